"""What a lens's parameters come to together: where it puts points of the image, px.

A principal point, tangential distortion and focal lengths make up for each other; what counts is where points end up.
"""

from __future__ import annotations

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry.camera import Camera
from rstrack.calibration.unknowns.parameters import LENS, changed

# Points looked at, and those in a picture: every so many px of a 640 px wide image, in both directions.
_EVERY, _PICTURED = 20, 40
_STEP = 1e-5


def displacement_px(before: Camera, after: Camera, every: int = _EVERY) -> FloatArray:
    """By how much (n, 2) points that `before` sees all over its image lie elsewhere in that of `after`, NaN outside."""
    pixels = _grid(before, every)
    rays = before.backproject(pixels, np.ones(len(pixels)))
    return np.asarray(after.project(rays)[0] - pixels)


def sigma_px(camera: Camera, covariance: FloatArray, every: int = _EVERY) -> FloatArray:
    """σ (n,) of where the lens puts the points of its image, both axes together, by the covariance (9, 9) of LENS."""
    pixels = _grid(camera, every)
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


def lens_map(before: Camera, after: Camera, covariance: FloatArray) -> dict[str, list[list[float]]]:
    """For JSON: points [x, y] of the image of `before`, how far they have moved, [x, y], and σ of that, [σ]; px."""
    moved, sigma = displacement_px(before, after, _PICTURED), sigma_px(after, covariance, _PICTURED)
    known = np.isfinite(moved).all(axis=1) & np.isfinite(sigma)
    parts = {"at_px": _grid(before, _PICTURED), "moved_px": moved, "sigma_px": sigma[:, None]}
    return {name: np.round(values[known], 3).tolist() for name, values in parts.items()}


def _grid(camera: Camera, every: int) -> FloatArray:
    step = max(1, round(every * camera.width / 640))
    return np.asarray(camera.pixel_grid()[::step, ::step].reshape(-1, 2))
