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
from rstrack.keyframes.surface import FloatImage, on_one_surface

# Pixels of the smallest image of which every second one, in every second row, is enough, and of the largest one:
# 320×240 and 640×480 lose nothing by that, while 160×120 has none to spare.
_SPARE_PX, _PLENTY_PX = 320 * 240, 640 * 480
THINNED = LEVELS
"""Beside the pyramid's levels: the finest with every second of its pixels, for where a good many err alike."""
# Of a keyframe on the device: five images, and of its points five of a quarter to a 64th of the pixels.
_PIXEL_BYTES = 28


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
    focal = 1.0 / max(float(np.diff(rays[0, :, 0]).mean()), 1e-9)
    for sampling, stride in enumerate(strides(width, height)):
        level = pyramid_level(sampling)
        image, known = images[level]
        # A level's pixels are 2^level apart.
        pick, on_level = _every(stride), _every(stride // 2**level)
        at, inverse_z = image[on_level], rho[pick]
        shown = whole[pick] & known[on_level]
        z = np.where(shown, 1.0 / np.maximum(inverse_z, 1e-6), 0.0)
        steepness = np.hypot(*gradient(image, stride // 2**level))
        slope, depths = (steepness / 2**level * inverse_z)[shown], z[shown]
        bound = 2.0 * focal * float(np.percentile(slope, 99.5)) if slope.size else 1.0
        median_depth = float(np.median(depths)) if depths.size else 1.0
        x, y = rays[..., 0][pick] * z, rays[..., 1][pick] * z
        on = e.upload(np.ones(z.shape))
        out.append(Points(e.upload(x), e.upload(y), e.upload(z), e.upload(at), on, median_depth, max(bound, 1e-2)))
    return tuple(out)


def _every(stride: int) -> tuple[slice, slice]:
    return slice(None, None, stride), slice(None, None, stride)


@compiled
def gradient(image: Any, stride: Any) -> Any:
    """`np.gradient` of an image (h, w) by x and y, at every stride-th pixel of every stride-th row."""
    height, width = image.shape
    shape = (height - 1) // stride + 1, (width - 1) // stride + 1
    by_x, by_y = np.empty(shape, image.dtype), np.empty(shape, image.dtype)
    for i in range(shape[0]):
        for j in range(shape[1]):
            y, x = i * stride, j * stride
            left, right, above, below = max(x - 1, 0), min(x + 1, width - 1), max(y - 1, 0), min(y + 1, height - 1)
            by_x[i, j] = (image[y, right] - image[y, left]) / np.float32(right - left)
            by_y[i, j] = (image[below, x] - image[above, x]) / np.float32(below - above)
    return by_x, by_y


def _intensities(intensity: FloatImage, rho: FloatImage) -> list[tuple[FloatImage, npt.NDArray[np.bool_]]]:
    known = np.isfinite(intensity)
    return masked_pyramid(np.where(known, intensity, np.float32(0.0)), known & (rho > 0))
