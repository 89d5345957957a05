"""Frames go to splits in time and to configurations by chance, none of them twice, the same each time."""

from __future__ import annotations

import subprocess
import sys
from itertools import combinations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ocnf_data.errors import OcnfError
from ocnf_data.sequences.configurations import Deal, split_in_time

COUNTS = st.fixed_dictionaries({split: st.integers(0, 9) for split in ("train", "val", "test")}).filter(
    lambda counts: any(counts.values()))


@given(n=st.integers(0, 300), counts=COUNTS, stretches=st.integers(1, 8), gap=st.integers(0, 20))
def test_splits_share_no_frame_and_keep_their_distance(n: int, counts: dict[str, int], stretches: int,
                                                       gap: int) -> None:
    found = split_in_time(n, counts, stretches, gap)
    assert set(found) == {split for split, count in counts.items() if count}
    for frames in found.values():
        assert list(frames) == sorted(set(frames)) and set(frames) <= set(range(n))
    for a, b in combinations(found.values(), 2):
        assert all(abs(i - j) > gap for i in a for j in b)
    if gap == 0:
        assert sorted(sum(found.values(), ())) == list(range(n))


@given(n=st.integers(1, 500), counts=COUNTS, stretches=st.integers(1, 5))
def test_each_split_gets_its_share_of_every_stretch(n: int, counts: dict[str, int], stretches: int) -> None:
    found = split_in_time(n, counts, stretches)
    total = sum(counts.values())
    for stretch in range(stretches):
        start, stop = n * stretch // stretches, n * (stretch + 1) // stretches
        for split, frames in found.items():
            inside = sum(start <= frame < stop for frame in frames)
            assert abs(inside - (stop - start) * counts[split] / total) < 1


def test_the_splits_follow_one_another_in_time() -> None:
    found = split_in_time(20, {"train": 2, "val": 1, "test": 1}, gap=2)
    assert found == {"train": tuple(range(8)), "val": (10, 11, 12), "test": (15, 16, 17, 18, 19)}


@given(frames=st.sets(st.integers(0, 999), min_size=1, max_size=60), size=st.integers(1, 12),
       seed=st.integers(0, 2**63 - 1))
def test_a_deal_is_disjoint_and_of_its_frames(frames: set[int], size: int, seed: int) -> None:
    deal = Deal(tuple(sorted(frames)), size, (seed, "kitchen", "test"))
    if deal.n_disjoint == 0:
        with pytest.raises(OcnfError, match="too few frames"):
            deal.check(1, False, "kitchen", "test")
        return
    for start in (0, deal.n_disjoint):  # the first deal, and the next
        subsets = [deal.subset(start + i) for i in range(deal.n_disjoint)]
        dealt = [frame for subset in subsets for frame in subset]
        assert len(set(dealt)) == len(dealt) == size * deal.n_disjoint and set(dealt) <= frames


def test_a_subset_depends_on_seed_scan_split_and_number_alone() -> None:
    code = ("from ocnf_data.sequences.configurations import Deal; "
            "print(Deal(tuple(range(100)), 10, (1, 'a', 'test')).subset(3))")
    there = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, text=True).stdout
    here = Deal(tuple(range(100)), 10, (1, "a", "test")).subset(3)
    assert there.strip() == str(here)
    others = {Deal(tuple(range(100)), 10, name).subset(3)
              for name in ((2, "a", "test"), (1, "b", "test"), (1, "a", "train"))}
    assert len({here, *others}) == 4
    assert list(here) != sorted(here)  # the first k of them would else be the earliest


def test_every_frame_is_drawn_about_as_often() -> None:
    deal = Deal(tuple(range(50)), 20, (0, "box", "test"))
    drawn = [frame for i in range(200) for frame in deal.subset(i)]
    counts = [drawn.count(frame) for frame in range(50)]
    assert min(counts) > 55 and max(counts) < 105  # 80 of 200: 6.9 is one standard deviation


def test_too_few_frames_are_refused_with_figures() -> None:
    deal = Deal(tuple(range(50)), 20, (0, "box", "test"))
    deal.check(2, True, "scans/box", "test")
    with pytest.raises(OcnfError) as caught:
        deal.check(20, True, "scans/box", "test")
    text = str(caught.value)
    assert "scans/box: source.configurations.test: too few frames" in text
    assert "found 50 frames for test" in text and "at least 400" in text
    assert "at most 2 configurations" in text and "disjoint: false" in text
    deal.check(20, False, "scans/box", "test")
