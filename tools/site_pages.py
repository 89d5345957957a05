"""Hooks of mkdocs: pages that lie elsewhere in the repository, and no network, now or when the site is read.

README.md is the site's first page; CONTRIBUTING.md, CHANGELOG.md and the pretrained network's card are pages
of it. Links between files of the repository are turned into links between pages, so that readers of both can
follow them.
"""

from __future__ import annotations

import posixpath
import re
import sys
from pathlib import Path
from typing import Any, Final

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parent.parent
PAGES: Final = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "ocnf_model/pretrained/README.md": "pretrained.md",
    "ocnf_model/pretrained/completion/README.md": "pretrained-completion.md",
    "ocnf_model/pretrained/scan/README.md": "pretrained-scan.md",
}
_LINK = re.compile(r"(\]\()([^)#:]+)([)#])")
# What a browser fetches by itself; an <a href> waits for a click.
_ELSEWHERE = r"[^>]+%s=\"?(?:https?:)?//[^ >]+"
_LOADED = re.compile(r"<(?:script|img|iframe|source)" + _ELSEWHERE % "src"
                     + r"|<link[^>]+rel=\"?(?:stylesheet|preload|preconnect|icon)" + _ELSEWHERE % "href")


def on_startup(command: str, **_: Any) -> None:
    """While the site is built, refuse every connection and every look-up of a name."""
    def refuse(event: str, arguments: tuple[Any, ...]) -> None:
        if event in ("socket.connect", "socket.getaddrinfo"):
            raise PluginError(f"building the site needs no network, but something asked for {arguments[-1]}")

    if command == "build":
        sys.addaudithook(refuse)


def page_of(file: str) -> str:
    """The page, relative to docs/, that a file of the repository is on the site."""
    return PAGES.get(file) or file.removeprefix("docs/")


def as_page(text: str, file: str) -> str:
    """The Markdown of a repository's file with its links turned into links between pages."""
    def link(found: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(file), found[2]))
        start = posixpath.dirname(page_of(file)) or "."
        return found[1] + posixpath.relpath(page_of(target), start) + found[3]

    return _LINK.sub(link, text)


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that lie outside docs/."""
    for file, page in PAGES.items():
        text = (ROOT / file).read_text(encoding="utf-8")
        wide = "---\nhide: [navigation]\n---\n\n" if page == "index.md" else ""
        files.append(File.generated(config, page, content=wide + as_page(text, file)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Turn the links of the pages in docs/."""
    uri = page.file.src_uri
    return markdown if uri in PAGES.values() else as_page(markdown, f"docs/{uri}")


def on_post_build(config: Any) -> None:
    """Refuse a site that fetches anything from another server."""
    for html in Path(config["site_dir"]).rglob("*.html"):
        if found := _LOADED.search(html.read_text(encoding="utf-8")):
            raise PluginError(f"{html} loads {found[0]} from elsewhere")
