"""What the tests do to OpenGL in a process of its own: `gl_child.py meshes | thread | fork` prints JSON."""

from __future__ import annotations

import json
import os
import sys
import threading
from pathlib import Path

import numpy as np

from ocnf_data.errors import OcnfError
from ocnf_data.render import render_depth
from ocnf_data.views.rigs import fibonacci, intrinsics, look_from

K = intrinsics(60.0, 60.0, 31.0, 20.0)
R, T = look_from(fibonacci(1), 3.0)


def render(size: tuple[int, int] = (40, 60)) -> np.ndarray:
    corners = np.random.default_rng(0).uniform(-1, 1, (20_000, 3, 3))
    faces = np.arange(60_000).reshape(-1, 3)
    return render_depth(corners.reshape(-1, 3), faces, K, R, T, size, backend="pyrender")


def attempt() -> str:
    try:
        render()
    except OcnfError as error:
        return str(error)
    return "no error"


def meshes(n: int = 24) -> object:
    """Whether n renderings equal the first, with an image of another size between, and the growth in MB."""
    first, resident = render(), []
    render((30, 40))
    for _ in range(n):
        last = render()
        resident.append(int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE"))
    return {"same": bool(np.array_equal(first, last)), "growth": (resident[-1] - resident[n // 2]) / 2**20}


def thread() -> object:
    render()
    caught: list[str] = []
    other = threading.Thread(target=lambda: caught.append(attempt()))
    other.start()
    other.join()
    return caught[0]


def fork() -> object:
    render()
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        os.write(writer, attempt().encode())
        os._exit(0)
    os.waitpid(child, 0)
    return os.read(reader, 4096).decode()


if __name__ == "__main__":
    print(json.dumps({"meshes": meshes, "thread": thread, "fork": fork}[sys.argv[1]]()))
