"""Failures of file systems and networks as `OcnfError`, each with its code and what to do."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager

from ocnf_data.errors import OcnfError

TEMPORARY_PREFIX = ".tmp-"
"""The beginning of names of files that are being written; users never chose them, so no message has one."""

_REASONS: dict[int, tuple[str, str]] = {
    errno.ENOSPC: ("disk_full", "the disk is full"),
    errno.EDQUOT: ("disk_full", "the disk quota is used up"),
    errno.EACCES: ("permission", "permission denied"),
    errno.EPERM: ("permission", "permission denied"),
    errno.EROFS: ("permission", "the file system is read-only"),
    errno.ENOENT: ("missing", "no such file or folder"),
    errno.ENOTDIR: ("missing", "a part of the path is a file, not a folder"),
    errno.EEXIST: ("io", "a file is in the place of a folder"),
    errno.EISDIR: ("io", "is a folder, not a file"),
}
_FIXES = {
    "disk_full": "free some space and run the same command again: what is finished is kept",
    "permission": "check who may read and write there, and the credentials if it is remote",
    "unreachable": "check the network, the endpoint and the credentials",
}
# Their errors are no OSErrors, and the libraries are optional, so they are known by name.
_NETWORK_LIBRARIES = frozenset({"aiobotocore", "aiohttp", "botocore", "gcsfs", "requests", "urllib3"})


@contextmanager
def storage_errors(where: object) -> Iterator[None]:
    """Turn the failures of files and connections inside the block into `OcnfError`.

    Args:
        where: the file or URL the block is about; an OSError that names another file is reported under that.
    """
    try:
        yield
    except OcnfError:
        raise
    except Exception as error:
        translated = _translate(error, where)
        if translated is None:  # a bug or somebody else's error
            raise
        raise translated from error


def _translate(error: Exception, where: object) -> OcnfError | None:
    """The OcnfError for a failure of a file system or network; None for anything else."""
    network = type(error).__module__.partition(".")[0] in _NETWORK_LIBRARIES
    if network or isinstance(error, ConnectionError | TimeoutError):
        code, what = "unreachable", f"cannot be reached ({type(error).__name__}: {error})"
    elif not isinstance(error, OSError):
        return None
    else:
        number = error.errno
        if number is None:  # fsspec raises plain FileNotFoundError(path)
            number = {FileNotFoundError: errno.ENOENT, PermissionError: errno.EACCES}.get(type(error))
        code, what = _REASONS.get(number or 0, ("io", f"input/output error ({error})"))
        if isinstance(error.filename, str) and TEMPORARY_PREFIX not in error.filename:
            where = error.filename
    return OcnfError(what, code=code, where=where, fix=_FIXES.get(code))
