"""The order and its partition, against the definition written out naively."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ocnf_data.errors import OcnfError
from ocnf_data.loading.order import Partition, Uneven, epoch_order

GOLDEN = [[8, 5, 9, 4, 1, 7, 0, 6, 3, 2], [2, 1, 3, 0, 8, 5, 4, 9, 6, 7]]

sizes_of_shards = st.lists(st.integers(0, 9), min_size=1, max_size=12).filter(lambda sizes: sum(sizes) > 0)


@given(sizes_of_shards, st.integers(0, 3), st.integers(0, 3), st.integers(1, 40))
def test_order_is_shards_permuted_then_windows_permuted(sizes, seed, epoch, buffer):
    order = epoch_order(sizes, seed, epoch, buffer).tolist()
    shards_alone = epoch_order(sizes, seed, epoch, 1).tolist()
    ids = iter(range(sum(sizes)))
    shard_of = [shard for shard, size in enumerate(sizes) for _ in range(size)]
    members = [[next(ids) for _ in range(size)] for size in sizes]

    met = list(dict.fromkeys(shard_of[sample] for sample in shards_alone))
    assert shards_alone == [sample for shard in met for sample in members[shard]]
    for start in range(0, sum(sizes), buffer):
        window = slice(start, start + buffer)
        assert sorted(order[window]) == sorted(shards_alone[window])


@given(sizes_of_shards, st.integers(0, 3), st.integers(0, 3))
def test_order_without_shuffling_is_that_of_the_shards(sizes, seed, epoch):
    assert epoch_order(sizes, seed, epoch, 4, shuffle=False).tolist() == list(range(sum(sizes)))


def test_order_differs_between_epochs_and_seeds_and_repeats_for_equal_ones():
    def orders():
        return [tuple(epoch_order([7] * 9, seed, epoch, 20)) for seed in range(4) for epoch in range(4)]

    assert len(set(orders())) == 16
    assert orders() == orders()


def test_order_is_the_same_on_every_machine_and_numpy():
    """A golden value: a state saved today resumes in this order for ever."""
    assert epoch_order([3, 1, 4, 2], 0, 0, 4).tolist() == GOLDEN[0]
    assert epoch_order([3, 1, 4, 2], 0, 1, 4).tolist() == GOLDEN[1]


def test_every_place_is_equally_likely():
    """Chi-square of where sample 0 lands, over epochs: 99 degrees of freedom, mean 99, deviation 14."""
    orders = np.array([epoch_order([10] * 10, 5, epoch, 100) for epoch in range(3000)])
    places = np.nonzero(orders == 0)[1]
    counts = np.bincount(places, minlength=100)
    assert ((counts - 30.0) ** 2 / 30.0).sum() < 99 + 5 * 14


@settings(max_examples=200)
@given(st.integers(1, 60), st.integers(1, 7), st.integers(1, 6))
def test_training_batches_partition_the_order_and_fill_the_tail_with_its_beginning(n, batch, world):
    ranks = [Partition(n, batch, rank, world, Uneven.REPEAT) for rank in range(world)]
    n_batches = math.ceil(n / (world * batch))
    assert [part.n_batches for part in ranks] == [n_batches] * world
    walk = [met for step in range(n_batches) for part in ranks
            for met in zip(*part.places(step), strict=True)]
    assert walk == [(i % n, i >= n) for i in range(n_batches * world * batch)]


@settings(max_examples=200)
@given(st.integers(1, 60), st.integers(1, 7), st.integers(1, 6))
def test_drop_last_meets_whole_batches_only(n, batch, world):
    if n < world * batch:
        with pytest.raises(OcnfError, match="drop_last leaves nothing"):
            Partition(n, batch, 0, world, Uneven.DROP)
        return
    ranks = [Partition(n, batch, rank, world, Uneven.DROP) for rank in range(world)]
    walk = [place for step in range(ranks[0].n_batches) for part in ranks for place in part.places(step)[0]]
    assert walk == list(range(n // (world * batch) * (world * batch)))


@settings(max_examples=200)
@given(st.integers(1, 60), st.integers(1, 7), st.integers(1, 6))
def test_exact_meets_every_sample_once_and_no_batch_is_empty(n, batch, world):
    seen = []
    for rank in range(world):
        part = Partition(n, batch, rank, world, Uneven.EXACT)
        batches = [part.places(step) for step in range(part.n_batches)]
        assert all(len(places) and not repeat.any() for places, repeat in batches)
        assert len(part.places(part.n_batches)[0]) == 0
        seen += [place for places, _ in batches for place in places]
    assert sorted(seen) == list(range(n))


@given(st.integers(1, 40), st.integers(1, 5), st.integers(1, 4), st.integers(0, 60))
def test_spares_are_the_others_in_order_from_behind_the_batch(n, batch, world, step):
    part = Partition(n, batch, world - 1, world, Uneven.REPEAT)
    step %= part.n_batches
    own = set(part.places(step)[0].tolist())
    behind = (step * world + world) * batch
    expected = [place % n for place in range(behind, behind + n) if place % n not in own]
    assert list(part.spares(step)) == expected
    assert sorted(expected) == sorted(set(range(n)) - own)


@pytest.mark.parametrize(("field", "values"), [
    ("batch_size", (0, 0, 1)), ("batch_size", (True, 0, 1)), ("rank", (1, 2, 2)), ("rank", (1, -1, 2)),
    ("world_size", (1, 0, 0)), ("batch_size", (1.0, 0, 1)),
])
def test_impossible_partitions_are_refused_by_name(field, values):
    batch, rank, world = values
    with pytest.raises(OcnfError, match=field):
        Partition(10, batch, rank, world, Uneven.REPEAT)
