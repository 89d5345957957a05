"""Monitors."""

from __future__ import annotations

import numpy as np

from ocnf_data.shapes.draw import Draw
from ocnf_data.shapes.primitives import (
    Part,
    bar,
    bevel_box,
    board,
    box,
    ellipse,
    frustum,
    mirrored,
    rectangle,
    sheet,
    slab,
    solid,
    stack,
    tube,
)


def monitor(draw: Draw) -> list[Part]:
    """Flat and curved screens, alone or in pairs, and old ones with a tube behind them."""
    w = draw.between(0.4, 0.9)
    h = w * draw.pick(0.42, 0.5625, 0.625, 0.75)
    lift = draw.between(0.08, 0.22)
    if draw.chance(0.2):
        return _tube_monitor(draw, 0.42)
    bow = draw.between(0.02, 0.09) * w / 0.9 if draw.chance(0.3) else 0.0
    shell, behind = _flat_screen(draw, w, h)
    screen = [*(p.bend(lambda x, y, z: (x, y - bow * (2 * x / w) ** 2, z)) for p in shell), *behind]
    tilt = draw.between(-10, 3)
    screen = [p.turn("x", tilt).move(z=lift) for p in screen]
    neck_x, plate = 0.0, draw.between(0.12, 0.2)
    if draw.chance(0.12):
        side = draw.between(8, 25)
        screen = [q for s in (-1, 1) for q in (p.move(x=s * w * 0.51).turn("z", -s * side) for p in screen)]
        plate = w * 0.5
    y = 0.06
    stem = draw.pick(
        box(0.06, 0.02, lift + h * 0.4),
        frustum(0.03, 0.02, lift + h * 0.4),
        bevel_box(0.11, 0.015, lift + h * 0.4, 0.004),
    )
    parts = [*screen, stem.move(x=neck_x, y=y), box(0.08, 0.05, 0.08).move(y=y, z=lift + h * 0.35)]
    match draw.pick("oval", "plate", "fork", "ring"):
        case "oval":
            parts.append(slab(ellipse(plate, 0.1, 32), 0.015, 0.005).move(y=0.02))
        case "plate":
            parts.append(bevel_box(2 * plate, 0.2, 0.012, 0.003).move(y=0.02))
        case "fork":
            parts += mirrored(
                [
                    bar((0, y, 0.012), (plate, -0.12, 0.008), 0.011),
                    bar((0, y, 0.012), (plate * 0.7, 0.13, 0.008), 0.011),
                ]
            )
        case _:
            a = np.linspace(0, 2 * np.pi, 32, endpoint=False)
            ring = np.column_stack([plate * np.cos(a), 0.11 * np.sin(a) - 0.05, 0 * a + 0.01])
            parts.append(tube(ring, 0.01, loop=True))
    return parts


def _flat_screen(draw: Draw, w: float, h: float) -> tuple[list[Part], list[Part]]:
    """The picture recessed in a bezel and the back, which may be curved; the bulge and the boards inside."""
    edge, deep = draw.between(0.006, 0.03), draw.between(0.015, 0.035)
    chin = edge * draw.pick(1.0, 1.0, 2.5)
    n = 12
    x = np.linspace(-w / 2, w / 2, n + 1)
    strip = solid(
        np.stack(
            [np.column_stack([np.full(4, u), rectangle(deep, 1)[:, 0], rectangle(deep, 1)[:, 1]]) for u in x]
        )
    )
    bezel = [
        strip.scale(z=chin).move(z=chin / 2),
        strip.scale(z=edge).move(z=h - edge / 2),
        *mirrored([box(edge, deep, h).move(x=w / 2 - edge / 2)]),
    ]
    picture = board(w - edge, h - edge, 0, n).move(y=-deep / 2 + 0.004, z=edge / 2)
    back = board(w, h, 0, n).move(y=deep / 2)
    bulge = solid(stack([rectangle(w * 0.7, h * 0.6), rectangle(w * 0.45, h * 0.35)], [0, 0.035]))
    bulge = bulge.turn("x", -90).move(y=deep / 2 - 0.002, z=h / 2)
    inside = [
        box(w * 0.4, 0.003, h * 0.4).move(z=h * 0.3),
        *(box(0.03, 0.008, 0.03).move(x=p * w, y=0.004, z=h * 0.4) for p in (-0.12, 0.0, 0.13)),
    ]
    return [*bezel, picture, back], [bulge, *inside]


def _tube_monitor(draw: Draw, w: float) -> list[Part]:
    h, deep, lift = w * draw.between(0.78, 0.95), draw.between(0.3, 0.45), draw.between(0.04, 0.1)
    outlines = [
        rectangle(w, h, 0.02),
        rectangle(w, h, 0.02),
        rectangle(w * 0.97, h * 0.95, 0.04),
        rectangle(w * 0.55, h * 0.5, 0.04),
        rectangle(w * 0.5, h * 0.45, 0.04),
    ]
    body = solid(stack(outlines, [0, 0.06, 0.1, deep * 0.8, deep])).turn("x", -90).move(z=h / 2)
    u, v = np.meshgrid(np.linspace(-0.42 * w, 0.42 * w, 13), np.linspace(0.1 * h, 0.9 * h, 13))
    bulb = 0.02 * (1 - (2 * u / w) ** 2) * (1 - (2 * v / h - 1) ** 2)
    glass = sheet(np.stack([u, -0.004 - bulb, v], axis=-1))
    gun = frustum(0.12, 0.02, deep * 0.7).turn("x", -90).move(y=0.03, z=h / 2)  # the tube inside
    vents = [
        box(w * 0.3, 0.004, 0.004).move(y=0.3 * deep + 0.02 * i, z=h - 0.02 - 0.02 * i) for i in range(4)
    ]
    tilt = draw.between(-8, 4)
    parts = [p.turn("x", tilt).move(y=-deep * 0.4, z=lift + 0.03) for p in (body, glass, gun, *vents)]
    return [*parts, frustum(0.13, 0.1, lift + 0.04, 24), bevel_box(0.28, 0.26, 0.025, 0.008)]
