"""Depth as drivers deliver it: warped into the colour camera by geometry alone, motion ignored."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rsgen.array_types import Float32Array, FloatArray
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera


def register_depth(
    rays_depth: FloatArray, z: Float32Array, color: Camera, T_color_depth: npt.ArrayLike
) -> Float32Array:
    """Depth as the colour camera sees it: planar z (H, W) in metres of its pixels, 0 where no point falls.

    Each depth pixel's point goes to the nearest colour pixel; of several the nearest point stays (z-buffer). Depth
    coarser than colour leaves holes, as it does in drivers that do not fill.

    rays_depth (h, w, 3): rays with z = 1 of the depth camera's pixels. z (h, w): m, 0 where nothing was measured.
    """
    seen = z > 0
    p_color = se3.transform(T_color_depth, rays_depth[seen] * z[seen].astype(np.float64)[:, None])
    uv, _ = color.project(p_color)
    inside = color.contains(uv)
    u, v = np.rint(uv[inside]).astype(np.int64).T
    # A half rounds to the even number, which at the image's edge can be one too far.
    place = np.clip(v, 0, color.height - 1) * color.width + np.clip(u, 0, color.width - 1)
    buffer = np.full(color.height * color.width, np.inf, np.float32)
    np.minimum.at(buffer, place, p_color[inside, 2].astype(np.float32))
    return np.where(np.isfinite(buffer), buffer, np.float32(0)).reshape(color.height, color.width)
