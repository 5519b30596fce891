"""The paper's baseline: each depth image has one pose and is aligned to a keyframe, as if its shutter were global.

tracker = BaselineTracker(rig, Options(method="baseline"))
for frame in frames:
    tracker.feed(frame)
stamps, T_world_depth = tracker.trajectory
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.adjustment.rigid import Alignment, align
from rstrack.alignment.linearise import Terms
from rstrack.alignment.observation import Observation, scores
from rstrack.alignment.optimizer import Solved
from rstrack.alignment.spline_state import SplineState
from rstrack.data.moving_masks import MovingMasks
from rstrack.data.rig import Frame, Rig
from rstrack.images.device_frame import DeviceFrame, DeviceRig, Timer, untimed
from rstrack.keyframes.keyframe import Reference
from rstrack.keyframes.maker import KeyframeMaker
from rstrack.options import Options
from rstrack.tracking.frame_report import Fault, FrameReport, frame_report
from rstrack.tracking.judgement.lost_track import lost
from rstrack.tracking.judgement.uncertainty import Uncertainty
from rstrack.tracking.window import LEVELS

# Part of an image's pixels that must have depth for it to begin; frames in a row without a pose after which the
# keyframe is given up; seconds after which the velocity before says nothing about where the camera is.
_LEAST_DEPTH, _MOST_LOST, _GAP_S = 0.1, 5, 0.3


class BaselineTracker:
    """Estimates T_world_depth of each frame; the world is the depth camera's frame at the middle of the first image.

    A pose belongs to the middle of its image's readout.
    """

    spline = None
    spline_valid: tuple[tuple[float, float], ...] = ()
    inertia = None
    color_late = 0.0, 0.0

    def __init__(self, rig: Rig, options: Options | None = None, timer: Timer = untimed) -> None:
        self.rig = rig
        self.options = (options or Options(method="baseline")).decided(rig.depth_shutter)
        self._device = DeviceRig(rig, self.options, timer)
        self._terms = Terms.of(self._device, self.options)
        self._maker = KeyframeMaker.of(self._device)
        self._reference: Reference | None = None
        self._first_count = 0
        self._last_fed = -np.inf
        self._lost_in_a_row = 0
        self._stamps: list[float] = []
        self._times: list[float] = []
        self._poses: list[FloatArray] = []
        # Times and poses that the motion is extrapolated from: two, or one after a start.
        self._last: list[tuple[float, FloatArray]] = []
        self.reports: list[FrameReport] = []
        self.keyframes = 0
        self.left_out = MovingMasks()

    @property
    def uncorrected(self) -> BaselineTracker:
        """Itself: it closes no loops."""
        return self

    @property
    def reference(self) -> int | None:
        """Number of the frame whose keyframe new ones are aligned to."""
        return None if self._reference is None else self._reference.index

    @property
    def trajectory(self) -> tuple[FloatArray, FloatArray]:
        """Stamps (n,) of the frames that were not lost and T_world_depth (n, 4, 4) there."""
        stamps = np.array(self._stamps)
        poses = np.array(self._poses).reshape(-1, 4, 4)
        return stamps, se3.interpolated(np.array(self._times), poses, stamps) if len(poses) else poses

    def feed(self, frame: Frame) -> FrameReport:
        """Track one frame. Raises UserError if it is not newer than the one before, or its image is not the rig's."""
        stamp = frame.depth.stamp
        if not stamp > self._last_fed:
            raise UserError(
                f"tracker: frame stamped {stamp:.6f} s follows one stamped {self._last_fed:.6f} s: frames must come in "
                "order of time"
            )
        self._last_fed = stamp
        new = self._device.upload(len(self.reports), frame)
        report = self._start(new) if self._reference is None else self._track(new, self._reference)
        self.reports.append(report)
        return report

    def _start(self, new: DeviceFrame) -> FrameReport:
        is_lost = new.depth_share < _LEAST_DEPTH
        if not is_lost:
            self._found(new, np.eye(4))
            self._set_keyframe(new, np.eye(4), None)
        fault = Fault.NO_START if is_lost else Fault.NONE
        return frame_report(new.stamp, (), None, keyframe=not is_lost, fault=fault, overlap=1.0)

    def _track(self, new: DeviceFrame, ref: Reference) -> FrameReport:
        found = self._search(new, ref)
        self._first_count = max(self._first_count, 1 if found.fault else found.pixels)
        overlap = found.pixels / self._first_count
        if not found.fault:
            T_world_cam = se3.orthonormalise(ref.T_world_base @ found.T_ref_cam)
            self._found(new, T_world_cam)
            renew = self.options.left_behind(found.T_ref_cam, overlap)
            if renew:
                self._set_keyframe(new, T_world_cam, ref)
            elif self.options.fuse:
                self._reference = self._maker.fused(ref, new.depth, _still(T_world_cam, new.depth.exposure.mid_time))
        else:
            self._lost_in_a_row += 1
            renew = self._lost_in_a_row >= _MOST_LOST and new.depth_share >= _LEAST_DEPTH
            if renew:
                self._last = [(new.depth.exposure.mid_time, self._last[-1][1])]
                self._lost_in_a_row = 0
                self._set_keyframe(new, self._last[-1][1], None)
        fault = Fault(found.fault)
        return frame_report(new.stamp, found.fresh, found.solved, keyframe=renew, fault=fault, overlap=overlap)

    def _search(self, new: DeviceFrame, ref: Reference) -> Alignment:
        """Alignment from the predicted pose or, where that fails, the better one of those from the last pose and the
        keyframe's."""
        found = self._align(new, ref, self._predict(new.depth.exposure.mid_time))
        if not found.fault:
            return found
        others = [self._align(new, ref, T) for T in (self._last[-1][1], ref.T_world_base)]
        return min((other for other in others if not other.fault), key=lambda other: other.sigma_m, default=found)

    def _predict(self, t: float) -> FloatArray:
        """Constant velocity, unless it is too long ago."""
        times, poses = np.array([at for at, _ in self._last]), np.array([T for _, T in self._last])
        if t - times[-1] > _GAP_S:
            return self._last[-1][1]
        T: FloatArray = se3.interpolated(times, poses, np.array([t]))[0]
        return T

    def _align(self, new: DeviceFrame, ref: Reference, T_world_cam: FloatArray) -> Alignment:
        motion = _still(T_world_cam, new.depth.exposure.mid_time)
        T_ref_cam = se3.inverse(ref.T_world_base) @ T_world_cam
        return align(self._terms, self.options, new, ref, motion, T_ref_cam, LEVELS, self._judge)

    def _judge(
        self, fresh: Sequence[Observation], solved: Solved, state: SplineState, ref: Reference
    ) -> tuple[str, FloatArray]:  # fmt: skip
        """As `matching.judge_alone`, of an image that no other one can disagree with."""
        information = scores(fresh, state).information
        fault = lost(fresh, solved, ref.pixels)
        is_known = Uncertainty().found_anew(information).is_known
        return fault or ("" if is_known else Fault.UNKNOWN), information

    def _found(self, new: DeviceFrame, T_world_cam: FloatArray) -> None:
        t = new.depth.exposure.mid_time
        self._lost_in_a_row = 0
        self._stamps.append(new.stamp)
        self._times.append(t)
        self._poses.append(T_world_cam)
        self._last = [*self._last[-1:], (t, T_world_cam)]

    def _set_keyframe(self, new: DeviceFrame, T_world_cam: FloatArray, older: Reference | None) -> None:
        motion = _still(T_world_cam, new.depth.exposure.mid_time)
        older = older if self.options.fuse else None
        self._reference = self._maker.rectified(new.index, new.depth, (), motion, older)
        self._first_count = 0
        self.keyframes += 1


def _still(T_world_cam: FloatArray, t: float) -> Spline:
    """A camera that does not move around time t (s): what a global-shutter image's only line knows of its motion."""
    return Spline(np.repeat(T_world_cam[None], 4, axis=0), t - 0.5, 1.0)
