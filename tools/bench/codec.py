"""Size, speed and error of stored octrees: what is stored, what was considered, and which level.

    python tools/bench/codec.py [MESH | CATEGORY ...]

Prints docs/storage-table.md's tables. One thread. Without arguments, a procedural chair and bed.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np
import numpy.typing as npt
import zstandard
from noisy_octrees import print_table, sample_octrees, timed

from ocnf_data.arrays import F32, I16, U8
from ocnf_data.encodings import Encoding
from ocnf_data.octree import TARGET, GridOctree, decode, decode_raw, encode, quantise

KINDS = [TARGET, *map(str, Encoding)]
RESOLUTIONS = (64, 128, 256)
LEVELS = (1, 3, 6, 9, 12)
Layout = Callable[[F32, str], npt.NDArray]


def main() -> None:
    """Print the tables."""
    plain = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=plain)
    parser.add_argument("meshes", nargs="*", default=["chair", "bed"])
    meshes = parser.parse_args().meshes
    octrees = {Path(mesh).stem: sample_octrees(mesh, RESOLUTIONS) for mesh in meshes}
    numba.set_num_threads(1)
    for name, sample in octrees.items():
        print(f"### {name}: what is stored, 256^3\n")
        stored_table(sample)
        print(f"### {name}: a whole sample, the three resolutions\n")
        sample_table(sample)
    name, sample = next(iter(octrees.items()))
    print(f"### {name}: dtypes and layouts of the data, 256^3, zstd level 6\n")
    layout_table(sample)
    print(f"### {name}: zstd levels, 256^3\n")
    level_table(sample)


def stored_table(sample: dict[tuple[str, int], GridOctree]) -> None:
    """Each kind as the codec writes it."""
    rows = []
    for kind in KINDS:
        octree = sample[kind, 256]
        encode_ms, blob = timed(lambda octree=octree, kind=kind: encode(octree, kind), repeat=2)  # type: ignore[misc]
        raw_ms, raw = timed(lambda blob=blob: decode_raw(blob), repeat=9)  # type: ignore[misc]
        float_ms, back = timed(lambda blob=blob: decode(blob), repeat=9)  # type: ignore[misc]
        error = np.abs(back.data.astype(np.float64) - octree.data).max()
        rows.append([kind, str(raw.data.dtype), f"{octree.n_leaves:,}", f"{oc_bytes(octree) / 1e6:.2f}",
                     f"{len(blob) / 1e6:.3f}", f"{oc_bytes(octree) / len(blob):.1f}", f"{encode_ms:.0f}",
                     f"{raw_ms:.1f}", f"{float_ms:.1f}", f"{error:.6f}"])
    print_table("kind | dtype | leaves | .oc MB | MB | .oc / stored | encode ms | decode ms | "
                "decode to float32 ms | error", rows)


def sample_table(sample: dict[tuple[str, int], GridOctree]) -> None:
    """Ground truth and one input at 64, 128 and 256, against the same octrees as `.oc`."""
    rows = []
    for kinds in (*((TARGET, kind) for kind in KINDS[1:]), tuple(KINDS)):
        octrees = [(sample[kind, resolution], kind) for kind in kinds for resolution in RESOLUTIONS]
        oc = sum(oc_bytes(octree) for octree, _ in octrees)
        stored = sum(len(encode(octree, kind)) for octree, kind in octrees)
        rows.append([" + ".join(kinds), f"{oc / 1e6:.2f}", f"{stored / 1e6:.3f}", f"{oc / stored:.1f}"])
    print_table("members | .oc MB | MB | .oc / stored", rows)


def layout_table(sample: dict[tuple[str, int], GridOctree]) -> None:
    """The data alone (no trees) in every dtype and layout that was considered."""
    layouts: dict[str, tuple[tuple[str, ...], Layout]] = {
        "float32": (tuple(KINDS), lambda values, kind: values),
        "float16": (tuple(KINDS), lambda values, kind: values.astype(np.float16)),
        "as stored": (tuple(KINDS), stored),
        "as stored, channel-major": ((str(Encoding.TDF_OCCUPANCY), str(Encoding.HISTOGRAM)),
                                     lambda values, kind: np.ascontiguousarray(stored(values, kind).T)),
        "as stored, byte planes": ((TARGET, str(Encoding.TSDF)),
                                   lambda values, kind: byte_planes(stored(values, kind))),
        "int16 codes": ((TARGET, str(Encoding.TSDF)), codes),
        "int16 codes, byte planes": ((TARGET, str(Encoding.TSDF)),
                                     lambda values, kind: byte_planes(codes(values, kind))),
    }
    rows = []
    for kind in KINDS:
        for name, (kinds, layout) in layouts.items():
            if kind in kinds:
                content = layout(sample[kind, 256].data, kind).tobytes()
                rows.append([kind, name, f"{len(content) / 1e6:.2f}", *measure(content, 6)])
    print_table("kind | layout | raw MB | MB | compress ms | decompress ms", rows)


def level_table(sample: dict[tuple[str, int], GridOctree]) -> None:
    """The stored data of the target and the histogram at each level."""
    rows = []
    for kind in (TARGET, str(Encoding.HISTOGRAM)):
        content = stored(sample[kind, 256].data, kind).tobytes()
        rows += [[kind, str(level), *measure(content, level)] for level in LEVELS]
    print_table("kind | level | MB | compress ms | decompress ms", rows)


def oc_bytes(octree: GridOctree) -> int:
    """Size of the octree as a `.oc` file."""
    return 28 + 20 * (octree.trees.size // 2) + octree.data.nbytes


def stored(values: F32, kind: str) -> npt.NDArray:
    """The values rounded as the codec does, without the trees."""
    one_leaf_each = np.zeros((len(values), 1, 1, 2), np.uint64)
    return quantise(GridOctree(one_leaf_each, values), kind).data


def codes(values: F32, kind: str) -> I16:
    """The stored levels of a TSDF as integers in units of half a step."""
    return (stored(values, kind).astype(np.float32) * (2048 if kind == TARGET else 256)).astype(np.int16)


def byte_planes(values: npt.NDArray) -> U8:
    """All low bytes, then all high bytes."""
    return np.ascontiguousarray(values.view(np.uint8).reshape(-1, 2).T)


def measure(content: bytes, level: int) -> list[str]:
    """Compressed size in MB, milliseconds to compress and to decompress, checksum included."""
    compressor = zstandard.ZstdCompressor(level=level, write_checksum=True)
    compress_ms, frame = timed(lambda: compressor.compress(content), repeat=2)
    decompress_ms, _ = timed(lambda: zstandard.ZstdDecompressor().decompress(frame))
    return [f"{len(frame) / 1e6:.3f}", f"{compress_ms:.0f}", f"{decompress_ms:.1f}"]


if __name__ == "__main__":
    main()
