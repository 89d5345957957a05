"""Shelves and what stands on them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from ocnf_data.shapes.draw import Draw
from ocnf_data.shapes.primitives import (
    Part,
    bar,
    bevel_box,
    board,
    box,
    mirrored,
    revolve,
)


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
                parts += [
                    bar((-w / 2, d / 2, 0.1), (w / 2, d / 2, h), r * 0.6),
                    bar((w / 2, d / 2, 0.1), (-w / 2, d / 2, h), r * 0.6),
                ]
        case _:
            for i, (low, high) in enumerate(pairwise(levels)):
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
        door = bevel_box(w / 2 - 0.006, 0.018, top - levels[0], 0.004).move(
            x=w / 4, y=-d / 2 - 0.01, z=levels[0]
        )
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
    parts: list[Part] = []
    x, end = -w / 2, draw.between(-0.1, 0.5) * w - 0.06
    while x < end and len(parts) < 40:
        thick, tall, deep = (
            draw.between(0.015, 0.06),
            h * draw.between(0.55, 0.95),
            d * draw.between(0.5, 0.85),
        )
        parts.append(box(thick, deep, tall).move(x=x + thick / 2, y=back - deep / 2 - 0.01, z=z))
        x += thick + 0.001
    tall = h * 0.8
    if x + 0.07 + 0.31 * tall < w / 2:
        lean = box(0.03, d * 0.6, tall).turn("y", -18)
        parts.append(lean.move(x=x + 0.04 + tall * 0.31, y=back - d * 0.3 - 0.01, z=z))
    return parts
