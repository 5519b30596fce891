"""What images are aligned to: a keyframe, rectified to one pose, or still with its own rolling shutter."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from rsgen.array_types import FloatArray
from rsgen.device.arrays import Engine
from rsgen.device.lens import Lens
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rstrack.compiled import compiled
from rstrack.images.line_poses import Exposure
from rstrack.images.pyramid import LEVELS, masked_pyramid
from rstrack.images.sampling import NEAREST
from rstrack.keyframes.surface import on_one_surface

# Pixels of the smallest image of which every second one, in every second row, is enough, and of the largest one:
# 320×240 and 640×480 lose nothing by that, while 160×120 has none to spare.
_SPARE_PX, _PLENTY_PX = 320 * 240, 640 * 480
THINNED = LEVELS
"""Beside the pyramid's levels: the finest with every second of its pixels, for where a good many err alike."""
# Of a keyframe on the device: five images, and of its points five of a quarter to a 64th of the pixels.
_PIXEL_BYTES = 28
# Pixels that medians and percentiles are taken from.
_SOME = 10_000

FloatImage = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]


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


def pyramid_level(sampling: int) -> int:
    """Level of the pyramid that the pixels of a sampling, a level or `THINNED`, are taken from."""
    return 0 if sampling == THINNED else sampling


def depth_scaling(rho: FloatImage) -> tuple[float, float]:
    """`median_depth` and `bound` of the geometric term.

    |j| is 1 for shifts and z / median_depth for rotations, times the kernel's min((median_depth / z)², NEAREST): never
    above NEAREST for points as far from the axis as from the camera.
    """
    some = _some(rho)
    return (1.0 / float(np.median(some[some > 0])) if (some > 0).any() else 1.0), 2.0 * NEAREST


def _some(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """About `_SOME` of the values, evenly spread: a median or percentile that scales others need not know all."""
    flat = values.reshape(-1)
    return flat[:: max(1, flat.size // _SOME) | 1]


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
    focal = 1.0 / max(float(np.diff(rays[0, :, 0]).mean()), 1e-9)
    out = []
    for sampling, stride in enumerate(strides(width, height)):
        level = pyramid_level(sampling)
        image, known = images[level]
        x, y, z, at, slope = _sampled(rho, whole, rays, image, known, stride, 2**level)
        depths, slopes = _some(z), _some(slope)
        depths, slopes = depths[depths > 0], slopes[slopes >= 0]
        bound = 2.0 * focal * float(np.percentile(slopes, 99.5)) if slopes.size else 1.0
        median_depth = float(np.median(depths)) if depths.size else 1.0
        on = e.upload(np.ones(z.shape))
        out.append(Points(e.upload(x), e.upload(y), e.upload(z), e.upload(at), on, median_depth, max(bound, 1e-2)))
    return tuple(out)


@compiled
def _sampled(
    rho: FloatImage, whole: Mask, rays: FloatArray, image: FloatImage, known: Mask, stride: int, halved: int
) -> tuple[FloatImage, ...]:  # fmt: skip
    """Coordinates x, y, z of every stride-th pixel and row, intensity and its slope by the point's shift (1/m, px).

    whole (h, w): where z is known; image, known: of a level with pixels `halved` times as large. z is 0 and the slope
    −1 where there is no point. Slopes are central differences, one-sided at the border.
    """
    height, width = rho.shape
    rows, columns = (height + stride - 1) // stride, (width + stride - 1) // stride
    out = np.empty((5, rows, columns), np.float32)
    x, y, z, at, slope = out
    step = stride // halved
    last_v, last_u = image.shape[0] - 1, image.shape[1] - 1
    for i in range(rows):
        v = i * step
        above, below = max(v - 1, 0), min(v + 1, last_v)
        for j in range(columns):
            u = j * step
            left, right = max(u - 1, 0), min(u + 1, last_u)
            is_on = whole[i * stride, j * stride] & known[v, u]
            own = rho[i * stride, j * stride]
            depth = 1.0 / max(own, np.float32(1e-6)) if is_on else 0.0
            gx = (image[v, right] - image[v, left]) / max(right - left, 1)
            gy = (image[below, u] - image[above, u]) / max(below - above, 1)
            x[i, j], y[i, j] = rays[i * stride, j * stride, 0] * depth, rays[i * stride, j * stride, 1] * depth
            z[i, j], at[i, j] = depth, image[v, u]
            slope[i, j] = np.sqrt(gx * gx + gy * gy) / halved * own if is_on else -1.0
    return x, y, z, at, slope


def _intensities(intensity: FloatImage, rho: FloatImage) -> list[tuple[FloatImage, Mask]]:
    return masked_pyramid(intensity, np.isfinite(intensity) & (rho > 0))
