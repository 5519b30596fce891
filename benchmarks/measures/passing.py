"""A thing that passes before the camera: a textured ball put into the images of a recording, line by line."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rsgen.array_types import ByteArray, Float32Array, FloatArray
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.spline import Spline
from rsgen.sequence.trajectory import Trajectory
from rstrack.bench.changes import with_color, with_depth
from rstrack.data.dataset import Dataset
from rstrack.metrics.association import truth_of

# Part of the picture that the ball fills where it is nearest to the middle, and of the way to what is seen there.
_SHARE, _NEARNESS = 0.2, 0.5
# Waves of its texture, the scatter of their frequencies along an axis (rad over its radius), and their grey levels.
_WAVES, _FREQUENCY, _CONTRAST = 10, 8.0, 20.0
# Metres, and part of the depth, by which the room has to lie before it to hide it from a colour camera beside.
_BEFORE_M, _BEFORE_PART = 0.02, 0.03


def passed_by(dataset: Dataset, first: int, count: int, seed: int) -> Dataset:
    """A ball of the seed's texture passes through the picture in frames [first, first + count).

    It goes from outside the first of them to outside the last of them, straight and at one speed in the world, half as
    far away as what is seen there, and fills a fifth of the picture in its middle. Each pixel shows it at its own
    line's mid-exposure, sharp, without noise; what is nearer hides it, which for colours is asked of the frame's depth
    image. A single frame shows it in the middle, at rest. Raises UserError: no true poses there.
    """
    rig, truth, stamps = dataset.rig, truth_of(dataset), dataset.stamps
    camera, rng = rig.depth_camera, np.random.default_rng(seed)
    begin, end = float(stamps[first]), float(stamps[first + count - 1])
    if truth is None:
        raise UserError(f"{dataset.name}: has no true poses, by which a thing could pass before the camera")
    z = dataset.depth(first + count // 2)
    distance = _NEARNESS * float(np.median(z[z > 0])) if (z > 0).any() else 1.0
    tangent = np.sqrt(_SHARE * camera.width * camera.height / (np.pi * camera.fx * camera.fy))
    radius = distance * np.sin(np.arctan(tangent))  # its outline is where rays touch it
    angle = rng.uniform(0.0, 2.0 * np.pi)
    # From the middle to a corner of the picture, in any direction, and as far again as it reaches.
    half = distance * 0.5 * np.array([camera.width / camera.fx, camera.height / camera.fy])
    across = np.array([np.cos(angle), np.sin(angle)]) * (np.hypot(*half) + 1.2 * radius)
    ends = [_poses(truth.motion, np.array([t]))[0] @ np.array([*side, distance, 1.0])
            for t, side in ((begin, -across), (end, across))]  # fmt: skip
    velocity = (ends[1] - ends[0])[:3] / (end - begin) if count > 1 else np.zeros(3)
    middle = 0.5 * (ends[0] + ends[1])[:3]
    waves = rng.normal(0.0, _FREQUENCY / radius, (3, _WAVES)), rng.uniform(0.0, 2.0 * np.pi, (_WAVES, 3))

    def ball(shot: Camera, shutter: Shutter, stamp: float, T_cam_depth: FloatArray) -> tuple[FloatArray, FloatArray]:
        """z (h, w), m, infinite where it is not, and the points seen (h, w, 3), from its middle."""
        lines = shutter.line_of_pixel(shot.pixel_grid(), shot)
        times = shutter.line_mid_time(stamp, np.arange(shutter.line_count(shot)), shot)
        line = np.rint(lines).astype(int)
        T = (_poses(truth.motion, times) @ se3.inverse(T_cam_depth))[line]
        d = np.einsum("...ij,...j->...i", T[..., :3, :3], shot.unproject(shot.pixel_grid()))
        to_ball = middle + velocity * (times[line] - 0.5 * (begin + end))[..., None] - T[..., :3, 3]
        a, b = (d**2).sum(-1), (d * to_ball).sum(-1)
        under = b**2 - a * ((to_ball**2).sum(-1) - radius**2)
        near = (b - np.sqrt(np.maximum(under, 0.0))) / a
        seen = np.where((under > 0.0) & (near > 0.0), near, np.inf)
        return seen, np.where(np.isfinite(seen), near, 0.0)[..., None] * d - to_ball

    def shown_depth(k: int, pixels: Float32Array) -> Float32Array:
        if not first <= k < first + count:
            return pixels
        seen, _ = ball(camera, rig.depth_shutter, float(stamps[k]), np.eye(4))
        return np.where(np.isfinite(seen) & ((pixels <= 0) | (seen < pixels)), seen, pixels).astype(np.float32)

    frame_of = {i: k for k in range(first, first + count) for i in dataset.groups[k]}

    def shown_color(i: int, pixels: ByteArray) -> ByteArray:
        if i not in frame_of:
            return pixels
        k, T_cd, stamp = frame_of[i], rig.T_color_depth, float(dataset.color_stamps[i])
        seen, point = ball(rig.color_camera, rig.color_shutter, stamp, T_cd)
        shown = np.isfinite(seen)
        q = rig.color_camera.unproject(rig.color_camera.pixel_grid())[shown] * seen[shown][:, None]
        shown[shown] = ~_is_hidden(dataset.depth(k), camera, se3.transform(se3.inverse(T_cd), q))
        grey = 128.0 + _CONTRAST * np.sin((point[shown] @ waves[0])[..., None] + waves[1]).sum(axis=-2)
        out = pixels.copy()
        out[shown] = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
        return out

    return with_color(with_depth(dataset, shown_depth), shown_color)


def _poses(motion: Spline | Trajectory, times: FloatArray) -> FloatArray:
    """T_world_depth (n, 4, 4) at times (n,), s, between poses on SE(3). Raises UserError: before the first or after the
    last of them."""
    span = (motion.t_begin, motion.t_end) if isinstance(motion, Spline) else motion.stamps[[0, -1]]
    if times.min() < span[0] or times.max() > span[1]:
        raise UserError(f"a thing that passes needs true poses from {times.min():.3f} to {times.max():.3f} s")
    if isinstance(motion, Spline):
        return motion.pose(times)
    return se3.interpolated(motion.stamps, motion.T_world_cam, times)


def _is_hidden(z: Float32Array, camera: Camera, p: FloatArray) -> npt.NDArray[np.bool_]:
    """Which points (n, 3) of the depth camera's frame lie behind what its image (h, w) shows there."""
    uv, valid = camera.project(p)
    inside = valid & camera.contains(uv)
    column, row = (np.rint(np.where(inside, uv[:, i], 0.0)).astype(int) for i in (0, 1))
    before = z[row, column]
    return np.asarray(inside & (before > 0) & (p[:, 2] > before * (1.0 + _BEFORE_PART) + _BEFORE_M))
