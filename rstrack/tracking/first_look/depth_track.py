"""T_world_depth(t) over some seconds from depth images alone: OpenCV's odometry, and a spline through its poses.

The odometry (point to plane, coarse to fine) takes all lines of an image for seen at once, which shifts the motion in
time by as much as the lines that have depth lie off the middle of the image: 8 ms in fr3_teddy. So it is asked twice:
the second time each image is what it would have been at its middle, by the motion that was found the first time.

It is rough and knows no covariances, but takes some milliseconds a frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import cv2
import numpy as np

from rsgen.array_types import Float32Array, FloatArray
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.spline import Spline
from rstrack.data.dataset import Dataset
from rstrack.options import Options

# Depth images are thinned out to about so many pixels across: of 320 the odometry makes the same in three times the
# time.
_ACROSS = 160
# Frames in a row that are a track.
_FEWEST = 4
# Rounds of correction of a spline that is to pass through poses.
_ROUNDS = 6


@dataclass(frozen=True)
class DepthTrack:
    """T_world_depth(t) of frames from depth alone, and the time (begin, end) in s that it covers.

    halves: colour images that have been looked at along it, see `rstrack.tracking.first_look.lookup.image_of`.
    """

    frames: range
    spline: Spline
    begin: float
    end: float
    halves: dict[int, Float32Array] = field(default_factory=dict, repr=False)


def depth_track(dataset: Dataset, frames: range, done: Callable[[float], None]) -> DepthTrack | None:
    """The track of the most frames in a row that the odometry can follow; None where it can follow none.

    done: called with what part (0 to 1) of the work is done.
    """
    odometry = _Odometry(dataset, frames[0])
    images, steps = [], []
    for n, k in enumerate(frames, 1):
        images.append(odometry.image(k))
        steps.append(odometry.aligned(images[-1], images[-2]) if n > 1 else None)
        done(n / len(frames))
    run = max(_runs(steps), key=len)
    if len(run) < _FEWEST:
        return None
    poses = np.array([np.eye(4)])
    for n in run[1:]:
        poses = np.concatenate([poses, poses[-1:] @ steps[n]])
    used = frames[run.start : run.stop]
    rough = odometry.spline(used, poses)
    still = [odometry.at_middle(image, k, rough) for image, k in zip(images[run.start : run.stop], used, strict=True)]
    spline = odometry.spline(used, odometry.by_keyframes(still, poses))
    times = odometry.times(used)
    return DepthTrack(used, spline, float(times[0]), float(times[-1]))


def _runs(steps: Sequence[FloatArray | None]) -> list[range]:
    """Images in a row that are each aligned to the one before; the first step leads from nowhere."""
    starts = [n for n, step in enumerate(steps) if step is None]
    return [range(a, b) for a, b in pairwise([*starts, len(steps)])]


def through(poses: FloatArray, t0: float, dt: float) -> Spline:
    """The spline that passes at its knots through poses (n, 4, 4), but for the first and the last.

    Cubic B-splines blur a little what their control points are laid through: a few rounds of correction.
    """
    wanted = se3.orthonormalise(poses)
    points = wanted
    knots = t0 + (np.arange(len(poses))[1:-1] - 1) * dt
    for _ in range(_ROUNDS):
        off = se3.log(wanted[1:-1] @ se3.inverse(Spline(points, t0, dt).pose(knots)))
        points = np.concatenate([wanted[:1], se3.orthonormalise(se3.exp(off) @ points[1:-1]), wanted[-1:]])
    return Spline(points, t0, dt)


class _Odometry:
    """Aligns depth images of a dataset, which it sees through a pinhole and thinned out."""

    def __init__(self, dataset: Dataset, first: int) -> None:
        self._dataset, camera = dataset, dataset.rig.depth_camera
        step = max(camera.width // _ACROSS, 1)
        self._camera = replace(thinned(camera, step), model="pinhole", distortion=())
        self._grid = self._camera.pixel_grid()
        self._rays = self._camera.unproject(self._grid)
        # Where a pixel is in the image on disk, and in which line.
        uv, _ = camera.project(self._rays)
        self._on_disk = np.nan_to_num(uv, nan=-1.0).astype(np.float32)
        last = dataset.rig.depth_shutter.line_count(camera) - 1
        self._lines = np.clip(np.rint(np.nan_to_num(dataset.rig.depth_shutter.line_of_pixel(uv, camera))), 0, last)
        z = self._read(first)
        settings = cv2.OdometrySettings()
        settings.setCameraMatrix(self._camera.K.astype(np.float32))
        # All points count alike there: farther ones have four times the noise of the median one, or more.
        settings.setMaxDepth(2.0 * float(np.median(z[z > 0.0])) if (z > 0.0).any() else Options().max_depth)
        settings.setMaxPointsPart(1.0)  # all: they are few
        self._farthest = 0.5 * settings.getMaxTranslation(), np.radians(0.5 * settings.getMaxRotation())
        self._odometry = cv2.Odometry(cv2.ODOMETRY_TYPE_DEPTH, settings, cv2.ODOMETRY_ALGO_TYPE_COMMON)

    def image(self, k: int) -> cv2.OdometryFrame | None:
        """Frame k's depth as the odometry sees it; None where it cannot be read."""
        z = self._read(k)
        return self._prepared(z) if (z > 0.0).any() else None

    def _read(self, k: int) -> Float32Array:
        """Planar z (h, w) in m, 0 where there is none, or it cannot be read."""
        u, v = self._on_disk[..., 0], self._on_disk[..., 1]
        try:
            z = self._dataset.depth(k)
        except UserError:
            return np.zeros(u.shape, np.float32)
        # Without a border of its own depth would go on beyond the image.
        return np.asarray(cv2.remap(z, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0.0))

    def at_middle(self, image: cv2.OdometryFrame | None, k: int, spline: Spline) -> cv2.OdometryFrame | None:
        """Frame k's image as it would be at the middle line's time. Points move by a few pixels, and neighbours alike,
        so that the flow away from a pixel stands for that towards it."""
        if image is None:
            return None
        z = np.asarray(image.getDepth(), np.float64)
        rig = self._dataset.rig
        lines = np.arange(rig.depth_shutter.line_count(rig.depth_camera))
        times = rig.depth_shutter.line_mid_time(self._dataset.stamps[k], lines, rig.depth_camera)
        T_world_line = spline.pose(np.clip(times, spline.t_begin, spline.t_end))
        T_middle_line = se3.inverse(spline.pose(self.times(range(k, k + 1)))) @ T_world_line
        p = se3.transform(T_middle_line[self._lines.astype(np.int64)], self._rays * z[..., None])
        uv, _ = self._camera.project(p)
        u, v = np.nan_to_num(2.0 * self._grid - uv, nan=-1.0).astype(np.float32).transpose(2, 0, 1)
        border = cv2.BORDER_CONSTANT
        moved = cv2.remap(
            p[..., 2].astype(np.float32), u, v, cv2.INTER_LINEAR, borderMode=border, borderValue=float("nan")
        )
        return self._prepared(np.asarray(moved, np.float32))

    def _prepared(self, z: Float32Array) -> cv2.OdometryFrame:
        frame = cv2.OdometryFrame(np.where(z > 0.0, z, np.float32(np.nan)))
        self._odometry.prepareFrame(frame)
        return frame

    def aligned(self, new: cv2.OdometryFrame | None, old: cv2.OdometryFrame | None) -> FloatArray | None:
        """T_old_new (4, 4); None where it is not found."""
        if new is None or old is None:
            return None
        found, T_old_new = self._odometry.compute(new, old)
        return np.asarray(T_old_new, np.float64) if found else None

    def by_keyframes(self, images: Sequence[cv2.OdometryFrame | None], poses: FloatArray) -> FloatArray:
        """Poses (n, 4, 4) like these, but each image aligned to an earlier one, as far back as half of what the
        odometry aligns: errors add up from image to image."""
        found, key = poses[:1], 0
        for n in range(1, len(images)):
            if self._is_far(se3.inverse(poses[key]) @ poses[n]):
                key = n - 1
            T_key_new = self.aligned(images[n], images[key])
            step = se3.inverse(poses[key]) @ poses[n] if T_key_new is None else T_key_new
            found = np.concatenate([found, found[[key]] @ step])
        return found

    def _is_far(self, T: FloatArray) -> bool:
        distance, angle = np.linalg.norm(T[:3, 3]), np.linalg.norm(se3.log(T)[3:])
        return bool(distance > self._farthest[0] or angle > self._farthest[1])

    def times(self, frames: range) -> FloatArray:
        """Seconds (n,) at which the middle lines of frames are exposed."""
        rig = self._dataset.rig
        middle = 0.5 * (rig.depth_shutter.line_count(rig.depth_camera) - 1)
        return rig.depth_shutter.line_mid_time(self._dataset.stamps[frames], middle, rig.depth_camera)

    def spline(self, frames: range, poses: FloatArray) -> Spline:
        """Through poses (n, 4, 4) of frames at their middle lines, with knots as far apart as frames are."""
        times = self.times(frames)
        dt = float(np.median(np.diff(times)))
        t0 = float(times[0]) - dt
        knots = np.asarray(t0 + (np.arange(int(np.ceil((times[-1] - t0) / dt)) + 4) - 1) * dt, np.float64)
        return through(se3.interpolated(times, poses, knots), t0, dt)


def thinned(camera: Camera, step: int) -> Camera:
    """The camera whose pixels are every step-th of a camera's, from the first."""
    fx, fy, cx, cy = (value / step for value in (camera.fx, camera.fy, camera.cx, camera.cy))
    width, height = -(-camera.width // step), -(-camera.height // step)
    return replace(camera, width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)
