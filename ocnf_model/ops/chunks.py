"""The neighbours of all leaves, gathered chunk by chunk, and the threads that share the chunks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import Enum
from typing import Any, TypeVar

import numpy.typing as npt
import torch
from torch import Tensor

from ocnf_model.octree.leafmap import sparse_product
from ocnf_model.octree.neighbours import N_AROUND, N_OFFSETS, Neighbours
from ocnf_model.ops.gather import average_twos, average_twos_bfloat16, copy_rows, gather_octets

_Result = TypeVar("_Result")

# Elements of a gathered chunk: on a CPU 4 MB of float32, which stay in the cache from the gather to the
# product; on a GPU as much as keeps it busy.
_CPU_ELEMENTS = 2**20
_GPU_ELEMENTS = 2**27
# (8, 27): which of the 4x4x4 voxels in and around an octet are those around each of its own.
_AROUND = torch.arange(N_AROUND).view(4, 4, 4) \
    .unfold(0, 3, 1).unfold(1, 3, 1).unfold(2, 3, 1).reshape(8, N_OFFSETS)
_MIN_CHUNKS = 4  # a thread: with fewer it is not worth starting


class Kind(Enum):
    """The kinds of leaves that `Neighbours` tells apart."""

    OCTETS = "octets"
    TWOS = "twos"
    WIDE = "wide"


@dataclass(frozen=True)
class Chunk:
    """Consecutive octets, twos, or wide leaves and their sparse entries."""

    kind: Kind
    rows: slice
    entries: slice | None = None

    def __len__(self) -> int:
        """Number of leaves."""
        return (self.rows.stop - self.rows.start) * (8 if self.kind is Kind.OCTETS else 1)


def plan(neighbours: Neighbours, channels: int) -> list[Chunk]:
    """Chunks of all leaves, for features of that many channels: octets first."""
    elements = _CPU_ELEMENTS if neighbours.octets.device.type == "cpu" else _GPU_ELEMENTS
    size = max(1, elements // (N_OFFSETS * channels * 8)) * 8
    # All have one length, but the last of a kind: oneDNN compiles a kernel for each.
    chunks = [Chunk(Kind.OCTETS, rows) for rows in _parts(len(neighbours.octets), size // 8)]
    chunks += [Chunk(Kind.TWOS, rows) for rows in _parts(len(neighbours.twos), size)]
    # One transfer for all bounds: on a GPU, reading them one by one would wait for each.
    bounds = [*neighbours.starts[:: N_OFFSETS * size].tolist(), len(neighbours.columns)]
    for n, rows in enumerate(_parts(len(neighbours.wide), size)):
        chunks.append(Chunk(Kind.WIDE, rows, slice(bounds[n], bounds[n + 1])))
    return chunks


def _parts(total: int, size: int) -> list[slice]:
    return [slice(i, min(i + size, total)) for i in range(0, total, size)]


def near_rows(neighbours: Neighbours, features: Tensor) -> Tensor:
    """What the wide leaves read of features (L, C), (U, C) in at least float32, as their sums are."""
    rows = features.detach().index_select(0, neighbours.near)
    return rows.float() if rows.element_size() < 4 else rows


def gather(neighbours: Neighbours, features: Tensor, near: Tensor,
           chunks: Sequence[Chunk]) -> Iterator[tuple[Tensor, Tensor]]:
    """The leaves of each chunk, (m,) int64, and A_k x of them at all offsets k, (m, 27 C).

    The second tensor is overwritten by the next chunk. `near` are the `near_rows`, for all chunks once.
    """
    features = features.detach()
    lengths = [len(chunk) for chunk in chunks if chunk.kind is not Kind.WIDE]
    buffer = features.new_empty(max(lengths, default=0), N_OFFSETS * features.shape[1])
    on_cpu = features.device.type == "cpu"
    copy = _copy_by_kernel if on_cpu else _copy
    average = _average_by_kernel if on_cpu and features.dtype is not torch.float16 else _average
    for chunk in chunks:
        if chunk.kind is Kind.OCTETS:
            leaves = neighbours.voxels[8 * chunk.rows.start : 8 * chunk.rows.stop]  # (m,)
            copy(neighbours.octets[chunk.rows], features, buffer[: len(chunk)])
            yield leaves, buffer[: len(chunk)]
        elif chunk.kind is Kind.TWOS:
            average(neighbours.twos[chunk.rows], features, buffer[: len(chunk)])
            yield neighbours.two_wide[chunk.rows], buffer[: len(chunk)]
        elif chunk.entries is not None:
            leaves = neighbours.wide[chunk.rows]  # (m,)
            starts = neighbours.starts[N_OFFSETS * chunk.rows.start : N_OFFSETS * chunk.rows.stop + 1]
            gathered = sparse_product(starts - chunk.entries.start, neighbours.columns[chunk.entries],
                                      neighbours.weights[chunk.entries], near).to(features.dtype)
            yield leaves, gathered.view(len(leaves), -1)  # (27 m, C) -> (m, 27 C)


def _copy(octets: Tensor, features: Tensor, out: Tensor) -> None:
    """Write the rows around each voxel of (o, 64) octets, (8 o, 27 C)."""
    padded = torch.cat([features, features.new_zeros(1, features.shape[1])])  # (L + 1, C)
    around = octets[:, _AROUND.view(-1).to(octets.device)].view(-1)  # (o, 64) -> (216 o,)
    torch.index_select(padded, 0, around, out=out.view(-1, features.shape[1]))


def _copy_by_kernel(octets: Tensor, features: Tensor, out: Tensor) -> None:
    """The same on a CPU."""
    gather_octets(octets.numpy(), _as_numpy(features), _as_numpy(out))


def _average(twos: Tensor, features: Tensor, out: Tensor) -> None:
    """Write the means around each of (w, 64) leaves of width 2, (w, 27 C)."""
    padded = torch.cat([features, features.new_zeros(1, features.shape[1])])  # (L + 1, C)
    around = padded.index_select(0, twos.view(-1))  # (64 w, C)
    sums = (around.float() if around.element_size() < 4 else around).view(-1, 4, 4, 4, features.shape[1])
    for axis in (3, 2, 1):
        sums = sums.narrow(axis, 0, 3) + sums.narrow(axis, 1, 3)
    out.copy_((sums / 8).flatten(1))


def _average_by_kernel(twos: Tensor, features: Tensor, out: Tensor) -> None:
    """The same on a CPU, but for float16, which numba does not know."""
    if features.dtype is torch.bfloat16:
        average_twos_bfloat16(twos.numpy(), features.view(torch.uint16).numpy(),
                              out.view(torch.uint16).numpy())
    else:
        average_twos(twos.numpy(), features.numpy(), out.numpy())


def put_rows(out: Tensor, leaves: Tensor, rows: Tensor) -> None:
    """out[leaves] = rows, (m, C); without a gradient."""
    if out.device.type == "cpu":
        copy_rows(leaves.numpy(), _as_numpy(rows.contiguous()), _as_numpy(out))
    else:
        out.index_copy_(0, leaves, rows)


def _as_numpy(tensor: Tensor) -> npt.NDArray[Any]:
    """The same memory; as whole numbers where numpy has no such floats."""
    return (tensor.view(torch.int16) if tensor.element_size() == 2 else tensor).numpy()


def map_chunks(work: Callable[[Sequence[Chunk]], _Result], chunks: Sequence[Chunk],
          device: torch.device) -> list[_Result]:
    """Run `work` on parts of the chunks, without gradients: one part, or on a CPU one for each thread.

    Threads that each take a part do not wait for one another after every small operation, as those within an
    operation do: a tenth faster on an idle machine, and many times on one that has other work too. Which
    thread takes which chunk is fixed, so that sums of the results do not vary from run to run.
    """
    n_threads = torch.get_num_threads()
    n_parts = min(n_threads, len(chunks) // _MIN_CHUNKS) if device.type == "cpu" else 1
    if n_parts <= 1:
        with torch.no_grad():
            return [work(chunks)]

    def run(part: int) -> _Result:
        torch.set_num_threads(1)  # of this Python thread
        with torch.no_grad():
            return work(chunks[part::n_parts])

    try:
        with ThreadPoolExecutor(n_parts) as pool:
            return list(pool.map(run, range(n_parts)))
    finally:
        torch.set_num_threads(n_threads)  # what Python threads that start later will have
