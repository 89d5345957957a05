"""The loaders' settings, checked: a bad one is named with what was found and what is allowed.

`where` is the name of the class whose argument it is.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from enum import StrEnum
from typing import TypeVar

from ocnf_data.errors import OcnfError

_Choice = TypeVar("_Choice", bound=StrEnum)
_LARGEST = 2**53
_SHARDS = "ShardDataset"


class OnError(StrEnum):
    """What becomes of a damaged sample."""

    RAISE = "raise"
    """The run stops, and names shard, key, member and offset."""
    SKIP = "skip"
    """It is left out and listed; another sample takes its place."""


def one_of(kind: type[_Choice], field: str, value: object, where: str = _SHARDS) -> _Choice:
    """The member of an enumeration that has this value, or OcnfError."""
    if isinstance(value, str) and value in list(kind):
        return kind(value)
    raise bad_setting("not one of the choices", field, value, ", ".join(kind), where)


def whole(field: str, value: object, least: int, where: str = _SHARDS) -> int:
    """An integer from `least` to 2^53 (a bool is none), or OcnfError."""
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= _LARGEST:
        raise bad_setting("not a number of that kind", field, value, f"an integer, at least {least}", where)
    return value


def flag(field: str, value: object, where: str = _SHARDS) -> bool:
    """True or False, or OcnfError; a text such as "no" would count as true."""
    if not isinstance(value, bool):
        raise bad_setting("neither true nor false", field, value, "True or False", where)
    return value


def fraction(field: str, value: object, where: str = _SHARDS) -> float:
    """A number from 0 to 1, or OcnfError."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= 1:
        raise bad_setting("not a share", field, value, "0 to 1", where)
    return float(value)


def names(field: str, value: object, where: str = _SHARDS) -> tuple[str, ...]:
    """One or more texts or paths, each once, or OcnfError; a single one may stand alone."""
    if isinstance(value, str | os.PathLike):
        value = [value]
    listed = list(value) if isinstance(value, Sequence) else []
    texts = tuple(str(os.fspath(item)) for item in listed if isinstance(item, str | os.PathLike))
    if not texts or len(texts) != len(listed) or len(set(texts)) != len(texts):
        raise bad_setting("not a list of names", field, value, "one or more, each once", where)
    return texts


def parse_resolutions(value: object, where: str = _SHARDS) -> tuple[int, ...]:
    """The resolutions, or OcnfError: one or more, each once, multiples of 8; a single one may stand alone."""
    listed = list(value) if isinstance(value, Sequence) and not isinstance(value, str) else [value]
    checked = tuple(whole("resolutions", resolution, 8, where) for resolution in listed)
    if not checked or len(set(checked)) != len(checked) or any(resolution % 8 for resolution in checked):
        raise bad_setting("not resolutions", "resolutions", value, "one or more multiples of 8, each once",
                          where)
    return checked


def parse_targets(value: object, resolutions: tuple[int, ...], where: str = _SHARDS) -> tuple[int, ...]:
    """Resolutions of the ground truth: all of `resolutions` (True), none (False), or some; else OcnfError."""
    if isinstance(value, bool):
        return resolutions if value else ()
    chosen = parse_resolutions(value, where)
    if unknown := set(chosen) - set(resolutions):
        raise bad_setting("no such resolution", "targets", min(unknown), f"some of {resolutions}", where)
    return chosen


def place_among_ranks(rank: int | None, world_size: int | None,
                      running: tuple[int, int] | None, where: str = _SHARDS) -> tuple[int, int]:
    """(rank, world size) of this process.

    Args:
        rank: rank given by the user together with the world size, or None.
        world_size: world size given by the user together with the rank, or None.
        running: rank and world size of torch.distributed, where it is initialised.
        where: the class that they are given to.

    Raises:
        OcnfError: one of `rank` and `world_size` is given alone; or RANK or WORLD_SIZE in the environment is
            no whole number, or WORLD_SIZE is above 1 and RANK is not set.
    """
    if (rank is None) != (world_size is None):
        field = "rank" if rank is None else "world_size"
        raise bad_setting("rank and world_size go together", field, None, "both, or neither", where)
    if rank is not None and world_size is not None:
        return rank, world_size
    if running is not None:
        return running
    rank, world_size = _from_environment("RANK", 0), _from_environment("WORLD_SIZE", 1)
    if world_size > 1 and not os.environ.get("RANK", "").strip():  # every process would be the first
        raise OcnfError("a number of processes without the number of this one", where="the environment",
                        field="RANK", found=None, expected=f"0 to {world_size - 1}, as WORLD_SIZE is "
                        f"{world_size}", fix="set both, or neither, or give rank and world_size")
    return rank, world_size


def _from_environment(name: str, default: int) -> int:
    text = os.environ.get(name, "").strip() or str(default)
    if not (text.isascii() and text.isdigit()):
        raise OcnfError("not a number", where="the environment", field=name, found=text,
                        expected="an integer")
    return int(text)


def bad_setting(what: str, field: str, found: object, expected: object, where: str = _SHARDS) -> OcnfError:
    """An error about an argument of a loader."""
    return OcnfError(what, where=where, field=field, found=repr(found), expected=expected)
