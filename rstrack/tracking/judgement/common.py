"""What errors of the calibration do to a track: to its newest frame, to its velocity and to its keyframes.

A Schmidt-Kalman filter beside `Uncertainty`: the same gain, and the parameters, which are not solved for, keep their σ.
Poses have left increments in the world, as drift has; the world is the first frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rstrack.alignment.consider import Coupling, Rays, coupling
from rstrack.alignment.landmarks import Landmarks
from rstrack.alignment.observation import Observation
from rstrack.alignment.pull import steady
from rstrack.alignment.spline_state import SplineState
from rstrack.data.calibration_sigma import NAMES
from rstrack.keyframes.keyframe import Reference

# Keyframes whose landmarks are remembered.
_REMEMBERED = 4


def _nothing() -> FloatArray:
    return np.zeros((6, len(NAMES)))


@dataclass(frozen=True, eq=False)
class Common:
    """By how much one σ of each parameter moves pose and velocity (6, m) of the newest frame, and keyframes' poses.

    velocity: in the depth camera's axes, [m; rad]/s. velocities: those (6,) at which keyframes were taken.
    """

    pose: FloatArray = field(default_factory=_nothing)
    velocity: FloatArray = field(default_factory=_nothing)
    keyframes: dict[int, FloatArray] = field(default_factory=dict)
    velocities: dict[int, FloatArray] = field(default_factory=dict)

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

    def after(
        self, seconds: float, T_world_depth: FloatArray, P: FloatArray, seen: FloatArray, pulled: FloatArray
    ) -> Common:  # fmt: skip
        """With a frame that was found at T_world_depth (4, 4); its covariance (12, 12) is then P.

        seen (6, 6): the information of its images; pulled (6, m): what an error of each parameter pulls it by.
        """
        now = self.predicted(seconds, T_world_depth)
        now = now + P[:, :6] @ (pulled - seen @ now[:6])
        return replace(self, pose=se3.adjoint(T_world_depth) @ now[:6], velocity=now[6:])


class Calibration:
    """A rig whose camera file may be wrong. rays: as a method sees it; sigmas (m,): of the parameters."""

    def __init__(self, rays: Rays, sigmas: FloatArray) -> None:
        self._rays, self.sigmas = rays, sigmas
        self._landmarks: dict[int, Landmarks] = {}
        # Of the newest frame's images: what they are like changes little while it is aligned.
        self._couplings: dict[tuple[int, int, float, bool], Coupling] = {}

    @property
    def is_exact(self) -> bool:
        """Whether nothing may be wrong: then nothing is worked out."""
        return not self.sigmas.any()

    def moved(self, o: Observation, state: SplineState, common: Common, count: int = 6) -> FloatArray:
        """How one σ of each parameter would have an image move its lines (count, m), in the depth camera's axes.

        count: 6 for all lines alike, 12 as of `pull.steady`.
        """
        key = o.frame, o.ref.index, o.image.exposure.first_time, o.is_depth
        if key not in self._couplings:
            if any(frame != o.frame for frame, *_ in self._couplings):
                self._couplings.clear()
            T_world_cam, velocity = state.spline.pose_and_velocity(o.image.exposure.mid_time)
            T_cam_ref = se3.inverse(T_world_cam) @ o.ref.T_world_base
            self._couplings[key] = coupling(o, self.landmarks(o.ref, common), self._rays, T_cam_ref, velocity)
        return self._couplings[key].twists(count, o.ref.median_depth) * self.sigmas

    def pulled(
        self, fresh: Sequence[Observation], state: SplineState, common: Common, at: FloatArray, excess: float
    ) -> FloatArray:  # fmt: skip
        """What errors pull a frame by at `at`, T_world_depth (4, 4), see `Common.after`; excess: see `Pulls`."""
        total = _nothing()
        turn = np.kron(np.eye(2), at[:3, :3])
        for o in fresh:
            if o.is_linearised:
                H, _ = steady(o, state)
                moved = self.moved(o, state, common) + common.of_keyframe(o.ref.index, at)
                total += turn.T @ H[:6, :6] @ turn @ moved
        return total / excess**2

    def landmarks(self, ref: Reference, common: Common) -> Landmarks:
        """Of a rectified keyframe."""
        found = self._landmarks.get(ref.index)
        if found is None:
            found = Landmarks.of(ref, common.velocities.get(ref.index, np.zeros(6)))
            for oldest in list(self._landmarks)[: len(self._landmarks) - _REMEMBERED + 1]:
                del self._landmarks[oldest]
            self._landmarks[ref.index] = found
        return found


@dataclass(frozen=True, eq=False)
class Considered:
    """The calibration of a frame, and what it has done to the one so many seconds before; all by one σ of it."""

    calibration: Calibration
    common: Common
    seconds: float

    def moved(self, o: Observation, state: SplineState) -> FloatArray:
        """How it would have an image move its lines (12, m), see `Calibration.moved`."""
        return self.calibration.moved(o, state, self.common, 12)

    def of_keyframe(self, o: Observation, T_world_depth: FloatArray) -> FloatArray:
        """What it has done to the image's keyframe (6, m), in the axes of the camera at T_world_depth (4, 4)."""
        return self.common.of_keyframe(o.ref.index, T_world_depth)

    def predicted(self, T_world_depth: FloatArray) -> FloatArray:
        """What it does to a prediction of pose and velocity (12, m) at T_world_depth (4, 4)."""
        return self.common.predicted(self.seconds, T_world_depth)
