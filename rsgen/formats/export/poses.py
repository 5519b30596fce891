"""The spline as few poses an image: what that loses in pixels, the shutter as JSON, and a sparse model of the scene.

Loss: scene points from the exact depth are seen by the colour camera where its rolling shutter shows them (equation (3)
of the paper). At the time of that row, the pose that a format has shows them elsewhere. That distance is the loss.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.array_types import ByteArray, FloatArray, IntArray
from rsgen.console.progress import Progress
from rsgen.files import atomic_write
from rsgen.formats.export.shared import nearest_depth
from rsgen.geometry import se3, so3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter, project_rolling
from rsgen.image_codecs import encode_npz
from rsgen.sensors.imu import nanoseconds
from rsgen.sequence.images import ImageStream, Rig, Sequence

PIXEL_SHIFT = 0.5
"""What COLMAP's and nerfstudio's pixel coordinates are larger by: their pixel centres are at halves."""
ONE_POSE = "one pose an image"

_SCANS = {
    "top-bottom": "ROLLING_TOP_TO_BOTTOM",
    "bottom-top": "ROLLING_BOTTOM_TO_TOP",
    "left-right": "ROLLING_LEFT_TO_RIGHT",
    "right-left": "ROLLING_RIGHT_TO_LEFT",
}

_FRAMES, _ROWS, _COLUMNS = 12, 120, 12  # at most as many of each are looked at


@dataclass(frozen=True)
class Loss:
    """Distances in pixels between scene points as images show them and as an approximation has them; NaN of none."""

    median_px: float
    max_px: float

    def __str__(self) -> str:
        return f"{self.median_px:.2g} px median, {self.max_px:.2g} px at most"

    def as_dict(self) -> dict[str, float | None]:
        """For JSON, which has no NaN."""
        values = {"median_px": self.median_px, "max_px": self.max_px}
        return {name: None if np.isnan(value) else value for name, value in values.items()}


@dataclass(frozen=True)
class Observations:
    """n scene points as colour images show them: p_world (n, 3) m, uv (n, 2) px, t (n,) s of the line, image (n,)."""

    p_world: FloatArray
    uv: FloatArray
    t: FloatArray
    image: IntArray


def blur_centres(stream: ImageStream) -> FloatArray:
    """Stamps (n,) in s for which `Shutter.line_mid_time` is the middle of each line's own exposure.

    They are the true stamps, but for an automatic camera, whose exposures are not the shutter's.
    """
    if stream.table is None:
        return stream.stamps
    return stream.stamps - 0.5 * (stream.table.exposure_s - stream.shutter.exposure_s)


def exposures(stream: ImageStream) -> FloatArray:
    """Exposure (n,) in s of each image."""
    return np.full(len(stream.paths), stream.shutter.exposure_s) if stream.table is None else stream.table.exposure_s


def at_line(sequence: Sequence, line: float) -> FloatArray:
    """T_world_color (n, 4, 4) of every colour image at the mid-exposure of `line`, 0 the first that is read."""
    color = sequence.streams["color"]
    times = color.shutter.line_mid_time(blur_centres(color), line, color.camera)
    return np.asarray(sequence.spline.pose(times) @ se3.inverse(sequence.T_color_depth))


def middle_line(sequence: Sequence) -> float:
    """The line half way between the first and the last of a colour image."""
    return 0.5 * (sequence.streams["color"].line_count - 1)


def exact_points(sequence: Sequence, k: int, uv: IntArray) -> tuple[FloatArray, IntArray]:
    """Points (m, 3) in the world that depth image k shows at whole pixels (n, 2), and which pixels have one (m,).

    From the exact depth, at the time of each pixel's line. Raises UserError if the depth cannot be read.
    """
    depth = sequence.streams["depth"]
    z = sequence.truth_depth(k)[uv[:, 1], uv[:, 0]]
    measured = np.flatnonzero(z > 0)
    line = depth.shutter.line_of_pixel(uv[measured], depth.camera)
    T_world_depth = sequence.spline.pose(depth.shutter.line_mid_time(blur_centres(depth)[k], line, depth.camera))
    return se3.transform(T_world_depth, depth.camera.backproject(uv[measured], z[measured])), measured


def observations(sequence: Sequence) -> Observations:
    """Scene points on rows all over some of the colour images, evenly spread over the sequence. Raises UserError.

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
        p_world, _ = exact_points(sequence, nearest_depth(sequence, int(k)), grid)
        stamp = blur_centres(color)[k]
        uv, t, valid = project_rolling(
            sequence.spline, sequence.T_color_depth, color.camera, color.shutter, stamp, p_world
        )
        found.append((p_world[valid], uv[valid], t[valid], np.full(valid.sum(), k)))
    return Observations(*(np.concatenate(parts) for parts in zip(*found, strict=True)))


def loss_of_poses(camera: Camera, observed: Observations, T_world_color: FloatArray) -> Loss:
    """Of an approximation that has the poses T_world_color (n, 4, 4) for the lines of the observations."""
    uv, _ = camera.project(se3.transform(se3.inverse(T_world_color), observed.p_world))
    return _loss(uv - observed.uv)


def loss_of_image_velocity(
    camera: Camera, observed: Observations, T_world_color: FloatArray, twist: FloatArray, dt: FloatArray
) -> Loss:
    """Of points that move straight on through the image, as 3dgs-deblur moves its Gaussians.

    T_world_color (n, 4, 4), twist (n, 6): pose and velocity [v; ω] of the camera in its own frame, m/s and rad/s, of
    the image that each observation is in; dt (n,): time from that pose to the observation's line, s.
    """
    p_color = se3.transform(se3.inverse(T_world_color), observed.p_world)
    uv, _ = camera.project(p_color)
    p_dot = -(twist[:, :3] + so3.cross(twist[:, 3:], p_color))
    moved = np.einsum("nij,nj->ni", camera.project_jacobian(p_color), p_dot) * dt[:, None]
    return _loss(uv + moved - observed.uv)


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


FORMAT = "rsgen-rolling-shutter/1"


def shutter_facts(sequence: Rig, losses: dict[str, Loss]) -> dict[str, Any]:
    """Shutters of all streams, their images' stamps, and what a format's poses lose against the spline, for JSON."""
    return {
        "format": FORMAT,
        "sequence": sequence.name,
        "stamp": "end of the exposure of line 0, the line that is read first",
        "line_window": "line i of n: [stamp + i readout_s / n - exposure_s, stamp + i readout_s / n], seconds",
        "pose_of_line": "at the middle of its window",
        "line_of_pixel": "top-bottom: i = v; bottom-top: i = n - 1 - v; left-right: i = u; right-left: i = n - 1 - u",
        "streams": {name: _stream_facts(stream) for name, stream in sequence.streams.items()},
        **_extrinsics(sequence),
        "loss_px": {name: loss.as_dict() for name, loss in losses.items()},
    }


def _extrinsics(sequence: Rig) -> dict[str, Any]:
    if isinstance(sequence, Sequence):
        return {"T_color_depth": sequence.T_color_depth.tolist()}
    return {"T_cam_body": {name: stream.T_cam_body.tolist() for name, stream in sequence.streams.items()}}


def shutter_type(shutter: Shutter) -> str:
    """What gsplat and NCore call a shutter."""
    return _SCANS[shutter.scan] if shutter.readout_s else "GLOBAL"


def write_shutter_files(sequence: Sequence, out: Path, losses: dict[str, Loss]) -> None:
    """Write rolling_shutter.json and spline.npz, from which every line's pose follows. Raises UserError."""
    atomic_write(out / "rolling_shutter.json", json.dumps(shutter_facts(sequence, losses), indent=1).encode())
    atomic_write(out / "spline.npz", encode_npz(sequence.spline.arrays()))


def _stream_facts(stream: ImageStream) -> dict[str, Any]:
    facts: dict[str, Any] = {
        "readout_s": stream.shutter.readout_s,
        "exposure_s": stream.shutter.exposure_s,
        "scan": stream.shutter.scan,
        "lines": stream.line_count,
        "line_delay_s": stream.shutter.line_delay(stream.camera),
        "rate_hz": stream.rate_hz,
        "offset_s": stream.offset_s,
        "size": [stream.camera.width, stream.camera.height],
        "intrinsics": [stream.camera.fx, stream.camera.fy, stream.camera.cx, stream.camera.cy],
        "model": stream.camera.model,
        "distortion": list(stream.camera.distortion),
    }
    if stream.registered:
        facts["registered"] = "images are warped into the colour camera; size, intrinsics and lines are the sensor's"
    if stream.depth_scale:
        facts["depth_scale"] = stream.depth_scale
    if stream.table is not None:
        facts["listed_ns"] = nanoseconds(stream.listed)
        facts["true_ns"] = nanoseconds(stream.stamps)
        facts["exposures_s"] = exposures(stream).tolist()
    return facts


def loss_words(losses: dict[str, Loss]) -> str:
    """The losses as the end of the line that an export prints; none are stated of a rig."""
    if not losses:
        return "poses of the spline"
    return "against the spline: " + "; ".join(f"{name} {loss}" for name, loss in losses.items())


_SEED_FRAMES, _SEED_COLUMNS, _SEED_ROWS = 25, 16, 12  # depth images that points are taken from, and their grid
_DEPTH_SHARE = 0.01  # by how much a point's depth may differ from what the depth image shows there


@dataclass(frozen=True)
class SurfacePoints:
    """m points: p_world (m, 3) m, color (m, 3) sRGB. Of each of n images: which points it shows, and where.

    shown[k] (s,): numbers of points in colour image k; uv[k] (s, 2): their pixels, with its rolling shutter.
    """

    p_world: FloatArray
    color: ByteArray
    shown: tuple[IntArray, ...]
    uv: tuple[FloatArray, ...]


def surface_points(sequence: Sequence, progress: Progress) -> SurfacePoints:
    """Points from the exact depth of some depth images, each in one colour image or more. Raises UserError.

    A point is visible if the depth image that is nearest in time shows it at its depth. Its colour is that of the first
    image that shows it. sequence: with the cameras that took it.
    """
    color = sequence.streams["color"]
    p_world = _seeds(sequence)
    shown, uvs = [], []
    colors, colored = np.zeros((len(p_world), 3), np.uint8), np.zeros(len(p_world), bool)
    for k, stamp in enumerate(blur_centres(color)):
        near = _visible_in_depth(sequence, nearest_depth(sequence, k), p_world)
        uv, _, valid = project_rolling(
            sequence.spline, sequence.T_color_depth, color.camera, color.shutter, stamp, p_world[near]
        )
        which, uv = near[valid], uv[valid]
        shown.append(which)
        uvs.append(uv)
        new = ~colored[which]
        if new.any():
            u, v = np.rint(uv[new]).astype(np.int64).T
            colors[which[new]] = sequence.color(k)[
                np.clip(v, 0, color.camera.height - 1), np.clip(u, 0, color.camera.width - 1)
            ]
            colored[which] = True
        progress("export", (k + 1) / len(color.paths), color.paths[k].name)
    number = np.cumsum(colored) - 1
    return SurfacePoints(p_world[colored], colors[colored], tuple(number[which] for which in shown), tuple(uvs))


def _seeds(sequence: Sequence) -> FloatArray:
    depth = sequence.streams["depth"]
    frames = np.unique(np.linspace(0, len(depth.paths) - 1, _SEED_FRAMES).round().astype(np.int64))
    u, v = (
        np.unique((size * (np.arange(count) + 0.5) / count).astype(np.int64))
        for size, count in ((depth.camera.width, _SEED_COLUMNS), (depth.camera.height, _SEED_ROWS))
    )
    grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    return np.concatenate([exact_points(sequence, int(k), grid)[0] for k in frames])


def _visible_in_depth(sequence: Sequence, k: int, p_world: FloatArray) -> IntArray:
    """Numbers (s,) of the points (m, 3) that lie on the surface that depth image k shows."""
    depth = sequence.streams["depth"]
    uv, t, valid = project_rolling(
        sequence.spline, np.eye(4), depth.camera, depth.shutter, blur_centres(depth)[k], p_world
    )
    which = np.flatnonzero(valid)
    z = se3.transform(se3.inverse(sequence.spline.pose(t[which])), p_world[which])[:, 2]
    u, v = np.rint(uv[which]).astype(np.int64).T
    image = sequence.truth_depth(k)
    on = image[np.clip(v, 0, image.shape[0] - 1), np.clip(u, 0, image.shape[1] - 1)]
    return which[np.abs(z - on) < _DEPTH_SHARE * z]
