"""Some points of a keyframe on the host: enough to tell what is smooth over all of its pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsgen.array_types import FloatArray
from rstrack.keyframes.keyframe import Points, Reference, strides

# Points nearer than this are left out, m; and about so many are enough.
NEAR, _POINTS = 0.05, 400


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Some points of a rectified keyframe: p (n, 3) in m, normals of the surface (n, 3), and gradients of intensity
    along it (n, 3), 1/m, zero where there is none; all in the keyframe's frame. velocity (6,): [m; rad]/s of the camera
    when the keyframe was taken, in its own axes."""

    p: FloatArray
    normal: FloatArray
    gradient: FloatArray
    median_depth: float
    velocity: FloatArray

    @classmethod
    def of(cls, ref: Reference, velocity: FloatArray) -> Landmarks:
        """Of a keyframe that is on the device."""
        camera = ref.lens.camera
        stride = strides(camera.width, camera.height)[2]
        pick = np.s_[::stride, ::stride]
        every = max(1, round(np.sqrt(camera.width * camera.height / _POINTS) / stride))
        few = np.s_[every // 2 :: every, every // 2 :: every]
        rho, sx, sy = (
            image.numpy().reshape(camera.height, camera.width)[pick].astype(float)
            for image in (ref.inverse_depth, ref.slope_x, ref.slope_y)
        )
        v, u = np.mgrid[0 : camera.height : stride, 0 : camera.width : stride]
        slope = _slopes(ref.points[2], rho.shape, stride) if ref.points else np.zeros((*rho.shape, 2))
        rho, sx, sy, u, v, slope = (image[few] for image in (rho, sx, sy, u, v, slope))
        x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
        plane = np.stack([sx, sy, rho - sx * x - sy * y], axis=-1)
        known = (rho > 0.0) & (rho < 1.0 / NEAR)
        normal = plane[known] / np.linalg.norm(plane[known], axis=1, keepdims=True)
        p = np.stack([x, y, np.ones_like(x)], axis=-1)[known] / rho[known, None]
        # ∂I/∂p through the pixel; what counts of it is the part along the surface.
        at = slope[known] * (camera.fx, camera.fy) / p[:, 2:]
        gradient = np.column_stack([at, -(at * p[:, :2]).sum(axis=1) / p[:, 2]])
        return cls(p, normal, gradient, ref.median_depth, velocity)


def _slopes(points: Points, shape: tuple[int, int], stride: int) -> FloatArray:
    """∂I by pixels (h, w, 2), zero where a neighbour is missing."""
    intensity, z = (values.numpy().reshape(shape).astype(float) for values in (points.intensity, points.z))
    seen = np.where(z > 0.0, intensity, np.nan)
    dy, dx = np.gradient(seen, stride) if min(shape) > 1 else (np.full(shape, np.nan),) * 2
    return np.nan_to_num(np.stack([dx, dy], axis=-1))
