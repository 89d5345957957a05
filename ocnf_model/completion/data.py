"""What completion trains on: frames of real and synthetic scenes, made into octrees once and kept.

    RUN/samples/VERSION-NAME.npz    a frame's octrees at all resolutions; may be deleted, they are made again

The first level's first epochs draw from synthetic scenes alone; everything later, which fine-tunes, mostly
from real ones. Which frames make a batch, and how they are turned, is a function of (seed, epoch, place).
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track

from ocnf_data.errors import OcnfError
from ocnf_data.files.records import canonical_json, sha256_hex
from ocnf_data.loading.epochs import EpochDataset, place_in_world
from ocnf_data.loading.order import Partition, Uneven
from ocnf_data.octree.symmetry import SYMMETRIES, Symmetry
from ocnf_model.completion.sample import (
    LEVELS,
    SAMPLE_VERSION,
    SHRINK,
    SIZE,
    FrameSample,
    kept,
    load_sample,
    save_sample,
)
from ocnf_model.completion.synthetic import VIEWS_PER_SCENE, frame_name, synthetic_tabletops
from ocnf_model.completion.tabletop import Tabletop
from ocnf_model.completion.visible import TRUNCATION
from ocnf_model.completion.voxlets import VoxletsFrame, list_frames
from ocnf_model.training.batches import GridBatch
from ocnf_model.training.record import SAMPLES
from ocnf_model.training.settings import TrainSettings

UPRIGHT: tuple[Symmetry, ...] = tuple(s for s in SYMMETRIES if s.axes[0] == 0 and not s.flips[0])
"""The eight symmetries that leave up where it is."""
_HELD_OUT = 6  # every so manieth scene of the training split is validated with
_SYNTHETIC_EPOCHS = 0.4  # of the first level's epochs, the first ones
_SYNTHETIC_SHARE = 0.2  # of the samples of later epochs and levels
_VOXEL = 0.005  # metres


def held_out(frames: Sequence[VoxletsFrame]) -> tuple[list[VoxletsFrame], list[VoxletsFrame]]:
    """(to train on, to validate with): every sixth scene is held out with all its frames.

    Raises:
        OcnfError: code `empty`: there are too few scenes.
    """
    scenes = sorted({frame.scene for frame in frames})
    chosen = set(scenes[_HELD_OUT - 1:: _HELD_OUT])
    if not chosen:
        raise OcnfError("too few scenes to hold one out", code="empty", where="the training frames",
                        field="train", found=len(scenes), expected=f"at least {_HELD_OUT} scenes")
    return ([frame for frame in frames if frame.scene not in chosen],
            [frame for frame in frames if frame.scene in chosen])


class CompletionData:
    """A `DataSource` for `training.run.train`.

    Args:
        root: folder of the Voxlets data.
        synthetic: number of synthetic scenes.
        seed: seed of the synthetic scenes.

    Raises:
        OcnfError: there is no training split, or it has too few scenes to hold one out.
    """

    def __init__(self, root: str | Path, synthetic: int = 40, seed: int = 0) -> None:
        self.where = str(root)
        self.training_frames, self.validation_frames = held_out(list_frames(root, "train"))
        self._scenes, self._seed = synthetic, seed
        self._folder: Path | None = None
        resolutions = [SIZE >> (LEVELS - 1 - level) for level in range(LEVELS)]
        self.manifest: dict[str, Any] = {
            "name": "voxlets", "target": "occupancy", "resolutions": resolutions,
            "normalise": {"extent": SIZE * SHRINK * _VOXEL},
            "truncation_voxels": TRUNCATION / (SHRINK * _VOXEL), "inputs": []}

    def prepare(self, folder: Path, settings: TrainSettings, console: Console) -> None:
        """Make the octrees of all frames that are not there yet."""
        samples = folder / SAMPLES
        jobs: list[tuple[str, Callable[[], list[Tabletop]]]] = []
        for frame in (*self.validation_frames, *self.training_frames):
            if not kept(samples, frame.name).is_file():
                jobs.append((frame.name, lambda frame=frame: [frame.read()]))  # type: ignore[misc]
        for index in range(self._scenes):
            names = self._names(index)
            if not all(kept(samples, name).is_file() for name in names):
                jobs.append((names[-1], lambda index=index: synthetic_tabletops(  # type: ignore[misc]
                    self._seed, index)))
        for _, make in track(jobs, "encoding frames", console=console, disable=not jobs):
            for scene in make():
                save_sample(kept(samples, scene.name), FrameSample.of(scene))

    def training(self, folder: Path, settings: TrainSettings, level: int) -> EpochDataset:
        """Turned and mirrored frames, synthetic ones first."""
        real = [frame.name for frame in self.training_frames]
        synthetic = [name for index in range(self._scenes) for name in self._names(index)]
        first = round(_SYNTHETIC_EPOCHS * settings.stage(0).epochs) if synthetic and level == 0 else 0
        return FrameDataset(folder / SAMPLES, real, level, self._checksum(real), seed=settings.seed,
                            batch_size=settings.stage(level).batch_size, synthetic=synthetic,
                            synthetic_epochs=first, n_samples=settings.samples_per_epoch or len(real))

    def validation(self, folder: Path, settings: TrainSettings, level: int) -> EpochDataset:
        """The frames that are held out, as they are."""
        names = [frame.name for frame in self.validation_frames]
        return FrameDataset(folder / SAMPLES, names, level, self._checksum(names))

    def _names(self, index: int) -> list[str]:
        return [frame_name(self._seed, index, view) for view in range(VIEWS_PER_SCENE)]

    def _checksum(self, names: Sequence[str]) -> str:
        """Of the frames' names, not of their images: the octrees that were made of them stay in the run."""
        return sha256_hex(canonical_json([SAMPLE_VERSION, list(names), self._scenes, self._seed]))


class FrameDataset(EpochDataset):
    """Batches of kept samples: in order and as they are, or drawn and turned.

    Args:
        folder: folder of the samples.
        names: names of the real frames.
        level: number of the level, from 0; the inputs of the levels before come with it.
        checksum: SHA-256 of what the samples are called and made by.
        seed: of the draws.
        batch_size: samples a batch, for each rank.
        synthetic: names of the synthetic frames.
        synthetic_epochs: epochs, the first ones, that only have synthetic frames; a state that is loaded has
            its own number of them.
        n_samples: samples in an epoch, drawn and turned; None for each frame once.
    """

    def __init__(self, folder: Path, names: Sequence[str], level: int, checksum: str, *, seed: int = 0,
                 batch_size: int = 1, synthetic: Sequence[str] = (), synthetic_epochs: int = 0,
                 n_samples: int | None = None) -> None:
        rank, world_size = place_in_world(None, None)
        self._drawn = n_samples is not None
        super().__init__(Partition(len(names) if n_samples is None else n_samples, batch_size, rank,
                                   world_size, Uneven.REPEAT if self._drawn else Uneven.EXACT))
        self._folder, self._names, self._level, self._checksum = folder, names, level, checksum
        self._seed, self._synthetic, self._synthetic_epochs = seed, synthetic, synthetic_epochs

    @property
    def checksum(self) -> str:
        """SHA-256 of what the samples are called and made by."""
        return self._checksum

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """As of every loader, but the state's number of synthetic epochs is taken over.

        It is a share of the level's epochs, which may be changed when those with synthetic frames are over.
        """
        begun = state.get("synthetic_epochs") if isinstance(state, Mapping) else None
        ours = self._synthetic_epochs
        if self._synthetic and self._level == 0 and type(begun) is int and begun >= 0:
            self._synthetic_epochs = begun
        try:
            super().load_state_dict(state)
        except OcnfError:
            self._synthetic_epochs = ours
            raise

    def _order(self) -> dict[str, Any]:
        partition = self._partition
        return {"checksum": self._checksum, "level": self._level, "n_samples": partition.n_samples,
                "batch_size": partition.batch_size, "world_size": partition.world_size, "seed": self._seed,
                "synthetic_epochs": self._synthetic_epochs}

    def _batches(self, epoch: int, steps: range) -> Iterator[GridBatch]:  # type: ignore[override]
        for step in steps:
            places, repeat = self._partition.places(step)
            samples = [self._sample(epoch, int(place)) for place in places]
            yield GridBatch(epoch, step, tuple(sample.name for sample in samples), tuple(repeat.tolist()),
                            [[sample.inputs[level] for sample in samples]
                             for level in range(self._level + 1)],
                            [sample.targets[self._level] for sample in samples])

    def _sample(self, epoch: int, place: int) -> FrameSample:
        if not self._drawn:
            return self._load(self._names[place])
        key = hashlib.sha256(f"ocnf completion {self._seed} {self._level} {epoch} {place}".encode()).digest()
        random = np.random.Generator(np.random.Philox(key=int.from_bytes(key[:16], "little")))
        alone = epoch < self._synthetic_epochs
        if alone or (self._synthetic and random.random() < _SYNTHETIC_SHARE):
            names = self._synthetic
        else:
            names = self._names
        sample = self._load(names[int(random.random() * len(names))])
        return sample.moved(UPRIGHT[int(random.random() * len(UPRIGHT))])

    def _load(self, name: str) -> FrameSample:
        return load_sample(kept(self._folder, name), name, self._level + 1)
