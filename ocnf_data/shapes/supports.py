"""What other things stand on: legs in all styles, star bases, turned columns."""

from __future__ import annotations

import numpy as np

from ocnf_data.shapes.draw import Draw
from ocnf_data.shapes.primitives import (
    F64,
    Part,
    around,
    bar,
    box,
    ellipse,
    ellipsoid,
    frustum,
    revolve,
    tube,
)


def turned(draw: Draw, r: float, h: float) -> Part:
    """A column of height h turned on a lathe: beads, necks and swellings around radius r."""
    n = draw.count(3, 6)
    z = np.linspace(0, h, 8 * n + 1)
    u = z / h
    radius = r * (0.75 + 0.3 * np.sin(np.pi * u * draw.count(1, 3) + draw.between(0, 3)) ** 2)
    for _ in range(n):
        at, width = draw.between(0.05, 0.95), draw.between(0.01, 0.04)
        radius = radius + r * draw.between(-0.25, 0.5) * np.exp(-(((u - at) / width) ** 2))
    profile: F64 = np.column_stack([radius, z])
    return revolve(np.concatenate([[[0, 0]], profile, [[0, h]]]), 18)


def four_legs(draw: Draw, w: float, d: float, h: float, r: float) -> list[Part]:
    """Four legs (seldom three, or six under something wide) up to height h, some with stretchers."""
    style = draw.pick("square", "round", "tapered", "splayed", "turned", "hairpin", "blade")
    x, y = w / 2 - 1.6 * r, d / 2 - 1.6 * r
    places = [(s * x, t * y) for s in (-1, 1) for t in (-1, 1)]
    if w > 1.5 and draw.chance(0.3):
        places += [(0, -y), (0, y)]
    elif w < 0.7 and draw.chance(0.08):
        places = [(-x, -y), (x, -y), (0, y)]
    splay = draw.between(0.04, 0.12) if style in ("splayed", "hairpin") else 0.0
    feet = [(px * (1 + splay / max(x, 0.1)), py * (1 + splay / max(y, 0.1))) for px, py in places]
    column = turned(draw, r, h)
    legs: list[Part] = []
    for (px, py), (fx, fy) in zip(places, feet, strict=True):
        match style:
            case "square":
                legs.append(box(2 * r, 2 * r, h).move(px, py))
            case "blade":
                legs.append(box(0.012, 4 * r, h).move(px, py))
            case "turned":
                legs.append(column.move(px, py))
            case "hairpin":
                top = (px - np.copysign(3 * r, px), py, h)
                legs += [tube([(px, py, h), (fx, fy, 0.01), top], 0.006, 8)]
            case "tapered":
                legs.append(tube([(px, py, 0), (px, py, h)], [r * 0.6, r * 1.3], section=ellipse(1, 1, 8, 7)))
            case _:
                legs.append(bar((fx, fy, 0), (px, py, h), r * 0.75, r * 1.1))
    if style != "hairpin" and draw.chance(0.4) and len(places) == 4:
        z = h * draw.between(0.2, 0.5)
        t = z / h
        low = [
            ((1 - t) * fx + t * px, (1 - t) * fy + t * py, z)
            for (px, py), (fx, fy) in zip(places, feet, strict=True)
        ]
        pairs = draw.pick([(0, 1), (2, 3)], [(0, 1), (2, 3), (0, 2), (1, 3)], [(0, 3), (1, 2)])
        legs += [bar(low[i], low[j], 0.5 * r) for i, j in pairs]
        if len(pairs) == 2 and draw.chance(0.7):
            (i, j), (k, m) = pairs
            middle = np.add([low[i], low[k]], [low[j], low[m]]) / 2
            if np.linalg.norm(middle[0] - middle[1]) > 0.05:
                legs.append(tube(middle, 0.5 * r))
    return legs


def star_base(draw: Draw, h: float) -> list[Part]:
    """Gas column on a star of four to six spokes, with castors or without."""
    n, reach, start = draw.count(4, 6), draw.between(0.24, 0.33), draw.between(0, 90)
    wheel = draw.pick(0.0, draw.between(0.022, 0.032))
    z = 2 * wheel + 0.03
    spoke = tube([(0.02, 0, z + 0.035), (reach, 0, z)], [0.028, 0.016], section=ellipse(1, 1, 8, 5))
    parts = around(spoke, n, start)
    if wheel:
        castor = frustum(wheel, wheel, 0.02, 14).turn("x", 90).move(x=reach - 0.01, z=wheel)
        twin = [
            castor.move(y=0.026),
            castor.move(y=-0.006),
            frustum(0.008, 0.008, 0.03).move(x=reach - 0.01, z=wheel),
        ]
        for p in twin:
            parts += around(p, n, start)
    else:
        parts += around(ellipsoid(0.02, 0.02, 0.02, 10).move(x=reach, z=0.02), n, start)
    column = [
        (0, z),
        (0.035, z),
        (0.035, h * 0.55),
        (0.022, h * 0.55),
        (0.022, h - 0.03),
        (0.11, h),
        (0, h + 0.01),
    ]
    return [*parts, revolve(column, 18)]
