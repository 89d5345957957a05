"""What differs from the paper in data and budget, a sentence each, to stand above a table."""

from __future__ import annotations

import os
import platform
from collections import Counter
from collections.abc import Iterator, Sequence

from ocnf_data.manifest import Entry
from ocnf_model.tables.budget import PAPER_RESOLUTIONS, Budget
from ocnf_model.tables.schema import PAPER_CATEGORIES, Quantity, TableSpec
from ocnf_model.training.settings import FREE_TO_CHANGE, TrainSettings

_TOLD_ELSEWHERE = FREE_TO_CHANGE | {"levels", "resolutions", "encoding", "variant", "categories", "stages"}


def differences(table: TableSpec, budget: Budget, entries: Sequence[Entry], device: str) -> list[str]:
    """The paper's protocol, ours, and what else is to be known.

    Args:
        table: the table.
        budget: what was spent.
        entries: the meshes that the budget took.
        device: the machine that it ran on, in words.
    """
    counts = Counter(entry.split for entry in entries)
    epochs = ", ".join(map(str, budget.epochs))
    grids = ", ".join(f"{resolution}³" for resolution in budget.resolutions)
    what, whose = ("sets of frames", "scans") if budget.of_scans else ("meshes", "categories")
    found = [
        table.protocol,
        f"Here: {counts['train']} {what} for training, {counts['val']} for validation and {counts['test']} "
        f"for testing, of {len(budget.categories)} {whose} ({', '.join(budget.categories)}); {grids}; "
        f"{epochs} epochs.",
        *_settings(budget.settings)]
    found += [f"The folder {folder} takes the place of the paper's category {category}."
              for category, folder in budget.stand_ins.items()]
    strangers = sorted(set(budget.categories) - set(PAPER_CATEGORIES) - set(budget.stand_ins.values()))
    if strangers and not budget.of_scans:
        found.append(f"Not among the paper's categories, as far as they are known: {', '.join(strangers)}.")
    if budget.resolutions != PAPER_RESOLUTIONS[: len(budget.resolutions)]:
        found.append(f"The rows stand for the levels: {grids} here, for the paper's 64³, 128³, 256³.")
    elif len(budget.resolutions) < len(PAPER_RESOLUTIONS):
        found.append(f"Figures here end at {budget.resolutions[-1]}³"
                     + ("; a table of one resolution has them there, where the paper's are at 256³."
                        if all(row.level is None for row in table.rows) else "."))
    found.append(f"TV-L1's weight is chosen on {min(budget.weight_models, counts['val'])} of the {what} for "
                 "validation, for each input and resolution; the paper says cross-validation.")
    if table.quantity is Quantity.SECONDS:
        found.append(f"Run on: {device}.")
    return [*found, *table.remarks]


def _settings(settings: TrainSettings) -> Iterator[str]:
    """Settings of training that are not the paper's."""
    paper, changed = TrainSettings(), []
    for name in TrainSettings.model_fields:
        if name not in _TOLD_ELSEWHERE and getattr(settings, name) != getattr(paper, name):
            changed.append(f"{name} {getattr(settings, name)}")
    for level in range(settings.levels):
        ours, theirs = settings.stage(level), paper.stage(level)
        other = [f"{name} {getattr(ours, name)}" for name in type(ours).model_fields
                 if name != "epochs" and getattr(ours, name) != getattr(theirs, name)]
        if other:
            changed.append(f"level {level + 1} with {', '.join(other)}")
    if changed:
        yield f"Training settings that are not the paper's: {'; '.join(changed)}."


def machine(device: str) -> str:
    """The machine in words: its processor, how many threads are used, and the device that was asked for."""
    import torch

    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    if device.startswith("cuda"):
        return torch.cuda.get_device_name(device)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"CPU ({platform.machine()}), {cores} cores, {torch.get_num_threads()} threads"
