"""How far off the poses of a track may be: of its newest frames, and of its keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry.spline import Spline
from rstrack.alignment.observation import Observation
from rstrack.images.device_frame import DeviceFrame
from rstrack.keyframes.keyframe import Reference
from rstrack.tracking.frame_report import FrameReport
from rstrack.tracking.judgement.uncertainty import Uncertainty


class PoseCovariances:
    """uncertainty: of the newest frame. Of frames that may become keyframes their covariance is remembered."""

    def __init__(self, focal_px: float) -> None:
        """focal_px: the depth camera's."""
        self.uncertainty = Uncertainty()
        self._focal = focal_px
        # Of recent frames: the keyframe and the covariance against it.
        self._recent: dict[int, tuple[int, FloatArray]] = {}

    def add(self, frame: DeviceFrame, ref: Reference, oldest: int = 0) -> None:
        """A frame that has been found against a keyframe; what is before frame `oldest` is forgotten."""
        kept = {k: c for k, c in self._recent.items() if k >= oldest}
        self._recent = kept | {frame.index: (ref.index, self._of(ref))}

    def begin(self, ref: Reference, frames: Sequence[DeviceFrame], spline: Spline) -> None:
        """The first keyframe, made of one of the first frames; the world is the first of them."""
        _, covariance = self._recent.get(frames[0].index, (ref.index, np.zeros((6, 6))))
        T_world_first = spline.pose(frames[0].depth.exposure.mid_time)
        self.uncertainty = self.uncertainty.with_keyframe(ref.index, -1, T_world_first, covariance)

    def keyframe(self, ref: Reference) -> None:
        """A keyframe made of a recent frame."""
        if ref.index in self._recent:
            before, covariance = self._recent[ref.index]
            self.uncertainty = self.uncertainty.with_keyframe(ref.index, before, ref.T_world_base, covariance)

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
        at, covariance = self._recent.get(frame.index, (at, np.zeros((6, 6))))
        drift = self.uncertainty.drift_of(at, spline.pose(frame.depth.exposure.mid_time))
        return replace(report, covariance=covariance, drift=drift)

    def _of(self, ref: Reference) -> FloatArray:
        return self.uncertainty.covariance(self._focal, ref.median_depth)
