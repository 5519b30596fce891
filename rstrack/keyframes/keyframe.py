"""What images are aligned to: a keyframe, rectified to one pose, or still with its own rolling shutter."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
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

# Pixels of the smallest image of which every second one, in every second row, is enough, and of the largest one:
# 320×240 and 640×480 lose nothing by that, while 160×120 has none to spare.
_SPARE_PX, _PLENTY_PX = 320 * 240, 640 * 480
THINNED = LEVELS
"""Beside the pyramid's levels: the finest with every second of its pixels, for where a good many err alike."""
# Of a keyframe on the device: five images, and of its points five of a quarter to a 64th of the pixels.
_PIXEL_BYTES = 28
# Normals come from a window of this many pixels; the residual itself is not smoothed.
_NORMAL_WINDOW = 5

FloatImage = npt.NDArray[np.float32]


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

    T_world_base (4, 4) at time `t` (s): its depth's frame if it is rectified. rolling: the depth camera's exposure if
    it is not; the base frame is then only a frame to compute in. On the device: inverse_depth (1/m, 0 missing), its
    smoothed slopes by normalised coordinates, roughness (error of its bilinear interpolation, m), fusion weight.
    median_depth, bound: see `block_sums.Scaling`. pixels: of the finest level that have depth. moments: of its colour
    image; brightness: gain and offset (2,) of that against the track's first one. intensity (h, w): on the host, NaN
    unknown. coarse_intensity (h, w): for coarser levels where colour is finer than depth, low-passed to the depth
    camera's pixels, else None. *_thumbnail: see `pyramid.thumbnail`.
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
    moments: FloatArray
    intensity: FloatImage | None
    depth_thumbnail: FloatImage
    color_thumbnail: FloatImage | None
    brightness: FloatArray = field(default_factory=lambda: np.zeros(2))
    coarse_intensity: FloatImage | None = None

    def emptied(self) -> Reference:
        """Without what is on the device, and can be made again."""
        return replace(
            self, inverse_depth=None, slope_x=None, slope_y=None, roughness=None, weight=None, points=()
        )  # fmt: skip

    def without_images(self) -> Reference:
        """Without what is large on the host."""
        return replace(self, intensity=None, coarse_intensity=None)

    @property
    def device_bytes(self) -> int:
        """About what it takes on the device."""
        camera = self.lens.camera
        return _PIXEL_BYTES * camera.width * camera.height


def rectified_lens(camera: Camera) -> Lens:
    """Global-shutter pinhole of the same size and focal lengths: what rectified images are made for."""
    return Lens(Camera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy), Shutter())


def strides(width: int, height: int) -> tuple[int, ...]:
    """Strides of the pixels of a depth image that are looked at on the levels, finest first, and with `THINNED`."""
    pixels = width * height
    finest = 1 if pixels < _SPARE_PX else 2 * max(1, math.isqrt(pixels // _PLENTY_PX))
    return *(finest * 2**level for level in range(LEVELS)), 2 * finest


def surface_slopes(rho: FloatImage, fx: float, fy: float) -> tuple[FloatImage, FloatImage]:
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


def surface_bends(slope_x: FloatImage, slope_y: FloatImage, fx: float, fy: float) -> tuple[FloatImage, FloatImage]:
    """Size of the second differences (h, w) of inverse depth from pixel to pixel, along rows and columns."""
    bend_x, bend_y = np.zeros_like(slope_x), np.zeros_like(slope_y)
    bend_x[:, 1:-1] = np.abs(slope_x[:, 2:] - slope_x[:, :-2]) / np.float32(2.0 * fx)
    bend_y[1:-1] = np.abs(slope_y[2:] - slope_y[:-2]) / np.float32(2.0 * fy)
    return bend_x, bend_y


def surface_roughness(rho: FloatImage, slope_x: FloatImage, slope_y: FloatImage, fx: float, fy: float) -> FloatImage:
    """Error (h, w) in m that bilinear interpolation of inverse depth may have: an eighth of its second difference.

    Where walls meet, the chord cuts the corner, always towards the camera: small, but it adds up from keyframe to
    keyframe (0.02 mm each). Taken from the smoothed slopes, so that noise does not pass for corners; a corner's
    second difference is spread over the window there.
    """
    bend_x, bend_y = surface_bends(slope_x, slope_y, fx, fy)
    z = np.divide(np.float32(1.0), rho, out=np.zeros_like(rho), where=rho > 0)
    return (_NORMAL_WINDOW / 8.0 * z * z * np.maximum(bend_x, bend_y)).astype(np.float32)


def on_one_surface(rho: FloatImage) -> npt.NDArray[np.bool_]:
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


def pyramid_level(sampling: int) -> int:
    """Level of the pyramid that the pixels of a sampling, a level or `THINNED`, are taken from."""
    return 0 if sampling == THINNED else sampling


def depth_scaling(rho: FloatImage) -> tuple[float, float]:
    """`median_depth` and `bound` of the geometric term.

    |j| is 1 for shifts and z / median_depth for rotations, times the kernel's min((median_depth / z)², NEAREST): never
    above NEAREST for points as far from the axis as from the camera.
    """
    median_depth = float(np.median(1.0 / rho[rho > 0])) if (rho > 0).any() else 1.0
    return median_depth, 2.0 * NEAREST


def level_points(
    e: Engine, rho: FloatImage, rays: FloatArray, intensity: FloatImage, coarse: FloatImage | None = None
) -> tuple[Points, ...]:
    """Points of all levels, and of `THINNED`.

    rays (h, w, 2): normalised coordinates; intensity, coarse (h, w): see `Reference`.
    """
    whole = on_one_surface(rho)
    height, width = rho.shape
    images = _intensities(intensity, rho)
    if coarse is not None:
        images[1:] = _intensities(coarse, rho)[1:]
    out = []
    for sampling, stride in enumerate(strides(width, height)):
        level = pyramid_level(sampling)
        image, known = images[level]
        pick = (slice(None, None, stride), slice(None, None, stride))
        # A level's pixels are 2^level apart.
        on_level = (slice(None, None, stride // 2**level), slice(None, None, stride // 2**level))
        at = image[on_level]
        z = np.where(whole[pick] & known[on_level], 1.0 / np.maximum(rho[pick], 1e-6), 0.0)
        gy, gx = np.gradient(image)
        slope = (np.hypot(gx, gy)[on_level] / 2**level * rho[pick])[z > 0]
        focal = 1.0 / max(float(np.diff(rays[0, :, 0]).mean()), 1e-9)
        bound = 2.0 * focal * float(np.percentile(slope, 99.5)) if slope.size else 1.0
        median_depth = float(np.median(z[z > 0])) if (z > 0).any() else 1.0
        x, y = rays[..., 0][pick] * z, rays[..., 1][pick] * z
        on = e.upload(np.ones(z.shape))
        out.append(Points(e.upload(x), e.upload(y), e.upload(z), e.upload(at), on, median_depth, max(bound, 1e-2)))
    return tuple(out)


def _intensities(intensity: FloatImage, rho: FloatImage) -> list[tuple[FloatImage, npt.NDArray[np.bool_]]]:
    known = np.isfinite(intensity)
    return masked_pyramid(np.where(known, intensity, np.float32(0.0)), known & (rho > 0))
