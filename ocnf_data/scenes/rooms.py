"""Furnished rooms."""

from __future__ import annotations

from ocnf_data.scenes.place import Draft, settled, sized
from ocnf_data.shapes.draw import Draw
from ocnf_data.shapes.primitives import Part, box

_AGAINST_A_WALL = ("bed", "desk", "shelf", "sofa")
_ANYWHERE = ("chair", "table", "plant", "lamp", "chair", "sofa", "table")
_SMALL = ("mug", "bottle", "plant", "monitor", "lamp")
_THICK = 0.1  # metres, of walls and floor
_FREE = 0.05  # metres between furniture and walls


def room(draw: Draw, draft: Draft) -> Draft:
    """Floor, walls with a door's opening, perhaps a ceiling; furniture along the walls and in the middle."""
    w, d, h = draw.between(2.8, 5.5), draw.between(2.8, 5.0), draw.between(2.3, 2.9)
    draft.shell(box(w + 2 * _THICK, d + 2 * _THICK, _THICK).move(z=-_THICK), *_walls(draw, w, d, h))
    if draw.chance(0.4):
        draft.shell(box(w + 2 * _THICK, d + 2 * _THICK, _THICK).move(z=h))
    for _ in range(draw.count(2, 5)):
        _against_a_wall(draw, draft, w, d)
    for _ in range(draw.count(2, 6)):
        name = draw.pick(*_ANYWHERE)
        part = settled(draft.shape(draw, name).turn("z", draw.between(0, 360)))
        placed = draft.put(draw, part, name, (-w / 2 + _FREE, -d / 2 + _FREE), (w / 2 - _FREE, d / 2 - _FREE))
        if placed is not None and name == "table":
            _things_on(draw, draft, placed)
    _pictures(draw, draft, w, d, h)
    return draft


def _walls(draw: Draw, w: float, d: float, h: float) -> list[Part]:
    """Four walls around w x d; one of those along x has an opening for a door."""
    across = [box(_THICK, d, h).move(x=side * (w + _THICK) / 2) for side in (-1, 1)]
    door, height, side = draw.between(0.7, 1.0), draw.between(1.95, 2.15), draw.pick(-1, 1)
    left = draw.between(0.1, w - door - 0.1)  # of the opening, from the corner
    y = side * (d + _THICK) / 2
    beside = [box(left, _THICK, h).move(x=-w / 2 + left / 2, y=y),
              box(w - left - door, _THICK, h).move(x=(left + door) / 2, y=y),
              box(door, _THICK, h - height).move(x=-w / 2 + left + door / 2, y=y, z=height)]
    return [*across, box(w, _THICK, h).move(y=-y), *beside]


def _against_a_wall(draw: Draw, draft: Draft, w: float, d: float) -> None:
    """A piece with its back (positive y) to one of the walls."""
    name, side = draw.pick(*_AGAINST_A_WALL), draw.count(0, 3)
    part = settled(draft.shape(draw, name).turn("z", 90 * side))
    a, b = part.vertices.min(axis=0), part.vertices.max(axis=0)
    low, high = [-w / 2 + _FREE, -d / 2 + _FREE], [w / 2 - _FREE, d / 2 - _FREE]
    axis, far = (1, 0)[side % 2], side in (0, 3)  # the wall that the back faces: y, -x, -y, x
    if far:
        low[axis] = high[axis] - (b - a)[axis]
    else:
        high[axis] = low[axis] + (b - a)[axis]
    draft.put(draw, part, name, low, high)


def _things_on(draw: Draw, draft: Draft, table: Part) -> None:
    """Up to three small things on the middle of a table, whose highest point is its top."""
    a, b = table.vertices.min(axis=0), table.vertices.max(axis=0)
    a, b = a + 0.25 * (b - a) * (1, 1, 0), b - 0.25 * (b - a) * (1, 1, 0)
    for _ in range(draw.count(0, 3)):
        small = draw.pick(*_SMALL)
        thing = sized(draft.shape(draw, small).turn("z", draw.between(0, 360)), draw.between(0.1, 0.35))
        draft.put(draw, settled(thing), small, a[:2].tolist(), b[:2].tolist(), float(b[2]))


def _pictures(draw: Draw, draft: Draft, w: float, d: float, h: float) -> None:
    """Thin frames on the walls at x = -w / 2 and w / 2."""
    for _ in range(draw.count(0, 3)):
        side, wide, high = draw.pick(-1, 1), draw.between(0.3, 0.9), draw.between(0.3, 0.7)
        y, thick = draw.between(-d / 2 + wide / 2, d / 2 - wide / 2), draw.between(0.015, 0.04)
        z = draw.between(1.2, h - high - 0.1)
        frame = box(thick, wide, high).move(x=side * (w - thick) / 2, y=y, z=z)
        draft.stand(frame, "picture")
