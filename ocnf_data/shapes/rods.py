"""Shapes of thin rods: ladders, racks, poles, fences, stools."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from ocnf_data.shapes.draw import Draw
from ocnf_data.shapes.primitives import (
    Part,
    arc,
    around,
    bar,
    bevel_box,
    board,
    box,
    cushion,
    ellipsoid,
    frustum,
    mirrored,
    revolve,
    rounded,
    tube,
)


def ladder(draw: Draw) -> list[Part]:
    """Straight ladders, tapering ones, step ladders and trestles, of round or square bars."""
    h, w = draw.between(1.2, 2.6), draw.between(0.3, 0.5)
    top, r = draw.between(0.6, 1.0) * w, draw.between(0.012, 0.028)
    n = draw.count(4, 9)
    square = draw.chance(0.5)

    def rail(a: tuple[float, float, float], b: tuple[float, float, float], q: float) -> Part:
        return bar(a, b, q * 1.3, n=4) if square else bar(a, b, q)

    parts = mirrored([rail((w / 2, 0, 0), (top / 2, 0, h), r)])
    steps = (np.arange(n) + 0.5) / n
    for u in steps:
        x = (w + (top - w) * u) / 2
        if square and draw.chance(0.5):
            parts.append(box(2 * x, draw.between(0.06, 0.1), 0.02).move(z=u * h))
        else:
            parts.append(rail((-x, 0, u * h), (x, 0, u * h), 0.8 * r))
    if draw.chance(0.55):
        lean = draw.between(8, 20)
        back = mirrored([rail((w / 2, 0, 0), (top / 2, 0, h), 0.9 * r)])
        for u in steps[:: draw.pick(1, 2, 3)]:
            x = (w + (top - w) * u) / 2
            back.append(rail((-x, 0, u * h), (x, 0, u * h), 0.6 * r))
        hinge = [p.move(z=-h) for p in parts], [p.move(z=-h) for p in back]
        parts = [p.turn("x", -lean).move(z=h) for p in hinge[0]] + [
            p.turn("x", lean).move(z=h) for p in hinge[1]
        ]
        parts.append(bevel_box(top + 4 * r, 0.14, 0.04, 0.01).move(z=h - 0.02))
    else:
        lean = draw.pick(0.0, -draw.between(5, 25))
        parts = [p.turn("x", lean) for p in parts]
    return parts


def rack(draw: Draw) -> list[Part]:
    """Coat stands, clothes rails, drying racks, dish racks, wine racks, grids."""
    r = draw.between(0.008, 0.016)
    match draw.pick("coat", "rail", "dryer", "dish", "grid"):
        case "coat":
            h = draw.between(1.5, 1.9)
            parts = [bar((0, 0, 0), (0, 0, h), 1.4 * r)]
            foot = arc([(0, 0, 0.25), (0.12, 0, 0.12), (draw.between(0.2, 0.35), 0, 0.01)], 10)
            parts += around(tube(foot, r), draw.count(3, 5))
            hook = arc([(0, 0, h - 0.25), (0.1, 0, h - 0.15), (0.16, 0, h - 0.05), (0.14, 0, h)], 12)
            hooks = around(tube(hook, 0.7 * r), draw.count(4, 8))
            parts += hooks
            if draw.chance(0.5):
                parts += [p.scale(0.8, 0.8, 1).move(z=-0.35) for p in hooks]
            if draw.chance(0.4):
                ring = np.array(
                    [(0.2 * np.cos(t), 0.2 * np.sin(t), 0.45) for t in np.arange(32) * np.pi / 16]
                )
                parts.append(tube(ring, 0.7 * r, loop=True))
        case "rail":
            w, h, d = draw.between(0.8, 1.5), draw.between(1.3, 1.8), draw.between(0.3, 0.5)
            parts = mirrored(
                [bar((w / 2, 0, 0), (w / 2, 0, h), r), bar((w / 2, -d / 2, 0.03), (w / 2, d / 2, 0.03), r)]
            )
            parts.append(bar((-w / 2 - 0.1, 0, h), (w / 2 + 0.1, 0, h), r))
            if draw.chance(0.6):
                parts += [
                    bar((-w / 2, y, 0.15), (w / 2, y, 0.15), 0.8 * r) for y in np.linspace(-d / 3, d / 3, 4)
                ]
            for x in np.linspace(-0.4, 0.4, 9)[: draw.count(0, 9)] * w:
                wire = [(-0.2, 0, -0.2), (0, 0, -0.06), (0.2, 0, -0.2)]
                hanger = (
                    tube(rounded(wire, 0.02, loop=True), 0.005, 6, loop=True).turn("z", 90).move(x=x, z=h)
                )
                parts += [hanger, bar((x, 0, h - 0.06), (x, 0, h + 0.02), 0.003, n=6)]
                if draw.chance(0.4):
                    cloth = board(
                        0.4, draw.between(0.5, 0.9), draw.pick(0.0, 0.01), 6, draw.between(-0.05, 0.05)
                    )
                    parts.append(cloth.move(z=-0.2).turn("z", 90).move(x=x, z=h - 0.9))
        case "dryer":
            w, d, h = draw.between(0.8, 1.3), draw.between(0.5, 0.7), draw.between(0.8, 1.1)
            parts = [
                bar((-w / 2, y, h), (w / 2, y, h), 0.4 * r, n=6)
                for y in np.linspace(-d / 2, d / 2, draw.count(6, 14))
            ]
            parts += mirrored(
                [
                    bar((w / 2, -d / 2, h), (w / 2, d / 2, h), r),
                    bar((0.4 * w, -d / 2, 0), (0.4 * w, d / 2, h), r),
                    bar((0.4 * w, d / 2, 0), (0.4 * w, -d / 2, h), r),
                ]
            )
            parts += [bar((-0.4 * w, s * d / 2, 0), (0.4 * w, s * d / 2, 0), r) for s in (-1, 1)]
        case "dish":
            w, d, h = draw.between(0.3, 0.5), draw.between(0.25, 0.35), draw.between(0.08, 0.15)
            frame = [(-w / 2, -d / 2), (w / 2, -d / 2), (w / 2, d / 2), (-w / 2, d / 2)]
            parts = [
                tube(rounded([(x, y, z) for x, y in frame], 0.03, loop=True), 0.4 * r, loop=True)
                for z in (0.02, h)
            ]
            for x in np.linspace(-0.45, 0.45, draw.count(8, 18)) * w:
                path = [(x, -d / 2, h), (x, -d / 2, 0.02), (x, 0, 0.02), (x, 0, 0.9 * h)]
                parts.append(tube(rounded(path, 0.02), 0.25 * r, 6))
                parts.append(
                    tube(rounded([(x, 0, 0.02), (x, d / 2, 0.02), (x, d / 2, h)], 0.02), 0.25 * r, 6)
                )
            plates = draw.count(0, 4)
            parts += [
                frustum(0.1, 0.11, 0.012, 28).turn("y", 80).move(x=x, z=0.14)
                for x in np.linspace(-0.3, 0.3, 5)[:plates] * w
            ]
        case _:
            w, h = draw.between(0.5, 1.0), draw.between(0.5, 1.2)
            n, m = draw.count(4, 10), draw.count(4, 10)
            parts = [bar((x, 0, 0), (x, 0, h), 0.5 * r, n=6) for x in np.linspace(-w / 2, w / 2, n)]
            parts += [bar((-w / 2, 0, z), (w / 2, 0, z), 0.5 * r, n=6) for z in np.linspace(0, h, m)]
            if draw.chance(0.7):
                d = draw.between(0.15, 0.4)
                parts += [p.move(y=d) for p in parts]
                parts += [
                    bar((x, 0, z), (x, d, z), 0.5 * r, n=6)
                    for x in np.linspace(-w / 2, w / 2, n)
                    for z in np.linspace(0, h, m)[:: draw.pick(1, 2)]
                ]
            else:
                parts += mirrored([box(0.05, 0.4, 0.03).move(x=w / 2)])
    return parts


def pole(draw: Draw) -> list[Part]:
    """Street lamps, signposts, masts with arms, parasols, flags: one pole and what it carries."""
    h, r = draw.between(2, 4), draw.between(0.02, 0.06)
    parts = [tube([(0, 0, 0), (0, 0, h)], [r * draw.between(1, 1.8), r], draw.pick(6, 8, 12))]
    match draw.pick("plate", "block", "cross", "none"):
        case "plate":
            parts.append(frustum(5 * r, 4 * r, 0.06, 24))
        case "block":
            parts.append(bevel_box(8 * r, 8 * r, 0.25, 0.03))
        case "cross":
            parts += around(bar((0, 0, 0.05), (0.15 * h, 0, 0.02), 0.8 * r), 4)
    match draw.pick("lamp", "sign", "mast", "parasol", "flag"):
        case "lamp":
            reach = draw.between(0.15, 0.35) * h
            arm = arc([(0, 0, 0.85 * h), (0.2 * reach, 0, 1.02 * h), (reach, 0, 1.03 * h)], 12)
            head = cushion(0.12 * h, 0.06 * h, 0.03 * h, draw.pick(2, 4)).move(x=reach, z=h)
            n = draw.pick(1, 1, 2, 2, 3, 4)
            parts += [*around(tube(arm, 0.7 * r), n), *around(head, n)]
        case "sign":
            for _ in range(draw.count(1, 4)):
                w, tall = draw.between(0.15, 0.4) * h, draw.between(0.05, 0.12) * h
                plate = board(w, tall, draw.pick(0.0, 0.02)).move(x=draw.between(-0.3, 0.6) * w, y=-r)
                parts.append(plate.turn("z", draw.between(0, 360)).move(z=draw.between(0.5, 0.85) * h))
        case "mast":
            for u in np.linspace(0.5, 0.97, draw.count(1, 5)):
                wide = draw.between(0.1, 0.3) * h
                spar = [bar((-wide, 0, u * h), (wide, 0, u * h), 0.6 * r)]
                if draw.chance(0.5):
                    spar += [bar((x, 0, (u - 0.04) * h), (x, 0, u * h), 0.3 * r, n=6) for x in (-wide, wide)]
                angle = draw.pick(0.0, 90.0, draw.between(0, 180))
                parts += [p.turn("z", angle) for p in spar]
            if draw.chance(0.5):
                parts += around(bar((0.25 * h, 0, 0), (0, 0, 0.9 * h), 0.006, n=5), 3)
        case "parasol":
            n, wide = draw.count(6, 10), draw.between(0.3, 0.5) * h
            tips = np.array(
                [(wide * np.cos(t), wide * np.sin(t), 0.82 * h) for t in 2 * np.pi * np.arange(n) / n]
            )
            top = np.array([0.0, 0.0, h])
            parts.append(Part(np.vstack([tips, top]), np.array([(i, (i + 1) % n, n) for i in range(n)])))
            parts += around(bar((0, 0, 0.985 * h), (wide, 0, 0.82 * h), 0.4 * r, n=6), n)
            parts += around(bar((0, 0, 0.7 * h), (wide / 2, 0, 0.9 * h), 0.3 * r, n=5), n)
        case _:
            w, tall = draw.between(0.2, 0.45) * h, draw.between(0.12, 0.25) * h
            cloth = board(w, tall, draw.pick(0.0, 0.01), 10).move(x=w / 2, z=0.97 * h - tall)
            wave, phase = draw.between(4, 9) / w, draw.between(0, 6)
            parts.append(cloth.bend(lambda x, y, z: (x, y + 0.08 * x * np.sin(wave * x + phase), z)))
            parts.append(ellipsoid(1.6 * r, 1.6 * r, 1.6 * r, 12).move(z=h))
    return parts


def fence(draw: Draw) -> list[Part]:
    """Fences, gates, railings and benches of slats: posts, rails and pickets in a row."""
    w, h = draw.between(1.2, 3), draw.between(0.7, 1.3)
    posts, t = np.linspace(-w / 2, w / 2, draw.count(2, 5)), draw.between(0.03, 0.07)
    parts = [box(t, t, h * draw.pick(1.0, 1.08)).move(x=x) for x in posts]
    rails = np.linspace(0.15, 0.85, draw.count(2, 4)) * h
    thin = draw.between(0.008, 0.02)
    style = draw.pick("pickets", "bars", "rails", "cross", "wire")
    if style == "wire":
        rails = np.linspace(0.05, 0.95, draw.count(5, 12)) * h
    parts += [
        bar((-w / 2, 0, z), (w / 2, 0, z), 0.5 * thin if style == "wire" else 1.5 * thin, n=draw.pick(4, 8))
        for z in rails
    ]
    n = draw.count(8, 22)
    match style:
        case "pickets":
            wide = draw.between(0.4, 0.8) * w / n
            top = np.array([(-wide / 2, 0), (wide / 2, 0), (wide / 2, 0.9 * h), (0, h), (-wide / 2, 0.9 * h)])
            for x in np.linspace(-w / 2, w / 2, n):
                front = np.column_stack([top[:, 0] + x, np.full(5, -t / 2), top[:, 1]])
                fan = [(0, 1, 2), (0, 2, 4), (4, 2, 3)]
                back = [(5 + a, 5 + c, 5 + b) for a, b, c in fan]
                edge = [
                    f
                    for i in range(5)
                    for f in ((i, i + 5, (i + 1) % 5), ((i + 1) % 5, i + 5, (i + 1) % 5 + 5))
                ]
                vertices = np.vstack([front, front + np.array([0, 0.015, 0])])
                parts.append(Part(vertices, np.array(fan + back + edge)))
        case "bars":
            parts += [bar((x, 0, 0.1 * h), (x, 0, h), 0.6 * thin, n=6) for x in np.linspace(-w / 2, w / 2, n)]
            if draw.chance(0.5):
                parts += [
                    frustum(1.5 * thin, 0.001, 0.08, 6).move(x=x, z=h) for x in np.linspace(-w / 2, w / 2, n)
                ]
        case "cross":
            for a, b in pairwise(posts):
                parts += [
                    bar((a, 0, 0.1 * h), (b, 0, 0.9 * h), thin),
                    bar((b, 0, 0.1 * h), (a, 0, 0.9 * h), thin),
                ]
        case "wire":
            parts += [
                bar((x, 0, 0.05 * h), (x, 0, 0.95 * h), 0.4 * thin, n=5)
                for x in np.linspace(-w / 2, w / 2, n)
            ]
    if draw.chance(0.35):  # round a corner
        parts += [p.turn("z", 90).move(w / 2, w / 2) for p in parts]
    return parts


def stool(draw: Draw) -> list[Part]:
    """Stools without backs: three or four legs, one pillar, or a bent tube; round and square seats."""
    h, r = draw.between(0.4, 0.8), draw.between(0.14, 0.2)
    match draw.pick("disc", "square", "cushion", "dish"):
        case "disc":
            parts = [frustum(r, r, draw.between(0.02, 0.05), 32).move(z=h)]
        case "square":
            parts = [bevel_box(2 * r, 2 * r, draw.between(0.02, 0.06), 0.01).move(z=h)]
        case "cushion":
            parts = [cushion(2 * r, 2 * r, draw.between(0.06, 0.12), draw.pick(2.4, 4)).move(z=h - 0.01)]
        case _:
            u = np.linspace(0.05, 1, 8)
            dish = [(0, h), *zip(r * u, h + 0.04 * u**3, strict=True), (0.96 * r, h + 0.06), (0, h + 0.02)]
            parts = [frustum(0.2 * r, 0.6 * r, 0.02).move(z=h - 0.015), revolve(dish, 32)]
    q = draw.between(0.01, 0.022)
    match draw.pick("legs", "legs", "pillar", "tube"):
        case "legs":
            n, spread, start = draw.pick(3, 4, 4), draw.between(0.9, 1.3), draw.pick(0, 45)
            parts += around(bar((spread * r, 0, 0), (0.7 * r, 0, h), 0.8 * q, q), n, start)
            if draw.chance(0.7):
                z = draw.between(0.2, 0.5)
                x = r * (spread + (0.7 - spread) * z)
                half, in_between = x * np.sin(np.pi / n), x * np.cos(np.pi / n)
                rung = bar((in_between, -half, z * h), (in_between, half, z * h), 0.6 * q)
                parts += around(rung, n, start + 180 / n)
        case "pillar":
            parts += [bar((0, 0, 0), (0, 0, h), 1.5 * q), frustum(1.1 * r, 0.9 * r, 0.03, 28)]
            if draw.chance(0.5):
                ring = [
                    (0.7 * r * np.cos(t), 0.7 * r * np.sin(t), 0.35 * h) for t in np.arange(24) * np.pi / 12
                ]
                parts += [
                    tube(ring, 0.5 * q, loop=True),
                    *around(bar((0, 0, 0.35 * h), (0.7 * r, 0, 0.35 * h), 0.4 * q), 3),
                ]
        case _:
            for y in (-0.8 * r, 0.8 * r):
                path = [(-r, y, h), (-r, y, 0.01), (r, y, 0.01), (r, y, h)]
                parts.append(tube(rounded(path, 0.05), 0.8 * q))
            parts.append(bar((r, -0.8 * r, 0.3 * h), (r, 0.8 * r, 0.3 * h), 0.7 * q))
    return parts
