"""Lamps."""

from __future__ import annotations

import numpy as np

from ocnf_data.shapes.draw import Draw
from ocnf_data.shapes.primitives import (
    Part,
    arc,
    around,
    bar,
    bevel_box,
    ellipsoid,
    frustum,
    revolve,
    sheet,
    tube,
)
from ocnf_data.shapes.supports import turned


def lamp(draw: Draw) -> list[Part]:
    """Table, floor, desk, arc and tripod lamps; a bulb inside a shade that is open or a globe."""
    match draw.pick("table", "table", "floor", "desk", "arc", "tripod"):
        case "table":
            h, r = draw.between(0.3, 0.55), draw.between(0.09, 0.14)
            column = draw.pick(
                turned(draw, draw.between(0.02, 0.06), h), ellipsoid(0.1, 0.1, h / 2).move(z=h / 2)
            )
            parts = [*_foot(draw, r), column.move(z=0.01)]
            return [*parts, *_shade(draw, draw.between(0.13, 0.24), h)]
        case "floor":
            h = draw.between(1.2, 1.6)
            return [
                *_foot(draw, draw.between(0.13, 0.18)),
                bar((0, 0, 0), (0, 0, h), 0.012),
                *_shade(draw, draw.between(0.18, 0.28), h),
            ]
        case "arc":
            h, reach = draw.between(1.5, 1.9), draw.between(0.7, 1.1)
            path = arc([(0, 0, 0.02), (0, 0, h * 0.6), (reach * 0.35, 0, h), (reach, 0, h * 0.92)], 30)
            return [
                *_foot(draw, 0.19),
                tube(path, 0.011),
                bar((reach, 0, h * 0.92), (reach, 0, h * 0.8), 0.004),
                *(p.move(x=reach) for p in _shade(draw, 0.18, h * 0.62)),
            ]
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
    lampshade = [
        revolve(cone, 24),
        ellipsoid(0.02, 0.02, 0.03, 12).move(z=deep * 0.6),
        frustum(0.018, 0.016, 0.01),
    ]
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
            return around(
                tube([(0.005, 0, 0.04), (r * 0.6, 0, 0.03), (r * 1.1, 0, 0.008)], 0.009), draw.count(3, 5)
            )


def _shade(draw: Draw, r: float, z: float) -> list[Part]:
    """Shade, bulb, socket; the bottom of the shade is about at z. All but the globe are open sheets."""
    tall = r * draw.between(0.9, 1.6)
    bulb = [
        ellipsoid(0.03, 0.03, 0.042, 14).move(z=z + tall * 0.5),
        frustum(0.014, 0.016, tall * 0.4).move(z=z),
    ]
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
