"""Messages between a worker and its child over two pipes: JSON and raw bytes, nothing to be unpickled.

    | b"ocnf" | u32 size of the header, little-endian | header: UTF-8 JSON object | payloads, back to back |

`header["payloads"]` lists their sizes.
"""

from __future__ import annotations

import json
import os
import select
import struct
import time
from collections.abc import Sequence
from typing import Any

_MAGIC = b"ocnf"
_PREFIX = struct.Struct("<4sI")
_LONGEST_POLL = 3600.0  # seconds; poll takes milliseconds as a C int, which 25 days overflow


class BrokenFrameError(Exception):
    """What arrived is not a message: the other side printed into the pipe, or died within one."""


def write_frame(fd: int, header: dict[str, Any], payloads: Sequence[bytes] = ()) -> None:
    """Send one message. Raises BrokenPipeError where nobody reads any more."""
    text = json.dumps({**header, "payloads": [len(part) for part in payloads]}).encode()
    for part in (_PREFIX.pack(_MAGIC, len(text)) + text, *payloads):
        view = memoryview(part)
        while view:
            view = view[os.write(fd, view):]


def read_frame(fd: int, deadline: float | None = None) -> tuple[dict[str, Any], list[bytes]]:
    """Receive one message as (header, payloads).

    Args:
        fd: the pipe's reading end.
        deadline: time on the clock of `time.monotonic`, in seconds; None waits for ever.

    Raises:
        EOFError: the other side closed the pipe between two messages.
        BrokenFrameError: it closed it within one, or sent something else.
        TimeoutError: the deadline passed.
    """
    magic, size = _PREFIX.unpack(_read(fd, _PREFIX.size, deadline, first=True))
    if magic != _MAGIC:
        raise BrokenFrameError(f"unexpected bytes in the pipe: {magic!r}")
    header = json.loads(_read(fd, size, deadline))
    return header, [_read(fd, part, deadline) for part in header.pop("payloads")]


def _read(fd: int, size: int, deadline: float | None, first: bool = False) -> bytes:
    data = bytearray(size)
    view = memoryview(data)
    while view:
        if deadline is not None:
            _wait(fd, deadline)
        n = os.readv(fd, [view])
        if n == 0:
            if first and len(view) == size:
                raise EOFError("the pipe is closed")
            raise BrokenFrameError("the pipe was closed within a message")
        view = view[n:]
    return bytes(data)


def _wait(fd: int, deadline: float) -> None:
    poll = select.poll()  # not select.select, which fails for descriptors of 1024 and above
    poll.register(fd, select.POLLIN)
    while (left := deadline - time.monotonic()) > 0:
        if poll.poll(min(left, _LONGEST_POLL) * 1000):
            return
    raise TimeoutError("no message before the deadline")
