"""What can be wrong with the bytes of a tar whose index is known: one `Fault` for each thing that is."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

from ocnf_data.errors import OcnfError
from ocnf_data.files.records import sha256_hex
from ocnf_data.shards.index import Member
from ocnf_data.shards.tarformat import BLOCK, TRAILER, make_header, padding, parse_tar_header, tar_name


class RawMember(NamedTuple):
    """The bytes that lie where a member should; parts are shorter where the tar ends."""

    header: bytes
    payload: bytes
    pad: bytes


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong in a tar.

    Attributes:
        code: `truncated`, `header`, `checksum`, `padding` or `trailer`.
        what: a clause.
        offset: byte in the tar where it begins.
        key, member: sample and member that the fault is in; None for the end of the tar.
    """

    code: str
    what: str
    offset: int
    key: str | None = None
    member: str | None = None

    def error(self, where: object) -> OcnfError:
        """The fault as an error about the tar `where`."""
        subject = f"{self.key}.{self.member}" if self.key else "end of the tar"
        return OcnfError(self.what, code=self.code, where=where, field=f"{subject} at byte {self.offset}",
                         fix="`ocnf-data repair` generates the shard again")


def member_faults(key: str, member: Member, raw: RawMember) -> Iterator[Fault]:
    """Everything that is wrong with a member as read; nothing where it is what the index says."""
    header, payload, pad = raw
    start, end = member.offset - BLOCK, member.offset + member.size
    missing = end + padding(member.size) - start - len(header) - len(payload) - len(pad)
    if missing:
        yield Fault("truncated", f"the tar ends {missing} bytes too early", start, key, member.name)
        return
    if header != make_header(key, member.name, member.size):
        yield Fault("header", f"not the header that the index calls for, but {_describe(header)}", start, key,
                    member.name)
    if (found := sha256_hex(payload)) != member.sha256:
        yield Fault("checksum", f"the payload has SHA-256 {found[:12]}..., not {member.sha256[:12]}...",
                    member.offset, key, member.name)
    if any(pad):
        yield Fault("padding", "the padding is not zero", end, key, member.name)


def end_faults(end: bytes, size: int) -> Iterator[Fault]:
    """What is wrong with the bytes from the trailer of a tar of `size` bytes on."""
    start = size - len(TRAILER)
    if len(end) < len(TRAILER):
        yield Fault("truncated", "the tar is cut in its last two blocks", start)
    elif any(end[: len(TRAILER)]):
        yield Fault("trailer", "the last two blocks are not zero", start)
    if len(end) > len(TRAILER):
        yield Fault("trailer", "something follows the last two blocks", size)


def _describe(header: bytes) -> str:
    """What a wrong header is, in words."""
    try:
        key, member, size = parse_tar_header(header)
    except OcnfError as error:
        return f"a damaged one ({error})"
    return f"that of {tar_name(key, member)} with {size} bytes"
