"""The paper's baseline: each depth image has one pose and is aligned to a keyframe, as if its shutter were global.

tracker = BaselineTracker(rig, Options(method="baseline"))
for frame in frames:
    tracker.feed(frame)
stamps, T_world_depth = tracker.trajectory
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.alignment.linearise import Terms, seen_motions, weakest_motion
from rstrack.alignment.optimizer import STOP_PX
from rstrack.data.rig import Frame, Rig
from rstrack.images.device_frame import DeviceFrame, DeviceRig, Timer, untimed
from rstrack.images.pyramid import LEVELS, DepthImage
from rstrack.keyframes.keyframe import Reference, strides
from rstrack.keyframes.maker import KeyframeMaker
from rstrack.options import Options
from rstrack.tracking.frame_report import FrameReport
from rstrack.tracking.judgement.fault import Fault

# Error at the start of an alignment, as σ in m; re-estimated with every step.
_START_DEPTH = 5e-3
# Steps at most on the levels, finest first.
_MOST_STEPS = (30, 10, 10)
# An alignment whose last step still moves lines further has not converged (pixels).
_SETTLED_PX = 0.5
# Part of an image's pixels that must fall on the keyframe; `observability` of the motion that is seen least, below
# which rounding decides; frames in a row without either after which the keyframe is given up.
_LEAST_SHARE, _LEAST_SEEN = 0.1, 1e-5
_MOST_LOST = 5
# Seconds after which the velocity before says nothing about where the camera is.
_GAP_S = 0.3


@dataclass(frozen=True)
class Alignment:
    """Where a depth image was found to be: T_base_cam (4, 4) in the keyframe's frame, and how well it fits there.

    sigma: scale of the residuals, m. count, share: pixels that fall on the keyframe, and their part of those looked
    at. evaluations: linearisations, one for each step. shift: movement of the last step, pixels; infinite if there was
    none to take.
    """

    T_base_cam: FloatArray
    sigma: float
    count: int
    share: float
    evaluations: int
    shift: float
    observability: float

    @property
    def fault(self) -> Fault:
        """Where it has not converged, or not on enough pixels."""
        if self.share < _LEAST_SHARE:
            return Fault.NOTHING_SEEN
        if self.shift < _SETTLED_PX:
            return Fault.NONE
        return Fault.UNKNOWN if self.observability < _LEAST_SEEN else Fault.UNSETTLED

    @property
    def is_good(self) -> bool:
        """Whether it has converged on enough pixels."""
        return not self.fault


class BaselineTracker:
    """Estimates T_world_depth of each frame; the world is the depth camera's frame at the middle of the first image.

    A pose belongs to the middle of its image's readout.
    """

    spline = None
    spline_valid: tuple[tuple[float, float], ...] = ()

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
        is_lost = new.depth_share < _LEAST_SHARE
        if not is_lost:
            self._found(new, np.eye(4))
            self._set_keyframe(new, np.eye(4), None)
        nowhere = Alignment(np.eye(4), float("nan"), 0, 0.0, 0, 0.0, 0.0)
        return _report(new, nowhere, 1.0, keyframe=not is_lost, fault=Fault.NO_START if is_lost else Fault.NONE)

    def _track(self, new: DeviceFrame, ref: Reference) -> FrameReport:
        found = self._search(new, ref)
        self._first_count = max(self._first_count, found.count if found.is_good else 1)
        overlap = found.count / self._first_count
        if found.is_good:
            T_world_cam = se3.orthonormalise(ref.T_world_base @ found.T_base_cam)
            self._found(new, T_world_cam)
            renew = self.options.left_behind(found.T_base_cam, overlap)
            if renew:
                self._set_keyframe(new, T_world_cam, ref)
            elif self.options.fuse:
                self._reference = self._maker.fused(ref, new.depth, _still(T_world_cam, new.depth.exposure.mid_time))
        else:
            self._lost_in_a_row += 1
            renew = self._lost_in_a_row >= _MOST_LOST and new.depth_share >= _LEAST_SHARE
            if renew:
                self._last = [(new.depth.exposure.mid_time, self._last[-1][1])]
                self._lost_in_a_row = 0
                self._set_keyframe(new, self._last[-1][1], None)
        return _report(new, found, overlap, keyframe=renew, fault=found.fault)

    def _search(self, new: DeviceFrame, ref: Reference) -> Alignment:
        """Alignment from the predicted pose or, where that fails, the better one of those from the last pose and the
        keyframe's."""
        to_base = se3.inverse(ref.T_world_base)
        found = self._align(new.depth, ref, to_base @ self._predict(new.depth.exposure.mid_time))
        if found.is_good:
            return found
        others = [self._align(new.depth, ref, to_base @ T) for T in (self._last[-1][1], ref.T_world_base)]
        return min((other for other in others if other.is_good), key=lambda other: other.sigma, default=found)

    def _predict(self, t: float) -> FloatArray:
        """Constant velocity, unless it is too long ago."""
        times, poses = np.array([at for at, _ in self._last]), np.array([T for _, T in self._last])
        if t - times[-1] > _GAP_S:
            return self._last[-1][1]
        T: FloatArray = se3.interpolated(times, poses, np.array([t]))[0]
        return T

    def _align(self, new: DepthImage, ref: Reference, T_base_cam: FloatArray) -> Alignment:
        """Gauss-Newton from a pose, coarse to fine."""
        found = Alignment(T_base_cam, _START_DEPTH, 0, 1.0, 0, 0.0, 0.0)
        for level in reversed(range(LEVELS)):
            if np.isfinite(found.shift):
                found = self._descend(new, ref, found, level)
        return found

    def _descend(self, new: DepthImage, ref: Reference, start: Alignment, level: int) -> Alignment:
        camera = self.rig.depth_camera
        stride = strides(camera.width, camera.height)[level]
        looked_at = -(-camera.width // stride) * -(-camera.height // stride)
        found = start
        for _ in range(_MOST_STEPS[level]):
            T, sigma = found.T_base_cam, found.sigma
            sums, next_sigma = self._terms.geometric_pose(new, ref, T, level, sigma)
            share, weakest, evaluations = (
                sums.count / looked_at,
                weakest_motion(seen_motions(sums, ref.median_depth)),
                found.evaluations + 1,
            )
            if share < _LEAST_SHARE or weakest < _LEAST_SEEN:
                return Alignment(T, sigma, sums.count, share, evaluations, np.inf, weakest)
            step = -sigma * np.linalg.solve(sums.H[0, 0], sums.g[0, 0])
            T = se3.orthonormalise(se3.exp(step) @ T)
            shift = camera.fx * float(np.abs(step[:3]).max() / ref.median_depth + np.abs(step[3:]).max())
            found = Alignment(T, next_sigma, sums.count, share, evaluations, shift, weakest)
            if shift < STOP_PX[level]:
                break
        return found

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


def _report(new: DeviceFrame, found: Alignment, overlap: float, *, keyframe: bool, fault: Fault) -> FrameReport:
    return FrameReport(
        stamp=new.stamp,
        sigma_depth_m=found.sigma,
        sigma_intensity=float("nan"),
        inliers_depth=found.count,
        inliers_color=0,
        iterations=found.evaluations,
        evaluations=found.evaluations,
        last_shift_px=found.shift,
        keyframe=keyframe,
        lost=bool(fault),
        observability=found.observability,
        overlap=overlap,
        fault=fault,
    )
