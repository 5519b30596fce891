"""How far off the poses of a track may be: of its newest frames, and of its keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.alignment.observation import Observation, Scores
from rstrack.alignment.spline_state import SplineState
from rstrack.images.device_frame import DeviceFrame
from rstrack.images.fast_spline import motion
from rstrack.keyframes.keyframe import Reference
from rstrack.tracking.frame_report import FrameReport
from rstrack.tracking.judgement.calibration_errors import Common, Considered
from rstrack.tracking.judgement.consider import CLOCK, Calibration
from rstrack.tracking.judgement.uncertainty import Uncertainty


@dataclass(frozen=True, eq=False)
class _Recent:
    """Of a frame: the keyframe, the covariance (6, 6) against it, `Common.pose`, the camera's velocity (6,), and what
    was added to its colours' stamps."""

    ref: int
    covariance: FloatArray
    common: FloatArray
    velocity: FloatArray
    color_late_s: float


@dataclass
class PoseCovariances:
    """uncertainty, common: of the newest frame. Of frames that may become keyframes theirs are remembered.

    focal_px: the depth camera's.
    """

    focal_px: float
    calibration: Calibration
    uncertainty: Uncertainty = field(default_factory=Uncertainty)
    common: Common = field(default_factory=Common)
    _recent: dict[int, _Recent] = field(default_factory=dict)

    @property
    def color_late(self) -> tuple[float, float]:
        """Seconds that colour was found to be later than its stamps, and σ of that."""
        mean, sigma = self.uncertainty.calibration.clock
        file_s = self.calibration.sigmas[CLOCK]
        return -file_s * mean, file_s * sigma

    def begun_anew(self) -> PoseCovariances:
        """Of a track that begins, with what is known of the cameras."""
        return PoseCovariances(self.focal_px, self.calibration, self.uncertainty.begun_anew())

    def considered(self, seconds: float) -> Considered | None:
        """What the calibration does to the next frame, so many seconds later; None where it is exact."""
        if self.calibration.is_exact:
            return None
        return Considered(self.calibration, self.common, seconds, self.color_late[0])

    def after(
        self, seconds: float, uncertainty: Uncertainty, fresh: Sequence[Observation], state: SplineState, score: Scores
    ) -> Common:  # fmt: skip
        """`common` so many seconds later (0: found anew), of a frame then so uncertain; score: by its images."""
        if self.calibration.is_exact or not fresh:
            return self.common
        at = motion(state.spline, fresh[0].image.exposure.mid_time)[0]
        own = self.common.cross_information(self.calibration, fresh, state, at, score.excess)
        before = self.common if seconds else self.common.at_rest()
        return before.after(seconds, at, uncertainty.state, score.information, own)

    def add(self, frame: DeviceFrame, ref: Reference, spline: Spline, oldest: int = 0) -> None:
        """A frame that has been found against a keyframe; what is before frame `oldest` is forgotten."""
        kept = {k: one for k, one in self._recent.items() if k >= oldest}
        _, velocity = motion(spline, frame.depth.exposure.mid_time)
        covariance = self.uncertainty.covariance(self.focal_px, ref.median_depth)
        own = _Recent(ref.index, covariance, self.common.pose, velocity, frame.color_late_s)
        self._recent = kept | {frame.index: own}

    def look_at(self, ref: Reference, spline: Spline) -> None:
        """The first keyframe, before anything is found at it."""
        self._keep(ref.index, np.zeros_like(self.common.pose), motion(spline, ref.t)[1])

    def begin(self, ref: Reference, frames: Sequence[DeviceFrame], spline: Spline) -> None:
        """The first keyframe, made of one of the first frames; the world is the first of them."""
        first = self._recent.get(frames[0].index)
        T_world_first = spline.pose(frames[0].depth.exposure.mid_time)
        covariance = np.zeros((6, 6)) if first is None else first.covariance
        self.uncertainty = self.uncertainty.with_keyframe(ref.index, -1, T_world_first, covariance)
        if first is None:
            return
        # Found at a keyframe that was taken for exact, it is the first frame that is.
        self._keep(ref.index, -first.common, self.common.velocities[ref.index])
        self.common = replace(self.common, pose=self.common.pose - first.common)
        self._recent = {k: replace(one, common=one.common - first.common) for k, one in self._recent.items()}

    def keyframe(self, ref: Reference) -> None:
        """A keyframe made of a recent frame."""
        if ref.index in self._recent:
            own = self._recent[ref.index]
            self.uncertainty = self.uncertainty.with_keyframe(ref.index, own.ref, ref.T_world_base, own.covariance)
            self._keep(ref.index, own.common, own.velocity, own.color_late_s)

    def report(
        self, report: FrameReport, frame: DeviceFrame, fresh: Sequence[Observation], spline: Spline
    ) -> FrameReport:
        """A frame's report with its covariance, if it has one."""
        if report.lost or frame.index not in self._recent:
            return report
        report = self.of(report, frame, spline)
        if not fresh or any(o.ref.rolling is not None for o in fresh):
            return report
        return replace(report, held_by_motion=self.uncertainty.held_by_motion)

    def of(self, report: FrameReport, frame: DeviceFrame, spline: Spline, at: int = -1) -> FrameReport:
        """The same where it has none, too: that it is then as good as keyframe `at`."""
        T_world_depth, own = motion(spline, frame.stamp)[0], self._recent.get(frame.index)
        from_world = se3.adjoint(se3.inverse(T_world_depth))
        if own is None:
            common = self.common.of_keyframe(at, T_world_depth)
            covariance = np.zeros((6, 6))
        else:
            to_stamp = from_world @ se3.adjoint(motion(spline, frame.depth.exposure.mid_time)[0])
            at, covariance = own.ref, to_stamp @ own.covariance @ to_stamp.T
            common = from_world @ own.common
        may_be_wrong = self.calibration.sigmas > 0.0
        shared = common[:, may_be_wrong] if may_be_wrong.any() else None
        return replace(report, covariance=covariance, drift_world=self.uncertainty.drift_of(at), common=shared)

    def _keep(self, index: int, common: FloatArray, velocity: FloatArray, color_late_s: float = 0.0) -> None:
        known = self.common
        self.common = replace(
            known, keyframes=known.keyframes | {index: common}, velocities=known.velocities | {index: velocity},
            color_late_s=known.color_late_s | {index: color_late_s},
        )  # fmt: skip
