"""Tensors and a JSON header in one safetensors file: whole or absent, and nothing in it is executed.

The header is canonical JSON under the one metadata key `ocnf`, so equal contents are equal bytes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
from safetensors import SafetensorError
from torch import Tensor

from ocnf_data.errors import OcnfError
from ocnf_data.files.records import canonical_json
from ocnf_data.files.storage import Store, storage_errors

_KEY = "ocnf"
_MAX_BYTES = 4 * 2**30


def write_tensors(path: Path, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> None:
    """Write the file under its name when it is whole, replacing one that is there."""
    own = {name: tensor.detach().to("cpu", copy=True).contiguous() for name, tensor in tensors.items()}
    metadata = {_KEY: canonical_json(dict(header)).decode()}
    Store(path.parent).put_bytes(path.name, safetensors.torch.save(own, metadata))


def read_header(path: Path) -> dict[str, Any]:
    """The header alone.

    Raises:
        OcnfError: the file is missing, damaged, or none of ours.
    """
    with _opened(path) as file:
        return _header(path, file)


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """(tensors on the CPU, header).

    Raises:
        OcnfError: the file is missing, too large, damaged, or none of ours.
    """
    with storage_errors(path):
        size = path.stat().st_size
    if size > _MAX_BYTES:
        raise OcnfError("too large for a checkpoint", code="too_large", where=path, found=f"{size} bytes",
                        expected=f"at most {_MAX_BYTES}")
    with _opened(path) as file:
        return {name: file.get_tensor(name) for name in file.keys()}, _header(path, file)  # noqa: SIM118


def _opened(path: Path) -> Any:
    with storage_errors(path):
        path.open("rb").close()  # safetensors' own message for a missing file has no name
    try:
        return safetensors.safe_open(path, framework="pt")
    except SafetensorError as error:
        raise OcnfError("not a whole safetensors file", code="damaged", where=path, found=error) from error


def _header(path: Path, file: Any) -> dict[str, Any]:
    text = (file.metadata() or {}).get(_KEY)
    try:
        header = None if text is None else json.loads(text)
    except (ValueError, RecursionError):
        header = None
    if not isinstance(header, dict):
        raise OcnfError("not a file of this project", code="unreadable", where=path, field=_KEY,
                        expected="a JSON header in the metadata")
    return header
