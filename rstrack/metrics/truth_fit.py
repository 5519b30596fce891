"""The truth against the images: its clock, and what its poses are poses of, each as it fits an estimate best.

fit = fit_clock(truth, estimate)
metrics = evaluate(shifted(truth, fit.offset_s), estimate)
metrics = evaluate(mounted(truth, fit_extrinsics(truth, estimate).T_body_camera), estimate)

Motion capture has a clock of its own, and a driver's stamps are late or early. Its poses are of a body fixed to the
camera, where calibration was to make it the camera itself. That is hand-eye calibration, A X = X B of the motions A of
the body and B of the camera: Park, Martin, Robot Sensor Calibration: Solving AX = XB on the Euclidean Group (IEEE T-RA
10(5), 1994). A camera with wrong intrinsics moves as if it were elsewhere too: what is found is where the truth fits
the estimate best, whoever of the two is wrong.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
from scipy.optimize import least_squares, minimize_scalar
from scipy.spatial.transform import Rotation

from rsgen.array_types import FloatArray, IntArray
from rsgen.errors import UserError
from rsgen.geometry import se3, so3
from rsgen.geometry.spline import Spline
from rsgen.sequence.trajectory import Trajectory
from rstrack.data.estimate import Estimate
from rstrack.metrics.association import Truth, align, true_poses
from rstrack.metrics.evaluate import motions, pairs_one_second_apart, pose_errors

TruthOffset = float | Literal["auto"]
"""Seconds after a stamp that the truth is looked up, or 'auto': those at which the errors are least."""
TruthExtrinsics = Literal["auto"]
Criterion = Literal["rotational drift", "translational drift"]
CRITERIA: tuple[Criterion, ...] = ("rotational drift", "translational drift")

SEARCH_S = 0.1
"""Offsets are sought within ± this."""

_COARSE_S, _FINE_S, _FINE_REACH_S = 4e-3, 1e-3, 20e-3
LEAST_PAIRS = 30
"""Pairs of poses one second apart below which there is no fit."""

# Resampled curves, and the length of what is resampled as one piece: errors of overlapping seconds are alike.
_RESAMPLES, _BLOCK_S = 200, 2.0
# Motions of one second must turn the camera this much, degrees RMS, about every axis that the fit needs.
_LEAST_TURN_DEG = 2.0
# Of that fit, each with new scales of the residuals.
_ROUNDS = 4
# Scales of residuals that do not differ from zero, m and rad.
_EXACT = 1e-9


@dataclass(frozen=True)
class ClockFit:
    """Offset at which an estimate fits the truth best: the pose stamped t belongs to the truth at t + offset_s.

    sigma_s: standard deviation of that, from a block bootstrap over the recording's time. criterion: the error that was
    minimised. least_s: where each of the errors is least, the trajectory error among them: they should agree.
    """

    offset_s: float
    sigma_s: float
    criterion: Criterion
    least_s: dict[str, float]

    @property
    def is_clear(self) -> bool:
        """Whether the clocks differ by more than 2 ms and more than two standard deviations."""
        return abs(self.offset_s) > max(2e-3, 2.0 * self.sigma_s)

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers for JSON."""
        return dataclasses.asdict(self)


def shifted(truth: Truth, offset_s: float) -> Truth:
    """The truth on the images' clock, where its own is ahead by offset_s; poses are interpolated from then on."""
    motion: Spline | Trajectory
    if isinstance(truth.motion, Spline):
        motion = Spline(truth.motion.control_points, truth.motion.t0 - offset_s, truth.motion.dt)
    else:
        motion = Trajectory(truth.motion.stamps - offset_s, truth.motion.T_world_cam)
    return dataclasses.replace(truth, motion=motion, interpolate=True)


def fit_clock(truth: Truth, estimate: Estimate) -> ClockFit:
    """Find the offset within ±0.1 s at which the drift per second is least.

    Minimised is the mean absolute error of relative poses over one second (`evaluate`'s RPE, but not squared, so that a
    stretch where the track was lost does not decide): a scan in steps of 4 ms, then Brent's method. Rotation is
    sharper than translation but for motions without any; whichever has the smaller standard deviation is taken.
    Only poses that have a truth at all offsets count, the same ones at each.

    Standard deviation: half the central 68 % of the minima of 200 curves, resampled in blocks of 2 s.

    Raises UserError: too few poses, or no minimum within the range.
    """
    errors = _Errors.of(truth, estimate)
    coarse = _steps(SEARCH_S, _COARSE_S)
    curves = np.stack([errors.drift(tau).mean(axis=-1) for tau in coarse])
    least: dict[str, float] = {}
    for c, name in enumerate(CRITERIA):
        k = int(np.argmin(curves[:, c]))
        if 0 < k < len(coarse) - 1:
            least[name] = _brent(partial(errors.mean_drift, c), coarse, k)
    if not least:
        raise UserError(
            f"estimate: its errors have no minimum within {1e3 * SEARCH_S:g} ms of clock offset: give the offset in "
            "seconds, or repair the track first"
        )
    sigma = {name: errors.deviation(c, least[name]) for c, name in enumerate(CRITERIA) if name in least}
    best = min((name for name in CRITERIA if name in least), key=lambda name: sigma[name])
    trajectory = [errors.trajectory(tau) for tau in coarse]
    k = int(np.clip(np.argmin(trajectory), 1, len(coarse) - 2))
    return ClockFit(least[best], sigma[best], best, {**least, "trajectory": _brent(errors.trajectory, coarse, k)})


def resampled_blocks(stamps: FloatArray) -> list[IntArray]:
    """Indices of 200 resamples of what happens at times (n,), s, of a recording: blocks of 2 s, with replacement."""
    count = len(stamps)
    per_second = count / (stamps[-1] - stamps[0])
    length = int(np.clip(_BLOCK_S * per_second, 1, count // 4))
    starts = np.random.default_rng(0).integers(0, count, (_RESAMPLES, -(-count // length)))
    # Circular: both ends count as often as the middle.
    return [((blocks[:, None] + np.arange(length)) % count).ravel() for blocks in starts]


# ---------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Errors:
    """Errors of one estimate as functions of the offset.

    stamps (n,), T_est (n, 4, 4): poses that have a truth at all offsets. i, j: (k,) pairs one second apart.
    """

    motion: Spline | Trajectory
    stamps: FloatArray
    T_est: FloatArray
    i: Any
    j: Any

    @classmethod
    def of(cls, truth: Truth, estimate: Estimate) -> _Errors:
        # Also half a coarse step outside, where Brent's method may look.
        offsets = _steps(SEARCH_S + _FINE_REACH_S, 5e-3)
        known = np.zeros(len(estimate.stamps), int)
        for tau in offsets:
            known[true_poses(truth.motion, estimate.stamps + tau, interpolate=True)[0]] += 1
        compared = known == len(offsets)
        stamps, T_est = estimate.stamps[compared], estimate.T_world_depth[compared]
        i, j = pairs_one_second_apart(stamps)
        if len(i) < LEAST_PAIRS:
            raise UserError(
                f"estimate: {len(i)} pairs of poses one second apart have a truth within {1e3 * SEARCH_S:g} ms, a "
                f"clock offset needs {LEAST_PAIRS}"
            )
        return cls(truth.motion, stamps, T_est, i, j)

    def true_poses(self, tau: float) -> FloatArray:
        """(n, 4, 4) at the stamps + tau."""
        return true_poses(self.motion, self.stamps + tau, interpolate=True)[1]

    def drift(self, tau: float) -> FloatArray:
        """Angles, degrees, and distances, m, of the relative poses' errors (2, k)."""
        true_step, est_step = (motions(T, self.i, self.j) for T in (self.true_poses(tau), self.T_est))
        distance, angle = pose_errors(true_step, est_step)
        return np.stack([angle, distance])

    def mean_drift(self, criterion: int, tau: float) -> float:
        """Mean of a row of `drift`."""
        return float(self.drift(tau)[criterion].mean())

    def trajectory(self, tau: float) -> float:
        """Mean distance after alignment, m."""
        T_true = self.true_poses(tau)
        T_true_est, _ = align(T_true, self.T_est)
        aligned = se3.transform(T_true_est, self.T_est[:, :3, 3])
        return float(np.linalg.norm(aligned - T_true[:, :3, 3], axis=1).mean())

    def deviation(self, criterion: int, tau: float) -> float:
        """Standard deviation of the least point of a drift curve that is least at tau, seconds."""
        offsets = tau + _steps(_FINE_REACH_S, _FINE_S)
        curves = np.stack([self.drift(float(at))[criterion] for at in np.clip(offsets, -SEARCH_S, SEARCH_S)], axis=1)
        drawn = resampled_blocks(self.stamps[self.i])
        minima = [offsets[int(np.argmin(curves[k].mean(axis=0)))] for k in drawn]
        low, high = np.quantile(minima, [0.16, 0.84])
        # Minima are found on a grid: no finer than its rounding error.
        return float(np.hypot(0.5 * (high - low), _FINE_S / np.sqrt(12.0)))


def _steps(reach: float, step: float) -> FloatArray:
    count = round(reach / step)
    return np.asarray(np.arange(-count, count + 1) * step, np.float64)


def _brent(cost: Callable[[float], float], grid: FloatArray, k: int) -> float:
    """Where a function is least between the neighbours of the k-th of some points."""
    found = minimize_scalar(cost, bounds=(grid[k - 1], grid[k + 1]), method="bounded", options={"xatol": 1e-6})
    return float(found.x)


@dataclass(frozen=True)
class ExtrinsicsFit:
    """Rigid transform on the right of the truth's poses that fits an estimate best.

    T_body_camera: (4, 4) the estimate's camera to the truth's body. sigma_m, sigma_deg: (3,) standard deviations of the
    translation and of the rotation vector, about the body's axes, from a block bootstrap over the recording's time.
    """

    T_body_camera: FloatArray
    sigma_m: FloatArray
    sigma_deg: FloatArray

    @property
    def translation_m(self) -> FloatArray:
        """(3,) where the camera lies in the body's frame."""
        return np.asarray(self.T_body_camera[:3, 3])

    @property
    def rotation_deg(self) -> FloatArray:
        """(3,) rotation vector of the camera in the body's frame."""
        return np.degrees(so3.log(self.T_body_camera[:3, :3]))

    def text(self) -> str:
        """On one line."""
        moved = _triple(1e3 * self.translation_m, 1e3 * self.sigma_m)
        return f"the truth's camera moved by {moved} mm and {_triple(self.rotation_deg, self.sigma_deg)} deg"

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers for JSON."""
        numbers = dataclasses.asdict(self) | {"translation_m": self.translation_m, "rotation_deg": self.rotation_deg}
        return {name: value.tolist() for name, value in numbers.items()}


def mounted(truth: Truth, T_body_camera: FloatArray) -> Truth:
    """The truth of a camera that lies at T_body_camera (4, 4) in the frame whose poses the truth has."""
    motion: Spline | Trajectory
    if isinstance(truth.motion, Spline):
        # Exact at all times: the twists between control points are those of the same motion, seen from elsewhere.
        motion = Spline(truth.motion.control_points @ T_body_camera, truth.motion.t0, truth.motion.dt)
    else:
        motion = Trajectory(truth.motion.stamps, truth.motion.T_world_cam @ T_body_camera)
    return dataclasses.replace(truth, motion=motion)


def fit_extrinsics(truth: Truth, estimate: Estimate) -> ExtrinsicsFit:
    """Find the transform on the right of the truth's poses with which the motions over one second agree best.

    Least squares over the pairs of `evaluate`'s RPE, translations and rotations each in units of their own remaining
    RMS; as relative motions they know no alignment, and errors that add up along the track count only as fast as they
    arise. Begins at the closed form of Park and Martin, so that a body turned by any angle is found.

    Standard deviations: of 200 solutions, linearised, over blocks of 2 s drawn with replacement.

    Raises UserError: too few poses, or a motion that turns about fewer than two axes, which leaves a translation open.
    """
    index, T_true = true_poses(truth.motion, estimate.stamps, truth.interpolate)
    stamps, T_est = estimate.stamps[index], estimate.T_world_depth[index]
    i, j = pairs_one_second_apart(stamps)
    if len(i) < LEAST_PAIRS:
        raise UserError(
            f"estimate: {len(i)} pairs of poses one second apart have a truth, its extrinsics need {LEAST_PAIRS}"
        )
    body, camera = (motions(T, i, j) for T in (T_true, T_est))
    _refuse_few_turns(body)
    R, p = _closed_form(body, camera)

    def residuals(x: FloatArray) -> FloatArray:
        X = _rigid(so3.exp(x[3:]) @ R, p + x[:3])
        return np.asarray(se3.log(se3.inverse(se3.inverse(X) @ body @ X) @ camera) / scale).ravel()

    x, scale = np.zeros(6), np.ones(6)
    for _ in range(_ROUNDS):
        rest = residuals(x).reshape(-1, 6) * scale
        scale = np.repeat([_size(rest[:, :3]), _size(rest[:, 3:])], 3)
        solution = least_squares(residuals, x, x_scale=np.repeat([1.0, 0.1], 3))
        x = solution.x
    J = np.asarray(solution.jac, np.float64).reshape(-1, 6, 6)
    H, g = np.einsum("nki,nkj->nij", J, J), np.einsum("nki,nk->ni", J, residuals(x).reshape(-1, 6))
    errors = np.stack([-np.linalg.solve(H[k].sum(0), g[k].sum(0)) for k in resampled_blocks(stamps[i])])
    sigma = errors.std(axis=0)
    return ExtrinsicsFit(_rigid(so3.exp(x[3:]) @ R, p + x[:3]), sigma[:3], np.degrees(sigma[3:]))


# ---------------------------------------------------------------------------------------------------------------------


def _refuse_few_turns(body: FloatArray) -> None:
    """Raises UserError if the motions (n, 4, 4) leave one of the extrinsics open."""
    turn = so3.log(body[:, :3, :3])
    spread = np.degrees(np.sqrt(np.maximum(np.linalg.eigvalsh(turn.T @ turn / len(turn)), 0.0)))
    if spread[1] < _LEAST_TURN_DEG:
        what = "along the axis of the turns" if spread[2] >= _LEAST_TURN_DEG else "altogether"
        raise UserError(
            f"truth: the motion leaves its extrinsics open, the translation {what}: within a second it turns by "
            f"{spread[2]:.1f}, {spread[1]:.1f} and {spread[0]:.1f} deg RMS about its three axes, two need "
            f"{_LEAST_TURN_DEG:g}"
        )


def _closed_form(body: FloatArray, camera: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotation (3, 3) and translation (3,) of X in A X = X B, motions A and B (n, 4, 4) of body and camera."""
    # R_X turns the camera's axes of rotation onto the body's.
    R = Rotation.align_vectors(so3.log(body[:, :3, :3]), so3.log(camera[:, :3, :3]))[0].as_matrix()
    A = (body[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    b = (camera[:, :3, 3] @ R.T - body[:, :3, 3]).ravel()
    return R, np.asarray(np.linalg.lstsq(A, b, rcond=None)[0])


def _rigid(R: FloatArray, p: FloatArray) -> FloatArray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, p
    return T


def _size(rest: FloatArray) -> float:
    return max(float(np.sqrt(np.mean(rest**2))), _EXACT)


def _triple(values: FloatArray, sigmas: FloatArray) -> str:
    return f"({', '.join(f'{v:.1f} ± {s:.1f}' for v, s in zip(values, sigmas, strict=True))})"
