"""Things that stand on furniture or beside it: bottles, guitars, lamps, mugs and plants."""

from __future__ import annotations

import numpy as np

from ocnf_data.sources.shapes.draw import Draw
from ocnf_data.sources.shapes.primitives import (
    F64,
    Part,
    arc,
    around,
    bar,
    bevel_box,
    box,
    cushion,
    ellipse,
    ellipsoid,
    frustum,
    mirrored,
    revolve,
    rounded,
    sheet,
    slab,
    solid,
    tube,
)
from ocnf_data.sources.shapes.supports import turned


def mug(draw: Draw) -> list[Part]:
    """Mugs, cups, beakers and steins with handles of all kinds, saucers, lids, spoons, something to drink."""
    r, h = draw.between(0.035, 0.05), draw.between(0.06, 0.13)
    wall = draw.between(0.003, 0.006)
    flare, belly = draw.between(0.75, 1.3), draw.between(-0.12, 0.25)
    u = np.linspace(0, 1, 9)
    outer = r * (1 + (flare - 1) * u + belly * np.sin(np.pi * u))
    inner = np.maximum(outer - wall, 0.004)
    up, down = np.column_stack([outer, u * h]), np.column_stack([inner, wall + u * (h - wall)])[::-1]
    lip = [[(outer[-1] + inner[-1]) / 2, h + wall * 0.4]]
    n = draw.pick(10, 32, 32, 40)
    profile = np.concatenate([[[0, 0]], up, lip, down, [[0, wall]]])
    parts = [revolve(profile, n)]
    if draw.chance(0.9):
        parts += _handle(draw, h, float(np.interp(0.82, u, outer)), float(np.interp(0.2, u, outer)))
    if draw.chance(0.4):
        level = draw.between(0.5, 0.9)
        parts.append(revolve([(0, level * h), (float(np.interp(level, u, inner)), level * h)], n))
    if draw.chance(0.25):
        q = r * draw.between(1.7, 2.1)
        saucer = [(0, -0.004), (0.5 * q, -0.004), (0.55 * q, 0), (q, 0.012), (q, 0.015), (0.5 * q, 0.002), (0, 0.001)]
        parts = [*(p.move(z=0.004) for p in parts), revolve(saucer, 36).move(z=0.004)]
    if draw.chance(0.2):
        top = float(outer[-1])
        tilt = draw.between(-1, 1)
        parts += [bar((0, 0, wall * 2), (top * 0.9, top * tilt * 0.2, h * 1.5), 0.0022, n=6),
                  cushion(0.02, 0.03, 0.006, 2.2).turn("y", 35).move(z=wall * 2)]
    elif draw.chance(0.15):
        top = float(outer[-1])
        lid = [(0, h), (top * 1.03, h), (top * 1.03, h + 0.005), (top * 0.5, h + 0.016), (0.008, h + 0.02),
               (0.011, h + 0.03), (0, h + 0.034)]
        parts.append(revolve(lid, n))
    return parts


def _handle(draw: Draw, h: float, upper: float, lower: float) -> list[Part]:
    out, thick = draw.between(0.022, 0.04), draw.between(0.0035, 0.006)
    high, low = 0.82 * h, draw.between(0.15, 0.3) * h
    a, b = (upper - 0.002, 0, high), (lower - 0.002, 0, low)
    x = max(upper, lower) + out
    match draw.pick("C", "D", "ear", "strap"):
        case "C":
            path = arc([a, (x, 0, high * 0.95), (x + 0.004, 0, (high + low) / 2), (x * 0.9, 0, low * 1.1), b], 20)
        case "D":
            path = rounded([a, (x, 0, high), (x, 0, low), b], 0.015)
        case "ear":
            path = arc([a, (x * 0.95, 0, high + 0.012), (x + 0.008, 0, high * 0.75), b], 20)
        case _:
            path = arc([a, (x, 0, (high + low) / 2), b], 16)
            return [tube(path, thick, section=ellipse(2.2, 0.7, 12, 3))]
    return [tube(path, thick, 12)]


def bottle(draw: Draw) -> list[Part]:
    """Bottles, flasks, jugs and jars: hollow, with necks, caps, handles, labels and a drink inside."""
    r, h = draw.between(0.03, 0.06), draw.between(0.16, 0.34)
    neck = r * draw.between(0.25, 0.6)
    shoulder, base = draw.between(0.45, 0.78), draw.between(0.75, 1.05)
    u = np.concatenate([np.linspace(0, shoulder, 10), np.linspace(shoulder, min(shoulder + 0.22, 0.93), 8)[1:], [0.97, 1]])
    drop = np.clip((u - shoulder) / (min(shoulder + 0.22, 0.93) - shoulder), 0, 1)
    curve = draw.pick(drop, drop**2 * (3 - 2 * drop), np.sqrt(drop))
    body = r * (base + (1 - base) * np.minimum(u / 0.15, 1) + draw.between(-0.18, 0.12) * np.sin(np.pi * u / shoulder) ** 2 * (
        u < shoulder))
    outer = (1 - curve) * body + curve * neck
    if draw.chance(0.4):
        outer = outer + 0.04 * r * np.sin(draw.count(20, 60) * u) * (u < shoulder)
    outline = np.column_stack([outer, u * h])
    inner = np.column_stack([np.maximum(outer - 0.0025, 0.003), np.maximum(u * h, 0.004)])
    n = draw.pick(6, 28, 28, 36)
    if draw.chance(0.3):  # open at the top and without thickness
        parts = [revolve(np.concatenate([[[0, 0]], outline]), n)]
    else:
        parts = [revolve(np.concatenate([[[0, 0]], outline, inner[::-1], [[0, 0.004]]]), n)]
    if draw.chance(0.5):
        level = draw.between(0.2, 0.9) * shoulder
        q = float(np.interp(level, u, outer)) * 0.93
        parts.append(revolve([(0, 0.006), (q * 0.95, 0.006), (q, level * h), (0, level * h)], n))
    match draw.pick("cap", "cork", "none", "spray"):
        case "cap":
            parts.append(frustum(neck * 1.15, neck * 1.1, 0.022, 24).move(z=h - 0.016))
        case "cork":
            parts.append(frustum(neck * 0.8, neck * 0.95, 0.035, 16).move(z=h - 0.02))
        case "spray":
            parts += [frustum(neck * 1.1, neck * 0.9, 0.03).move(z=h - 0.01), box(0.018, 0.06, 0.02).move(y=-0.01, z=h + 0.02),
                      frustum(0.004, 0.003, 0.015, 8).turn("x", 90).move(y=-0.04, z=h + 0.032),
                      tube([(0, -0.02, h + 0.02), (0, -0.035, h + 0.005), (0, -0.033, h - 0.02)], 0.004, 8),
                      bar((0, 0, 0.01), (0, 0, h), 0.0025, n=6)]
    if draw.chance(0.3):
        z0, z1 = h * shoulder * 0.4, h * min(shoulder + 0.15, 0.9)
        a, b = float(np.interp(z0 / h, u, outer)), float(np.interp(z1 / h, u, outer))
        out = max(a, b) + 0.03
        parts.append(tube(arc([(b * 0.95, 0, z1), (out, 0, z1), (out, 0, z0 * 1.2), (a * 0.97, 0, z0)], 18), 0.006, 10))
    if draw.chance(0.4):
        z = np.linspace(0.2, 0.8, 6)[:, None] * shoulder
        t = np.linspace(-2, 2, 24)[None]
        q = np.interp(z, u, outer) * 1.012 + 0.0004
        parts.append(sheet(np.stack(np.broadcast_arrays(q * np.sin(t), -q * np.cos(t), z * h), axis=-1)))
    return parts


def lamp(draw: Draw) -> list[Part]:
    """Table, floor, desk, arc and tripod lamps; a bulb inside a shade that is open or a globe."""
    match draw.pick("table", "table", "floor", "desk", "arc", "tripod"):
        case "table":
            h, r = draw.between(0.3, 0.55), draw.between(0.09, 0.14)
            column = draw.pick(turned(draw, draw.between(0.02, 0.06), h), ellipsoid(0.1, 0.1, h / 2).move(z=h / 2))
            parts = [*_foot(draw, r), column.move(z=0.01)]
            return [*parts, *_shade(draw, draw.between(0.13, 0.24), h)]
        case "floor":
            h = draw.between(1.2, 1.6)
            return [*_foot(draw, draw.between(0.13, 0.18)), bar((0, 0, 0), (0, 0, h), 0.012),
                    *_shade(draw, draw.between(0.18, 0.28), h)]
        case "arc":
            h, reach = draw.between(1.5, 1.9), draw.between(0.7, 1.1)
            path = arc([(0, 0, 0.02), (0, 0, h * 0.6), (reach * 0.35, 0, h), (reach, 0, h * 0.92)], 30)
            return [*_foot(draw, 0.19), tube(path, 0.011), bar((reach, 0, h * 0.92), (reach, 0, h * 0.8), 0.004),
                    *(p.move(x=reach) for p in _shade(draw, 0.18, h * 0.62))]
        case "tripod":
            h, r = draw.between(0.5, 1.3), draw.between(0.16, 0.28)
            legs = around(bar((1.3 * r, 0, 0), (0.02, 0, h), 0.011, 0.014), 3, draw.between(0, 120))
            return [*legs, frustum(0.03, 0.03, 0.05).move(z=h - 0.02), *_shade(draw, r, h)]
    a, b = draw.between(0.25, 0.4), draw.between(0.2, 0.35)
    lean, fold = np.radians(draw.between(10, 35)), np.radians(draw.between(20, 60))
    elbow = np.array([0, a * np.sin(lean), 0.02 + a * np.cos(lean)])
    head = elbow + b * np.array([0, -np.sin(fold + lean), np.cos(fold + lean)])
    gap = draw.pick(0.0, 0.018)
    parts = [*_foot(draw, draw.between(0.08, 0.12))]
    for x in {gap, -gap}:
        parts += [bar((x, 0, 0.02), (x, *elbow[1:]), 0.006), bar((x, *elbow[1:]), (x, *head[1:]), 0.006)]
    parts += [ellipsoid(0.022, 0.014, 0.014, 12).move(*elbow), ellipsoid(0.02, 0.015, 0.015, 12).move(*head)]
    r, deep = draw.between(0.05, 0.09), draw.between(0.08, 0.15)
    cone = [(0.018, 0), (0.022, 0.03), (r * 0.7, deep * 0.55), (r, deep)]
    lampshade = [revolve(cone, 24), ellipsoid(0.02, 0.02, 0.03, 12).move(z=deep * 0.6), frustum(0.018, 0.016, 0.01)]
    tilt = draw.between(115, 165)
    return [*parts, *(p.turn("x", tilt).move(*head) for p in lampshade)]


def _foot(draw: Draw, r: float) -> list[Part]:
    match draw.pick("disc", "dome", "block", "star"):
        case "disc":
            return [frustum(r, r, 0.015, 32)]
        case "dome":
            return [revolve([(0, 0), (r, 0), (r, 0.01), (r * 0.6, 0.035), (0.02, 0.05), (0, 0.05)], 32)]
        case "block":
            return [bevel_box(1.7 * r, 1.7 * r, 0.03, 0.006)]
        case _:
            return around(tube([(0.005, 0, 0.04), (r * 0.6, 0, 0.03), (r * 1.1, 0, 0.008)], 0.009), draw.count(3, 5))


def _shade(draw: Draw, r: float, z: float) -> list[Part]:
    """Shade, bulb, socket; the bottom of the shade is about at z. All but the globe are open sheets."""
    tall = r * draw.between(0.9, 1.6)
    bulb = [ellipsoid(0.03, 0.03, 0.042, 14).move(z=z + tall * 0.5), frustum(0.014, 0.016, tall * 0.4).move(z=z)]
    match draw.pick("drum", "cone", "bell", "globe", "pleated", "box"):
        case "globe":
            shade = ellipsoid(r * 0.8, r * 0.8, r * 0.8, 24).move(z=z + r * 0.7)
        case "bell":
            u = np.linspace(0, 1, 9)
            shade = revolve(np.column_stack([r * (1 - 0.6 * u**0.5), z + u * tall]), 32)
        case "pleated":
            t = np.linspace(0, 2 * np.pi, 81)
            u = np.linspace(0, 1, 3)[:, None]
            q = r * (1 - 0.35 * u) * (1 + 0.025 * np.cos(np.pi * np.arange(81)))
            shade = sheet(np.stack(np.broadcast_arrays(q * np.cos(t), q * np.sin(t), z + u * tall), axis=-1))
        case "box":
            shade = revolve([(r * 1.2, z), (r * draw.between(0.7, 1.2), z + tall)], 4)
        case "cone":
            shade = revolve([(r, z), (r * draw.between(0.3, 0.6), z + tall)], 32)
        case _:
            shade = revolve([(r, z), (r, z + tall * 0.8)], 32)
    spider = [bar((0, 0, z + tall * 0.4), (s * r * 0.75, 0, z + tall * 0.42), 0.003, n=5) for s in (-1, 1)]
    return [shade, *bulb, *spider]


def plant(draw: Draw) -> list[Part]:
    """Pots with soil and something in them: broad leaves, grass, a small tree, a cactus."""
    r, h = draw.between(0.09, 0.2), draw.between(0.12, 0.35)
    flare = draw.between(0.65, 1.1)
    profile = [(0, 0), (r * flare, 0), (r, h), (r * 1.08, h), (r * 1.08, h * 0.86), (r * 0.9, h * 0.86)]
    n = draw.pick(4, 8, 28, 28)
    parts = [revolve(profile[: draw.pick(4, 6)], n), revolve([(0, h * 0.85), (r * 0.97, h * 0.85)], n)]
    z = h * 0.85
    match draw.pick("leaves", "grass", "tree", "cactus", "palm"):
        case "leaves":
            for i in range(draw.count(6, 16)):
                stem, size = draw.between(0.15, 0.5), draw.between(0.12, 0.25)
                lean = draw.between(0.15, 0.6)
                path = arc([(0, 0, z), (lean * stem * 0.4, 0, z + stem * 0.7), (lean * stem, 0, z + stem)], 8)
                leaf = _leaf(size, size * draw.between(0.3, 0.6), draw.between(0.2, 0.9)).turn("y", draw.between(-50, 10))
                turn = 137.5 * i + draw.between(-20, 20)
                parts += [p.turn("z", turn) for p in (tube(path, 0.004, 5), leaf.move(*path[-1]))]
        case "grass":
            for i in range(draw.count(18, 45)):
                blade = _leaf(draw.between(0.3, 0.8), 0.016, draw.between(0.3, 1.6)).turn("y", -draw.between(55, 88))
                parts.append(blade.move(x=draw.between(0, 0.6) * r, z=z).turn("z", 137.5 * i))
        case "palm":
            tall = draw.between(0.3, 0.9)
            trunk = arc([(0, 0, z - 0.02), (draw.between(-0.1, 0.1), 0, z + tall / 2), (0.02, 0.03, z + tall)], 14)
            parts.append(tube(trunk, np.linspace(0.03, 0.018, 14) * (1 + 0.12 * (np.arange(14) % 2))))
            for i in range(draw.count(7, 14)):
                frond = _leaf(draw.between(0.35, 0.6), 0.07, draw.between(1.0, 1.9)).turn("y", -draw.between(20, 60))
                parts.append(frond.turn("z", 137.5 * i).move(*trunk[-1]))
        case "cactus":
            for i in range(draw.count(1, 4)):
                tall, q = draw.between(0.15, 0.6), draw.between(0.03, 0.06)
                parts.append(_cactus(tall, q).move(x=draw.between(0, 0.5) * r * (i > 0), z=z).turn("z", 137.5 * i))
                if draw.chance(0.5):
                    arm = arc([(0, 0, tall * 0.5), (q + 0.06, 0, tall * 0.52), (q + 0.08, 0, tall * 0.9)], 10)
                    parts += [tube(arm, q * 0.55, 10).move(z=z), ellipsoid(q * 0.55, q * 0.55, q * 0.55, 12).move(*arm[-1]).move(z=z)]
        case _:
            parts += _tree(draw, np.array([0, 0, z]), np.array([0, 0, 1.0]), draw.between(0.25, 0.4), 0.02, 3)
    return parts


def _leaf(length: float, width: float, droop: float) -> Part:
    """A pointed sheet along +x from the origin, folded at the midrib, bending down towards the tip."""
    u = np.linspace(0, 1, 9)[:, None]
    v = np.linspace(-1, 1, 5)[None]
    half = width * np.sin(np.pi * (0.04 + 0.95 * u) ** 0.8) + 1e-4
    angle = droop * u
    x, z = length * u * np.sinc(angle / np.pi), -length * u * np.sin(angle / 2) * np.sinc(angle / 2 / np.pi)
    return sheet(np.stack(np.broadcast_arrays(x, v * half, z + 0.3 * half * np.abs(v)), axis=-1))


def _cactus(h: float, r: float) -> Part:
    t = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    ribs = 1 + 0.12 * np.cos(10 * t)
    u = np.linspace(0, 1, 12)
    q = r * np.sqrt(np.clip(1 - (np.maximum(u - 0.75, 0) / 0.26) ** 2, 0.01, 1)) * (0.8 + 0.2 * np.minimum(u / 0.3, 1))
    return solid(np.stack([np.column_stack([a * ribs * np.cos(t), a * ribs * np.sin(t), 0 * t + h * b])
                           for a, b in zip(q, u, strict=True)]))


def _tree(draw: Draw, at: F64, along: F64, length: float, r: float, depth: int) -> list[Part]:
    """A branch, the branches on it, and leaves at the last ones."""
    tip = at + length * along
    parts = [bar(at.tolist(), tip.tolist(), r, r * 0.7, 7)]
    if depth == 0:
        for i in range(3):
            leaf = _leaf(draw.between(0.05, 0.09), 0.022, 0.6).turn("y", draw.between(-60, 30)).turn("z", 120 * i)
            parts.append(leaf.move(*tip))
        return parts
    for i in range(draw.count(2, 3)):
        swing = np.radians(137.5 * i + draw.between(0, 90))
        out = np.array([np.cos(swing), np.sin(swing), 0.0])
        aim = along + draw.between(0.4, 0.9) * out
        parts += _tree(draw, tip - 0.02 * along, aim / np.linalg.norm(aim), length * draw.between(0.55, 0.8), r * 0.65,
                       depth - 1)
    return parts


def guitar(draw: Draw) -> list[Part]:
    """Acoustic and electric guitars standing upright, strings and pegs and all; hollow ones have a sound hole."""
    electric = draw.chance(0.4)
    t = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    lower, waist = draw.between(0.17, 0.21), draw.between(0.6, 0.8)
    upper = lower * draw.between(0.7, 0.85)
    long = draw.between(0.44, 0.52)
    z = -np.cos(t) * long / 2
    u = z / long + 0.5
    width = lower * (1 - u) ** 0.35 * 1.06 + (upper - lower * 0.25) * u
    width = width * (1 - (1 - waist) * np.exp(-(((u - 0.62) / 0.13) ** 2)))
    x = np.sign(np.sin(t)) * width * np.abs(np.sin(t)) ** 0.55
    if electric and draw.chance(0.7):  # horns beside the neck
        horn = np.exp(-(((u - 0.93) / 0.07) ** 2)) * (np.abs(x) > 0.05)
        z = z + draw.between(0.05, 0.11) * horn * np.where(x < 0, 1.0, draw.between(0.4, 1.0))
        x = x * (1 + 0.35 * horn)
    elif draw.chance(0.3):  # a cutaway
        x = np.where((x > 0.03) & (u > 0.78), 0.03 + (x - 0.03) * np.clip((1 - u) / 0.22, 0, 1) ** 0.6, x)
    thick = draw.between(0.035, 0.05) if electric else draw.between(0.085, 0.12)
    parts = [slab(np.column_stack([x, z]), thick, 0.004 if electric else 0).turn("x", 90).move(y=thick / 2, z=long / 2)]
    front = -thick / 2
    scale_end = long * 0.22
    neck_top = long + draw.between(0.28, 0.36)
    neck = tube([(0, front + 0.004, long * 0.75), (0, front + 0.004, neck_top)], [0.028, 0.022], section=ellipse(1, 0.5, 10, 3))
    board = solid(np.array([[(s * w, front - d, z) for s, d in ((-1, 0.004), (-1, 0.012), (1, 0.012), (1, 0.004))]
                            for w, z in ((0.028, long * 0.72), (0.022, neck_top))]))
    head = bevel_box(0.075, 0.014, 0.17, 0.004).turn("x", draw.between(3, 14)).move(y=front + 0.002, z=neck_top - 0.004)
    bridge_y = front - 0.01
    parts += [neck, board, head, bevel_box(0.14 if not electric else 0.08, 0.014, 0.03, 0.003).move(y=front - 0.004, z=scale_end)]
    n = draw.pick(4, 6, 6, 6, 12)
    for i, s in enumerate(np.linspace(-1, 1, n)):
        parts.append(bar((0.026 * s, bridge_y, scale_end + 0.015), (0.017 * s, front - 0.015, neck_top), 0.0008, n=4))
        side = 1 if i % 2 else -1
        peg_z = neck_top + 0.03 + 0.13 * (i // 2) / max(n // 2, 1)
        parts += [bar((side * 0.025, front, peg_z), (side * 0.06, front + 0.004, peg_z), 0.004, n=6),
                  ellipsoid(0.012, 0.005, 0.009, 8).move(x=side * 0.065, y=front + 0.004, z=peg_z)]
    frets = np.linspace(0, 1, 14) ** 0.8
    parts += [box(0.05 - 0.008 * f, 0.003, 0.002).move(y=front - 0.0125, z=long * 0.74 + f * (neck_top - long * 0.76)) for f in frets]
    if electric:
        parts += [bevel_box(0.08, 0.012, 0.035, 0.003).move(y=front - 0.002, z=long * p) for p in (0.35, 0.5, 0.62)[: draw.count(2, 3)]]
        parts += [frustum(0.012, 0.01, 0.018, 14).turn("x", 90).move(x=0.09 + 0.03 * (i % 2), y=front, z=long * (0.2 + 0.08 * i))
                  for i in range(draw.count(2, 4))]
        parts += mirrored([frustum(0.006, 0.006, 0.015, 10).turn("x", 90).move(x=0.0, y=front, z=0.01)])
    else:  # a rosette round a disc, and the braces in the hollow body
        hole = long * 0.56
        ring = np.column_stack([0.052 * np.cos(t[::2]), 0 * t[::2] + front - 0.001, hole + 0.052 * np.sin(t[::2])])
        parts += [tube(ring, 0.003, 6, loop=True), frustum(0.05, 0.05, 0.03, 28).turn("x", -90).move(y=front - 0.0005, z=hole),
                  box(0.25, 0.012, 0.012).move(z=long * 0.3), box(0.2, 0.012, 0.012).move(z=long * 0.8)]
    return parts
