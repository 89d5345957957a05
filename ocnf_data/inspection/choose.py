"""Which samples to look at: named by a part of a key that is theirs alone, drawn, or the first ones."""

from __future__ import annotations

import difflib
import random
from collections.abc import Sequence

from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store
from ocnf_data.shards.browse import StoredSample, find_sample, stored_samples
from ocnf_data.shards.catalogue import load_catalogue
from ocnf_data.shards.dataset import load_dataset

_LISTED = 8


def sample_keys(url: str) -> list[str]:
    """The keys of all samples, split by split, from the catalogues alone."""
    store = Store(url)
    info = load_dataset(store)
    return [key for split in info.splits for key in load_catalogue(store, info, split).keys]


def complete_key(part: str, keys: Sequence[str], where: object = None) -> str:
    """The one key that is meant: it is `part`, or the only one that begins with it, or that contains it.

    >>> complete_key("mug", ["chair-train-0000", "mug-train-0000", "cup-and-mug-1"])
    'mug-train-0000'

    Raises:
        OcnfError: no key has that part (`missing`), or several have.
    """
    wanted = part.lower()
    if part in keys:
        return part
    for fits in (str.startswith, str.__contains__):
        found = [key for key in keys if fits(key.lower(), wanted)]
        if len(found) == 1:
            return found[0]
        if found:
            more = f" and {len(found) - _LISTED} more" if len(found) > _LISTED else ""
            raise OcnfError("several samples are called like that", where=where, field=part,
                            found=", ".join(found[:_LISTED]) + more, fix="give more of the key")
    close = difflib.get_close_matches(part, keys, _LISTED, 0.4)
    raise OcnfError("the data set has no such sample", code="missing", where=where, field=part,
                    expected=f"a part of a key, such as {', '.join(close or keys[:3])}",
                    fix="list the keys with `ocnf-data info DIR --samples`")


def pick(url: str, parts: Sequence[str], n_random: int = 0, seed: int = 0) -> list[StoredSample]:
    """The samples of `parts` of keys; else `n_random`, drawn with a seed; else the first of each split."""
    if parts:
        keys = sample_keys(url)
        return [find_sample(url, complete_key(part, keys, url)) for part in parts]
    everything = list(stored_samples(url))
    if n_random:
        return random.Random(seed).sample(everything, min(n_random, len(everything)))
    return list({sample.split: sample for sample in reversed(everything)}.values())
