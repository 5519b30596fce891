"""Whether an image agrees with what is known without it: the normalised innovation of a Kalman filter, per image.

State: the pose [m; rad] in the depth camera's axes at mid readout, and its velocity, against the predicted ones. An
image whose errors hang together, which no scatter of its pixels shows (steps of depth on a wall, a lens, clocks), is
off as a whole: its innovation is too large for its covariance. Its covariance is then inflated until the innovation is
what it may be (Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, 5.4).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
from scipy.special import chdtri

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.alignment.observation import Observation
from rstrack.alignment.pull import steady
from rstrack.alignment.spline_state import SplineState
from rstrack.tracking.judgement.uncertainty import SYSTEMATIC_PX

# Chance with which an innovation that is nothing but chance counts as too large.
_LEVEL = 1e-3
# σ of colour's clock, s, and of readouts, as a part of them, where they are told and not calibrated.
_CLOCK_S, _READOUT = 3e-3, 0.13
# σ of what an image alone leaves open, m and rad; and of a state of which nothing is known, with velocities in 1/s.
_OPEN = np.tile([0.05, 0.05, 0.05, *np.radians([3.0, 3.0, 3.0])], 2)
_UNKNOWN = np.full(12, 100.0)


@dataclass(frozen=True)
class Prediction:
    """What is known before a frame's images: an extrapolated spline, and the state's covariance (12, 12)."""

    spline: Spline
    covariance: FloatArray


@dataclass(frozen=True)
class _Measured:
    """What one image says of the state: deviation z (12,) from the prediction and covariance R (12, 12)."""

    observation: Observation
    z: FloatArray
    R: FloatArray

    def inflated(self, factor: float) -> _Measured:
        return replace(self, R=factor * self.R)


def weighed(fresh: Sequence[Observation], state: SplineState, predicted: Prediction) -> bool:
    """Let images that are off as a whole count as little as their innovations say; whether there are any.

    fresh: a frame's observations, aligned, of a spline in this state. Of two that disagree it is the one that is
    further from the prediction: it is held against the prediction and the others. Then all of them together are held
    against the prediction.
    """
    seen = [_measured(o, state, predicted) for o in fresh if o.is_linearised]
    if not seen:
        return False
    P, nothing = predicted.covariance, np.zeros(12)
    odd = max(seen, key=lambda one: _innovation(one, P))
    rest = [one for one in seen if one is not odd]
    excess = _inflation(odd, *_updated(nothing, P, rest))
    z, R = _updated(nothing, np.diag(_UNKNOWN**2), [*rest, odd.inflated(excess)])
    together = _inflation(_Measured(odd.observation, z, R), nothing, P)
    for one in seen:
        one.observation.count_as(one.observation.independent / (together * (excess if one is odd else 1.0)))
    return max(excess, together) > 1.0


def _updated(mean: FloatArray, P: FloatArray, images: Sequence[_Measured]) -> tuple[FloatArray, FloatArray]:
    """Mean (12,) and covariance (12, 12) of the state after images."""
    for one in images:
        gain = np.linalg.solve(P + one.R, P).T
        mean, P = mean + gain @ (one.z - mean), P - gain @ P
        P = 0.5 * (P + P.T)
    return mean, P


def _innovation(one: _Measured, P: FloatArray) -> float:
    return float(one.z @ np.linalg.solve(P + one.R, one.z))


def _inflation(one: _Measured, mean: FloatArray, P: FloatArray) -> float:
    """The least s >= 1 with which s R leaves the image's innovation against a state within the quantile of chance."""
    off, R = one.z - mean, one.R
    limit = float(chdtri(len(off), _LEVEL))
    spread, basis = scipy.linalg.eigh(P, R)  # basisᵀ R basis = 1
    y2, spread = (basis.T @ off) ** 2, np.maximum(spread, 0.0)

    def beyond(s: float) -> float:
        return float((y2 / (spread + s)).sum()) - limit

    if beyond(1.0) <= 0.0:
        return 1.0
    low, high = 1.0, 1.0 + float(y2.sum()) / limit
    for _ in range(50):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if beyond(middle) > 0.0 else (low, middle)
    return float(high)


def _measured(o: Observation, state: SplineState, predicted: Prediction) -> _Measured:
    exposure = o.image.exposure
    mid, half = exposure.mid_time, 0.5 * (exposure.last_time - exposure.first_time)
    H, g = steady(o, state)
    pose, velocity = state.spline.pose_and_velocity(mid)
    to_camera = np.kron(np.eye(4), pose[:3, :3].T)
    H, g = to_camera @ H @ to_camera.T, to_camera @ g
    # `steady` has the change over half a readout where the state has the velocity.
    by = np.concatenate([np.ones(6), np.full(6, max(half, 1e-3))])
    # Scaled by what is open, since gain and offset, taken out of H, may leave rounding below zero.
    spread, basis = np.linalg.eigh(H * np.outer(_OPEN, _OPEN))
    R = (basis / (1.0 + np.maximum(spread, 0.0))) @ basis.T * np.outer(_OPEN, _OPEN)
    moved = -R @ g / by
    turn = SYSTEMATIC_PX / o.ref.lens.camera.fx
    R += np.diag(np.tile(np.repeat([turn * o.ref.median_depth, turn], 3), 2) ** 2)
    R = R / np.outer(by, by)
    T_predicted, velocity_predicted = predicted.spline.pose_and_velocity(mid)
    deviation = np.concatenate([se3.log(se3.inverse(T_predicted) @ pose), velocity - velocity_predicted])
    # What the cameras' times may be wrong by moves all of an image alike, as far as the camera moves meanwhile.
    if not o.is_depth:
        R[:6, :6] += _CLOCK_S**2 * np.outer(velocity, velocity)
    R[6:, 6:] += _READOUT**2 * np.outer(velocity, velocity)
    return _Measured(o, deviation + moved, 0.5 * (R + R.T))
