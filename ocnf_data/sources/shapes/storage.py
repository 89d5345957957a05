"""Shelves, beds and monitors."""

from __future__ import annotations

import numpy as np

from ocnf_data.sources.shapes.draw import Draw
from ocnf_data.sources.shapes.primitives import (
    Part,
    bar,
    bevel_box,
    board,
    box,
    cushion,
    ellipse,
    frustum,
    mirrored,
    rectangle,
    revolve,
    rounded,
    sheet,
    slab,
    solid,
    stack,
    tube,
)
from ocnf_data.sources.shapes.supports import four_legs, turned


def shelf(draw: Draw) -> list[Part]:
    """Bookcases with and without backs, cubes, ladder shelves, wire racks; books and boxes on the boards."""
    w, d, h = draw.between(0.5, 1.4), draw.between(0.24, 0.4), draw.between(0.8, 2.1)
    n, t = max(2, round(h / draw.between(0.28, 0.45))), draw.between(0.014, 0.03)
    levels = np.linspace(draw.between(0.04, 0.12), h - t, n + 1)
    style = draw.pick("case", "case", "cubes", "ladder", "rack", "zigzag")
    parts: list[Part] = []
    depths = np.full(n + 1, d)
    match style:
        case "case" | "cubes":
            parts += mirrored([box(t, d, h).move(x=w / 2 - t / 2)])
            if draw.chance(0.7):
                parts.append(board(w, h, draw.pick(0.0, 0.006)).move(y=d / 2))
            if style == "cubes":
                for x in np.linspace(-w / 2, w / 2, draw.count(3, 4))[1:-1]:
                    parts.append(box(t, d, h - levels[0]).move(x=x, z=levels[0]))
        case "ladder":
            depths = d * np.linspace(1.4, 0.7, n + 1)
            rail = bar((w / 2, -0.9 * d, 0), (w / 2, d / 2, h + 0.05), 0.018)
            parts += mirrored([rail, bar((w / 2, d / 2, 0), (w / 2, d / 2, h + 0.05), 0.018)])
        case "rack":
            r = draw.between(0.008, 0.014)
            parts += mirrored([bar((w / 2, s * d / 2, 0), (w / 2, s * d / 2, h + 0.03), r) for s in (-1, 1)])
            if draw.chance(0.6):
                parts += [bar((-w / 2, d / 2, 0.1), (w / 2, d / 2, h), r * 0.6),
                          bar((w / 2, d / 2, 0.1), (-w / 2, d / 2, h), r * 0.6)]
        case _:
            for i, (low, high) in enumerate(zip(levels[:-1], levels[1:], strict=True)):
                parts.append(box(t, d, high - low).move(x=(w / 2 - 0.08) * (-1) ** i, z=low))
    for z, deep in zip(levels, depths, strict=True):
        if style == "rack" and draw.chance(0.5):
            wires = np.linspace(-w / 2, w / 2, 16)
            parts += [bar((x, -d / 2, z), (x, d / 2, z), 0.004, n=5) for x in wires]
            parts += [bar((-w / 2, s * d / 2, z), (w / 2, s * d / 2, z), 0.006) for s in (-1, 1)]
        else:
            parts.append(box(w, deep, t).move(y=(d - deep) / 2, z=z))
    filled = draw.between(0, 0.8)
    for low, high, deep in zip(levels[:-1], levels[1:], depths, strict=False):
        if draw.chance(filled):
            parts += _books(draw, w - 2 * t - 0.02, deep, high - low - t, low + t, d / 2)
    if style == "case" and draw.chance(0.25):  # doors in front of the lower boards, what is inside stays
        top = levels[min(2, n)]
        door = bevel_box(w / 2 - 0.006, 0.018, top - levels[0], 0.004).move(x=w / 4, y=-d / 2 - 0.01, z=levels[0])
        ajar = draw.pick(0.0, draw.between(10, 80))
        hinge = door.move(x=-w / 2, y=d / 2).turn("z", ajar).move(x=w / 2, y=-d / 2)
        parts += [hinge, door.scale(x=-1)]
    return parts


def _books(draw: Draw, w: float, d: float, h: float, z: float, back: float) -> list[Part]:
    """A row of books from the left, the last ones leaning, or a box, or a vase."""
    kind = draw.pick("row", "row", "box", "vase")
    if kind == "box":
        size = min(h, w, d) * draw.between(0.5, 0.8)
        return [box(size * 1.2, d * 0.7, size).move(x=draw.between(-0.2, 0.2) * w, y=back - d / 2, z=z)]
    if kind == "vase":
        r, tall = min(h, d) * 0.25, h * draw.between(0.5, 0.9)
        vase = revolve([(0, 0), (0.6 * r, 0), (r, tall * 0.4), (0.4 * r, tall * 0.8), (0.5 * r, tall)], 16)
        return [vase.move(x=draw.between(-0.3, 0.3) * w, y=back - d / 2, z=z)]
    parts, x, end = [], -w / 2, draw.between(-0.1, 0.5) * w
    while x < end and len(parts) < 40:
        thick, tall, deep = draw.between(0.015, 0.06), h * draw.between(0.55, 0.95), d * draw.between(0.5, 0.85)
        parts.append(box(thick, deep, tall).move(x=x + thick / 2, y=back - deep / 2 - 0.01, z=z))
        x += thick + 0.001
    tall = h * 0.8
    parts.append(box(0.03, d * 0.6, tall).turn("y", -18).move(x=x + 0.04 + tall * 0.31, y=back - d * 0.3 - 0.01, z=z))
    return parts


def bed(draw: Draw) -> list[Part]:
    """Single to double beds, head to the back: panels, slats, arches, canopies, bunks, under a blanket."""
    w, d = draw.pick(0.9, 1.2, 1.4, 1.6, 1.8), draw.between(1.95, 2.1)
    low, thick = draw.between(0.14, 0.38), draw.between(0.14, 0.28)
    parts = _berth(draw, w, d, low, thick)
    style = draw.pick("plain", "plain", "plain", "canopy", "bunk")
    post = draw.between(0.025, 0.045)
    x, y = w / 2 + post, d / 2 + post
    if style == "plain":
        parts += four_legs(draw, w, d, low, draw.between(0.025, 0.045))
        parts += _headboard(draw, w, low, draw.between(0.75, 1.3), d / 2 + 0.03)
        if draw.chance(0.5):
            parts += _headboard(draw, w, low, draw.between(0.4, 0.7), -d / 2 - 0.03)
        return parts
    tall = draw.between(1.7, 2.1) if style == "canopy" else draw.between(1.5, 1.75)
    column = draw.pick(turned(draw, post, tall), box(2 * post, 2 * post, tall))
    parts += mirrored([column.move(x=x, y=s * y) for s in (-1, 1)])
    rails = mirrored([bar((x, -y, tall - 0.04), (x, y, tall - 0.04), post * 0.6)])
    rails += [bar((-x, s * y, tall - 0.04), (x, s * y, tall - 0.04), post * 0.6) for s in (-1, 1)]
    if style == "canopy":
        parts += [*rails, *_headboard(draw, w, low, draw.between(0.8, 1.2), y)]
        if draw.chance(0.5):
            u, v = np.meshgrid(np.linspace(-x, x, 16), np.linspace(-y, y, 16))
            parts.append(sheet(np.stack([u, v, tall - 0.12 * (1 - (u / x) ** 2)], axis=-1)))
        return parts
    upper = tall - thick - 0.35
    parts += [*_berth(draw, w, d, upper, thick), *rails]
    lx = draw.pick(-1, 1) * w / 4
    parts += [bar((lx + s * 0.18, -y - 0.03, 0), (lx + s * 0.18, -y - 0.03, tall), 0.018) for s in (-1, 1)]
    parts += [bar((lx - 0.18, -y - 0.03, z), (lx + 0.18, -y - 0.03, z), 0.014) for z in np.arange(0.25, tall, 0.27)]
    return parts


def _berth(draw: Draw, w: float, d: float, low: float, thick: float) -> list[Part]:
    """Frame, slats (hidden below the mattress), mattress, pillows and perhaps a blanket."""
    side = bevel_box(0.03, d, 0.16, 0.006).move(x=w / 2, z=low - 0.06)
    parts = [*mirrored([side]), *(box(w, 0.03, 0.14).move(y=s * d / 2, z=low - 0.05) for s in (-1, 1))]
    parts += [box(w - 0.03, 0.07, 0.015).move(y=v, z=low - 0.01) for v in np.linspace(-0.45 * d, 0.45 * d, 11)]
    parts.append(cushion(w - 0.04, d - 0.04, thick, draw.between(8, 14), 32).move(z=low))
    n = 1 if w < 1.3 else 2
    wide = min(0.7, (w - 0.1) / n)
    top = low + thick
    for i in range(n):
        pillow = cushion(wide, 0.4, 0.14, 2.8).turn("x", draw.between(0, 35))
        parts.append(pillow.move(x=(i - (n - 1) / 2) * wide, y=d / 2 - 0.28, z=top - 0.02))
    if draw.chance(0.5):
        reach, drop, phase = draw.between(0.4, 0.7) * d, draw.between(0.1, thick + 0.05), draw.between(0, 6)
        u, v = np.meshgrid(np.linspace(-1, 1, 33), np.linspace(0, reach, 20))
        over = np.clip(np.abs(u) * (w / 2 + drop) - w / 2, 0, None)
        x = np.sign(u) * np.minimum(np.abs(u) * (w / 2 + drop), w / 2 + 0.012)
        z = top + 0.015 - over + 0.008 * np.sin(9 * v + 5 * u + phase)
        parts.append(sheet(np.stack([x, v - d / 2 + 0.01, z], axis=-1)))
    return parts


def _headboard(draw: Draw, w: float, low: float, tall: float, y: float) -> list[Part]:
    x = w / 2
    match draw.pick("panel", "arch", "slats", "padded", "rails"):
        case "panel":
            parts = [bevel_box(w + 0.06, 0.04, tall, 0.01), bevel_box(w * 0.86, 0.02, tall * 0.5, 0.01).move(
                y=-0.025, z=tall * 0.4)]
        case "arch":
            parts = [board(w + 0.05, tall * 0.8, 0.04, 24, 0, tall * 0.25)]
        case "slats":
            slats = [bar((p, 0, low), (p, 0, tall - 0.02), 0.011) for p in np.linspace(-x, x, draw.count(7, 16))]
            parts = [*slats, *mirrored([box(0.05, 0.05, tall + 0.03).move(x=x)]),
                     box(w, 0.035, 0.05).move(z=tall - 0.05), box(w, 0.035, 0.05).move(z=low)]
        case "padded":
            n = draw.count(1, 4)
            parts = [box(w, 0.04, tall), *(cushion(w / n - 0.01, 0.12, tall - low, 6).move(
                x=(i - (n - 1) / 2) * w / n, y=-0.03, z=low) for i in range(n))]
        case _:
            ring = rounded([(-x, 0, 0), (-x, 0, tall), (x, 0, tall), (x, 0, 0)], 0.2)
            parts = [tube(ring, 0.02), *(bar((-x, 0, z), (x, 0, z), 0.01)
                                         for z in np.linspace(low, tall - 0.12, draw.count(2, 4)))]
    return [p.move(y=y) for p in parts]


def monitor(draw: Draw) -> list[Part]:
    """Flat and curved screens, alone or in pairs, and old ones with a tube behind them."""
    w = draw.between(0.4, 0.9)
    h = w * draw.pick(0.42, 0.5625, 0.625, 0.75)
    lift = draw.between(0.08, 0.22)
    if draw.chance(0.2):
        return _tube_monitor(draw, 0.42)
    bow = draw.between(0.02, 0.09) * w / 0.9 if draw.chance(0.3) else 0.0
    screen = [p.bend(lambda x, y, z: (x, y - bow * (2 * x / w) ** 2, z)) if bow else p
              for p in _flat_screen(draw, w, h)]
    tilt = draw.between(-10, 3)
    screen = [p.turn("x", tilt).move(z=lift) for p in screen]
    neck_x, plate = 0.0, draw.between(0.12, 0.2)
    if draw.chance(0.12):
        side = draw.between(8, 25)
        screen = [q for s in (-1, 1) for q in (p.move(x=s * w * 0.51).turn("z", -s * side) for p in screen)]
        plate = w * 0.5
    y = 0.06
    stem = draw.pick(box(0.06, 0.02, lift + h * 0.4), frustum(0.03, 0.02, lift + h * 0.4), bevel_box(
        0.11, 0.015, lift + h * 0.4, 0.004))
    parts = [*screen, stem.move(x=neck_x, y=y), box(0.08, 0.05, 0.08).move(y=y - 0.02, z=lift + h * 0.35)]
    match draw.pick("oval", "plate", "fork", "ring"):
        case "oval":
            parts.append(slab(ellipse(plate, 0.1, 32), 0.015, 0.005).move(y=0.02))
        case "plate":
            parts.append(bevel_box(2 * plate, 0.2, 0.012, 0.003).move(y=0.02))
        case "fork":
            parts += mirrored([bar((0, y, 0.012), (plate, -0.12, 0.008), 0.011), bar(
                (0, y, 0.012), (plate * 0.7, 0.13, 0.008), 0.011)])
        case _:
            a = np.linspace(0, 2 * np.pi, 32, endpoint=False)
            ring = np.column_stack([plate * np.cos(a), 0.11 * np.sin(a) - 0.05, 0 * a + 0.01])
            parts.append(tube(ring, 0.01, loop=True))
    return parts


def _flat_screen(draw: Draw, w: float, h: float) -> list[Part]:
    """The picture recessed in a bezel, a back that bulges, boards inside."""
    edge, deep = draw.between(0.006, 0.03), draw.between(0.015, 0.035)
    chin = edge * draw.pick(1.0, 1.0, 2.5)
    n = 12
    x = np.linspace(-w / 2, w / 2, n + 1)
    strip = solid(np.stack([np.column_stack([np.full(4, u), rectangle(deep, 1)[:, 0], rectangle(deep, 1)[:, 1]])
                            for u in x]))
    bezel = [strip.scale(z=chin).move(z=chin / 2), strip.scale(z=edge).move(z=h - edge / 2),
             *mirrored([box(edge, deep, h).move(x=w / 2 - edge / 2)])]
    picture = board(w - edge, h - edge, 0, n).move(y=-deep / 2 + 0.004, z=edge / 2)
    back = board(w, h, 0, n).move(y=deep / 2)
    bulge = solid(stack([rectangle(w * 0.7, h * 0.6), rectangle(w * 0.45, h * 0.35)], [0, 0.035]))
    bulge = bulge.turn("x", -90).move(y=deep / 2 - 0.002, z=h / 2)
    inside = [box(w * 0.4, 0.003, h * 0.4).move(z=h * 0.3), *(
        box(0.03, 0.008, 0.03).move(x=p * w, y=0.004, z=h * 0.4) for p in (-0.12, 0.0, 0.13))]
    return [*bezel, picture, back, bulge, *inside]


def _tube_monitor(draw: Draw, w: float) -> list[Part]:
    h, deep, lift = w * draw.between(0.78, 0.95), draw.between(0.3, 0.45), draw.between(0.04, 0.1)
    outlines = [rectangle(w, h, 0.02), rectangle(w, h, 0.02), rectangle(w * 0.97, h * 0.95, 0.04),
                rectangle(w * 0.55, h * 0.5, 0.04), rectangle(w * 0.5, h * 0.45, 0.04)]
    body = solid(stack(outlines, [0, 0.06, 0.1, deep * 0.8, deep])).turn("x", -90).move(z=h / 2)
    u, v = np.meshgrid(np.linspace(-0.42 * w, 0.42 * w, 13), np.linspace(0.1 * h, 0.9 * h, 13))
    bulb = 0.02 * (1 - (2 * u / w) ** 2) * (1 - (2 * v / h - 1) ** 2)
    glass = sheet(np.stack([u, -0.004 - bulb, v], axis=-1))
    gun = frustum(0.12, 0.02, deep * 0.7).turn("x", -90).move(y=0.03, z=h / 2)  # the tube inside
    vents = [box(w * 0.3, 0.004, 0.004).move(y=0.3 * deep + 0.02 * i, z=h - 0.02 - 0.02 * i) for i in range(4)]
    tilt = draw.between(-8, 4)
    parts = [p.turn("x", tilt).move(y=-deep * 0.4, z=lift + 0.03) for p in (body, glass, gun, *vents)]
    return [*parts, frustum(0.13, 0.1, lift + 0.04, 24), bevel_box(0.28, 0.26, 0.025, 0.008)]
