"""Local thickness of solids whose thickness is known, and the recall that is divided by it."""

from __future__ import annotations

import numpy as np
import pytest

from ocnf_model.measures.figures import measure_surface
from ocnf_model.measures.reference import Reference
from ocnf_model.measures.surface import Surface
from ocnf_model.measures.thickness import local_thickness


def plate(thickness: float, at: float = 0.011, half: float = 1.0):
    return lambda x, y, z: np.maximum(abs(z - at) - thickness / 2, np.maximum(abs(x), abs(y)) - half)


def rod(diameter: float):
    """Along z, right through the cube."""
    return lambda x, y, z: np.hypot(x - 0.013, y + 0.02) - diameter / 2


def thickness_of(octree, longest: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    samples = Surface.of_octree(octree, 3.0).samples
    return samples.points, local_thickness(octree, samples.points, samples.normals, longest, 3.0)


@pytest.mark.parametrize("voxels", [2.0, 3.5, 6.0])
def test_a_plate_is_as_thick_as_it_is_but_at_its_rim(solid, voxel, voxels) -> None:
    points, found = thickness_of(solid(plate(voxels * voxel)))
    flat = np.abs(points[:, :2]).max(axis=1) < 0.9
    np.testing.assert_allclose(found[flat] / voxel, voxels, atol=0.1)
    assert flat.mean() > 0.6


@pytest.mark.parametrize("voxels", [2.4, 4.0, 8.0])
def test_a_rod_is_as_thick_as_its_diameter(solid, voxel, voxels) -> None:
    points, found = thickness_of(solid(rod(voxels * voxel)))
    side = abs(points[:, 2]) < 1.3
    assert np.median(found[side]) / voxel == pytest.approx(voxels, abs=0.3)
    assert (found[side] / voxel < voxels + 0.1).all()


def test_a_sphere_is_as_thick_as_its_diameter_and_a_block_thicker_than_is_followed(solid, voxel) -> None:
    _, found = thickness_of(solid(lambda x, y, z: np.sqrt(x**2 + y**2 + z**2) - 0.4))
    np.testing.assert_allclose(found, 0.8, atol=0.2 * voxel)
    _, found = thickness_of(solid(lambda x, y, z: np.sqrt(x**2 + y**2 + z**2) - 0.4), longest=0.5)
    assert np.isinf(found).all()


def test_which_way_normals_point_does_not_matter_and_sheets_have_none(solid, voxel) -> None:
    octree = solid(plate(3 * voxel))
    samples = Surface.of_octree(octree, 3.0).samples
    one, other = (local_thickness(octree, samples.points, sign * samples.normals, 1.0) for sign in (1, -1))
    np.testing.assert_allclose(one, other)
    # A sheet in free space, that the grid does not hold at all.
    points = np.tile([[0.0, 0.0, 1.2]], (5, 1))
    assert (local_thickness(octree, points, np.tile([[0.0, 0, 1]], (5, 1)), 1.0, 3.0) == 0).all()
    # A sheet half a voxel off the surface still belongs to it.
    near = np.tile([[0.0, 0.0, 0.011 + 2.0 * voxel]], (5, 1))
    found = local_thickness(octree, near, np.tile([[0.0, 0, 1]], (5, 1)), 1.0, 3.0)
    np.testing.assert_allclose(found / voxel, 3, atol=0.1)


def test_the_recall_of_what_is_thin_is_its_own(solid, voxel) -> None:
    """A block and a plate two voxels thick, far apart, of which the plate, or the block, is lost."""
    def block(x, y, z):
        return np.maximum(np.maximum(abs(x), abs(y)), abs(z + 0.8)) - 0.3

    thin = plate(2 * voxel, at=0.8, half=0.6)
    reference = Reference.of_truth(solid(lambda x, y, z: np.minimum(block(x, y, z), thin(x, y, z))), 3.0,
                                   3 * voxel)
    without_thin = measure_surface(Surface.of_octree(solid(block), 3.0), reference, voxel, 3.0)
    assert without_thin.recall_medium == 0 and without_thin.recall_thick > 0.85
    without_block = measure_surface(Surface.of_octree(solid(thin), 3.0), reference, voxel, 3.0)
    assert without_block.recall_medium == 1 and without_block.recall_thick < 0.15
    # At twice the size of a voxel the plate is one voxel thick.
    coarse = measure_surface(Surface.of_octree(solid(block), 3.0), reference, 2 * voxel, 3.0)
    assert coarse.recall_thin == 0 and np.isnan(coarse.recall_medium)
