"""What errors of the calibration do to a track, and what its images tell of these errors.

`Common` is a Schmidt-Kalman filter beside `Uncertainty`: the same gain, and the parameters, which are not solved for,
keep their σ. Poses have left increments in the world, as drift has; the world is the first frame.

`CalibrationErrors` is a Kalman filter of the errors θ of all parameters, in σ of the camera file; they stay the same.
Depth and colour of a frame each find its pose. The two are apart by D θ and noise, D being what one σ of each moves the
one image by, less what it moves the other. Colour's clock alone is put right while tracking: for a lens all keyframes
would have to be made again. The others are estimated beside it, so that it is not taken for what they do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rstrack.alignment.normal_equations import block_diagonal
from rstrack.alignment.observation import Observation
from rstrack.alignment.spline_state import SplineState
from rstrack.data.rig import CALIBRATION_NAMES
from rstrack.tracking.judgement.consider import CLOCK, COUNT, Calibration


def _nothing() -> FloatArray:
    return np.zeros((6, len(CALIBRATION_NAMES)))


@dataclass(frozen=True, eq=False)
class Common:
    """By how much one σ of each parameter moves pose and velocity (6, m) of the newest frame, and keyframes' poses.

    velocity: in the depth camera's axes, [m; rad]/s. Of keyframes, velocities: those (6,) at which they were taken;
    color_late_s: what was added to their colours' stamps.
    """

    pose: FloatArray = field(default_factory=_nothing)
    velocity: FloatArray = field(default_factory=_nothing)
    keyframes: dict[int, FloatArray] = field(default_factory=dict)
    velocities: dict[int, FloatArray] = field(default_factory=dict)
    color_late_s: dict[int, float] = field(default_factory=dict)

    def predicted(self, seconds: float, T_world_depth: FloatArray) -> FloatArray:
        """Of pose and velocity (12, m) in the camera's axes so many seconds later, at T_world_depth (4, 4)."""
        pose = se3.adjoint(se3.inverse(T_world_depth)) @ self.pose
        return np.concatenate([pose + seconds * self.velocity, self.velocity])

    def of_keyframe(self, index: int, T_world_depth: FloatArray) -> FloatArray:
        """What a keyframe's own errors do to a pose T_world_depth (4, 4) found at it: (6, m), in the camera's axes."""
        return np.asarray(se3.adjoint(se3.inverse(T_world_depth)) @ self.keyframes.get(index, _nothing()))

    def at_rest(self) -> Common:
        """The same, if nothing is known of the motion."""
        return replace(self, velocity=_nothing())

    def moved(self, calibration: Calibration, o: Observation, state: SplineState, count: int = 6) -> FloatArray:
        """How the calibration would have an image move its lines (count, m), see `Calibration.moved`."""
        return calibration.moved(o, state, self.velocities.get(o.ref.index, np.zeros(6)), count)

    def cross_information(
        self, calibration: Calibration, fresh: Sequence[Observation], state: SplineState, at: FloatArray, excess: float
    ) -> FloatArray:  # fmt: skip
        """H D (6, m) of a frame at `at`, T_world_depth (4, 4): minus the information of pose and parameters both.

        H: the information of the pose, in the camera's axes; D: what one σ of each parameter moves an image by. excess:
        see `Scores`.
        """
        total = _nothing()
        turn = block_diagonal(at[:3, :3], 2)
        for o in fresh:
            if o.is_linearised:
                H, _ = o.steady(state)
                moved = self.moved(calibration, o, state) + self.of_keyframe(o.ref.index, at)
                total += turn.T @ H[:6, :6] @ turn @ moved
        return total / excess**2

    def after(
        self, seconds: float, T_world_depth: FloatArray, P: FloatArray, seen: FloatArray, cross: FloatArray
    ) -> Common:  # fmt: skip
        """With a frame that was found at T_world_depth (4, 4); its covariance (12, 12) is then P.

        seen (6, 6): the information of its images; cross (6, m): see `cross_information`.
        """
        now = self.predicted(seconds, T_world_depth)
        now = now + P[:, :6] @ (cross - seen @ now[:6])
        return replace(self, pose=se3.adjoint(T_world_depth) @ now[:6], velocity=now[6:])


@dataclass(frozen=True, eq=False)
class Considered:
    """The calibration of a frame, and what it has done to the one so many seconds before; all by one σ of it.

    color_late_s: what is added to its colours' stamps.
    """

    calibration: Calibration
    common: Common
    seconds: float
    color_late_s: float

    def moved(self, o: Observation, state: SplineState) -> FloatArray:
        """How it would have an image move its lines (12, m), see `Calibration.moved`."""
        return self.common.moved(self.calibration, o, state, 12)

    def lag(self, o: Observation, state: SplineState) -> FloatArray:
        """What an image's lines (12,) are moved by since its keyframe was made with an older clock."""
        index, known = o.ref.index, self.common
        velocity = known.velocities.get(index, np.zeros(6))
        later_s = self.color_late_s - known.color_late_s.get(index, 0.0)
        return later_s * self.calibration.lagging(o, state, velocity)

    def of_keyframe(self, o: Observation, T_world_depth: FloatArray) -> FloatArray:
        """What it has done to the image's keyframe (6, m), in the axes of the camera at T_world_depth (4, 4)."""
        return self.common.of_keyframe(o.ref.index, T_world_depth)

    def predicted(self, T_world_depth: FloatArray) -> FloatArray:
        """What it does to a prediction of pose and velocity (12, m) at T_world_depth (4, 4)."""
        return self.common.predicted(self.seconds, T_world_depth)


# Frames that tell as much as one: they share a keyframe, with what its noise and depth have wrong. wild2's clock is the
# same from three starts by 30; by 1 it is several of its σ apart.
_ALIKE = 30.0


@dataclass(frozen=True, eq=False)
class CalibrationErrors:
    """mean (21,), covariance (21, 21): of what the parameters are too large by, in σ of the camera file."""

    mean: FloatArray = field(default_factory=lambda: np.zeros(COUNT))
    covariance: FloatArray = field(default_factory=lambda: np.eye(COUNT))

    @property
    def clock(self) -> tuple[float, float]:
        """Colour's clock: what its offset is too large by, and how far that may be wrong."""
        return float(self.mean[CLOCK]), float(np.sqrt(self.covariance[CLOCK, CLOCK]))

    def with_frame(self, apart: FloatArray, D: FloatArray, R: FloatArray) -> CalibrationErrors:
        """With a frame whose two images' poses are `apart` (6,), though the clock was put right by its mean.

        D (6, 21): by how much one σ of each parameter has them apart. R (6, 6): covariance of all else.
        """
        P, R = self.covariance, _ALIKE * R
        still_wrong = np.where(np.arange(len(self.mean)) == CLOCK, 0.0, self.mean)
        gain = np.linalg.solve(D @ P @ D.T + R, D @ P).T
        # Joseph's form: the covariance stays positive where D is large.
        left = np.eye(len(P)) - gain @ D
        return CalibrationErrors(self.mean + gain @ (apart - D @ still_wrong), left @ P @ left.T + gain @ R @ gain.T)
