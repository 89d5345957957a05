"""Airplanes."""

from __future__ import annotations

import numpy as np

from ocnf_data.shapes.draw import Draw
from ocnf_data.shapes.primitives import (
    Part,
    bar,
    box,
    ellipse,
    ellipsoid,
    frustum,
    mirrored,
    revolve,
    sheet,
    solid,
)


def _wing(span: float, root: float, tip: float, sweep: float, rise: float, thick: float) -> Part:
    """Half a wing along +x from the origin, where its chord is centred; swept back to +y, rising."""
    t = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    chord = 0.5 - 0.5 * np.cos(t)
    airfoil = np.column_stack([chord, np.sign(np.sin(t)) * thick * (chord**0.5) * (1.02 - chord) * 1.9])
    rings = []
    for u in np.linspace(0, 1, 7):
        c = root + (tip - root) * u
        rings.append(
            np.column_stack(
                [
                    np.full(16, span * u),
                    airfoil[:, 0] * c + sweep * u - root / 2,
                    airfoil[:, 1] * c + rise * u,
                ]
            )
        )
    return solid(np.stack(rings))


def airplane(draw: Draw) -> list[Part]:
    """Airliners, propeller planes, biplanes, jet fighters and gliders, nose at negative y."""
    kind = draw.pick("airliner", "airliner", "propeller", "biplane", "fighter", "glider")
    length = {"airliner": 40.0, "propeller": 8.0, "biplane": 7.0, "fighter": 15.0, "glider": 7.5}[kind]
    length *= draw.between(0.85, 1.2)
    slim = {"airliner": 0.052, "propeller": 0.075, "biplane": 0.075, "fighter": 0.055, "glider": 0.045}[kind]
    r = length * slim * draw.between(0.85, 1.15)
    parts = [_fuselage(draw, length, r, pointed=kind in ("fighter", "glider"))]
    span = (
        length * {"airliner": 0.48, "propeller": 0.58, "biplane": 0.55, "fighter": 0.32, "glider": 1.05}[kind]
    )
    span *= draw.between(0.85, 1.15)
    root = length * draw.between(0.13, 0.2) * (2.2 if kind == "fighter" else 0.6 if kind == "glider" else 1)
    tip = root * draw.between(0.2, 0.5) if kind in ("airliner", "fighter") else root * draw.between(0.6, 1)
    sweep = span * {"airliner": 0.45, "propeller": 0.02, "biplane": 0.0, "fighter": 0.9, "glider": 0.02}[kind]
    sweep *= draw.between(0.6, 1.1)
    rise, thick = span * draw.between(0, 0.1), draw.between(0.05, 0.09)
    high = draw.pick(-0.6, -0.6, 0.75) * r if kind != "fighter" else 0.0
    wing_y = -0.05 * length if kind != "fighter" else 0.05 * length
    wing = _wing(span, root, tip, sweep, rise, thick).move(y=wing_y, z=high)
    parts += mirrored([wing])
    parts += _tail(draw, length, r, kind)
    if kind == "airliner":
        parts += _engines(draw, length, r, span, sweep, rise, wing_y - root / 2, high, root)
        if draw.chance(0.5):
            tip_y, tip_z = wing_y - root / 2 + sweep, high + rise
            parts += mirrored(
                [
                    _wing(0.06 * span, tip, tip * 0.5, tip * 0.5, 0, 0.05)
                    .turn("y", -75)
                    .move(x=span, y=tip_y + tip / 2, z=tip_z)
                ]
            )
    if kind in ("propeller", "biplane"):
        parts += _propeller(draw, length, r)
        parts += _gear(length, r)
    if kind == "biplane":
        gap = length * draw.between(0.17, 0.23)
        parts += mirrored([wing.move(y=-0.06 * root, z=gap - high)])
        for u in (0.12, 0.7):
            for dy in (-0.25, 0.25):
                parts += mirrored(
                    [
                        bar(
                            (u * span, wing_y + dy * root, high),
                            (u * span, wing_y + (dy - 0.06) * root, gap + 0.3 * rise),
                            0.012 * r + 0.01,
                        )
                    ]
                )
    if kind == "fighter":
        parts += mirrored([box(0.35 * r, length * 0.3, 0.8 * r).move(x=r, y=-0.12 * length, z=-0.4 * r)])
        parts += mirrored(
            [
                ellipsoid(0.18 * r, length * 0.1, 0.18 * r, 12).move(
                    x=span * draw.between(0.4, 0.8), y=0.2 * length, z=-0.35 * r
                )
            ]
        )
    if kind != "airliner":
        parts.append(ellipsoid(0.55 * r, 0.11 * length, 0.6 * r).move(y=-0.2 * length, z=0.75 * r))
        parts.append(box(0.5 * r, 0.5 * r, 0.9 * r).move(y=-0.17 * length, z=-0.2 * r))  # the seat inside
    else:
        parts.append(box(1.7 * r, 0.7 * length, 0.05 * r).move(z=-0.25 * r))  # the floor inside
    return [p.move(z=2 * r) for p in parts]


def _fuselage(draw: Draw, length: float, r: float, pointed: bool) -> Part:
    u = np.concatenate(
        [[0.004], np.linspace(0.02, 0.2, 8), np.linspace(0.28, 0.6, 4), np.linspace(0.68, 1, 7)]
    )
    nose = np.minimum(u / (0.4 if pointed else 0.14), 1)
    tail = np.minimum((1 - u) / draw.between(0.35, 0.5), 1)
    radius = r * (1 - (1 - nose) ** 2) ** (0.75 if pointed else 0.5) * (0.08 + 0.92 * tail**0.8)
    lift = 0.75 * r * (1 - tail) ** 1.5  # the tail rises, so that the back stays level
    flat, power = draw.between(0.9, 1.15), draw.pick(2.0, 2.0, 2.6)
    rings = []
    for q, v, z in zip(radius, u, lift, strict=True):
        outline = ellipse(q, q * flat, 24, power)
        rings.append(np.column_stack([outline[:, 0], np.full(24, (v - 0.5) * length), outline[:, 1] + z]))
    return solid(np.stack(rings)[:, ::-1])


def _tail(draw: Draw, length: float, r: float, kind: str) -> list[Part]:
    y, z, s = 0.42 * length, 0.75 * r, length * draw.between(0.12, 0.17)
    chord, sweep = length * 0.1, s * (0.15 if kind in ("propeller", "biplane", "glider") else 0.7)
    fin = _wing(s * draw.between(0.8, 1.1), chord * 1.2, chord * 0.6, sweep, 0, 0.05).turn("y", -90)
    plane = _wing(s * 1.1, chord, chord * 0.6, sweep, s * draw.between(0, 0.12), 0.05)
    layout = draw.pick(
        "low",
        "low",
        "T",
        "V" if kind in ("glider", "fighter") else "low",
        "twin" if kind == "fighter" else "low",
    )
    if layout == "V":
        return mirrored([plane.turn("y", -40).move(y=y, z=z * 0.8)])
    if layout == "twin":
        return [
            *mirrored([fin.turn("y", 12).move(x=0.7 * r, y=y, z=0.4 * r)]),
            *mirrored([plane.move(y=y, z=0.4 * z)]),
        ]
    if layout == "T":
        return [fin.move(y=y, z=z), *mirrored([plane.move(y=y + sweep * 0.9, z=z + s * 0.8)])]
    return [fin.move(y=y, z=z), *mirrored([plane.move(y=y, z=0.6 * z)])]


def _engines(
    draw: Draw,
    length: float,
    r: float,
    span: float,
    sweep: float,
    rise: float,
    front: float,
    high: float,
    root: float,
) -> list[Part]:
    """Open nacelles with a spinner and a disc inside, on pylons under the wing or at the tail."""
    q, deep = r * draw.between(0.4, 0.6), length * draw.between(0.07, 0.1)
    profile = [
        (0.82 * q, 0.05 * deep),
        (0.95 * q, 0),
        (q, 0.25 * deep),
        (0.75 * q, deep),
        (0.65 * q, deep),
        (0.8 * q, 0.4 * deep),
    ]
    nacelle = [
        revolve(profile, 20),
        frustum(0.8 * q, 0.8 * q, 0.02 * deep, 20).move(z=0.35 * deep),
        revolve([(0, 0.1 * deep), (0.25 * q, 0.35 * deep), (0.3 * q, 0.8 * deep), (0, 1.15 * deep)], 14),
    ]
    nacelle = [p.turn("x", -90) for p in nacelle]
    match draw.pick("two", "two", "four", "rear"):
        case "two":
            places = [0.33]
        case "four":
            places = [0.3, 0.6]
        case _:
            x, y = r + 1.1 * q, 0.25 * length
            return mirrored(
                [
                    *(p.move(x=x, y=y, z=0.3 * r) for p in nacelle),
                    box(x, deep * 0.6, 0.15 * q).move(x=x / 2, y=y + deep / 2, z=0.3 * r),
                ]
            )
    parts = []
    for u in places:
        x, y, z = u * span, front + sweep * u - 0.35 * deep, high + rise * u - 1.25 * q
        parts += [p.move(x=x, y=y, z=z) for p in nacelle]
        parts.append(box(0.12 * q, deep * 0.9, 1.3 * q).move(x=x, y=y + 0.6 * deep, z=z))
    return mirrored(parts)


def _propeller(draw: Draw, length: float, r: float) -> list[Part]:
    reach = r * draw.between(1.3, 1.8)
    u = np.linspace(0.05, 1, 9)[:, None]
    edge = np.array([[-1.0, 1.0]]) * 0.13 * reach * np.sqrt(np.maximum(1.02 - u, 0)) * (0.5 + u)
    twist = np.radians(60 - 45 * u)
    blade = sheet(
        np.stack(np.broadcast_arrays(edge * np.cos(twist), edge * np.sin(twist), u * reach), axis=-1)
    )
    spin = draw.between(0, 90)
    n = draw.count(2, 4)
    blades = [blade.turn("y", spin + 360 * i / n).move(y=-0.51 * length) for i in range(n)]
    spinner = revolve(
        [(0, -0.06 * length), (0.2 * r, -0.02 * length), (0.3 * r, 0.02 * length), (0, 0.02 * length)], 14
    )
    return [*blades, spinner.turn("x", -90).move(y=-0.5 * length)]


def _gear(length: float, r: float) -> list[Part]:
    wheel = 0.32 * r
    tyre = frustum(wheel, wheel, 0.25 * r, 18).turn("y", 90)
    main = [
        bar((0.5 * r, -0.15 * length, -0.7 * r), (1.3 * r, -0.17 * length, -1.6 * r), 0.06 * r),
        tyre.move(x=1.25 * r, y=-0.17 * length, z=-1.65 * r),
    ]
    rear = [
        bar((0, 0.42 * length, 0.2 * r), (0, 0.45 * length, -0.5 * r), 0.05 * r),
        frustum(0.5 * wheel, 0.5 * wheel, 0.1 * r, 14)
        .turn("y", 90)
        .move(-0.05 * r, 0.45 * length, -0.55 * r),
    ]
    return [*mirrored(main), *rear]
