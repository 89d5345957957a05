"""Open vessels from a profile: the walls, and the handles, spouts and contents that go with them."""

from __future__ import annotations

import numpy as np

from ocnf_data.arrays import F64
from ocnf_data.shapes.draw import Draw
from ocnf_data.shapes.primitives import (
    Part,
    arc,
    bevel_box,
    cushion,
    ellipse,
    ellipsoid,
    loft,
    revolve,
    rounded,
    stack,
    tube,
)


def hollow(radii: F64, heights: F64, wall: float, section: F64, floor: float | None = None) -> Part:
    """A vessel that is open at the top, with a lip as thick as the wall; watertight.

    Args:
        radii: (k,) of the outside from the bottom to the rim.
        heights: (k,) ascending.
        wall: thickness, also of the floor.
        section: (m, 2) outline of radius 1, counter-clockwise.
        floor: height of the inner floor; `heights[0] + wall` where None.
    """
    bottom = heights[0] + wall if floor is None else floor
    inner_z = np.maximum(heights, bottom)[::-1]
    inner_r = np.maximum(np.interp(inner_z, heights, radii) - wall, 0.15 * radii.min())
    rim = (radii[-1] + inner_r[0]) / 2
    r = np.concatenate([radii, [rim], inner_r])
    z = np.concatenate([heights, [heights[-1] + 0.4 * wall], inner_z])
    # Rings that fell together at the floor would give faces without area.
    keep = np.concatenate([[True], (np.abs(np.diff(r)) + np.abs(np.diff(z))) > 1e-9])
    rings = stack([section * q for q in r[keep]], z[keep].tolist())
    return loft(rings, np.array([0, 0, heights[0]]), np.array([0, 0, bottom]))


def shell(radii: F64, heights: F64, section: F64) -> Part:
    """A vessel like `hollow`'s without thickness: an open sheet, as many downloaded vessels are."""
    rings = stack([section * q for q in radii], heights.tolist())
    return loft(rings, np.array([0, 0, heights[0]]))


def vessel(draw: Draw, radii: F64, heights: F64, wall: float, section: F64) -> list[Part]:
    """`hollow`, or in one of six `shell`."""
    if draw.chance(0.16):
        return [shell(radii, heights, section)]
    return [hollow(radii, heights, wall, section)]


def round_section(draw: Draw, fluted: float = 0.2) -> F64:
    """An outline of radius about 1: a circle, a polygon, rarely an oval or one with flutes."""
    n = draw.pick(24, 28, 32, 36, 40)
    if draw.chance(fluted):
        waves, deep = draw.count(5, 16), draw.between(0.02, 0.09)
        m = 4 * waves
        t = 2 * np.pi * (np.arange(m) + 0.5) / m
        return ellipse(1, 1, m) * (1 + deep * np.cos(waves * t))[:, None]
    match draw.pick("circle", "circle", "circle", "polygon", "oval"):
        case "polygon":
            return ellipse(1, 1, draw.count(5, 10))
        case "oval":
            return ellipse(1, draw.between(0.6, 0.9), n, draw.between(2, 2.6))
        case _:
            return ellipse(1, 1, n)


def box_section(draw: Draw, ratio: float) -> F64:
    """A rounded rectangle of half sides 1 and `ratio`."""
    return ellipse(1, ratio, draw.pick(32, 40, 48), draw.between(4, 14))


def side_handle(draw: Draw, inner: float, low: float, high: float, reach: float, thick: float) -> Part:
    """A handle beside a wall: begins and ends `inner` from the axis, at heights low and high."""
    a, b, x = (inner, 0.0, high), (inner, 0.0, low), inner + reach
    middle = (low + high) / 2
    match draw.pick("C", "D", "ear", "strap"):
        case "C":
            path = arc([a, (x, 0, high), (x + 0.15 * reach, 0, middle), (x, 0, low), b], 20)
        case "D":
            path = rounded([a, (x, 0, high), (x, 0, low), b], 0.3 * reach)
        case "ear":
            path = arc([a, (x, 0, high + 0.1 * reach), (x, 0, middle), b], 18)
        case _:
            path = arc([a, (x, 0, middle + 0.2 * (high - low)), b], 16)
            return tube(path, thick, section=ellipse(2, 0.7, 12, 3))
    return tube(path, thick, draw.pick(8, 10, 12))


def bail(draw: Draw, radius: float, rim: float, rise: float, thick: float) -> Part:
    """A handle over the opening, from side to side, upright or fallen over."""
    t = np.linspace(0, np.pi, 24)
    path = np.column_stack([radius * np.cos(t), 0 * t, rise * np.sin(t)])
    lean = draw.pick(0.0, draw.between(-75, 75))
    return tube(path, thick, draw.pick(6, 8, 10)).turn("x", lean).move(z=rim)


def contents(draw: Draw, radius: float, floor: float, top: float) -> list[Part]:
    """Things within: a level of liquid, or some lumps that lie on the floor; in most vessels nothing."""
    match draw.pick("nothing", "nothing", "nothing", "liquid", "lumps"):
        case "liquid":
            z = floor + draw.between(0.15, 0.8) * (top - floor)
            return [revolve([(0, z - 0.02 * radius), (radius, z - 0.02 * radius), (radius, z), (0, z)], 24)]
        case "lumps":
            size = draw.between(0.18, 0.35) * radius
            parts = []
            for _ in range(draw.count(2, 5)):
                angle, out = draw.between(0, 2 * np.pi), draw.between(0, max(radius - size, 0))
                lump = draw.pick(
                    ellipsoid(size, size * draw.between(0.6, 1), size * 0.8, 14),
                    bevel_box(size, size, size, size / 6).move(z=-size / 2),
                    cushion(size, 1.5 * size, size, 3, 12).move(z=-size / 2),
                )
                x, y = out * np.cos(angle), out * np.sin(angle)
                parts.append(lump.turn("z", np.degrees(angle)).move(x, y, floor + 0.8 * size))
            return parts
        case _:
            return []
