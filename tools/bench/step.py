"""Where the processor time of a training step goes at each level, beside its floor.

    python tools/bench/step.py [MESH | CATEGORY] [--levels 3] [--steps 3]

Two networks: the paper's in float32, and one with context and batch normalisation in bfloat16. Level 1 on
whole grids, two samples; levels 2 and 3 on crops (96 and 128 voxels) and, the last, on the whole grid. One
thread; milliseconds of processor time, medians over the steps after the first. Parts do not overlap, but for
`before`, which is all that the earlier levels took of the others.

The floor is what no other arrangement of the same products can undercut: the bare products of exactly these
shapes by the kernel that the network uses, and writing the gathered rows once at the speed at which memory of
a chunk's size is copied.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numba
import torch
from noisy_octrees import print_table, sample_octrees

from ocnf_data.encodings import Encoding
from ocnf_data.octree import TARGET, GridOctree
from ocnf_model.devices import keep_freed_memory
from ocnf_model.losses import truncated_l1_loss
from ocnf_model.network import OctNetFusion
from ocnf_model.octree.batch import OctreeBatch
from ocnf_model.octree.structure import Structure
from ocnf_model.ops import conv
from ocnf_model.ops.gemm import linear
from ocnf_model.training.batches import Example
from ocnf_model.training.crops import crop_losses, draw_corners

PARTS = ("read", "tables", "gather", "place", "forward", "input", "weight", "loss", "optimiser", "rest")
CASES = {  # label -> arguments of the network, whether in bfloat16
    "paper": ({}, False),
    "general": ({"context": 128, "normalise": "batch"}, True),
}
CROPS = ((1, None), (2, 96), (3, 128), (3, None))
CHUNK_BYTES = 1 << 22


class Clock:
    """Processor time by part; a part that begins within another stops that one's clock."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Begin anew, with the part `rest`."""
        self.spent: dict[str, float] = defaultdict(float)
        self.products: Counter[tuple[Any, ...]] = Counter()
        self.gathered = 0  # bytes
        self._stack: list[str] = ["rest"]
        self._since = time.thread_time()

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Count what runs within as `name`."""
        self._count()
        self._stack.append(name)
        try:
            yield
        finally:
            self._count()
            self._stack.pop()

    def _count(self) -> None:
        now = time.thread_time()
        self.spent[self._stack[-1]] += now - self._since
        self._since = now

    def timed(self, name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        """The call, counted as `name`."""
        def run(*arguments: Any, **named: Any) -> Any:
            with self.part(name):
                return call(*arguments, **named)
        return run


clock = Clock()


def watch() -> None:
    """Put the clock around the parts of a convolution, the tables of structures and the loss."""
    gather = conv.gather

    def multiply(a: torch.Tensor, weight: torch.Tensor, *bias: torch.Tensor | None) -> torch.Tensor:
        name = "forward" if bias else "weight" if weight.stride(0) == 1 else "input"
        clock.products[name, tuple(a.shape), tuple(weight.shape), a.dtype] += 1
        with clock.part(name):
            return linear(a, weight, *bias)

    def chunks(*arguments: Any) -> Iterator[Any]:
        rows = gather(*arguments)
        while True:
            with clock.part("gather"):
                found = next(rows, None)
            if found is None:
                return
            clock.gathered += found[1].nbytes
            yield found

    for name, replaced in (("linear", multiply), ("gather", chunks),
                           ("near_rows", clock.timed("gather", conv.near_rows)),
                           ("put_rows", clock.timed("place", conv.put_rows))):
        setattr(conv, name, replaced)
    for method in ("table", "relation"):
        setattr(Structure, method, clock.timed("tables", getattr(Structure, method)))


def floor() -> tuple[float, float]:
    """Seconds of the bare products of a step, and of writing its gathered rows."""
    seconds = 0.0
    with torch.no_grad():
        for (name, left, right, dtype), n in clock.products.items():
            a, weight = torch.randn(left).to(dtype), torch.randn(right).to(dtype)
            if name == "weight":
                a, weight = a.T.contiguous().T, weight.T.contiguous().T
            seconds += n * fastest(lambda a=a, weight=weight: linear(a, weight))  # type: ignore[misc]
    source = torch.zeros(CHUNK_BYTES, dtype=torch.uint8)
    target = torch.zeros_like(source)
    return seconds, clock.gathered / CHUNK_BYTES * fastest(lambda: target.copy_(source))


def fastest(call: Callable[[], object]) -> float:
    """The shortest of a few calls, in seconds of processor time."""
    call()
    times = []
    for _ in range(5):
        began = time.thread_time()
        call()
        times.append(time.thread_time() - began)
    return min(times)


def steps(octrees: dict[tuple[str, int], GridOctree], level: int, crop: int | None, label: str,
          n: int) -> Iterator[None]:
    """Some steps of a level (from 1); what each takes stands in `clock`."""
    arguments, low = CASES[label]
    network = OctNetFusion(levels=level, **arguments)  # type: ignore[arg-type]
    network.eval()
    trained = network.levels[level - 1].train()
    optimiser = torch.optim.Adam(trained.parameters())
    for earlier in network.levels[: level - 1]:
        earlier.register_forward_pre_hook(lambda *_: clock.spent.update(began=time.thread_time()))
        earlier.register_forward_hook(lambda *_: clock.spent.update(
            before=clock.spent["before"] + time.thread_time() - clock.spent["began"]))
    batch, resolutions = 2 if level == 1 else 1, [64 << shift for shift in range(level)]
    loss = clock.timed("loss", truncated_l1_loss)
    for _ in range(n):
        clock.reset()
        with clock.part("read"):
            inputs = [OctreeBatch.from_grids([octrees[str(Encoding.HISTOGRAM), resolution]] * batch)
                      for resolution in resolutions]
            target = OctreeBatch.from_grids([octrees[TARGET, resolutions[-1]]] * batch)
        with torch.autocast("cpu", torch.bfloat16, enabled=low):
            if crop:
                corners = draw_corners(target.structure, crop // 8, 0, 0, ["sample"])
                losses = crop_losses(network, Example(inputs, target), level - 1, corners, crop // 8, loss)
            else:
                losses = loss(network.run(inputs, frozen=level - 1)[-1].raw, target, "none")
        losses.mean().backward()
        with clock.part("optimiser"):
            optimiser.step()
            optimiser.zero_grad()
        yield


def main() -> None:
    """Print the table."""
    plain = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=plain)
    parser.add_argument("mesh", nargs="?", default="chair")
    parser.add_argument("--levels", type=int, default=3)
    parser.add_argument("--steps", type=int, default=3)
    options = parser.parse_args()
    torch.set_num_threads(1)
    keep_freed_memory()  # as `ocnf-model train` does
    octrees = sample_octrees(options.mesh, tuple(64 << shift for shift in range(options.levels)))
    numba.set_num_threads(1)
    watch()
    rows = []
    for label in CASES:
        for level, crop in CROPS[: None if options.levels > 2 else options.levels]:
            found: dict[str, list[float]] = defaultdict(list)
            for _ in steps(octrees, level, crop, label, options.steps + 1):
                for name in (*PARTS, "before"):
                    found[name].append(clock.spent[name])
            products, gathers = floor()
            parts = {name: statistics.median(times[1:]) for name, times in found.items()}
            total = sum(parts[name] for name in PARTS)
            figures = (total, *parts.values(), products, gathers)
            rows.append([f"{label}, {32 << level}³" + (f", crop {crop}" if crop else ""),
                         *(f"{1e3 * seconds:.0f}" for seconds in figures),
                         f"{total / (products + gathers):.2f}"])
    print(f"{Path(options.mesh).stem}, milliseconds\n")
    titles = ("step", "all", *PARTS, "before", "floor: products", "gathers", "all / floor")
    print_table(" | ".join(titles), rows)


if __name__ == "__main__":
    main()
