"""What a rectified image of inverse depth shows of its surfaces: slopes, how far they bend, and where they end.

Loops over pixels on the host, compiled: a keyframe takes NumPy some forty passes over its image.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from rstrack.compiled import compiled
from rstrack.images.sampling import EDGE

FloatImage = npt.NDArray[np.float32]

# Normals come from a window of this many pixels; the residual itself is not smoothed.
_NORMAL_WINDOW = 5


def surface_slopes(rho: FloatImage, fx: float, fy: float) -> tuple[FloatImage, FloatImage]:
    """Derivatives of inverse depth (h, w) by normalised coordinates, averaged over a window without crossing edges."""
    steps = _steps(np.ascontiguousarray(rho), np.float32(EDGE))
    means = (np.asarray(cv2.boxFilter(step, -1, (_NORMAL_WINDOW, _NORMAL_WINDOW))) for step in steps)
    step_x, count_x, step_y, count_y = means
    return _mean(step_x, count_x, np.float32(fx)), _mean(step_y, count_y, np.float32(fy))


@compiled
def _steps(rho: Any, edge: Any) -> Any:
    """Sums of the steps to the two neighbours on a pixel's own surface, and their numbers, along rows and columns."""
    height, width = rho.shape
    step_x, count_x = np.empty_like(rho), np.empty_like(rho)
    step_y, count_y = np.empty_like(rho), np.empty_like(rho)
    # With nothing about it, so that no border is a case of its own.
    framed = np.zeros((height + 2, width + 2), rho.dtype)
    framed[1:-1, 1:-1] = rho
    for y in range(height):
        above, here, below = framed[y], framed[y + 1], framed[y + 2]
        _to_neighbours(step_x[y], count_x[y], here[:-2], here[1:-1], here[2:], edge)
        _to_neighbours(step_y[y], count_y[y], above[1:-1], here[1:-1], below[1:-1], edge)
    return step_x, count_x, step_y, count_y


@compiled
def _to_neighbours(step: Any, count: Any, before: Any, here: Any, after: Any, edge: Any) -> None:
    zero, one = np.float32(0.0), np.float32(1.0)
    for i in range(len(here)):
        a, b, c = before[i], here[i], after[i]
        # Not short-circuited, so that the loop is vectorised.
        first = (a > zero) & (b > zero) & (abs(b - a) < edge * b)
        second = (b > zero) & (c > zero) & (abs(c - b) < edge * c)
        step[i] = (b - a if first else zero) + (c - b if second else zero)
        count[i] = (one if first else zero) + (one if second else zero)


@compiled
def _mean(step: Any, share: Any, focal: Any) -> Any:
    out, least = np.empty_like(step), np.float32(1e-3)
    for y in range(step.shape[0]):
        for x in range(step.shape[1]):
            out[y, x] = focal * step[y, x] / max(share[y, x], least)
    return out


def surface_bends(slope_x: FloatImage, slope_y: FloatImage, fx: float, fy: float) -> tuple[FloatImage, FloatImage]:
    """Size of the second differences (h, w) of inverse depth from pixel to pixel, along rows and columns."""
    bend_x, bend_y = np.zeros_like(slope_x), np.zeros_like(slope_y)
    bend_x[:, 1:-1] = np.abs(slope_x[:, 2:] - slope_x[:, :-2]) / np.float32(2.0 * fx)
    bend_y[1:-1] = np.abs(slope_y[2:] - slope_y[:-2]) / np.float32(2.0 * fy)
    return bend_x, bend_y


def surface_roughness(rho: FloatImage, slope_x: FloatImage, slope_y: FloatImage, fx: float, fy: float) -> FloatImage:
    """Error (h, w) in m that bilinear interpolation of inverse depth may have: an eighth of its second difference.

    Where walls meet, the chord cuts the corner, always towards the camera: small, but it adds up from keyframe to
    keyframe (0.02 mm each). Taken from the smoothed slopes, so that noise does not pass for corners; a corner's
    second difference is spread over the window there.
    """
    part, twice = np.float32(_NORMAL_WINDOW / 8.0), (np.float32(2.0 * fx), np.float32(2.0 * fy))
    rough: FloatImage = _roughness(rho, slope_x, slope_y, part, *twice)
    return rough


@compiled
def _roughness(rho: Any, slope_x: Any, slope_y: Any, part: Any, twice_fx: Any, twice_fy: Any) -> Any:
    height, width = rho.shape
    zero, one = np.float32(0.0), np.float32(1.0)
    out = np.zeros_like(rho)
    for y in range(height):
        for x in range(width):
            z = one / rho[y, x] if rho[y, x] > zero else zero
            bend_x = abs(slope_x[y, x + 1] - slope_x[y, x - 1]) / twice_fx if 0 < x < width - 1 else zero
            bend_y = abs(slope_y[y + 1, x] - slope_y[y - 1, x]) / twice_fy if 0 < y < height - 1 else zero
            out[y, x] = part * z * z * max(bend_x, bend_y)
    return out


def on_one_surface(rho: FloatImage) -> npt.NDArray[np.bool_]:
    """Pixels (h, w) with depth whose neighbours right, left, above and below do not lie across an edge."""
    valid: npt.NDArray[np.bool_] = _on_one_surface(rho, np.float32(EDGE))
    return valid


@compiled
def _on_one_surface(rho: Any, edge: Any) -> Any:
    height, width = rho.shape
    valid = np.empty(rho.shape, np.bool_)
    for y in range(height):
        for x in range(width):
            valid[y, x] = rho[y, x] > np.float32(0.0)
    for y in range(height):
        for x in range(width):
            a = rho[y, x]
            if x + 1 < width and abs(a - rho[y, x + 1]) > edge * max(a, rho[y, x + 1]):
                valid[y, x] = valid[y, x + 1] = False
            if y + 1 < height and abs(a - rho[y + 1, x]) > edge * max(a, rho[y + 1, x]):
                valid[y, x] = valid[y + 1, x] = False
    return valid
