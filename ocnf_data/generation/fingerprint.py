"""What the bytes of a data set, or of rendered views, depend on beside meshes: manifest, libraries, CPU."""

from __future__ import annotations

import hashlib
import json
import platform
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

from ocnf_data.manifest import Manifest
from ocnf_data.version import __version__

# safetensors and zstandard write the members; numpy draws the noise and rounds; numba compiles the rest.
_ALWAYS = ("llvmlite", "numba", "numpy", "safetensors", "zstandard")
_FOR_FILES = ("trimesh",)
_FOR_PYRENDER = ("PyOpenGL", "pyrender", "trimesh")


def fingerprint(reads_files: bool, renders_with_gl: bool) -> dict[str, Any]:
    """`{"libraries": {name: version}, "cpu": type}`.

    Resuming with other libraries is refused: half of the data set would come from each. The type of the CPU
    only warns: IEEE arithmetic is the same on all of them, as far as compilers keep to it.

    Args:
        reads_files: the items are mesh files.
        renders_with_gl: depth comes from `pyrender`.
    """
    import zstandard

    names = [*_ALWAYS, *(_FOR_FILES if reads_files else ()), *(_FOR_PYRENDER if renders_with_gl else ())]
    libraries = {name: _version(name) for name in sorted(set(names))}
    libraries["libzstd"] = ".".join(str(part) for part in zstandard.ZSTD_VERSION)
    libraries["ocnf"] = __version__
    libraries["python"] = f"{sys.version_info.major}.{sys.version_info.minor}"
    return {"libraries": libraries, "cpu": cpu_type()}


def view_fingerprint(manifest: Manifest) -> str:
    """SHA-256 of everything but the mesh that the rendered depth depends on.

    Noise, view counts, encodings and resolutions are not in it: that is what views are kept for. The
    package's version is, because a later renderer may be a better one.
    """
    parts = manifest.to_dict()
    facts = {name: parts[name] for name in ("camera", "normalise", "renderer")}
    if manifest.camera.path is not None:  # a path depends on the seed, a rig on nothing
        facts["seed"] = manifest.seed
    text = json.dumps({"ocnf": __version__, **facts}, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def cpu_type() -> str:
    """The processor's model name."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _version(distribution: str) -> str:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return "not installed"
