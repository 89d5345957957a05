"""Settings that would change nothing together with others are refused when a run is begun.

A run that an earlier version began with some of them is gone on with.
"""

from __future__ import annotations

from collections.abc import Collection

from ocnf_data.errors import OcnfError
from ocnf_model.checkpoint import level_architecture, run_folder
from ocnf_model.network import Output
from ocnf_model.training.settings import MixturePart, TrainSettings

_OF_A_TSDF = ("loss", "wrong_sign", "unseen")
_OF_A_BLEND = ("blend_from", "blend_learns")


def refuse_without_effect(settings: TrainSettings, where: object = "the settings") -> None:
    """Refuse a setting that is not its default and would not be looked at.

    Args:
        settings: resolved.
        where: where they come from, for messages.

    Raises:
        OcnfError: code `manifest`, with the field; or the run to start from is missing or damaged.
    """
    own = settings.level_channels or ()
    if len(own) > settings.levels:
        raise no_effect("level_channels", f"there are {settings.levels} levels", where, own,
                        f"at most {settings.levels}, or more levels")
    if len(own) == settings.levels:
        _refuse(settings, ("channels",), "all levels have their own", f"fewer level_channels than "
                f"{settings.levels}", where)
    if settings.output is Output.OCCUPANCY:
        _refuse(settings, _OF_A_TSDF, "an occupancy has the binary cross entropy", "output: tsdf", where)
    if not settings.blend:
        _refuse(settings, _OF_A_BLEND, "there is no blend with plain fusion", "blend: true", where)
    elif settings.start is not None and level_architecture(run_folder(settings.start), 0).blend:
        # Levels that are not there begin with the blend of the level before, so none is new.
        _refuse(settings, ("blend_from",), f"{settings.start} has a blend, and keeps it",
                "a run to start from without one", where)


def refuse_idle_part(number: int, part: MixturePart, variants: Collection[str] | None,
                     reads_meshes: bool) -> None:
    """Refuse fields of a mixture's part that would not be looked at.

    Args:
        number: its place in the mixture.
        part: what the settings say of it.
        variants: names of the inputs of a manifest, whose variants are not drawn; None for a data set.
        reads_meshes: whether it is a manifest that reads mesh files.

    Raises:
        OcnfError: code `manifest`, with the field.
    """
    at = f"mixture[{number}]"
    if part.meshes is not None and (part.data is None or not reads_meshes):
        reason = "the part is what the command line names" if part.data is None else \
            "the part reads no mesh files"
        raise no_effect(f"{at}.meshes", reason, "the settings", part.meshes, "null", "leave it out")
    if variants is not None and part.variant is not None and part.variant not in variants:
        raise no_effect(f"{at}.variant", "the part is a manifest, and what is drawn of one has no variants",
                        "the settings", part.variant, "null", "leave it out")


def refuse_extra_channels(settings: TrainSettings, where: object = "the settings") -> None:
    """Refuse channels behind the encoding's, also those of a run to start from: data sets have none.

    Raises:
        OcnfError: code `manifest`.
    """
    if settings.extra_channels:
        raise OcnfError("only the frames of completion have some", code="manifest", where=where,
                        field="extra_channels", found=settings.extra_channels,
                        expected="0" if settings.start is None else "0, or no completion network as start",
                        fix="train completion with `ocnf-model complete train`")


def no_effect(name: str, reason: str, where: object, found: object, expected: object,
              fix: str | None = None) -> OcnfError:
    """The error for a setting that would not be looked at."""
    return OcnfError(f"it would have no effect: {reason}", code="manifest", where=where, field=name,
                     found=found, expected=expected, fix=fix)


def _refuse(settings: TrainSettings, names: tuple[str, ...], reason: str, remedy: str, where: object) -> None:
    for name in names:
        found, default = getattr(settings, name), TrainSettings.model_fields[name].default
        if found != default:
            raise no_effect(name, reason, where, found, f"{default}, or {remedy}")
