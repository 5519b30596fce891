"""What a lens's parameters come to together: where it puts points of the image, px.

A principal point, tangential distortion and focal lengths make up for each other; what counts is where points end up.
"""

from __future__ import annotations

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry.camera import Camera
from rstrack.calibration.unknowns.parameters import LENS, changed

# Points looked at: every so many px of a 640 px wide image, in both directions.
_EVERY = 20
_STEP = 1e-5


def displacement_px(before: Camera, after: Camera) -> FloatArray:
    """By how much (n, 2) points that `before` sees all over its image lie elsewhere in that of `after`, NaN outside."""
    pixels = _grid(before)
    rays = before.backproject(pixels, np.ones(len(pixels)))
    return np.asarray(after.project(rays)[0] - pixels)


def sigma_px(camera: Camera, covariance: FloatArray) -> FloatArray:
    """σ (n,) of where the lens puts the points of its image, both axes together, by the covariance (8, 8) of LENS."""
    pixels = _grid(camera)
    rays = camera.backproject(pixels, np.ones(len(pixels)))
    slopes = []
    for i in range(len(LENS)):
        step = np.zeros(len(LENS))
        step[i] = _STEP
        ends = [changed(camera, sign * step).project(rays)[0] for sign in (1.0, -1.0)]
        slopes.append((ends[0] - ends[1]) / (2.0 * _STEP))
    J = np.stack(slopes, axis=-1)
    return np.asarray(np.sqrt(np.einsum("nai,ij,naj->n", J, covariance, J)))


def rms(pixels: FloatArray) -> float:
    """Root mean square length of displacements (n, 2) or of lengths (n,), over those that there are."""
    squares = np.square(pixels) if pixels.ndim == 1 else np.square(pixels).sum(axis=1)
    return float(np.sqrt(np.nanmean(squares)))


def _grid(camera: Camera) -> FloatArray:
    every = max(1, round(_EVERY * camera.width / 640))
    return np.asarray(camera.pixel_grid()[::every, ::every].reshape(-1, 2))
