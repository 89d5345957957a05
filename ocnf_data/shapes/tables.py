"""Tables and desks."""

from __future__ import annotations

import numpy as np

from ocnf_data.shapes.draw import Draw
from ocnf_data.shapes.primitives import (
    Part,
    around,
    bar,
    bevel_box,
    board,
    box,
    ellipse,
    frustum,
    loft,
    mirrored,
    rectangle,
    rounded,
    slab,
    stack,
    taper_box,
    tube,
)
from ocnf_data.shapes.supports import four_legs, turned


def table(draw: Draw) -> list[Part]:
    """Dining, coffee and side tables and benches: legs, pedestals, trestles, wire and panel bases."""
    match draw.pick("dining", "dining", "coffee", "side", "bench"):
        case "dining":
            w, d, h = draw.between(1.1, 2.2), draw.between(0.7, 1.1), draw.between(0.71, 0.78)
        case "coffee":
            w, d, h = draw.between(0.8, 1.4), draw.between(0.5, 0.8), draw.between(0.32, 0.48)
        case "side":
            w = d = draw.between(0.4, 0.6)
            h = draw.between(0.45, 0.72)
        case _:
            w, d, h = draw.between(1.0, 1.8), draw.between(0.3, 0.42), draw.between(0.42, 0.48)
    thick = draw.between(0.015, 0.05)
    power = draw.pick(2.0, 2.0, 3.0, 6.0)
    outline = (
        ellipse(w / 2, d / 2, 40, power) if draw.chance(0.45) else rectangle(w, d, draw.pick(0, 0.02, 0.1))
    )
    if draw.chance(0.08):  # a sheet of glass
        top = [loft(stack([outline, outline / 2], [h, h]), end=np.array([0.0, 0.0, h]))]
    else:
        top = [slab(outline, thick, draw.pick(0, 0.006, 0.012)).move(z=h - thick)]
    under = h - thick + 0.004
    inset = 0.72 if len(outline) == 40 and power < 4 else 0.96
    return [*top, *_table_base(draw, w * inset, d * inset, under, round_top=inset < 0.9)]


def _table_base(draw: Draw, w: float, d: float, h: float, round_top: bool) -> list[Part]:
    r = draw.between(0.018, 0.042)
    match draw.pick("legs", "legs", "legs", "pedestal", "trestle", "panels", "frame", "wire"):
        case "pedestal":
            places = [0.0] if w < 1.3 else [-0.27 * w, 0.27 * w]
            reach = min(d * 0.45, 0.4)
            foot = tube(
                rounded([(0.02, 0, h * 0.22), (reach * 0.5, 0, h * 0.16), (reach, 0, 0.015)], 0.08),
                0.022,
                section=ellipse(1, 1.2, 8, 4),
            )
            base = draw.pick([frustum(reach, reach * 0.8, 0.03, 28)], around(foot, draw.count(3, 5), 45))
            column = [
                turned(draw, draw.between(0.03, 0.06), h),
                *base,
                box(reach * 1.4, 0.06, 0.03).move(z=h - 0.03),
            ]
            return [p.move(x=x) for x in places for p in column]
        case "trestle":
            x, y = w * 0.36, d * 0.42
            lean = draw.between(0.3, 1.0)
            end = [
                bar((x, -y, 0), (x, -y * (1 - lean), h), r),
                bar((x, y, 0), (x, y * (1 - lean), h), r),
                bar((x, -y * 0.7, h - r), (x, y * 0.7, h - r), r),
            ]
            z = h * draw.between(0.15, 0.45)
            return [
                *mirrored(end),
                box(2 * x, 0.03, 0.08).move(z=z),
                bar((-x, -y * 0.8, z), (-x, y * 0.8, z), r),
                bar((x, -y * 0.8, z), (x, y * 0.8, z), r),
            ]
        case "panels":
            side = bevel_box(draw.between(0.02, 0.06), d * 0.9, h, 0.005).move(x=w * 0.42)
            return [*mirrored([side]), board(w * 0.84, draw.between(0.06, 0.5) * h, 0.02).move(z=h * 0.5)]
        case "frame":
            x, y = w / 2 - 0.04, d / 2 - 0.04
            ring = rounded([(x, -y, 0.015), (x, y, 0.015), (x, y, h), (x, -y, h)], 0.02, 3, loop=True)
            return [
                *mirrored([tube(ring, 0.018, loop=True, section=ellipse(1, 1, 8, 8))]),
                bar((-x, 0, h - 0.02), (x, 0, h - 0.02), 0.015),
            ]
        case "wire":
            n = draw.count(14, 36)
            a = 2 * np.pi * np.arange(n) / n
            low, waist, high = (
                0.4 * s * min(w, d) for s in (1.0, draw.between(0.3, 0.7), draw.between(0.8, 1.1))
            )
            parts = []
            for t in a:
                c, s = np.cos(t), np.sin(t)
                c2, s2 = np.cos(t + 0.5), np.sin(t + 0.5)
                parts.append(
                    tube(
                        [(low * c, low * s, 0), (waist * c, waist * s, h / 2), (high * c2, high * s2, h)],
                        0.005,
                        5,
                    )
                )
            rings = [
                tube(np.column_stack([q * np.cos(a), q * np.sin(a), 0 * a + z]), 0.006, 6, loop=True)
                for q, z in ((low, 0.006), (high, h - 0.006))
            ]
            places = [0.0] if w < 1.8 * d else [-0.28 * w, 0.28 * w]
            return [p.move(x=x) for x in places for p in (*parts, *rings)]
    parts = four_legs(draw, w, d, h, r)
    if draw.chance(0.6):
        x, y, drop = w - 4 * r, d - 4 * r, draw.between(0.04, 0.12)
        front = board(x, drop, 0.018, 8, 0, draw.pick(0, -0.02)).move(z=h - drop)
        side = board(y, drop, 0.018).turn("z", 90).move(x=x / 2, z=h - drop)
        parts += [front.move(y=-y / 2), front.move(y=y / 2), *mirrored([side])]
        if w > 0.7 and draw.chance(0.3):
            inset = _drawer(draw, x * 0.4, y * 0.8, drop * 0.9, draw.between(0, 0.2))
            parts += [p.move(y=-y / 2 - 0.012, z=h - drop) for p in inset]
    if not round_top and draw.chance(0.25):
        parts.append(bevel_box(w * 0.92, d * 0.9, 0.02, 0.004).move(z=h * draw.between(0.15, 0.35)))
    return parts


def _drawer(draw: Draw, w: float, d: float, h: float, out: float) -> list[Part]:
    """A drawer, open at the top, from z = 0 up: its front at y = 0, pulled out by `out`."""
    t, deep = 0.012, d - 0.02
    parts = [
        bevel_box(w, 0.02, h, 0.004),
        box(w - 0.03, deep, t).move(y=deep / 2, z=0.01),
        *mirrored([box(t, deep, h * 0.7).move(x=w / 2 - 0.02, y=deep / 2, z=0.01)]),
        box(w - 0.03, t, h * 0.7).move(y=deep, z=0.01),
    ]
    match draw.pick("bar", "ball", "none"):
        case "bar":
            x, y, z = min(0.07, w * 0.3), -0.035, h / 2
            parts.append(tube(rounded([(-x, 0, z), (-x, y, z), (x, y, z), (x, 0, z)], 0.012, 3), 0.005, 6))
        case "ball":
            parts.append(frustum(0.006, 0.014, 0.03, 10).turn("x", 90).move(z=h / 2))
    return [p.move(y=-out) for p in parts]


def desk(draw: Draw) -> list[Part]:
    """Desks with drawers, some pulled out, hutches, returns, cable trays; writing and standing desks."""
    w, d, h = draw.between(1.1, 1.9), draw.between(0.55, 0.85), draw.between(0.70, 0.78)
    thick = draw.between(0.02, 0.045)
    parts = [bevel_box(w, d, thick, 0.006).move(z=h - thick)]
    under = h - thick
    match draw.pick("pedestals", "pedestals", "one", "legs", "standing", "panels"):
        case "pedestals":
            parts += [*_pedestal(draw, w, d, under, -1), *_pedestal(draw, w, d, under, 1)]
        case "one":
            side = draw.pick(-1, 1)
            parts += _pedestal(draw, w, d, under, side)
            x = -side * (w / 2 - 0.04)
            parts += draw.pick(
                [bevel_box(0.03, d * 0.92, under, 0.005).move(x=x)],
                [bar((x, s * d * 0.4, 0), (x, s * d * 0.4, under), 0.02) for s in (-1, 1)],
            )
        case "standing":
            column = [
                box(0.07, d * 0.85, 0.03),
                box(0.08, 0.06, under * 0.5),
                box(0.06, 0.045, under),
                box(0.05, d * 0.8, 0.03).move(z=under - 0.03),
            ]
            parts += [p.move(x=s * w * 0.36) for s in (-1, 1) for p in column]
            parts.append(box(w * 0.72, 0.03, 0.05).move(z=under - 0.06))
        case "legs":
            parts += four_legs(draw, w, d, under + 0.004, draw.between(0.018, 0.03))
            drop = draw.between(0.08, 0.14)
            n = draw.count(1, 3)
            for i in range(n):
                front = _drawer(draw, w * 0.86 / n, d * 0.8, drop, draw.pick(0, draw.between(0, 0.3)))
                x = (i - (n - 1) / 2) * w * 0.88 / n
                parts += [p.move(x=x, y=-d / 2 + 0.03, z=under - drop) for p in front]
            parts.append(board(w * 0.9, drop, 0.015).move(y=d / 2 - 0.04, z=under - drop))
        case _:
            parts += mirrored([bevel_box(0.035, d * 0.95, under, 0.006).move(x=w / 2 - 0.03)])
    if draw.chance(0.6):  # the modesty panel, a board or a sheet
        tall = draw.between(0.25, 0.9) * under
        parts.append(board(w - 0.1, tall, draw.pick(0.0, 0.016)).move(y=d / 2 - 0.06, z=under - tall))
    if draw.chance(0.35):
        parts += _hutch(draw, w, d, h)
    if draw.chance(0.2):
        side, reach = draw.pick(-1, 1), draw.between(0.5, 0.9)
        x, y = side * (w / 2 - d * 0.35), -d / 2 - reach / 2
        parts += [
            bevel_box(d * 0.7, reach, thick, 0.006).move(x=x, y=y, z=h - thick),
            box(d * 0.68, 0.03, under).move(x=x, y=y - reach / 2 + 0.03),
        ]
    if draw.chance(0.25):
        stand = [box(0.5, 0.22, 0.015).move(z=0.1), *mirrored([box(0.015, 0.22, 0.1).move(x=0.24)])]
        parts += [p.move(y=d * 0.25, z=h) for p in stand]
    return parts


def _pedestal(draw: Draw, w: float, d: float, h: float, side: int) -> list[Part]:
    """A chest of drawers under one end: an open-fronted case, and drawers that may be pulled out."""
    cw, n, t = draw.between(0.32, 0.45), draw.count(2, 4), 0.016
    lift = draw.pick(0.0, 0.06)
    x, deep, case_h = side * (w / 2 - cw / 2 - 0.02), d * 0.92, h - lift
    case = [
        *mirrored([box(t, deep, case_h).move(x=cw / 2 - t / 2)]),
        box(cw, t, case_h).move(y=deep / 2 - t / 2),
        box(cw, deep, t),
        box(cw, deep, t).move(z=case_h - t),
    ]
    row = (case_h - 0.05) / n
    for i in range(n):
        out = draw.between(0.05, 0.35) if draw.chance(0.25) else 0.0
        front = _drawer(draw, cw - 0.01, deep * 0.9, row - 0.012, out)
        case += [p.move(y=-deep / 2 - 0.008, z=0.025 + i * row) for p in front]
    if lift:
        case += mirrored(
            [
                taper_box(0.04, 0.04, lift + 0.01, 1.2).move(x=cw * 0.4, y=s * deep * 0.4, z=-lift)
                for s in (-1, 1)
            ]
        )
    return [p.move(x=x, z=lift) for p in case]


def _hutch(draw: Draw, w: float, d: float, h: float) -> list[Part]:
    tall, deep, t = draw.between(0.3, 0.7), draw.between(0.2, 0.3), 0.018
    n = draw.count(1, 3)
    parts = [*mirrored([box(t, deep, tall).move(x=w / 2 - t / 2)]), box(w, deep, t).move(z=tall - t)]
    parts += [box(w - 2 * t, deep, t).move(z=tall * i / (n + 1)) for i in range(1, n + 1)]
    if draw.chance(0.6):
        parts.append(board(w, tall, 0).move(y=deep / 2))
    parts += [box(t, deep, tall * 0.5).move(x=p * w, z=tall * 0.5) for p in (-0.2, 0.2)[: draw.count(0, 2)]]
    return [p.move(y=d / 2 - deep / 2, z=h) for p in parts]
