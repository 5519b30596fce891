"""How much of what seems to be known of a motion is no noise.

Slopes of noisy images pass for shape and print: on a bare wall all that seems to be known of the motion along it is
noise, however much that is, and clocks that are calibrated with such a motion are made up. Noise differs from image to
image, what is seen does not; so the derivatives of a pixel's residual are taken from either image of a pair: products
of the two hold what both see, squares of one hold its noise too.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import scipy.linalg

from rsgen.array_types import FloatArray, IntArray
from rstrack.alignment.block_sums import Scaling, every
from rstrack.alignment.weights import FLOOR_DEPTH, GATE_INTENSITY, GATE_SIGMAS
from rstrack.calibration.pairs.images import ACROSS, LinePoses, lines_of
from rstrack.calibration.pairs.kernels import PairGrid, PairInput, color_residual, depth_residual, in_atlas, pair_grid
from rstrack.calibration.pairs.optics import turn
from rstrack.calibration.pairs.terms import PairTerms
from rstrack.calibration.pairs.window import RecordingWindow
from rstrack.calibration.parameters import Parameters
from rstrack.images.sampling import PyramidLevel, Raster


def trust_in(window: RecordingWindow, terms: PairTerms, p: Parameters) -> float:
    """Part of the information about the window's motion, in the direction of which least of it is real, that is real.

    1 where images are free of noise, 0 or less where there is nothing but noise in some direction. Of the frame in the
    middle against the next one, at the values that were found.
    """
    k = len(window.views) // 2
    pair = np.array([[k, k - 1]])
    T_base_world, lever = window.base(p)
    depths = lines_of([view.depth for view in window.views], window.spline, p, T_base_world)
    pairs = [_by_depth(terms, window, pair, depths, p, lever)]
    if all(window.views[i].has_color for i in pair[0]):
        colors = lines_of([view.color for view in window.views], window.spline, p, T_base_world)
        pairs.append(_by_color(terms, window, pair, (depths, colors), p, lever))
    common, single = np.zeros((6, 6)), np.zeros((6, 6))
    for a, b in pairs:
        a, b = (J / np.repeat([1.0, lever], 3) for J in (a, b))
        cross = a.T @ b
        common += 0.5 * (cross + cross.T)
        single += 0.5 * (a.T @ a + b.T @ b)
    single += 1e-9 * np.trace(single) * np.eye(6)
    return float(scipy.linalg.eigvalsh(common, single)[0])


def _by_depth(
    terms: PairTerms, window: RecordingWindow, pair: IntArray, lines: LinePoses, p: Parameters, lever: float
) -> tuple[FloatArray, FloatArray]:
    """Derivatives (n, 6) of depth's residuals over σ by a twist, with the slopes of either image."""
    e, camera, sigma = terms.e, terms.depth.camera, window.sigma[0]
    given = terms.depth_input(window.images, pair, lines, terms.optics(p), np.inf, Scaling(lever, 1.0, 1))
    raster, grid = _pair_grid(terms, given)
    of = depth_residual(e, terms.depth, raster, grid, terms.asked, given)
    at, (x, y) = of.at, in_atlas(grid.current, camera.width, camera.height, grid.x, grid.y)
    own = y * (ACROSS * camera.width) + x
    own_x, own_y = (dr.gather(e.Float, slope, own) for slope in (given.slope_x, given.slope_y))
    own_z = 1.0 / at.z - own_x * at.xn - own_y * at.yn
    scale = -of.even / (own_x * own_x + own_y * own_y + own_z * own_z) ** 0.5
    other = turn(at.T_base_cam, (scale * own_x, scale * own_y, scale * own_z))
    return _twists(at.p, of.g, other, of.active & (abs(of.r) < GATE_SIGMAS * max(sigma, FLOOR_DEPTH)), sigma)


def _by_color(
    terms: PairTerms, window: RecordingWindow, pair: IntArray, lines: tuple[LinePoses, LinePoses], p: Parameters,
    lever: float,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """The same of colour's, of the reference's points; lines: of depth images and of colour images."""
    e, optics, sigma = terms.e, terms.optics(p), window.sigma[1]
    same, scaling = np.zeros_like(window.brightness), Scaling(lever, 1.0, 1)
    given = terms.color_input(window.images, 0, pair, lines, optics, same, sigma, scaling)
    (raster, grid), level = _pair_grid(terms, given), PyramidLevel.of(terms.color.camera, 0)
    of = color_residual(e, terms.color, terms.depth, raster, grid, level, terms.asked, given)
    return _twists(of.p, of.own, of.other, of.active & (abs(of.r) < GATE_INTENSITY), sigma)


def _pair_grid(terms: PairTerms, given: PairInput) -> tuple[Raster, PairGrid]:
    camera, stride = terms.depth.camera, terms.stride
    raster, pixels = Raster.of(camera, stride), every(terms.e, camera.width, camera.height, stride)
    return raster, pair_grid(terms.e, terms.depth, raster, pixels, given)


def _twists(p: Any, g: Any, other: Any, active: Any, sigma: float) -> tuple[FloatArray, FloatArray]:
    """Derivatives (n, 6) of the active pixels by a twist of the point, for two derivatives by its shift."""
    keep = np.array(active, bool)
    points, a, b = (np.stack([np.array(x, float) for x in v], axis=-1)[keep] for v in (p, g, other))
    finite = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    points, a, b = points[finite], a[finite], b[finite]
    return np.hstack([a, np.cross(points, a)]) / sigma, np.hstack([b, np.cross(points, b)]) / sigma
