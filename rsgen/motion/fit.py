"""Least-squares fit of a cumulative cubic B-spline on SE(3) to stamped poses: banded Gauss-Newton.

What is minimised, over the control points, with r_k = log(T_k⁻¹ T(t_k)) = [ρ; φ] and a_i = (Ω_{i+1} − Ω_i) / dt², the
body acceleration (m/s², rad/s²) at knot i to first order:

    Σ_k huber(|[ρ_k; λ φ_k]|) + Σ_i s_i |a_i|²_λ        λ = metres_per_radian

``s_i`` holds the user's smoothing (zero by default) and the prior that holds what the data leave loose (see `_prior`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import LinAlgError, solveh_banded
from scipy.sparse import diags_array

from rsgen.array_types import BoolArray, FloatArray, IntArray
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.sequence.trajectory import MIN_POSES, Trajectory

Robust = Literal["huber", "none"]

MAX_CONTROL_POINTS = 1_000_000
HUBER_FACTOR = 8.0
"""Poses farther from the spline than this many median residuals count with constant force only."""

_ROWS = 24  # stored diagonals of the normal equations: four control points of six
_MAX_ITERATIONS = 200
_STEP_TOLERANCE = 1e-8  # m and rad; a thousand times below the sixth decimal of trajectory files
_SCALE_ITERATIONS = 6  # afterwards Huber's threshold and the prior stay put, so that the iteration can end
_WEAK_PRIOR = 1e-10  # per control point, against about 0.5 from the data: decides only what data do not
_LOOSE_VARIANCE = 400.0  # acceleration noise 20 times the noise of the poses / dt²
_HOLD = 10.0  # with 1 the first knot of kt1, which starts with a jump, exceeds all accelerations inside
_RADIAL = 0.95  # 1 is Newton's method; a little less keeps the equations definite


@dataclass(frozen=True)
class FitResult:
    """A fitted spline and what it leaves of the n poses it was fitted to.

    residual_trans_m (n,): distance of the spline's position from the measured one, metres.
    residual_rot_rad (n,): angle between the orientations, radians.
    weights (n,): 1, or less where Huber's kernel limits a pose's influence. iterations: Gauss-Newton steps taken.
    """

    spline: Spline
    residual_trans_m: FloatArray
    residual_rot_rad: FloatArray
    weights: FloatArray
    iterations: int

    @property
    def rms_trans_m(self) -> float:
        """Root mean square of the position residuals, metres."""
        return float(np.sqrt(np.mean(self.residual_trans_m**2)))

    @property
    def rms_rot_rad(self) -> float:
        """Root mean square of the rotation residuals, radians."""
        return float(np.sqrt(np.mean(self.residual_rot_rad**2)))


def fit_spline(
    trajectory: Trajectory,
    dt: float = 0.05,
    smoothing: float = 0.0,
    pad_begin_s: float = 0.0,
    pad_end_s: float = 0.0,
    robust: Robust = "huber",
    metres_per_radian: float = 1.0,
) -> FitResult:
    """Fit a spline with knots at integer multiples of dt that covers the stamps, and the padding before and after.

    dt: knot spacing, s. Below about 1.2 samples a knot the spline interpolates its poses, noise included.
    smoothing: weight w in s⁴ of the acceleration in  T/n Σ|r|² + w ∫|a|² dt: motion at angular frequency ω is damped by
      1 / (1 + w ω⁴), half of it at ω = w^(−1/4). 1e-5 halves motion at 2.8 Hz, 1e-3 at 0.9 Hz.
    pad_begin_s, pad_end_s: seconds of spline wanted before the first and after the last stamp; the motion goes on there
      at nearly constant body velocity.
    robust: "huber" (see below) or "none", plain least squares.
    metres_per_radian: how many metres of position error weigh as much as one radian. The default suits hand-held
      cameras, whose trackers err by about 1 mm and 1 mrad.

    Jumps. ICL-NUIM's kt0 has steps of 28 + 61 and 45 mm between frames. They are no outliers (the camera stays on the
    other side), and no spline with 50 ms knots can follow them. Measured on kt0: plain least squares misses both sides
    by 9.4 mm and rings, 3.5 to 4.3 mm at the next frames; Huber at 8 medians misses by 13 mm and is back to noise
    (1.2 mm) at the next, for an RMS of 0.78 instead of 0.74 mm; the redescending Cauchy gives up whole frames, 23 mm
    off, for an RMS of 1.0 mm. The peak acceleration stays about 60 m/s² with either of the first two: it is in the
    data. So Huber: a jump, or one false pose, stays local, and all else is least squares (the RMS of kt1..3 changes
    by under 1 %).

    Raises UserError on unusable parameters, unordered stamps, or when the iteration fails.
    """
    _check(trajectory, dt, smoothing, pad_begin_s, pad_end_s, robust, metres_per_radian)
    stamps = trajectory.stamps
    span_s = stamps[-1] + pad_end_s - stamps[0] + pad_begin_s
    if not span_s <= MAX_CONTROL_POINTS * dt:
        raise UserError(f"a spline of {span_s:g} s is too long for a knot spacing of {dt:g} s: raise the knot spacing")
    first = math.floor((stamps[0] - pad_begin_s) / dt + 5e-10)  # the slack that Spline allows, halved
    last = max(math.ceil((stamps[-1] + pad_end_s) / dt - 5e-10), first + 1)
    count = last - first + 3
    scale = np.array([1.0] * 3 + [metres_per_radian] * 3)
    smooth = smoothing * len(stamps) / ((stamps[-1] - stamps[0]) * dt**3)
    loose = _loose_knots(stamps, first * dt, dt, count)
    # The start: constant twist between neighbouring poses, at rest outside the stamps.
    knots = np.clip(dt * np.arange(first - 1, last + 2), stamps[0], stamps[-1])
    start = se3.orthonormalise(se3.interpolated(stamps, trajectory.T_world_cam, knots))
    spline = Spline(start, first * dt, dt)

    threshold, prior = math.inf, np.full((count - 2, 6), _WEAK_PRIOR)
    r, bend = _residuals(trajectory, spline) * scale, _second_differences(spline) * scale
    length = 1.0
    for iteration in range(1, _MAX_ITERATIONS + 1):
        if iteration <= _SCALE_ITERATIONS:
            # Least squares first: the start is poor at the ends, and Huber would take its poses there for outliers.
            typical = float(np.median(np.linalg.norm(r, axis=1)))
            threshold = max(HUBER_FACTOR * typical, 1e-6) if robust == "huber" and iteration > 2 else math.inf
            prior = smooth + _prior(r, bend, loose)
        bands, gradient = _data_equations(trajectory, spline, r, threshold, scale, _RADIAL if length == 1.0 else 0.0)
        prior_bands, prior_gradient = _prior_equations(spline, bend, prior, scale)
        try:
            step = solveh_banded(bands + prior_bands, -(gradient + prior_gradient).ravel(), lower=True).reshape(
                count, 6
            )
        except (LinAlgError, ValueError):
            raise UserError("the spline fit broke down: check the trajectory or use a wider knot spacing") from None
        # The longest of the steps 1, 1/2, 1/4.. that does not raise the cost.
        before, points = _cost(r, bend, threshold, prior), spline.control_points
        for length in (0.5**k for k in range(11)):
            spline = Spline(se3.orthonormalise(points @ se3.exp(length * step)), spline.t0, dt)
            r, bend = _residuals(trajectory, spline) * scale, _second_differences(spline) * scale
            if _cost(r, bend, threshold, prior) <= before * (1.0 + 1e-9) + 1e-20:
                break
        if length * np.abs(step).max() < _STEP_TOLERANCE and iteration > 3:
            break
    else:
        if np.abs(step).max() > 1e-5:
            raise UserError(
                f"the spline fit did not settle in {_MAX_ITERATIONS} steps: widen the knot spacing, or check for "
                "rotations of half a turn between neighbouring poses"
            )
    distance = np.linalg.norm(spline.pose(stamps)[:, :3, 3] - trajectory.positions, axis=1)
    angle = np.linalg.norm(r[:, 3:], axis=1) / metres_per_radian
    weights = _huber_weights(np.linalg.norm(r, axis=1), threshold)
    return FitResult(spline, distance, angle, weights, iteration)


# --- the terms -------------------------------------------------------------------------------------------------------


def _residuals(trajectory: Trajectory, spline: Spline) -> FloatArray:
    """(n, 6) log(T_k⁻¹ T(t_k)), metres and radians, in the measured camera's frame."""
    return se3.log(se3.inverse(trajectory.T_world_cam) @ spline.pose(trajectory.stamps))


def _second_differences(spline: Spline) -> FloatArray:
    """(m − 2, 6) Ω_{i+1} − Ω_i = dt² times the body acceleration at the knots, to first order in Ω."""
    return spline.increments[1:] - spline.increments[:-1]


def _data_equations(
    trajectory: Trajectory, spline: Spline, r: FloatArray, threshold: float, scale: FloatArray, newton: float
) -> tuple[FloatArray, FloatArray]:
    first, J = spline.pose_jacobian(trajectory.stamps, side="right")
    J = scale[:, None] * (se3.right_jacobian_inv(r / scale)[:, None] @ J)
    norm = np.linalg.norm(r, axis=1)
    weights = _huber_weights(norm, threshold)
    # Huber's true Hessian is w (I − r̂ r̂ᵀ) beyond the threshold. With w I alone convergence takes hundreds of steps,
    # but never overshoots: the caller falls back to it (newton = 0) after a step that was too long.
    radial = np.where(weights < 1.0, newton, 0.0)
    direction = r / np.maximum(norm, 1e-300)[:, None]
    along = np.einsum("ni,naij->naj", direction, J)
    WJ = weights[:, None, None, None] * (J - (radial[:, None] * direction)[:, None, :, None] * along[:, :, None, :])
    return _accumulate(first, J, WJ, weights[:, None] * r, len(spline.control_points))


def _prior_equations(
    spline: Spline, bend: FloatArray, prior: FloatArray, scale: FloatArray
) -> tuple[FloatArray, FloatArray]:
    # log(exp(−δ) exp(Ω) exp(δ')) = Ω − Jl⁻¹ δ + Jr⁻¹ δ' for right increments of both control points.
    Jl, Jr = se3.left_jacobian_inv(spline.increments), se3.right_jacobian_inv(spline.increments)
    J = scale[:, None] * np.stack([Jl[:-1], -Jr[:-1] - Jl[1:], Jr[1:]], axis=1)
    count = len(spline.control_points)
    return _accumulate(np.arange(count - 2), J, prior[:, None, :, None] * J, prior * bend, count)


def _accumulate(
    first: IntArray, J: FloatArray, WJ: FloatArray, Wr: FloatArray, count: int
) -> tuple[FloatArray, FloatArray]:
    """Normal equations in LAPACK's lower band storage (24, 6 count), and the gradient (count, 6).

    first (n,): each term's first control point, ascending. J, WJ (n, k, 6, 6): Jacobians by its k ≤ 4 control points,
    bare and weighted. Wr (n, 6): weighted residuals.
    """
    starts = np.flatnonzero(np.diff(first, prepend=-1))
    index = first[starts]
    gradient = np.zeros((count, 6))
    blocks = np.zeros((4, count, 6, 6))  # [d, i] couples control points i and i + d
    for a in range(J.shape[1]):
        gradient[index + a] += np.add.reduceat(np.einsum("nij,ni->nj", J[:, a], Wr), starts)
        for b in range(a, J.shape[1]):
            blocks[b - a, index + a] += np.add.reduceat(np.swapaxes(J[:, a], 1, 2) @ WJ[:, b], starts)
    d, i, j = np.meshgrid(np.arange(4), np.arange(6), np.arange(6), indexing="ij")
    lower = 6 * d + j - i >= 0
    d, i, j = d[lower], i[lower], j[lower]
    bands = np.zeros((_ROWS, count, 6))
    bands[6 * d + j - i, :, i] = blocks[d, :, i, j]
    return bands.reshape(_ROWS, 6 * count), gradient


def _cost(r: FloatArray, bend: FloatArray, threshold: float, prior: FloatArray) -> float:
    norm = np.linalg.norm(r, axis=1)
    limit = np.minimum(norm, threshold)  # Huber: norm² below the threshold, its tangent above
    return float((limit * (2.0 * norm - limit)).sum() + (prior * bend**2).sum())


# --- weights ---------------------------------------------------------------------------------------------------------


def _huber_weights(norm: FloatArray, threshold: float) -> FloatArray:
    return np.minimum(1.0, threshold / np.maximum(norm, 1e-300))


def _loose_knots(stamps: FloatArray, t0: float, dt: float, count: int) -> BoolArray:
    """(count − 2,) True where the poses alone leave the acceleration at knot t0 + i dt open.

    That is so at the ends, in padding, around gaps and wherever poses are sparser than knots. Least squares lets
    acceleration run wild there: on kt2 the last control point, seen by one pose with weight 0.006, goes so far that the
    iteration diverges. The measure is the variance of a second difference of control points under unit noise of the
    poses, D (BᵀB)⁻¹ Dᵀ, in the additive B-spline: 38 inside at 1.5 poses a knot, 1207 at the end, 10⁹ without data.
    """
    basis = BSpline.design_matrix(np.clip((stamps - t0) / dt, 0.0, count - 3.0), np.arange(-3.0, count + 1.0), 3)
    D: Any = diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(count - 2, count))
    normal: Any = basis.T @ basis + _WEAK_PRIOR * (D.T @ D)
    bands = np.zeros((4, count))
    for d in range(4):
        bands[d, : count - d] = normal.diagonal(d)
    # Wanted is a diagonal only; what is far apart does not interact, so that every 48th knot shares a right-hand side.
    rows = np.arange(count - 2)
    probes = np.zeros((count - 2, 48))
    probes[rows, rows % 48] = 1.0
    variance = (D @ solveh_banded(bands, D.T @ probes, lower=True))[rows, rows % 48]
    return np.abs(variance) > _LOOSE_VARIANCE


def _prior(r: FloatArray, bend: FloatArray, loose: BoolArray) -> FloatArray:
    """(m − 2, 6) weights of the second differences.

    A loose knot's acceleration is expected to be like those inside: the weight is the one of a Gaussian prior of their
    (median) size against data of the median residual's noise, times _HOLD, apart for translation and rotation. Where
    the data are exact, or everything is loose (knots finer than the poses), what remains is the weak prior: the
    straightest motion through the poses.
    """
    weights = np.full(bend.shape, _WEAK_PRIOR)
    if loose.all():
        return weights
    for part in (slice(0, 3), slice(3, 6)):
        noise = float(np.median(np.linalg.norm(r[:, part], axis=1)))
        typical = float(np.median(np.linalg.norm(bend[~loose, part], axis=1)))
        # A camera at rest has neither; then the ratio is one.
        weights[loose, part] += _HOLD * ((noise + 1e-12) / (typical + 1e-12)) ** 2
    return weights


# --- checks ----------------------------------------------------------------------------------------------------------


def _check(
    trajectory: Trajectory, dt: float, smoothing: float, pad_begin_s: float, pad_end_s: float, robust: str, rad: float
) -> None:
    if len(trajectory) < MIN_POSES:
        raise UserError(f"cannot fit a spline to {len(trajectory)} poses: at least {MIN_POSES} are needed")
    if not (np.diff(trajectory.stamps) > 0.0).all() or not np.isfinite(trajectory.T_world_cam).all():
        raise UserError("cannot fit a spline: stamps must increase strictly and poses be finite")
    if not (math.isfinite(dt) and dt > 0.0):
        raise UserError(f"knot spacing {dt} s: must be positive")
    if robust not in get_args(Robust):
        raise UserError(f"unknown robust kernel '{robust}': use one of {', '.join(get_args(Robust))}")
    named = (("smoothing", smoothing), ("pad_begin_s", pad_begin_s), ("pad_end_s", pad_end_s))
    for name, value in named:
        if not (math.isfinite(value) and value >= 0.0):
            raise UserError(f"{name} = {value}: must be zero or positive")
    if not (math.isfinite(rad) and rad > 0.0):
        raise UserError(f"metres_per_radian = {rad}: must be positive")
