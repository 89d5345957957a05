"""Which variant of the inputs is read, where one data set is trained on and another is validated with.

The variant that the settings name, or else the only one that is trained on, is read wherever there is one of
that name. A data set with a single other one is read in that; one with several others is refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_model.training.settings import TrainSettings


def variants_of(manifest: Mapping[str, Any], encoding: Encoding) -> list[str]:
    """Names of a manifest's inputs that have an encoding, in its order."""
    return [entry["name"] for entry in manifest["inputs"] if encoding in map(Encoding, entry["encodings"])]


def with_first_variant(settings: TrainSettings, manifest: Mapping[str, Any], where: str) -> TrainSettings:
    """The settings; where they name no variant, with the first of the manifest's that has the encoding.

    Raises:
        OcnfError: none has.
    """
    if settings.variant is not None:
        return settings
    if there := variants_of(manifest, settings.encoding):
        return _with(settings, there[0])
    raise OcnfError("no input has the encoding to validate with", code="missing", where=where, field="inputs",
                    expected=str(settings.encoding))


def refuse_unknown_variant(settings: TrainSettings, manifest: Mapping[str, Any], where: str) -> None:
    """Refuse an encoding or a variant that a manifest does not have, before anything is made of it.

    Raises:
        OcnfError: code `missing`, with those that it has.
    """
    there = variants_of(manifest, settings.encoding)
    if not there:
        encodings = {encoding: None for entry in manifest["inputs"] for encoding in entry["encodings"]}
        raise OcnfError("no input has the encoding", code="missing", where=where, field="encoding",
                        found=str(settings.encoding), expected=f"one of {', '.join(map(str, encodings))}")
    if settings.variant is not None and settings.variant not in there:
        raise OcnfError("no inputs have that name and encoding", code="missing", where=where,
                        field="variant", found=settings.variant, expected=f"one of {', '.join(there)}")


def with_training_variant(settings: TrainSettings, manifest: Mapping[str, Any], where: str,
                          validation: Mapping[str, Any]) -> TrainSettings:
    """The settings with the variant to train on, where another data set is validated with.

    Args:
        settings: settings of the run.
        manifest: manifest of the data set that is trained on.
        where: its name, for messages.
        validation: manifest of the one that is validated with.

    Raises:
        OcnfError: only the one that is validated with has the variant that they name.
    """
    wanted, here = settings.variant, variants_of(manifest, settings.encoding)
    if wanted is None:
        return _with(settings, here[0]) if len(here) == 1 else settings  # the loader names those there are
    there = variants_of(validation, settings.encoding)
    if not here or wanted in here or wanted not in there:
        return settings
    if len(here) == len(there) == 1:
        return _with(settings, here[0])
    raise _no_such(where, wanted, here)


def with_validation_variant(settings: TrainSettings, manifest: Mapping[str, Any], where: str,
                            training: Mapping[str, Any]) -> TrainSettings:
    """The settings with the variant to validate with, where another data set is trained on.

    Args:
        settings: settings of the run, with the variant to train on.
        manifest: manifest of the data set that is validated with.
        where: its name, for messages.
        training: manifest of the one that is trained on.

    Raises:
        OcnfError: it has several, and not the one that is trained on.
    """
    wanted, there = settings.variant, variants_of(manifest, settings.encoding)
    if wanted is None or not there or wanted in there:
        return settings
    if wanted not in variants_of(training, settings.encoding):
        return settings  # nobody has it: the loader says what there is
    if len(there) == 1:
        return _with(settings, there[0])
    raise _no_such(where, wanted, there)


def _with(settings: TrainSettings, variant: str) -> TrainSettings:
    return settings.model_copy(update={"variant": variant})


def _no_such(where: str, wanted: str, there: list[str]) -> OcnfError:
    return OcnfError("the data set has no inputs of that name and encoding", code="missing", where=where,
                     field="variant", found=wanted, expected=f"one of {', '.join(there)}",
                     fix="name a variant that both data sets have, or take data sets with a single one each")
