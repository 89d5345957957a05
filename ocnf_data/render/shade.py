"""Pictures of surfaces from the depth rasteriser alone, so that they need no GL.

Normals come from differences of neighbouring depths, ambient occlusion from the unsharp-masked depth
buffer (Luft, Colditz and Deussen, "Image enhancement by unsharp masking the depth buffer", SIGGRAPH 2006).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ocnf_data.arrays import F32, F64, I64, U8, Bool
from ocnf_data.render.raster import rasterise
from ocnf_data.views.cameras import Views, resized

CLAY = (0.80, 0.76, 0.70)
_KEY_LIGHT = np.array([-0.45, -0.65, -0.61])  # camera axes (x right, y down, z forward), towards the light
_DISTANCE = 4.5  # of the camera, in radii of the object: a long lens distorts little
_AZIMUTHS = (35.0, 325.0, 145.0, 215.0, 60.0, 300.0, 120.0, 240.0)  # of equal ones, the first is taken
_SEARCH = 96  # pixels along a picture that is only measured
_NEAR = 1e-3  # radii of the object, and at most as many units: of things smaller than 1 nothing is cut off
_MARGIN = 0.04  # of the picture's width, left free all around


def shade(
    vertices: npt.ArrayLike,
    faces: npt.ArrayLike,
    size: int = 480,
    azimuth: float = 35.0,
    elevation: float = 22.0,
    up: str = "z",
    colour: tuple[float, float, float] = CLAY,
    frame: npt.ArrayLike | None = None,
    supersample: int = 3,
) -> U8:
    """Draw a surface, two-sided, on white.

    Args:
        vertices: (N, 3) in any unit.
        faces: (M, 3) indices; M may be 0, which gives an empty picture.
        size: width and height of the square picture in pixels.
        azimuth: degrees around the up axis.
        elevation: degrees above the horizon.
        up: which axis of the mesh points up, "y" or "z".
        colour: albedo, RGB in 0..1.
        frame: (P, 3) points that have to fit into the picture, default the vertices. Pass the same to
            pictures that are to be compared.
        supersample: samples a pixel along each axis.

    Returns:
        (size, size, 3) uint8.
    """
    points = np.asarray(vertices, dtype=np.float64).reshape(-1, 3)
    triangles = np.asarray(faces, dtype=np.int64).reshape(-1, 3)
    if len(triangles) == 0:
        return np.full((size, size, 3), 255, dtype=np.uint8)
    fit = points if frame is None else np.asarray(frame, dtype=np.float64).reshape(-1, 3)
    low, high = fit.min(axis=0), fit.max(axis=0)
    radius = max(float(np.linalg.norm(high - low)) / 2, 1e-12)

    n = size * supersample
    R = _orbit(azimuth, elevation, up)
    T = np.array([0.0, 0.0, _DISTANCE * radius]) - R @ ((low + high) / 2)
    K = _fit(fit @ R.T + T, n)
    return _lit(points, triangles, Views(_blank((n, n)), K, R[None], T[None]), radius, colour, supersample)


def shade_view(vertices: npt.ArrayLike, faces: npt.ArrayLike, camera: Views, supersample: int = 2,
               colour: tuple[float, float, float] = CLAY) -> U8:
    """Draw a surface, two-sided, on white, as a camera of one's own sees it.

    Args:
        vertices: (N, 3) metres.
        faces: (M, 3) indices; M may be 0, which gives an empty picture.
        camera: one view; its depth map gives nothing but the size (H, W) of the picture.
        supersample: samples a pixel along each axis.
        colour: albedo, RGB in 0..1.

    Returns:
        (H, W, 3) uint8.
    """
    points = np.asarray(vertices, dtype=np.float64).reshape(-1, 3)
    triangles = np.asarray(faces, dtype=np.int64).reshape(-1, 3)
    height, width = camera.size
    if len(triangles) == 0:
        return np.full((height, width, 3), 255, dtype=np.uint8)
    size = height * supersample, width * supersample
    fine = Views(_blank(size), resized(camera.K, camera.size, size), camera.R, camera.T)
    radius = max(float(np.linalg.norm(points.max(axis=0) - points.min(axis=0))) / 2, 1e-12)
    return _lit(points, triangles, fine, radius, colour, supersample)


def _blank(size: tuple[int, int]) -> F32:
    """A depth map (1, H, W) that says nothing, and takes no memory."""
    return np.broadcast_to(np.float32(0), (1, *size))


def _lit(points: F64, triangles: I64, camera: Views, radius: float, colour: tuple[float, float, float],
         supersample: int) -> U8:
    """The picture of one view, averaged over squares of `supersample` x `supersample` pixels."""
    height, width = camera.size
    K = camera.K[0]
    depth = rasterise(points, triangles, camera.K, camera.R, camera.T, (height, width),
                      _NEAR * min(1.0, radius))[0].astype(np.float64)
    hit = np.isfinite(depth)
    normal = _normals(np.where(hit, depth, np.nan), K)
    key = np.clip(normal @ (_KEY_LIGHT / np.linalg.norm(_KEY_LIGHT)), 0, 1)
    facing = np.clip(-normal[..., 2], 0, 1)
    light = (0.30 + 0.25 * facing + 0.55 * key) * _occlusion(depth, hit, radius, supersample)
    image = np.where(hit[..., None], np.clip(light, 0, 1)[..., None] * np.asarray(colour), 1.0)
    image = image.reshape(height // supersample, supersample, width // supersample, supersample, 3)
    return (255 * np.clip(image.mean(axis=(1, 3)), 0, 1) ** (1 / 1.2) + 0.5).astype(np.uint8)


def best_azimuth(vertices: npt.ArrayLike, faces: npt.ArrayLike, up: str = "z",
                 elevation: float = 22.0) -> float:
    """The azimuth for `shade` from which most is seen of a surface, of eight that look at it half sideways.

    What is seen of is the entropy of the directions in which the pixels face (after Vazquez et al.,
    "Viewpoint selection using viewpoint entropy", VMV 2001), times the number of pixels: large and varied.

    Args:
        vertices: (N, 3) in any unit.
        faces: (M, 3) indices.
        up: which axis of the mesh points up, "y" or "z".
        elevation: degrees above the horizon.
    """
    points = np.asarray(vertices, dtype=np.float64).reshape(-1, 3)
    triangles = np.asarray(faces, dtype=np.int64).reshape(-1, 3)
    if len(triangles) == 0:
        return _AZIMUTHS[0]
    low, high = points.min(axis=0), points.max(axis=0)
    radius = max(float(np.linalg.norm(high - low)) / 2, 1e-12)
    R = np.stack([_orbit(azimuth, elevation, up) for azimuth in _AZIMUTHS])
    T = np.array([0.0, 0.0, _DISTANCE * radius]) - R @ ((low + high) / 2)
    focal = 0.45 * _SEARCH * (_DISTANCE - 1)  # the same in all, so that pixels can be compared
    K = np.array([[focal, 0, (_SEARCH - 1) / 2], [0, focal, (_SEARCH - 1) / 2], [0, 0, 1]])
    depths = rasterise(points, triangles, np.tile(K, (len(R), 1, 1)), R, T, (_SEARCH, _SEARCH),
                       _NEAR * min(1.0, radius))
    shown = [_shown(depth.astype(np.float64), K) for depth in depths]
    return _AZIMUTHS[int(np.argmax(shown))]


def _shown(depth: F64, K: F64) -> float:
    """Pixels that hit times (1 + the entropy of their normals, rounded to halves)."""
    hit = np.isfinite(depth)
    normal = _normals(np.where(hit, depth, np.nan), K)[hit]
    bins = np.rint(2 * np.nan_to_num(normal)).astype(np.int64) + 2
    share = np.bincount(bins @ [25, 5, 1], minlength=125) / max(len(bins), 1)
    share = share[share > 0]
    return float(hit.sum() * (1 - (share * np.log(share)).sum()))


def _fit(points: F64, n: int) -> F64:
    """Intrinsics (3, 3) with which points in camera axes just fill n x n pixels, less the margin."""
    seen = points[:, :2] / points[:, 2:]
    low, high = seen.min(axis=0), seen.max(axis=0)
    focal = (1 - 2 * _MARGIN) * n / max(float((high - low).max()), 1e-12)
    cx, cy = (n - 1) / 2 - focal * (low + high) / 2
    return np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1]])


def _orbit(azimuth: float, elevation: float, up: str) -> F64:
    """World-to-camera rotation (3, 3) of a camera that orbits the origin and looks at it."""
    a, e = np.deg2rad([azimuth, elevation])
    ahead = -np.array([np.cos(e) * np.sin(a), -np.cos(e) * np.cos(a), np.sin(e)])  # z is up
    if up == "y":
        ahead = ahead[[0, 2, 1]] * [1, 1, -1]
    sky = np.array([0.0, 1.0, 0.0]) if up == "y" else np.array([0.0, 0.0, 1.0])
    right = np.cross(ahead, sky)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(ahead, right), ahead])


def _normals(depth: F64, K: F64) -> F64:
    """Unit normals (H, W, 3) towards the camera from depth (H, W) with NaN for the background.

    Of the differences to the two neighbours on an axis the smaller in depth is taken, so that normals at a
    silhouette come from the near surface alone.
    """
    v, u = np.indices(depth.shape)
    ray = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(depth)], axis=-1)
    points = ray * depth[..., None]

    def slope(axis: int) -> F64:
        ahead = np.full_like(points, np.nan)
        step = np.diff(points, axis=axis)
        if axis == 0:
            ahead[:-1] = step
        else:
            ahead[:, :-1] = step
        behind = np.roll(ahead, 1, axis=axis)
        size_ahead = np.nan_to_num(np.abs(ahead[..., 2]), nan=np.inf)
        size_behind = np.nan_to_num(np.abs(behind[..., 2]), nan=np.inf)
        return np.where((size_ahead <= size_behind)[..., None], ahead, behind)

    normal = np.cross(slope(1), slope(0))
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    unit = np.divide(normal, length, out=np.zeros_like(normal), where=np.nan_to_num(length) > 0)
    return np.where((unit * ray).sum(axis=-1, keepdims=True) > 0, -unit, unit)


def _occlusion(depth: F64, hit: Bool, radius: float, supersample: int) -> F64:
    """Factor (H, W) in 0.45..1: darker where the surroundings are nearer than the pixel."""
    import cv2

    height, n = depth.shape
    filled = np.where(hit, depth, 0.0)
    # So wide a Gaussian leaves nothing fine: it is taken of the means of the picture's pixels, in float32.
    pixels = (n // supersample, height // supersample)
    depths, hits = (np.asarray(cv2.resize(image.astype(np.float32), pixels, interpolation=cv2.INTER_AREA),
                               np.float32) for image in (filled, hit))

    def blurred(image: F32, width: float) -> F64:
        wide = cv2.GaussianBlur(image, (0, 0), width, borderType=cv2.BORDER_REFLECT)
        return np.asarray(cv2.resize(wide, (n, height), interpolation=cv2.INTER_LINEAR), np.float64)

    total = np.ones_like(depth)
    for width in (n / 90 / supersample, n / 30 / supersample):
        mean = blurred(depths, width) / np.maximum(blurred(hits, width), 1e-6)
        total -= 2.2 * np.clip(filled - mean, 0, 0.12 * radius) / radius
    return np.clip(total, 0.45, 1.0)
