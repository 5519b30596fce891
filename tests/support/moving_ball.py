"""A ball that passes between the camera and the made room of `synthetic`, ray-cast line by line."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import synthetic

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.spline import Spline
from rstrack.data.rig import Rig

Mask = npt.NDArray[np.bool_]

SIZE = 96, 128
CAMERA = Camera(128, 96, 100.0, 100.0, 63.5, 47.5)
SHUTTER = Shutter(readout_s=0.028)
T_COLOR_DEPTH = se3.exp(np.array([-0.03, 0.0, 0.0, 0.0, 0.0, 0.0]))
RADIUS = 0.33
RIG = Rig(CAMERA, SHUTTER, CAMERA, SHUTTER, T_COLOR_DEPTH)
# Of a texture that does not repeat itself, rad/m.
WAVES = np.random.default_rng(5).normal(0.0, 10.0, (3, 10))


def center(t: FloatArray) -> FloatArray:
    """Of a ball (..., 3) in the world: to and fro before the camera, at up to 0.6 m/s."""
    t = np.asarray(t)
    return np.stack([0.25 * np.sin(2.4 * t), -0.05 + 0.1 * np.cos(2.0 * t), 0.95 + 0.0 * t], axis=-1)


def picture(
    spline: Spline, stamp: float, T_cam_body: FloatArray, radius: float = RADIUS
) -> tuple[FloatArray, FloatArray, Mask]:
    """z (h, w), colours (h, w, 3) in 0..255 and where the ball is: a room with furniture, and a ball that passes."""
    uv = CAMERA.pixel_grid()
    t = SHUTTER.line_mid_time(stamp, SHUTTER.line_of_pixel(uv, CAMERA), CAMERA)
    T = spline.pose(t) @ se3.inverse(T_cam_body)
    p, d = T[..., :3, 3], np.einsum("...ij,...j->...i", T[..., :3, :3], CAMERA.unproject(uv))
    room = synthetic.cast(p, d)
    to_ball = center(t) - p
    a, b = (d**2).sum(-1), (d * to_ball).sum(-1)
    under = b**2 - a * ((to_ball**2).sum(-1) - radius**2)
    ball = (b - np.sqrt(np.maximum(under, 0.0))) / a
    is_ball = (under > 0.0) & (ball > 0.0) & (ball < room)
    z = np.where(is_ball, ball, room)
    hit = p + d * z[..., None] - np.where(is_ball[..., None], center(t), 0.0)
    waves = np.sin(np.where(is_ball[..., None], 1.5, 1.0) * (hit @ WAVES) + np.arange(WAVES.shape[1])).sum(axis=-1)
    return z, np.repeat(127.5 + 30.0 * waves[..., None], 3, axis=-1), is_ball
