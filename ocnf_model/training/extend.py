"""More epochs than a run was begun with."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ocnf_data.errors import OcnfError
from ocnf_data.files.records import canonical_json
from ocnf_data.files.storage import Store
from ocnf_model.training.settings import TrainSettings
from ocnf_model.training.train_state import TrainState

EXTENDED = "extended"
"""Field of a run's settings file: what was raised, when. Settings are always those of the last start."""


def raised_epochs(ours: TrainSettings, theirs: TrainSettings) -> dict[int, tuple[int, int]]:
    """The levels (from 0) that get more epochs: how many they had, and how many they have now.

    Empty where nothing is raised, a level gets fewer, or something else differs that the weights depend on.

    Args:
        ours: of this start.
        theirs: that the run was begun with.
    """
    if ours.levels != theirs.levels or _without_epochs(ours) != _without_epochs(theirs):
        return {}
    epochs = {level: (theirs.stage(level).epochs, ours.stage(level).epochs) for level in range(ours.levels)}
    if any(now < before for before, now in epochs.values()):
        return {}
    return {level: (before, now) for level, (before, now) in epochs.items() if now > before}


def _without_epochs(settings: TrainSettings) -> dict[str, Any]:
    stages = [settings.stage(level).model_dump(mode="json") for level in range(settings.levels)]
    return {**settings.decisive(), "stages": [{**stage, "epochs": None} for stage in stages]}


def extend(folder: Path, name: str, settings: TrainSettings, raised: Mapping[int, tuple[int, int]],
           state: TrainState) -> None:
    """Write down that a run goes on for longer.

    The level in training and those after it may get more epochs, and so may the last one when all is done. A
    learning rate that falls by a cosine goes on on the longer curve, so that it rises at first.

    Args:
        folder: of the run.
        name: of its settings file.
        settings: of this start.
        raised: as `raised_epochs` has it.
        state: where the run is.

    Raises:
        OcnfError: a level that others were trained on already.
    """
    for level, (before, now) in raised.items():
        if level < state.level:
            raise OcnfError("the level is finished: what comes after it builds on its weights, or the run "
                            "was finished by a version that did not keep what going on needs", code="misfit",
                            where=folder, field=f"stages[{level}].epochs", found=now, expected=before,
                            fix="raise the epochs of later levels only, or begin a new run")
    store = Store(folder)
    fields = json.loads(store.read_bytes(name))
    done = {level: state.epoch if level == state.level else 0 for level in raised}
    fields[EXTENDED] = [*fields.get(EXTENDED, []), *(
        {"level": level + 1, "epochs": before, "raised_to": now, "done": done[level]}
        for level, (before, now) in raised.items())]
    fields["settings"] = settings.to_dict()
    store.put_bytes(name, canonical_json(fields, indent=2))
