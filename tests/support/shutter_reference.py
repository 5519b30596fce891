"""What tests compare rolling shutters with: when a line is exposed, and the projection's exact derivative."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rsgen.array_types import FloatArray, IntArray
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.so3 import cross, hat
from rsgen.geometry.spline import Side, Spline


def line_window(
    shutter: Shutter, stamp: npt.ArrayLike, line: npt.ArrayLike, camera: Camera
) -> tuple[FloatArray, FloatArray]:
    """Times in seconds at which lines (...,) start and stop being exposed."""
    end = shutter.line_end_time(stamp, line, camera)
    return np.asarray(end - shutter.exposure_s), end


def rolling_shutter_jacobian(
    spline: Spline,
    T_cam_body: npt.ArrayLike,
    camera: Camera,
    shutter: Shutter,
    t: npt.ArrayLike,
    p_world: npt.ArrayLike,
    side: Side = "left",
) -> tuple[IntArray, FloatArray]:
    """Total derivative of `project_rolling`'s pixel by the control points, the line's own change of time included.

    Takes the times t (...,) that it found for points (..., 3), valid ones only. Returns the index of the first control
    point (...,) and J (..., 4, 2, 6): pixels per metre and per radian of the increments that `Spline.pose_jacobian`
    defines for the same side.
    """
    t, p_world = np.asarray(t, dtype=np.float64), np.asarray(p_world, dtype=np.float64)
    R_cam_body = np.asarray(T_cam_body, dtype=np.float64)[:3, :3]
    first, J_pose = spline.pose_jacobian(t, side)
    T_world_body, w = spline.pose_and_velocity(t)
    q = se3.transform(se3.inverse(T_world_body), p_world)
    J_body = camera.project_jacobian(se3.transform(T_cam_body, q)) @ R_cam_body
    if side == "left":
        R_body_world = np.swapaxes(T_world_body[..., :3, :3], -1, -2)
        dq = np.concatenate([-R_body_world, R_body_world @ hat(p_world)], axis=-1)
    else:
        dq = np.concatenate([np.broadcast_to(-np.eye(3), (*q.shape, 3)), hat(q)], axis=-1)
    x_dot = (J_body @ -(w[..., :3] + cross(w[..., 3:], q))[..., None])[..., 0]
    axis, delay = shutter.axis, shutter.direction * shutter.line_delay(camera)
    total = np.broadcast_to(np.eye(2), (*t.shape, 2, 2)).copy()
    total[..., :, axis] += x_dot * (delay / (1.0 - delay * x_dot[..., axis]))[..., None]
    return first, (total @ J_body @ dq)[..., None, :, :] @ J_pose
