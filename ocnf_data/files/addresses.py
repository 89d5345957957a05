"""Where files may be: paths and URLs that are opened, and names that stay inside a store."""

from __future__ import annotations

import re
from pathlib import PurePosixPath

from ocnf_data.errors import OcnfError
from ocnf_data.files.storage_errors import TEMPORARY_PREFIX

# One letter would be a Windows drive. `pipe:ls` has no slashes, and must not pass for a relative path.
_SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):(//)?")


def split_url(text: str) -> tuple[str, str]:
    """(protocol, path) of a path or URL; refuses everything that is not one plain, known protocol."""
    scheme = _SCHEME.match(text)
    if not text or "\0" in text:
        raise OcnfError("not a path or URL", where="storage", found=repr(text))
    if scheme is None:
        return "file", text
    protocol = scheme[1].lower()
    if scheme[2] is None:
        raise OcnfError("commands and protocols without // are not opened", code="refused", where=text,
                        found=f"{scheme[1]}:", expected="a path, or a URL such as s3://bucket/folder",
                        fix="write ./ before a local path that holds a colon")
    if "::" in text:
        raise OcnfError("chained URLs are not opened", code="refused", where=text, expected="one plain URL")
    import fsspec

    if protocol not in fsspec.available_protocols():
        raise OcnfError("unknown protocol", code="refused", where=text, found=f"{protocol}://",
                        expected="a path, or a URL that fsspec opens: s3://, gs://, az://, memory://, ...")
    return protocol, text[scheme.end():]


def checked_name(name: str) -> str:
    """The name; OcnfError (`refused`) unless it is a plain relative POSIX path inside the store."""
    parts = name.split("/")
    if any(part in ("", ".", "..") for part in parts) or "\\" in name or "\0" in name:
        raise OcnfError("not a name inside the store", code="refused", where=repr(name),
                        expected="a relative path such as train/shard-000000.tar, without . or ..")
    return name


def is_temporary(name: str) -> bool:
    """Whether a file of that name is one that is not finished, or that a killed writer has left."""
    return PurePosixPath(name).name.startswith(TEMPORARY_PREFIX)
