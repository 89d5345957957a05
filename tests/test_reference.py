"""The pages of fields say what the models say: their text, their bounds, their defaults."""

from __future__ import annotations

import importlib
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

import pytest
import yaml
from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from ocnf_data.files.validation import Int, Strict
from ocnf_data.manifest import Manifest
from ocnf_model.training.settings import TrainSettings

ROOT = Path(__file__).parent.parent
PAGES = {"manifest.md": Manifest, "training.md": TrainSettings}


@pytest.fixture
def reference(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    return importlib.import_module("reference")


def rows(reference: ModuleType, page: str) -> Iterator[tuple[type[BaseModel], str, list[str]]]:
    """(model, field, the other cells) of every row in the committed page."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    for section in reference.sections(PAGES[page]):
        body = text.split(f"### {section.title}\n")[1].split("\n### ")[0]
        for line in re.findall(r"^\| (`\w+` \| .*) \|$", body, re.MULTILINE):
            name, *cells = re.split(r" \| ", line)
            yield section.model, name.strip("`"), cells


@pytest.mark.parametrize("page", PAGES)
def test_the_committed_page_is_what_the_models_give(reference: ModuleType, page: str) -> None:
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    assert reference.render(text) == text, "run `make docs`, and commit what it changes"


@pytest.mark.parametrize("page", PAGES)
def test_every_field_of_every_model_has_a_row(reference: ModuleType, page: str) -> None:
    """Counted from pydantic's own JSON schema, which knows nothing of the pages."""
    there = {(model, name) for model, name, _ in rows(reference, page)}
    schema = PAGES[page].model_json_schema(by_alias=True)
    wanted = {name for model in [schema, *schema["$defs"].values()] for name in model.get("properties", {})}
    assert {name for _, name in there} == wanted
    models = {model.__name__ for model, _ in there}
    assert {name for name, model in schema["$defs"].items() if "properties" in model} <= models


@pytest.mark.parametrize("page", PAGES)
def test_the_printed_default_is_the_default(reference: ModuleType, page: str) -> None:
    n = 0
    for model, name, (_, default, *_) in rows(reference, page):
        field = next(f for key, f in model.model_fields.items() if name in (key, f.alias))
        assert (default == "required") == field.is_required(), (model, name)
        if default.startswith("`"):
            written = yaml.safe_load(default.strip("`"))
            assert TypeAdapter(field.annotation).validate_python(written) == field.default, (model, name)
            n += 1
    assert n > 10


@pytest.mark.parametrize("page", PAGES)
def test_the_printed_range_is_what_is_accepted(reference: ModuleType, page: str) -> None:
    """Just outside each bound the field is refused, on the bound or just inside it is not."""
    n = 0
    for model, name, (kind, _, bounds, _) in rows(reference, page):
        listed = re.match(r"list of (lists of )?(\d+)?", kind)
        copies = int(listed[2] or 1) if listed else 0
        mapped = re.match(r"mapping of `(\w+)`", kind)
        step = 1 if "integer" in kind else 1e-9
        for word, text in re.findall(r"(from|above|to|below) ([\d.^e+-]+)", bounds):
            base, _, power = text.partition("^")
            bound = int(base) ** int(power) if power else float(base)
            bound = int(bound) if "integer" in kind else bound
            outward = -1 if word in ("from", "above") else 1
            inside, outside = {
                "from": (bound, bound - step), "to": (bound, bound + step * max(1, abs(bound)))}.get(
                word, (bound - outward * step * max(1, abs(bound)), bound))
            for value, allowed in ((inside, True), (outside, False)):
                given = [value] * copies if copies else {mapped[1]: value} if mapped else value
                given = [given] if listed and listed[1] else given
                assert refuses(model, name, given) != allowed, (model, name, value)
                n += 1
    assert n > 10


def refuses(model: type[BaseModel], name: str, value: Any) -> bool:
    try:
        model.model_validate({name: value})
    except ValidationError as error:
        return any(problem["loc"][:1] == (name,) and problem["type"] != "missing"
                   for problem in error.errors())
    return False


def test_a_new_field_needs_its_docstring_and_nothing_else(reference: ModuleType,
                                                          monkeypatch: pytest.MonkeyPatch) -> None:
    class Probe(Strict):
        """A model."""

        speed: Annotated[Int, Field(ge=2, lt=9)] = 3

    section = reference.Section((), "", Probe)
    with pytest.raises(SystemExit, match=r"Probe\.speed has no docstring"):
        reference.section_text(section)
    told = {"speed": "Of the camera, metres a second; None stands still."}
    monkeypatch.setattr(reference, "_docstrings", lambda kind: told)
    row = "`speed` | integer | `3` | from 2 below 9 | Of the camera, metres a second; `null` stands still."
    assert row in reference.section_text(section)
