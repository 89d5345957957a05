"""The one tar that a shard may be: canonical ustar, whose every byte follows from names and payloads.

    offset  bytes  field      value                      offset  bytes  field      value
    0       100    name       KEY.MEMBER, zero-padded    156     1      typeflag   "0", a plain file
    100     8      mode       "0000644" NUL              157     100    linkname   zeros
    108     8      uid        "0000000" NUL              257     6      magic      "ustar" NUL
    116     8      gid        "0000000" NUL              263     2      version    "00"
    124     12     size       11 octal digits, NUL       265     64     user and group name: zeros
    136     12     mtime      11 zeros "0", NUL          329     16     device numbers: zeros
    148     8      checksum   6 octal digits, NUL, " "   345     167    prefix and rest: zeros

A member is this header, its payload, and zeros up to a multiple of 512. Two blocks of zeros end the file;
nothing follows them. Since a header is a pure function of (name, size), reading one means: take the name and
the size it claims, build the canonical header, compare all 512 bytes. Links, devices, PAX and GNU extensions,
absolute paths, `..` and flipped bits all fail that one comparison.

A *key* names a sample (`chair_0001`), a *member name* what is in it (`json`, `target-64.oct`,
`v4_n02-histogram-256.oct`); the name in the tar is `KEY.MEMBER`. Keys hold no dot, because webdataset ends a
key at the first one.
"""

from __future__ import annotations

import re

from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError

BLOCK = 512
TRAILER = bytes(2 * BLOCK)
JSON = "json"
"""Name of the member that describes the sample; always its first."""

MAX_KEY = 64
MAX_NAME = 100
MAX_JSON_BYTES = 4 * 2**20
MAX_OCTREE_BYTES = 256 * 2**20

_KEY = re.compile(rf"[A-Za-z0-9_-]{{1,{MAX_KEY}}}", re.ASCII)
_ENCODINGS = "|".join(Encoding)
_MEMBER = re.compile(
    rf"(?:(?P<target>target)|(?P<variant>[A-Za-z0-9_][A-Za-z0-9_-]*)-(?P<encoding>{_ENCODINGS}))"
    r"-(?P<resolution>[1-9][0-9]{0,3})\.oct",
    re.ASCII,
)
_SIZE = re.compile(rb"[0-7]{11}\0")
_TYPES = {
    b"\0": "a file of the old tar format", b"1": "a hard link", b"2": "a symbolic link",
    b"3": "a character device", b"4": "a block device", b"5": "a folder", b"6": "a pipe",
    b"L": "a GNU long name", b"K": "a GNU long link", b"S": "a GNU sparse file",
    b"x": "a PAX header", b"g": "a global PAX header",
}


def check_key(key: str) -> str:
    """The key; OcnfError (`name`) unless a sample may have it: 1 to 64 of `A-Z a-z 0-9 _ -`."""
    if not _KEY.fullmatch(key):
        raise OcnfError("not a sample key", code="name", where=repr(key),
                        expected=f"1 to {MAX_KEY} characters of A-Z a-z 0-9 _ -")
    return key


def check_member(member: str) -> str:
    """The member name, if it is on the list: `json`, `target-RES.oct`, `VARIANT-ENCODING-RES.oct`.

    Raises:
        OcnfError: it is not (`name`).
    """
    if member != JSON and not _MEMBER.fullmatch(member):
        raise OcnfError("not a member that a sample may have", code="name", where=repr(member),
                        expected=f"json, target-RES.oct or VARIANT-ENCODING-RES.oct with one of {_ENCODINGS}")
    return member


def target_member(resolution: int) -> str:
    """Member name of the ground truth: `target-64.oct`."""
    return check_member(f"target-{resolution}.oct")


def input_member(variant: str, encoding: Encoding | str, resolution: int) -> str:
    """Member name of an input: `v4_n02-histogram-64.oct`."""
    return check_member(f"{variant}-{encoding}-{resolution}.oct")


def parse_member(member: str) -> tuple[str, Encoding | None, int]:
    """(variant, encoding, resolution) of an octree member; a target is ("target", None, resolution).

    Raises:
        OcnfError: no member has that name, or it is `json` (`name`).
    """
    match = _MEMBER.fullmatch(check_member(member))
    if match is None:
        raise OcnfError("not an octree", code="name", where=repr(member))
    if match["target"]:
        return "target", None, int(match["resolution"])
    return match["variant"], Encoding(match["encoding"]), int(match["resolution"])


def tar_name(key: str, member: str) -> str:
    """The checked name of a member in the tar, `KEY.MEMBER`; at most 100 characters.

    Raises:
        OcnfError: it is longer, or key or member is none (`name`).
    """
    name = f"{check_key(key)}.{check_member(member)}"
    if len(name) > MAX_NAME:
        raise OcnfError("a member's name is too long for a tar", code="name", where=name, found=len(name),
                        expected=f"at most {MAX_NAME} characters", fix="shorten the key or the variant")
    return name


def split_name(name: str) -> tuple[str, str]:
    """(key, member) of a name in the tar; OcnfError (`name`) unless a sample may have both."""
    key, _, member = name.partition(".")
    if tar_name(key, member) != name:
        raise OcnfError("not a member's name", code="name", where=repr(name))
    return key, member


def max_size(member: str) -> int:
    """The most bytes that a member may have: what one read may allocate."""
    return MAX_JSON_BYTES if member == JSON else MAX_OCTREE_BYTES


def padding(size: int) -> int:
    """Bytes of zeros after a payload."""
    return -size % BLOCK


def stored_size(size: int) -> int:
    """Bytes that a member occupies: header, payload, padding."""
    return BLOCK + size + padding(size)


def make_header(key: str, member: str, size: int) -> bytes:
    """The 512 bytes before a payload of `size` bytes: a pure function of its arguments.

    Raises:
        OcnfError: `size` is below 0 or above `max_size` (`too_large`), or the name cannot be (`name`).
    """
    if not 0 <= size <= max_size(member):
        raise OcnfError("a member has an impossible size", code="too_large", where=f"{key}.{member}",
                        found=size, expected=f"0 to {max_size(member)} bytes")
    return _header(tar_name(key, member).encode("ascii"), size)


def parse_tar_header(block: bytes) -> tuple[str, str, int]:
    """(key, member, size) of a header block.

    Raises:
        OcnfError: unless the block is, bit for bit, the canonical header of what it claims to be
            (code `header`, `name`, `too_large`, or `truncated` where there are fewer than 512 bytes).
    """
    if len(block) < BLOCK:
        raise OcnfError("the tar ends inside a header", code="truncated", found=f"{len(block)} bytes")
    if not any(block):
        raise OcnfError("a block of zeros stands where a header should", code="header")
    if block[156:157] in _TYPES:
        raise OcnfError("a shard holds plain files only", code="header", found=_TYPES[block[156:157]])
    raw_name, digits = block[:100].rstrip(b"\0"), block[124:136]
    if not _SIZE.fullmatch(digits):
        raise OcnfError("the size in a header is not 11 octal digits", code="header", found=digits)
    size = int(digits[:11], 8)
    if block != _header(raw_name, size):
        raise OcnfError("a header is not the one its name and size call for", code="header", found=raw_name)
    key, member = split_name(raw_name.decode("latin-1"))
    if size > max_size(member):
        raise OcnfError("a member claims to be too large", code="too_large", where=f"{key}.{member}",
                        found=size, expected=f"at most {max_size(member)} bytes")
    return key, member, size


def _header(name: bytes, size: int) -> bytes:
    block = bytearray(BLOCK)
    block[0:len(name)] = name
    block[100:124] = b"0000644\0" b"0000000\0" b"0000000\0"
    block[124:148] = b"%011o\0" % size + b"00000000000\0"
    block[148:156] = b" " * 8
    block[156:157] = b"0"
    block[257:265] = b"ustar\0" b"00"
    block[148:156] = b"%06o\0 " % sum(block)
    return bytes(block)
