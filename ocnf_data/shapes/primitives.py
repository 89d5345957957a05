"""The small parts that shapes are put together from.

Axes: x to the right, y to the back, z up; metres. Unless said otherwise a part stands on z = 0, centred on
the z axis, and its faces look outwards.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ocnf_data.arrays import F64, I64


class Part(NamedTuple):
    """Vertices (N, 3) and triangles (M, 3); every method returns a new part."""

    vertices: F64
    faces: I64

    def move(self, x: float = 0, y: float = 0, z: float = 0) -> Part:
        """The part shifted."""
        return Part(self.vertices + np.array([x, y, z]), self.faces)

    def scale(self, x: float = 1, y: float = 1, z: float = 1) -> Part:
        """The part stretched along the axes from the origin; mirrored by a negative factor, normals kept."""
        faces = self.faces[:, ::-1] if x * y * z < 0 else self.faces
        return Part(self.vertices * (x, y, z), faces)

    def shrink(self, factor: float) -> Part:
        """The part scaled about the middle of its box."""
        middle = (self.vertices.min(axis=0) + self.vertices.max(axis=0)) / 2
        return Part(middle + factor * (self.vertices - middle), self.faces)

    def turn(self, axis: str, degrees: float) -> Part:
        """The part turned about x, y or z through the origin, counter-clockwise seen from the axis' tip."""
        i = "xyz".index(axis)
        j, k = (i + 1) % 3, (i + 2) % 3
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        out = self.vertices.copy()
        out[:, j] = c * self.vertices[:, j] - s * self.vertices[:, k]
        out[:, k] = s * self.vertices[:, j] + c * self.vertices[:, k]
        return Part(out, self.faces)

    def bend(self, change: Callable[[F64, F64, F64], tuple[F64, F64, F64]]) -> Part:
        """The part with every vertex moved to `change(x, y, z)`."""
        return Part(np.stack(change(*self.vertices.T), axis=1), self.faces)


def join(parts: Sequence[Part]) -> Part:
    """All parts as one, in order; overlaps stay."""
    offsets = np.cumsum([0] + [len(p.vertices) for p in parts[:-1]])
    return Part(
        np.concatenate([p.vertices for p in parts]),
        np.concatenate([p.faces + o for p, o in zip(parts, offsets, strict=True)]),
    )


def around(part: Part, n: int, start: float = 0) -> list[Part]:
    """`n` copies turned evenly about the z axis, the first by `start` degrees."""
    return [part.turn("z", start + 360 * i / n) for i in range(n)]


def mirrored(parts: Sequence[Part]) -> list[Part]:
    """The parts and their mirror images in the plane x = 0."""
    return [*parts, *(p.scale(x=-1) for p in parts)]


def loft(rings: F64, start: F64 | None = None, end: F64 | None = None, loop: bool = False) -> Part:
    """Skin over closed rings.

    Args:
        rings: (n, m, 3); going round a ring is counter-clockwise seen from the next one.
        start: point to which the first ring is closed; open where None.
        end: the same for the last ring.
        loop: join the last ring to the first.
    """
    n, m, _ = rings.shape
    index = np.arange(n * m).reshape(n, m)
    a, c = (index, np.roll(index, -1, axis=0)) if loop else (index[:-1], index[1:])
    b, d = np.roll(a, -1, axis=1), np.roll(c, -1, axis=1)
    faces = [np.stack([a, b, d], axis=-1).reshape(-1, 3), np.stack([a, d, c], axis=-1).reshape(-1, 3)]
    vertices = [rings.reshape(-1, 3)]
    extra = n * m
    for point, ring, reverse in ((start, index[0], True), (end, index[-1], False)):
        if point is not None:
            fan = np.stack([np.full(m, extra), ring, np.roll(ring, -1)], axis=1)
            faces.append(fan[:, ::-1] if reverse else fan)
            vertices.append(np.asarray(point, dtype=np.float64)[None])
            extra += 1
    return Part(np.concatenate(vertices), np.concatenate(faces))


def solid(rings: F64) -> Part:
    """`loft` with both ends closed at the middle of the ring."""
    return loft(rings, rings[0].mean(axis=0), rings[-1].mean(axis=0))


def ellipse(rx: float, ry: float, n: int = 24, power: float = 2) -> F64:
    """Outline (n, 2) of |x/rx|^power + |y/ry|^power = 1; a rectangle as the power grows."""
    t = 2 * np.pi * (np.arange(n) + 0.5) / n
    c, s = np.cos(t), np.sin(t)
    return np.stack(
        [rx * np.sign(c) * np.abs(c) ** (2 / power), ry * np.sign(s) * np.abs(s) ** (2 / power)], 1
    )


def rectangle(w: float, d: float, corner: float = 0) -> F64:
    """Outline (4, 2), or (8, 2) with the corners cut off by `corner`."""
    x, y = w / 2, d / 2
    if corner == 0:
        return np.array([[x, -y], [x, y], [-x, y], [-x, -y]])
    i, j = x - corner, y - corner
    return np.array([[i, -y], [x, -j], [x, j], [i, y], [-i, y], [-x, j], [-x, -j], [-i, -y]])


def stack(outlines: Sequence[F64], heights: Sequence[float]) -> F64:
    """Rings (n, m, 3): flat outlines (m, 2) put at heights z."""
    return np.stack(
        [np.column_stack([o, np.full(len(o), z)]) for o, z in zip(outlines, heights, strict=True)]
    )


def box(w: float, d: float, h: float) -> Part:
    """Box of width x, depth y and height z, twelve triangles."""
    x, y = w / 2, d / 2
    corners = np.array([[i, j, k] for k in (0, h) for j in (-y, y) for i in (-x, x)], dtype=np.float64)
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (1, 3, 7, 5), (3, 2, 6, 7), (2, 0, 4, 6)]
    return Part(corners, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]))


def bevel_box(w: float, d: float, h: float, bevel: float) -> Part:
    """Box with all edges cut off by `bevel` (at most a third of the shortest side)."""
    bevel = min(bevel, w / 3, d / 3, h / 3)
    wide, narrow = rectangle(w, d, bevel), rectangle(w - 2 * bevel, d - 2 * bevel, bevel / 2)
    return solid(stack([narrow, wide, wide, narrow], [0, bevel, h - bevel, h]))


def taper_box(w: float, d: float, h: float, top: float) -> Part:
    """Box whose upper side is `top` times as large as the lower."""
    return solid(stack([rectangle(w, d), rectangle(w * top, d * top)], [0, h]))


def slab(outline: F64, h: float, bevel: float = 0) -> Part:
    """An outline (m, 2) that is star-shaped about its mean, h thick."""
    if bevel == 0:
        return solid(stack([outline, outline], [0, h]))
    inner = outline * (1 - bevel / np.abs(outline).max())
    return solid(stack([inner, outline, outline, inner], [0, bevel, h - bevel, h]))


def frustum(r0: float, r1: float, h: float, n: int = 16) -> Part:
    """Cylinder or cone from radius r0 at the bottom to r1 at the top."""
    return solid(stack([ellipse(r0, r0, n), ellipse(r1, r1, n)], [0, h]))


def revolve(profile: Sequence[tuple[float, float]] | F64, n: int = 24) -> Part:
    """Surface of revolution of (radius, z) points; an end on the axis closes it, another stays open."""
    points = np.asarray(profile, dtype=np.float64)
    start = np.array([0, 0, points[0, 1]]) if points[0, 0] == 0 else None
    end = np.array([0, 0, points[-1, 1]]) if points[-1, 0] == 0 else None
    inner = points[start is not None : len(points) - (end is not None)]
    return loft(stack([ellipse(r, r, n) for r, _ in inner], inner[:, 1].tolist()), start, end)


def cushion(w: float, d: float, h: float, power: float = 4, n: int = 20) -> Part:
    """Superellipsoid: an ellipsoid for power 2, a pillow for 3, a soft box for more."""
    t = np.pi * (np.arange(1, n // 2) / (n // 2) - 0.5)
    s, c = np.sin(t), np.cos(t)
    heights = h / 2 + h / 2 * np.sign(s) * np.abs(s) ** (2 / power)
    outline = ellipse(w / 2, d / 2, n, power)
    rings = stack([outline * abs(k) ** (2 / power) for k in c], heights.tolist())
    return loft(rings, np.array([0.0, 0.0, 0.0]), np.array([0.0, 0.0, h]))


def ellipsoid(rx: float, ry: float, rz: float, n: int = 20) -> Part:
    """Ellipsoid about the origin."""
    return cushion(2 * rx, 2 * ry, 2 * rz, 2, n).move(z=-rz)


def tube(
    path: Sequence[Sequence[float]] | F64,
    radius: float | Sequence[float] | F64,
    n: int = 8,
    loop: bool = False,
    section: F64 | None = None,
) -> Part:
    """Round bar along a polyline (k, 3); the section is carried along without twisting.

    Args:
        path: (k, 3) points, no two neighbours equal.
        radius: one for all points, or (k,).
        n: corners of the section.
        loop: the path is closed.
        section: (m, 2) outline of unit size in place of the circle.
    """
    p = np.asarray(path, dtype=np.float64)
    step = np.roll(p, -1, axis=0) - p
    step /= np.linalg.norm(step, axis=1, keepdims=True)
    if not loop:
        step[-1] = step[-2]
    tangent = step + np.roll(step, 1, axis=0)
    if not loop:
        tangent[0] = step[0]
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.zeros(3)
    side[np.argmin(np.abs(tangent[0]))] = 1
    outline = ellipse(1, 1, n) if section is None else section
    rings = np.empty((len(p), len(outline), 3))
    for i, (t, r) in enumerate(zip(tangent, np.broadcast_to(radius, len(p)), strict=True)):
        side = side - t * (side @ t)
        side /= np.linalg.norm(side)
        rings[i] = p[i] + r * (outline[:, :1] * side + outline[:, 1:] * np.cross(t, side))
    return loft(rings, loop=True) if loop else loft(rings, p[0], p[-1])


def bar(a: Sequence[float], b: Sequence[float], r0: float, r1: float | None = None, n: int = 10) -> Part:
    """Straight round bar from a to b."""
    return tube([a, b], [r0, r0 if r1 is None else r1], n)


def arc(points: Sequence[Sequence[float]], n: int = 12) -> F64:
    """A smooth curve (n, 3) through the given points (Catmull-Rom)."""
    p = np.asarray(points, dtype=np.float64)
    padded = np.concatenate([[2 * p[0] - p[1]], p, [2 * p[-1] - p[-2]]])
    t = np.linspace(0, len(p) - 1, n)
    i = np.minimum(t.astype(np.int64), len(p) - 2)
    u = (t - i)[:, None]
    a, b, c, d = (padded[i + k] for k in range(4))
    return 0.5 * (2 * b + (c - a) * u + (2 * a - 5 * b + 4 * c - d) * u**2 + (3 * b - a - 3 * c + d) * u**3)


def rounded(points: Sequence[Sequence[float]], radius: float, n: int = 5, loop: bool = False) -> F64:
    """A polyline (k, 3) with its corners replaced by arcs that begin `radius` before them."""
    p = [np.asarray(q, dtype=np.float64) for q in points]
    out: list[F64] = []
    for i, q in enumerate(p):
        if not loop and i in (0, len(p) - 1):
            out.append(q)
            continue
        before, after = p[i - 1] - q, p[(i + 1) % len(p)] - q
        lb, la = np.linalg.norm(before), np.linalg.norm(after)
        r = min(radius, 0.45 * lb, 0.45 * la)
        a, b = q + before / lb * r, q + after / la * r
        out.extend((1 - t) ** 2 * a + 2 * t * (1 - t) * q + t**2 * b for t in np.linspace(0, 1, n))
    return np.array(out)


def sheet(grid: F64) -> Part:
    """Open surface without thickness through a grid of points (n, m, 3)."""
    n, m, _ = grid.shape
    index = np.arange(n * m).reshape(n, m)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, d), (a, d, c))])
    return Part(grid.reshape(-1, 3), faces)


def board(w: float, h: float, thick: float, n: int = 1, bow: float = 0, arch: float = 0) -> Part:
    """Upright board in the x-z plane, bowed backwards and its upper edge arched, n strips wide.

    Without thickness it is an open sheet.
    """
    x = np.linspace(-w / 2, w / 2, n + 1)
    u = 1 - (2 * x / w) ** 2
    y, top = bow * u, h + arch * u
    if thick == 0:
        z = np.linspace(0, 1, 2)[:, None]
        return sheet(np.stack(np.broadcast_arrays(x, y, z * top), axis=-1))
    corners = [(y - thick / 2, 0 * x), (y + thick / 2, 0 * x), (y + thick / 2, top), (y - thick / 2, top)]
    return solid(np.stack([np.stack([x, cy, cz], axis=-1) for cy, cz in corners], axis=1))


def subdivide(part: Part) -> Part:
    """Every triangle cut into four at the middles of its edges."""
    a, b, c = (part.vertices[part.faces[:, i]] for i in range(3))
    n, m = len(part.vertices), len(part.faces)
    ab, bc, ca = (n + k * m + np.arange(m) for k in range(3))
    i, j, k = part.faces.T
    faces = np.concatenate(
        [np.stack(t, axis=1) for t in ((i, ab, ca), (ab, j, bc), (ca, bc, k), (ab, bc, ca))]
    )
    return Part(np.concatenate([part.vertices, (a + b) / 2, (b + c) / 2, (c + a) / 2]), faces)
