"""What an image's depth says of another's: each point where the other camera saw it, line by line, and how far off.

For the eye, and apart from the tracker's kernels: projection through both shutters, in NumPy, of some pixels.
"""

from __future__ import annotations

import numpy as np

from rsgen.array_types import Float32Array, FloatArray
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.spline import Spline
from rstrack.data.rig import Image

_LOOKS = 3
# Neighbours whose depths differ by more than this part are on two sides of an edge.
_EDGE = 0.1


def world_points(spline: Spline, camera: Camera, shutter: Shutter, image: Image, stride: int) -> FloatArray:
    """p_world (h', w', 3) of every stride-th pixel of a depth image, each at its line's pose; NaN without depth.

    spline: T_world_depth(t). Raises UserError where the spline does not cover the image.
    """
    uv = camera.pixel_grid()[::stride, ::stride]
    z = image.pixels[::stride, ::stride].astype(np.float64)
    p_cam = camera.backproject(uv, np.where(z > 0.0, z, np.nan))
    lines, of = np.unique(shutter.line_of_pixel(uv, camera), return_inverse=True)
    T = spline.pose(shutter.line_mid_time(image.stamp, lines, camera))
    return np.asarray(se3.transform(T[of.reshape(p_cam.shape[:-1])], p_cam))


def depth_residuals(
    spline: Spline, camera: Camera, shutter: Shutter, p_world: FloatArray, other: Image
) -> FloatArray:  # fmt: skip
    """Depth that another image has where it sees p_world (..., 3), less the depth that the points have there, in m.

    NaN: not seen, or without depth there. spline: T_world_depth(t), of both images. Which line sees a point is found by
    looking from the line that would have seen it from the line before, which here settles within a hundredth of a line.
    Raises UserError where the spline does not cover the other image.
    """
    points = p_world.reshape(-1, 3)
    last = shutter.line_count(camera) - 1
    times = shutter.line_mid_time(other.stamp, np.arange(last + 1), camera)
    T_cam_world = se3.inverse(spline.pose(times))
    line = np.full(len(points), last // 2)
    for _ in range(_LOOKS):
        p_cam = se3.transform(T_cam_world[line], points)
        uv, valid = camera.project(p_cam)
        wanted = np.where(valid, shutter.line_of_pixel(uv, camera), 0.0)
        line = np.clip(np.rint(wanted), 0, last).astype(int)
    residuals = np.where(valid, _between(other.pixels, uv), np.nan) - p_cam[:, 2]
    return np.asarray(residuals.reshape(p_world.shape[:-1]))


def _between(z: Float32Array, uv: FloatArray) -> FloatArray:
    """Depth (n,) between the four pixels about uv (n, 2), as of a plane: linear in 1 / z. NaN beside edges and gaps."""
    height, width = z.shape
    inside = np.asarray(((uv >= 0.0) & (uv <= (width - 1, height - 1))).all(axis=-1))
    at = np.where(inside[:, None], uv, 0.0)
    u, v = (np.minimum(np.floor(at[:, i]).astype(int), n - 2) for i, n in enumerate((width, height)))
    near = np.stack([z[v + j, u + i] for j in (0, 1) for i in (0, 1)]).astype(np.float64)
    a, b = at[:, 0] - u, at[:, 1] - v
    weights = np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b])
    smooth = inside & (near.min(axis=0) > 0.0) & (np.ptp(near, axis=0) < _EDGE * near.max(axis=0))
    inverse = (weights / np.where(smooth, near, 1.0)).sum(axis=0)
    return np.where(smooth, 1.0 / inverse, np.nan)
