"""The manifests that come with the package: to list, and to copy as a beginning for one's own.

They lie in `manifests/` at the root of the repository, where pages and people look for them. A wheel has them
in `ocnf_data/manifests/`, where `setup.py` puts them; from a checkout, installed or not, they are read where
they lie.
"""

from __future__ import annotations

import difflib
import os
from pathlib import Path
from typing import NamedTuple

from ocnf_data.errors import OcnfError
from ocnf_data.files.strict_yaml import read_yaml

_IN_A_WHEEL = Path(__file__).parents[1] / "manifests"
_IN_A_CHECKOUT = Path(__file__).parents[2] / "manifests"


class Shipped(NamedTuple):
    """A manifest that comes along.

    Attributes:
        name: without `.yaml`.
        path: of the file.
        says: the first sentence of the comment that it begins with.
        needs_meshes: whether it reads files from `--meshes ROOT`.
    """

    name: str
    path: Path
    says: str
    needs_meshes: bool


def shipped_manifests() -> list[Shipped]:
    """All of them, by name."""
    folder = _IN_A_WHEEL if _IN_A_WHEEL.is_dir() else _IN_A_CHECKOUT
    found = []
    for path in sorted(folder.glob("*.yaml")):
        source = read_yaml(path)["source"]
        found.append(Shipped(path.stem, path, _first_sentence(path.read_text(encoding="utf-8")),
                             source["kind"] != "shapes"))
    return found


def write_manifest(name: str, out: str | os.PathLike[str] | None = None) -> Path:
    """Copy one of them to edit.

    Args:
        name: which, with or without `.yaml`.
        out: the file to write; None: NAME.yaml in the current folder.

    Returns:
        What was written.

    Raises:
        OcnfError: there is none of that name, or a file is there already: it is left as it is.
    """
    known = {shipped.name: shipped for shipped in shipped_manifests()}
    wanted = name.removesuffix(".yaml")
    if wanted not in known:
        close = difflib.get_close_matches(wanted, known) or known
        raise OcnfError("no manifest of this name comes along", code="missing", field="NAME", found=name,
                        expected=", ".join(close), fix="list them with `ocnf-data manifests`")
    target = Path(f"{wanted}.yaml" if out is None else out)
    text = known[wanted].path.read_bytes()
    try:
        with target.open("xb") as file:
            file.write(text)
    except FileExistsError as error:
        raise OcnfError("is there already, and is left as it is", where=target,
                        fix="give another name with --out FILE") from error
    except OSError as error:
        raise OcnfError("cannot be written", where=target, found=error.strerror) from error
    return target


def _first_sentence(text: str) -> str:
    lines = []
    for line in text.splitlines():
        words = line.removeprefix("#").strip()
        if not line.startswith("#") or not words:
            break
        lines.append(words)
    said = " ".join(lines)
    end = said.find(". ")
    return (said if end < 0 else said[:end]).rstrip(".")
