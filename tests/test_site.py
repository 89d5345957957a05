"""The documentation site: built strictly, offline, and with a page for every public name."""

from __future__ import annotations

import os
import subprocess
import sys
import zlib
from pathlib import Path

import pytest

import ocnf_data
import ocnf_model

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    done = subprocess.run(command, cwd=ROOT, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
                          capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert not done.stderr
    return folder


def test_every_public_name_is_on_a_page(site: Path) -> None:
    inventory = (site / "objects.inv").read_bytes()
    body = zlib.decompress(inventory[inventory.index(b"zlib.\n") + 6:]).decode()
    documented = {line.split()[0].rpartition(".")[2] for line in body.splitlines()}
    public = {*ocnf_data.__all__, *ocnf_model.__all__, "tvl1"} - {"__version__"}
    assert public <= documented


def test_the_first_page_is_the_readme_and_its_links_lead_to_pages(site: Path) -> None:
    page = (site / "index.html").read_text(encoding="utf-8")
    assert "<h1 id=\"ocnf\">" in page
    for target in ("manifest.html", "semantics.html#promises", "contributing.html", "pretrained.html"):
        assert f'href="{target}"' in page
        assert (site / target.partition("#")[0]).is_file()
    assert 'href="docs/' not in page


@pytest.mark.parametrize("call", ["socket.create_connection(('127.0.0.1', 9), 1)",
                                  "socket.getaddrinfo('a.b', 1)"])
def test_the_build_refuses_the_network(call: str) -> None:
    code = (f"import sys; sys.path.insert(0, {str(ROOT / 'tools')!r}); import site_pages, socket\n"
            f"site_pages.on_startup(command='build')\n{call}")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "needs no network" in done.stderr


@pytest.mark.parametrize(("html", "wanted"), [
    ('<script src="https://cdn.example/x.js">', False),
    ('<link rel="stylesheet" href="//fonts.example/css">', False),
    ('<link rel="canonical" href="https://ocnf.example"><a href="https://arxiv.org">', True),
    ('<script src="assets/x.js"><link rel="stylesheet" href="assets/x.css">', True),
])
def test_a_page_that_loads_from_elsewhere_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                                     html: str, wanted: bool) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    import site_pages

    (tmp_path / "index.html").write_text(html)
    if wanted:
        site_pages.on_post_build({"site_dir": tmp_path})
    else:
        with pytest.raises(site_pages.PluginError, match="from elsewhere"):
            site_pages.on_post_build({"site_dir": tmp_path})
