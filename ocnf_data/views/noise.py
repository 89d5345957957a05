"""Depth noise that grows with the distance (Park et al. 2011, as in section 4.1 of the paper).

The noise of a pixel is a pure function of (seed, item key, view): it does not depend on the order of the
work, on other items, on sigma, or on which other views are in the subset. So variants of one item share
their noise, and an input with more views or another sigma differs from this one in nothing else.
"""

from __future__ import annotations

from enum import StrEnum

import numpy as np

from ocnf_data.arrays import F32
from ocnf_data.errors import OcnfError
from ocnf_data.views.chance import keyed_random


class NoiseModel(StrEnum):
    """How a depth camera errs."""

    PARK = "park"
    """Every pixel by itself, in proportion to its depth (`views.noise`)."""
    KINECT = "kinect"
    """The noise of a structured-light sensor (`views.sensor`)."""


def view_noise(seed: int, key: str, view: int, size: tuple[int, int]) -> F32:
    """Standard normal noise of one view: Philox4x64 keyed by 128 bits of the SHA-256 of the three.

    Args:
        seed: the manifest's seed.
        key: the item's key.
        view: the view's index in the rig, not in the subset.
        size: (H, W) in pixels.

    Returns:
        (H, W) float32.
    """
    return keyed_random(int(seed), key, int(view)).standard_normal(size, dtype=np.float32)


def add_noise(depth: F32, sigma: float, noise: F32) -> F32:
    """`depth * (1 + sigma * noise)`; free rays (inf) and pixels without a measurement (0) stay what they are.

    A measured pixel stays measured: where the noise would take it to 0 or below (noise < -1 / sigma, one
    pixel in 3.5 million at sigma = 0.2), it becomes the smallest normal float32. 0 would say "not measured",
    and dropping exactly the largest errors would make the noise less than it is. For the same reason it
    stays finite.

    Args:
        depth: (..., H, W) float32 metres.
        sigma: standard deviation as a fraction of the depth, >= 0.
        noise: standard normal, of the same shape.

    Returns:
        (..., H, W) float32, a new array.

    Raises:
        OcnfError: `sigma` is negative or not finite, or `noise` has another shape.
    """
    if not (np.isfinite(sigma) and sigma >= 0):
        raise OcnfError("sigma is not a noise level", where="add_noise", field="sigma", found=sigma,
                        expected="a fraction of the depth, >= 0")
    if depth.shape != noise.shape:
        raise OcnfError("the noise does not fit the depth", where="add_noise", field="noise",
                        found=noise.shape, expected=depth.shape)
    limits = np.finfo(np.float32)
    noisy = np.array(depth, dtype=np.float32)
    hit = np.isfinite(noisy) & (noisy > 0)
    factor = 1 + np.float32(sigma) * noise[hit]
    with np.errstate(over="ignore"):
        noisy[hit] = np.clip(noisy[hit] * factor, limits.tiny, limits.max)
    return noisy
