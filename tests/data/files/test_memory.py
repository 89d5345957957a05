"""What a process may use is the least of what the machine has and what its control groups allow."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from ocnf_data.files.memory import usable_memory

WHOLE = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
NO_LIMIT = 9223372036854771712  # what version 1 writes


def system(folder: Path, groups: str, files: dict[str, str]) -> Path:
    for name, text in {"proc/self/cgroup": groups,
                       **{f"sys/fs/cgroup/{name}": text for name, text in files.items()}}.items():
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return folder


@pytest.mark.parametrize(("groups", "files", "expected"), [
    ("0::/\n", {"memory.max": "1000000\n"}, 1_000_000),
    ("0::/\n", {"memory.max": "max\n"}, WHOLE),
    ("0::/\n", {}, WHOLE),
    ("0::/\n", {"memory.max": f"{WHOLE * 2}\n"}, WHOLE),
    ("0::/batch/job\n", {"batch/memory.max": "2000000\n", "batch/job/memory.max": "max\n"}, 2_000_000),
    ("0::/batch/job\n", {"batch/memory.max": "2000000\n", "batch/job/memory.max": "1000\n"}, 1000),
    ("0::/outside/of/here\n", {"memory.max": "3000000\n"}, 3_000_000),
    ("9:cpu:/x\n4:memory:/job\n0::/\n", {"memory/memory.limit_in_bytes": f"{NO_LIMIT}\n",
                                         "memory/job/memory.limit_in_bytes": "4000000\n"}, 4_000_000),
    ("4:hugetlb,memory:/docker/ab:c\n", {"memory/memory.limit_in_bytes": "5000000\n"}, 5_000_000),
    ("4:memory:/job\n", {"memory/memory.limit_in_bytes": f"{NO_LIMIT}\n"}, WHOLE),
    ("7:cpu:/job\n", {"memory/memory.limit_in_bytes": "5000000\n"}, WHOLE),
    ("nonsense\n\n::\n", {"memory.max": "-1\n"}, WHOLE),
])
def test_the_least_limit_counts(tmp_path: Path, groups: str, files: dict[str, str], expected: int) -> None:
    assert usable_memory(system(tmp_path, groups, files)) == expected


def test_elsewhere_than_on_linux_it_is_the_machines(tmp_path: Path) -> None:
    assert usable_memory(tmp_path) == WHOLE >= usable_memory() > 2**20
