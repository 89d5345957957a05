"""One run at a time into a folder."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store
from ocnf_data.files.storage_errors import storage_errors

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
    from filelock import FileLock, Timeout

    path = store.root / _LOCK
    lock = FileLock(path)
    with storage_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire(blocking=False)
        except Timeout:
            raise OcnfError("another run is writing here", code="busy", where=store.url,
                            fix="wait until it is done, or stop it") from None
    try:
        yield
    finally:
        # Gone while it is still held: a run that has just opened it finds that it is another file, and waits
        # for nothing. Windows refuses to remove an open file, and keeps it.
        with contextlib.suppress(OSError):
            path.unlink()
        lock.release()
