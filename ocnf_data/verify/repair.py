"""Setting damaged shards aside, so that generation makes exactly those again. Nothing is ever deleted.

`dataset.json` stays where it is: it says what the new shards must hash to. Catalogues follow from the
indices, and are made from them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import count

from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store
from ocnf_data.files.storage_errors import storage_errors
from ocnf_data.shards.catalogue import made_catalogue
from ocnf_data.shards.dataset import FileEntry, load_dataset, write_dataset
from ocnf_data.shards.index import catalogue_path, index_path, is_shard, shard_path
from ocnf_data.shards.index_files import rebuild_index
from ocnf_data.verify.problems import Problem, VerifyReport
from ocnf_data.verify.verify import verify

QUARANTINE = "quarantine"


@dataclass(frozen=True)
class DamagedShard:
    """A shard that `verify` found fault with.

    Attributes:
        split: the split's name.
        shard: `shard-000000.tar`.
        problems: what is wrong, at least one.
    """

    split: str
    shard: str
    problems: tuple[Problem, ...]

    @property
    def path(self) -> str:
        """`train/shard-000000.tar`."""
        return shard_path(self.split, self.shard)

    @property
    def number(self) -> int:
        """The shard's number in its split."""
        return int(self.shard.removeprefix("shard-").removesuffix(".tar"))


def find_damaged(
    url: str | Store, jobs: int = 1, progress: Callable[[int, int], None] | None = None
) -> list[DamagedShard]:
    """The shards of a data set that are not whole, missing ones included, in the order of their paths."""
    return damaged_shards(verify(url, jobs, progress))


def damaged_shards(report: VerifyReport) -> list[DamagedShard]:
    """The damaged shards of a report that `verify` has made; see `find_damaged`."""
    damaged = []
    for path in report.damaged_shards:
        split, _, shard = path.partition("/")
        problems = tuple(problem for problem in report.problems if problem.file == path)
        damaged.append(DamagedShard(split, shard, problems))
    return damaged


def restore_index(url: str | Store, split: str, shard: str) -> bool:
    """Write the index of a shard again, if the tar is whole and `dataset.json` lists it.

    Returns:
        False where the tar is not whole: then the shard has to be generated again.

    Raises:
        OcnfError: there is no finished data set, it lists no such shard (`missing`), or its files cannot be
            read or written.
    """
    store = url if isinstance(url, Store) else Store(url)
    for entry_split, entry in load_dataset(store).shards():
        if (entry_split, entry.shard) == (split, shard):
            break
    else:
        raise OcnfError("dataset.json lists no such shard", code="missing", where=store.url,
                        found=f"{split}/{shard}")
    if not store.exists(shard_path(split, shard)):
        return False
    try:
        index = rebuild_index(store, split, entry)
    except OcnfError as error:
        if error.code in ("permission", "unreachable", "io"):  # says nothing about the bytes
            raise
        return False
    store.put_bytes(index_path(split, shard), index.to_json())
    return True


def restore_catalogues(url: str | Store) -> list[str]:
    """Write again the catalogues that are lost, damaged, or missing in a data set of an earlier version.

    They are made from the indices, which must be whole. Where `dataset.json` does not list exactly these, it
    is written again, last; the data set's identity stays.

    Returns:
        The names of the files that were written, without `dataset.json`.
    """
    store = url if isinstance(url, Store) else Store(url)
    info = load_dataset(store)
    written = []
    files = {entry.name: entry for entry in info.files}
    for split in info.splits:
        name = catalogue_path(split)
        data = made_catalogue(store, info, split).to_bytes()
        files[name] = FileEntry.of(name, data)
        if not store.holds(name, data):
            store.put_bytes(name, data)
            written.append(name)
    if tuple(files.values()) != info.files:
        write_dataset(store, info.model_copy(update={"files": tuple(files.values())}))
    return written


def quarantine(url: str | Store, path: str) -> list[str]:
    """Move a shard and its index, or what is in their places, to `quarantine/`.

    What is there already keeps its name.

    Args:
        url: folder or fsspec URL of the data set.
        path: `train/shard-000000.tar`.

    Returns:
        The new names, in the data set. The index goes first: from then on the shard does not count as done.

    Raises:
        OcnfError: `path` is not a shard's (`name`), or the files cannot be moved.
    """
    if not is_shard(path):
        raise OcnfError("not a shard's path", code="name", where=repr(path),
                        expected="train/shard-000000.tar")
    store = url if isinstance(url, Store) else Store(url)
    split, _, shard = path.partition("/")
    moved = []
    for name in (index_path(split, shard), path):
        moved += set_aside(store, name)
    return moved


def set_aside(store: Store, name: str) -> list[str]:
    """Move a file, or what is in its place, to `quarantine/`: its new name, or nothing if it is not there."""
    if not _is_taken(store, name):
        return []
    return [_move(store, name, _free_name(store, f"{QUARANTINE}/{name}"))]


def _is_taken(store: Store, name: str) -> bool:
    """Whether anything has the name: a file, or locally a folder, a pipe or a link to nowhere."""
    path = store.local_path(name)
    return store.exists(name) if path is None else path.exists() or path.is_symlink()


def _free_name(store: Store, name: str) -> str:
    if not _is_taken(store, name):
        return name
    return next(free for number in count(1) if not _is_taken(store, free := f"{name}.{number}"))


def _move(store: Store, name: str, target: str) -> str:
    """Rename where the store is a local folder; copy whole and then remove elsewhere."""
    source, destination = store.local_path(name), store.local_path(target)
    with storage_errors(store.where(name)):
        if source is not None and destination is not None:
            destination.parent.mkdir(parents=True, exist_ok=True)
            source.replace(destination)
            return target
        with store.open(name) as file, store.writing(target) as path, path.open("wb") as copy:
            while piece := file.read(2**20):
                copy.write(piece)
    store.remove(name)
    return target
