"""Fixtures that several test folders use."""

from __future__ import annotations

import base64
import importlib
import json
import re
import shutil
import signal
import sys
import uuid
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser

Decoded = tuple[dict[str, np.ndarray], dict[str, Any]]


def pytest_configure() -> None:
    """Let the commands that tests start be interrupted, though a shell's background jobs ignore Ctrl-C."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The slow tests first: one of them at the end would keep all but one core waiting."""
    items.sort(key=lambda item: item.get_closest_marker("slow") is None)


@pytest.fixture(scope="session")
def load_bench() -> Callable[[str], Any]:
    """Imports a script of `tools/bench` by its name."""
    folder = str(Path(__file__).parents[1] / "tools" / "bench")

    def load(name: str) -> Any:
        sys.path.insert(0, folder)  # scripts import one another
        try:
            return importlib.import_module(name)
        finally:
            sys.path.remove(folder)

    return load


@pytest.fixture(scope="session")
def _s3_endpoint() -> Iterator[str]:
    """A local S3 server (moto), which worker processes reach too."""
    moto = pytest.importorskip("moto.server", reason="moto[server] is not installed")
    pytest.importorskip("s3fs", reason="s3fs is not installed")
    server = moto.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    yield f"http://{host}:{port}"
    server.stop()


@pytest.fixture
def s3_url(_s3_endpoint: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """The URL `s3://bucket` of an empty bucket, with the environment set so that child processes find it."""
    import s3fs

    for name, value in {
        "AWS_ACCESS_KEY_ID": "testing",
        "AWS_SECRET_ACCESS_KEY": "testing",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_ENDPOINT_URL": _s3_endpoint,
    }.items():
        monkeypatch.setenv(name, value)
    for name in ("HTTP_PROXY", "HTTPS_PROXY", "http_proxy", "https_proxy", "AWS_PROFILE"):
        monkeypatch.delenv(name, raising=False)
    bucket = f"bucket-{uuid.uuid4().hex}"
    # An instance made with other settings in this process would be handed out again.
    s3fs.S3FileSystem.clear_instance_cache()
    s3fs.S3FileSystem().mkdir(bucket)
    return f"s3://{bucket}"


def _decode(text: str) -> Decoded:
    """What `ocnf_data.report.blob` packed, number by number from its description."""
    raw = zlib.decompress(base64.b64decode(text))
    end = 4 + int.from_bytes(raw[:4], "little")
    header = json.loads(raw[4:end])
    arrays = {}
    for name, (kind, shape, offset, coding) in header["arrays"].items():
        width = np.dtype(kind).itemsize
        n = int(np.prod(shape))
        part = np.frombuffer(raw[end + offset : end + offset + n * width], np.uint8).reshape(width, n)
        numbers = (256 ** np.arange(width)) @ part.astype(np.int64)
        if coding == "delta":
            numbers = np.cumsum(numbers.reshape(shape), axis=0) % 256**width
        arrays[name] = numbers.reshape(shape)
    return arrays, header["meta"]


@pytest.fixture(scope="session")
def decode_blob() -> Callable[[str], Decoded]:
    """The arrays and the rest of what `ocnf_data.report.blob` packed."""
    return _decode


@pytest.fixture(scope="session")
def read_page() -> Callable[[Path], tuple[dict[str, Any], Callable[[int], Decoded]]]:
    """What a page says, and a function that gives the arrays and the rest of a sample by its number."""

    def read(path: Path) -> tuple[dict[str, Any], Callable[[int], Decoded]]:
        text = path.read_text(encoding="utf-8")
        [found] = re.findall(r'<script type="application/json" id="page-data">(.*?)</script>', text)
        page = json.loads(found)

        def sample(number: int) -> Decoded:
            if page["folder"]:
                script = (path.parent / page["folder"] / f"{number:06d}.js").read_text()
                [(n, key, blob)] = re.findall(r'^ocnfReceive\((\d+),(".*"),"([^"]*)"\)$', script)
                assert (int(n), json.loads(key)) == (number, page["samples"][number]["key"])
            else:
                [blob] = re.findall(rf'<script type="text/plain" id="geometry-{number}">(.*?)</script>', text)
            return _decode(blob)

        return page, sample

    return read


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """A real Chromium without a window, which draws WebGL with the processor."""
    driver = pytest.importorskip("playwright.sync_api", reason="the pages are not looked at: no playwright")
    program = next((found for name in ("chromium", "chromium-browser", "google-chrome", "chrome")
                    if (found := shutil.which(name))), None)
    with driver.sync_playwright() as playwright:
        if program is None and not Path(playwright.chromium.executable_path).is_file():
            pytest.skip("the pages are not looked at: no Chromium here (apt-get install chromium)")
        chromium = playwright.chromium.launch(executable_path=program, args=[
            "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"])
        yield chromium
        chromium.close()
