"""Open vessels of kitchen and yard: pots, buckets, boxes, baskets, bath tubs."""

from __future__ import annotations

import numpy as np

from ocnf_data.shapes.draw import Draw
from ocnf_data.shapes.hollow import bail, box_section, contents, hollow, round_section, side_handle, vessel
from ocnf_data.shapes.primitives import (
    Part,
    around,
    bar,
    bevel_box,
    box,
    ellipse,
    frustum,
    mirrored,
    revolve,
    rounded,
    tube,
)


def pot(draw: Draw) -> list[Part]:
    """Cooking pots, pans and plant pots; one long handle or two short ones, lids on, off or ajar."""
    r = draw.between(0.08, 0.17)
    h = r * draw.between(0.3, 1.8)
    u = np.linspace(0, 1, draw.count(6, 12))
    radii = r * (
        draw.between(0.65, 1.0) + draw.between(0, 0.3) * u + draw.between(-0.05, 0.2) * np.sin(np.pi * u)
    )
    if draw.chance(0.3):  # a rim, as plant pots have it
        radii = radii * np.where(u > 0.8, 1.12, 1.0)
    wall, n = draw.between(0.003, 0.01), draw.pick(24, 32, 40)
    section = round_section(draw, 0.1)
    parts = vessel(draw, radii, h * u, wall, section)
    rim, q = float(radii[-1]), draw.between(0.006, 0.011)
    match draw.pick("two", "long", "none", "bail"):
        case "two":
            z = draw.between(0.6, 0.9) * h
            ear = tube(
                rounded(
                    [
                        (0.9 * rim, -0.04, z),
                        (rim + 0.04, -0.04, z),
                        (rim + 0.04, 0.04, z),
                        (0.9 * rim, 0.04, z),
                    ],
                    0.02,
                ),
                q,
            )
            parts += [ear, ear.turn("z", 180)]
        case "long":
            z = 0.85 * h
            parts.append(
                bar((0.9 * rim, 0, z), (rim + draw.between(0.1, 0.2), 0, z + 0.03), 0.8 * q, 1.4 * q)
            )
        case "bail":
            parts.append(bail(draw, 0.98 * rim, 0.9 * h, draw.between(0.7, 1.1) * r, 0.5 * q))
    if draw.chance(0.3):
        lid = [
            (0, 0),
            (1.03 * rim, 0),
            (1.03 * rim, 0.004),
            (0.6 * rim, 0.12 * rim),
            (0.1 * rim, 0.16 * rim),
            (0.14 * rim, 0.3 * rim),
            (0, 0.32 * rim),
        ]
        shift = draw.pick(0.0, draw.between(0.2, 0.9) * rim)
        parts.append(revolve(lid, n).move(x=shift, z=h + 0.5 * wall))
    elif draw.chance(0.6):
        parts += contents(draw, 0.8 * float(radii.min()) - wall, 1.5 * wall, h)
    return parts


def bucket(draw: Draw) -> list[Part]:
    """Buckets, pails, bins and tubs: wider at the top, with a bail, rims and hoops."""
    r, h = draw.between(0.1, 0.17), draw.between(0.18, 0.42)
    u = np.linspace(0, 1, draw.count(5, 10))
    foot = draw.between(0.6, 0.95)
    radii, wall = r * (foot + (1 - foot) * u), draw.between(0.003, 0.009)
    section = round_section(draw, 0.1) if draw.chance(0.8) else box_section(draw, draw.between(0.6, 1))
    parts = vessel(draw, radii, h * u, wall, section)
    if draw.chance(0.6):
        parts.append(bail(draw, 0.99 * r, 0.95 * h, draw.between(0.7, 1.2) * r, draw.between(0.003, 0.006)))
        parts += [
            frustum(0.015, 0.015, 0.012, 12).turn("y", 90 * s).move(x=s * 0.96 * r, z=0.93 * h)
            for s in (-1, 1)
        ]
    outline = np.column_stack([section, np.zeros(len(section))])
    for level in [0.98, *(draw.between(0.1, 0.9) for _ in range(draw.count(0, 3)))]:
        hoop = outline * float(np.interp(level, u, radii)) + np.array([0, 0, level * h])
        parts.append(tube(hoop, draw.between(0.003, 0.006), 6, loop=True))
    return parts + contents(draw, 0.7 * r * foot, 1.5 * wall, h)


def open_box(draw: Draw) -> list[Part]:
    """Open boxes: crates of boards, cartons with flaps, trays with compartments, drawers, chests."""
    w, d, h = draw.between(0.2, 0.6), draw.between(0.15, 0.5), draw.between(0.06, 0.4)
    t = draw.between(0.003, 0.02)
    # No two boards have corners in common: each stays closed when equal vertices are welded.
    sides = [box(w, t, h).move(y=s * (d - t) / 2) for s in (-1, 1)]
    sides += [box(t, d - t, h - 0.002).move(x=s * (w - t) / 2 * 0.998) for s in (-1, 1)]
    parts = [*sides, box(w - t, d - t, t).move(z=0.001)]
    match draw.pick("plain", "carton", "crate", "tray", "chest"):
        case "carton":
            flap = draw.between(0.3, 0.5)
            for s in (-1, 1):
                lid = box(w, flap * d, t).move(y=flap * d / 2).turn("x", draw.between(-150, 80))
                parts.append((lid if s > 0 else lid.turn("z", 180)).move(y=s * d / 2, z=h))
                lid = box(flap * w, d, t).move(x=flap * w / 2).turn("y", draw.between(-80, 150))
                parts.append((lid if s > 0 else lid.turn("z", 180)).move(x=s * w / 2, z=h))
        case "crate":
            n, parts = draw.count(2, 5), []
            gap = h / n
            for z in gap * np.arange(n):
                parts += [box(w, t, 0.7 * gap).move(y=s * (d - t) / 2, z=z) for s in (-1, 1)]
                parts += [box(t, d, 0.7 * gap).move(x=s * (w - t) / 2, z=z) for s in (-1, 1)]
            slats = draw.count(3, 7)
            parts += [
                box(0.8 * w / slats, d, t).move(x=x) for x in (np.arange(slats) + 0.5) * w / slats - w / 2
            ]
            parts += [
                box(2 * t, 2 * t, h).move(i * (w / 2 - 2 * t), j * (d / 2 - 2 * t))
                for i in (-1, 1)
                for j in (-1, 1)
            ]
        case "tray":
            parts += [
                box(t, d, 0.9 * h).move(x=x) for x in np.linspace(-w / 2, w / 2, draw.count(3, 6))[1:-1]
            ]
            if draw.chance(0.5):
                parts += [
                    box(w, t, 0.9 * h).move(y=y) for y in np.linspace(-d / 2, d / 2, draw.count(3, 4))[1:-1]
                ]
        case "chest":
            lid = bevel_box(w, d, 0.25 * h, t).move(y=-d / 2).turn("x", -draw.between(30, 120))
            parts.append(lid.move(y=d / 2, z=h))
    if draw.chance(0.3):
        grip = tube(
            rounded(
                [
                    (w / 2 - t / 2, -0.06, 0.6 * h),
                    (w / 2 + 0.03, -0.06, 0.7 * h),
                    (w / 2 + 0.03, 0.06, 0.7 * h),
                    (w / 2 - t / 2, 0.06, 0.6 * h),
                ],
                0.02,
            ),
            0.006,
        )
        parts += mirrored([grip])
    return parts + contents(draw, 0.4 * min(w, d), t, h)


def basket(draw: Draw) -> list[Part]:
    """Baskets of wires, of woven bands or solid walls, round or square, with or without handles."""
    r, h = draw.between(0.12, 0.25), draw.between(0.1, 0.35)
    foot, ratio = draw.between(0.6, 1.0), draw.between(0.6, 1.0)
    section = draw.pick(ellipse(1, ratio, 40), ellipse(1, ratio, 40, 6))
    ring = np.column_stack([section, np.zeros(len(section))])

    def width(z: float) -> float:
        return r * (foot + (1 - foot) * z / h)

    thin = draw.between(0.002, 0.005)
    parts = [
        tube(ring * width(h) + np.array([0, 0, h]), 2 * thin, 8, loop=True),
        tube(ring * width(0.0), 1.5 * thin, 8, loop=True),
    ]
    posts = section[:: draw.pick(1, 2, 4)]
    match draw.pick("wire", "bands", "solid"):
        case "wire":
            for z in np.linspace(0, h, draw.count(3, 7))[1:-1]:
                parts.append(tube(ring * width(z) + np.array([0, 0, z]), thin, 6, loop=True))
            parts += [
                bar((x * width(0), y * width(0), 0), (x * width(h), y * width(h), h), thin, n=6)
                for x, y in posts
            ]
            lines = [(x, y) for x, y in posts if y > 0]
            parts += [
                bar((x * width(0), y * width(0), 0), (x * width(0), -y * width(0), 0), thin, n=6)
                for x, y in lines
            ]
        case "bands":
            n = draw.count(4, 9)
            for i, z in enumerate(h * (np.arange(n) + 0.5) / n):
                wave = 1 + (0.02 if i % 2 else -0.02) * np.cos(np.pi * np.arange(len(section)))
                band = ring * wave[:, None] * width(z) + np.array([0, 0, z])
                parts.append(tube(band, 0.45 * h / n, loop=True, section=ellipse(0.25, 0.9, 8, 4)))
            parts += [
                bar((x * width(0), y * width(0), 0), (x * width(h), y * width(h), h), thin, n=6)
                for x, y in posts
            ]
            parts.append(
                hollow(np.array([width(0), width(0) * 1.001]), np.array([0, 0.02 * h]), 0.01 * h, section)
            )
        case _:
            u = np.linspace(0, 1, 6)
            parts += vessel(draw, r * (foot + (1 - foot) * u), h * u, 2 * thin, section)
    match draw.pick("bail", "ears", "none"):
        case "bail":
            parts.append(bail(draw, width(h), h, draw.between(0.8, 1.3) * r, 2 * thin))
        case "ears":
            ear = side_handle(draw, width(h), 0.7 * h, h, 0.25 * r, 1.5 * thin)
            parts += [ear, ear.turn("z", 180)]
    return parts + contents(draw, 0.5 * r * foot * ratio, 2 * thin, h)


def bathtub(draw: Draw) -> list[Part]:
    """Bath tubs, sinks and troughs: long open basins with rims, feet, taps or a stand."""
    w, ratio, h = draw.between(0.3, 0.9), draw.between(0.4, 0.75), draw.between(0.25, 0.6)
    u = np.linspace(0, 1, draw.count(7, 12))
    foot = draw.between(0.6, 0.9)
    radii = w * (foot + (1 - foot) * np.sin(np.pi / 2 * u))
    wall = draw.between(0.02, 0.06)
    section = ellipse(1, ratio, draw.pick(36, 40, 48), draw.between(2, 8))
    deep = h * draw.between(0.03, 0.3)
    parts = [hollow(radii, h * u, wall, section, floor=deep)]
    if draw.chance(0.5):
        ring = np.column_stack([section * radii[-1], np.full(len(section), h)])
        parts.append(tube(ring, 0.6 * wall, 8, loop=True))
    if draw.chance(0.6):
        x, y = 0.6 * w * foot, 0.6 * w * foot * ratio
        low = draw.between(0.05, 0.6)
        leg = frustum(0.02, 0.04, low + deep, 12).move(x, y, -low)
        parts += mirrored([leg, leg.scale(y=-1)])
    if draw.chance(0.5):
        x = draw.pick(1, -1) * 0.9 * w
        tap = rounded([(x, 0, h), (x, 0, h + 0.2), (0.7 * x, 0, h + 0.2), (0.7 * x, 0, h + 0.12)], 0.05)
        parts += [tube(tap, 0.015), around(bar((0, 0, 0), (0.05, 0, 0), 0.01), 4)[0].move(x, 0.06, h + 0.08)]
    return parts + contents(draw, 0.5 * w * foot * ratio, deep, h)
