"""A data set that was written with schema version 1 is read for ever, and would be written so again."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store
from ocnf_data.octree.codec import decode
from ocnf_data.shards import (
    SCHEMA_VERSION,
    DatasetInfo,
    ShardReader,
    ShardWriter,
    load_dataset,
    write_dataset,
)
from ocnf_data.verify.verify import verify

GOLDEN = Path(__file__).parent / "golden-v1"
SHA256 = {
    "dataset.json": "346df2bedd9c78350140597d658ec5e2140a8ce54f2e81d9ca7c9d47d60cdcc5",
    "train/shard-000000.json": "3d8e5099c9fc4a06ca8f954dab99f034f90408ea250a95bae00e3a37354a98a4",
    "train/shard-000000.tar": "45f60a15fbca0e742ba0caeebeae26a532dbfa9c430f595eadc29cb147f83a3e",
}


def test_the_golden_files_are_as_they_were() -> None:
    assert SCHEMA_VERSION == 1  # a new version gets a golden set of its own, beside this one
    found = {name: hashlib.sha256((GOLDEN / name).read_bytes()).hexdigest() for name in SHA256}
    assert found == SHA256


def test_the_golden_set_is_whole() -> None:
    report = verify(str(GOLDEN))
    assert report.ok, report.problems
    with ShardReader(Store(GOLDEN), "train", load_dataset(str(GOLDEN)).splits["train"][0]) as reader:
        leaves = {sample.key: {name: decode(members[name]).n_leaves for name in members if name != "json"}
                  for sample, members in reader.samples()}
    assert leaves == {
        "chair_0000": {"target-16.oct": 771, "v4_n02-histogram-16.oct": 8},
        "chair_0001": {"target-16.oct": 1394, "v4_n02-histogram-16.oct": 8},
    }


def test_the_same_members_give_the_same_files(tmp_path: Path) -> None:
    info = load_dataset(str(GOLDEN))
    store = Store(tmp_path)
    with (ShardReader(Store(GOLDEN), "train", info.splits["train"][0]) as reader,
          ShardWriter(store, "train", 0) as writer):
        for sample, members in reader.samples():
            writer.add(sample.key, members)
    write_dataset(store, info)
    assert {name: hashlib.sha256(store.read_bytes(name)).hexdigest() for name in SHA256} == SHA256


@pytest.mark.parametrize("version", [0, 2])
def test_another_version_is_refused_with_a_sentence(version: int) -> None:
    blob = (GOLDEN / "dataset.json").read_bytes().replace(b'"schema": 1', b'"schema": %d' % version)
    with pytest.raises(OcnfError, match=f"another schema version; found {version}, expected 1. Read it with"):
        DatasetInfo.from_json(blob, "dataset.json")
