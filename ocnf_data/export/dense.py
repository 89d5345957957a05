"""Volumes as NumPy arrays: what a dense network of any framework reads."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import numpy.typing as npt

from ocnf_data.export.sample import ExportSample
from ocnf_data.octree import TARGET
from ocnf_data.octree.stored import storage_of
from ocnf_data.shards.tarformat import parse_member


def dense_arrays(sample: ExportSample) -> dict[str, npt.NDArray[Any]]:
    """The ground truth and the inputs of a sample as volumes.

    Returns:
        `target` (1, D, H, W), and each input (C, D, H, W) under its name `VARIANT-ENCODING`, axes z, y, x
        from the low end. float32 in [-1, 1], TSDF divided by tau; with `stored` the dtype on disk, where
        uint8 counts 255ths. Also `extent` and `truncation` in metres, scalars: voxel i lies at
        `(i + 0.5) * extent / D - extent / 2`, and a TSDF value times `truncation` is metres.
    """
    members = {TARGET: sample.target, **sample.inputs}
    arrays: dict[str, npt.NDArray[Any]] = {}
    for name, member in members.items():
        volume = sample.octree(member).to_dense()
        arrays[name] = _as_stored(sample, member, volume) if sample.settings.stored else volume
    return {**arrays, "extent": np.array(sample.extent), "truncation": np.array(sample.truncation)}


def dense_files(sample: ExportSample) -> dict[str, bytes]:
    """The files of a sample: one compressed `.npz`."""
    return {f"{sample.stored.split}/{sample.key}.npz": npz_bytes(dense_arrays(sample), compressed=True)}


def npz_bytes(arrays: dict[str, npt.NDArray[Any]], compressed: bool = False) -> bytes:
    """The bytes of an `.npz`."""
    file = io.BytesIO()
    save = np.savez_compressed if compressed else np.savez
    save(file, **arrays)  # type: ignore[arg-type]
    return file.getvalue()


def _as_stored(sample: ExportSample, member: str, volume: npt.NDArray[np.float32]) -> npt.NDArray[Any]:
    encoding = parse_member(member)[1]
    storage = storage_of(TARGET if encoding is None else str(encoding))
    return np.rint(volume * storage.divisor).astype(storage.dtype) if storage.divisor > 1 \
        else volume.astype(storage.dtype)
