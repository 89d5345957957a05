"""Whatever the documents and the code refer to is there: sections, files, links, commands, codes."""

from __future__ import annotations

import ast
import re
import shlex
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
import typer

import ocnf_data.cli
import ocnf_model.cli
from ocnf_data.generation.worker.supervisor import FATAL_CODES

ROOT = Path(__file__).parent.parent
PAGES = sorted(path for pattern in ("*.md", "docs/**/*.md", "ocnf_model/pretrained/*.md")
               for path in ROOT.glob(pattern))
CODE = sorted(path for folder in ("ocnf_data", "ocnf_model", "tools", "tests", "manifests", "examples")
              for path in (ROOT / folder).rglob("*") if path.suffix in (".py", ".yaml", ".sh"))
THIS = Path(__file__)
COMMANDS = {"ocnf-data": ocnf_data.cli.app, "ocnf-model": ocnf_model.cli.app}


def name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@cache
def text_of(path: Path) -> str:
    return path.read_text(encoding="utf-8")


# ---- citations of docs/semantics.md


def test_every_cited_section_and_promise_exists() -> None:
    semantics = text_of(ROOT / "docs/semantics.md")
    sections = set(re.findall(r"^## (\d+)\. ", semantics, re.MULTILINE))
    promises = set(re.findall(r"^(\d+)\. \*\*", semantics.split("## Promises")[1], re.MULTILINE))
    assert len(sections) == 6 and len(promises) == 11
    cited = 0
    for path in [*PAGES, *CODE]:
        if path == THIS:
            continue
        for number in re.findall(r"SEMANTICS\b ?(\d*)", text_of(path)):
            assert number in sections, f"{name(path)} cites SEMANTICS {number}"
            cited += 1
        for number in re.findall(r"\bpromise (\d+)", text_of(path)):
            assert number in promises, f"{name(path)} cites promise {number}"
    assert cited >= 20


def test_no_document_is_cited_that_is_not_here() -> None:
    """Documents are cited as `docs/...` or by the name SEMANTICS, not by names of notes that are not here."""
    note = re.compile(r"\b(?:DESIGN|FINDINGS|HOUSE|STYLE|CONVENTIONS)\b(?!\.)")
    found = {name(path): cited for path in [*PAGES, *CODE] if path != THIS
             if (cited := note.findall(text_of(path)))}
    assert found == {}


# ---- files and links


def anchors(page: str) -> set[str]:
    """The anchors of a page's headings, as GitHub and mkdocs make them."""
    headings = re.findall(r"^#+ (.*)$", re.sub(r"```.*?```", "", page, flags=re.DOTALL), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("path", PAGES, ids=name)
def test_links_lead_somewhere(path: Path) -> None:
    page = re.sub(r"```.*?```", "", text_of(path), flags=re.DOTALL)
    for link in re.findall(r"\]\(([^)\s]+)\)", page):
        if link.startswith("https://"):
            continue
        target, _, anchor = link.partition("#")
        file = (path.parent / target).resolve() if target else path
        assert file.is_file(), f"{link} leads to nothing"
        if anchor:
            assert anchor in anchors(text_of(file)), f"{link}: no such heading"


def is_here(file: str) -> bool:
    """Whether a file or folder is in the repository; `*` stands for anything."""
    return any(ROOT.glob(file.rstrip("/")))


def test_files_that_are_named_are_there() -> None:
    """`docs/format.md`, `tools/bench/conv.py` and the like, in prose, comments and docstrings."""
    path_like = re.compile(r"(?<![\w./*-])(?:docs|tools|tests|manifests|examples|ocnf_data|ocnf_model)"
                           r"/[\w./*-]*[\w*]\.(?:py|md|yaml|sh|svg|png|txt)\b")
    named = [(name(path), file) for path in [*PAGES, *CODE] for file in path_like.findall(text_of(path))]
    assert len(named) > 50
    assert [(path, file) for path, file in named if not is_here(file)] == []


@pytest.mark.parametrize("path", PAGES, ids=name)
def test_folders_and_files_in_backticks_are_there(path: Path) -> None:
    tops = {file.name for file in ROOT.iterdir()}
    for quoted in re.findall(r"`([\w.-]+(?:/[\w.*-]+)*/?)`", text_of(path)):
        top = quoted.split("/")[0]
        if ("/" in quoted and top in tops) or quoted in ("constraints.txt", "CITATION.cff", ".ci/run"):
            assert is_here(quoted), f"{quoted} is not in the repository"


# ---- commands


def code_of(path: Path) -> list[str]:
    """The lines of a page's code: fenced, indented, or in backticks."""
    fenced = re.findall(r"```\w*\n(.*?)```", text_of(path), re.DOTALL)
    rest = re.sub(r"```.*?```", "", text_of(path), flags=re.DOTALL)
    inline = re.findall(r"^    (.*)$|`([^`\n]+)`", rest, re.MULTILINE)
    return [line for block in fenced for line in block.splitlines()] + ["".join(pair) for pair in inline]


def command_lines(path: Path) -> Iterator[list[str]]:
    """The words of every `ocnf-data ...` or `ocnf-model ...` in a page, comments apart."""
    for line in code_of(path):
        if re.match(r"ocnf-(?:data|model) [a-z]", line):
            yield shlex.split(line.partition("#")[0].replace("...", ""), posix=False)


@pytest.mark.parametrize("path", PAGES, ids=name)
def test_commands_and_their_options_exist(path: Path) -> None:
    for program, subcommand, *words in command_lines(path):
        known = typer.main.get_group(COMMANDS[program]).commands
        assert subcommand in known, f"{program} {subcommand}"
        command = known[subcommand]
        if isinstance(command, typer.core.TyperGroup):
            inner, *words = words
            assert inner in command.commands, f"{program} {subcommand} {inner}"
            command = command.commands[inner]
        options = {option for parameter in command.params
                   for option in [*parameter.opts, *parameter.secondary_opts]}
        unknown = {word for word in words if word.startswith("--")} - options
        assert not unknown, f"{program} {subcommand} {unknown}"


def test_every_subcommand_is_in_a_page() -> None:
    shown = {(program, subcommand) for path in PAGES for program, subcommand, *_ in command_lines(path)}
    assert shown >= {(program, subcommand) for program, app in COMMANDS.items()
                     for subcommand in typer.main.get_group(app).commands}


def test_make_targets_exist() -> None:
    targets = set(re.findall(r"^([a-z]+):", text_of(ROOT / "Makefile"), re.MULTILINE))
    shown = {target for path in PAGES for line in code_of(path)
             for target in re.findall(r"^make ([a-z]+)\b", line)}
    assert {"demo", "docs", "setup"} <= shown <= targets


# ---- codes of errors


def table(heading: str) -> set[str]:
    """The codes in one of the tables of docs/errors.md."""
    part = text_of(ROOT / "docs/errors.md").split(f"<!-- {heading} -->")[1].split("<!-- end of codes -->")[0]
    return set(re.findall(r"^\| `(\w+)` \|", part, re.MULTILINE))


def codes_in(path: Path) -> set[str]:
    """The codes that a module gives: `code="..."`, and the first text of what records a fault."""
    found = set()
    for node in ast.walk(ast.parse(text_of(path))):
        if isinstance(node, ast.Call):
            called = getattr(node.func, "attr", getattr(node.func, "id", ""))
            values = [word.value for word in node.keywords if word.arg == "code"]
            if called in ("Fault", "ChildDiedError"):
                values += node.args[:1]
            elif called == "add" and node.args and isinstance(node.func, ast.Name | ast.Attribute):
                # report.add(file, code, ...) of a data set, report.add(code, ...) of a shard
                values += node.args[:2] if path.name != "check.py" else node.args[:1]
            found |= {leaf.value for value in values for leaf in ast.walk(value)
                      if isinstance(leaf, ast.Constant) and isinstance(leaf.value, str)}
        elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Tuple):
            for target, value in zip(node.targets[0].elts, getattr(node.value, "elts", []), strict=False):
                if getattr(target, "id", "") == "code" and isinstance(value, ast.Constant):
                    found.add(value.value)
    return {code for code in found if re.fullmatch(r"[a-z][a-z0-9_]*", code)}


# What makes a sample out of an item; what it raises becomes a row of failures.jsonl.
MAKES_SAMPLES = ("meshes/formats", "meshes/read.py", "meshes/topology.py", "render", "fusion",
                 "views/rigs.py", "views/noise.py", "octree/grid.py", "octree/stored.py",
                 "generation/sample.py", "generation/worker", "files/storage.py",
                 "files/storage_errors.py", "shards/writer.py")
BUILT_IN = {"excluded", "invalid"}
INTERNAL = {"idle"}
"""A child process ended because there was no work; the error never leaves the supervisor."""


def sources(*folders: str) -> Iterator[Path]:
    for folder in folders:
        place = ROOT / folder
        yield from [place] if place.is_file() else place.rglob("*.py")


def test_every_code_has_a_row_and_every_row_a_code() -> None:
    given = set().union(*map(codes_in, sources("ocnf_data", "ocnf_model"))) | BUILT_IN
    storage = text_of(ROOT / "ocnf_data/files/storage_errors.py")
    given |= set(re.findall(r': \("(\w+)", ', storage))  # by errno
    listed = table("codes of failures.jsonl") | table("other codes")
    assert given - INTERNAL - listed == set(), "a row in docs/errors.md, with meaning and what to do"
    assert listed - given == set()
    assert not table("codes of failures.jsonl") & table("other codes")


def test_what_makes_samples_gives_codes_of_the_first_table() -> None:
    given = set().union(*map(codes_in, sources(*(f"ocnf_data/{place}" for place in MAKES_SAMPLES))))
    rows = table("codes of failures.jsonl")
    elsewhere = FATAL_CODES | INTERNAL | {"start"}
    assert given - rows <= elsewhere
    assert not FATAL_CODES & rows
    assert len(given & rows) > 10


def test_every_stage_is_named() -> None:
    page = text_of(ROOT / "docs/errors.md")
    stages = re.findall(r'stages\("([\w ]+)"\)', text_of(ROOT / "ocnf_data/generation/sample.py"))
    assert len(stages) > 5
    assert all(f"`{stage}`" in page for stage in [*stages, "plan", "start", "write"])
