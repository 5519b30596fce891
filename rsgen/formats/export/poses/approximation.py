"""What an export that has one pose, two poses or a velocity for an image loses against the spline, in pixels.

Scene points from the exact depth are seen by the colour camera where its rolling shutter shows them (equation (3) of
the paper); at the very time of that line, a format's own idea of the pose shows them elsewhere. That distance is the
loss.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsgen.array_types import FloatArray, IntArray
from rsgen.geometry import se3, so3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import project_rolling
from rsgen.sequence.reader import Sequence, Stream

_FRAMES, _ROWS, _COLUMNS = 12, 120, 12  # at most as many of each are looked at


@dataclass(frozen=True)
class Loss:
    """Distances in pixels between where a scene point is seen and where an approximation has it; NaN of no points."""

    median_px: float
    max_px: float

    def __str__(self) -> str:
        return f"{self.median_px:.2g} px median, {self.max_px:.2g} px at most"

    def as_dict(self) -> dict[str, float | None]:
        """For JSON, which has no NaN."""
        values = {"median_px": self.median_px, "max_px": self.max_px}
        return {name: None if np.isnan(value) else value for name, value in values.items()}


@dataclass(frozen=True)
class Sightings:
    """n scene points as colour images show them: p_world (n, 3) m, uv (n, 2) px, t (n,) s of the line, image (n,)."""

    p_world: FloatArray
    uv: FloatArray
    t: FloatArray
    image: IntArray


def blur_centres(stream: Stream) -> FloatArray:
    """Stamps (n,) in s for which `Shutter.line_mid_time` is the middle of each line's own exposure.

    They are the true stamps, but for an automatic camera, whose exposures are not the shutter's.
    """
    if stream.table is None:
        return stream.stamps
    return stream.stamps - 0.5 * (stream.table.exposure_s - stream.shutter.exposure_s)


def exposures(stream: Stream) -> FloatArray:
    """Exposure (n,) in s of each image."""
    return np.full(len(stream.paths), stream.shutter.exposure_s) if stream.table is None else stream.table.exposure_s


def poses_of_line(sequence: Sequence, line: float) -> FloatArray:
    """T_world_color (n, 4, 4) of every colour image at the mid-exposure of `line`, 0 the first that is read."""
    color = sequence.streams["color"]
    times = color.shutter.line_mid_time(blur_centres(color), line, color.camera)
    return np.asarray(sequence.spline.pose(times) @ se3.inverse(sequence.T_color_depth))


def exact_points(sequence: Sequence, k: int, uv: IntArray) -> tuple[FloatArray, IntArray]:
    """Points (m, 3) in the world that depth image k shows at whole pixels (n, 2), and which pixels have one (m,).

    From the exact depth, at the time of each pixel's line. Raises UserError if the depth cannot be read.
    """
    depth = sequence.streams["depth"]
    z = sequence.truth_depth(k)[uv[:, 1], uv[:, 0]]
    seen = np.flatnonzero(z > 0)
    line = depth.shutter.line_of_pixel(uv[seen], depth.camera)
    T_world_depth = sequence.spline.pose(depth.shutter.line_mid_time(blur_centres(depth)[k], line, depth.camera))
    return se3.transform(T_world_depth, depth.camera.backproject(uv[seen], z[seen])), seen


def sightings(sequence: Sequence) -> Sightings:
    """Scene points on lines all over some of the colour images, evenly spread over the sequence. Raises UserError.

    sequence: with the cameras that took it.
    """
    color, depth = sequence.streams["color"], sequence.streams["depth"]
    images = np.unique(np.linspace(0, len(color.paths) - 1, _FRAMES).round().astype(np.int64))
    u, v = (
        np.unique(np.linspace(0, size - 1, count).round().astype(np.int64))
        for size, count in ((depth.camera.width, _COLUMNS), (depth.camera.height, _ROWS))
    )
    grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    found = []
    for k in images:
        nearest = int(np.abs(depth.stamps - color.stamps[k]).argmin())
        p_world, _ = exact_points(sequence, nearest, grid)
        stamp = blur_centres(color)[k]
        uv, t, valid = project_rolling(
            sequence.spline, sequence.T_color_depth, color.camera, color.shutter, stamp, p_world
        )
        found.append((p_world[valid], uv[valid], t[valid], np.full(valid.sum(), k)))
    return Sightings(*(np.concatenate(parts) for parts in zip(*found, strict=True)))


def loss_of_poses(camera: Camera, seen: Sightings, T_world_color: FloatArray) -> Loss:
    """Of an approximation that has the poses T_world_color (n, 4, 4) for the lines of the sightings."""
    uv, _ = camera.project(se3.transform(se3.inverse(T_world_color), seen.p_world))
    return _loss(uv - seen.uv)


def loss_of_image_velocity(
    camera: Camera, seen: Sightings, T_world_color: FloatArray, twist: FloatArray, dt: FloatArray
) -> Loss:
    """Of points that move straight on through the image, as 3dgs-deblur moves its Gaussians.

    T_world_color (n, 4, 4), twist (n, 6): pose and velocity [v; ω] of the camera in its own frame, m/s and rad/s, of
    the image that each sighting is in; dt (n,): time from that pose to the sighting's line, s.
    """
    p_color = se3.transform(se3.inverse(T_world_color), seen.p_world)
    uv, _ = camera.project(p_color)
    p_dot = -(twist[:, :3] + so3.cross(twist[:, 3:], p_color))
    moved = np.einsum("nij,nj->ni", camera.project_jacobian(p_color), p_dot) * dt[:, None]
    return _loss(uv + moved - seen.uv)


def between(T_start: FloatArray, T_end: FloatArray, s: FloatArray) -> FloatArray:
    """Poses (n, 4, 4) at parts s (n,) of the way from T_start to T_end (n, 4, 4): translations straight, slerps.

    So do tf2 and instant-ngp, camera to world, and gsplat (`interpolate_shutter_pose`), world to camera.
    """
    turn = so3.log(np.swapaxes(T_start[:, :3, :3], -1, -2) @ T_end[:, :3, :3])
    T = T_start.copy()
    T[:, :3, :3] = T_start[:, :3, :3] @ so3.exp(s[:, None] * turn)
    T[:, :3, 3] += s[:, None] * (T_end[:, :3, 3] - T_start[:, :3, 3])
    return T


def _loss(error: FloatArray) -> Loss:
    size = np.linalg.norm(error, axis=-1)
    size = size[np.isfinite(size)]
    return Loss(float(np.median(size)), float(size.max())) if size.size else Loss(np.nan, np.nan)
