"""Ground truth that epochs share: a cache that changes nothing but the time."""

from __future__ import annotations

import errno
import shutil
from pathlib import Path

import pytest

from ocnf_data import SynthesisDataset
from ocnf_data.synthesis import supply

N = 4


def open_set(manifest, cache, resolutions=(16, 32)):
    return SynthesisDataset(manifest, list(resolutions), "tsdf", batch_size=N, rank=0, world_size=1,
                            cache=cache)


def contents(dataset, epochs):
    return [(batch.keys, batch.meta, batch.slots, batch.arena.numpy().tobytes())
            for _ in range(epochs) for batch in dataset]


@pytest.fixture
def manifest(small):
    return small({"repeat": 3, "rotate": "any", "scale": [0.8, 1.0], "samples_per_epoch": N, "views": [1, 2]})


@pytest.fixture
def made(monkeypatch):
    """How many ground truths were made since."""
    found = []
    real = supply.make_truths

    def count(manifest, posed, resolutions):
        found.append(resolutions)
        return real(manifest, posed, resolutions)

    monkeypatch.setattr(supply, "make_truths", count)
    return found


def test_it_changes_no_sample_and_is_used(manifest, tmp_path, made):
    without = contents(open_set(manifest, None), 7)
    assert len(made) == 7 * N
    made.clear()
    assert contents(open_set(manifest, tmp_path), 7) == without
    assert len(made) == 3 * N  # seasons begin with the epochs 0, 3 and 6
    made.clear()
    assert contents(open_set(manifest, tmp_path), 1) == without[:1]  # another process, from the start again
    assert len(made) == N  # by then this season's were gone


def test_a_body_lasts_a_season_and_looks_do_not(manifest):
    dataset = open_set(manifest, None)
    epochs = [[meta for batch in dataset for meta in batch.meta] for _ in range(4)]
    body, look = ("source", "rotation", "scale"), ("views", "sigma", "directions")

    def facts(epoch, names):
        return [[meta[name] for name in names] for meta in epochs[epoch]]

    assert facts(0, body) == facts(1, body) == facts(2, body)
    assert facts(2, body) != facts(3, body)
    assert all(facts(a, look) != facts(b, look) for a, b in ((0, 1), (1, 2), (2, 3)))


def test_what_is_damaged_or_lacks_a_resolution_is_made_again(manifest, tmp_path, made):
    wanted = contents(open_set(manifest, None), 1)
    coarse = open_set(manifest, tmp_path, resolutions=(16,))
    contents(coarse, 1)
    made.clear()
    assert contents(open_set(manifest, tmp_path), 1) == wanted
    assert made == [(32,)] * N
    files = sorted(tmp_path.rglob("*.oct"))
    assert len(files) == 2 * N
    files[3].write_bytes(files[3].read_bytes()[:-7])
    files[6].write_bytes(b"")
    made.clear()
    assert contents(open_set(manifest, tmp_path), 1) == wanted
    assert len(made) == 2


def test_it_holds_a_few_seasons_only(manifest, tmp_path):
    contents(open_set(manifest, tmp_path), 13)  # seasons 0 to 4
    kept = sorted(folder.name for folder in tmp_path.glob("*/season-*"))
    assert kept == ["season-000003", "season-000004"]


def test_what_cannot_be_kept_changes_no_sample(manifest, tmp_path, made, monkeypatch, caplog):
    """No room, or no folder: every sample is made, none is drawn anew, and it is said once."""
    without = contents(open_set(manifest, None), 2)
    in_the_way = tmp_path / "file"
    in_the_way.touch()
    for cache in (in_the_way, tmp_path / "full"):
        if cache.name == "full":
            monkeypatch.setattr(Path, "write_bytes", no_room)
        caplog.clear()
        dataset = open_set(manifest, cache)
        batches = [batch for _ in range(2) for batch in dataset]
        assert [(batch.keys, batch.meta, batch.slots, batch.arena.numpy().tobytes())
                for batch in batches] == without
        assert not any(batch.lost for batch in batches)
        assert len([one for one in caplog.records if "cannot be kept" in one.message]) == 1


def no_room(path, data):
    raise OSError(errno.ENOSPC, "no space left on device", str(path))


def test_runs_in_other_seasons_leave_one_another_their_files(manifest, tmp_path, made):
    """One is four seasons ahead; epoch by epoch in turn, each makes its ground truths once a season."""
    ahead, behind = open_set(manifest, tmp_path), open_set(manifest, tmp_path)
    ahead.set_epoch(12)
    for _ in range(6):
        for dataset in (ahead, behind):
            contents(dataset, 1)
    assert len(made) == 2 * 2 * N
    contents(ahead, 4)  # alone now, it removes what nobody has used for a season
    assert {folder.name for folder in tmp_path.glob("*/season-*")} == {"season-000006", "season-000007"}


def test_a_folder_that_goes_while_it_is_written_to(manifest, tmp_path, monkeypatch):
    """Another process removes the season between the temporary file and its name."""
    without = contents(open_set(manifest, None), 1)
    replace = Path.replace

    def removed(path, target):
        shutil.rmtree(path.parent)
        return replace(path, target)

    monkeypatch.setattr(Path, "replace", removed)
    dataset = open_set(manifest, tmp_path)
    batches = list(dataset)
    assert [(b.keys, b.meta, b.slots, b.arena.numpy().tobytes()) for b in batches] == without
    assert not any(batch.lost for batch in batches)
