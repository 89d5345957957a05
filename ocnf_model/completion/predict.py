"""The trained network on a frame: probabilities of being occupied, and from where on that counts as so."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import torch

from ocnf_data.arrays import F32, Bool
from ocnf_data.errors import OcnfError
from ocnf_data.files.records import canonical_json
from ocnf_data.files.storage import Store
from ocnf_model.checkpoint import PRETRAINED, open_run, run_path
from ocnf_model.completion.encoding import CHANNELS
from ocnf_model.completion.sample import LEVELS, SHRINK, finer, input_octrees
from ocnf_model.completion.scores import Scores
from ocnf_model.completion.tabletop import Tabletop
from ocnf_model.completion.visible import Visible
from ocnf_model.devices import pick_device
from ocnf_model.network import Output
from ocnf_model.octree.batch import OctreeBatch

THRESHOLD = "threshold.json"
"""Name in a run's folder of the probability from which on a voxel counts as occupied."""
_CANDIDATES = np.round(np.arange(0.2, 0.71, 0.05), 2)


class CompletionNetwork:
    """A trained network, ready for frames.

    Args:
        run: folder of a run, or `pretrained` for the network that comes along.
        device: `auto`, `cpu`, `cuda`.
        levels: how many of the trained levels to use; None for all.

    Raises:
        OcnfError: there is no such run, or it is none of completion.
    """

    def __init__(self, run: str | Path, device: str = "auto", levels: int | None = None) -> None:
        folder = completion_folder(run)
        trained = open_run(folder, levels)
        self._network = trained.network
        if self._network.output is not Output.OCCUPANCY or self._network.in_channels != CHANNELS:
            raise OcnfError("the network is not for completion", code="misfit", where=folder, field="output",
                            found=f"{self._network.output}, {self._network.in_channels} channels in",
                            expected=f"{Output.OCCUPANCY}, {CHANNELS}",
                            fix="train one: ocnf-model complete train")
        self._device = pick_device(device)
        self._network.to(self._device)
        self.n_levels = len(trained.headers)
        self.threshold = read_threshold(folder)

    @torch.no_grad()
    def probability(self, scene: Tabletop, visible: Visible | None = None) -> F32:
        """(D, H, W) in [0, 1], interpolated to the scene's voxels."""
        visible = visible or Visible.of(scene.view, scene.shape, scene.voxel)
        octrees = input_octrees(scene, visible)[: self.n_levels]
        inputs = [OctreeBatch.from_grids([octree]).to(self._device) for octree in octrees]
        dense: F32 = self._network(inputs)[-1].to_dense()[0, 0].cpu().numpy()
        return finer(dense, scene.shape, SHRINK << (LEVELS - self.n_levels))

    def __call__(self, scene: Tabletop) -> Bool:
        """(D, H, W): whether occupied, by the run's threshold."""
        return np.asarray(self.probability(scene) >= self.threshold)


def completion_folder(run: str | Path) -> Path:
    """The folder of a run, or of the completion network that comes with the package."""
    return run_path(PRETRAINED) / "completion" if str(run) == PRETRAINED else run_path(run)


def read_threshold(folder: Path) -> float:
    """A run's threshold; 0.5 where none was chosen yet.

    Raises:
        OcnfError: the file is damaged.
    """
    file = folder / THRESHOLD
    if not file.is_file():
        return Output.OCCUPANCY.threshold
    try:
        value = json.loads(Store(folder).read_at_most(THRESHOLD, 2**16))["threshold"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise OcnfError("not a threshold", code="damaged", where=file, found=error) from error
    if not isinstance(value, float) or not 0 < value < 1:
        raise OcnfError("not a threshold", code="damaged", where=file, found=value, expected="0 to 1")
    return value


def write_threshold(folder: Path, value: float, scores: Scores) -> None:
    """Write down a threshold, and what it was chosen by."""
    fields = {"threshold": value, "validation": {"iou": scores.iou, "precision": scores.precision,
                                                 "recall": scores.recall}}
    Store(folder).put_bytes(THRESHOLD, canonical_json(fields, indent=2))


def choose_threshold(probability: Callable[[Tabletop], F32],
                     scenes: Iterable[Tabletop]) -> tuple[float, Scores]:
    """The candidate with the highest mean IoU on scenes, and its figures. Not for scenes of the test split.

    Args:
        probability: gives (D, H, W) of a scene.
        scenes: frames with ground truth; taken one after the other.
    """
    rows: list[list[Scores]] = [[] for _ in _CANDIDATES]
    for scene in scenes:
        values = probability(scene)
        judged = Visible.of(scene.view, scene.shape, scene.voxel).judged
        for found, threshold in zip(rows, _CANDIDATES, strict=True):
            found.append(Scores.of(scene.occupied, values >= threshold, judged))
    means = [Scores.mean(found) for found in rows]
    best = int(np.argmax([mean.iou for mean in means]))
    return float(_CANDIDATES[best]), means[best]
