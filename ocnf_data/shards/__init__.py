"""Shards: plain tars with an index, written whole, checked on every read (docs/format.md).

What decodes octrees is in modules of its own: `shards.verify`, `shards.info`, `shards.repair`.
"""

from ocnf_data.files.records import SCHEMA_VERSION
from ocnf_data.shards.dataset import Counts, DatasetInfo, FileEntry, ShardEntry, load_dataset, write_dataset
from ocnf_data.shards.index import ShardIndex
from ocnf_data.shards.reader import ShardReader
from ocnf_data.shards.writer import ShardWriter, find_complete

__all__ = [
    "SCHEMA_VERSION",
    "Counts",
    "DatasetInfo",
    "FileEntry",
    "ShardEntry",
    "ShardIndex",
    "ShardReader",
    "ShardWriter",
    "find_complete",
    "load_dataset",
    "write_dataset",
]
