"""Beds."""

from __future__ import annotations

import numpy as np

from ocnf_data.shapes.draw import Draw
from ocnf_data.shapes.primitives import (
    Part,
    bar,
    bevel_box,
    board,
    box,
    cushion,
    mirrored,
    rounded,
    sheet,
    tube,
)
from ocnf_data.shapes.supports import four_legs, turned


def bed(draw: Draw) -> list[Part]:
    """Single to double beds, head to the back: panels, slats, arches, canopies, bunks, under a blanket."""
    style = draw.pick("plain", "plain", "plain", "canopy", "bunk")
    w = draw.between(0.85, 1.1) if style == "bunk" else draw.pick(0.9, 1.2, 1.4, 1.6, 1.8)
    d = draw.between(1.95, 2.1)
    low, thick = draw.between(0.14, 0.38), draw.between(0.14, 0.28)
    parts = _berth(draw, w, d, low, thick)
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
    parts += [
        bar((lx - 0.18, -y - 0.03, z), (lx + 0.18, -y - 0.03, z), 0.014) for z in np.arange(0.25, tall, 0.27)
    ]
    return parts


def _berth(draw: Draw, w: float, d: float, low: float, thick: float) -> list[Part]:
    """Frame, slats (hidden below the mattress), mattress, pillows and perhaps a blanket."""
    side = bevel_box(0.03, d, 0.16, 0.006).move(x=w / 2, z=low - 0.06)
    parts = [*mirrored([side]), *(box(w, 0.03, 0.14).move(y=s * d / 2, z=low - 0.05) for s in (-1, 1))]
    parts += [
        box(w - 0.03, 0.07, 0.015).move(y=v, z=low - 0.01) for v in np.linspace(-0.45 * d, 0.45 * d, 11)
    ]
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
            parts = [
                bevel_box(w + 0.06, 0.04, tall, 0.01),
                bevel_box(w * 0.86, 0.02, tall * 0.5, 0.01).move(y=-0.025, z=tall * 0.4),
            ]
        case "arch":
            parts = [board(w + 0.05, tall * 0.8, 0.04, 24, 0, tall * 0.25)]
        case "slats":
            slats = [
                bar((p, 0, low), (p, 0, tall - 0.02), 0.011) for p in np.linspace(-x, x, draw.count(7, 16))
            ]
            parts = [
                *slats,
                *mirrored([box(0.05, 0.05, tall + 0.03).move(x=x)]),
                box(w, 0.035, 0.05).move(z=tall - 0.05),
                box(w, 0.035, 0.05).move(z=low),
            ]
        case "padded":
            n = draw.count(1, 4)
            parts = [
                box(w, 0.04, tall),
                *(
                    cushion(w / n - 0.01, 0.12, tall - low, 6).move(
                        x=(i - (n - 1) / 2) * w / n, y=-0.03, z=low
                    )
                    for i in range(n)
                ),
            ]
        case _:
            ring = rounded([(-x, 0, 0), (-x, 0, tall), (x, 0, tall), (x, 0, 0)], 0.2)
            parts = [
                tube(ring, 0.02),
                *(bar((-x, 0, z), (x, 0, z), 0.01) for z in np.linspace(low, tall - 0.12, draw.count(2, 4))),
            ]
    return [p.move(y=y) for p in parts]
