"""A keyframe's surface: slopes, bends and edges of inverse depth, in passes over rows on the host.

Each value is made of many neighbours: rows that are read one after the other take a tenth of the time that gathers on
the device do, and a seventh of what whole arrays take, one operation after the other.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rstrack.compiled import compiled
from rstrack.images.sampling import EDGE

# Normals come from a window of so many pixels; the residual itself is not smoothed.
_WINDOW = 5
_EDGE = np.float32(EDGE)

Row = npt.NDArray[np.float32]
Image = npt.NDArray[np.float32]


@compiled
def _steps(before: Row, after: Row, step: Row, counts: Row) -> None:
    """What inverse depth changes by from pixels to their neighbours, and 1 where it does so on one surface, else 0."""
    for x in range(step.size):
        change = after[x] - before[x]
        is_on = abs(change) < _EDGE * after[x]  # nor is there a hole
        step[x] = change if is_on else np.float32(0.0)
        counts[x] = np.float32(1.0) if is_on else np.float32(0.0)


@compiled
def _two(a: Row, b: Row, total: Row) -> None:
    for x in range(total.size):
        total[x] = a[x] + b[x]


@compiled
def _five(a: Row, b: Row, c: Row, d: Row, e: Row, total: Row) -> None:
    for x in range(total.size):
        total[x] = a[x] + b[x] + c[x] + d[x] + e[x]


@compiled
def _over_window(row: Row, total: Row) -> None:
    """Sums over the window's pixels of a row; it has two more at each end, which become mirror images."""
    row[0], row[1], row[-1], row[-2] = row[4], row[3], row[-5], row[-4]
    _five(row[:-4], row[1:-3], row[2:-2], row[3:-1], row[4:], total)


@compiled
def _mean(total: Row, count: Row, focal: np.float32, mean: Row) -> None:
    for x in range(total.size):
        mean[x] = focal * total[x] / (count[x] if count[x] > 1.0 else np.float32(1.0))


@compiled
def _rows(middle: int, height: int) -> tuple[int, int, int, int, int]:
    """Where the window's rows, mirrored at the image's border, are among the last five."""
    last = height - 1
    up, upper = abs(middle - 1), abs(middle - 2)
    down, lower = last - abs(last - middle - 1), last - abs(last - middle - 2)
    return upper % 5, up % 5, middle % 5, down % 5, lower % 5


@compiled
def surface_slopes(rho: Image, fx: float, fy: float) -> tuple[Image, Image]:
    """Derivatives of inverse depth (h, w) by normalised coordinates, averaged over a window without crossing edges.

    Each of its pixels counts with the steps to and from it; beyond the image's border they are mirrored.
    """
    height, width = rho.shape
    slope_x, slope_y = np.empty_like(rho), np.empty_like(rho)
    # Of steps (0) and of their number (1): of a row; to the rows above and below the last one; a row with its ends
    # mirrored; sums; and those of the last five rows.
    across, sums = np.zeros((2, width + 1), np.float32), np.zeros((2, width), np.float32)
    above, below = np.zeros((2, width), np.float32), np.zeros((2, width), np.float32)
    mirrored = np.zeros((2, width + 4), np.float32)
    of_x, of_y = np.zeros((2, 5, width), np.float32), np.zeros((2, 5, width), np.float32)
    for y in range(height + 3):
        if y < height:
            _steps(rho[y, :-1], rho[y, 1:], across[0, 1:-1], across[1, 1:-1])
            for k in range(2):
                _two(across[k, :-1], across[k, 1:], mirrored[k, 2:-2])
                _over_window(mirrored[k], of_x[k, y % 5])
        if 2 <= y < height + 2:
            a, b, c, d, e = _rows(y - 2, height)
            for k in range(2):
                _five(of_x[k, a], of_x[k, b], of_x[k, c], of_x[k, d], of_x[k, e], sums[k])
            _mean(sums[0], sums[1], np.float32(fx), slope_x[y - 2])
        if 1 <= y <= height:
            above[:], below[:] = below, 0.0
            if y < height:
                _steps(rho[y - 1], rho[y], below[0], below[1])
            for k in range(2):
                _two(above[k], below[k], of_y[k, (y - 1) % 5])
        if y >= 3:
            a, b, c, d, e = _rows(y - 3, height)
            for k in range(2):
                _five(of_y[k, a], of_y[k, b], of_y[k, c], of_y[k, d], of_y[k, e], mirrored[k, 2:-2])
                _over_window(mirrored[k], sums[k])
            _mean(sums[0], sums[1], np.float32(fy), slope_y[y - 3])
    return slope_x, slope_y


@compiled
def surface_bends(slope_x: Image, slope_y: Image, fx: float, fy: float) -> tuple[Image, Image]:
    """Size of the second differences (h, w) of inverse depth from pixel to pixel, along rows and columns."""
    height, width = slope_x.shape
    bend_x, bend_y = np.zeros_like(slope_x), np.zeros_like(slope_y)
    for y in range(height):
        for x in range(1, width - 1):
            bend_x[y, x] = abs(slope_x[y, x + 1] - slope_x[y, x - 1]) / np.float32(2.0 * fx)
    for y in range(1, height - 1):
        for x in range(width):
            bend_y[y, x] = abs(slope_y[y + 1, x] - slope_y[y - 1, x]) / np.float32(2.0 * fy)
    return bend_x, bend_y


@compiled
def surface_roughness(rho: Image, slope_x: Image, slope_y: Image, fx: float, fy: float) -> Image:
    """Error (h, w) in m that bilinear interpolation of inverse depth may have: an eighth of its second difference.

    Where walls meet, the chord cuts the corner, always towards the camera: small, but it adds up from keyframe to
    keyframe (0.02 mm each). Taken from the smoothed slopes, so that noise does not pass for corners; a corner's
    second difference is spread over the window there.
    """
    bend_x, bend_y = surface_bends(slope_x, slope_y, fx, fy)
    height, width = rho.shape
    for y in range(height):
        for x in range(width):
            z = np.float32(1.0) / rho[y, x] if rho[y, x] > 0.0 else np.float32(0.0)
            most = bend_x[y, x] if bend_x[y, x] > bend_y[y, x] else bend_y[y, x]
            bend_x[y, x] = np.float32(_WINDOW / 8.0) * z * z * most
    return bend_x


@compiled
def on_one_surface(rho: Image) -> npt.NDArray[np.bool_]:
    """Pixels (h, w) with depth whose neighbours right, left, above and below do not lie across an edge."""
    height, width = rho.shape
    valid = np.empty((height, width), np.bool_)
    for y in range(height):
        above, below = rho[max(y - 1, 0)], rho[min(y + 1, height - 1)]
        for x in range(width):
            own = rho[y, x]
            left, right = rho[y, max(x - 1, 0)], rho[y, min(x + 1, width - 1)]
            most = max(max(left, right), max(above[x], below[x]))
            least = min(min(left, right), min(above[x], below[x]))
            # The larger of two may be larger by a part of itself.
            far = (own - least > _EDGE * own) | (most - own > _EDGE * most)
            valid[y, x] = (own > 0.0) & ~far
    return valid
