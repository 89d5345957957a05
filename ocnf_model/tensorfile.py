"""Tensors and a JSON header in one safetensors file: whole or absent, and nothing in it is executed.

The header is canonical JSON under the one metadata key `ocnf`, so equal contents are equal bytes. Its field
`sha256` is the checksum of everything else that the file says, which is compared whenever tensors are read:

    SHA-256(header without `sha256`, canonical | for each tensor by name: [name, dtype, shape] | bytes)

Files of before that have no such field; they are read, and a note in the log says that they were not checked.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import safetensors
import safetensors.torch
import torch
from safetensors import SafetensorError
from torch import Tensor

from ocnf_data.errors import OcnfError
from ocnf_data.files.records import canonical_json
from ocnf_data.files.storage import Store
from ocnf_data.files.storage_errors import storage_errors

_KEY = "ocnf"
_DIGEST = "sha256"
_MAX_BYTES = 4 * 2**30
_MAX_TENSORS = 10_000
_log = logging.getLogger(__name__)


class TensorKind(NamedTuple):
    """What a tensor is, except for its values: the dtype as safetensors writes it (`F32`), and the shape."""

    dtype: str
    shape: tuple[int, ...]

    @classmethod
    def of(cls, tensor: Tensor) -> TensorKind:
        """The kind of a tensor, which may be on the device `meta`."""
        return cls(_DTYPES.get(tensor.dtype, str(tensor.dtype)), tuple(tensor.shape))


_DTYPES = {torch.float32: "F32", torch.float64: "F64", torch.float16: "F16", torch.bfloat16: "BF16",
           torch.uint8: "U8", torch.int32: "I32", torch.int64: "I64", torch.bool: "BOOL"}


def write_tensors(path: Path, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> None:
    """Write the file under its name when it is whole, replacing one that is there."""
    own = {name: tensor.detach().to("cpu", copy=True).contiguous() for name, tensor in tensors.items()}
    signed = {**header, _DIGEST: _digest(own, header)}
    metadata = {_KEY: canonical_json(signed).decode()}
    Store(path.parent).put_bytes(path.name, safetensors.torch.save(own, metadata))


def read_header(path: Path) -> dict[str, Any]:
    """The header alone, without its checksum, which takes the tensors to compare.

    Raises:
        OcnfError: the file is missing, damaged, or none of ours.
    """
    with _opened(path) as file:
        header = _header(path, file)
    header.pop(_DIGEST, None)
    return header


def read_kinds(path: Path) -> dict[str, TensorKind]:
    """The kind of each tensor, by name; no values are read.

    Raises:
        OcnfError: the file cannot be read or is damaged, as for `read_header`.
    """
    with _opened(path) as file:
        names = _names(path, file)
        slices = {name: file.get_slice(name) for name in names}
        return {name: TensorKind(part.get_dtype(), tuple(part.get_shape())) for name, part in slices.items()}


def read_tensors(path: Path, note: bool = True) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """(tensors on the CPU, header without its checksum).

    Args:
        path: the file.
        note: whether the log says of a file without a checksum that it has none.

    Raises:
        OcnfError: the file is missing, too large, damaged (code `checksum` where it is whole but not what was
            written), or none of ours.
    """
    with _opened(path) as file:
        tensors = {name: file.get_tensor(name) for name in _names(path, file)}
        header = _header(path, file)
    if _DIGEST not in header:
        if not note:
            return tensors, header
        _log.warning("%s is of a version that wrote no checksums: whether it is damaged cannot be seen", path)
        return tensors, header
    if header.pop(_DIGEST) != _digest(tensors, header):
        raise OcnfError("the checksum does not match: damaged, or changed by hand", code="checksum",
                        where=path, field=_DIGEST, fix="put a good copy in its place")
    return tensors, header


def _digest(tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> str:
    digest = hashlib.sha256(canonical_json(dict(header)))
    for name in sorted(tensors):
        kind = TensorKind.of(tensors[name])
        digest.update(canonical_json([name, kind.dtype, kind.shape]))
        digest.update(tensors[name].reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def _names(path: Path, file: Any) -> list[str]:
    names: list[str] = file.keys()
    if len(names) > _MAX_TENSORS:
        raise OcnfError("too many tensors for a checkpoint", code="too_large", where=path, found=len(names),
                        expected=f"at most {_MAX_TENSORS}")
    return names


def _opened(path: Path) -> Any:
    with storage_errors(path):
        path.open("rb").close()  # safetensors' own message for a missing file has no name
        size = path.stat().st_size
    if size > _MAX_BYTES:
        raise OcnfError("too large for a checkpoint", code="too_large", where=path, found=f"{size} bytes",
                        expected=f"at most {_MAX_BYTES}")
    try:
        return safetensors.safe_open(path, framework="pt")
    except SafetensorError as error:
        raise OcnfError("not a whole safetensors file", code="damaged", where=path, found=error) from error


def _header(path: Path, file: Any) -> dict[str, Any]:
    text = (file.metadata() or {}).get(_KEY)
    try:
        header = None if text is None else json.loads(text, parse_constant=_no_constant)
    except (ValueError, RecursionError):
        header = None
    if not isinstance(header, dict):
        raise OcnfError("not a file of this project", code="unreadable", where=path, field=_KEY,
                        expected="a JSON header in the metadata")
    return header


def _no_constant(text: str) -> None:
    raise ValueError(f"{text} is not JSON")
