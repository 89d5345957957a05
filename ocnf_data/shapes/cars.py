"""Cars."""

from __future__ import annotations

import numpy as np

from ocnf_data.shapes.draw import Draw
from ocnf_data.shapes.primitives import (
    F64,
    Part,
    around,
    bar,
    box,
    cushion,
    ellipse,
    ellipsoid,
    frustum,
    loft,
    mirrored,
    revolve,
    sheet,
    solid,
    tube,
)


def car(draw: Draw) -> list[Part]:
    """Saloons, hatchbacks, coupes, estates, vans and pickups, nose at negative y, seats inside."""
    kind = draw.pick("saloon", "hatchback", "coupe", "estate", "van", "pickup")
    length = {"saloon": 4.6, "hatchback": 4.0, "coupe": 4.3, "estate": 4.7, "van": 4.9, "pickup": 5.2}[kind]
    length *= draw.between(0.93, 1.07)
    w, wheel = draw.between(1.68, 1.9), draw.between(0.28, 0.335)
    belt, clear = draw.between(0.86, 0.98) + 0.1 * (kind in ("van", "pickup")), draw.between(0.14, 0.22)
    roof = (
        belt
        + {"saloon": 0.48, "hatchback": 0.52, "coupe": 0.40, "estate": 0.52, "van": 0.95, "pickup": 0.58}[
            kind
        ]
    )
    # Along the car: share of the length, height of the body's upper edge as a share of the belt line.
    hood = draw.between(0.84, 0.93) if kind != "van" else 0.97
    tail = {"saloon": 0.93, "coupe": 0.95, "pickup": 0.98}.get(kind, 1.0)
    u = np.array([0.0, 0.015, 0.06, 0.15, 0.27, 0.4, 0.6, 0.75, 0.86, 0.95, 0.985, 1.0])
    top = belt * np.interp(
        u,
        [0, 0.015, 0.06, 0.25, 0.35, 0.75, 0.9, 0.985, 1],
        [0.55, hood * 0.85, hood * 0.92, hood * 0.98, 1, 1, tail, tail * 0.95, 0.6],
    )
    half = w / 2 * np.interp(u, [0, 0.05, 0.15, 0.85, 0.97, 1], [0.82, 0.94, 1, 1, 0.94, 0.86])
    rings: list[F64] = []
    for v, z, x in zip(u, top, half, strict=True):
        outline = ellipse(x, (z - clear) / 2, 24, 5)
        rings.append(
            np.column_stack([outline[:, 0], np.full(24, (v - 0.5) * length), outline[:, 1] + (z + clear) / 2])
        )
    parts = [solid(np.stack(rings)[:, ::-1]), *_cabin(draw, kind, length, w, belt, roof)]
    axle = length * draw.between(0.29, 0.33)
    parts += _wheels(draw, w, wheel, [-axle, axle * draw.between(0.9, 1.0)])
    seat = [
        cushion(0.5, 0.5, 0.16, 6).move(z=0.35),
        cushion(0.48, 0.14, 0.6, 6).turn("x", -12).move(y=0.25, z=0.42),
    ]
    rows = (-0.02, 0.18) if kind not in ("coupe", "pickup") else (0.0,)
    parts += mirrored([p.move(x=0.37, y=y * length, z=0.1) for y in rows for p in seat])
    parts += mirrored(
        [
            ellipsoid(0.11, 0.06, 0.07, 10).move(x=w / 2 + 0.06, y=-0.17 * length, z=belt + 0.05),
            bar((w / 2 - 0.06, -0.17 * length, belt), (w / 2 + 0.05, -0.17 * length, belt + 0.04), 0.02),
            cushion(0.36, 0.1, 0.14, 4).move(x=w * 0.36, y=-0.488 * length, z=belt * 0.62),
        ]
    )
    parts += [box(w * 0.9, 0.12, 0.14).move(y=s * 0.495 * length, z=clear + 0.1) for s in (-1, 1)]
    if kind == "coupe" and draw.chance(0.5):
        y, z = 0.46 * length, belt * 0.93 + draw.between(0.1, 0.25)
        grid = np.stack(np.meshgrid(np.linspace(-0.42 * w, 0.42 * w, 9), np.linspace(0, 0.25, 3)), axis=-1)
        blade = sheet(np.concatenate([grid, 0.3 * grid[..., 1:]], axis=-1)).move(y=y - 0.15, z=z)
        parts += [
            blade,
            *mirrored([bar((0.3 * w, y - 0.05, belt * 0.8), (0.3 * w, y - 0.05, z + 0.03), 0.02)]),
        ]
    if kind in ("estate", "van") and draw.chance(0.6):
        rail = bar((0.36 * w, -0.05 * length, roof + 0.05), (0.36 * w, 0.35 * length, roof + 0.05), 0.02)
        feet = [
            bar((0.36 * w, y * length, roof - 0.08), (0.36 * w, y * length, roof + 0.05), 0.015)
            for y in (0.0, 0.3)
        ]
        parts += mirrored([rail, *feet])
    return parts


def _cabin(draw: Draw, kind: str, length: float, w: float, belt: float, roof: float) -> list[Part]:
    """The glasshouse, outlines of shrinking size from the belt line to the roof.

    An open shell, or a roof on pillars with or without a windscreen, or no more than the windscreen.
    """
    rake, back = draw.between(0.11, 0.16), {"saloon": 0.12, "coupe": 0.2, "hatchback": 0.09}.get(kind, 0.03)
    front, rear = {
        "van": (-0.42, 0.49),
        "estate": (-0.2, 0.48),
        "hatchback": (-0.2, 0.47),
        "pickup": (-0.2, 0.14),
        "coupe": (-0.14, 0.4),
    }.get(kind, (-0.2, 0.36))
    rings = []
    for t, width in ((-0.25, 0.98), (0.0, 0.95), (0.5, 0.86), (0.85, 0.78), (1.0, 0.66)):
        y0 = (front + rake * max(t, 0)) * length
        y1 = (rear - back * max(t, 0)) * length
        if t == 1.0:
            y0, y1 = y0 + 0.08, y1 - 0.08
        outline = ellipse(width * w / 2, (y1 - y0) / 2, 28, 7)
        rings.append(
            np.column_stack(
                [outline[:, 0], outline[:, 1] + (y0 + y1) / 2, np.full(28, belt + t * (roof - belt))]
            )
        )
    outlines, top = np.stack(rings), rings[-1].mean(axis=0)
    style = draw.pick("closed", "closed", "pillars", "open" if kind == "coupe" else "pillars")
    if style == "closed":
        return [loft(outlines, end=top)]
    corners = [3, 10, 17, 24]  # of the rounded rectangle, counter-clockwise from the right rear
    screen = sheet(outlines[1:, 17:25])
    if style == "open":
        return [screen, tube(np.concatenate([outlines[1:, 17], outlines[:0:-1, 24]]), 0.025)]
    middle = [0, 13] if kind != "coupe" else []
    pillars = [tube(outlines[:4, j], 0.03, 6) for j in corners + middle]
    return [
        loft(outlines[3:], end=top),
        *pillars,
        *([screen] if draw.chance(0.5) else []),
        tube(outlines[3], 0.025, 6, loop=True),
    ]


def _wheels(draw: Draw, w: float, r: float, axles: list[float]) -> list[Part]:
    t = draw.between(0.17, 0.24)
    profile = [
        (0.62 * r, 0),
        (0.9 * r, 0),
        (r, 0.15 * t),
        (r, 0.85 * t),
        (0.9 * r, t),
        (0.62 * r, t),
        (0.6 * r, 0.8 * t),
    ]
    n = draw.count(4, 9)
    spoke = box(0.5 * r, 0.1 * r * draw.between(0.8, 2), 0.05).move(x=0.38 * r, z=0.75 * t)
    wheel = [
        revolve(profile, 26),
        frustum(0.18 * r, 0.15 * r, 0.1, 12).move(z=0.6 * t),
        *around(spoke, n),
        frustum(0.6 * r, 0.6 * r, 0.02, 26).move(z=0.2 * t),
    ]
    wheel = [p.turn("y", 90).move(x=w / 2 - 0.88 * t, z=r) for p in wheel]
    a = np.linspace(-0.15, np.pi + 0.15, 14)
    arch = np.column_stack([0 * a + w / 2 - 0.01, 1.1 * r * np.cos(a), r + 1.1 * r * np.sin(a)])
    wheel.append(tube(arch, 0.03, section=ellipse(1.0, 1.0, 6)))
    shaft = [frustum(0.05, 0.05, w - 0.3, 8).turn("y", 90).move(x=0.15 - w / 2, y=y, z=r) for y in axles]
    return [*mirrored([p.move(y=y) for y in axles for p in wheel]), *shaft]
