"""What a run is, in RUN/settings.json: written when it is begun, compared whenever it goes on.

    {"schema": 1,
     "settings": all settings, resolved,
     "data": what the manifest says of the data set, and its checksum,
     "validation": checksum of the data set that it is validated with,
     "start": SHA-256 of the checkpoint of each level that begins with the weights of another run,
     "apart": true where samples that are mixed are drawn apart, see `draws_apart`,
     "extended": epochs that were changed since, see `epochs`}

Versions before wrote no `validation`, no `start` and no `apart`: what is missing is not compared.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ocnf_data.errors import OcnfError
from ocnf_data.files.records import Sha256, canonical_json
from ocnf_data.files.storage import Store
from ocnf_data.files.validation import Strict, validate
from ocnf_model.header import TrainingData
from ocnf_model.training.settings import TrainSettings, read_settings, setting_difference

SETTINGS = "settings.json"
VALIDATION = "validation"
"""Folder in a run of what a manifest's validation samples were made into."""
SAMPLES = "samples"
"""Folder in a run of frames that were made into octrees (see `completion`)."""
_SCHEMA = 1
_MAX_SETTINGS = 16 * 2**20  # bytes


class _Beside(Strict):
    """What there is beside the settings and the data set."""

    validation: Sha256 | None = None
    start: tuple[Sha256, ...] | None = None
    apart: bool = False


@dataclass(frozen=True)
class RunRecord:
    """What a run was begun with.

    Attributes:
        settings: resolved, with the epochs that it has now.
        data: the data set that it is trained on.
        validation: checksum of the data set that it is validated with; None where a version began it that did
            not write it.
        start: SHA-256 of the checkpoints that its levels begin with, from the first level on; None where a
            version began it that did not write them, or where it starts from no run.
        apart: whether its samples are drawn as `draws_apart` says; not where nothing is mixed.
    """

    settings: TrainSettings
    data: TrainingData
    validation: str | None = None
    start: tuple[str, ...] | None = None
    apart: bool = False

    def to_dict(self) -> dict[str, Any]:
        """JSON values."""
        sums = {"validation": self.validation, "start": None if self.start is None else list(self.start)}
        return {"schema": _SCHEMA, "settings": self.settings.to_dict(),
                "data": self.data.model_dump(mode="json"),
                **{name: value for name, value in sums.items() if value is not None},
                **({"apart": True} if self.apart else {})}


def is_begun(folder: Path) -> bool:
    """Whether the folder is a run's."""
    return Store(folder).exists(SETTINGS)


def write_record(folder: Path, record: RunRecord) -> None:
    """Write down what a run is that begins."""
    Store(folder).put_bytes(SETTINGS, canonical_json(record.to_dict(), indent=2))


def read_record(folder: Path) -> RunRecord:
    """What a run's folder says it is.

    Raises:
        OcnfError: it is missing, damaged or of another schema.
    """
    where = Store(folder).where(SETTINGS)
    try:
        fields = json.loads(Store(folder).read_at_most(SETTINGS, _MAX_SETTINGS))
    except (ValueError, RecursionError) as error:
        raise OcnfError("not JSON", code="damaged", where=where, found=error) from error
    if not isinstance(fields, dict) or fields.get("schema") != _SCHEMA:
        raise OcnfError("not the settings of a run of this version", code="schema", where=where)
    beside = {name: fields[name] for name in _Beside.model_fields if name in fields}
    return RunRecord(read_settings(fields.get("settings"), where),
                     validate(TrainingData, fields.get("data"), where),
                     **dict(validate(_Beside, beside, where)))


def draws_apart(folder: Path) -> bool:
    """Whether the parts of a run's mixture have seeds of their own, and what comes again in an epoch is new.

    A run that an earlier version began goes on without either, as it was begun: its parts share one seed, and
    a sample that comes again is the same.
    """
    return not is_begun(folder) or read_record(folder).apart


def refuse_strangers(folder: Path) -> None:
    """Refuse a folder that is no run and holds anything but what `prepare` made before it was stopped."""
    store = Store(folder)
    if store.exists(SETTINGS):
        return
    strangers = [name for name in store.list()
                 if name != ".lock" and not name.startswith((f"{VALIDATION}/", f"{SAMPLES}/"))]
    if strangers:
        raise OcnfError("the folder is not empty, and not a run", code="occupied", where=store.url,
                        found=strangers[0], fix="name a new folder: nothing is overwritten")


def refuse_another_run(folder: Path, ours: RunRecord, begun: RunRecord, but_epochs: bool) -> None:
    """Refuse to go on with a run that was begun with something else.

    Args:
        folder: folder of the run.
        ours: what this start was asked for.
        begun: what the run was begun with.
        but_epochs: the settings are known to differ in numbers of epochs, and in nothing else that counts.

    Raises:
        OcnfError: code `misfit`; the first field that differs, with both values.
    """
    if not but_epochs and (found := setting_difference(ours.settings, begun.settings)):
        field, mine, theirs = found
        raise OcnfError("the run was begun with other settings", code="misfit", where=folder, field=field,
                        found=mine, expected=theirs, fix="pass the same settings, or name a new folder")
    if ours.data.checksum != begun.data.checksum:
        raise OcnfError("the run was begun on another data set", code="misfit", where=folder, field="data",
                        found=f"{ours.data.name} {ours.data.checksum[:12]}",
                        expected=f"{begun.data.name} {begun.data.checksum[:12]}",
                        fix="pass the same data set, or name a new folder")
    if begun.validation is not None and ours.validation != begun.validation:
        # Which epoch is best is told by comparing them: all have to be measured on the same samples.
        raise OcnfError("the run is validated with another data set", code="misfit", where=folder,
                        field="validation", found=str(ours.validation)[:12], expected=begun.validation[:12],
                        fix="pass the same --val, or without it the same data set, or name a new folder")
