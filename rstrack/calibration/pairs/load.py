"""Stretches of a recording on the device, with the spline of a track of it to begin with."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rsgen.array_types import BoolArray, FloatArray
from rsgen.device.arrays import Engine
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.calibration.pairs.images import Taken, pair_lens, span
from rstrack.calibration.pairs.optics import Asked
from rstrack.calibration.pairs.stretch import Stretch, View
from rstrack.calibration.pairs.surfaces import averaged, intensity_bound, surface_of
from rstrack.calibration.pairs.terms import PairTerms
from rstrack.calibration.unknowns.parameters import COLOR_LENS, COUNT, DEPTH, DEPTH_ERROR, DEPTH_LENS, LENS, Parameters
from rstrack.data.dataset import Dataset
from rstrack.data.rig import NO_DEPTH_ERROR
from rstrack.images.line_poses import Exposure
from rstrack.images.pyramid import color_image, intensity
from rstrack.options import Options

# Seconds before the first and after the last line for which a stretch has spline: times move while they are estimated.
_MARGIN_S = 0.08
# What the colour camera may be further away than the file says, m.
_BASELINE_M = 0.01
# Rounds of correction of a spline that is to pass through poses.
_ROUNDS = 6


def pair_terms(e: Engine, dataset: Dataset, free: BoolArray | None = None) -> PairTerms:
    """The kernels of a dataset's rig, with columns for those lens and depth unknowns (31,) that are free."""
    rig = dataset.rig
    depth, color = pair_lens(rig.depth_camera, rig.depth_shutter), pair_lens(rig.color_camera, rig.color_shutter)
    return PairTerms(e, depth, color, _asked(dataset, np.zeros(COUNT, bool) if free is None else free))


def _asked(dataset: Dataset, free: BoolArray) -> Asked:
    one = dataset.rig.is_registered
    color = tuple(name for name, asked in zip(LENS, free[COLOR_LENS], strict=True) if asked)
    depth = color if one else tuple(name for name, asked in zip(LENS, free[DEPTH_LENS], strict=True) if asked)
    depth += tuple(name for name, asked in zip(DEPTH, free[DEPTH_ERROR], strict=True) if asked)
    return Asked(depth, color, bool(free[DEPTH_ERROR].any()) or dataset.depth_error != NO_DEPTH_ERROR, one)


def load_stretch(
    terms: PairTerms, dataset: Dataset, frames: Sequence[int], track: Spline, p: Parameters, options: Options
) -> Stretch:
    """Frames of a dataset, with a spline like that of the track but with knots as the options want them.

    Raises UserError: an image that cannot be read.
    """
    views = [_view(terms, dataset, k, options.max_depth) for k in frames]
    begin, end = span([taken for v in views for taken in (v.depth, v.color) if taken is not None], p)
    knot_s = options.knots_s()
    t0 = begin - _MARGIN_S - options.knot_phase * knot_s
    count = int(np.ceil((end + _MARGIN_S - t0) / knot_s)) + 3
    return Stretch(views, like(track, t0, knot_s, count))


def like(track: Spline, t0: float, dt: float, count: int) -> Spline:
    """A spline of `count` control points through the poses of another, which goes on with constant velocity."""
    knots = t0 + (np.arange(count) - 1) * dt
    inside = np.clip(knots, track.t_begin, track.t_end)
    poses, velocity = track.pose_and_velocity(inside)
    return through(poses @ se3.exp((knots - inside)[:, None] * velocity), t0, dt)


def through(poses: FloatArray, t0: float, dt: float) -> Spline:
    """The spline that passes at its knots through poses (n, 4, 4), but for the first and the last.

    Cubic B-splines blur a little what their control points are laid through: a few rounds of correction.
    """
    wanted = se3.orthonormalise(poses)
    points = wanted
    knots = t0 + (np.arange(len(poses))[1:-1] - 1) * dt
    for _ in range(_ROUNDS):
        off = se3.log(wanted[1:-1] @ se3.inverse(Spline(points, t0, dt).pose(knots)))
        points = np.concatenate([wanted[:1], se3.orthonormalise(se3.exp(off) @ points[1:-1]), wanted[-1:]])
    return Spline(points, t0, dt)


def _view(terms: PairTerms, dataset: Dataset, k: int, max_depth: float) -> View:
    e, rig = terms.e, dataset.rig
    z = dataset.images.depth(k)
    rho = averaged(np.divide(np.float32(1.0), z, out=np.zeros_like(z), where=(z > 0.0) & (z < max_depth)))
    z = np.divide(np.float32(1.0), rho, out=np.zeros_like(z), where=rho > 0.0)
    depth = Taken(terms.depth, float(dataset.stamps[k]), rig.depth_shutter.exposure_s, True)
    camera, baseline = rig.depth_camera, _BASELINE_M + float(np.linalg.norm(rig.T_color_depth[:3, 3]))
    view = View(depth, e.upload(z), surface_of(e, rho, camera.fx, camera.fy, baseline))
    if dataset.groups[k]:
        i = dataset.groups[k][0]
        color = dataset.images.color(i)
        view.color = Taken(terms.color, float(dataset.color_stamps[i]), rig.color_shutter.exposure_s, False)
        view.levels = color_image(e, Exposure(terms.color, 0.0, np.eye(4)), color).levels
        view.bound = intensity_bound(intensity(color), rig.color_camera.fx, view.surface.median_depth)
    return view
