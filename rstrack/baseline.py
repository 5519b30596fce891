"""The paper's baseline: each depth image has one pose and is aligned to a keyframe, as if its shutter were global.

tracker = BaselineTracker(rig, Options(method="baseline"))
for frame in frames:
    tracker.feed(frame)
stamps, T_world_depth = tracker.trajectory
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsgen.geometry import se3
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.so3 import FloatArray
from rsgen.geometry.spline import Spline
from rstrack.engine import engine
from rstrack.frames import DepthImage, camera_rays, depth_image
from rstrack.keyframe import KeyframeMaker
from rstrack.lines import Exposure
from rstrack.optimizer import STOP_PX
from rstrack.options import Options
from rstrack.reference import STRIDES, Reference
from rstrack.rig import Frame, Rig
from rstrack.terms import Terms, observability
from rstrack.tracker import FrameReport
from rstrack.warp import Lens

# Error at the start of an alignment, as σ in m; re-estimated with every step.
_START_DEPTH = 5e-3
# Steps at most on the pyramid's levels, finest first.
_MOST_STEPS = (30, 10, 10)
# A step is taken if it raises the image's negative log-likelihood per pixel by less, and else cut to this part.
_SAME, _SHORTEN = 1e-5, 0.25
# An alignment whose last step still moves lines further has not converged (pixels).
_SETTLED_PX = 0.5
# Part of an image's pixels that must fall on the keyframe, and frames in a row without it after which it is given up.
_LEAST_SHARE = 0.1
_MOST_LOST = 5


@dataclass(frozen=True)
class Alignment:
    """Where a depth image was found to be: T_base_cam (4, 4) in the keyframe's frame, and how well it fits there.

    sigma: scale of the residuals, m. count, share: pixels that fall on the keyframe, and their part of those looked
    at. evaluations: linearisations, one for each step. shift: movement of the last step, pixels.
    """

    T_base_cam: FloatArray
    sigma: float
    count: int
    share: float
    evaluations: int
    shift: float
    observability: float

    @property
    def is_good(self) -> bool:
        """Whether it has converged on enough pixels."""
        return self.share >= _LEAST_SHARE and self.shift < _SETTLED_PX


class BaselineTracker:
    """Estimates T_world_depth of each frame; the world is the depth camera's frame at the middle of the first image.

    A pose belongs to the middle of its image's readout.
    """

    spline = None

    def __init__(self, rig: Rig, options: Options | None = None) -> None:
        self.rig, self.options = rig, options or Options(method="baseline")
        shutter = rig.depth_shutter
        self._e = engine(self.options.backend)
        self._lens = Lens(rig.depth_camera, Shutter(0.0, shutter.exposure_s, shutter.scan))
        lines = shutter.line_count(rig.depth_camera)
        self._to_middle = 0.5 * (lines - 1) * shutter.line_delay(rig.depth_camera)
        rays = camera_rays(Exposure(self._lens, 0.0, np.eye(4)))
        device_rays = self._e.upload(rays[..., 0]), self._e.upload(rays[..., 1])
        self._terms = Terms(self._e, device_rays)
        self._maker = KeyframeMaker(self._e, rays, device_rays)
        self._reference: Reference | None = None
        self._first_count = 0
        self._fed = 0
        self._lost_in_a_row = 0
        self._stamps: list[float] = []
        self._times: list[float] = []
        self._poses: list[FloatArray] = []
        # The pose that the next frame starts from if there is no motion to go on with.
        self._last = np.eye(4)
        self.reports: list[FrameReport] = []
        self.keyframes = 0

    @property
    def trajectory(self) -> tuple[FloatArray, FloatArray]:
        """Stamps (n,) of the frames that were not lost and T_world_depth (n, 4, 4) there."""
        stamps = np.array(self._stamps)
        return stamps, interpolated(np.array(self._times), np.array(self._poses), stamps)

    def feed(self, frame: Frame) -> FrameReport:
        """Track one frame."""
        exposure = Exposure(self._lens, frame.depth.stamp + self._to_middle, np.eye(4))
        new = depth_image(self._e, exposure, frame.depth.pixels, self.options.max_depth)
        self._fed += 1
        if self._reference is None:
            self._found(frame.depth.stamp, new, np.eye(4))
            self._set_keyframe(new, self._last, None)
            report = FrameReport(
                stamp=frame.depth.stamp, sigma_depth_m=float("nan"), sigma_intensity=float("nan"), inliers_depth=0,
                inliers_color=0, iterations=0, evaluations=0, last_shift_px=0.0, keyframe=True, lost=False,
                observability=0.0, overlap=1.0,
            )  # fmt: skip
        else:
            report = self._track(frame.depth.stamp, new, self._reference)
        self.reports.append(report)
        return report

    def _track(self, stamp: float, new: DepthImage, ref: Reference) -> FrameReport:
        found = self._search(new, ref)
        T_world_cam = se3.orthonormalise(ref.T_world_base @ found.T_base_cam)
        if found.is_good:
            self._found(stamp, new, T_world_cam)
            self._first_count = max(self._first_count, found.count)
            overlap = found.count / self._first_count
            changed = self._is_left_behind(found, overlap)
            if changed:
                self._set_keyframe(new, T_world_cam, ref)
            elif self.options.fuse:
                self._reference = self._maker.fused(ref, new, _still(T_world_cam, new.exposure.mid_time))
        else:
            self._lost_in_a_row += 1
            overlap = found.count / max(1, self._first_count)
            changed = self._lost_in_a_row >= _MOST_LOST
            if changed:
                self._set_keyframe(new, self._last, None)
                self._lost_in_a_row = 0
        return FrameReport(
            stamp=stamp, sigma_depth_m=found.sigma, sigma_intensity=float("nan"), inliers_depth=found.count,
            inliers_color=0, iterations=found.evaluations, evaluations=found.evaluations, last_shift_px=found.shift,
            keyframe=changed, lost=not found.is_good, observability=found.observability, overlap=overlap,
        )  # fmt: skip

    def _search(self, new: DepthImage, ref: Reference) -> Alignment:
        """Alignment from the predicted pose or, where that fails, from the keyframe's own."""
        to_base = se3.inverse(ref.T_world_base)
        found = self._align(new, ref, to_base @ self._predict(new.exposure.mid_time))
        if found.is_good:
            return found
        again = self._align(new, ref, np.eye(4))
        return again if again.is_good else found

    def _predict(self, t: float) -> FloatArray:
        """Constant velocity; no motion after a loss, when the velocity is old or is what misled."""
        if self._lost_in_a_row or len(self._poses) < 2:
            return self._last
        T: FloatArray = interpolated(np.array(self._times[-2:]), np.array(self._poses[-2:]), np.array([t]))[0]
        return T

    def _align(self, new: DepthImage, ref: Reference, T_base_cam: FloatArray) -> Alignment:
        """Gauss-Newton from a pose, coarse to fine; a step that makes the image less likely is shortened."""
        camera = self.rig.depth_camera
        sigma, evaluations, shift = _START_DEPTH, 0, np.inf
        for level in reversed(range(len(STRIDES))):
            looked_at = -(-camera.width // STRIDES[level]) * -(-camera.height // STRIDES[level])
            T, least, step = T_base_cam, np.inf, np.zeros(6)
            for _ in range(_MOST_STEPS[level]):
                sums, next_sigma = self._terms.geometric_pose(new, ref, T, level, sigma)
                evaluations += 1
                share, weakest = sums.count / looked_at, observability(sums, ref.lever)
                if share < _LEAST_SHARE or not weakest > 0.0:
                    return Alignment(T, sigma, sums.count, share, evaluations, np.inf, weakest)
                # Negative logarithm of the Student-t likelihood per pixel; the step of σ alone never raises it.
                unlikely = sums.cost / sums.count + np.log(sigma)
                if unlikely > least + _SAME:
                    step = _SHORTEN * step
                else:
                    least, T_base_cam = unlikely, T
                    step = -sigma * np.linalg.solve(sums.H[0, 0], sums.g[0, 0])
                    sigma = next_sigma
                T = se3.orthonormalise(se3.exp(step) @ T_base_cam)
                shift = camera.fx * float(np.abs(step[:3]).max() / ref.lever + np.abs(step[3:]).max())
                if shift < STOP_PX[level]:
                    T_base_cam = T
                    break
        return Alignment(T_base_cam, sigma, sums.count, share, evaluations, shift, weakest)

    def _found(self, stamp: float, new: DepthImage, T_world_cam: FloatArray) -> None:
        self._lost_in_a_row = 0
        self._stamps.append(stamp)
        self._times.append(new.exposure.mid_time)
        self._poses.append(T_world_cam)
        self._last = T_world_cam

    def _is_left_behind(self, found: Alignment, overlap: float) -> bool:
        """The tracker's criterion for a new keyframe."""
        distance = np.linalg.norm(found.T_base_cam[:3, 3])
        angle = np.degrees(np.linalg.norm(se3.log(found.T_base_cam)[3:]))
        options = self.options
        return bool(
            overlap < options.keyframe_overlap
            or distance > options.keyframe_distance
            or angle > options.keyframe_angle_deg
        )

    def _set_keyframe(self, new: DepthImage, T_world_cam: FloatArray, older: Reference | None) -> None:
        motion = _still(T_world_cam, new.exposure.mid_time)
        self._reference = self._maker.rectified(self._fed, new, (), motion, older if self.options.fuse else None)
        self._first_count = 0
        self.keyframes += 1


def interpolated(times: FloatArray, poses: FloatArray, t: FloatArray) -> FloatArray:
    """Poses (m, 4, 4) at times t (m,) on the geodesics between poses (n, 4, 4) at increasing times (n,), n ≥ 1.

    Times before the first pose and after the last lie on the first and the last geodesic.
    """
    if len(times) == 1:
        return np.repeat(poses, len(t), axis=0)
    i = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 2)
    u = (t - times[i]) / (times[i + 1] - times[i])
    twist = se3.log(se3.inverse(poses[i]) @ poses[i + 1])
    return np.asarray(poses[i] @ se3.exp(u[:, None] * twist))


def _still(T_world_cam: FloatArray, t: float) -> Spline:
    """A camera that does not move around time t (s): what a global-shutter image's only line knows of its motion."""
    return Spline(np.repeat(T_world_cam[None], 4, axis=0), t - 0.5, 1.0)
