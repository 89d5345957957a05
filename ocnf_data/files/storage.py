"""Whole files in a local folder or under any fsspec URL; no reader ever meets half of one.

A file under its final name is whole. Locally it is written under a temporary name in the same folder,
flushed to the disk, renamed, and the folder is flushed too; a process killed in between leaves a file named
`.tmp-*`, which `list` does not show and `clean_temporaries` removes. Remotely it is made on the local disk
and sent as one PUT: on an object store (S3, GCS, Azure) that is atomic; over protocols where a PUT is a
stream of writes (SFTP, WebDAV) it is not, which is why the shards' indices, written after them, decide.

Every failure is an `OcnfError` with the code `missing`, `permission`, `disk_full`, `unreachable`, `truncated`
or `io`, that names the file.
"""

from __future__ import annotations

import errno
import os
import secrets
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import IO, TYPE_CHECKING, Any, cast

from ocnf_data.errors import OcnfError, missing_extra
from ocnf_data.files.addresses import checked_name, is_temporary, split_url
from ocnf_data.files.disk import flush, make_folder, read_exactly
from ocnf_data.files.storage_errors import TEMPORARY_PREFIX, storage_errors

if TYPE_CHECKING:
    from fsspec import AbstractFileSystem

_LOCAL_PROTOCOLS = frozenset({"file", "local"})
# s3fs holds what it sends in one PUT in memory, and splits from 100 MB on unless told otherwise. A split
# upload appears as a whole too, but leaves parts that cost money where its process is killed.
_LARGEST_PUT = 2**30


class Store:
    """A folder of whole files: a local path, `file://...`, or any URL that fsspec opens (`s3://bucket/set`).

    Names are relative POSIX paths such as `train/shard-000000.tar`. A store is cheap to make and to pickle:
    it connects on first use. Credentials and endpoints are fsspec's: environment variables (`AWS_...`,
    `AWS_ENDPOINT_URL`) or its configuration files, so that workers find them too.

    Raises:
        OcnfError: an unknown protocol, a chained one (`a::b`), or one whose library is not installed.
    """

    def __init__(self, url: str | os.PathLike[str]) -> None:
        text = os.fspath(url)
        self.protocol, path = split_url(text)
        self.root: Path | None = None
        if self.protocol in _LOCAL_PROTOCOLS:
            self.root = Path(path).expanduser().absolute()
            self.url = str(self.root)
        else:
            self.url = text.rstrip("/") if path else text

    def __repr__(self) -> str:
        return f"Store({self.url!r})"

    def __str__(self) -> str:
        return self.url

    def __reduce__(self) -> tuple[Any, ...]:
        return Store, (self.url,)

    @property
    def is_local(self) -> bool:
        """Whether the files are on a local (or mounted) disk."""
        return self.root is not None

    @property
    def shared_between_processes(self) -> bool:
        """False for `memory://`, where what a worker process writes is lost."""
        return self.protocol != "memory"

    def where(self, name: str) -> str:
        """The full path or URL of a file, for messages and for `Store` or fsspec elsewhere."""
        return f"{self.url.rstrip('/')}/{checked_name(name)}"

    def local_path(self, name: str) -> Path | None:
        """The file's path on this machine, or None where the store is remote."""
        return None if self.root is None else self.root / checked_name(name)

    # ---- reading

    def open(self, name: str) -> IO[bytes]:
        """The file, open for reading bytes; seekable. Wrap reads in `storage_errors(store.where(name))`."""
        with storage_errors(self.where(name)):
            path = self.local_path(name)
            if path is not None:
                return path.open("rb")
            return cast(IO[bytes], self._fs.open(self._remote(name), "rb"))

    def read_bytes(self, name: str) -> bytes:
        """The whole file. The caller bounds it with `size` where the file is not trusted."""
        with storage_errors(self.where(name)):
            path = self.local_path(name)
            if path is not None:
                return path.read_bytes()
            return cast(bytes, self._fs.cat_file(self._remote(name)))

    def read_at_most(self, name: str, limit: int) -> bytes:
        """The whole file, if it has at most `limit` bytes: one request, and nothing larger is ever held.

        Raises:
            OcnfError: code `missing` where there is no such file, `too_large` where it is longer.
        """
        with storage_errors(self.where(name)):
            path = self.local_path(name)
            if path is not None:
                if not path.is_file():  # opening a pipe would wait for ever
                    raise FileNotFoundError(errno.ENOENT, "no such file", str(path))
                with path.open("rb", buffering=0) as file:
                    size = os.fstat(file.fileno()).st_size
                    data = read_exactly(file, size) if size <= limit else b""
            else:
                data = self._read_start(name, limit + 1)
                size = len(data)
        if size > limit:
            raise OcnfError("the file is too large", code="too_large", where=self.where(name),
                            expected=f"at most {limit} bytes")
        return data

    def read_range(self, name: str, offset: int, size: int) -> bytes:
        """Exactly `size` bytes from `offset`.

        Raises:
            OcnfError: code `truncated` where the file ends before that.
        """
        with storage_errors(self.where(name)):
            path = self.local_path(name)
            if size == 0:
                data = b""
            elif path is not None:
                with path.open("rb", buffering=0) as file:
                    file.seek(offset)
                    data = read_exactly(file, size)
            else:
                end = min(offset + size, self.size(name))  # servers answer a range past the end with an error
                data = self._fs.cat_file(self._remote(name), start=offset, end=end) if end > offset else b""
        if len(data) != size:
            raise OcnfError("the file ends too early", code="truncated", where=self.where(name),
                            found=f"{offset + len(data)} bytes", expected=f"at least {offset + size}")
        return data

    def exists(self, name: str) -> bool:
        """Whether the file is there (a folder is not a file). Failing to find out is an error, not False."""
        with storage_errors(self.where(name)):
            path = self.local_path(name)
            if path is not None:
                return path.is_file()
            try:
                return self._info(name)["type"] == "file"
            except FileNotFoundError:
                return False

    def size(self, name: str) -> int:
        """Size of the file in bytes."""
        with storage_errors(self.where(name)):
            path = self.local_path(name)
            return path.stat().st_size if path is not None else int(self._info(name)["size"])

    def list(self, folder: str = "") -> list[str]:
        """Names of all files in `folder` and below, sorted; without temporaries; [] for a missing folder."""
        with storage_errors(self.url):
            if self.root is not None:
                names = [name for name in self._walk(folder) if not is_temporary(name)]
            else:
                base = self._remote(folder) if folder else self._remote_root
                self._fs.invalidate_cache()  # another process may have written since
                try:
                    found = self._fs.find(base)
                except FileNotFoundError:
                    found = []
                cut = len(self._remote_root.strip("/")) + 1 if self._remote_root.strip("/") else 0
                names = [path.strip("/")[cut:] for path in found]
        return sorted(names)

    # ---- writing

    @contextmanager
    def writing(self, name: str) -> Iterator[Path]:
        """A local path to write to; the file gets its name when the block ends, and not if it raises.

        >>> with store.writing("train/shard-000000.tar") as path:      # doctest: +SKIP
        ...     write_tar(path)
        """
        with storage_errors(self.where(name)):
            if self.root is None:
                with tempfile.TemporaryDirectory(prefix=TEMPORARY_PREFIX + "ocnf-") as folder:
                    path = Path(folder) / PurePosixPath(name).name
                    yield path
                    self._put(path, name)
                return
            final = self.root / checked_name(name)
            make_folder(final.parent)
            # Not mkstemp: its files are unreadable for the group, whatever the umask says.
            path = final.with_name(f"{TEMPORARY_PREFIX}{secrets.token_hex(8)}-{final.name}")
            try:
                yield path
                flush(path)
                path.replace(final)
                flush(final.parent)
            finally:
                path.unlink(missing_ok=True)

    def holds(self, name: str, data: bytes) -> bool:
        """Whether the file is there and holds exactly this."""
        return self.exists(name) and self.size(name) == len(data) and self.read_bytes(name) == data

    def put_bytes(self, name: str, data: bytes | bytearray | memoryview) -> None:
        """Write a whole file, replacing one of that name."""
        with self.writing(name) as path:
            path.write_bytes(data)

    def remove(self, name: str) -> None:
        """Delete a file; one that is not there is no error."""
        with storage_errors(self.where(name)):
            path = self.local_path(name)
            if path is not None:
                path.unlink(missing_ok=True)
            elif self.exists(name):
                self._fs.rm_file(self._remote(name))

    def clean_temporaries(self) -> Sequence[str]:
        """Remove what killed writers left, and return the names.

        Only where nobody is writing: a live writer's temporary looks the same.
        """
        if self.root is None:  # remote temporaries never get a name there
            return []
        with storage_errors(self.url):
            left = sorted(name for name in self._walk() if is_temporary(name))
            for name in left:
                (self.root / name).unlink(missing_ok=True)
        return left

    # ---- the two kinds of place

    def _walk(self, folder: str = "") -> Iterator[str]:
        assert self.root is not None
        base = self.root / checked_name(folder) if folder else self.root

        def fail(error: OSError) -> None:  # os.walk's default is to skip unreadable folders in silence
            if error.errno != errno.ENOENT:
                raise error

        for parent, _, files in os.walk(base, onerror=fail):
            for file in files:
                yield (Path(parent) / file).relative_to(self.root).as_posix()

    @cached_property
    def _fs(self) -> AbstractFileSystem:
        import fsspec

        try:
            return fsspec.filesystem(self.protocol)
        except ImportError as error:
            raise missing_extra(f"{self.protocol}:// needs a library that is not installed ({error})",
                                "remote", self.url) from error

    @cached_property
    def _remote_root(self) -> str:
        return cast(str, self._fs._strip_protocol(self.url)).rstrip("/")

    def _remote(self, name: str) -> str:
        return f"{self._remote_root}/{checked_name(name)}"

    def _info(self, name: str) -> dict[str, Any]:
        self._fs.invalidate_cache()  # another process may have written since
        return cast(dict[str, Any], self._fs.info(self._remote(name)))

    def _read_start(self, name: str, end: int) -> bytes:
        """The first `end` bytes of a remote file, or all that it has."""
        try:
            return cast(bytes, self._fs.cat_file(self._remote(name), start=0, end=end))
        except FileNotFoundError:
            raise
        except Exception:  # of an empty file, servers refuse every range
            if self.size(name) == 0:
                return b""
            raise

    def _put(self, path: Path, name: str) -> None:
        options = {}
        if self.protocol in ("s3", "s3a") and path.stat().st_size < _LARGEST_PUT:
            options["chunksize"] = _LARGEST_PUT // 2  # s3fs splits at twice the chunk
        self._fs.put_file(str(path), self._remote(name), **options)
