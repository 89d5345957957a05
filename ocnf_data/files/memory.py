"""How much memory this process may use: the machine's, or less where a container or a batch system says so.

Linux keeps that limit in a control group, of which a process is told by `/proc/self/cgroup`. Of version 2
there is one line, `0::/PATH`, and a file `memory.max` in each folder from there up to the root; of version 1
a line `N:memory:/PATH`, and `memory.limit_in_bytes` below `memory/`. Within a container the path may be that
outside of it, which is not there; the root's file is.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path, PurePosixPath


def usable_memory(system: Path = Path("/")) -> int:
    """Bytes of memory that this process may use.

    Args:
        system: the folder that `proc` and `sys` lie in.
    """
    return min([os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"), *_limits(system)])


def _limits(system: Path) -> Iterator[int]:
    """The limits of the control groups that this process is in; none where there are none."""
    groups = system / "sys/fs/cgroup"
    for line in (_text(system / "proc/self/cgroup") or "").splitlines():
        _, controllers, path = [*line.split(":", 2), "", ""][:3]
        if not controllers:
            base, name = groups, "memory.max"
        elif "memory" in controllers.split(","):
            base, name = groups / "memory", "memory.limit_in_bytes"
        else:
            continue
        place = PurePosixPath("/") / path
        for folder in (place, *place.parents):
            text = _text(base / folder.relative_to("/") / name)
            if text is not None and text.strip().isdecimal() and int(text) > 0:  # `max` is no limit
                yield int(text)


def _text(file: Path) -> str | None:
    try:
        return file.read_text(encoding="ascii")
    except (OSError, ValueError):
        return None
