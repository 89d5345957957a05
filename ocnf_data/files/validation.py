"""Typed values whose errors say field, value, and what is allowed: their base, and the one translator."""

from __future__ import annotations

import difflib
import re
import reprlib
import typing
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails, PydanticCustomError

from ocnf_data.errors import OcnfError

_T = TypeVar("_T")
M = TypeVar("M", bound=BaseModel)

# Strict: YAML knows numbers from strings and truth values, and `views: true` is a slip, not 1.
Int = Annotated[int, Field(strict=True)]
Positive = Annotated[int, Field(strict=True, ge=1)]
Real = Annotated[float, Field(strict=True, allow_inf_nan=False)]

_REPR = reprlib.Repr()
_REPR.maxstring = _REPR.maxother = 80
_REPR.maxlist, _REPR.maxdict = 12, 8


# A damaged file may have thousands of wrong fields.
_MOST_PROBLEMS = 20
_ORDERS = re.compile(r"(Input should be|(Data|Dictionary|List|Tuple|String|Value) should have) ")


class Strict(BaseModel):
    """Base of all configuration and of all records: immutable, and nothing in it is ignored."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True)


def refused(
    what: str, *, found: object = None, expected: str | None = None, at: str = ""
) -> PydanticCustomError:
    """The error for a validator to raise.

    Args:
        what: what is wrong, as a clause.
        found: the offending value, where it is only a part of the field's.
        expected: what is allowed.
        at: place below the field, such as `[6]` or `.path`.
    """
    context = {"what": what, "expected": expected, "at": at, "part": found is not None, "found": found}
    return PydanticCustomError("refused", "{what}", context)


def refuse_repeats(names: Sequence[str], at: str = "", after: str = "") -> None:
    """Raise `refused` at `at[i]after` for the first name that was there before."""
    for i, name in enumerate(names):
        if name in names[:i]:
            raise refused("listed twice", at=f"{at}[{i}]{after}", found=name,
                          expected=f"each once (it is also number {names.index(name)}, counted from 0)")


def _some(value: tuple[_T, ...]) -> tuple[_T, ...]:
    if not value:
        raise refused("the list is empty", found=[], expected="at least one")
    return value


NotEmpty = AfterValidator(_some)
"""Refuses the empty tuple. (`min_length` would report it whenever an item is refused.)"""


def validate(model: type[M], data: Any, where: object) -> M:
    """`data` as a `model`.

    Raises:
        OcnfError: (code `manifest`) every field that is wrong, in one message that begins with `where`.
    """
    if not isinstance(data, Mapping):
        raise OcnfError("not a mapping of fields to values", code="manifest", where=where,
                        found=_REPR.repr(data), expected=f"the fields {', '.join(_field_names(model))}")
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise translate(error, model, where, "manifest") from None
    except RecursionError as error:
        raise OcnfError("nested too deeply", code="manifest", where=where) from error


def translate(error: ValidationError, model: type[BaseModel], where: object, code: str) -> OcnfError:
    """The OcnfError that says what pydantic found wrong with a `model`, up to 20 fields in one message."""
    details = error.errors(include_url=False)
    problems = [_problem(model, detail) for detail in details[:_MOST_PROBLEMS]]
    if len(details) == 1:
        return OcnfError(code=code, where=where, **problems[0])
    lines = "".join(f"\n  {OcnfError(**problem)}" for problem in problems)
    more = f"\n  and {len(details) - len(problems)} more" if len(details) > len(problems) else ""
    return OcnfError(f"{len(details)} fields are wrong:{lines}{more}", code=code, where=where)


def _problem(model: type[BaseModel], detail: ErrorDetails) -> dict[str, Any]:
    """The arguments of the OcnfError for one of pydantic's."""
    context: dict[str, Any] = detail.get("ctx", {})
    field, owners = _locate(model, detail["loc"])
    found: str | None = _REPR.repr(detail["input"])
    match detail["type"]:
        case "refused":
            if context["part"]:
                found = _REPR.repr(context["found"])
            elif isinstance(detail["input"], Mapping):  # fields that do not fit together: `what` says which
                found = None
            return {"what": context["what"], "field": field + context["at"], "found": found,
                    "expected": context["expected"]}
        case "extra_forbidden":
            known = [name for owner in owners for name in _field_names(owner)]
            name = str(detail["loc"][-1])
            near = difflib.get_close_matches(name.lower(), known, n=1, cutoff=0.5)
            return {"what": "unknown field", "field": field, "expected": f"one of {', '.join(known)}",
                    "fix": f"perhaps you mean {near[0]}" if near else None}
        case "missing":
            return {"what": "the field is missing", "field": field}
        case "union_tag_invalid":
            return {"what": "the value is not allowed", "field": f"{field}.kind",
                    "found": repr(context["tag"]), "expected": f"one of {context['expected_tags']}"}
        case "union_tag_not_found":
            return {"what": "the field is missing", "field": f"{field}.kind"}
        case "json_invalid":
            return {"what": f"not JSON: {context['error']}"}
        case "value_error":  # raised by a validator that compares several fields, and names them
            return {"what": str(context["error"]), "field": field}
        case _:
            expected = _ORDERS.sub("", detail["msg"]).replace("a valid tuple", "a list")
            expected = expected.replace("String should match", "text that matches")
            return {"what": "the value is not allowed", "field": field, "found": found, "expected": expected}


def _locate(model: type[BaseModel], location: tuple[int | str, ...]) -> tuple[str, list[type[BaseModel]]]:
    """The field's path as one would write it, and the models whose field its last part is (or should be).

    Pydantic puts the tag of a union into the path (`source.shapes.counts`); it is left out here.
    """
    path = ""
    owners: list[type[BaseModel]] = [model]
    inside: list[type[BaseModel]] = [model]
    for part in location:
        if isinstance(part, int):
            path += f"[{part}]"
            continue
        tagged = [m for m in inside if part in _tags(m)]
        if tagged and not any(part in _field_names(m) for m in inside):
            inside = tagged
            continue
        path += f".{part}" if path else part
        owners = inside
        inside = [m for owner in owners for m in _models_in(_annotation(owner, part))]
    return path, owners


def _field_names(model: type[BaseModel]) -> list[str]:
    return [field.alias or name for name, field in model.model_fields.items()]


def _annotation(model: type[BaseModel], field_name: str) -> Any:
    for name, field in model.model_fields.items():
        if field_name in (name, field.alias):
            return field.annotation
    return None


def _tags(model: type[BaseModel]) -> tuple[Any, ...]:
    return typing.get_args(_annotation(model, "kind"))


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in typing.get_args(annotation):
        yield from _models_in(argument)
