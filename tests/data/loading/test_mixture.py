"""`MixtureDataset`: parts by weight, each sample a pure function of (seed, epoch, number)."""

from __future__ import annotations

import numpy as np
import pytest
from torch.utils.data import DataLoader

from ocnf_data import MixtureDataset, ShardDataset
from ocnf_data.errors import OcnfError
from ocnf_data.files.records import canonical_json, sha256_hex
from ocnf_data.loading.augment import Augment, draw_symmetry

N = 60


@pytest.fixture(scope="module")
def two(sets, tmp_path_factory):
    """Two data sets: one with two variants, and another one of 3 samples."""
    folder = tmp_path_factory.mktemp("mixture")
    inputs = {"v1": ["histogram"], "v4": ["histogram"]}
    return (
        sets.write(folder / "a", {"train": [4, 3]}, inputs),
        sets.write(folder / "b", {"train": [3]}, {"v2": ["histogram"]}, prefix="t"),
    )


def part(url, variant, **arguments):
    return ShardDataset(
        url, "train", [16, 32], "histogram", variant=variant, rank=0, world_size=1, **arguments
    )


def mixed(two, weights=(2, 1, 1), **arguments):
    parts = [
        (part(two[0], "v4"), weights[0]),
        (part(two[0], "v1"), weights[1]),
        (part(two[1], "v2"), weights[2]),
    ]
    return MixtureDataset(
        parts, **{"samples_per_epoch": N, "batch_size": 4, "rank": 0, "world_size": 1, **arguments}
    )


def contents(batch):
    return batch.epoch, batch.step, batch.keys, batch.repeat, batch.slots, batch.arena.numpy().tobytes()


def test_samples_are_those_of_the_parts_under_one_name(two):
    dataset = mixed(two)
    batch = next(iter(dataset))
    assert {slot.member for slot in batch.slots} == {
        f"{kind}-{res}.oct" for kind in ("mixture-histogram", "target") for res in (16, 32)
    }
    # the same octrees as the parts', found by key: keys s... are of the first set, t... of the second
    stored = {}
    for variant, url in (("v1", two[0]), ("v4", two[0]), ("v2", two[1])):
        for one in part(url, variant):
            stored[one.keys[0], variant] = one.inputs[32].grids()[0]
    for i, (key, grid) in enumerate(zip(batch.keys, batch.inputs[32].grids(), strict=True)):
        of_part, _ = dataset.supply().place(0, i)
        np.testing.assert_array_equal(grid.data, stored[key, ("v4", "v1", "v2")[of_part]].data)
        assert key.startswith("st"[of_part == 2])


def test_each_part_comes_in_its_own_order_and_begins_again_at_its_end(two):
    dataset = mixed(two)
    for epoch in range(2):
        keys = [key for batch in dataset for key in batch.keys]
        assert len(keys) == N
        parts = [dataset.supply().place(epoch, i) for i in range(N)]
        for number, (url, variant) in enumerate(((two[0], "v4"), (two[0], "v1"), (two[1], "v2"))):
            alone = part(url, variant)
            alone.set_epoch(epoch)
            order = [batch.keys[0] for batch in alone]
            met = [key for key, (p, _) in zip(keys, parts, strict=True) if p == number]
            assert met == [order[i % len(order)] for i in range(len(met))]
            assert [n for p, n in parts if p == number] == list(range(len(met)))


def test_parts_are_drawn_by_weight(two):
    place = mixed(two, weights=(1, 2.5, 0.5)).supply().place
    share = np.bincount([place(3, i)[0] for i in range(4000)]) / 4000
    np.testing.assert_allclose(share, [0.25, 0.625, 0.125], atol=0.03)  # 3.8 standard deviations
    assert [place(0, i)[0] for i in range(50)] != [place(1, i)[0] for i in range(50)]
    assert place(0, 5) == place(0, 5)
    late = mixed(two, weights=(1, 2.5, 0.5)).supply().place
    assert late(3, 3999) == place(3, 3999)  # asked for first or last, it is the same


@pytest.mark.parametrize("world", [1, 2, 3])
def test_ranks_share_what_one_alone_would_meet(two, world):
    alone = [
        (key, grid.data.tobytes())
        for batch in mixed(two, batch_size=1)
        for key, grid in zip(batch.keys, batch.inputs[16].grids(), strict=True)
    ]
    ranks = [list(mixed(two, batch_size=2, rank=rank, world_size=world)) for rank in range(world)]
    assert len({len(batches) for batches in ranks}) == 1
    met = [
        (key, grid.data.tobytes(), again)
        for step in zip(*ranks, strict=True)
        for batch in step
        for key, grid, again in zip(batch.keys, batch.inputs[16].grids(), batch.repeat, strict=True)
    ]
    assert [one[:2] for one in met[:N]] == alone
    assert [one[2] for one in met] == [False] * N + [True] * (len(met) - N)


@pytest.mark.parametrize("workers", [0, 2])
def test_a_state_resumes_exactly_with_another_number_of_workers(two, workers):
    whole = mixed(two, augment="all")
    wanted = [contents(batch) for _ in range(2) for batch in whole]
    dataset, met = mixed(two, augment="all"), []
    for batch in DataLoader(dataset, batch_size=None, num_workers=workers):
        met.append(contents(batch))
        state = dataset.state_dict(batch)
        if batch.step == 6:
            break
    resumed = mixed(two, augment="all")
    resumed.load_state_dict(state)
    loader = DataLoader(resumed, batch_size=None, num_workers=(workers + 1) % 3)
    met += [contents(batch) for _ in range(2) for batch in loader]
    assert met == wanted


def test_a_state_of_another_mixture_is_refused(two):
    state = mixed(two).state_dict()
    for other in (
        mixed(two, weights=(2, 1, 2)),
        mixed(two, samples_per_epoch=N + 4),
        mixed(two, seed=1),
        mixed(two, augment="flips"),
    ):
        with pytest.raises(OcnfError, match="another order") as caught:
            other.load_state_dict(state)
        assert caught.value.code == "state"


@pytest.mark.parametrize("changed", [{"seed": 5}, {"shuffle": False}, {"buffer": 1}], ids=str)
def test_a_state_of_parts_in_another_order_is_refused(two, changed):
    def of(**arguments):
        parts = [(part(two[0], "v4", **arguments), 1), (part(two[1], "v2"), 1)]
        return MixtureDataset(parts, N, rank=0, world_size=1)

    state = of().state_dict()
    of().load_state_dict(state)
    with pytest.raises(OcnfError, match="parts: the state is of a run with another order"):
        of(**changed).load_state_dict(state)
    before = {name: value for name, value in state.items() if name != "parts"}  # of an earlier version
    of().load_state_dict(before)


def showings(dataset, epoch=0):
    """(key, symmetry, what is drawn by) of each sample of an epoch."""
    dataset.set_epoch(epoch)
    return [one for batch in dataset for one in zip(batch.keys, batch.symmetries, batch.draws, strict=True)]


def test_a_sample_that_comes_again_in_an_epoch_is_drawn_for_anew(two):
    def once(epoch):
        alone = part(two[0], "v4", augment="all")
        alone.set_epoch(epoch)
        return [(batch.keys[0], batch.symmetries[0], batch.draws[0]) for batch in alone]

    mixture = MixtureDataset([(part(two[0], "v4"), 1)], N, rank=0, world_size=1, augment="all")
    for epoch in range(2):
        met = showings(mixture, epoch)
        assert met[:7] == once(epoch)  # the first round is a plain pass
        assert len({draw for _, _, draw in met}) == N
        for key in {key for key, _, _ in met}:  # eight or nine times; 48 symmetries
            assert len({symmetry for of, symmetry, _ in met if of == key}) > 4
    both = [(part(two[0], variant), 1) for variant in ("v1", "v4")]
    met = showings(MixtureDataset(both, 14, rank=0, world_size=1, augment="all"))
    assert len({draw for _, _, draw in met}) == 14 > len({key for key, _, _ in met})


@pytest.mark.parametrize("workers", [0, 1])
def test_a_state_of_an_earlier_version_goes_on_with_what_comes_again_alike(two, workers):
    dataset, before = mixed(two, augment="all"), mixed(two, augment="all").as_before()
    state = {name: value for name, value in dataset.state_dict().items() if name != "showings"}
    assert state == before.state_dict()
    loader = DataLoader(dataset, batch_size=None, num_workers=workers, persistent_workers=workers > 0)
    ours = [contents(batch) for batch in loader]
    dataset.load_state_dict(state)  # while there are workers
    alike = [contents(batch) for batch in loader]
    assert alike == [contents(batch) for batch in before] != ours
    for key, symmetry, draw in showings(before):
        assert draw == key and symmetry == draw_symmetry(Augment.ALL, 0, 0, key)
    assert "showings" not in dataset.state_dict()
    dataset.load_state_dict(mixed(two, augment="all").state_dict())
    assert [contents(batch) for batch in loader] == ours
    with pytest.raises(OcnfError):
        dataset.load_state_dict({**state, "seed": 1})
    assert "showings" in dataset.state_dict()  # a state that is refused changes nothing


def test_a_weight_is_a_number_whatever_its_type(two):
    state, one = mixed(two, weights=(2, 1, 1)).state_dict(), mixed(two, weights=(2.0, 1, 1.0))
    one.load_state_dict(state)
    mixed(two, weights=(np.int64(2), np.float32(1), True + 0)).load_state_dict(state)
    assert one.checksum == mixed(two, weights=(2, 1, 1)).checksum
    for weight in (True, np.inf, np.nan, -1, 10**400, "1"):
        with pytest.raises(OcnfError, match="not a weight"):
            mixed(two, weights=(2, 1, weight))
    # Earlier versions hashed weights as they were given: those states go on, under either spelling.
    named = [[part(two[0], "v4"), "v4"], [part(two[0], "v1"), "v1"], [part(two[1], "v2"), "v2"]]
    before = [sha256_hex(canonical_json([[data.checksum, variant, "train", None, weight]
                                         for (data, variant), weight in zip(named, weights, strict=True)]))
              for weights in ((2, 1, 1), (2.0, 1, 1.0), (2.0, 1.0, 1.0))]
    assert len({*before, one.checksum}) == 3 and one.checksum == before[2]
    for checksum in before:
        one.load_state_dict({**state, "mixture": checksum})
    with pytest.raises(OcnfError, match="mixture: the state is of a run with another order"):
        one.load_state_dict({**state, "mixture": [checksum]})


def test_a_damaged_sample_gives_its_place_to_the_part_s_next(two, sets, tmp_path):
    url = sets.write(tmp_path / "bad", {"train": [5]}, {"v2": ["histogram"]}, prefix="u")
    path = tmp_path / "bad" / "train" / "shard-000000.tar"
    whole = [batch.keys[0] for batch in part(url, "v2", shuffle=False)]
    data = bytearray(path.read_bytes())
    data[700] ^= 1  # in the payload of the first member of the first sample
    path.write_bytes(data)
    bad = part(url, "v2", shuffle=False)
    with pytest.raises(OcnfError, match="u000"):
        list(MixtureDataset([(bad, 1)], 5, rank=0, world_size=1))
    dataset = MixtureDataset([(bad, 1)], 5, rank=0, world_size=1, on_error="skip")
    batches = list(dataset)
    assert [batch.keys[0] for batch in batches] == [whole[1], *whole[1:]]
    assert [[lost.key for lost in batch.lost] for batch in batches] == [["u000"], [], [], [], []]
    assert dataset.lost(0) == [0]


def test_each_part_may_have_its_own_way_with_damage(two, sets, tmp_path):
    def flipped(name, prefix):
        url = sets.write(tmp_path / name, {"train": [5]}, {"v2": ["histogram"]}, prefix=prefix)
        path = tmp_path / name / "train" / "shard-000000.tar"
        data = bytearray(path.read_bytes())
        data[700] ^= 1
        path.write_bytes(data)
        return part(url, "v2")

    parts = [(flipped("one", "u"), 1), (flipped("other", "w"), 1)]

    def lost(on_error):
        dataset = MixtureDataset(parts, 40, rank=0, world_size=1, on_error=on_error, max_bad_fraction=1.0)
        return {one.key for batch in dataset for one in batch.lost}

    assert lost("skip") == lost(["skip", "skip"]) == {"u000", "w000"}
    for policies, stopped in ((["skip", "raise"], "w000"), (["raise", "skip"], "u000")):
        with pytest.raises(OcnfError, match=stopped):
            lost(policies)
    for policies in (["skip"], None, ["skip", "no"]):
        with pytest.raises(OcnfError, match="MixtureDataset: on_error"):
            lost(policies)


@pytest.mark.parametrize(
    "argument",
    [{"seed": -1}, {"batch_size": 0}, {"augment": "some"}, {"rank": 3}, {"rank": None}, {"uneven": "no"},
     {"on_error": "no"}, {"drop_last": 1}, {"max_bad_fraction": 2}],
    ids=str,
)
def test_an_argument_that_is_refused_is_the_mixture_s(two, argument):
    with pytest.raises(OcnfError, match=f"^MixtureDataset: {next(iter(argument))}: "):
        mixed(two, **argument)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ([], "nothing to mix"),
        ([("v4", [16], 0)], "not a weight.*0"),
        ([("v4", [16], 1), ("v1", [16, 32], 1)], r"part 1.*resolutions.*\(16, 32\).*\(16,\)"),
    ],
)
def test_what_cannot_be_mixed_is_refused(two, parts, message):
    with pytest.raises(OcnfError, match=message):
        MixtureDataset(
            [
                (ShardDataset(two[0], "train", resolutions, "histogram", variant=variant), weight)
                for variant, resolutions, weight in parts
            ],
            10,
        )


def test_parts_whose_values_mean_something_else_are_refused(two, sets, tmp_path):
    other = sets.write(tmp_path / "c", {"train": [2]}, {"v2": ["histogram"]}, truncation_voxels=4.0)
    with pytest.raises(OcnfError, match=r"part 1.*truncation_voxels.*4\.0"):
        MixtureDataset([(part(two[0], "v4"), 1), (part(other, "v2"), 1)], 10)


def test_what_is_no_part_is_named(two):
    for parts in ([part(two[0], "v4")], [(part(two[0], "v4"),)], [("a folder", 1)]):
        with pytest.raises(OcnfError, match=r"MixtureDataset: parts\[0\]: not a part"):
            MixtureDataset(parts, 3)
    with pytest.raises(OcnfError, match=r"MixtureDataset: parts\[0\]: not a weight; found 'x'"):
        MixtureDataset([(part(two[0], "v4"), "x")], 3)
