"""A small exact sequence without a renderer: the inside of a box with a ball in it, ray-cast in NumPy line by line.

root = make_sequence(tmp_path / "seq", make_config(depth={"readout_s": 0.02}), frames=6)
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh

from rsgen.array_types import FloatArray
from rsgen.config.config import Config
from rsgen.files import atomic_write
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.spline import Spline
from rsgen.produce.writer import SequenceWriter
from rsgen.sequence.format import stream_stamps

BOX = np.array([[-2.0, -1.2, -1.5], [2.2, 1.3, 2.5]])  # lower and upper corner, m
BALL, BALL_RADIUS = np.array([0.35, 0.25, 1.5]), 0.35
T_COLOR_DEPTH = se3.exp(np.array([-0.05, 0.004, 0.002, 0.01, -0.02, 0.015]))
DURATION_S = 1.0
RATE_HZ = 30.0


def make_spline(speed: float = 1.0) -> Spline:
    """T_world_depth over [-0.2, 1.3] s: about speed · 0.9 m/s and speed · 1 rad/s, with changing directions."""
    dt, t0 = 0.05, -0.2
    t = t0 + dt * (np.arange(33) - 1.0)
    xi = np.stack(
        [
            0.35 * np.sin(1.9 * t * speed),
            0.12 * np.cos(2.6 * t * speed),
            0.7 * t * speed - 0.4,
            0.25 * np.sin(3.1 * t * speed),
            0.6 * np.sin(1.4 * t * speed + 0.4),
            0.2 * np.cos(2.2 * t * speed),
        ],
        axis=-1,
    )
    return Spline(se3.exp(xi), t0, dt)


def make_config(
    width: int = 64, height: int = 48, color: dict[str, Any] | None = None, depth: dict[str, Any] | None = None
) -> Config:
    """Config of the sequence; `color` and `depth` override fields of the streams."""
    f = 0.75 * width
    camera = {"width": width, "height": height, "intrinsics": [f, f, (width - 1) / 2, (height - 1) / 2]}
    return Config.model_validate(
        {
            "name": "synthetic",
            "trajectory": {"file": "motion.txt"},
            "scene": {"file": "box.ply"},
            "color": camera | {"rate_hz": RATE_HZ, "readout_s": 0.028} | (color or {}),
            "depth": camera | {"rate_hz": RATE_HZ, "readout_s": 0.028} | (depth or {}),
            "T_color_depth": T_COLOR_DEPTH.tolist(),
        }
    )


def cast(p_world: FloatArray, d_world: FloatArray) -> FloatArray:
    """Ray parameters (...,) of the first hit from points inside the box (..., 3) along directions (..., 3)."""
    with np.errstate(divide="ignore"):
        box = np.max((BOX[:, *([None] * (p_world.ndim - 1))] - p_world) / d_world, axis=0).min(axis=-1)
    to_ball = BALL - p_world
    a, b = (d_world**2).sum(-1), (d_world * to_ball).sum(-1)
    discriminant = b**2 - a * ((to_ball**2).sum(-1) - BALL_RADIUS**2)
    ball = (b - np.sqrt(np.maximum(discriminant, 0))) / a
    return np.where((discriminant > 0) & (ball > 0) & (ball < box), ball, box)


def pixel_rays(
    spline: Spline, camera: Camera, shutter: Shutter, stamp: float, T_cam_body: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Origins and directions (h, w, 3) in the world of all pixels' rays, planar z = ray parameter."""
    uv = camera.pixel_grid()
    t = shutter.line_mid_time(stamp, shutter.line_of_pixel(uv, camera), camera)
    times, line = np.unique(t, return_inverse=True)
    T_world_cam = (spline.pose(times) @ se3.inverse(T_cam_body))[line.reshape(t.shape)]
    return T_world_cam[..., :3, 3], np.einsum("...ij,...j->...i", T_world_cam[..., :3, :3], camera.unproject(uv))


def render_depth(
    spline: Spline, camera: Camera, shutter: Shutter, stamp: float, T_cam_body: FloatArray | None = None
) -> npt.NDArray[np.float32]:
    """Exact planar z (h, w), m."""
    return cast(*pixel_rays(spline, camera, shutter, stamp, np.eye(4) if T_cam_body is None else T_cam_body)).astype(
        np.float32
    )


def render_color(
    spline: Spline, camera: Camera, shutter: Shutter, stamp: float, T_cam_body: FloatArray
) -> npt.NDArray[np.uint8]:
    """A smooth solid texture on everything, (h, w, 3)."""
    p, d = pixel_rays(spline, camera, shutter, stamp, T_cam_body)
    hit = p + d * cast(p, d)[..., None]
    return np.rint(127.5 + 110 * np.sin(hit @ np.array([[5, 2, 1], [1, 6, -2], [-2, 1, 7.0]]))).astype(np.uint8)


def open_writer(root: Path, config: Config, frames: int = 6, spline: Spline | None = None) -> SequenceWriter:
    """The writer of the sequence's first `frames` frames."""
    color, depth = (stream_stamps(0.0, DURATION_S, stream)[:frames] for stream in (config.color, config.depth))
    spline = spline or make_spline()
    stamps = {"color": color, "depth": depth}
    return SequenceWriter.open(root, config, spline, stamps, {"synthetic": "1"}, {"scene": "box"})


def write_frames(writer: SequenceWriter, frames: range | None = None) -> None:
    """Render and write the missing frames, or those of `frames`."""
    config = writer.config
    T_color_depth = np.array(config.T_color_depth)
    for k in writer.missing("color") if frames is None else frames:
        stamp = float(writer.stamps("color")[k])
        image = render_color(writer.spline, config.color.camera, config.color.shutter, stamp, T_color_depth)
        writer.write_color(k, image)
    for k in writer.missing("depth") if frames is None else frames:
        stamp = float(writer.stamps("depth")[k])
        writer.write_depth(k, render_depth(writer.spline, config.depth.camera, config.depth.shutter, stamp))


def write_scene(root: Path) -> None:
    """scene.ply: the box's inside and the ball."""
    box = trimesh.creation.box(bounds=BOX)
    box.invert()
    ball = trimesh.creation.icosphere(3, BALL_RADIUS)
    ball.apply_translation(BALL)
    atomic_write(root / "scene.ply", trimesh.util.concatenate([box, ball]).export(file_type="ply"))


def make_sequence(root: Path, config: Config | None = None, frames: int = 6) -> Path:
    """Write a complete sequence and return its folder."""
    writer = open_writer(root, config or make_config(), frames)
    write_frames(writer)
    write_scene(root)
    writer.finish()
    return root
