"""Checkpoints: the weights of a level and what they are, in one file, read without running anything.

    RUN/level-1.safetensors     weights of the first level, of its best epoch; the header is JSON
    RUN/level-1.json            the same header, to look at; nothing reads it

Weights may be stored in half precision, which halves the file, and are read as single.

A later level was trained on the outputs of certain weights of the level before: its header names them by
checksum, so that levels of different runs, or of an unfinished mixture, are not put together.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import torch
from torch import Tensor

from ocnf_data.errors import OcnfError
from ocnf_data.files.records import canonical_json, sha256_hex
from ocnf_data.files.storage import Store
from ocnf_data.files.storage_errors import storage_errors
from ocnf_model.devices import Precision
from ocnf_model.header import Architecture, Header, TrainingData, parse_header
from ocnf_model.network import OctNetFusion
from ocnf_model.tensorfile import TensorKind, read_header, read_kinds, read_tensors, write_tensors

PRETRAINED: Final = "pretrained"
PRETRAINED_SCAN: Final = "pretrained-scan"
SHIPPED: Final = {PRETRAINED: Path(__file__).parent / "pretrained",
                  PRETRAINED_SCAN: Path(__file__).parent / "pretrained" / "scan"}
"""Names of the networks that come with the package, and their folders."""


@dataclass(frozen=True, eq=False)
class TrainedRun:
    """A run's best checkpoints.

    Attributes:
        path: the folder.
        network: the trained levels, in evaluation mode, on the CPU.
        headers: header of each level's checkpoint, coarse to fine.
    """

    path: Path
    network: OctNetFusion
    headers: tuple[Header, ...]

    @property
    def resolutions(self) -> list[int]:
        """Voxels along each axis of each level."""
        return [header.resolution for header in self.headers]

    @property
    def data(self) -> TrainingData:
        """What the last level was trained on."""
        return self.headers[-1].data

    def check_truncation(self, where: str, truncation_voxels: float) -> None:
        """Refuse data whose distances are cut elsewhere than those the network was trained on.

        Raises:
            OcnfError: code `misfit`.
        """
        expected = self.headers[0].data.truncation_voxels
        if abs(truncation_voxels - expected) >= 1e-3:
            raise OcnfError("the network was trained on something else", code="misfit", where=where,
                            field="truncation_voxels", found=truncation_voxels,
                            expected=f"{expected}, as in {self.path}")


def save_checkpoint(folder: Path, header: Header, weights: Mapping[str, Tensor]) -> None:
    """Write a level's checkpoint over the one before it."""
    write_tensors(checkpoint_path(folder, header.level), weights, header.to_dict())
    Store(folder).put_bytes(f"level-{header.level}.json", canonical_json(header.to_dict(), indent=2))


def load_level(folder: Path, network: OctNetFusion, level: int) -> Header:
    """Put a checkpoint's weights into a level (from 0) of a network.

    Raises:
        OcnfError: it is missing or damaged, of another schema, or does not fit the network.
    """
    path = checkpoint_path(folder, level + 1)
    # What comes with the package is checked by what installs it.
    weights, fields = read_tensors(path, note=folder not in SHIPPED.values())
    header = parse_header(path, fields)
    if header.level != level + 1:
        raise _misfit(path, "level", header.level, level + 1)
    own_architecture = Architecture.of(network)
    for field in Architecture.model_fields:
        found, expected = getattr(header.architecture, field), getattr(own_architecture, field)
        if found != expected:
            raise _misfit(path, field, found, expected)
    own = {name: TensorKind.of(tensor) for name, tensor in network.levels[level].state_dict().items()}
    _check_kinds(path, {name: TensorKind.of(tensor) for name, tensor in weights.items()}, own)
    for name, tensor in weights.items():
        if not tensor.isfinite().all():
            raise OcnfError("weights that are not finite", code="damaged", where=path, field=name)
    network.levels[level].load_state_dict(weights)
    return header


def level_architecture(folder: Path, level: int) -> Architecture:
    """What the checkpoint of a level (from 0) says that the network is.

    Raises:
        OcnfError: as `parse_header`.
    """
    path = checkpoint_path(folder, level + 1)
    return parse_header(path, read_header(path)).architecture


def open_run(path: str | Path, levels: int | None = None) -> TrainedRun:
    """The best checkpoint of every level that has one.

    Args:
        path: a run's folder, `pretrained` or `pretrained-scan`.
        levels: number of levels that are needed; None takes all that exist.

    Raises:
        OcnfError: none is there, or fewer than asked for; or they are damaged or do not go together.
    """
    folder = run_folder(path)
    there = trained_levels(folder)
    if there < (levels or 1):
        raise OcnfError("too few levels are trained", code="missing", where=folder, field="levels",
                        found=there, expected=f"at least {levels or 1}",
                        fix="go on with `ocnf-model train`, with the same arguments as before")
    levels = levels or there
    headers = [parse_header(file, read_header(file))
               for file in (checkpoint_path(folder, level) for level in range(1, levels + 1))]
    for level, header in enumerate(headers):  # before anything is allocated
        path = checkpoint_path(folder, level + 1)
        _check_kinds(path, read_kinds(path), header.architecture.kinds(level))
    network = headers[0].architecture.network(levels)
    for level, header in enumerate(headers):
        load_level(folder, network, level)
        if header.built_on != (checkpoint_sha256(folder, level) if level else None):
            raise OcnfError("the level was trained on other weights of the level before", code="misfit",
                            where=checkpoint_path(folder, level + 1), field="built_on",
                            fix="do not mix files of different runs, or replace them")
    if all(header.settings.get("precision") == Precision.BFLOAT16 for header in headers):
        network.precision = Precision.BFLOAT16
    return TrainedRun(folder, network.eval().requires_grad_(False), tuple(headers))


def load_run(path: str | Path, levels: int | None = None) -> OctNetFusion:
    """The network of `open_run`."""
    return open_run(path, levels).network


def run_path(path: str | Path) -> Path:
    """The folder of a run, existing or not; for a name of `SHIPPED`, the checkpoints that come along."""
    return SHIPPED.get(str(path)) or Path(path).expanduser()


def run_folder(path: str | Path) -> Path:
    """The folder of a run, or of the checkpoints that come with the package.

    Raises:
        OcnfError: there is no such folder.
    """
    folder = run_path(path)
    if str(path) not in SHIPPED:
        if not folder.is_dir():
            raise OcnfError("no such run", code="missing", where=folder,
                            expected=f"a folder made by `ocnf-model train`, {' or '.join(SHIPPED)}")
    elif not checkpoint_path(folder, 1).is_file():
        raise OcnfError("this version comes without pretrained weights", code="missing", where=path,
                        fix="train some: ocnf-model train DATA --out RUN")
    return folder


def trained_levels(folder: Path) -> int:
    """How many levels, from the first on, have a checkpoint."""
    level = 0
    while checkpoint_path(folder, level + 1).is_file():
        level += 1
    return level


def checkpoint_path(folder: Path, level: int) -> Path:
    """The file of a level (from 1)."""
    return folder / f"level-{level}.safetensors"


def checkpoint_sha256(folder: Path, level: int) -> str:
    """Checksum of the file of a level (from 1)."""
    path = checkpoint_path(folder, level)
    with storage_errors(path):
        return sha256_hex(path.read_bytes())


def torch_version() -> str:
    """The version of PyTorch, as headers hold it."""
    return str(torch.__version__)


def _check_kinds(path: Path, found: Mapping[str, TensorKind], expected: Mapping[str, TensorKind]) -> None:
    """Refuse tensors of other names, dtypes or shapes than the network's; F16 may stand for F32."""
    if missing := sorted(expected.keys() ^ found.keys()):
        raise _misfit(path, missing[0], "there" if missing[0] in found else "nothing",
                      f"the tensors {', '.join(expected)}")
    for name, kind in found.items():
        wanted = expected[name]
        halved = kind.dtype == "F16" and wanted.dtype == "F32"
        if kind.shape != wanted.shape or (kind.dtype != wanted.dtype and not halved):
            raise _misfit(path, name, f"{kind.dtype} {kind.shape}", f"{wanted.dtype} {wanted.shape}")


def _misfit(path: Path, field: str, found: object, expected: object) -> OcnfError:
    return OcnfError("the checkpoint does not fit the network", code="misfit", where=path, field=field,
                     found=_shown(found), expected=_shown(expected))


def _shown(value: object) -> object:
    return "null" if value is None else value
