"""Another number of epochs than a run was begun with."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ocnf_data.errors import OcnfError
from ocnf_data.files.records import canonical_json
from ocnf_data.files.storage import Store
from ocnf_model.training.record import SETTINGS
from ocnf_model.training.settings import TrainSettings
from ocnf_model.training.train_state import TrainState

CHANGED = "extended"
"""Field of a run's settings file: what was raised or lowered, and when."""


def changed_epochs(ours: TrainSettings, theirs: TrainSettings) -> dict[int, tuple[int, int]]:
    """The levels (from 0) that get other epochs: how many they had, and how many they have now.

    Empty where no number changes, or something else differs that the weights depend on.

    Args:
        ours: settings of this start.
        theirs: settings that the run was begun with.
    """
    if ours.levels != theirs.levels or _without_epochs(ours) != _without_epochs(theirs):
        return {}
    epochs = {level: (theirs.stage(level).epochs, ours.stage(level).epochs) for level in range(ours.levels)}
    return {level: (before, now) for level, (before, now) in epochs.items() if now != before}


def _without_epochs(settings: TrainSettings) -> dict[str, Any]:
    stages = [settings.stage(level).model_dump(mode="json") for level in range(settings.levels)]
    return {**settings.decisive(), "stages": [{**stage, "epochs": None} for stage in stages]}


def check_epochs(folder: Path, changed: Mapping[int, tuple[int, int]], state: TrainState) -> None:
    """Refuse what cannot be changed any more.

    The level in training and those after it may get more epochs, and so may the last one when all is done;
    and fewer, but not fewer than have begun. A learning rate that falls by a cosine goes on on the other
    curve: it rises at first where that is longer, and drops where it is shorter.

    Args:
        folder: folder of the run.
        changed: the levels that get other epochs, from `changed_epochs`.
        state: where the run is.

    Raises:
        OcnfError: a level that others were trained on already, or fewer epochs than have begun.
    """
    begun = {level: state.epoch + (state.step > 0) if level == state.level else 0 for level in changed}
    for level, (before, now) in changed.items():
        field = f"stages[{level}].epochs"
        if level < state.level:
            raise OcnfError("the level is finished: what comes after it builds on its weights, or the run "
                            "was finished by a version that did not keep what going on needs", code="misfit",
                            where=folder, field=field, found=now, expected=before,
                            fix="change the epochs of later levels only, or begin a new run")
        if now < begun[level]:
            raise OcnfError("fewer epochs than have begun", code="misfit", where=folder, field=field,
                            found=now, expected=f"at least {begun[level]}",
                            fix="take that many, or begin a new run")


def write_epochs(folder: Path, settings: TrainSettings, changed: Mapping[int, tuple[int, int]],
                 state: TrainState) -> None:
    """Write down that a run goes on for longer, or ends earlier.

    Args:
        folder: folder of the run.
        settings: settings of this start.
        changed: the levels that get other epochs, from `changed_epochs`.
        state: where the run is.
    """
    store = Store(folder)
    fields = json.loads(store.read_bytes(SETTINGS))
    done = {level: state.epoch if level == state.level else 0 for level in changed}
    fields[CHANGED] = [*fields.get(CHANGED, []), *(
        {"level": level + 1, "epochs": before, "raised_to" if now > before else "lowered_to": now,
         "done": done[level]} for level, (before, now) in changed.items())]
    fields["settings"] = settings.to_dict()
    store.put_bytes(SETTINGS, canonical_json(fields, indent=2))
