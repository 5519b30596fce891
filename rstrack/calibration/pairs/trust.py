"""How much of what seems to be known of a motion is no noise.

Slopes of noisy images pass for shape and print: on a bare wall all that seems to be known of the motion along it is
noise, however much that is, and clocks that are calibrated with such a motion are made up. Noise differs from image to
image, what is seen does not; so the derivatives of a pixel's residual are taken from either image of a pair: products
of the two hold what both see, squares of one hold its noise too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import numpy as np
import scipy.linalg

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rstrack.alignment.block_sums import PixelGrid, Scaling, every
from rstrack.alignment.brightness import SAME
from rstrack.alignment.weights import FLOOR_DEPTH, GATE_INTENSITY, GATE_SIGMAS
from rstrack.calibration.pairs.images import DepthSurface, LinePoses, lines_of
from rstrack.calibration.pairs.kernels import color_residual, depth_residual
from rstrack.calibration.pairs.optics import turn
from rstrack.calibration.pairs.terms import PairTerms
from rstrack.calibration.pairs.window import RecordingWindow, WindowFrame
from rstrack.calibration.parameters import Parameters


def trust_in(window: RecordingWindow, terms: PairTerms, p: Parameters) -> float:
    """Part of the information about the window's motion, in the direction of which least of it is real, that is real.

    1 where images are free of noise, 0 or less where there is nothing but noise in some direction. Of the frame in the
    middle against the next one, at the values that were found.
    """
    k = len(window.views) // 2
    ref, current = window.views[k - 1], window.views[k]
    T_base_world = se3.inverse(window.spline.pose(ref.depth.mid_time(p)))
    depths = lines_of([view.depth for view in (ref, current)], window.spline, p)
    pairs = [_by_depth(terms, current, ref, (depths[1], depths[0]), T_base_world, p, window.sigma[0])]
    if ref.color is not None and current.color is not None:
        lines = depths[0], *lines_of([current.color, ref.color], window.spline, p)
        pairs.append(_by_color(terms, current, ref, lines, T_base_world, p, window.sigma[1]))
    lever = ref.surface.median_depth
    common, single = np.zeros((6, 6)), np.zeros((6, 6))
    for a, b in pairs:
        a, b = (J / np.repeat([1.0, lever], 3) for J in (a, b))
        cross = a.T @ b
        common += 0.5 * (cross + cross.T)
        single += 0.5 * (a.T @ a + b.T @ b)
    single += 1e-9 * np.trace(single) * np.eye(6)
    return float(scipy.linalg.eigvalsh(common, single)[0])


def _by_depth(
    terms: PairTerms, current: WindowFrame, ref: WindowFrame, lines: Sequence[LinePoses], T_base_world: FloatArray,
    p: Parameters, sigma: float,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Derivatives (n, 6) of depth's residuals over σ by a twist, with the slopes of either image.

    lines: of the current image and of the reference.
    """
    e, surface = terms.e, ref.surface
    tables = lines[0].to_base(T_base_world), lines[1].from_base(T_base_world)
    given = terms.depth_input(current.z, surface, *tables, terms.optics(p), np.inf, _scaling(surface))
    of = depth_residual(e, terms.depth, _pixels(terms), terms.asked, given)
    at, own = of.at, (current.surface.slope_x, current.surface.slope_y)
    own_x, own_y = (dr.gather(e.Float, slope, at.pixel) for slope in own)
    own_z = 1.0 / at.z - own_x * at.xn - own_y * at.yn
    scale = -of.even / (own_x * own_x + own_y * own_y + own_z * own_z) ** 0.5
    other = turn(at.T_base_cam, (scale * own_x, scale * own_y, scale * own_z))
    return _twists(at.p, of.g, other, of.active & (abs(of.r) < GATE_SIGMAS * max(sigma, FLOOR_DEPTH)), sigma)


def _by_color(
    terms: PairTerms, current: WindowFrame, ref: WindowFrame, lines: Sequence[LinePoses], T_base_world: FloatArray,
    p: Parameters, sigma: float,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """The same of colour's, of the reference's points; lines: of its depth image, of the current colour image, of its
    own."""
    tables = lines[0].to_base(T_base_world), lines[1].from_base(T_base_world), lines[2].from_base(T_base_world)
    images, scaling = (current.levels[0], ref.levels[0]), _scaling(ref.surface)
    given = terms.color_input(images, ref.surface, tables, terms.optics(p), SAME, sigma, scaling)
    of = color_residual(terms.e, terms.color, terms.depth, _pixels(terms), 0, terms.asked, given)
    return _twists(of.p, of.own, of.other, of.active & (abs(of.r) < GATE_INTENSITY), sigma)


def _pixels(terms: PairTerms) -> PixelGrid:
    camera = terms.depth.camera
    return every(terms.e, camera.width, camera.height, terms.stride)


def _scaling(surface: DepthSurface) -> Scaling:
    """Of sums that are not made."""
    return Scaling(surface.median_depth, 1.0, 1)


def _twists(p: Any, g: Any, other: Any, active: Any, sigma: float) -> tuple[FloatArray, FloatArray]:
    """Derivatives (n, 6) of the active pixels by a twist of the point, for two derivatives by its shift."""
    keep = np.array(active, bool)
    points, a, b = (np.stack([np.array(x, float) for x in v], axis=-1)[keep] for v in (p, g, other))
    finite = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    points, a, b = points[finite], a[finite], b[finite]
    return np.hstack([a, np.cross(points, a)]) / sigma, np.hstack([b, np.cross(points, b)]) / sigma
