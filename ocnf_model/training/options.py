"""Settings from a file and from the command line's options."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ocnf_data.errors import OcnfError
from ocnf_model.training.effects import no_effect
from ocnf_model.training.settings import TrainSettings, load_settings, read_settings


def merge_options(file: Path | None, options: Mapping[str, Any], stage_options: Mapping[str, str | None],
                  channels: str | None = None) -> TrainSettings:
    """The settings of a file, or the defaults, with what was given on the command line put over them.

    Args:
        file: YAML or JSON, or None.
        options: fields of `TrainSettings`; None where not given.
        stage_options: fields of `Stage`, each a list such as `50,25`, for the levels from the first on, of
            which the last one holds for all that follow; None where not given.
        channels: channels of the three resolutions within a level, such as `16,32,64`; None where not given.

    Raises:
        OcnfError: a field that is unknown or impossible, by name.
    """
    where = "the command line" if file is None else file
    fields: dict[str, Any] = {} if file is None else load_settings(file)
    fields |= {name: value for name, value in options.items() if value is not None}
    if channels is not None:
        fields["channels"] = parse_list("channels", channels)
    lists: dict[str, list[Any]] = {
        name: [part.strip() for part in text.split(",")] if name == "decay" else parse_list(name, text)
        for name, text in stage_options.items() if text is not None}
    settings = read_settings(fields, where)
    if not lists:
        return settings
    n_stages = max(len(settings.stages), *map(len, lists.values()))
    stages = [settings.stage(level).model_dump()
              | {name: values[min(level, len(values) - 1)] for name, values in lists.items()}
              for level in range(n_stages)]
    return read_settings({**fields, "stages": stages}, where)


def refuse_long_lists(levels: int, file: Path | None, stage_options: Mapping[str, str | None],
                      shortened: bool) -> None:
    """Refuse what is written down for more levels than there are; where a run is begun.

    Args:
        levels: how many there are.
        file: as for `merge_options`.
        stage_options: as for `merge_options`.
        shortened: whether the command line says how many levels; a file may have stages for more.

    Raises:
        OcnfError: code `manifest`, with the list.
    """
    lengths = {f"--{name.replace('_', '-')}": len(text.split(","))
               for name, text in stage_options.items() if text is not None}
    if file is not None and not shortened:
        lengths["stages"] = len(load_settings(file).get("stages", ()))
    for name, length in lengths.items():
        if length > levels:
            where = file if name == "stages" else "the command line"
            raise no_effect(name, f"there {'is 1 level' if levels == 1 else f'are {levels} levels'}",
                            where, f"{length} entries", f"at most {levels}, or more levels")


def parse_list(name: str, text: str) -> list[int | float]:
    """Whole and other numbers from a list such as `50,25`."""
    try:
        return [int(part) if part.strip().isdigit() else float(part) for part in text.split(",")]
    except ValueError:
        raise OcnfError("not a list of numbers", where="the command line", field=name, found=repr(text),
                        expected="such as 50,25,25") from None
