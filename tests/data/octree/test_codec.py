"""Octree members as bytes: golden, readable without this package, and safe against any bytes."""

from __future__ import annotations

import hashlib
import json
import struct
import subprocess
import sys
import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest
import safetensors.numpy
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.octree import TARGET, GridOctree, RawOctree, decode, decode_raw, encode, encode_raw, quantise
from ocnf_data.octree.codec import MAX_DECODED_BYTES

KINDS = [TARGET, *Encoding]


def example(kind: str, octree: GridOctree, seed: int = 0) -> GridOctree:
    """The octree's structure with random values that the kind can hold."""
    rng = np.random.default_rng(seed)
    channels = 1 if kind == TARGET else Encoding(kind).channels
    data = rng.random((octree.n_leaves, channels))
    if kind == Encoding.HISTOGRAM:
        data = rng.dirichlet(np.full(channels, 0.3), octree.n_leaves)
    elif kind in (TARGET, Encoding.TSDF):
        data = np.clip(rng.normal(0, 1, data.shape), -1, 1)
    return octree.with_data(data.astype(np.float32))


def content_of(blob: bytes) -> bytes:
    return zstandard.ZstdDecompressor().decompress(blob)


def frame(content: bytes) -> bytes:
    return zstandard.ZstdCompressor(level=1, write_checksum=True).compress(content)


def split_content(content: bytes) -> tuple[bytes, bytes]:
    """(header JSON, tensors)."""
    end = 8 + int.from_bytes(content[:8], "little")
    return content[8:end], content[end:]


def join_content(header: bytes, tensors: bytes) -> bytes:
    return struct.pack("<Q", len(header)) + header + tensors


@settings(deadline=None)
@given(st.data(), st.sampled_from(KINDS))
def test_there_and_back(octrees: Callable, data: st.DataObject, kind: str) -> None:
    octree = example(kind, data.draw(octrees()))
    raw = quantise(octree, kind)
    blob = encode(octree, kind)
    assert blob == encode_raw(raw)
    again = decode_raw(blob, kind)
    np.testing.assert_array_equal(again.trees, octree.trees)
    np.testing.assert_array_equal(again.data, raw.data)
    assert (again.kind, again.shape, again.data.dtype) == (kind, octree.shape, raw.data.dtype)
    np.testing.assert_array_equal(decode(blob).data, raw.to_grid().data)


def test_golden_content(golden: tuple[np.ndarray, GridOctree]) -> None:
    """The bytes before compression, put together by hand."""
    _, octree = golden
    values = octree.data / 32  # 10..27 / 32: multiples of 2^-7, which an input holds exactly
    meta = r'{\"divisor\":1,\"kind\":\"tsdf\",\"shape\":[8,8,16],\"units\":\"TSDF / tau\",\"version\":1}'
    header = (
        f'{{"__metadata__":{{"ocnf":"{meta}"}},'
        '"data":{"data_offsets":[20,94],"dtype":"F16","shape":[37,1]},'
        '"trees":{"data_offsets":[0,20],"dtype":"U8","shape":[1,1,2,10]}}'
    ).encode()
    header += b" " * (-len(header) % 8)
    tree = sum(1 << bit for bit in (0, 6, 8, 52, 72)).to_bytes(10, "little")
    tensors = bytes(10) + tree + struct.pack("<37e", *values.ravel())
    blob = encode(octree.with_data(values), Encoding.TSDF)
    assert content_of(blob) == join_content(header, tensors)
    parameters = zstandard.get_frame_parameters(blob)
    assert parameters.has_checksum and parameters.content_size == 8 + len(header) + len(tensors)


def test_it_is_safetensors_to_everyone(golden: tuple[np.ndarray, GridOctree]) -> None:
    for kind in KINDS:
        raw = quantise(example(kind, golden[1]), kind)
        content = content_of(encode_raw(raw))
        tensors = safetensors.numpy.load(content)
        assert set(tensors) == {"trees", "data"}
        np.testing.assert_array_equal(tensors["data"], raw.data)
        np.testing.assert_array_equal(tensors["trees"], raw.trees.view(np.uint8)[..., :10])
        meta = json.loads(json.loads(split_content(content)[0])["__metadata__"]["ocnf"])
        values = tensors["data"].astype(np.float32) / meta["divisor"]
        np.testing.assert_array_equal(values, raw.to_grid().data)
        assert meta["kind"] == kind and meta["shape"] == [8, 8, 16]


def test_equal_octrees_give_equal_bytes_in_another_process() -> None:
    code = (
        "import hashlib, numpy as np\n"
        "from ocnf_data.octree import GridOctree, encode\n"
        "values = np.random.default_rng(3).random((1, 16, 16, 16), np.float32)\n"
        "print(hashlib.sha256(encode(GridOctree.from_dense(values), 'target')).hexdigest())\n"
    )
    values = np.random.default_rng(3).random((1, 16, 16, 16), np.float32)
    here = hashlib.sha256(encode(GridOctree.from_dense(values), TARGET)).hexdigest()
    command = [sys.executable, "-c", code]
    there = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    assert there.stdout.strip() == here


def test_another_kind_is_refused(golden: tuple[np.ndarray, GridOctree]) -> None:
    blob = encode(example(TARGET, golden[1]), TARGET)
    with pytest.raises(OcnfError, match="another kind; found target, expected tsdf"):
        decode(blob, Encoding.TSDF)


# Hostile bytes.


@settings(deadline=None, max_examples=300)
@given(st.binary(max_size=300))
def test_random_bytes_give_our_error(junk: bytes) -> None:
    for blob in (junk, b"\x28\xb5\x2f\xfd" + junk, frame(junk), frame(struct.pack("<Q", len(junk)) + junk)):
        with pytest.raises(OcnfError):
            decode_raw(blob)


@settings(deadline=None, max_examples=300)
@given(st.data(), st.sampled_from(KINDS))
def test_a_damaged_blob_is_an_error_or_unchanged(
    octrees: Callable, data: st.DataObject, kind: str
) -> None:
    octree = example(kind, data.draw(octrees(channels=1)))
    blob = bytearray(encode(octree, kind))
    how = data.draw(st.sampled_from(["flip", "cut", "insert", "append"]))
    place = data.draw(st.integers(0, len(blob) - 1))
    if how == "flip":
        blob[place] ^= 1 << data.draw(st.integers(0, 7))
    elif how == "cut":
        del blob[place:]
    elif how == "insert":
        blob.insert(place, data.draw(st.integers(0, 255)))
    else:
        blob += b"\0"
    try:
        raw = decode_raw(bytes(blob))
    except OcnfError:
        return
    assert how == "flip"  # a bit of the frame's header that says nothing
    assert content_of(encode_raw(raw)) == content_of(encode(octree, kind))


@settings(deadline=None, max_examples=300)
@given(st.data(), st.sampled_from(KINDS))
def test_damage_under_a_good_checksum_is_an_error_or_a_valid_octree(
    octrees: Callable, data: st.DataObject, kind: str
) -> None:
    content = bytearray(content_of(encode(example(kind, data.draw(octrees(channels=1))), kind)))
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    try:
        raw = decode_raw(frame(bytes(content)))
    except OcnfError:
        return
    RawOctree(raw.trees.copy(), raw.data.copy(), raw.kind)
    assert content_of(encode_raw(raw)) == content  # whatever is accepted is in the one canonical form


def respell(change: Callable[[dict, dict], None]) -> Callable[[bytes, bytes], bytes]:
    """A content whose header and metadata dicts went through `change`."""
    def edit(header: bytes, tensors: bytes) -> bytes:
        fields = json.loads(header)
        meta = json.loads(fields["__metadata__"]["ocnf"])
        change(fields, meta)
        fields["__metadata__"]["ocnf"] = json.dumps(meta, separators=(",", ":"), sort_keys=True)
        text = json.dumps(fields, separators=(",", ":"), sort_keys=True).encode()
        return join_content(text + b" " * (-len(text) % 8), tensors)
    return edit


def set_leaves(n: object) -> Callable[[bytes, bytes], bytes]:
    return respell(lambda fields, meta: fields["data"]["shape"].__setitem__(0, n))


def set_meta(key: str, value: object) -> Callable[[bytes, bytes], bytes]:
    return respell(lambda fields, meta: meta.__setitem__(key, value))


def set_data(key: str, value: object) -> Callable[[bytes, bytes], bytes]:
    return respell(lambda fields, meta: fields["data"].__setitem__(key, value))


def claim(shape: list[int], n_leaves: int) -> Callable[[bytes, bytes], bytes]:
    """A header that is consistent in itself."""
    def change(fields: dict, meta: dict) -> None:
        grid = [n // 8 for n in shape]
        end_of_trees = int(np.prod(grid)) * 10
        meta["shape"] = shape
        fields["trees"] |= {"shape": [*grid, 10], "data_offsets": [0, end_of_trees]}
        end_of_data = end_of_trees + 2 * n_leaves
        fields["data"] |= {"shape": [n_leaves, 1], "data_offsets": [end_of_trees, end_of_data]}
    return respell(change)


def flip_bit(bit: int) -> Callable[[bytes, bytes], bytes]:
    """Flip a bit of the golden octree's second tree."""
    def edit(header: bytes, tensors: bytes) -> bytes:
        damaged = bytearray(tensors)
        damaged[10 + bit // 8] ^= 1 << bit % 8
        return join_content(header, bytes(damaged))
    return edit


def set_half(value: float) -> Callable[[bytes, bytes], bytes]:
    return lambda header, tensors: join_content(header, tensors[:-2] + struct.pack("<e", value))


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (lambda h, t: b"", "header is too long or cut off"),
        (lambda h, t: struct.pack("<Q", 2**63) + h + t, f"found {2**63} bytes"),
        (lambda h, t: struct.pack("<Q", 2**20) + h + t, "too long"),
        (lambda h, t: join_content(b"[" * 1000, t), "not that of an octree"),
        (lambda h, t: join_content(b"\xff" + h, t), "not that of an octree"),
        (lambda h, t: join_content(b"[1]", t), "not that of an octree"),
        (lambda h, t: join_content(b"null", t), "not that of an octree"),
        (lambda h, t: join_content(b'{"__metadata__":{"ocnf":"[]"}}', t), "not that of an octree"),
        (lambda h, t: join_content(h.replace(b"trees", b"roots"), t), "contradicts itself"),
        (lambda h, t: join_content(h + b" " * 8, t), "contradicts itself"),
        (lambda h, t: join_content(h, t[:-1]), "size that its header claims"),
        (lambda h, t: join_content(h, t + b"\0"), "size that its header claims"),
        (set_meta("version", 2), "version: written by another version of the format; found 2, expected 1"),
        (set_meta("kind", "colour"), "kind: not a kind of octree; found colour"),
        (set_meta("kind", ["tsdf"]), "kind: not a kind"),
        (set_meta("kind", "histogram"), "contradicts itself"),
        (set_meta("divisor", 7), "contradicts itself"),
        (set_meta("shape", [8, 8, 12]), "shape: not the shape"),
        (set_meta("shape", [8, 8, 0]), "shape: not the shape"),
        (set_meta("shape", [8, 8, 16.0]), "shape: not the shape"),
        (set_meta("shape", [8, 8, 2**40]), "shape: not the shape"),
        (set_meta("shape", [8, 16, 8]), "contradicts itself"),
        (set_meta("shape", "abc"), "shape: not the shape"),
        (set_meta("script", "import os"), "contradicts itself"),
        (set_leaves(-1), "not a number of leaves"),
        (set_leaves(True), "not a number of leaves"),
        (set_leaves(1025), "not a number of leaves; found 1025, expected 1 to 1024"),
        (set_leaves(36), "contradicts itself"),
        (set_data("dtype", "F64"), "contradicts itself"),
        (set_data("data_offsets", [0, 74]), "contradicts itself"),
        (set_data("data_offsets", [20, 2**62]), "contradicts itself"),
        (claim([1024, 1024, 1024], 2**30), "size that its header claims"),
        (claim([8, 8, 16], 44), "size that its header claims"),
        (flip_bit(53), r"data: the data does not fit.*found float16 \(37, 1\), expected float16 \(44, 1\)"),
        (flip_bit(0), "no tree"),
        (flip_bit(79), "unused bit"),
        (set_half(np.nan), r"data\[36\]: no tsdf has"),
        (set_half(np.inf), "no tsdf has"),
        (set_half(1.0009765625), "no tsdf has"),
    ],
)
def test_content_that_lies(golden: tuple[np.ndarray, GridOctree], edit: Callable, words: str) -> None:
    _, octree = golden
    header, tensors = split_content(content_of(encode(octree.with_data(octree.data / 32), Encoding.TSDF)))
    with pytest.raises(OcnfError, match=words):
        decode_raw(frame(edit(header, tensors)))


def test_frames_without_size_or_checksum_or_with_company(golden: tuple[np.ndarray, GridOctree]) -> None:
    blob = encode(example(TARGET, golden[1]), TARGET)
    content = content_of(blob)
    with pytest.raises(OcnfError, match="no checksum"):
        decode_raw(zstandard.ZstdCompressor(write_checksum=False).compress(content))
    unsized = zstandard.ZstdCompressor(write_checksum=True, write_content_size=False).compress(content)
    with pytest.raises(OcnfError, match="size that its header claims"):
        decode_raw(unsized)
    skippable = struct.pack("<II", 0x184D2A50, 4) + b"hide"
    for company in (blob + blob, blob + skippable, skippable + blob):
        with pytest.raises(OcnfError):
            decode_raw(company)


def test_a_large_volume_of_few_bytes_takes_no_memory_under_a_small_name() -> None:
    n = 256
    blob = encode(GridOctree.trusted(np.zeros((n // 8,) * 3 + (2,), np.uint64),
                                     np.ones(((n // 8) ** 3, 1), np.float32)), "target")
    assert decode(blob).shape == (n,) * 3
    tracemalloc.start()
    with pytest.raises(OcnfError, match="another resolution"):
        decode_raw(blob, "target", resolution=16)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < n**3 // 512 * 10  # less than its trees


def test_bombs_do_not_go_off(golden: tuple[np.ndarray, GridOctree]) -> None:
    """Frames that would unpack to a quarter gigabyte, and frames that only claim a terabyte."""
    content = content_of(encode(example(TARGET, golden[1]), TARGET))
    zeros = bytes(1 << 20)
    size = len(content) + 256 * len(zeros)
    compressor = zstandard.ZstdCompressor(write_checksum=True).compressobj(size=size)
    bomb = compressor.compress(content) + b"".join(compressor.compress(zeros) for _ in range(256))
    bomb += compressor.flush()
    # Magic, descriptor (8-byte content size, single segment, checksum), size, one empty last block.
    start, block = b"\x28\xb5\x2f\xfd\xe4", b"\x01\0\0\0\0\0\0"
    claims = [start + struct.pack("<Q", n) + block for n in (2**40, 2**64 - 2)]
    tracemalloc.start()
    for blob in (bomb, *claims):
        with pytest.raises(OcnfError):
            decode_raw(blob)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 8 << 20


def test_what_could_not_be_read_is_not_written() -> None:
    trees = np.zeros((1, 1, 129, 2), np.uint64)
    octree = GridOctree(trees, np.zeros((129, 1), np.float32))
    with pytest.raises(OcnfError, match=f"too large to be stored.*1024 along an axis.*{MAX_DECODED_BYTES}"):
        encode(octree, TARGET)
