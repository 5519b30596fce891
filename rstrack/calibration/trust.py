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

from rsgen.array_types import FloatArray
from rsgen.device.lens import Lens
from rsgen.device.projection import TO_BASE, gather, move, project_rolling
from rsgen.geometry import se3
from rstrack.alignment.residuals import GeometricInput, evened, plane_distance
from rstrack.calibration.images import lines_of
from rstrack.calibration.optics import Optics, turn, without_error
from rstrack.calibration.pair_terms import FLOOR_DEPTH, GATE_INTENSITY, GATE_SIGMAS, PairTerms
from rstrack.calibration.parameters import Parameters
from rstrack.calibration.stretch import Stretch, View
from rstrack.images.sampling import grid, surface, value_and_slope
from rstrack.keyframes.keyframe import strides


def trust_in(stretch: Stretch, terms: PairTerms, p: Parameters) -> float:
    """Part of the information about the stretch's motion, in the direction of which least of it is real, that is real.

    1 where images are free of noise, 0 or less where there is nothing but noise in some direction. Of the frame in the
    middle against the next one, at the values that were found.
    """
    k = len(stretch.views) // 2
    ref, current = stretch.views[k - 1], stretch.views[k]
    T_base_world = se3.inverse(stretch.spline.pose(ref.depth.mid_time(p)))
    depths = [lines_of(view.depth, stretch.spline, p) for view in (ref, current)]
    to_base, from_base = depths[1].to_base(T_base_world), depths[0].from_base(T_base_world)
    optics = terms.optics(p)
    lenses = [
        Lens(camera, lens.shutter) for camera, lens in zip(terms.cameras(p), (terms.depth, terms.color), strict=True)
    ]
    pairs = [_by_depth(terms, lenses[0], current, ref, to_base, from_base, optics, stretch.sigma[0])]
    if ref.color is not None and current.color is not None:
        lines = [lines_of(color, stretch.spline, p).from_base(T_base_world) for color in (ref.color, current.color)]
        tables = depths[0].to_base(T_base_world), lines[1], lines[0]
        pairs.append(_by_color(terms, lenses, current, ref, tables, optics, stretch.sigma[1]))
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
    terms: PairTerms, lens: Lens, current: View, ref: View, to_base: FloatArray, from_base: FloatArray, optics: Optics,
    sigma: float,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Derivatives (n, 6) of depth's residuals over σ by a twist, with the slopes of either image."""
    e, camera = terms.e, lens.camera
    i, px, py = grid(e, camera.width, camera.height, strides(camera.width, camera.height)[0])
    z, xn, yn, own_x, own_y = (
        _at(e, image, i) for image in (current.z, optics.rays_x, optics.rays_y, current.surface.slope_x,
                                       current.surface.slope_y)
    )  # fmt: skip
    active = z > 0.0
    z = without_error(e, terms.asked, z, xn, yn, optics.error)
    T_base_cam = gather(e.upload(to_base), e.UInt(lens.line_of(e.Int(px), e.Int(py))), TO_BASE, stride=TO_BASE)
    p = move(T_base_cam, (xn * z, yn * z, z))
    table = e.upload(from_base)
    seen = project_rolling(lens, table, p, e.UInt, e.Int)
    own = ref.surface
    rho, active = surface(e, camera, own.inverse_depth, seen.x, seen.y, active & seen.valid)
    if terms.asked.corrects:
        rho = dr.rcp(without_error(e, terms.asked, dr.rcp(rho), seen.at.xn, seen.at.yn, optics.error))
    constants = e.upload(np.append(np.zeros(7), [np.inf, 0.0]))
    images = own.inverse_depth, own.slope_x, own.slope_y, own.roughness
    given = GeometricInput(current.z, optics.rays_x, optics.rays_y, table, *images, table, constants)
    even = evened(z, 1.0 / own.median_depth)
    r, g, _ = plane_distance(e, given, camera, seen, rho, active, even)
    own_z = 1.0 / z - own_x * xn - own_y * yn
    scale = -even / (own_x * own_x + own_y * own_y + own_z * own_z) ** 0.5
    other = turn(T_base_cam, (scale * own_x, scale * own_y, scale * own_z))
    return _twists(p, g, other, active & (abs(r) < GATE_SIGMAS * max(sigma, FLOOR_DEPTH)), sigma)


def _by_color(
    terms: PairTerms, lenses: list[Lens], current: View, ref: View, tables: tuple[FloatArray, ...], optics: Optics,
    sigma: float,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """The same of colour's, of the reference's points; tables: to_base, from_base, the reference's from_base."""
    e, (depth, color) = terms.e, lenses
    camera = depth.camera
    i, px, py = grid(e, camera.width, camera.height, strides(camera.width, camera.height)[0])
    z, xn, yn = (_at(e, image, i) for image in (ref.surface.shown_z, optics.rays_x, optics.rays_y))
    M = gather(e.upload(tables[0]), e.UInt(depth.line_of(e.Int(px), e.Int(py))), TO_BASE, stride=TO_BASE)
    active, found = z > 0.0, []
    z = without_error(e, terms.asked, z, xn, yn, optics.error)
    p = move(M, (xn * z, yn * z, z))
    for view, table in ((current, tables[1]), (ref, tables[2])):
        seen = project_rolling(color, e.upload(table), p, e.UInt, e.Int)
        size = color.camera.width, color.camera.height
        value, dx, dy, active = value_and_slope(e, view.levels[0], *size, seen.x, seen.y, active & seen.valid)
        found.append((value, seen.chain(dx, dy, 0.0)))
    (value, g), (ref_value, other) = found
    return _twists(p, g, other, active & (abs(value - ref_value) < GATE_INTENSITY), sigma)


def _at(e: Any, image: Any, index: Any) -> Any:
    return dr.gather(e.Float, image, index)


def _twists(p: Any, g: Any, other: Any, active: Any, sigma: float) -> tuple[FloatArray, FloatArray]:
    """Derivatives (n, 6) of the active pixels by a twist of the point, for two derivatives by its shift."""
    keep = np.array(active, bool)
    points, a, b = (np.stack([np.array(x, float) for x in v], axis=-1)[keep] for v in (p, g, other))
    finite = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    points, a, b = points[finite], a[finite], b[finite]
    return np.hstack([a, np.cross(points, a)]) / sigma, np.hstack([b, np.cross(points, b)]) / sigma
