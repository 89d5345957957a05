"""What is compared: methods by name, each from a frame to occupied voxels."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ocnf_data.arrays import F32, Bool
from ocnf_model.completion.baselines import METHODS
from ocnf_model.completion.data import held_out
from ocnf_model.completion.forest import StructuredForest
from ocnf_model.completion.predict import CompletionNetwork, choose_threshold
from ocnf_model.completion.tabletop import Tabletop
from ocnf_model.completion.visible import Visible
from ocnf_model.completion.voxlets import list_frames

Completion = Callable[[Tabletop], Bool]
FOREST, OURS = "structured forest", "ours"


def forest_method(root: str) -> tuple[Completion, str]:
    """The structured forest, fitted to the training frames; its threshold is chosen on those held out.

    Returns:
        (the method: the forest's voxels and the visible band; a line that says what it was fitted to)
    """
    training, held = held_out(list_frames(root, "train"))
    forest = StructuredForest([frame.read() for frame in training])

    def probability(scene: Tabletop) -> F32:
        band = Visible.of(scene.view, scene.shape, scene.voxel).tsdf < 0
        return np.where(band, np.float32(1), forest.probability(scene))

    threshold, found = choose_threshold(probability, (frame.read() for frame in held))
    note = f"{FOREST}: fitted to {len(training)} frames, threshold {threshold} chosen on {len(held)} held " \
           f"out (IoU {found.iou:.3f} there)"
    return lambda scene: np.asarray(probability(scene) >= threshold), note


def methods_of(root: str, network: CompletionNetwork | None,
               forest: bool) -> tuple[dict[str, Completion], list[str]]:
    """The methods in the order of tables, and notes on them.

    Args:
        root: folder of the Voxlets data, whose training split the forest is fitted to.
        network: None to leave it out.
        forest: whether to fit one.
    """
    methods, notes = dict[str, Completion](METHODS), []
    if forest:
        methods[FOREST], note = forest_method(root)
        notes.append(note)
    if network is not None:
        methods[OURS] = network
        notes.append(f"{OURS}: {network.n_levels} levels, threshold {network.threshold}")
    return methods, notes
