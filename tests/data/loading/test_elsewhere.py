"""Shards that lie in a bucket or in memory, and shards that somebody reads without this package."""

from __future__ import annotations

import uuid

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from ocnf_data import OcnfError, ShardDataset
from ocnf_data.files.storage import Store
from ocnf_data.octree.stored import storage_of


def same(first, second):
    assert [batch.keys for batch in first] == [batch.keys for batch in second]
    assert all(torch.equal(a.arena, b.arena) for a, b in zip(first, second, strict=True))


def test_a_bucket_gives_what_the_folder_gives(eleven, sets, s3_url):
    """The main process has talked to the bucket before its workers are forked."""
    url = sets.write(f"{s3_url}/tiny", {"train": [3, 1, 4, 1, 2], "test": [2, 1, 1]})
    settings = {"split": "train", "resolutions": [16, 32], "encoding": "histogram", "batch_size": 3}
    remote = DataLoader(ShardDataset(url, **settings), batch_size=None, num_workers=2,
                        multiprocessing_context="fork")
    same(list(remote), list(ShardDataset(eleven, **settings)))


def test_memory_gives_what_the_folder_gives(eleven, sets):
    url = sets.write(f"memory://{uuid.uuid4().hex}", {"train": [3, 1, 4, 1, 2], "test": [2, 1, 1]})
    for resolutions in (32, [16, 32]):  # members apart, and next to each other
        settings = {"split": "train", "resolutions": resolutions, "encoding": "histogram", "batch_size": 3}
        same(list(ShardDataset(url, **settings)), list(ShardDataset(eleven, **settings)))


def test_memory_and_workers_do_not_go_together(sets):
    url = sets.write(f"memory://{uuid.uuid4().hex}", {"train": [2]})
    dataset = ShardDataset(url, "train", 16, "histogram")
    with pytest.raises(OcnfError, match="memory"):
        next(iter(DataLoader(dataset, batch_size=None, num_workers=1, multiprocessing_context="spawn")))


def test_damage_in_a_bucket_is_named(sets, s3_url):
    url = sets.write(f"{s3_url}/hurt", {"train": [2]})
    store = Store(url)
    content = bytearray(store.read_bytes("train/shard-000000.tar"))
    content[-2000] ^= 1
    store.put_bytes("train/shard-000000.tar", content)
    with pytest.raises(OcnfError) as caught:
        list(ShardDataset(url, "train", [16, 32], "histogram"))
    assert caught.value.where == f"{url}/train/shard-000000.tar" and caught.value.field.startswith("s001.")
    store.put_bytes("train/shard-000000.tar", content[:-512])
    with pytest.raises(OcnfError, match="another size"):
        list(ShardDataset(url, "train", [16, 32], "histogram"))


def test_webdataset_reads_the_shards_with_three_lines(eleven):
    """The snippet that README shows."""
    wds = pytest.importorskip("webdataset")
    import safetensors.numpy
    import zstandard

    def octrees(name, data):
        return safetensors.numpy.load(zstandard.decompress(data)) if name.endswith(".oct") else None

    shards = f"{eleven}/train/shard-{{000000..000004}}.tar"
    samples = list(wds.WebDataset(shards, shardshuffle=False).decode(octrees))

    ours = list(ShardDataset(eleven, "train", 16, "histogram", shuffle=False))
    assert [sample["__key__"] for sample in samples] == [batch.keys[0] for batch in ours]
    for sample, batch in zip(samples, ours, strict=True):
        assert sample["json"] == batch.meta[0]
        octree = sample["v4-histogram-16.oct"]
        np.testing.assert_array_equal(octree["data"], batch.inputs[16].data.numpy())
        words = np.zeros((2, 2, 2, 16), np.uint8)
        words[..., :10] = octree["trees"]
        np.testing.assert_array_equal(words.view(np.int64), batch.inputs[16].trees[0].numpy())
    assert storage_of("histogram").divisor == 255  # what the README tells to divide by
