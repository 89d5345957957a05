"""One run at a time into a folder."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator

from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store, storage_errors

_LOCK = ".lock"


@contextlib.contextmanager
def exclusive(store: Store) -> Iterator[None]:
    """Refuse a second run into the same local folder. The system drops a killed run's lock; remote has none.

    Raises:
        OcnfError: code `busy`; or the folder cannot be made or written to.
    """
    if store.root is None:
        yield
        return
    path = store.root / _LOCK
    with storage_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = path.open("w")
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise _busy(store) from None
        if not path.exists() or not os.path.samestat(path.stat(), os.fstat(lock.fileno())):
            raise _busy(store)  # it ended as we came and took the file away, so this lock keeps nobody out
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


def _busy(store: Store) -> OcnfError:
    return OcnfError("another run is writing here", code="busy", where=store.url,
                     fix="wait until it is done, or stop it")
