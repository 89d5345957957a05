"""The neighbours of all leaves, gathered chunk by chunk, and the threads that share the chunks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor

from ocnf_model.octree.leafmap import sparse_product
from ocnf_model.octree.neighbours import N_OFFSETS, Neighbours

_Result = TypeVar("_Result")

# Elements of a gathered chunk: on a CPU 4 MB of float32, which stay in the cache from the gather to the
# product; on a GPU as much as keeps it busy.
_CPU_ELEMENTS = 2**20
_GPU_ELEMENTS = 2**27
_MIN_CHUNKS = 4  # a thread: with fewer it is not worth starting


@dataclass(frozen=True)
class Chunk:
    """Consecutive leaves among the regular or the irregular ones, and the sparse entries of the latter."""

    leaves: slice
    entries: slice | None


def plan(neighbours: Neighbours, channels: int) -> list[Chunk]:
    """Chunks of all leaves, for features of that many channels: regular ones first."""
    elements = _CPU_ELEMENTS if neighbours.table.device.type == "cpu" else _GPU_ELEMENTS
    size = max(1, elements // (N_OFFSETS * channels))
    n_regular, n_irregular = len(neighbours.regular), len(neighbours.irregular)
    chunks = [Chunk(slice(i, min(i + size, n_regular)), None) for i in range(0, n_regular, size)]
    # One transfer for all bounds: on a GPU, reading them one by one would wait for each.
    bounds = [*neighbours.starts[:: N_OFFSETS * size].tolist(), len(neighbours.columns)]
    for n, i in enumerate(range(0, n_irregular, size)):
        chunks.append(Chunk(slice(i, min(i + size, n_irregular)), slice(bounds[n], bounds[n + 1])))
    return chunks


def gather(neighbours: Neighbours, features: Tensor,
           chunks: Sequence[Chunk]) -> Iterator[tuple[Tensor, Tensor]]:
    """The leaves of each chunk, (m,) int64, and A_k x of them at all offsets k, (m, 27 C).

    The second tensor is overwritten by the next chunk.
    """
    table = neighbours.table.view(-1)  # (R, 27) -> (27 R,)
    lengths = [chunk.leaves.stop - chunk.leaves.start for chunk in chunks if chunk.entries is None]
    buffer = features.new_empty(N_OFFSETS * max(lengths, default=0), features.shape[1])
    # Sums are of float32; all rows are converted once, not by each chunk.
    summed = features.float() if len(lengths) < len(chunks) and features.element_size() < 4 else features
    for chunk in chunks:
        first, end = N_OFFSETS * chunk.leaves.start, N_OFFSETS * chunk.leaves.stop
        if chunk.entries is None:
            leaves = neighbours.regular[chunk.leaves]  # (m,)
            gathered = torch.index_select(features, 0, table[first:end], out=buffer[: end - first])
        else:
            leaves = neighbours.irregular[chunk.leaves]  # (m,)
            starts = neighbours.starts[first : end + 1] - chunk.entries.start  # (27 m + 1,)
            gathered = sparse_product(starts, neighbours.columns[chunk.entries],
                                      neighbours.weights[chunk.entries], summed).to(features.dtype)
        yield leaves, gathered.view(len(leaves), -1)  # (27 m, C) -> (m, 27 C)


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
