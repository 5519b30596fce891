"""How far off a pose may be: its covariance against the keyframe that it was found at, and the keyframe's own.

A frame's images give an information matrix, that of the normal equations with pixels counted as far as they are
independent; what they leave open, the motion before holds, ever less (a Kalman filter over pose and velocity with white
acceleration). What all pixels have in common, and no scatter of theirs shows, is added (`systematic.py`). Where
a frame becomes a keyframe its covariance is added to all that follows: drift.

Increments are [m; rad] in the depth camera's own frame at mid readout, T_world_depth exp(ξ), unless named otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rstrack.alignment.priors import ACCELERATION, VELOCITY
from rstrack.tracking.judgement.calibration_errors import CalibrationErrors
from rstrack.tracking.judgement.systematic import Systematic, of_pixels

# σ (m, rad) above which a pose is not known.
_WORST = np.array([0.02, np.radians(2.0)])
# A pose that nothing tells, m and rad.
_NOWHERE = np.array([10.0, 10.0, 10.0, 3.0, 3.0, 3.0])


@dataclass(frozen=True)
class Uncertainty:
    """Of the newest frame. state (12, 12): the filter's covariance of pose and velocity against its keyframe; doubt
    (12, 12): what they have beyond it, see `innovation.doubt`.

    seen (6, 6): what its images say of its pose, the information. drift: for each keyframe by its index the covariance
    (6, 6) of its pose, as left increments in the world. systematic: what images so far have told of such errors;
    calibration: and of the calibration's.
    """

    state: FloatArray = field(default_factory=lambda: _lost())
    doubt: FloatArray = field(default_factory=lambda: np.zeros((12, 12)))
    seen: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))
    drift: dict[int, FloatArray] = field(default_factory=dict)
    systematic: Systematic = field(default_factory=Systematic)
    calibration: CalibrationErrors = field(default_factory=CalibrationErrors)

    @property
    def pose(self) -> FloatArray:
        """Covariance (6, 6) of the pose against the keyframe."""
        return np.asarray((self.state + self.doubt)[:6, :6])

    def covariance(self, focal_px: float, depth_m: float) -> FloatArray:
        """The same with what is systematic, for a depth camera of such a focal length and things so far away."""
        return np.asarray(self.pose + of_pixels(self.systematic.px, focal_px, depth_m))

    @property
    def is_known(self) -> bool:
        """Whether the pose is known better than to 20 mm and 2° in every direction."""
        sigmas = [np.sqrt(np.linalg.eigvalsh(self.pose[part, part])[-1]) for part in (slice(3), slice(3, 6))]
        return bool((np.array(sigmas) < _WORST).all())

    @property
    def held_by_motion(self) -> float:
        """Largest part, 0 to 1, that the motion before, not the images, has in what is known of any direction."""
        return float(np.clip(1.0 - np.linalg.eigvals(self.pose @ self.seen).real.min(), 0.0, 1.0))

    def after(
        self, seconds: float, seen: FloatArray, accelerations: FloatArray = ACCELERATION, rate: float = np.inf
    ) -> Uncertainty:
        """So many seconds later, with what the images then say (6, 6).

        accelerations (6,): σ of what the velocity changes by beyond what is known, m/s² and rad/s². rate: σ of the
        angular rate itself, rad/s, where a gyroscope tells it: it does not wander, as what is told by its changes does.
        """
        updated = _told(self.predicted(seconds, accelerations, rate), slice(0, 6), seen)
        return replace(self, state=0.5 * (updated + updated.T), seen=seen, doubt=np.zeros((12, 12)))

    def predicted(self, seconds: float, accelerations: FloatArray = ACCELERATION, rate: float = np.inf) -> FloatArray:
        """The state's covariance (12, 12) so many seconds later, before any image; arguments as in `after`."""
        F = np.eye(12)
        F[:6, 6:] = seconds * np.eye(6)
        gain = np.concatenate([0.5 * seconds**2 * np.eye(6), seconds * np.eye(6)])
        predicted = F @ (self.state + self.doubt) @ F.T + gain @ np.diag(accelerations**2) @ gain.T
        return _told(predicted, slice(9, 12), np.eye(3) / rate**2)

    def begun_anew(self) -> Uncertainty:
        """Nothing is known of any pose; of the cameras it is what was."""
        return Uncertainty(systematic=self.systematic, calibration=self.calibration)

    def of_first(self) -> Uncertainty:
        """Of the frame that the world is taken from, which may move."""
        return replace(self.begun_anew(), state=np.diag(np.concatenate([np.zeros(6), VELOCITY]) ** 2))

    def found_anew(self, seen: FloatArray) -> Uncertainty:
        """Of a frame of which nothing is known but what its images (6, 6) say."""
        return replace(self, state=_lost(), doubt=np.zeros((12, 12))).after(0.0, seen)

    def with_keyframe(self, index: int, before: int, T_world_depth: FloatArray, pose: FloatArray) -> Uncertainty:
        """With a keyframe made of a frame at T_world_depth (4, 4), whose covariance was `pose` against another one."""
        Ad = se3.adjoint(T_world_depth)
        drift = self.drift_of(before) + Ad @ pose @ Ad.T
        return replace(self, drift=self.drift | {index: drift})

    def drift_of(self, index: int) -> FloatArray:
        """Covariance (6, 6) of a keyframe's pose, see `drift`."""
        return self.drift.get(index, np.zeros((6, 6)))


def _told(P: FloatArray, part: slice, information: FloatArray) -> FloatArray:
    """Covariance P (12, 12) with information (k, k) of a part of the state."""
    # P − P E (H⁻¹ + Eᵀ P E)⁻¹ Eᵀ P without the inverse of H, which may be singular.
    solved = np.linalg.solve(np.eye(len(information)) + information @ P[part, part], information)
    return np.asarray(P - P[:, part] @ solved @ P[part])


def _lost() -> FloatArray:
    return np.diag(np.concatenate([_NOWHERE, VELOCITY]) ** 2)
