"""Write the tables of docs/manifest.md and docs/training.md from the models: fields, types, defaults, ranges.

    python tools/reference.py            # `make docs` runs it too; a test compares the pages with the models

A page says with `<!-- fields: module.Model -->` where the tables begin, and with `<!-- end of fields -->`
where they end; what stands between the two is replaced, everything else is written by hand. The
meaning of a field is the docstring below it, and so is that of an enumeration's member: a new field needs
nothing else.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import inspect
import re
import textwrap
import types
import typing
from collections.abc import Iterable, Iterator
from enum import StrEnum
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, NoReturn

import annotated_types
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from ocnf_data.manifest import SPLITS

DOCS = Path(__file__).parent.parent / "docs"
PAGES = ("manifest.md", "training.md")
_BLOCK = re.compile(r"(<!-- fields: (\S+)\.(\w+) -->\n).*?(<!-- end of fields -->)", re.DOTALL)
_HEADER = "| field | type | default | range | meaning |\n|---|---|---|---|---|\n"
_PLAIN = {int: "integer", float: "number", str: "text", bool: "`true` or `false`", type(None): "`null`"}


class Section(NamedTuple):
    """The fields of one model, and where in the file they stand (`inputs[]`, `camera`, ...)."""

    places: tuple[str, ...]
    kind: str
    model: type[BaseModel]

    @property
    def title(self) -> str:
        """The heading."""
        places = ", ".join(f"`{place}`" for place in self.places) or "Top level"
        return places + (f", kind `{self.kind}`" if self.kind else "")


def main() -> None:
    """Rewrite the pages that have changed."""
    plain = argparse.RawDescriptionHelpFormatter
    argparse.ArgumentParser(description=__doc__, formatter_class=plain).parse_args()
    for name in PAGES:
        page = DOCS / name
        page.write_text(render(page.read_text(encoding="utf-8")), encoding="utf-8")


def render(page: str) -> str:
    """A page with the tables that today's models give."""
    def tables(block: re.Match[str]) -> str:
        model = getattr(importlib.import_module(block[2]), block[3])
        return block[1] + "\n" + "\n".join(map(section_text, sections(model))) + block[4]

    return _BLOCK.sub(tables, page)


def sections(model: type[BaseModel]) -> list[Section]:
    """The model's own section, and then those of the models in its fields, each once with all its places."""
    found: dict[type[BaseModel], Section] = {}
    for section in _walk(model, (), ""):
        before = found.get(section.model, section)
        found[section.model] = before._replace(places=tuple(dict.fromkeys(before.places + section.places)))
    return list(found.values())


def _walk(model: type[BaseModel], places: tuple[str, ...], kind: str) -> Iterator[Section]:
    yield Section(places, kind, model)
    inner: dict[type[BaseModel], tuple[str, ...]] = {}
    for name, field in model.model_fields.items():
        for one in _models_in(field.annotation):
            below = (field.alias or name) + "[]" * (typing.get_origin(field.annotation) is tuple)
            # Of equal siblings (train, val, test) the first one's place is spelled out.
            start = f"{places[0]}." if places else ""
            inner[one] = (*inner.get(one, ()), start + below)
    for one, where in inner.items():
        tags = typing.get_args(one.model_fields["kind"].annotation) if "kind" in one.model_fields else (kind,)
        yield from _walk(one, where, tags[0])


def ranges(annotation: Any, metadata: Iterable[Any] = ()) -> list[str]:
    """The bounds of a field in words, such as `from 0 to 1`; one for each part of its type that has some."""
    words = []
    for bound in metadata:
        match bound:
            case annotated_types.Ge(ge=value):
                words.append(f"from {_number(value)}")
            case annotated_types.Gt(gt=value):
                words.append(f"above {_number(value)}")
            case annotated_types.Le(le=value):
                words.append(f"to {_number(value)}")
            case annotated_types.Lt(lt=value):
                words.append(f"below {_number(value)}")
            case annotated_types.MinLen(min_length=value):
                words.append(f"{value} or more characters")
    inner = [text for part in _parts(annotation) for text in ranges(*part)]
    return list(dict.fromkeys(text for text in [" ".join(words), *inner] if text))


def section_text(section: Section) -> str:
    """A section in Markdown."""
    model = section.model
    text = f"### {section.title}\n\n{_line(inspect.cleandoc(model.__doc__ or ''))}\n\n{_HEADER}"
    choices: dict[type[StrEnum], str] = {}
    for name, field in model.model_fields.items():
        shown = field.alias or name
        choices |= {leaf: shown for leaf in _leaves(field.annotation) if _is_a(leaf, StrEnum)}
        cells = (f"`{shown}`", _type(field.annotation), _default(field),
                 ", ".join(ranges(field.annotation, field.metadata)), _meaning(model, name, field))
        text += "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n"
    for enum, shown in choices.items():
        docs = _docstrings(enum)
        text += f"\nValues of `{shown}`:\n\n"
        text += "".join(f"- `{member.value}`: {_line(docs.get(member.name) or _missing(enum, member.name))}\n"
                        for member in enum)
    return text


def _meaning(model: type[BaseModel], name: str, field: FieldInfo) -> str:
    """The field's docstring; else, of a mapping, the first paragraph of its model's."""
    if text := _docstrings(model).get(name) or field.description:
        return re.sub(r"\bNone\b", "`null`", _line(text))
    if name == "kind":
        return "Says which kind it is."
    if name in SPLITS:
        return f"Of the split `{name}`."
    for inner in _models_in(field.annotation):
        return _line(inspect.cleandoc(inner.__doc__ or "").split("\n\n")[0])
    return _missing(model, name)


def _missing(kind: type, name: str) -> NoReturn:
    raise SystemExit(f"{kind.__module__}.{kind.__name__}.{name} has no docstring below it: write there "
                     "what it means, with the unit")


def _docstrings(kind: type) -> dict[str, str]:
    """The string below each attribute of a class and of its bases."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if not base.__module__.startswith("ocnf_"):
            continue
        body = typing.cast(ast.ClassDef, ast.parse(textwrap.dedent(inspect.getsource(base))).body[0]).body
        for line, below in pairwise(body):
            target = line.target if isinstance(line, ast.AnnAssign) else getattr(line, "targets", [None])[0]
            if isinstance(target, ast.Name) and isinstance(below, ast.Expr) \
                    and isinstance(below.value, ast.Constant) and isinstance(below.value.value, str):
                found[target.id] = inspect.cleandoc(below.value.value)
    return found


def _parts(annotation: Any) -> list[tuple[Any, list[Any]]]:
    """(type, metadata) of the types that an annotation is made of."""
    parts: list[tuple[Any, list[Any]]] = []
    for part in typing.get_args(annotation):
        if typing.get_origin(part) is Annotated:
            inner, *metadata = typing.get_args(part)
            flat = [fact for item in metadata
                    for fact in (item.metadata if isinstance(item, FieldInfo) else [item])]
            parts.append((inner, flat))
        elif typing.get_origin(annotation) is not Literal and part is not Ellipsis:
            parts.append((part, []))
    return parts


def _leaves(annotation: Any) -> Iterator[Any]:
    parts = _parts(annotation)
    if not parts:
        yield annotation
    for part, _ in parts:
        yield from _leaves(part)


def _is_a(kind: Any, base: type) -> bool:
    return isinstance(kind, type) and issubclass(kind, base)


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    return (kind for kind in _leaves(annotation) if _is_a(kind, BaseModel))


def _type(annotation: Any) -> str:
    origin, parts = typing.get_origin(annotation), [part for part, _ in _parts(annotation)]
    if origin is Literal:
        return " or ".join(f"`{value}`" for value in typing.get_args(annotation))
    if origin is tuple:
        several = {"text": "texts", "mapping": "mappings"}
        one = several.get(_type(parts[0]), _type(parts[0]))
        one += "s" * (one in ("integer", "number"))
        one = re.sub("^list of", "lists of", one)
        return f"list of {len(parts)} {one}" if len(parts) > 1 else f"list of {one}"
    if origin is dict:
        return f"mapping of {_type(parts[0])} to {_type(parts[1])}"
    if origin in (typing.Union, types.UnionType):
        return " or ".join(dict.fromkeys(map(_type, parts)))
    if _is_a(annotation, BaseModel):
        return "mapping"
    if _is_a(annotation, StrEnum):
        return " / ".join(f"`{member.value}`" for member in annotation)
    return _PLAIN[annotation]


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    value = field.default
    if isinstance(value, BaseModel):
        return f"`{_yaml(value)}`" if value.model_dump(exclude_defaults=True) else "its defaults"
    return f"`{_yaml(value)}`"


def _yaml(value: Any) -> str:
    """A value as one would write it on a line of YAML; of models only what differs from their defaults."""
    if isinstance(value, BaseModel):
        value = value.model_dump(exclude_defaults=True)
    if isinstance(value, dict):
        return "{" + ", ".join(f"{name}: {_yaml(one)}" for name, one in value.items()) + "}"
    if isinstance(value, tuple | list):
        return "[" + ", ".join(map(_yaml, value)) + "]"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return str(value) if isinstance(value, str) else _number(value)


def _number(value: Any) -> str:
    if isinstance(value, int) and value > 10**9 and value & (value - 1) == 0:
        return f"2^{value.bit_length() - 1}"
    return repr(int(value) if value == int(value) and abs(value) < 1e15 else value)


def _line(text: str) -> str:
    """A docstring on one line, as the cell of a table has to be."""
    return " ".join(line.strip() for line in text.splitlines() if line.strip())


if __name__ == "__main__":
    main()
