"""Which frames of a scan are taken."""

from __future__ import annotations

import re
from numbers import Integral

from ocnf_data.errors import OcnfError
from ocnf_data.views.rigs import view_subset

_NUMBER = re.compile(r"[0-9]{1,18}")
_RANGE = re.compile(r"([0-9]{0,18}):([0-9]{0,18})(?::([0-9]{1,18}))?")


def choose(n: int, frames: str | int | None = None, every: int = 1) -> list[int]:
    """Positions, ascending, of the chosen among n frames in the order of the scan.

    Args:
        n: number of frames in the scan.
        frames: None: all. A number: that many, spread evenly from the first to the last. `START:STOP` or
            `START:STOP:STEP`: as Python's slices, STOP left out, either may be empty.
        every: take only every n-th of the frames that `frames` chooses.

    >>> choose(250, 3), choose(250, "100:120:5"), choose(10, every=4)
    ([0, 124, 249], [100, 105, 110, 115], [0, 4, 8])

    Raises:
        OcnfError: `frames` is neither, or beyond the n frames; `every` is no whole number above 0; or nothing
            is left (`empty`).
    """
    if not isinstance(every, Integral) or every < 1:
        raise OcnfError("not a step", where="read_scan", field="every", found=every, expected="1 or more")
    chosen = list(_chosen(n, frames))[::every]
    if not chosen:
        raise OcnfError("no frame is chosen", code="empty", field="frames", found=frames,
                        expected=f"some of the {n} frames, 0 to {n - 1}")
    return chosen


def _chosen(n: int, frames: str | int | None) -> range | list[int]:
    if frames is None:
        return range(n)
    text = str(frames).strip()
    if _NUMBER.fullmatch(text) and int(text) > 0:
        if int(text) > n:
            raise _too_few(n, text)
        return [int(i) for i in view_subset(n, int(text))]
    match = _RANGE.fullmatch(text)
    if match is None or (match[3] is not None and int(match[3]) == 0):
        raise OcnfError("not a choice of frames", field="frames", found=text,
                        expected="a number, such as 20 (evenly spread), or a range, such as 100:200:5")
    start, stop, step = (int(part) if part else None for part in match.groups())
    if max(start or 0, (stop or 0) - 1) >= n:
        raise _too_few(n, text)
    return range(n)[start:stop:step]


def _too_few(n: int, frames: str) -> OcnfError:
    return OcnfError("the scan has fewer frames", field="frames", found=frames,
                     expected=f"at most {n}, or a range within 0:{n}")
