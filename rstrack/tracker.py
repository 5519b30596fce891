"""The online tracker (paper, section 3.5): grow the spline, align, freeze, choose keyframes.

tracker = Tracker(rig, Options())
for frame in frames:
    tracker.feed(frame)
stamps, T_world_depth = tracker.trajectory
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from rsgen.geometry import se3
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.so3 import FloatArray
from rsgen.geometry.spline import Spline
from rstrack.engine import engine
from rstrack.frames import ColorImage, DepthImage, camera_rays, color_image, depth_image
from rstrack.keyframe import KeyframeMaker
from rstrack.lines import Exposure
from rstrack.normal_equations import acceleration_prior, pose_constraint
from rstrack.optimizer import Extra, Observation, Problem, Solved, SplineState, optimise
from rstrack.options import Options
from rstrack.reference import Reference
from rstrack.rig import Frame, Image, Rig
from rstrack.terms import Terms
from rstrack.warp import Lens

# Motion prior: standard deviation of accelerations, m/s² and rad/s². Hand-held cameras reach 35 m/s² (DESIGN section
# 5), so it says little where there are data, and holds the newest control points, whose weight is only u³/6.
import os
PRIOR_ACCELERATION = float(os.environ.get('PA','5'))*np.array([1.0,1,1,2,2,2])
NEWEST = float(os.environ.get('NEWEST','0.1'))
# Metres and radians within which the reference's pose is held while its own control points are free.
_GAUGE = np.full(6, 1e-6)
# Steps at most on the pyramid's levels, finest first.
_MOST_STEPS = (15, 8, 8)
_LEVELS = (2, 1, 0)


@dataclass(frozen=True)
class Prepared:
    """A frame on the device."""

    index: int
    depth: DepthImage
    colors: tuple[ColorImage, ...]

    @property
    def exposures(self) -> list[Exposure]:
        """Of all its images."""
        return [self.depth.exposure, *(c.exposure for c in self.colors)]

    @property
    def first_time(self) -> float:
        """Time in s of its first line."""
        return min(x.first_time for x in self.exposures)

    @property
    def last_time(self) -> float:
        """Time in s of its last line."""
        return max(x.last_time for x in self.exposures)


@dataclass(frozen=True)
class FrameReport:
    """Diagnostics of one frame: scales in m and intensity, pixels used, steps, keyframe."""

    stamp: float
    sigma_depth_m: float
    sigma_intensity: float
    inliers_depth: int
    inliers_color: int
    iterations: int
    evaluations: int
    last_shift_px: float
    keyframe: bool
    lost: bool
    observability: float
    overlap: float


class Tracker:
    """Estimates T_world_depth(t); the world is the depth camera's frame at the middle of the first image."""

    def __init__(self, rig: Rig, options: Options | None = None) -> None:
        self.rig, self.options = rig, options or Options()
        self._e = engine(self.options.backend)
        rolling = self.options.rolling
        self._depth_lens = Lens(rig.depth_camera, _seen_as(rig.depth_shutter, rolling))
        self._color_lens = Lens(rig.color_camera, _seen_as(rig.color_shutter, rolling))
        rays = camera_rays(Exposure(self._depth_lens, 0.0, np.eye(4)))
        device_rays = self._e.upload(rays[..., 0]), self._e.upload(rays[..., 1])
        self._terms = Terms(self._e, device_rays)
        self._maker = KeyframeMaker(self._e, rays, device_rays)
        self._state: SplineState | None = None
        self._reference: Reference | None = None
        self._recent: deque[Prepared] = deque()
        self._active: list[Observation] = []
        self._first_count = 0
        self._stamps: list[float] = []
        self.reports: list[FrameReport] = []
        self.keyframes = 0

    # -- what it has found ------------------------------------------------------------------------------------------

    @property
    def spline(self) -> Spline:
        """T_world_depth(t) so far; the newest few control points still move."""
        assert self._state is not None
        return self._state.spline

    @property
    def trajectory(self) -> tuple[FloatArray, FloatArray]:
        """Stamps (n,) of the frames and T_world_depth (n, 4, 4) there."""
        stamps = np.array(self._stamps)
        return stamps, self.spline.pose(np.maximum(stamps, self.spline.t_begin))

    # -- the loop ---------------------------------------------------------------------------------------------------

    def feed(self, frame: Frame) -> FrameReport:
        """Track one frame."""
        new = self._prepare(frame)
        self._stamps.append(frame.depth.stamp)
        if self._state is None:
            report = self._start(new)
        elif self._reference is not None and self._reference.rolling is not None:
            report = self._bootstrap(new)
        else:
            report = self._track(new)
        self.reports.append(report)
        return report

    def _prepare(self, frame: Frame) -> Prepared:
        depth = self._exposure(frame.depth, self._depth_lens, self.rig.depth_shutter, np.eye(4))
        z = depth_image(self._e, depth, frame.depth.pixels, self.options.max_depth)
        colors = []
        if self.options.photometric:
            for image in frame.colors:
                exposure = self._exposure(image, self._color_lens, self.rig.color_shutter, self.rig.T_color_depth)
                colors.append(color_image(self._e, exposure, image.pixels))
        return Prepared(len(self._stamps), z, tuple(colors))

    @staticmethod
    def _exposure(image: Image, lens: Lens, true: Shutter, T_cam_body: FloatArray) -> Exposure:
        """Seen as a global shutter, an image has the time of its middle line: the best that such a model can do."""
        lines = true.line_count(lens.camera)
        middle = 0.0 if lens.lines > 1 else 0.5 * (lines - 1) * true.line_delay(lens.camera)
        return Exposure(lens, image.stamp + middle, T_cam_body)

    def _start(self, new: Prepared) -> FrameReport:
        dt = self.options.knot_spacing_s
        t0 = min(new.first_time, self._stamps[0]) - self.options.knot_phase * dt
        self._state = SplineState(t0, dt, np.eye(4), 4)
        self._state.extend(new.last_time)
        self._recent.append(new)
        self._reference = self._maker.rolling(new.index, new.depth, new.colors, self._state.spline)
        if self._reference.rolling is None:
            self._reference = self._maker.rectified(new.index, new.depth, new.colors, self._state.spline, None)
        return self._report(new.depth.exposure.stamp, [], Solved(), True)

    def _bootstrap(self, new: Prepared) -> FrameReport:
        """Joint alignment of the first frames with the first one, all of them rolling, from zero motion."""
        assert self._state is not None and self._reference is not None
        state, ref = self._state, self._reference
        state.extend(new.last_time)
        fresh = self._observe(new, ref)
        free = (0, len(state.points))
        extras = [self._prior(free), lambda spline: pose_constraint(spline, ref.t, ref.T_world_base, _GAUGE)]
        solved = self._optimise(fresh, self._active, free, extras, 6 * free[1])
        self._active += fresh
        self._recent.append(new)
        if len(self._recent) < self.options.bootstrap_frames:
            return self._report(new.depth.exposure.stamp, fresh, solved, False)
        self._leave_bootstrap()
        return self._report(new.depth.exposure.stamp, fresh, solved, True)

    def _leave_bootstrap(self) -> None:
        """Rectify the middle frame and align all others to it."""
        assert self._state is not None
        state = self._state
        middle = self._recent[len(self._recent) // 2]
        ref = self._maker.rectified(middle.index, middle.depth, middle.colors, state.spline, None)
        others = [o for frame in self._recent if frame is not middle for o in self._observe(frame, ref)]
        free = (0, len(state.points))
        self._optimise(others, [], free, [self._prior(free)], 24, levels=(0,))
        self._set_reference(ref, others)

    def _set_reference(self, ref: Reference, active: list[Observation]) -> None:
        self._reference, self._active, self._first_count = ref, active, 0
        self.keyframes += 1

    def _track(self, new: Prepared) -> FrameReport:
        assert self._state is not None and self._reference is not None
        state, ref = self._state, self._reference
        state.extend(new.last_time)
        free = (max(0, state.segment(new.first_time)), len(state.points))
        self._active = [o for o in self._active if o.lin is None or o.lin.model.last > free[0]]
        fresh = self._observe(new, ref)
        solved = self._optimise(fresh, self._active, free, [self._prior(free)], 24)
        self._active += fresh
        self._recent.append(new)
        overlap = self._overlap(fresh)
        changed = self._maybe_new_keyframe(free[0], overlap)
        return self._report(new.depth.exposure.stamp, fresh, solved, changed, overlap)

    # -- pieces -----------------------------------------------------------------------------------------------------

    def _observe(self, frame: Prepared, ref: Reference) -> list[Observation]:
        depth = [Observation(frame.index, frame.depth, ref)] if self.options.geometric else []
        color = [Observation(frame.index, c, ref) for c in frame.colors] if ref.points else []
        return depth + color

    def _prior(self, free: tuple[int, int]) -> Extra:
        sigma = PRIOR_ACCELERATION * self.options.knot_spacing_s**2
        first, last = max(0, free[0] - 2), free[1]
        sigmas = np.repeat(sigma[None], last - first - 2, axis=0)
        sigmas[-2:] *= NEWEST
        return lambda spline: acceleration_prior(spline, first, last, sigmas)

    def _optimise(
        self, fresh: list[Observation], settled: list[Observation], free: tuple[int, int], extras: list[Extra],
        bandwidth: int, levels: tuple[int, ...] = _LEVELS,
    ) -> Solved:  # fmt: skip
        assert self._state is not None
        problem = Problem(fresh, settled, free, extras, self.rig.depth_camera.fx, bandwidth)
        return optimise(self._terms, self._state, problem, levels, _MOST_STEPS)

    def _overlap(self, fresh: list[Observation]) -> float:
        first = next((o for o in fresh if o.lin is not None), None)
        if first is None or first.lin is None:
            return 0.0
        self._first_count = max(self._first_count, first.lin.count)
        return first.lin.count / max(1, self._first_count)

    def _maybe_new_keyframe(self, first_free: int, overlap: float) -> bool:
        """Promote the newest frame whose control points are all frozen, once the keyframe is left behind."""
        assert self._state is not None and self._reference is not None
        state, ref, options = self._state, self._reference, self.options
        frozen = [f for f in self._recent if state.segment(f.last_time) + 4 <= first_free]
        while len(frozen) > 1:
            # Only the newest frozen frame is ever promoted; older ones have been fused.
            done = frozen.pop(0)
            self._recent.popleft()
            if options.fuse and done.index > ref.index:
                self._reference = ref = self._maker.fused(ref, done.depth, state.spline)
        T = se3.inverse(ref.T_world_base) @ state.spline.pose(self._recent[-1].depth.exposure.mid_time)
        angle = np.degrees(np.linalg.norm(se3.log(T)[3:]))
        far = np.linalg.norm(T[:3, 3]) > options.keyframe_distance or angle > options.keyframe_angle_deg
        if not frozen or frozen[-1].index <= ref.index or not (overlap < options.keyframe_overlap or far):
            return False
        best = frozen[-1]
        made = self._maker.rectified(best.index, best.depth, best.colors, state.spline, ref if options.fuse else None)
        self._set_reference(made, self._active)
        return True

    def _report(
        self, stamp: float, fresh: list[Observation], solved: Solved, keyframe: bool, overlap: float = 1.0
    ) -> FrameReport:
        depth = [o.lin for o in fresh if o.is_depth and o.lin is not None]
        color = [o.lin for o in fresh if not o.is_depth and o.lin is not None]
        weakest = min((lin.observability for lin in depth), default=0.0)
        return FrameReport(
            stamp, depth[0].next_sigma if depth else float("nan"), color[0].next_sigma if color else float("nan"),
            sum(lin.count for lin in depth), sum(lin.count for lin in color), solved.iterations, solved.evaluations,
            solved.last_shift, keyframe, False, weakest, overlap,
        )  # fmt: skip


def _seen_as(shutter: Shutter, rolling: bool) -> Shutter:
    return shutter if rolling else Shutter(0.0, shutter.exposure_s, shutter.scan)
