"""Whether an image agrees with what is known without it: the normalised innovation of a Kalman filter, per image.

State: the pose [m; rad] in the depth camera's axes at mid readout, and its velocity, against the predicted ones. An
image whose errors hang together, which no scatter of its pixels shows (steps of depth on a wall, a lens, clocks), is
off as a whole: its innovation is too large for its covariance. Its covariance is then inflated until the innovation is
what it may be (Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, 5.4).

But the prediction may be what is wrong: the camera was moved while nothing was seen, or moves as no hand does. Images
that agree with each other better than with the prediction leave that open. The pose is then one of two, and their
distance is part of its covariance (a mixture's, as in probabilistic data association, ibid. 6.4).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.linalg
from scipy.optimize import brentq
from scipy.special import chdtri

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.alignment.normal_equations import block_diagonal
from rstrack.alignment.observation import Observation
from rstrack.alignment.spline_state import SplineState
from rstrack.images.fast_spline import motion, motions, twist_between
from rstrack.tracking.judgement.calibration_errors import CalibrationErrors, Considered
from rstrack.tracking.judgement.uncertainty import SYSTEMATIC_PX, Systematic, Uncertainty, of_pixels

# What an innovation of 12 numbers, over its covariance, exceeds by chance once in a thousand times.
_LIMIT = float(chdtri(12, 1e-3))
# σ of what an image alone leaves open, m and rad.
_OPEN = np.tile([0.05, 0.05, 0.05, *np.radians([3.0, 3.0, 3.0])], 2)


@dataclass(frozen=True)
class Prediction:
    """What is known before a frame's images: T_world_depth (4, 4) at a time t (s), the velocity [m; rad]/s (6,) in the
    camera's axes, which goes on, and the covariance (12, 12) of both."""

    t: float
    T_world_depth: FloatArray
    velocity: FloatArray
    covariance: FloatArray

    @classmethod
    def of(
        cls, extrapolated: Spline, t: float, covariance: FloatArray, earlier: tuple[float, float] | None = None
    ) -> Prediction:  # fmt: skip
        """At t (s), from where a spline goes on; or from its poses at two earlier times (s).

        Of images that are exposed at once a knot has one pose, and control points may alternate between them: what a
        spline is extrapolated to from those means little.
        """
        if earlier is None:
            return cls(t, *motion(extrapolated, t), covariance)
        before, last = motions(extrapolated, np.array(earlier))[0]
        velocity = twist_between(before, last) / (earlier[1] - earlier[0])
        return cls(t, last @ se3.exp((t - earlier[1]) * velocity), velocity, covariance)

    def pose(self, t: float) -> FloatArray:
        """T_world_depth (4, 4) at a time (s)."""
        if t == self.t:
            return self.T_world_depth
        return np.asarray(self.T_world_depth @ se3.exp((t - self.t) * self.velocity))


@dataclass(frozen=True)
class _Measured:
    """What one image says of the state: deviation z (12,) from the prediction and its covariance R (12, 12).

    at (12,): the deviation of what was found. D (12, m): by how much one σ of each parameter of the calibration changes
    z more than the prediction.
    """

    observation: Observation
    at: FloatArray
    z: FloatArray
    R: FloatArray
    D: FloatArray


@dataclass(frozen=True)
class Innovation:
    """What a frame's images are inflated by against a prediction, 1 where nothing is odd.

    own: what they would be if nothing were predicted, and the state that they would say then, alone (12,), as its
    deviation from the prediction. measured: what each image says, of a covariance that is inflated so.
    """

    inflation: float = 1.0
    own: float = 1.0
    alone: FloatArray = field(default_factory=lambda: np.zeros(12))
    measured: tuple[_Measured, ...] = ()


def weighed(
    fresh: Sequence[Observation], state: SplineState, predicted: Prediction, considered: Considered | None = None
) -> Innovation:  # fmt: skip
    """Let images that are off as a whole count as little as their innovations say.

    fresh: a frame's observations, aligned, of a spline in this state. Of two that disagree it is the one that is
    further from the prediction: it is held against the prediction and the others. Then all of them together are held
    against the prediction. considered: how far the calibration may be wrong.
    """
    seen = [_measured(o, state, predicted, considered) for o in fresh if o.is_linearised]
    if not seen:
        return Innovation()
    P = predicted.covariance
    odd = max(seen, key=lambda one: float(one.z @ np.linalg.solve(P + one.D @ one.D.T + one.R, one.z)))
    rest = [one for one in seen if one is not odd]
    excess = _inflation(*_expected(odd, P, rest), odd.R)
    z, R, D = _combined([replace(odd, R=excess * odd.R), *rest])
    together = _inflation(z, P + D @ D.T, R)
    for one in seen:
        factor = together * (excess if one is odd else 1.0)
        if factor > 1.0:
            one.observation.count_as(one.observation.independent / factor)
    if excess * together == 1.0:
        return Innovation(measured=tuple(seen))
    inflated = tuple(replace(one, R=together * (excess if one is odd else 1.0) * one.R) for one in seen)
    own = _inflation(*_expected(odd, Uncertainty().state, rest), odd.R)
    return Innovation(excess * together, own, _combined([replace(odd, R=own * odd.R), *rest])[0], inflated)


def mixture(
    innovation: Innovation, fresh: Sequence[Observation], state: SplineState, predicted: Prediction,
    considered: Considered | None = None,
) -> FloatArray:  # fmt: skip
    """Covariance (12, 12) that the state which was found has beyond the filter's.

    It is not the filter's mean where the spline cannot follow. And it may be what the images alone have it to be, the
    more likely the less inflation they need then. Of observations as they count after `weighed`, aligned again if any
    is odd.
    """
    known = {id(one.observation): one for one in innovation.measured if innovation.inflation == 1.0}
    seen = [
        known.get(id(o)) or _measured(o, state, predicted, considered) for o in fresh if o.is_linearised
    ]  # fmt: skip
    if not seen:
        return np.zeros((12, 12))
    P = predicted.covariance
    z, R, _ = _combined(seen)
    at = seen[0].at
    apart = P @ np.linalg.solve(P + R, z) - at
    total = np.outer(apart, apart)
    if innovation.inflation > 1.0:
        off = innovation.alone - at
        total += max(0.0, 1.0 - innovation.own / innovation.inflation) * np.outer(off, off)
    return np.asarray(total)


def disagreement(
    fresh: Sequence[Observation], state: SplineState, considered: Considered | None = None, median: float = 1.0
) -> FloatArray:  # fmt: skip
    """Covariance (12, 12) that a pose has beyond the filter's which nothing predicts, of the line that is furthest off.

    All of its images have a gradient beyond noise where the spline cannot follow. And where they disagree by more
    than they, the calibration and the median inflation explain, either of them may be right: each counts as if it were.
    median: see `Systematic.median_inflation`; a wrong camera file makes all frames' images disagree.
    """
    here, seen = _unpredicted(fresh, state, considered)
    if not seen:
        return np.zeros((12, 12))
    first = max((one.observation for one in seen), key=lambda o: o.is_depth)
    exposure, distance = first.image.exposure, first.ref.median_depth
    half = 0.5 * (exposure.last_time - exposure.first_time)

    def squared(z: FloatArray) -> FloatArray:
        ends = z[:6] - half * z[6:], z[:6] + half * z[6:]
        off = max(ends, key=lambda end: float(np.linalg.norm(end[:3]) + distance * np.linalg.norm(end[3:])))
        return np.outer(np.concatenate([off, z[6:]]), np.concatenate([off, z[6:]]))

    odd, *rest = seen
    inflation = _inflation(*_expected(odd, here.covariance, rest), odd.R)
    apart = np.sum([squared(one.z) for one in seen], axis=0)
    z, R, _ = _combined(seen)
    beyond = max(0.0, 1.0 - len(z) / max(float(z @ np.linalg.solve(R, z)), 1e-12))
    return np.asarray(beyond * squared(z) + max(0.0, 1.0 - median / inflation) * apart)


def by_images(
    fresh: Sequence[Observation], state: SplineState, considered: Considered | None = None, median: float = 1.0
) -> Prediction | None:  # fmt: skip
    """What a frame's images say of its pose and velocity, with nothing else known; None without images.

    median: as in `disagreement`.
    """
    here, seen = _unpredicted(fresh, state, considered)
    if not seen:
        return None
    z, R, D = _combined(seen)
    T_world_depth = np.asarray(here.T_world_depth @ se3.exp(z[:6]))
    return Prediction(here.t, T_world_depth, here.velocity + z[6:], median * R + D @ D.T)


def contradicts(before: Prediction, now: Prediction, accelerations: FloatArray, drift: FloatArray) -> bool:
    """Whether no motion leads from one state to another: their innovation is beyond the limit.

    accelerations (6,): σ, m/s² and rad/s². drift (6, 6): covariance of the keyframes' poses against each other, in the
    camera's axes.
    """
    P = Uncertainty(state=before.covariance).predicted(now.t - before.t, accelerations) + now.covariance
    P[:6, :6] += drift
    off = np.concatenate([twist_between(before.pose(now.t), now.T_world_depth), now.velocity - before.velocity])
    return bool(off @ np.linalg.solve(P, off) > _LIMIT)


def learnt(
    innovation: Innovation, known: Systematic, errors: CalibrationErrors, excess: float
) -> tuple[Systematic, CalibrationErrors]:  # fmt: skip
    """With what a frame's depth and colour, which are apart, say of both: of the first only where nothing is odd.

    excess: see `Scores`.
    """
    known = known.with_inflation(innovation.own)
    depth, color = (
        next((one for one in innovation.measured if one.observation.is_depth is kind), None) for kind in (True, False)
    )
    if depth is None or color is None:
        return known, errors
    apart, D = (depth.z - color.z)[:6], (depth.D - color.D)[:6]
    if D.size:
        errors = errors.with_frame(apart, D, excess**2 * (depth.R + color.R)[:6, :6])
    if innovation.inflation > 1.0:
        return known, errors
    focal_px, depth_m = depth.observation.ref.lens.camera.fx, depth.observation.ref.median_depth
    both = (depth.R + color.R)[:6, :6] - 2.0 * of_pixels(SYSTEMATIC_PX, focal_px, depth_m)
    return known.with_frame(apart, excess**2 * both + D @ D.T, focal_px, depth_m), errors


def _unpredicted(
    fresh: Sequence[Observation], state: SplineState, considered: Considered | None
) -> tuple[Prediction, list[_Measured]]:  # fmt: skip
    """The state that was found, as if that were the prediction, and what each image says against it."""
    aligned = [o for o in fresh if o.is_linearised]
    mid = max(aligned, key=lambda o: o.is_depth).image.exposure.mid_time if aligned else state.spline.t0
    here = Prediction(mid, *motion(state.spline, mid), Uncertainty().state)
    return here, [_measured(o, state, here, considered) for o in aligned]


def _expected(odd: _Measured, P: FloatArray, rest: Sequence[_Measured]) -> tuple[FloatArray, FloatArray]:
    """How far an image is off (12,) where the others are known, and the covariance (12, 12) of that but for its own R.

    State and parameters together: of these the images say the same.
    """
    mean = np.zeros(12 + odd.D.shape[1])
    P = scipy.linalg.block_diag(P, np.eye(odd.D.shape[1]))
    for one in rest:
        A = np.hstack([np.eye(12), one.D])
        gain = np.linalg.solve(A @ P @ A.T + one.R, A @ P).T
        mean, P = mean + gain @ (one.z - A @ mean), P - gain @ A @ P
        P = 0.5 * (P + P.T)
    A = np.hstack([np.eye(12), odd.D])
    return odd.z - A @ mean, A @ P @ A.T


def _combined(seen: Sequence[_Measured]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """z, R and D of images as the solver weighs them: by R alone."""
    first, *rest = seen
    both, R = np.column_stack([first.z, first.D]), first.R
    for one in rest:
        gain = np.linalg.solve(R + one.R, R).T
        both, R = both + gain @ (np.column_stack([one.z, one.D]) - both), R - gain @ R
        R = 0.5 * (R + R.T)
    return both[:, 0], R, both[:, 1:]


def _inflation(off: FloatArray, P: FloatArray, R: FloatArray) -> float:
    """The least s >= 1 for which an innovation `off` (12,) of covariance P + s R is within the limit."""
    spread, basis = scipy.linalg.eigh(P, R)  # basisᵀ R basis = 1
    y2, spread = (basis.T @ off) ** 2, np.maximum(spread, 0.0)

    def beyond(s: float) -> float:
        return float((y2 / (spread + s)).sum()) - _LIMIT

    if beyond(1.0) <= 0.0:
        return 1.0
    # Within the limit there, but for rounding: an innovation of 10⁹ σ, as of a start that diverged, may not be.
    most = 1.0 + float(y2.sum()) / _LIMIT
    return most if beyond(most) >= 0.0 else float(brentq(beyond, 1.0, most, rtol=1e-6))


def _measured(
    o: Observation, state: SplineState, predicted: Prediction, considered: Considered | None
) -> _Measured:  # fmt: skip
    exposure = o.image.exposure
    mid, half = exposure.mid_time, 0.5 * (exposure.last_time - exposure.first_time)
    H, g = o.steady(state)
    pose, velocity = motion(state.spline, mid)
    to_camera = block_diagonal(pose[:3, :3].T, 4)
    H, g = to_camera @ H @ to_camera.T, to_camera @ g
    # `Observation.steady` has the change over half a readout where the state has the velocity.
    by = np.concatenate([np.ones(6), np.full(6, max(half, 1e-3))])
    # Scaled by what is open, since gain and offset, taken out of H, may leave rounding below zero.
    spread, basis = np.linalg.eigh(H * np.outer(_OPEN, _OPEN))
    R = (basis / (1.0 + np.maximum(spread, 0.0))) @ basis.T * np.outer(_OPEN, _OPEN)
    moved = -R @ g / by
    D = np.zeros((12, 0))
    if considered is not None:
        D = R @ H @ considered.moved(o, state) / by[:, None]
        moved -= R @ H @ considered.lag(o, state) / by
        D[:6] += considered.of_keyframe(o, pose)
        D -= considered.predicted(pose)
    R += block_diagonal(of_pixels(SYSTEMATIC_PX, o.ref.lens.camera.fx, o.ref.median_depth), 2)
    R = R / np.outer(by, by)
    off = twist_between(predicted.pose(mid), pose)
    deviation = np.concatenate([off, velocity - predicted.velocity])
    return _Measured(o, deviation, deviation + moved, 0.5 * (R + R.T), D)
