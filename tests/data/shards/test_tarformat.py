"""The header is a pure function of (name, size): nothing else is read."""

from __future__ import annotations

import io
import tarfile

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ocnf_data.errors import OcnfError
from ocnf_data.shards.tarformat import (
    BLOCK,
    MAX_JSON_BYTES,
    MAX_OCTREE_BYTES,
    input_member,
    make_header,
    padding,
    parse_member,
    parse_tar_header,
    split_name,
    stored_size,
    tar_name,
    target_member,
)

KEYS = st.from_regex(r"[A-Za-z0-9_-]{1,64}", fullmatch=True)
SIZES = st.integers(0, MAX_OCTREE_BYTES)


@given(KEYS, SIZES)
def test_header_is_what_python_tarfile_writes_for_these_facts(key: str, size: int) -> None:
    info = tarfile.TarInfo(f"{key}.target-256.oct")
    info.size = size
    assert make_header(key, "target-256.oct", size) == info.tobuf(tarfile.USTAR_FORMAT)


@given(KEYS, SIZES)
def test_a_header_reads_back(key: str, size: int) -> None:
    assert parse_tar_header(make_header(key, "v4_n02-tsdf-64.oct", size)) == (key, "v4_n02-tsdf-64.oct", size)


def test_every_flipped_bit_of_a_header_is_refused() -> None:
    header = make_header("chair_0001", "target-64.oct", 12345)
    for bit in range(8 * BLOCK):
        damaged = bytearray(header)
        damaged[bit // 8] ^= 1 << bit % 8
        with pytest.raises(OcnfError):
            parse_tar_header(bytes(damaged))


@given(st.binary(max_size=600))
def test_random_blocks_are_refused(block: bytes) -> None:
    with pytest.raises(OcnfError):
        parse_tar_header(block)


@given(st.data())
def test_headers_of_other_writers_are_refused_unless_equal(data: st.DataObject) -> None:
    """Well-formed headers with a valid checksum, any type and any facts: ours or OcnfError."""
    info = tarfile.TarInfo(data.draw(st.one_of(
        st.just("chair_1.json"),
        st.sampled_from(["../chair.json", "/etc/passwd", "a/b.json", "chair.v2.json", "pipe:ls.json", "x.pyd",
                         "x.pickle", "chair_1.JSON", "chair_1.target-64.oct\n", ".json", "chair_1."]))))
    info.size = data.draw(st.integers(0, 8**11 - 1))
    info.type = data.draw(st.sampled_from([bytes([kind]) for kind in b"0123456\0xgLKSV"]))
    info.mode = data.draw(st.sampled_from([0o644, 0o755, 0]))
    info.mtime = data.draw(st.sampled_from([0, 0, 1700000000]))
    info.uid = data.draw(st.sampled_from([0, 0, 1000]))
    info.uname = data.draw(st.sampled_from(["", "", "root"]))
    info.linkname = data.draw(st.sampled_from(["", "", "/etc/passwd"]))
    block = info.tobuf(data.draw(st.sampled_from([tarfile.USTAR_FORMAT, tarfile.GNU_FORMAT])))[:BLOCK]
    try:
        key, member, size = parse_tar_header(block)
    except OcnfError:
        return
    assert block == make_header(key, member, size)


@pytest.mark.parametrize("name", [
    "../a.json", "a/b.json", "/a.json", "a.b.json", "a.pyd", "a.pickle", "a.depth.pyd", "a.json ", "a.json\n",
    ".json", "a", "", "a.", "a.target-0.oct", "a.target-064.oct", "a.target-64.oct.gz", "a.v4-rgb-64.oct",
    "a.-tsdf-64.oct", "ä.json", "pipe:ls.json", "a" * 65 + ".json",
    "a" * 64 + "." + "v" * 30 + "-tdf_occupancy-64.oct"])
def test_names_off_the_list_are_refused(name: str) -> None:
    with pytest.raises(OcnfError) as caught:
        split_name(name)
    assert caught.value.code == "name"


def test_names_come_apart() -> None:
    assert split_name("chair_0001.v4-n02-histogram-256.oct") == ("chair_0001", "v4-n02-histogram-256.oct")
    assert parse_member("v4-n02-tdf_occupancy-64.oct") == ("v4-n02", "tdf_occupancy", 64)
    assert parse_member("tsdf-tsdf-64.oct") == ("tsdf", "tsdf", 64)
    assert parse_member(target_member(512)) == ("target", None, 512)
    assert tar_name("a", input_member("v1", "occupancy", 64)) == "a.v1-occupancy-64.oct"


@pytest.mark.parametrize(("member", "size"), [
    ("json", MAX_JSON_BYTES + 1), ("target-64.oct", MAX_OCTREE_BYTES + 1), ("target-64.oct", 8**11 - 1),
    ("json", -1)])
def test_impossible_sizes_are_refused(member: str, size: int) -> None:
    with pytest.raises(OcnfError) as caught:
        make_header("a", member, size)
    assert caught.value.code == "too_large"
    if size > 0:
        info = tarfile.TarInfo(f"a.{member}")
        info.size = size
        with pytest.raises(OcnfError) as caught:
            parse_tar_header(info.tobuf(tarfile.USTAR_FORMAT))
        assert caught.value.code == "too_large"


def test_sizes_add_up_as_tarfile_adds_them() -> None:
    for size in (0, 1, 511, 512, 513, 5000):
        buffer = io.BytesIO()
        with tarfile.open(fileobj=buffer, mode="w", format=tarfile.USTAR_FORMAT) as tar:
            info = tarfile.TarInfo("a.json")
            info.size = size
            tar.addfile(info, io.BytesIO(bytes(size)))
            assert tar.offset == stored_size(size) == BLOCK + size + padding(size)
