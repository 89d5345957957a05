"""The z-buffer against float64 ray casting, and what only a rasteriser can get wrong."""

from __future__ import annotations

import itertools
import types
from collections.abc import Callable, Iterator

import numba
import numpy as np
import pytest
import trimesh
from hypothesis import example, given, settings
from hypothesis import strategies as st

from ocnf_data.errors import OcnfError
from ocnf_data.render import raster, render_depth
from ocnf_data.render.raster import rasterise
from ocnf_data.views.rigs import fibonacci, intrinsics, look_from, published80

# fx != fy, a principal point off the centre, an image that is not square
K = intrinsics(47.0, 61.0, 33.25, 15.5)
SIZE = (40, 70)
Same = Callable[..., np.ndarray]


def _badly_wound(faces: np.ndarray) -> np.ndarray:
    flip = np.random.default_rng(0).random(len(faces)) < 0.5
    return np.where(flip[:, None], faces[:, ::-1], faces)


def _meshes() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    rng = np.random.default_rng(1)
    ball = trimesh.creation.icosphere(3)
    torus = trimesh.creation.torus(0.8, 0.3, major_sections=24, minor_sections=12)
    upper = ball.vertices[ball.faces].mean(axis=1)[:, 2] > 0
    rods = rng.uniform(-1, 1, (30, 3, 3))
    rods[:, 2] = rods[:, 0] + rng.normal(0, 0.004, (30, 3))  # a tenth of a pixel wide
    soup = rng.uniform(-1.2, 1.2, (40, 3, 3))
    flat = soup.copy()
    flat[::2, 2] = flat[::2, 1]  # without area
    flat[1::4, 2] = (flat[1::4, 0] + flat[1::4, 1]) / 2

    def unshared(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)

    return {
        "closed": (np.array(ball.vertices), np.array(ball.faces)),
        "open": (np.array(ball.vertices), np.array(ball.faces[upper])),
        "badly wound": (np.array(torus.vertices), _badly_wound(np.array(torus.faces))),
        "thin": unshared(rods),
        "degenerate": unshared(flat),
        "soup": unshared(soup),
    }


MESHES = _meshes()


@pytest.mark.parametrize("name", MESHES)
def test_equals_ray_casting(name: str, assert_same_depth: Same) -> None:
    vertices, faces = MESHES[name]
    R, T = look_from(fibonacci(3), 3.0)
    depth = render_depth(vertices, faces, K, R, T, SIZE)
    expected = assert_same_depth(depth, vertices, faces, K, R, T)
    assert depth.dtype == np.float32
    assert 0 < np.isfinite(expected).mean() < 1


@pytest.mark.parametrize("name", MESHES)
def test_cuts_at_the_near_plane(name: str, assert_same_depth: Same) -> None:
    vertices, faces = MESHES[name]
    R, T = look_from(fibonacci(3), 0.6)  # inside
    for near in (1e-3, 0.3):
        depth = render_depth(vertices, faces, K, R, T, SIZE, near=near)
        assert_same_depth(depth, vertices, faces, K, R, T, near)
        assert (depth >= np.float32(near)).all()


def test_a_camera_for_every_view(assert_same_depth: Same) -> None:
    """80 views, each with a K of its own; and one view of them gives the same as all."""
    vertices, faces = MESHES["soup"]
    R, T = look_from(published80(), 3.0)
    f = np.linspace(10, 30, 80)
    Ks = np.stack([intrinsics(a, 40 - a, 8 + a / 10, 9 - a / 10) for a in f])
    depth = render_depth(vertices, faces, Ks, R, T, (14, 20))
    for i in range(80):
        if i % 16 == 0:
            assert_same_depth(depth[i : i + 1], vertices, faces, Ks[i], R[i : i + 1], T[i : i + 1])
        alone = render_depth(vertices, faces, Ks[i], R[i : i + 1], T[i : i + 1], (14, 20))
        np.testing.assert_array_equal(depth[i], alone[0])


# On this lattice, seen by the camera below, vertices at z = 4 project to exact whole and half pixels, so that
# pixel centres on edges and vertices, edges along rows and triangles seen edge on are the rule.
SIXTEENTHS = st.integers(-14, 14).map(lambda k: k / 16)
LATTICE = st.tuples(SIXTEENTHS, SIXTEENTHS, st.sampled_from([0.0, 0.0, -3.0, 1.0, -4.5]))
ANYWHERE = st.tuples(*[st.floats(-2, 2, width=32)] * 3)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(*[st.one_of(LATTICE, ANYWHERE)] * 3), min_size=1, max_size=8))
def test_triangle_soup(assert_same_depth: Same, corners: list[tuple[tuple[float, ...], ...]]) -> None:
    vertices = np.array(corners, dtype=float).reshape(-1, 3)
    faces = np.arange(len(vertices)).reshape(-1, 3)
    K, R, T = intrinsics(32.0, 32.0, 6.0, 5.0), np.eye(3)[None], np.array([[0.0, 0.0, 4.0]])
    assert_same_depth(render_depth(vertices, faces, K, R, T, (11, 13)), vertices, faces, K, R, T)


PIXELS = st.tuples(st.integers(-3, 15), st.integers(-3, 13))


@given(PIXELS, PIXELS, PIXELS)
@example((0, -44), (-3, 5), (1, 5))  # 49 * (1 / 49) < 1: the last corner would be lost to rounding
def test_covers_the_pixels_of_a_triangle(a: tuple[int, int], b: tuple[int, int], c: tuple[int, int]) -> None:
    """Vertices on whole pixels: coverage, edges and corners included, is decided in integers."""
    K, R, T = intrinsics(1.0, 1.0, 0.0, 0.0), np.eye(3)[None], np.zeros((1, 3))
    vertices = np.array([(*p, 1.0) for p in (a, b, c)])
    depth = render_depth(vertices, [[0, 1, 2]], K, R, T, (10, 12))[0]
    v, u = np.mgrid[:10, :12]
    sides = np.array([(q[0] - p[0]) * (v - p[1]) - (q[1] - p[1]) * (u - p[0])
                      for p, q in ((a, b), (b, c), (c, a))])
    area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    inside = ((sides >= 0).all(axis=0) | (sides <= 0).all(axis=0)) & (area != 0)
    np.testing.assert_array_equal(np.isfinite(depth), inside)
    assert (depth[inside] == 1.0).all()


def test_edge_on_triangles_stay_between_their_corners() -> None:
    """The depth of a triangle seen edge on to within rounding is anything between its corners', no more."""
    rng = np.random.default_rng(0)
    K, R, T = intrinsics(32.0, 32.0, 6.0, 5.0), np.eye(3)[None], np.zeros((1, 3))
    hits = 0
    for width in np.repeat([1e-17, 1e-16, 1e-15, 1e-13], 500):
        x, y, z = rng.integers(-2, 3, 3) * width, rng.uniform(-1, 1, 3), rng.uniform(1, 6, 3)
        corners = np.stack([x, y, z], axis=1)
        depth = render_depth(corners, [[0, 1, 2]], K, R, T, (11, 13))
        seen = depth[np.isfinite(depth)]
        hits += seen.size
        assert ((seen > corners[:, 2].min() - 1e-5) & (seen < corners[:, 2].max() + 1e-5)).all()
    assert hits > 1000


@pytest.mark.parametrize("seed", range(3))
def test_shared_edges_leave_no_cracks(seed: int) -> None:
    """A sheet cut into 200,000 triangles of all shapes shows no hole, from ahead and from the side."""
    rng = np.random.default_rng(seed)
    n = 317
    x, y = np.meshgrid(np.sort(rng.uniform(-1, 1, n)), np.linspace(-1, 1, n))  # columns down to 1e-6 wide
    if seed == 0:  # many vertices exactly on pixel centres
        x, y = np.round(x * 64) / 64, np.round(y * 64) / 64
    x[:, 0], x[:, -1], y[0], y[-1] = -1, 1, -1, 1
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel()
    faces = _badly_wound(np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)]))
    sheet = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    K = intrinsics(128.0, 128.0, 70.0, 50.0)
    turn = trimesh.transformations.rotation_matrix(0.9, (0.3, 1.0, 0.2))[:3, :3]
    R, T = np.stack([np.eye(3), turn]), np.array([[0.0, 0, 2], [0, 0, 2]])
    size = (101, 141)
    square = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]
    whole = render_depth(square, [[0, 1, 2], [0, 2, 3]], K, R, T, size)
    cut = render_depth(sheet, faces, K, R, T, size)
    assert (np.isfinite(whole).mean(axis=(1, 2)) > 0.3).all()
    np.testing.assert_array_equal(np.isfinite(cut), np.isfinite(whole))
    seen = np.isfinite(whole)
    np.testing.assert_allclose(cut[seen], whole[seen], atol=1e-6)


def test_large_and_near_triangles(assert_same_depth: Same) -> None:
    """Corners a million pixels outside the image, next to the near plane or behind it, cost no accuracy."""
    corners = np.array([
        [[-0.5, -0.5, -2.998], [90, 3, 90], [-150, 100, 70]],
        [[0.5, 0.1, -2.9985], [0.5, 0.7, -2.9985], [-3, -9, 9]],
        [[-30, -20, 8], [40, -20, -7], [3, 60, 9]],
    ])
    vertices, faces = corners.reshape(-1, 3), np.arange(9).reshape(-1, 3)
    R, T = np.eye(3)[None], np.array([[0.0, 0.0, 3.0]])
    for chosen in (faces, faces[:1], faces[1:2], faces[2:]):
        expected = assert_same_depth(render_depth(vertices, chosen, K, R, T, SIZE), vertices, chosen, K, R, T)
        assert np.isfinite(expected).any()


@pytest.fixture
def two_threads() -> Iterator[None]:
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("numba has one thread only")
    before = numba.get_num_threads()
    yield
    numba.set_num_threads(before)


@pytest.mark.usefixtures("two_threads")
def test_thread_count_changes_nothing() -> None:
    vertices, faces = MESHES["badly wound"]
    R, T = look_from(fibonacci(7), 3.0)
    depths = []
    for n in (1, 2):
        numba.set_num_threads(n)
        depths.append(render_depth(vertices, faces, K, R, T, SIZE))
    np.testing.assert_array_equal(*depths)


@pytest.fixture(scope="module")
def bounds_checked() -> Callable[..., np.ndarray]:
    """`rasterise` out of the same kernels, compiled so that an index outside its array raises IndexError."""
    namespace = dict(vars(raster))
    for name in ("_to_camera", "_upper_first", "_project", "_draw", "_draw_clipped", "_render_strided"):
        function = types.FunctionType(namespace[name].py_func.__code__, namespace, name)
        namespace[name] = numba.njit(boundscheck=True, error_model="numpy")(function)

    def rasterise(vertices, faces, K, R, T, size, near=1e-3) -> np.ndarray:
        depth = np.empty((len(R), *size), np.float32)
        pinholes = np.stack([K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2]], axis=1)
        cameras = raster.Cameras(pinholes, R, T, near)
        namespace["_render_strided"](vertices, faces.astype(np.uint32), cameras, 0, 1, depth)
        return depth

    return rasterise


ABSURD = np.array([[1e308, 1e308, 1.0], [-1e308, 1e308, 1.0], [0, -1e308, 1.0], [1e300, 0, 1e-3],
                   [3e9, -2e9, 0.5], [-7.0, 1e17, 2e-3], [0.0, 0.0, 1.0], [1e-3, 1e-3, -1e300]])


@pytest.mark.parametrize("focal", [1e-300, 1.0, 1e9, 1e300])
@pytest.mark.parametrize("centre", [3.0, -1e12, 1e308])
def test_absurd_cameras_stay_inside_the_image(bounds_checked: Same, focal: float, centre: float) -> None:
    """Overflow to inf and NaN in the set-up must not write outside the buffers."""
    faces = np.array(list(itertools.permutations(range(len(ABSURD)), 3)))
    K = np.array([[[focal, 0, centre], [0, focal, 3], [0, 0, 1]]])
    scene = (ABSURD, faces, K, np.eye(3)[None], np.zeros((1, 3)), (9, 7))
    inside = bounds_checked(*scene)  # first: the other would write where it likes
    np.testing.assert_array_equal(rasterise(*scene), inside)


@pytest.mark.parametrize("distance", [0.6, 1.1, 3.0])
def test_ordinary_cameras_stay_inside_the_image(bounds_checked: Same, distance: float) -> None:
    """Triangles over all four borders, and across the near plane."""
    R, T = look_from(fibonacci(5), distance)
    for vertices, faces in MESHES.values():
        scene = (vertices, faces, np.repeat(K[None], 5, axis=0), R, T, SIZE)
        inside = bounds_checked(*scene)  # first: the other would write where it likes
        np.testing.assert_array_equal(rasterise(*scene), inside)


R1, T1 = np.eye(3)[None], np.array([[0.0, 0.0, 3.0]])
TRIANGLE = np.array([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]])


@pytest.mark.parametrize(("change", "message"), [
    ({"vertices": TRIANGLE[:, :2]}, r"vertices: .*found \(3, 2\)"),
    ({"vertices": TRIANGLE * [1, np.nan, 1]}, r"vertices\[0\]: .*not finite"),
    ({"faces": [[0, 1, 3]]}, r"faces: .*found 0 to 3, expected 0 to 2"),
    ({"faces": [[0, 1, -1]]}, r"faces: .*found -1 to 1"),
    ({"faces": [[0.0, 1.0, 2.0]]}, r"faces: .*float64"),
    ({"faces": [[0, 1, 2, 0]]}, r"faces: .*\(1, 4\)"),
    ({"K": np.eye(4)}, r"K: .*found \(4, 4\)"),
    ({"K": np.diag([351.0, -351, 1])}, "K: not a pinhole"),
    ({"R": np.eye(3)}, r"R: .*found \(3, 3\), expected \(V, 3, 3\)"),
    ({"R": 2 * R1}, r"R\[0\]: not a rotation"),
    ({"T": np.zeros((2, 3))}, r"T: .*found \(2, 3\)"),
    ({"T": np.full((1, 3), np.inf)}, "T: T is not finite"),
    ({"size": (0, 5)}, "size: .*found"),
    ({"size": 480}, "size: .*found 480"),
    ({"size": (48.5, 64)}, "size: .*found"),
    ({"vertices": None}, "vertices: not one array of numbers"),
    ({"vertices": [[0, 0, 0], [1, 1]]}, "vertices: not one array of numbers; found a list of shapes"),
    ({"faces": "012"}, "faces: not one array of numbers; found <U3"),
    ({"K": {}}, "K: not one array of numbers"),
    ({"T": ["a", "b", "c"]}, "T: not one array of numbers"),
    ({"near": "1"}, "near: "),
    ({"backend": "vulkan"}, "backend: .*vulkan, expected raster or pyrender"),
    ({"near": 0.0}, "near: "),
    ({"near": np.nan}, "near: "),
])
def test_bad_arguments_are_refused(change: dict, message: str) -> None:
    good = {"vertices": TRIANGLE, "faces": [[0, 1, 2]], "K": K, "R": R1, "T": T1, "size": SIZE}
    assert np.isfinite(render_depth(**good)).any()
    with pytest.raises(OcnfError, match=message):
        render_depth(**(good | change))


def test_no_faces_is_free_space_everywhere() -> None:
    assert np.isposinf(render_depth(TRIANGLE, np.empty((0, 3), np.int64), K, R1, T1, SIZE)).all()
    assert np.isposinf(render_depth(np.empty((0, 3)), [], K, R1, T1, SIZE)).all()
