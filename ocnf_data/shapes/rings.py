"""Rings, pipes, wheels and knots: shapes with holes through them."""

from __future__ import annotations

from math import gcd

import numpy as np

from ocnf_data.arrays import F64
from ocnf_data.shapes.draw import Draw
from ocnf_data.shapes.primitives import (
    Part,
    around,
    bar,
    box,
    cushion,
    ellipse,
    ellipsoid,
    frustum,
    loft,
    rounded,
    stack,
    tube,
)


def ring(draw: Draw) -> list[Part]:
    """Tori thick and thin, hoops, washers, tyres, finger rings with stones, chains of a few links."""
    r = draw.between(0.05, 0.4)
    n, m = draw.pick(36, 48, 64), draw.count(8, 20)
    match draw.pick("torus", "torus", "hoop", "washer", "tyre", "stone", "chain"):
        case "hoop":
            parts = [_band(r, r * draw.between(0.015, 0.06), r * draw.between(0.1, 0.8), n)]
        case "washer":
            parts = [_band(r, r * draw.between(0.2, 0.6), r * draw.between(0.04, 0.3), n)]
        case "tyre":
            thick = draw.between(0.2, 0.45) * r
            section = ellipse(1, draw.between(0.6, 1.2), 16, draw.between(2.5, 5))
            parts = [tube(_circle(r - thick, n), thick, loop=True, section=section)]
            if draw.chance(0.7):
                lug = box(0.3 * thick, 0.5 * thick, 1.6 * thick).move(x=r - 0.1 * thick, z=-0.8 * thick)
                parts += around(lug, draw.count(12, 30))
        case "stone":
            thick = draw.between(0.06, 0.14) * r
            parts = [tube(_circle(r, n), thick, m, loop=True)]
            size = draw.between(0.2, 0.4) * r
            parts += [
                ellipsoid(size, size, 0.8 * size, draw.pick(6, 8, 20)).turn("y", 90).move(x=r + 0.6 * size),
                frustum(thick, 0.7 * size, 0.6 * size, 10).turn("y", 90).move(x=r),
            ]
        case "chain":
            thick, parts = draw.between(0.1, 0.2) * r, []
            oval = _circle(r, n) * (1, draw.between(0.6, 0.8), 1)
            for i in range(draw.count(2, 6)):
                link = tube(oval, thick, m, loop=True)
                parts.append(
                    link.turn("x", 90 * (i % 2) + draw.between(-15, 15)).move(x=i * (2 * r - 2.4 * thick))
                )
        case _:
            thick = draw.between(0.05, 0.48) * r
            radii = thick * (
                1 + draw.between(0, 0.3) * np.cos(draw.count(0, 8) * 2 * np.pi * np.arange(n) / n)
            )
            parts = [tube(_circle(r, n), radii, m, loop=True)]
    lean = draw.pick(0, 0, 90, 60)
    return [p.turn("x", lean) for p in parts]


def pipe(draw: Draw) -> list[Part]:
    """Open pipes: straight, bent, T and cross pieces, funnels, coils; with flanges, bolts and valves."""
    r = draw.between(0.02, 0.08)
    wall, n = draw.between(0.06, 0.3) * r, draw.pick(20, 24, 32)
    long = r * draw.between(3, 9)
    match draw.pick("straight", "elbow", "elbow", "tee", "funnel", "coil"):
        case "straight":
            parts = [_pipe(np.array([(0, 0, 0), (0, 0, long)]), r, wall, n)]
            ends = [((0.0, 0.0, 0.0), "z", 0.0), ((0.0, 0.0, long), "z", 0.0)]
        case "elbow":
            bend = draw.between(0.4, 0.9) * long
            corners = [(0.0, 0.0, 0.0), (0.0, 0.0, long), (long * draw.between(0.5, 1), 0.0, long)]
            if draw.chance(0.4):
                corners.append((corners[-1][0], long * draw.between(0.5, 1), long))
            parts = [_pipe(rounded(corners, min(bend, 0.4 * long), 9), r, wall, n)]
            ends = [((0.0, 0.0, 0.0), "z", 0.0)]
        case "tee":
            parts = [_pipe(np.array([(-long / 2, 0, 0), (long / 2, 0, 0)]), r, wall, n)]
            parts += [_pipe(np.array([(0, 0, 0.9 * r), (0, 0, long / 2)]), 0.9 * r, wall, n)]
            if draw.chance(0.4):
                parts.append(parts[1].scale(z=-1))
            ends = [((-long / 2, 0.0, 0.0), "y", 90.0), ((long / 2, 0.0, 0.0), "y", 90.0)]
        case "funnel":
            wide, neck = r * draw.between(2, 4), draw.between(0.3, 0.6) * long
            path = np.array([(0, 0, 0), (0, 0, neck), (0, 0, neck + 0.5 * wide), (0, 0, neck + 0.6 * wide)])
            parts = [_pipe(path, np.array([r, 1.1 * r, wide, wide]), wall, n)]
            ends = []
        case _:
            turns = draw.between(2, 5)
            t = np.linspace(0, 2 * np.pi * turns, int(24 * turns))
            path = np.column_stack(
                [4 * r * np.cos(t), 4 * r * np.sin(t), draw.between(2.2, 4) * r * t / 6.283]
            )
            parts, ends = [tube(path, 0.8 * r, 10)], []
    if draw.chance(0.6):
        flange = _band(1.7 * r, 0.72 * r, 0.3 * r, 28)
        bolts = around(frustum(0.12 * r, 0.12 * r, 0.5 * r, 6).move(x=1.4 * r, z=-0.1 * r), draw.count(4, 8))
        for place, axis, angle in ends:
            parts += [p.move(z=-0.15 * r).turn(axis, angle).move(*place) for p in (flange, *bolts)]
    if ends and draw.chance(0.2):
        wheel = [
            tube(_circle(1.2 * r, 24), 0.12 * r, 8, loop=True),
            *around(bar((0, 0, 0), (1.2 * r, 0, 0), 0.08 * r, n=6), 4),
        ]
        parts += [
            bar((0, 0, 0), (0, -2.5 * r, 0), 0.2 * r).move(z=0.3 * long),
            *(p.turn("x", 90).move(y=-2.5 * r, z=0.3 * long) for p in wheel),
        ]
    return parts


def wheel(draw: Draw) -> list[Part]:
    """Wheels and gears: rims with spokes, with wires or solid discs, hubs, teeth."""
    r, thick = draw.between(0.15, 0.4), draw.between(0.04, 0.2)
    rim, wide = thick * r, draw.between(0.05, 0.35) * r
    parts = [_band(r, rim, wide, 48).move(z=-wide / 2)]
    hub = draw.between(0.1, 0.22) * r
    parts.append(frustum(hub, hub, 1.4 * wide, draw.pick(12, 20)).move(z=-0.7 * wide))
    n = draw.count(4, 12)
    match draw.pick("bars", "wires", "blades", "disc"):
        case "bars":
            parts += around(bar((0.8 * hub, 0, 0), (r - 0.5 * rim, 0, 0), draw.between(0.02, 0.05) * r), n)
        case "wires":
            for side in (-1, 1):
                wire = bar((hub, 0, side * 0.6 * wide), (r - 0.5 * rim, 0, 0), 0.008 * r, n=5)
                parts += around(wire, 3 * n, 60 / n if side > 0 else 0)
        case "blades":
            blade = box(r - rim - 0.7 * hub, draw.between(0.1, 0.25) * r, 0.4 * wide)
            parts += around(blade.move(x=(r - rim + 0.8 * hub) / 2, z=-0.2 * wide), min(n, 7))
        case _:
            parts.append(frustum(r - 0.5 * rim, r - 0.5 * rim, 0.3 * wide, 40).move(z=-0.15 * wide))
    if draw.chance(0.4):
        tooth = box(0.16 * r, draw.between(0.06, 0.14) * r, wide).move(x=1.04 * r, z=-wide / 2)
        parts += around(tooth, draw.count(10, 26))
    if draw.chance(0.5):
        parts = [p.turn("x", 90) for p in parts]
        if draw.chance(0.5):
            parts += [p.move(y=draw.between(2, 6) * wide) for p in parts]
            parts.append(bar((0, 0, 0), (0, float(parts[-1].vertices[:, 1].mean()), 0), 0.5 * hub))
    return parts


def knot(draw: Draw) -> list[Part]:
    """Torus knots and links of a bar that is round, flat or swelling."""
    p, q = draw.pick((2, 3), (3, 2), (2, 5), (3, 4), (1, 4), (1, 6), (2, 1), (3, 5), (2, 2), (3, 3))
    r, inner = 0.2, draw.between(0.06, 0.12)
    closed, n = gcd(p, q), draw.pick(120, 150, 180)
    t = 2 * np.pi * np.arange(n) / n
    parts = []
    for k in range(closed):
        a, b = p // closed * t, q // closed * t + 2 * np.pi * k / closed
        path = np.column_stack(
            [
                (r + inner * np.cos(b)) * np.cos(a),
                (r + inner * np.cos(b)) * np.sin(a),
                draw.pick(1, 1.6) * inner * np.sin(b),
            ]
        )
        radius = draw.between(0.012, 0.035) * (1 + draw.between(0, 0.4) * np.cos(draw.count(0, 6) * t))
        flat = ellipse(1, draw.between(0.4, 1), draw.pick(8, 10, 14), draw.pick(2, 4))
        parts.append(tube(path, radius, loop=True, section=flat))
    if draw.chance(0.4):
        parts.append(cushion(0.7 * r, 0.7 * r, 0.05, draw.pick(2, 6)).move(z=-2.2 * inner))
        parts.append(bar((0, 0, -2 * inner), (r, 0, 0), 0.015))
    return parts


def _circle(r: float, n: int) -> F64:
    """(n, 3) points in the plane z = 0."""
    return np.column_stack([ellipse(r, r, n), np.zeros(n)])


def _band(r: float, thick: float, tall: float, n: int) -> Part:
    """A ring with a rectangular section, from r - thick to r, standing on z = 0; watertight."""
    inner, outer = ellipse(r - thick, r - thick, n), ellipse(r, r, n)
    return loft(stack([outer, outer, inner, inner], [0, tall, tall, 0]), loop=True)


def _pipe(path: F64, r: float | F64, wall: float, n: int) -> Part:
    """An open pipe along a polyline (k, 3), with a wall; watertight."""
    outside, inside = tube(path, r, n), tube(path, np.asarray(r) - wall, n)
    k = len(path)
    rings = np.concatenate(
        [outside.vertices[: k * n].reshape(k, n, 3), inside.vertices[: k * n].reshape(k, n, 3)[::-1]]
    )
    return loft(rings, loop=True)
