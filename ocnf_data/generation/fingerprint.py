"""What beside the manifest decides a data set's bytes: the versions of libraries, and the type of the CPU."""

from __future__ import annotations

import platform
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import ocnf_data

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
    libraries["ocnf"] = ocnf_data.__version__
    libraries["python"] = f"{sys.version_info.major}.{sys.version_info.minor}"
    return {"libraries": libraries, "cpu": cpu_type()}


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
