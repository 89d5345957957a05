"""Plants in pots."""

from __future__ import annotations

import numpy as np

from ocnf_data.shapes.draw import Draw
from ocnf_data.shapes.primitives import (
    F64,
    Part,
    arc,
    bar,
    ellipsoid,
    revolve,
    sheet,
    solid,
    tube,
)


def plant(draw: Draw) -> list[Part]:
    """Pots with soil and something in them: broad leaves, grass, a small tree, a cactus."""
    r, h = draw.between(0.09, 0.2), draw.between(0.12, 0.35)
    flare = draw.between(0.65, 1.1)
    profile = [(0, 0), (r * flare, 0), (r, h), (r * 1.08, h), (r * 1.08, h * 0.86), (r * 0.9, h * 0.86)]
    n = draw.pick(4, 8, 28, 28)
    parts = [revolve(profile[: draw.pick(4, 6)], n), revolve([(0, h * 0.85), (r * 0.97, h * 0.85)], n)]
    z = h * 0.85
    match draw.pick("leaves", "grass", "tree", "cactus", "palm"):
        case "leaves":
            for i in range(draw.count(6, 16)):
                stem, size = draw.between(0.15, 0.5), draw.between(0.12, 0.25)
                lean = draw.between(0.15, 0.6)
                path = arc([(0, 0, z), (lean * stem * 0.4, 0, z + stem * 0.7), (lean * stem, 0, z + stem)], 8)
                leaf = _leaf(size, size * draw.between(0.3, 0.6), draw.between(0.2, 0.9)).turn(
                    "y", draw.between(-50, 10)
                )
                turn = 137.5 * i + draw.between(-20, 20)
                parts += [p.turn("z", turn) for p in (tube(path, 0.004, 5), leaf.move(*path[-1]))]
        case "grass":
            for i in range(draw.count(18, 45)):
                blade = _leaf(draw.between(0.3, 0.8), 0.016, draw.between(0.3, 1.6)).turn(
                    "y", -draw.between(55, 88)
                )
                parts.append(blade.move(x=draw.between(0, 0.6) * r, z=z).turn("z", 137.5 * i))
        case "palm":
            tall = draw.between(0.3, 0.9)
            trunk = arc(
                [(0, 0, z - 0.02), (draw.between(-0.1, 0.1), 0, z + tall / 2), (0.02, 0.03, z + tall)], 14
            )
            parts.append(tube(trunk, np.linspace(0.03, 0.018, 14) * (1 + 0.12 * (np.arange(14) % 2))))
            for i in range(draw.count(7, 14)):
                frond = _leaf(draw.between(0.35, 0.6), 0.07, draw.between(1.0, 1.9)).turn(
                    "y", -draw.between(20, 60)
                )
                parts.append(frond.turn("z", 137.5 * i).move(*trunk[-1]))
        case "cactus":
            for i in range(draw.count(1, 4)):
                tall, q = draw.between(0.15, 0.6), draw.between(0.03, 0.06)
                parts.append(
                    _cactus(tall, q).move(x=draw.between(0, 0.5) * r * (i > 0), z=z).turn("z", 137.5 * i)
                )
                if draw.chance(0.5):
                    arm = arc([(0, 0, tall * 0.5), (q + 0.06, 0, tall * 0.52), (q + 0.08, 0, tall * 0.9)], 10)
                    parts += [
                        tube(arm, q * 0.55, 10).move(z=z),
                        ellipsoid(q * 0.55, q * 0.55, q * 0.55, 12).move(*arm[-1]).move(z=z),
                    ]
        case _:
            parts += _tree(draw, np.array([0, 0, z]), np.array([0, 0, 1.0]), draw.between(0.25, 0.4), 0.02, 3)
    return parts


def _leaf(length: float, width: float, droop: float) -> Part:
    """A pointed sheet along +x from the origin, folded at the midrib, bending down towards the tip."""
    u = np.linspace(0, 1, 9)[:, None]
    v = np.linspace(-1, 1, 5)[None]
    half = width * np.sin(np.pi * (0.04 + 0.95 * u) ** 0.8) + 1e-4
    angle = droop * u
    x, z = length * u * np.sinc(angle / np.pi), -length * u * np.sin(angle / 2) * np.sinc(angle / 2 / np.pi)
    return sheet(np.stack(np.broadcast_arrays(x, v * half, z + 0.3 * half * np.abs(v)), axis=-1))


def _cactus(h: float, r: float) -> Part:
    t = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    ribs = 1 + 0.12 * np.cos(10 * t)
    u = np.linspace(0, 1, 12)
    q = (
        r
        * np.sqrt(np.clip(1 - (np.maximum(u - 0.75, 0) / 0.26) ** 2, 0.01, 1))
        * (0.8 + 0.2 * np.minimum(u / 0.3, 1))
    )
    return solid(
        np.stack(
            [
                np.column_stack([a * ribs * np.cos(t), a * ribs * np.sin(t), 0 * t + h * b])
                for a, b in zip(q, u, strict=True)
            ]
        )
    )


def _tree(draw: Draw, at: F64, along: F64, length: float, r: float, depth: int) -> list[Part]:
    """A branch, the branches on it, and leaves at the last ones."""
    tip = at + length * along
    parts = [bar(at.tolist(), tip.tolist(), r, r * 0.7, 7)]
    if depth == 0:
        for i in range(3):
            leaf = (
                _leaf(draw.between(0.05, 0.09), 0.022, 0.6)
                .turn("y", draw.between(-60, 30))
                .turn("z", 120 * i)
            )
            parts.append(leaf.move(*tip))
        return parts
    for i in range(draw.count(2, 3)):
        swing = np.radians(137.5 * i + draw.between(0, 90))
        out = np.array([np.cos(swing), np.sin(swing), 0.0])
        aim = along + draw.between(0.4, 0.9) * out
        parts += _tree(
            draw,
            tip - 0.02 * along,
            aim / np.linalg.norm(aim),
            length * draw.between(0.55, 0.8),
            r * 0.65,
            depth - 1,
        )
    return parts
