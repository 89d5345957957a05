"""Balls, blocks and boulders: closed solids that fill their box, most of which no camera ever sees."""

from __future__ import annotations

import numpy as np

from ocnf_data.shapes.draw import Draw
from ocnf_data.shapes.primitives import (
    Part,
    bevel_box,
    box,
    cushion,
    ellipse,
    ellipsoid,
    frustum,
    loft,
    rectangle,
    slab,
    taper_box,
    tube,
)


def ball(draw: Draw) -> list[Part]:
    """Balls, eggs, pillows and lenses, cut off below or not, with seams, knobs and stands."""
    rx, rz = draw.between(0.1, 0.4), draw.between(0.6, 1.3)
    ry, rz = rx * draw.between(0.8, 1.0), rx * (1.0 if draw.chance(0.5) else rz)
    n = draw.pick(12, 20, 28, 36, 44, 52)
    power = 2.0 if draw.chance(0.7) else draw.between(2.2, 4)
    body = cushion(2 * rx, 2 * ry, 2 * rz, power, n)
    if draw.chance(0.2):  # it lies flat
        floor = rz * draw.between(0.15, 0.9)
        body = body.bend(lambda x, y, z: (x, y, np.maximum(z, floor)))
    parts = [body]
    if draw.chance(0.3):
        t = 2 * np.pi * np.arange(40) / 40
        seam = np.column_stack([rx * np.cos(t), ry * np.sin(t), np.full(40, rz)])
        parts.append(tube(seam, rx * draw.between(0.02, 0.06), 6, loop=True))
    if draw.chance(0.2):
        parts.append(frustum(0.3 * rx, 0.2 * rx, 0.15 * rz, draw.pick(6, 12, 18)).move(z=1.95 * rz))
    if draw.chance(0.2):
        foot = 0.25 * rz
        parts = [*(part.move(z=0.6 * foot) for part in parts), frustum(0.7 * rx, 0.5 * rx, foot, 20)]
    return parts


def block(draw: Draw) -> list[Part]:
    """Crates, bricks, dice, drums, prisms, wedges and steps: straight sides, solid throughout."""
    w = draw.between(0.2, 0.6)
    d, h = w * draw.between(0.5, 1.0), w * draw.between(0.5, 1.3)
    match draw.pick("box", "bevel", "taper", "drum", "prism", "steps"):
        case "box":
            parts = [box(w, d, h)]
        case "bevel":
            parts = [bevel_box(w, d, h, w * draw.between(0.02, 0.15))]
        case "taper":
            parts = [taper_box(w, d, h, draw.between(0.3, 0.95))]
        case "drum":
            parts = [frustum(w / 2, w / 2 * draw.between(0.6, 1.0), h, draw.pick(16, 24, 32, 40))]
        case "prism":
            parts = [slab(ellipse(w / 2, d / 2, draw.pick(3, 5, 6, 8)), h, w * draw.pick(0, 0.02, 0.05))]
        case _:
            n = draw.count(2, 4)
            parts = [box(w, d * (n - i) / n, h / n).move(y=d * i / n / 2, z=h * i / n) for i in range(n)]
    if draw.chance(0.3):  # battens round the outside
        thick = 0.04 * w
        parts += [slab(rectangle(w + thick, d + thick), thick).move(z=h * f) for f in (0.1, 0.5, 0.85)]
    if draw.chance(0.25):
        parts.append(
            box(w * 0.4, d * 0.4, h * draw.between(0.1, 0.5)).move(w * draw.between(-0.2, 0.2), 0, h)
        )
    if draw.chance(0.3):  # one of them by itself, on an edge or leaning
        parts = [parts[0].turn(draw.pick("x", "y"), draw.between(10, 45))]
    return parts


def boulder(draw: Draw) -> list[Part]:
    """Rocks, loaves, dumplings and heaps of them: round, bumpy, solid."""
    size = draw.between(0.1, 0.5)
    parts = [_rock(draw, size)]
    for _ in range(draw.pick(0, 0, 1, 2, 4)):
        angle, far = draw.between(0, 6.3), size * draw.between(0.4, 0.9)
        other = _rock(draw, size * draw.between(0.3, 0.8))
        parts.append(other.move(far * np.cos(angle), far * np.sin(angle), size * draw.between(-0.5, 0.5)))
    if draw.chance(0.3):
        parts.append(ellipsoid(size * 0.9, size * 0.7, size * 0.5, draw.pick(12, 20)).move(z=size * 0.4))
    low = min(float(part.vertices[:, 2].min()) for part in parts)
    return [part.move(z=-low) for part in parts]


def _rock(draw: Draw, size: float) -> Part:
    """A ball of that radius with waves on it, a little flattened, about the origin."""
    n, m = draw.pick(14, 20, 26), draw.pick(16, 24, 32)
    u = np.pi * (np.arange(1, n) / n)[:, None]
    t = (2 * np.pi * np.arange(m) / m)[None]
    axis = np.stack(np.broadcast_arrays(np.sin(u) * np.cos(t), np.sin(u) * np.sin(t), -np.cos(u)), -1)
    radius = np.ones(axis.shape[:2])
    for _ in range(draw.count(2, 7)):
        wave = np.array([draw.between(-1, 1) for _ in range(3)]) * draw.between(1.5, 6)
        radius = radius + draw.between(0.02, 0.12) * np.sin(axis @ wave + draw.between(0, 6.3))
    rings = axis * radius[..., None] * [size, size * draw.between(0.7, 1), size * draw.between(0.6, 1)]
    low, high = rings[0].mean(axis=0), rings[-1].mean(axis=0)
    return loft(rings, low, high)
