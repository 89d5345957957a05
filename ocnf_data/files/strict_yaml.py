"""YAML as configuration needs it: safe, without silent surprises, small."""

from __future__ import annotations

import os
import re
from collections.abc import Hashable
from pathlib import Path
from typing import Any

import yaml

from ocnf_data.errors import OcnfError
from ocnf_data.files.storage_errors import storage_errors

# A list of a hundred thousand mesh paths fits.
_MAX_BYTES = 16 * 2**20


# YAML 1.1, which PyYAML follows, reads 010 as eight and 1:30 as ninety; YAML 1.2 and people do not.
_AMBIGUOUS = re.compile(r"[-+]?(0[0-9_]+$|[0-9][0-9_]*:)")


class _StrictLoader(yaml.SafeLoader):
    """SafeLoader that refuses duplicate keys, aliases and 010, and reads 1e-3 as a number."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):  # nested, they make gigabytes out of a few lines
            event = self.peek_event()
            raise yaml.constructor.ConstructorError(
                None, None, "aliases (*name) are not supported: write the value out", event.start_mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[str] = set()
        for key_node, _ in node.value:
            key = str(self.construct_object(key_node, deep=True))
            if key in seen:  # YAML would let the last one win
                raise yaml.constructor.ConstructorError(
                    None, None, f"the field {key!r} is given twice", key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep)


    def construct_number(self, node: yaml.ScalarNode) -> int | float:
        """The number, unless YAML 1.1 and 1.2 read different ones."""
        if _AMBIGUOUS.match(node.value):
            raise yaml.constructor.ConstructorError(
                None, None, f"{node.value} is one number to YAML 1.1 and another to YAML 1.2: write it "
                "without a leading zero or a colon, or in quotes if it is text", node.start_mark)
        is_int = node.tag == "tag:yaml.org,2002:int"
        return self.construct_yaml_int(node) if is_int else self.construct_yaml_float(node)


for _kind in ("int", "float"):
    _StrictLoader.add_constructor(f"tag:yaml.org,2002:{_kind}", _StrictLoader.construct_number)
# YAML 1.1 takes 1e-3 for a string because it has no dot.
_StrictLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?[0-9]+[eE][-+]?[0-9]+$"), list("-+0123456789"))


class _TupleLoader(_StrictLoader):
    """Reads `!!python/tuple` too, and no other tag of Python's."""


def _tuple(loader: yaml.SafeLoader, node: yaml.SequenceNode) -> tuple[Any, ...]:
    return tuple(loader.construct_sequence(node))


_TupleLoader.add_constructor("tag:yaml.org,2002:python/tuple", _tuple)


def read_yaml(path: str | os.PathLike[str], *, tuples: bool = False) -> Any:
    """The one document in a YAML file.

    Args:
        path: path of the file.
        tuples: accept the tag `!!python/tuple`, which other programs write; it builds nothing but a tuple.

    Raises:
        OcnfError: missing, too large, not UTF-8, not YAML (with line and column), keys given twice, aliases,
            tags that would build Python objects.
    """
    path = Path(path)
    with storage_errors(path):
        size = path.stat().st_size
        if size > _MAX_BYTES:
            raise OcnfError("too large for YAML", code="too_large", where=path, found=f"{size} bytes",
                            expected=f"at most {_MAX_BYTES}")
        data = path.read_bytes()
    try:
        return yaml.load(data.decode("utf-8"), _TupleLoader if tuples else _StrictLoader)
    except UnicodeDecodeError as error:
        raise OcnfError("not UTF-8 text", where=path, found=str(error)) from error
    except RecursionError as error:
        raise OcnfError("nested too deeply", where=path) from error
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        place = None if mark is None else f"line {mark.line + 1}, column {mark.column + 1}"
        raise OcnfError(f"not valid YAML: {error.problem}", where=path, field=place) from error
    except (yaml.YAMLError, ValueError) as error:  # ValueError: a date such as 2026-99-99
        raise OcnfError(f"not valid YAML: {error}", where=path) from error
