"""A damaged sample is never delivered: it stops the run, or it is left out and counted."""

from __future__ import annotations

import json
import logging
import shutil
from dataclasses import replace

import pytest
from torch.utils.data import DataLoader

from ocnf_data import OcnfError, ShardDataset
from ocnf_data.files.storage import Store
from ocnf_data.shards import FileEntry, load_dataset, write_dataset
from ocnf_data.shards.catalogue import Keys, stored_catalogue
from ocnf_data.verify.verify import verify

BLOCK = 512


@pytest.fixture
def fresh(eleven, tmp_path):
    """A copy of `eleven` to be damaged, and its first training shard."""
    shutil.copytree(eleven, tmp_path / "set")
    return tmp_path / "set", tmp_path / "set" / "train" / "shard-000000.tar"


def everything(url, **options):
    return ShardDataset(url, "train", [16, 32], "histogram", **options)


def members(tar):
    index = json.loads(tar.with_suffix(".json").read_text())
    return [(sample["key"], member) for sample in index["samples"] for member in sample["members"]]


def flip(tar, offset, bit=0):
    content = bytearray(tar.read_bytes())
    content[offset] ^= 1 << bit
    tar.write_bytes(content)


def test_a_flipped_bit_anywhere_in_a_member_is_named(fresh):
    """In the header, the payload's first, middle and last byte, and the padding, of every member."""
    url, tar = fresh
    whole = tar.read_bytes()
    for number, (key, member) in enumerate(members(tar)):
        start, end = member["offset"], member["offset"] + member["size"]
        places = [start - BLOCK + 37 * number % BLOCK, start, (start + end) // 2, end - 1]
        if end % BLOCK:
            places.append(end)
        for place in places:
            flip(tar, place, bit=number % 8)
            with pytest.raises(OcnfError) as caught:
                list(everything(url))
            assert caught.value.where == str(tar)
            assert f"{key}.{member['name']} at byte " in caught.value.field
            assert caught.value.code in ("header", "checksum", "padding")
            tar.write_bytes(whole)


def test_a_flipped_bit_in_the_last_blocks_is_found(fresh):
    url, tar = fresh
    for place in (1, 700, 1024):
        flip(tar, tar.stat().st_size - place)
        with pytest.raises(OcnfError, match="end of the tar at byte"):
            list(everything(url))
        flip(tar, tar.stat().st_size - place)


def test_a_tar_cut_at_any_block_is_found(fresh):
    url, tar = fresh
    whole = tar.read_bytes()
    for size in range(0, len(whole), BLOCK):
        tar.write_bytes(whole[:size])
        with pytest.raises(OcnfError) as caught:
            list(everything(url))
        assert caught.value.code == "truncated" and caught.value.where == str(tar)
    tar.write_bytes(whole + bytes(BLOCK))
    with pytest.raises(OcnfError, match="another size"):
        list(everything(url))


def test_a_tar_cut_while_it_is_being_read_is_found(fresh):
    url, tar = fresh
    dataset = everything(url, shuffle=False)
    batches = iter(dataset)
    next(batches)
    key, last = members(tar)[-1]
    with tar.open("r+b") as file:
        file.truncate(last["offset"] + 1)
    with pytest.raises(OcnfError) as caught:
        list(batches)
    assert caught.value.code == "truncated" and key in caught.value.field


def test_a_missing_shard_is_found(fresh):
    url, tar = fresh
    tar.unlink()
    with pytest.raises(OcnfError) as caught:
        list(everything(url))
    assert caught.value.code == "missing" and str(tar) in str(caught.value)


def test_a_damaged_index_is_refused_and_a_lost_one_is_made_anew(fresh):
    url, tar = fresh
    before = [batch.arena.tolist() for batch in everything(url)]
    index = tar.with_suffix(".json")
    content = index.read_bytes()
    for bit in range(0, 8 * len(content), 997):
        flip(index, bit // 8, bit % 8)
        with pytest.raises(OcnfError, match=r"shard-000000\.json") as caught:
            list(everything(url))
        assert caught.value.code == "checksum"
        flip(index, bit // 8, bit % 8)
    index.unlink()
    assert [batch.arena.tolist() for batch in everything(url)] == before


def test_a_damaged_index_costs_its_shard_where_damage_is_skipped(fresh):
    url, tar = fresh
    flip(tar.with_suffix(".json"), 100)
    dataset = everything(url, on_error="skip", max_bad_fraction=0.3)
    met = {key for batch in dataset for key in batch.keys}
    assert met == {f"s{number:03d}" for number in range(3, 11)}
    assert sorted(dataset.lost(0)) == ["s000", "s001", "s002"]


def test_a_flipped_bit_anywhere_in_a_catalogue_is_found_when_the_set_is_opened(fresh):
    url, _ = fresh
    path = url / "train" / "catalogue.safetensors"
    whole = path.read_bytes()
    for bit in range(0, 8 * len(whole), 3):
        flip(path, bit // 8, bit % 8)
        with pytest.raises(OcnfError, match=r"catalogue\.safetensors") as caught:
            everything(url)
        assert caught.value.code == "checksum"
        path.write_bytes(whole)
    for content in (b"", whole[:-1], whole[: len(whole) // 2], whole + b"\0"):
        path.write_bytes(content)
        with pytest.raises(OcnfError, match="repair"):
            everything(url)


def test_an_index_that_contradicts_the_catalogue_is_refused(fresh):
    """Both whole, both listed: whoever made the data set was wrong, and nothing of it is delivered."""
    url, _ = fresh
    store = Store(url)
    info = load_dataset(store)
    catalogue = stored_catalogue(store, info, "train")
    keys, category_of = list(catalogue.keys), catalogue.category_of.copy()
    category_of[4] = 1 - category_of[4]
    for wrong, victim in (({"keys": Keys.of([*keys[:4], "s999", *keys[5:]])}, "s999"),
                          ({"category_of": category_of}, keys[4]),
                          ({"members": (("json", *catalogue.members[0][1:], "target-64.oct"),)}, keys[0])):
        data = replace(catalogue, **wrong).to_bytes()
        store.put_bytes("train/catalogue.safetensors", data)
        files = [entry for entry in info.files if entry.name != "train/catalogue.safetensors"]
        entry = FileEntry.of("train/catalogue.safetensors", data)
        write_dataset(store, info.model_copy(update={"files": (*files, entry)}))
        resolutions = 64 if "members" in wrong else 16
        with pytest.raises(OcnfError, match="other things of a sample than the catalogue") as caught:
            list(ShardDataset(url, "train", resolutions, None, shuffle=False))
        assert (caught.value.code, caught.value.field) == ("catalogue", victim)
        report = verify(store)
        assert [(row.file, row.code) for row in report.problems] == [
            ("train/catalogue.safetensors", "catalogue")]


@pytest.mark.parametrize("workers", [0, 2, 3])
@pytest.mark.filterwarnings("ignore:This DataLoader will create")
def test_skipping_puts_the_next_good_sample_in_place_for_any_number_of_workers(fresh, workers):
    url, tar = fresh
    whole = [batch.keys for batch in everything(url, batch_size=2)]
    bad = whole[1][0]
    spare = whole[2][0]
    for shard in tar.parent.glob("*.tar"):
        for key, member in members(shard):
            if key == bad and member["name"] == "target-32.oct":
                flip(shard, member["offset"])
    dataset = everything(url, batch_size=2, on_error="skip")
    batches = list(DataLoader(dataset, batch_size=None, num_workers=workers))
    expected = [list(keys) for keys in whole]
    expected[1][0] = spare
    assert [list(batch.keys) for batch in batches] == expected
    assert batches[1].repeat == (True, False)
    assert [(lost.key, lost.code) for lost in batches[1].lost] == [(bad, "checksum")]
    assert not any(batch.lost for batch in (*batches[:1], *batches[2:]))
    assert dataset.lost(0) == [bad] and dataset.lost(1) == []


@pytest.mark.parametrize("size", [11, 16])
def test_a_batch_as_large_as_the_epoch_takes_its_own_samples_again(fresh, size):
    url, tar = fresh
    whole = next(iter(everything(url, batch_size=11, shuffle=False))).keys
    flip(tar, members(tar)[0][1]["offset"])
    bad = members(tar)[0][0]
    batch = next(iter(everything(url, batch_size=size, shuffle=False, on_error="skip")))
    place = whole.index(bad)
    assert len(batch.keys) == size and batch.repeat[place] and bad not in batch.keys
    good = set(whole) - {bad}
    assert set(batch.keys) == good
    assert {lost.key for lost in batch.lost} == {bad}


def test_a_data_set_given_twice_is_refused(fresh):
    url, _ = fresh
    with pytest.raises(OcnfError, match="given twice"):
        everything([str(url), f"{url.parent}/./{url.name}"])


@pytest.mark.parametrize("workers", [0, 2])
def test_an_exact_epoch_leaves_the_lost_out_and_keeps_its_length(fresh, workers):
    url, tar = fresh
    flip(tar, members(tar)[1][1]["offset"])
    dataset = everything(url, on_error="skip", uneven="exact", shuffle=False)
    batches = list(DataLoader(dataset, batch_size=None, num_workers=workers))
    assert len(batches) == len(dataset) == 11
    assert [batch.keys for batch in batches] == [(), *((f"s{number:03d}",) for number in range(1, 11))]
    assert batches[0].inputs[16].grids() == [] and batches[0].inputs[16].to_float().shape == (0, 10)


def test_the_lost_are_logged_once_an_epoch(fresh, caplog):
    url, tar = fresh
    flip(tar, members(tar)[1][1]["offset"])
    dataset = everything(url, on_error="skip", batch_size=4, max_bad_fraction=0.5)
    with caplog.at_level(logging.WARNING, logger="ocnf_data.loading.dataset"):
        for _ in range(2):
            list(dataset)
    assert len(caplog.records) == 2
    assert all(str(tar) in record.message and "s000" in record.message for record in caplog.records)


@pytest.mark.parametrize("workers", [0, 2])
def test_too_many_damaged_samples_stop_the_run(fresh, workers):
    url, tar = fresh
    tar.unlink()  # three of eleven samples

    def run(limit):
        dataset = everything(url, on_error="skip", max_bad_fraction=limit)
        return list(DataLoader(dataset, batch_size=None, num_workers=workers))

    kept = run(0.3)
    assert len(kept) == 11 and not {"s000", "s001", "s002"} & {key for batch in kept for key in batch.keys}
    with pytest.raises(OcnfError, match="too many damaged samples"):
        run(0.2)


def test_all_samples_damaged_is_an_error(fresh):
    url, _ = fresh
    for tar in (url / "train").glob("*.tar"):
        tar.unlink()
    with pytest.raises(OcnfError, match="no sample is left"):
        list(everything(url, on_error="skip", max_bad_fraction=1.0))


def test_no_access_is_not_damage(fresh, monkeypatch):
    """Skipping what cannot be reached would go on without noticing that nothing can be."""
    url, _ = fresh
    dataset = everything(url, on_error="skip", max_bad_fraction=1.0)

    def fail(*arguments):
        raise OcnfError("cannot be reached", code="unreachable")

    monkeypatch.setattr("ocnf_data.shards.reader.check_size", fail)
    with pytest.raises(OcnfError, match="cannot be reached"):
        list(dataset)


@pytest.mark.parametrize("options", [{}, {"pin_memory": True}, {"persistent_workers": True},
                                     {"multiprocessing_context": "spawn"}], ids=str)
@pytest.mark.filterwarnings("ignore:.*pin_memory")
def test_a_worker_s_error_reaches_the_main_process_with_all_its_parts(fresh, options):
    url, tar = fresh
    flip(tar, members(tar)[3][1]["offset"])
    dataset = everything(url)
    alone = failure(dataset, num_workers=0)
    key, member = members(tar)[3]
    assert (alone.where, alone.code) == (str(tar), "checksum")
    assert alone.field == f"{key}.{member['name']} at byte {member['offset']}"
    ours = failure(dataset, num_workers=1, **options)
    assert type(ours) is OcnfError and vars(ours) == vars(alone) and str(ours) == str(alone)


def test_so_does_that_of_too_many_losses(fresh):
    url, tar = fresh
    tar.unlink()  # the error names the last of the lost, within its own message
    dataset = everything(url, on_error="skip", max_bad_fraction=0.2)
    ours = failure(dataset, num_workers=2)
    assert ours.code == "too_many_bad" and ours.where == "ShardDataset" and "Traceback" not in str(ours)


def failure(dataset, **options):
    with pytest.raises(OcnfError) as caught:
        list(DataLoader(dataset, batch_size=None, **options))
    return caught.value
