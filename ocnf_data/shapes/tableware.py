"""Open vessels for the table and the window sill: vases, bowls, cups, glasses, pitchers."""

from __future__ import annotations

import numpy as np

from ocnf_data.shapes.draw import Draw
from ocnf_data.shapes.hollow import contents, round_section, side_handle, vessel
from ocnf_data.shapes.primitives import Part, arc, bar, ellipse, frustum, revolve, tube


def vase(draw: Draw) -> list[Part]:
    """Bellied, necked, conical, cylindrical and square vases, amphoras; some with stems in them."""
    h, r = draw.between(0.15, 0.5), draw.between(0.05, 0.14)
    k = draw.count(14, 24)
    u = np.linspace(0, 1, k)
    match draw.pick("belly", "belly", "cone", "neck", "cylinder", "wave"):
        case "belly":
            peak, foot, rim = draw.between(0.3, 0.7), draw.between(0.4, 0.8), draw.between(0.3, 0.9)
            radii = np.interp(u, [0, peak, 1], [foot, 1, rim]) + 0.25 * np.sin(np.pi * u) ** 2
        case "cone":
            radii = draw.between(0.35, 0.7) + (1 - draw.between(0.3, 0.6)) * u ** draw.between(0.7, 2.5)
        case "neck":
            start, thin = draw.between(0.4, 0.7), draw.between(0.2, 0.5)
            drop = np.clip((u - start) / 0.2, 0, 1)
            radii = np.where(u < start, 0.7 + 0.4 * np.sin(np.pi * u / start), 0.7)
            radii = radii * (1 - drop) + thin * drop + draw.between(0, 0.4) * np.clip((u - 0.85) / 0.15, 0, 1)
        case "cylinder":
            radii = np.full(k, 0.8) + draw.between(-0.2, 0.3) * u
        case _:
            radii = 0.75 + draw.between(0.1, 0.25) * np.sin(draw.between(3, 9) * u + draw.between(0, 6))
    wall = draw.between(0.004, 0.012)
    section = round_section(draw, 0.3) if draw.chance(0.85) else ellipse(1, 1, 32, draw.between(4, 12))
    parts = vessel(draw, r * radii, h * u, wall, section)
    if draw.chance(0.2):
        low, high = draw.between(0.45, 0.6), draw.between(0.75, 0.9)
        inner = r * float(min(np.interp(low, u, radii), np.interp(high, u, radii))) - wall
        handle = side_handle(draw, inner, low * h, high * h, r * draw.between(0.5, 0.9), 0.006)
        parts += [handle, handle.turn("z", 180)]
    if draw.chance(0.2):
        for _ in range(draw.count(1, 5)):
            angle, lean = draw.between(0, 2 * np.pi), draw.between(0.2, 0.9) * r * float(radii[-1])
            top = (1.8 * lean * np.cos(angle), 1.8 * lean * np.sin(angle), h * draw.between(1.2, 1.8))
            middle = (0.5 * lean * np.cos(angle), 0.5 * lean * np.sin(angle), h)
            parts.append(tube(arc([(0, 0, 2 * wall), middle, top], 8), 0.003, 6))
    elif draw.chance(0.5):
        parts += contents(draw, 0.8 * r * float(radii[1 : k // 2].min()) - wall, 2 * wall, 0.5 * h)
    return parts


def bowl(draw: Draw) -> list[Part]:
    """Bowls, dishes and deep plates, on feet, with broad rims or handles."""
    r, h = draw.between(0.06, 0.18), draw.between(0.35, 1.0)
    h *= r
    u = np.linspace(0, 1, draw.count(9, 16))
    foot = draw.between(0.25, 0.6)
    radii = r * (foot + (1 - foot) * np.sin(np.pi / 2 * u) ** draw.between(0.5, 1.2))
    heights = h * u ** draw.between(1.0, 2.2)
    wall = draw.between(0.004, 0.009)
    if draw.chance(0.3):  # a broad rim
        radii = np.concatenate([radii, [radii[-1] * draw.between(1.1, 1.35)]])
        heights = np.concatenate([heights, [h * 1.04]])
    parts = vessel(draw, radii, heights, wall, round_section(draw))
    if draw.chance(0.4):
        q, low = float(radii[0]) * draw.between(0.8, 1.1), draw.between(0.006, 0.03)
        ring = [(q, -low), (q, wall / 2), (0.85 * q, wall / 2), (0.85 * q, -low), (q, -low)]
        parts.append(
            revolve(ring[:-1], 28) if draw.chance(0.5) else frustum(q, q, low + wall / 2).move(z=-low)
        )
    if draw.chance(0.2):
        ear = side_handle(draw, float(radii[-1]) - wall, 0.6 * h, 0.9 * h, 0.25 * r, 0.005)
        parts += [ear, ear.turn("z", 180)]
    return parts + contents(draw, 0.8 * float(radii[len(u) // 2]) - wall, float(heights[1]) + wall, h)


def cup(draw: Draw) -> list[Part]:
    """Tea and paper cups, beakers, egg cups; without or with one small handle, stacked, with straws."""
    r, h = draw.between(0.03, 0.05), draw.between(0.05, 0.13)
    u = np.linspace(0, 1, draw.count(8, 14))
    foot = draw.between(0.45, 0.95)
    curve = draw.pick(u, np.sin(np.pi / 2 * u), u**2)
    radii, wall = r * (foot + (1 - foot) * curve), draw.between(0.0015, 0.004)
    section = round_section(draw, 0.15)
    parts = vessel(draw, radii, h * u, wall, section)
    if draw.chance(0.25):  # another one in it
        lift = draw.between(0.1, 0.25) * h
        parts += [p.move(z=lift) for p in vessel(draw, radii - wall, h * u, wall, section)]
    elif draw.chance(0.35):
        inner = float(np.interp(0.4, u, radii)) - wall / 2
        parts.append(side_handle(draw, inner, 0.25 * h, draw.between(0.6, 0.85) * h, 0.5 * r, 0.003))
    elif draw.chance(0.3):
        parts.append(bar((0, 0, 2 * wall), (0.8 * r, 0.1 * r, h * draw.between(1.3, 1.8)), 0.0025, n=8))
    if draw.chance(0.25):  # on a foot, as egg cups are
        stem, low = draw.between(0.2, 0.5) * r, draw.between(0.01, 0.04)
        flat = [(0, -low), (0.8 * r, -low), (stem, -0.6 * low), (stem, wall / 2), (0, wall / 2)]
        parts.append(revolve(flat, 28))
    return parts + contents(draw, 0.7 * r * foot, 2 * wall, h)


def glass(draw: Draw) -> list[Part]:
    """Wine glasses, goblets, flutes, tumblers: thin walls, mostly on a stem."""
    r, deep = draw.between(0.025, 0.05), draw.between(0.05, 0.14)
    u = np.linspace(0, 1, draw.count(9, 15))
    match draw.pick("tulip", "flute", "cone", "balloon"):
        case "tulip":
            radii = np.sin(np.pi * (0.12 + 0.6 * u)) ** 0.8
        case "flute":
            radii = 0.35 + 0.5 * u ** draw.between(0.3, 0.8)
        case "cone":
            radii = 0.15 + 1.1 * u
        case _:
            radii = np.sin(np.pi * (0.15 + 0.55 * u)) * 1.2
    wall, section = draw.between(0.001, 0.0025), round_section(draw, 0.1)
    parts = vessel(draw, r * radii, deep * u, wall, section)
    if draw.chance(0.75):
        stem, tall, flat = draw.between(0.003, 0.006), draw.between(0.02, 0.1), draw.between(0.7, 1.0) * r
        foot = [
            (0, -tall),
            (flat, -tall),
            (flat, -tall + 0.002),
            (2 * stem, -tall + 0.006),
            (stem, -tall / 2),
            (1.5 * stem, 0.001),
            (0, 0.002),
        ]
        if draw.chance(0.3):
            foot.insert(4, (2.5 * stem, -0.7 * tall))
        parts.append(revolve(foot, draw.pick(20, 24, 32)))
    if draw.chance(0.3):
        level = draw.between(0.2, 0.7)
        q = r * float(np.interp(level, u, radii)) - wall
        parts.append(
            revolve(
                [(0, level * deep - 0.002), (q, level * deep - 0.002), (q, level * deep), (0, level * deep)],
                24,
            )
        )
    return parts


def pitcher(draw: Draw) -> list[Part]:
    """Jugs and pitchers with a handle and a spout, bellied or straight."""
    h, r = draw.between(0.15, 0.32), draw.between(0.05, 0.09)
    u = np.linspace(0, 1, draw.count(14, 20))
    neck, foot = draw.between(0.5, 0.95), draw.between(0.6, 0.95)
    radii = r * (
        np.interp(u, [0, 0.4, 0.8, 1], [foot, 1, neck, neck * draw.between(1, 1.2)])
        + draw.between(0, 0.15) * np.sin(np.pi * u)
    )
    wall = draw.between(0.003, 0.007)
    n = draw.pick(28, 32, 36, 40)
    pull, broad = draw.between(0.15, 0.45) * r, draw.between(0.35, 0.6)

    def spout(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        # The rim is drawn out towards -x, more the higher.
        near = np.exp(-((np.arctan2(y, -x) / broad) ** 2)) * np.clip(z / h - 0.75, 0, 1) * 4
        away = np.hypot(x, y) > 1e-9
        return x - pull * near * away, y, z + 0.3 * pull * near * away

    body = [p.bend(spout) for p in vessel(draw, radii, h * u, wall, ellipse(1, 1, n))]
    low, high = draw.between(0.12, 0.3), draw.between(0.75, 0.92)
    inner = float(min(np.interp(low, u, radii), np.interp(high, u, radii))) - wall / 2
    body.append(side_handle(draw, inner, low * h, high * h, r * draw.between(0.5, 0.9), 0.008))
    return body + contents(draw, 0.7 * float(radii[0]), 2 * wall, 0.7 * h)
