"""Slices are the dense volume's planes, and shading shows what is there."""

import numpy as np
import pytest

from ocnf_data.encodings import Encoding
from ocnf_data.octree import GridOctree
from ocnf_data.render import render_depth
from ocnf_data.render.pictures import as_distance, busiest_plane, busiest_window, paint_squares, slice_cells
from ocnf_data.render.shade import best_azimuth, shade, shade_view
from ocnf_data.views.cameras import Views


def ball(shape=(16, 24, 32), radius=6.0):
    z, y, x = np.indices(shape) + 0.5
    centre = np.array(shape) / 2
    distance = np.sqrt((z - centre[0]) ** 2 + (y - centre[1]) ** 2 + (x - centre[2]) ** 2) - radius
    return np.clip(distance / 2.13, -1, 1).astype(np.float32)[None]


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("index", [0, 7, 8, 11])
def test_painted_cells_are_the_plane_of_the_dense_volume(axis, index):
    dense = ball()
    octree = GridOctree.from_dense(dense)
    rows, squares = slice_cells(octree, axis, index)
    size = tuple(n for a, n in enumerate(octree.shape) if a != axis)
    assert (squares[:, 2].astype(int) ** 2).sum() == size[0] * size[1]
    plane = paint_squares(squares, octree.data[rows, 0], size)
    np.testing.assert_array_equal(plane, np.take(octree.to_dense()[0], index, axis=axis))


def test_every_encoding_of_free_and_unseen_space_shows_the_same_sign():
    for encoding, free, unseen in (
        (Encoding.TSDF, [1], [-1]),
        (Encoding.TDF_OCCUPANCY, [1, 0], [1, 1]),
        (Encoding.OCCUPANCY, [0], [1]),
        (Encoding.HISTOGRAM, [0] * 9 + [1], [1] + [0] * 9),
    ):
        np.testing.assert_array_equal(as_distance(np.float32([free, unseen]), encoding), [1, -1])


def test_busiest_plane_cuts_the_surface():
    octree = GridOctree.from_dense(ball())
    fine = octree.leaf_width() == 1
    assert fine[busiest_plane(octree, 0)].sum() == fine.sum(axis=(1, 2)).max()
    constant = GridOctree.from_dense(np.ones((1, 8, 8, 8), np.float32))
    assert busiest_plane(constant, 2) == 4


def test_busiest_window_holds_the_surface_and_stays_inside():
    octree = GridOctree.from_dense(ball((24, 24, 24), radius=4))
    window = busiest_window(octree, 1, 12, width=16)
    assert (window.row, window.column) == (3.5, 3.5)  # the median of voxels 0..23, less half of 16
    assert busiest_window(octree, 1, 12, width=64)[:2] == (0, 0)


def triangulated_sphere(n=48):
    theta, phi = np.meshgrid(np.linspace(0, np.pi, n), np.linspace(0, 2 * np.pi, 2 * n), indexing="ij")
    points = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    i, j = np.meshgrid(np.arange(n - 1), np.arange(2 * n - 1), indexing="ij")
    a = (i * 2 * n + j).ravel()
    below = a + 2 * n
    faces = np.concatenate([np.stack([a, a + 1, below], 1), np.stack([a + 1, below + 1, below], 1)])
    return points.reshape(-1, 3), faces


@pytest.mark.parametrize("up", ["y", "z"])
def test_a_shaded_sphere_is_a_disc_lit_from_the_upper_left(up):
    image = shade(*triangulated_sphere(), size=96, up=up)
    assert image.shape == (96, 96, 3) and image.dtype == np.uint8
    inside = (image < 250).any(axis=-1)
    radius = np.sqrt(inside.sum() / np.pi)
    assert radius == pytest.approx(0.46 * 96, rel=0.03)
    grey = image.mean(axis=-1)
    assert grey[30, 30] > grey[65, 65] + 20
    assert (image[0] == 255).all() and (image[:, -1] == 255).all()


def test_orientation_does_not_matter_and_up_is_up():
    points = np.array([[0, 0, 0], [1, 0, 0], [0.5, 0, 3.0]])  # a spike that points up the z axis
    faces = np.array([[0, 1, 2]])
    image = shade(points, faces, size=64, azimuth=0, elevation=0)
    np.testing.assert_array_equal(image, shade(points, faces[:, ::-1], size=64, azimuth=0, elevation=0))
    width = (image < 250).any(axis=-1).sum(axis=1)
    filled = np.flatnonzero(width)
    assert width[filled[0]] < width[filled[-1]]


@pytest.mark.parametrize("supersample", [1, 3])
def test_a_picture_from_a_camera_shows_what_the_camera_sees(supersample):
    """Not square, the principal point off the centre."""
    points, faces = triangulated_sphere()
    K = np.array([[50.0, 0, 20], [0, 55.0, 30], [0, 0, 1]])
    R, T = np.eye(3), np.array([0.3, -0.2, 3.0])
    depth = render_depth(points, faces, K[None], R[None], T[None], (48, 64))[0]
    camera = Views(np.zeros((1, 48, 64), np.float32), K, R[None], T[None])
    image = shade_view(points, faces, camera, supersample=supersample)
    assert image.shape == (48, 64, 3)
    drawn = (image < 250).any(axis=-1)
    off = drawn != np.isfinite(depth)
    assert off.mean() < (1e-9 if supersample == 1 else 0.05) and 0.2 < drawn.mean() < 0.8
    rows, columns = np.nonzero(np.isfinite(depth))
    assert np.abs(np.argwhere(drawn).mean(axis=0) - [rows.mean(), columns.mean()]).max() < 0.2


def test_any_unit_will_do():
    """Of a sphere smaller than a millimetre nothing is cut off."""
    points, faces = triangulated_sphere(24)
    picture, tiny = shade(points, faces, size=64), shade(points * 1e-6, faces, size=64)
    assert np.abs(picture.astype(int) - tiny).mean() < 1
    assert best_azimuth(points * 1e-6, faces) == best_azimuth(points, faces)
    K = np.array([[50.0, 0, 31], [0, 50.0, 23], [0, 0, 1]])
    seen = [shade_view(points * unit, faces, Views(np.zeros((1, 48, 64), np.float32), K, np.eye(3)[None],
                                                   np.array([[0, 0, 3.0 * unit]]))) for unit in (1, 1e-6)]
    assert (seen[0] < 250).any()
    assert np.abs(seen[0].astype(int) - seen[1]).mean() < 1


def test_no_faces_give_an_empty_picture():
    camera = Views(np.zeros((1, 4, 6), np.float32), np.eye(3), np.eye(3)[None], np.zeros((1, 3)))
    assert (shade_view(np.zeros((0, 3)), np.zeros((0, 3), int), camera) == 255).all()
    assert (shade(np.zeros((0, 3)), np.zeros((0, 3), int), size=16) == 255).all()
