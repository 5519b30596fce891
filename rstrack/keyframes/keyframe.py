"""What images are aligned to: a keyframe, rectified to one pose, or still with its own rolling shutter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from rsgen.array_types import FloatArray
from rsgen.device.arrays import Engine
from rsgen.device.lens import Lens
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rstrack.images.line_poses import Exposure
from rstrack.images.pyramid import LEVELS, masked_pyramid
from rstrack.images.sampling import EDGE, NEAREST

# Strides of the pixels that are looked at on the pyramid's levels, finest first (DESIGN section 5: every second pixel
# loses nothing).
STRIDES = (2, 4, 8)
# Normals come from a window of this many pixels; the residual itself is not smoothed.
_NORMAL_WINDOW = 5

Image = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Points:
    """Reference points of one pyramid level on the device: camera coordinates (z = 0: none), intensity, visibility.

    median_depth, bound: see `block_sums.Scaling`.
    """

    x: Any
    y: Any
    z: Any
    intensity: Any
    visible: Any
    median_depth: float
    bound: float


@dataclass(frozen=True)
class Reference:
    """A keyframe.

    T_world_base (4, 4) at time `t` (s): the frame in which its depth is given if it is rectified. `rolling`: the
    depth camera's exposure if it is not; the base frame is then only a frame to compute in.
    Inverse depth (1/m, 0 missing), its smoothed slopes by normalised coordinates, how far bilinear interpolation of it
    may be off (m), and fusion weights, on the device.
    median_depth, bound: see `block_sums.Scaling`, for the geometric term. pixels: of the finest level that have depth.
    """

    index: int
    stamp: float
    t: float
    T_world_base: FloatArray
    lens: Lens
    rolling: Exposure | None
    inverse_depth: Any
    slope_x: Any
    slope_y: Any
    roughness: Any
    weight: Any
    points: tuple[Points, ...]
    median_depth: float
    bound: float
    pixels: int


def rectified_lens(camera: Camera) -> Lens:
    """Global-shutter pinhole of the same size and focal lengths: what rectified images are made for."""
    return Lens(Camera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy), Shutter())


def surface_slopes(rho: Image, fx: float, fy: float) -> tuple[Image, Image]:
    """Derivatives of inverse depth (h, w) by normalised coordinates, averaged over a window without crossing edges."""
    out = []
    for axis, focal in ((1, fx), (0, fy)):
        r = rho if axis == 1 else rho.T
        step = r[:, 1:] - r[:, :-1]
        both = (r[:, 1:] > 0) & (r[:, :-1] > 0) & (np.abs(step) < EDGE * r[:, 1:])
        total, count = np.zeros_like(r), np.zeros_like(r)
        for side in (slice(None, -1), slice(1, None)):
            total[:, side] += np.where(both, step, 0)
            count[:, side] += both
        if axis == 0:
            total, count = total.T, count.T
        window = (_NORMAL_WINDOW, _NORMAL_WINDOW)
        mean_step, share = (np.asarray(cv2.boxFilter(np.ascontiguousarray(a), -1, window)) for a in (total, count))
        out.append((focal * mean_step / np.maximum(share, np.float32(1e-3))).astype(np.float32))
    return out[0], out[1]


def surface_roughness(rho: Image, slope_x: Image, slope_y: Image, fx: float, fy: float) -> Image:
    """Error (h, w) in m that bilinear interpolation of inverse depth may have: an eighth of its second difference.

    Where walls meet, the chord cuts the corner, always towards the camera: small, but it adds up from keyframe to
    keyframe (0.02 mm each). Taken from the smoothed slopes, so that noise does not pass for corners; a corner's
    second difference is spread over the window there.
    """
    bend_x, bend_y = np.zeros_like(rho), np.zeros_like(rho)
    bend_x[:, 1:-1] = np.abs(slope_x[:, 2:] - slope_x[:, :-2]) / np.float32(2.0 * fx)
    bend_y[1:-1] = np.abs(slope_y[2:] - slope_y[:-2]) / np.float32(2.0 * fy)
    z = np.divide(np.float32(1.0), rho, out=np.zeros_like(rho), where=rho > 0)
    return (_NORMAL_WINDOW / 8.0 * z * z * np.maximum(bend_x, bend_y)).astype(np.float32)


def on_one_surface(rho: Image) -> npt.NDArray[np.bool_]:
    """Pixels (h, w) with depth whose neighbours right, left, above and below do not lie across an edge."""
    valid = rho > 0
    for axis in (0, 1):
        a, b = (rho[1:], rho[:-1]) if axis == 0 else (rho[:, 1:], rho[:, :-1])
        edge = np.abs(a - b) > EDGE * np.maximum(a, b)
        if axis == 0:
            valid[1:] &= ~edge
            valid[:-1] &= ~edge
        else:
            valid[:, 1:] &= ~edge
            valid[:, :-1] &= ~edge
    return valid


def depth_scaling(rho: Image) -> tuple[float, float]:
    """`median_depth` and `bound` of the geometric term.

    |j| is 1 for shifts and z / median_depth for rotations, times the kernel's min((median_depth / z)², NEAREST): never
    above NEAREST for points as far from the axis as from the camera.
    """
    median_depth = float(np.median(1.0 / rho[rho > 0])) if (rho > 0).any() else 1.0
    return median_depth, 2.0 * NEAREST


def level_points(
    e: Engine, rho: Image, rays: FloatArray, intensity: Image, seen: npt.NDArray[np.bool_]
) -> tuple[Points, ...]:
    """Points of all levels. rays (h, w, 2): normalised coordinates; intensity (h, w), known where `seen`."""
    whole = on_one_surface(rho)
    out = []
    for level, (image, known) in enumerate(masked_pyramid(intensity, seen & (rho > 0))):
        stride = STRIDES[level]
        pick = (slice(None, None, stride), slice(None, None, stride))
        # A level's pixels are 2^level apart, the points twice that.
        at = image[::2, ::2]
        z = np.where(whole[pick] & known[::2, ::2], 1.0 / np.maximum(rho[pick], 1e-6), 0.0)
        gy, gx = np.gradient(image)
        slope = (np.hypot(gx, gy)[::2, ::2] / 2**level * rho[pick])[z > 0]
        focal = 1.0 / max(float(np.diff(rays[0, :, 0]).mean()), 1e-9)
        bound = 2.0 * focal * float(np.percentile(slope, 99.5)) if slope.size else 1.0
        median_depth = float(np.median(z[z > 0])) if (z > 0).any() else 1.0
        x, y = rays[..., 0][pick] * z, rays[..., 1][pick] * z
        on = e.upload(np.ones(z.shape))
        out.append(Points(e.upload(x), e.upload(y), e.upload(z), e.upload(at), on, median_depth, max(bound, 1e-2)))
    assert len(out) == LEVELS
    return tuple(out)
