"""Tables with things on them."""

from __future__ import annotations

from ocnf_data.scenes.place import Draft, settled, sized
from ocnf_data.shapes import CATEGORIES
from ocnf_data.shapes.draw import Draw
from ocnf_data.shapes.primitives import Part, bevel_box, box, cushion, frustum

# The solids came later; a scene of a seed stays what it was, and has solids of its own.
_THINGS = tuple(name for name in CATEGORIES if name not in ("ball", "block", "boulder"))
_EDGE = 0.03  # metres of the table's edge that stay free


def tabletop(draw: Draw, draft: Draft) -> Draft:
    """A table's top with three to nine things on it, some of them lying."""
    w, d = draw.between(0.7, 1.3), draw.between(0.6, 0.9)
    draft.shell(box(w, d, 0.03).move(z=-0.03))
    for _ in range(draw.count(3, 9)):
        thing, name = _thing(draw, draft)
        if draw.chance(0.25):
            thing = thing.turn(draw.pick("x", "y"), draw.pick(-90, 90))
        thing = settled(thing.turn("z", draw.between(0, 360)))
        draft.put(draw, thing, name, (-w / 2 + _EDGE, -d / 2 + _EDGE), (w / 2 - _EDGE, d / 2 - _EDGE))
    return draft


def _thing(draw: Draw, draft: Draft) -> tuple[Part, str]:
    """(part, name)."""
    if draw.chance(0.3):
        a, b, c = (draw.between(0.05, 0.25) for _ in range(3))
        return draw.pick(box(a, b, c), bevel_box(a, b, c, 0.01), frustum(a / 2, b / 2, c, 24),
                         cushion(a, b, c)), "solid"
    name = draw.pick(*_THINGS)
    longest = draw.between(0.08, 0.25) if name == "mug" else draw.between(0.12, 0.4)
    return sized(draft.shape(draw, name), longest), name
