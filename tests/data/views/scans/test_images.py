"""Images of scans: their pixels lie where the intrinsics mean them."""

from __future__ import annotations

import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from ocnf_data.views.scans.images import image_size, read_colour, read_depth

LEFT_RED = np.zeros((24, 40, 3), np.uint8)
LEFT_RED[:, :20, 0] = 255


def exif(orientation: int) -> bytes:
    """A TIFF directory, big-endian, of the one entry 0x0112."""
    return b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01" + orientation.to_bytes(2, "big") + bytes(6)


def encoded(suffix: str, image: np.ndarray, orientation: int) -> bytes:
    """The image with an EXIF orientation, as phones and cameras write it."""
    data = bytes(cv2.imencode(suffix, image[..., ::-1] if image.ndim == 3 else image)[1])
    tags = exif(orientation)
    if suffix == ".jpg":
        segment = b"Exif\0\0" + tags
        return data[:2] + b"\xff\xe1" + (len(segment) + 2).to_bytes(2, "big") + segment + data[2:]
    chunk = b"eXIf" + tags
    at = 8 + 25  # after the signature and IHDR
    return (data[:at] + len(tags).to_bytes(4, "big") + chunk + zlib.crc32(chunk).to_bytes(4, "big")
            + data[at:])


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_an_orientation_turns_no_pixel(tmp_path: Path, suffix: str, orientation: int) -> None:
    """The depth map and the intrinsics are of the sensor, whichever way up it was held."""
    file = tmp_path / f"image{suffix}"
    file.write_bytes(encoded(suffix, LEFT_RED, orientation))
    colour = read_colour(file)
    assert colour.shape[:2] == image_size(file) == (24, 40)
    assert np.abs(colour.astype(int) - LEFT_RED)[:, [0, 10, 30, 39]].max() < 10
    if suffix == ".png":
        depth = np.arange(24 * 40, dtype=np.uint16).reshape(24, 40)
        file.write_bytes(encoded(suffix, depth, orientation))
        np.testing.assert_array_equal(read_depth(file), depth)


def test_the_size_of_a_jpeg_behind_long_profiles(tmp_path: Path) -> None:
    file = tmp_path / "a.jpg"
    cv2.imwrite(str(file), np.zeros((24, 40, 3), np.uint8))
    data = file.read_bytes()
    profile = b"\xff\xe2" + (60_000).to_bytes(2, "big") + bytes(59_998)
    file.write_bytes(data[:2] + 2 * profile + data[2:])
    assert image_size(file) == (24, 40)
