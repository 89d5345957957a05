"""Mugs and bottles."""

from __future__ import annotations

import numpy as np

from ocnf_data.shapes.draw import Draw
from ocnf_data.shapes.primitives import (
    Part,
    arc,
    bar,
    box,
    cushion,
    ellipse,
    frustum,
    revolve,
    rounded,
    sheet,
    tube,
)


def mug(draw: Draw) -> list[Part]:
    """Mugs, cups, beakers and steins with handles of all kinds, saucers, lids, spoons, something to drink."""
    r, h = draw.between(0.035, 0.05), draw.between(0.06, 0.13)
    wall = draw.between(0.003, 0.006)
    flare, belly = draw.between(0.75, 1.3), draw.between(-0.12, 0.25)
    u = np.linspace(0, 1, 9)
    outer = r * (1 + (flare - 1) * u + belly * np.sin(np.pi * u))
    inner = np.maximum(outer - wall, 0.004)
    up, down = np.column_stack([outer, u * h]), np.column_stack([inner, wall + u * (h - wall)])[::-1]
    lip = [[(outer[-1] + inner[-1]) / 2, h + wall * 0.4]]
    n = draw.pick(10, 32, 32, 40)
    profile = np.concatenate([[[0, 0]], up, lip, down, [[0, wall]]])
    parts = [revolve(profile, n)]
    if draw.chance(0.9):
        parts += _handle(draw, h, float(np.interp(0.82, u, outer)), float(np.interp(0.2, u, outer)))
    if draw.chance(0.4):
        level = draw.between(0.5, 0.9)
        parts.append(revolve([(0, level * h), (float(np.interp(level, u, inner)), level * h)], n))
    if draw.chance(0.25):
        q = r * draw.between(1.7, 2.1)
        saucer = [
            (0, -0.004),
            (0.5 * q, -0.004),
            (0.55 * q, 0),
            (q, 0.012),
            (q, 0.015),
            (0.5 * q, 0.002),
            (0, 0.001),
        ]
        parts = [*(p.move(z=0.004) for p in parts), revolve(saucer, 36).move(z=0.004)]
    if draw.chance(0.2):
        top = float(outer[-1])
        tilt = draw.between(-1, 1)
        parts += [
            bar((0, 0, wall * 2), (top * 0.9, top * tilt * 0.2, h * 1.5), 0.0022, n=6),
            cushion(0.02, 0.03, 0.006, 2.2).turn("y", 35).move(z=wall * 2),
        ]
    elif draw.chance(0.15):
        top = float(outer[-1])
        lid = [
            (0, h),
            (top * 1.03, h),
            (top * 1.03, h + 0.005),
            (top * 0.5, h + 0.016),
            (0.008, h + 0.02),
            (0.011, h + 0.03),
            (0, h + 0.034),
        ]
        parts.append(revolve(lid, n))
    return parts


def _handle(draw: Draw, h: float, upper: float, lower: float) -> list[Part]:
    out, thick = draw.between(0.022, 0.04), draw.between(0.0035, 0.006)
    high, low = 0.82 * h, draw.between(0.15, 0.3) * h
    a, b = (upper - 0.002, 0, high), (lower - 0.002, 0, low)
    x = max(upper, lower) + out
    match draw.pick("C", "D", "ear", "strap"):
        case "C":
            path = arc(
                [a, (x, 0, high * 0.95), (x + 0.004, 0, (high + low) / 2), (x * 0.9, 0, low * 1.1), b], 20
            )
        case "D":
            path = rounded([a, (x, 0, high), (x, 0, low), b], 0.015)
        case "ear":
            path = arc([a, (x * 0.95, 0, high + 0.012), (x + 0.008, 0, high * 0.75), b], 20)
        case _:
            path = arc([a, (x, 0, (high + low) / 2), b], 16)
            return [tube(path, thick, section=ellipse(2.2, 0.7, 12, 3))]
    return [tube(path, thick, 12)]


def bottle(draw: Draw) -> list[Part]:
    """Bottles, flasks, jugs and jars: hollow, with necks, caps, handles, labels and a drink inside."""
    r, h = draw.between(0.03, 0.06), draw.between(0.16, 0.34)
    neck = r * draw.between(0.25, 0.6)
    shoulder, base = draw.between(0.45, 0.78), draw.between(0.75, 1.05)
    u = np.concatenate(
        [np.linspace(0, shoulder, 10), np.linspace(shoulder, min(shoulder + 0.22, 0.93), 8)[1:], [0.97, 1]]
    )
    drop = np.clip((u - shoulder) / (min(shoulder + 0.22, 0.93) - shoulder), 0, 1)
    curve = draw.pick(drop, drop**2 * (3 - 2 * drop), np.sqrt(drop))
    body = r * (
        base
        + (1 - base) * np.minimum(u / 0.15, 1)
        + draw.between(-0.18, 0.12) * np.sin(np.pi * u / shoulder) ** 2 * (u < shoulder)
    )
    outer = (1 - curve) * body + curve * neck
    if draw.chance(0.4):
        outer = outer + 0.04 * r * np.sin(draw.count(20, 60) * u) * (u < shoulder)
    outline = np.column_stack([outer, u * h])
    inner = np.column_stack([np.maximum(outer - 0.0025, 0.003), np.maximum(u * h, 0.004)])
    n = draw.pick(6, 28, 28, 36)
    if draw.chance(0.3):  # open at the top and without thickness
        parts = [revolve(np.concatenate([[[0, 0]], outline]), n)]
    else:
        parts = [revolve(np.concatenate([[[0, 0]], outline, inner[::-1], [[0, 0.004]]]), n)]
    if draw.chance(0.5):
        level = draw.between(0.2, 0.9) * shoulder
        q = float(np.interp(level, u, outer)) * 0.93
        parts.append(revolve([(0, 0.006), (q * 0.95, 0.006), (q, level * h), (0, level * h)], n))
    match draw.pick("cap", "cork", "none", "spray"):
        case "cap":
            parts.append(frustum(neck * 1.15, neck * 1.1, 0.022, 24).move(z=h - 0.016))
        case "cork":
            parts.append(frustum(neck * 0.8, neck * 0.95, 0.035, 16).move(z=h - 0.02))
        case "spray":
            parts += [
                frustum(neck * 1.1, neck * 0.9, 0.03).move(z=h - 0.01),
                box(0.018, 0.06, 0.02).move(y=-0.01, z=h + 0.02),
                frustum(0.004, 0.003, 0.015, 8).turn("x", 90).move(y=-0.04, z=h + 0.032),
                tube([(0, -0.02, h + 0.02), (0, -0.035, h + 0.005), (0, -0.033, h - 0.02)], 0.004, 8),
                bar((0, 0, 0.01), (0, 0, h), 0.0025, n=6),
            ]
    if draw.chance(0.3):
        z0, z1 = h * shoulder * 0.4, h * min(shoulder + 0.15, 0.9)
        a, b = float(np.interp(z0 / h, u, outer)), float(np.interp(z1 / h, u, outer))
        out = max(a, b) + 0.03
        parts.append(
            tube(arc([(b * 0.95, 0, z1), (out, 0, z1), (out, 0, z0 * 1.2), (a * 0.97, 0, z0)], 18), 0.006, 10)
        )
    if draw.chance(0.4):  # a label round the front
        v = np.linspace(0.2, 0.8, 6)[:, None] * shoulder
        t = np.linspace(-2, 2, 24)[None]
        near = np.interp(v, u, outer) * 1.012 + 0.0004
        label = np.broadcast_arrays(near * np.sin(t), -near * np.cos(t), v * h)
        parts.append(sheet(np.stack(label, axis=-1)))
    return parts
