"""Promises 5 and 11: every input is accounted for, and an item that misbehaves costs its row only."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ocnf_data.errors import OcnfError
from ocnf_data.generation import Report, generate
from ocnf_data.shards import load_dataset


def rows(out: Path) -> list[dict[str, str]]:
    return [json.loads(line) for line in (out / "failures.jsonl").read_text().splitlines()]


@pytest.fixture
def trouble(meshes) -> Path:
    """One of each kind of trouble among good items, one file under two names."""
    root = meshes([*(f"ok_{i}" for i in range(5)), "segfault_1", "hang_1", "refuse_1", "raise_1", "exit_1"])
    (root / "chair/train/zz-link.off").symlink_to(root / "chair/train/ok_1.off")
    return root


@pytest.mark.parametrize("jobs", [1, 2])
def test_inputs_are_samples_and_failures_and_exclusions(trouble, define, tmp_path, fake, jobs) -> None:
    out = tmp_path / "out"
    manifest = define(limits={"timeout_s": 1.0}, shards={"samples": 3})
    report = generate(manifest, out, trouble, jobs, progress=False)
    assert (report.items, report.samples, len(report.failures), len(report.exclusions)) == (11, 5, 5, 1)
    codes = {row["source"].rpartition("/")[2]: (row["stage"], row["code"]) for row in rows(out)}
    assert codes == {
        "segfault_1.off": ("render", "crash"), "exit_1.off": ("render", "crash"),
        "hang_1.off": ("render", "timeout"), "refuse_1.off": ("render", "empty"),
        "raise_1.off": ("render", "internal"), "zz-link.off": ("plan", "excluded"),
    }
    counts = load_dataset(str(out)).counts
    assert (counts.items, counts.samples, counts.failures, counts.exclusions) == (11, 5, 5, 1)
    assert not report.ok, "5 of 10 is more than the 5 % that are allowed"
    assert generate(manifest, out, trouble, progress=False).failures == report.failures


def test_a_shard_of_failures_only_is_done_all_the_same(meshes, define, tmp_path, fake) -> None:
    root, out = meshes(["refuse_1", "refuse_2"]), tmp_path / "out"
    report = generate(define(), out, root, progress=False)
    assert (report.samples, len(report.failures), report.ok) == (0, 2, False)
    assert generate(define(), out, root, progress=False).made == 0


def test_gaps_are_not_refilled(meshes, define, tmp_path, fake, contents) -> None:
    """A failure changes its own shard and no other."""
    root, out = meshes([*(f"ok_{i}" for i in range(11)), "refuse-unfixed_1"]), tmp_path / "out"
    generate(define(), out, root, progress=False)
    (root / ".fixed").touch()
    generate(define(), tmp_path / "whole", root, progress=False)
    before, after = contents(out), contents(tmp_path / "whole")
    tars = [name for name in before if name.endswith(".tar")]
    assert len(tars) == 3
    assert sum(before[name] != after[name] for name in tars) == 1


def test_retry_failed_makes_just_their_shards(meshes, define, tmp_path, fake, contents) -> None:
    root, out = meshes([*(f"ok_{i}" for i in range(11)), "segfault-unfixed_1"]), tmp_path / "out"
    generate(define(), out, root, progress=False)
    (root / ".fixed").touch()
    assert generate(define(), out, root, progress=False).made == 0, "resuming keeps the rows"
    assert len(rows(out)) == 1
    kept = {path: path.stat().st_mtime_ns for path in out.glob("train/*.tar")}
    report = generate(define(), out, root, retry_failed=True, progress=False)
    assert (report.made, report.samples, report.failures) == (4, 12, ())
    assert sum(path.stat().st_mtime_ns != stamp for path, stamp in kept.items()) == 1
    generate(define(), tmp_path / "whole", root, progress=False)
    assert contents(out) == contents(tmp_path / "whole"), "as if it had never failed"


def test_lost_failure_rows_are_found_again(meshes, define, tmp_path, fake, contents) -> None:
    """A shard whose rows are gone does not account for its items any more, so it is not done."""
    root, out = meshes([*(f"ok_{i}" for i in range(5)), "refuse_1"]), tmp_path / "out"
    generate(define(), out, root, progress=False)
    before = contents(out)
    (rows,) = out.glob("failures/*.jsonl")
    rows.unlink()
    (out / "failures.jsonl").unlink()
    assert generate(define(), out, root, progress=False).made in (2, 4)
    assert contents(out) == before


def test_a_file_that_cannot_be_read_is_a_row(define, meshes, tmp_path) -> None:
    """With the real maker: a folder with a mesh's name is found while planning, and reported by its item."""
    root, out = meshes(["a"]), tmp_path / "out"
    (root / "chair/train/b.off").mkdir()
    report = generate(define(), out, root, progress=False)
    assert [(f.stage, f.code) for f in report.failures] == [("read", "unreadable")]
    assert report.samples == 1


@pytest.mark.parametrize(("names", "category", "code"), [
    (["ok_1"], "table", "missing"), ([], "chair", "empty")])
def test_a_missing_or_empty_category(meshes, define, tmp_path, fake, names, category, code) -> None:
    source = {"kind": "modelnet", "categories": [category], "counts": {"train": "all"}}
    with pytest.raises(OcnfError) as caught:
        generate(define(source=source), tmp_path / "out", meshes(names), progress=False)
    assert caught.value.code == code
    assert category in str(caught.value)
    assert not (tmp_path / "out/plan.json").exists()


def test_missing_meshes(define, tmp_path) -> None:
    with pytest.raises(OcnfError, match="--meshes ROOT"):
        generate(define(), tmp_path / "out", progress=False)
    with pytest.raises(OcnfError, match="is not there"):
        generate(define(), tmp_path / "out", tmp_path / "nowhere", progress=False)


def test_an_output_that_cannot_be_a_folder(define, meshes, tmp_path, fake) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OcnfError, match="file"):
        generate(define(), tmp_path / "file/out", meshes(["ok_1"]), progress=False)


def test_the_report_decides_on_the_threshold() -> None:
    def report(samples: int, failures: int, threshold: float) -> Report:
        return Report("", samples + failures, samples, (None,) * failures, (), 0, 0, 1.0, threshold)  # type: ignore[arg-type]

    assert report(19, 1, 0.05).ok
    assert not report(18, 2, 0.05).ok
    assert not report(0, 0, 1.0).ok
