"""What the loader yields: the octrees of a few samples, side by side in one block of memory.

All tensors of a batch are views of one uint8 tensor, the arena. So a batch comes from its worker process as
one file descriptor of shared memory, whatever the number of resolutions, is pinned by one call and goes to
a GPU in one copy.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import prod
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.utils.data import get_worker_info
from torch.utils.data._utils.collate import default_collate_fn_map

from ocnf_data.arrays import U8
from ocnf_data.errors import OcnfError
from ocnf_data.loading.assemble import Assembled, Lost
from ocnf_data.loading.catalogue import Request
from ocnf_data.octree import GridOctree
from ocnf_data.octree.bits import TREE_WIDTH
from ocnf_data.octree.stored import TARGET, storage_of
from ocnf_data.octree.symmetry import Symmetry
from ocnf_data.shards.tarformat import parse_member

_ALIGNMENT = 64  # bytes, a cache line
_TORCH_DTYPE = {np.dtype(np.uint8): torch.uint8, np.dtype(np.float16): torch.float16}


@dataclass(frozen=True, eq=False)
class Octrees:
    """The octrees of B samples at one resolution, in the dtype that they are stored in.

    Attributes:
        kind: an `Encoding` or "target".
        trees: (B, GD, GH, GW, 2) int64, the bits of `GridOctree.trees` (bit 63 is the sign).
        data: (L, C) uint8 or float16, the leaves of all samples, in order; `value = data / divisor`.
        n_leaves: (B,) number of leaves of each sample; they sum to L.
    """

    kind: str
    trees: Tensor
    data: Tensor
    n_leaves: tuple[int, ...]

    @property
    def divisor(self) -> int:
        """What stored values are divided by: 255 for uint8, 1 for float16."""
        return storage_of(self.kind).divisor

    def to_float(self) -> Tensor:
        """(L, C) float32 values, on the device where the data is; equal to those of `codec.decode`."""
        values = self.data.to(torch.float32)
        return values if self.divisor == 1 else values.div_(self.divisor)

    def grids(self) -> list[GridOctree]:
        """One `GridOctree` a sample; `trees` are views of this batch's memory where it is on the CPU."""
        trees = self.trees.cpu().numpy().view(np.uint64)
        values = self.to_float().cpu().numpy()
        ends = np.cumsum(self.n_leaves, dtype=np.int64)
        return [GridOctree.trusted(trees[b], values[end - n : end])
                for b, (end, n) in enumerate(zip(ends, self.n_leaves, strict=True))]

    def to_dense(self) -> Tensor:
        """(B, C, D, H, W) float32, on the device where the data is: every voxel has its leaf's values."""
        return torch.stack([torch.from_numpy(grid.to_dense()) for grid in self.grids()]).to(self.data.device)

    def __repr__(self) -> str:
        """One line: kind, grids, leaves, dtype and device."""
        size = "x".join(str(TREE_WIDTH * n) for n in self.trees.shape[1:4])
        return f"Octrees({self.kind}, {len(self.n_leaves)} of {size}, " \
               f"data={tuple(self.data.shape)} {self.data.dtype} on {self.data.device})"


@dataclass(frozen=True)
class Slot:
    """Where in the arena one resolution's octrees lie: first the trees, then the data.

    Attributes:
        member: name of the member they come from.
        resolution: voxels along each axis.
        kind: an `Encoding` or "target".
        n_leaves: (B,) number of leaves of each sample.
        trees_at: first byte.
    """

    member: str
    resolution: int
    kind: str
    n_leaves: tuple[int, ...]
    trees_at: int

    @property
    def trees_shape(self) -> tuple[int, ...]:
        """(B, GD, GH, GW, 2)."""
        n = self.resolution // TREE_WIDTH
        return len(self.n_leaves), n, n, n, 2

    @property
    def data_shape(self) -> tuple[int, int]:
        """(L, C)."""
        return sum(self.n_leaves), storage_of(self.kind).channels

    @property
    def data_at(self) -> int:
        """First byte of the data; the trees are 16 bytes each, so it is aligned."""
        return self.trees_at + 8 * prod(self.trees_shape)

    @property
    def end(self) -> int:
        """The byte after the data."""
        return self.data_at + prod(self.data_shape) * storage_of(self.kind).dtype.itemsize

    def view(self, arena: Tensor) -> Octrees:
        """The octrees in an arena."""
        trees = arena[self.trees_at : self.data_at].view(torch.int64)
        data = arena[self.data_at : self.end].view(_TORCH_DTYPE[storage_of(self.kind).dtype])
        return Octrees(self.kind, trees.view(self.trees_shape), data.view(self.data_shape), self.n_leaves)


class DenseBatch(NamedTuple):
    """The volumes of a batch at one resolution, for networks that know no octrees.

    Attributes:
        inputs: (B, C, D, H, W) float32, the encoding's channels; z, y, x from the low end.
        targets: (B, 1, D, H, W) float32, TSDF / tau, or occupancy.
    """

    inputs: Tensor
    targets: Tensor


@dataclass(frozen=True, eq=False)
class Batch:
    """Some samples, and their place in the run.

    Attributes:
        epoch, step: this is batch `step` of its rank in that epoch.
        keys, categories: key and category of each of the B samples.
        meta: the parsed `json` member of each; it speaks of the sample before augmentation.
        repeat: whether the sample was met before in this epoch, or replaces a lost one. An average over
            an epoch leaves these out.
        symmetries: the symmetry that augmentation applied to each sample.
        lost: samples of this batch that were damaged (`on_error="skip"`).
        arena: the memory of all octrees.
        slots: what lies where in it.
        draws: for each sample, what anything drawn for it in this epoch should be drawn by: its key, and
            where a mixture may have met that before in the epoch, something that tells the two apart.
    """

    epoch: int
    step: int
    keys: tuple[str, ...]
    categories: tuple[str, ...]
    meta: tuple[dict[str, Any], ...]
    repeat: tuple[bool, ...]
    symmetries: tuple[Symmetry, ...]
    lost: tuple[Lost, ...]
    arena: Tensor
    slots: tuple[Slot, ...]
    draws: tuple[str, ...]

    def __len__(self) -> int:
        """Number of samples, B: `batch_size`, or fewer at an exact epoch's end or where some were lost."""
        return len(self.keys)

    @property
    def inputs(self) -> Mapping[int, Octrees]:
        """The input octrees by resolution, in the order asked for."""
        return {slot.resolution: slot.view(self.arena) for slot in self.slots if slot.kind != TARGET}

    @property
    def targets(self) -> Mapping[int, Octrees]:
        """The ground truth by resolution, in the order asked for."""
        return {slot.resolution: slot.view(self.arena) for slot in self.slots if slot.kind == TARGET}

    def dense(self, resolution: int) -> DenseBatch:
        """Inputs and ground truth as dense tensors; at 256^3 a sample of histograms takes 0.7 GB.

        >>> inputs, targets = batch.dense(64)      # doctest: +SKIP
        >>> inputs.shape, targets.shape            # doctest: +SKIP
        ((B, 10, 64, 64, 64), (B, 1, 64, 64, 64))

        Args:
            resolution: voxels a side, one of those that were asked for.

        Raises:
            OcnfError: the batch has no such resolution, or no ground truth.
        """
        found: dict[str, Tensor] = {}
        for name, octrees in (("inputs", self.inputs), ("targets", self.targets)):
            if resolution not in octrees:
                raise OcnfError(f"the batch has no {name} of this resolution", code="missing", where="Batch",
                                field="resolution", found=resolution, expected=list(octrees) or "none",
                                fix="name it in ShardDataset(..., resolutions=[...])")
            found[name] = octrees[resolution].to_dense()
        return DenseBatch(**found)

    def to(self, device: torch.device | str, non_blocking: bool = False) -> Batch:
        """The batch with its tensors on a device."""
        return replace(self, arena=self.arena.to(device, non_blocking=non_blocking))

    def pin_memory(self) -> Batch:
        """The batch in page-locked memory, if there is a GPU; `DataLoader(pin_memory=True)` calls this."""
        return replace(self, arena=self.arena.pin_memory()) if torch.cuda.is_available() else self


def make_batch(assembled: Assembled, request: Request, epoch: int, step: int) -> Batch:
    """The batch of samples that were read: their octrees copied into one arena."""
    samples = assembled.samples
    slots, end = [], 0
    for member in request.members()[1:]:
        _, encoding, resolution = parse_member(member)
        n_leaves = tuple(sample.octrees[member].n_leaves for sample in samples)
        slot = Slot(member, resolution, TARGET if encoding is None else str(encoding), n_leaves, end)
        slots.append(slot)
        end = slot.end + -slot.end % _ALIGNMENT
    arena = _allocate(end)
    memory = arena.numpy()
    for slot in slots:
        _fill(memory[slot.trees_at :], [sample.octrees[slot.member].trees for sample in samples])
        _fill(memory[slot.data_at :], [sample.octrees[slot.member].data for sample in samples])
        memory[slot.end : slot.end + -slot.end % _ALIGNMENT] = 0  # equal batches have equal arenas
    return Batch(
        epoch=epoch,
        step=step,
        keys=tuple(sample.key for sample in samples),
        categories=tuple(sample.category for sample in samples),
        meta=tuple(sample.meta for sample in samples),
        repeat=assembled.repeat,
        symmetries=assembled.symmetries,
        lost=assembled.lost,
        arena=arena,
        slots=tuple(slots),
        draws=tuple(sample.draw for sample in samples),
    )


def _refuse_to_collate(batches: Sequence[Batch], *, collate_fn_map: object = None) -> Batch:
    raise OcnfError("ShardDataset forms the batches itself", where="DataLoader", field="batch_size",
                    expected="None, and ShardDataset(..., batch_size=...)")


default_collate_fn_map[Batch] = _refuse_to_collate  # torch's own message would not say what to do


def _allocate(n_bytes: int) -> Tensor:
    """(n_bytes,) uint8, not initialised; in a worker it is shared memory from the start, as in torch's own
    collate function: moving it there when it is sent takes as long again as all of the decoding.
    """
    if get_worker_info() is None or n_bytes == 0:
        return torch.empty(n_bytes, dtype=torch.uint8)
    return torch.empty(0, dtype=torch.uint8).set_(torch.UntypedStorage._new_shared(n_bytes))


def _fill(memory: U8, arrays: Sequence[npt.NDArray[Any]]) -> None:
    """Copy arrays, one behind the other, to the beginning of the memory."""
    at = 0
    for array in arrays:
        memory[at : at + array.nbytes] = array.reshape(-1).view(np.uint8)
        at += array.nbytes
