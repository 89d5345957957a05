"""Guitars."""

from __future__ import annotations

import numpy as np

from ocnf_data.shapes.draw import Draw
from ocnf_data.shapes.primitives import (
    Part,
    bar,
    bevel_box,
    box,
    ellipse,
    ellipsoid,
    frustum,
    mirrored,
    slab,
    solid,
    tube,
)


def guitar(draw: Draw) -> list[Part]:
    """Acoustic and electric guitars standing upright, with strings and pegs, braces inside hollow ones."""
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
    parts = [
        slab(np.column_stack([x, z]), thick, 0.004 if electric else 0)
        .turn("x", 90)
        .move(y=thick / 2, z=long / 2)
    ]
    front = -thick / 2
    scale_end = long * 0.22
    neck_top = long + draw.between(0.28, 0.36)
    neck = tube(
        [(0, front + 0.004, long * 0.75), (0, front + 0.004, neck_top)],
        [0.028, 0.022],
        section=ellipse(1, 0.5, 10, 3),
    )
    board = solid(
        np.array(
            [
                [(s * w, front - d, z) for s, d in ((-1, 0.004), (-1, 0.012), (1, 0.012), (1, 0.004))]
                for w, z in ((0.028, long * 0.72), (0.022, neck_top))
            ]
        )
    )
    head = (
        bevel_box(0.075, 0.014, 0.17, 0.004)
        .turn("x", draw.between(3, 14))
        .move(y=front + 0.002, z=neck_top - 0.004)
    )
    bridge_y = front - 0.01
    parts += [
        neck,
        board,
        head,
        bevel_box(0.14 if not electric else 0.08, 0.014, 0.03, 0.003).move(y=front - 0.004, z=scale_end),
    ]
    n = draw.pick(4, 6, 6, 6, 12)
    for i, s in enumerate(np.linspace(-1, 1, n)):
        parts.append(
            bar((0.026 * s, bridge_y, scale_end + 0.015), (0.017 * s, front - 0.015, neck_top), 0.0008, n=4)
        )
        side = 1 if i % 2 else -1
        peg_z = neck_top + 0.03 + 0.13 * (i // 2) / max(n // 2, 1)
        parts += [
            bar((side * 0.025, front, peg_z), (side * 0.06, front + 0.004, peg_z), 0.004, n=6),
            ellipsoid(0.012, 0.005, 0.009, 8).move(x=side * 0.065, y=front + 0.004, z=peg_z),
        ]
    frets = np.linspace(0, 1, 14) ** 0.8
    parts += [
        box(0.05 - 0.008 * f, 0.003, 0.002).move(
            y=front - 0.0125, z=long * 0.74 + f * (neck_top - long * 0.76)
        )
        for f in frets
    ]
    if electric:
        parts += [
            bevel_box(0.08, 0.012, 0.035, 0.003).move(y=front - 0.002, z=long * p)
            for p in (0.35, 0.5, 0.62)[: draw.count(2, 3)]
        ]
        parts += [
            frustum(0.012, 0.01, 0.018, 14)
            .turn("x", 90)
            .move(x=0.09 + 0.03 * (i % 2), y=front, z=long * (0.2 + 0.08 * i))
            for i in range(draw.count(2, 4))
        ]
        parts += mirrored([frustum(0.006, 0.006, 0.015, 10).turn("x", 90).move(x=0.0, y=front, z=0.01)])
    else:  # a rosette round a disc, and the braces in the hollow body
        hole = long * 0.56
        ring = np.column_stack(
            [0.052 * np.cos(t[::2]), 0 * t[::2] + front - 0.001, hole + 0.052 * np.sin(t[::2])]
        )
        parts += [
            tube(ring, 0.003, 6, loop=True),
            frustum(0.05, 0.05, 0.03, 28).turn("x", -90).move(y=front - 0.0005, z=hole),
            box(0.25, 0.012, 0.012).move(z=long * 0.3),
            box(0.2, 0.012, 0.012).move(z=long * 0.8),
        ]
    return parts
