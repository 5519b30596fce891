"""Images as the kernels take them: depth and inverse depth on the device, and a pyramid of intensities."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from rsgen.array_types import FloatArray
from rsgen.device.arrays import Engine
from rsgen.geometry.camera import Camera
from rstrack.images.line_poses import Exposure

LEVELS = 3
# Bilinear interpolation of a sharper picture is drawn to whole and half pixels, by up to 0.05 px.
_BLUR_PX = 0.8
# Grey levels from which on, and up to which, a channel may be clipped.
_SATURATED, _BLACK = 250, 5
# Pixels (a square of this size) about a clipped one that smoothing draws it into, and its share that matters.
_MARGIN_PX, _LEAST_CLIPPED = 5, 0.2
_THUMBNAIL = 20, 15


@dataclass(frozen=True)
class DepthImage:
    """A depth image: z (m, 0 missing) and 1/z on the device; rays are those of its camera.

    count: pixels that have depth. thumbnail (15, 20): of 1/z, 0 missing.
    resolution: the camera's step (1/m, see `depth_resolution`), 0 where it shows none.
    whole: the image before what moves by itself was left out of it; None where nothing was. screen: that one with what
    moves made wider. left_out (gh, gw): every so-manyth pixel and row (left_out_stride) that was, None likewise.
    """

    exposure: Exposure
    z: Any
    inverse_z: Any
    count: int
    thumbnail: npt.NDArray[np.float32] = field(default_factory=lambda: np.zeros(_THUMBNAIL[::-1], np.float32))
    resolution: float = 0.0
    whole: DepthImage | None = None
    screen: DepthImage | None = None
    left_out: npt.NDArray[np.bool_] | None = None
    left_out_stride: int = 1

    @property
    def occluder(self) -> DepthImage:
        """All that it shows: what moves hides what rests."""
        return self.whole or self

    @property
    def hider(self) -> DepthImage:
        """What hides points from colour images taken with it: things have moved a little by then."""
        return self.screen or self.occluder

    @property
    def moving(self) -> float:
        """Part of its pixels that were left out since they move by themselves."""
        return 1.0 - self.count / self.occluder.count if self.whole else 0.0


@dataclass(frozen=True)
class ColorImage:
    """Intensities in [0, 1], NaN where clipped; level 0 is full size, each further one low-passed and halved
    (cv2.pyrDown). moments (2,): mean and standard deviation of the coarsest level. thumbnail (15, 20): of it. finer: by
    how many halvings its pixels are smaller than those of the depth images, negative if they are larger."""

    exposure: Exposure
    levels: tuple[Any, ...]
    moments: FloatArray = field(default_factory=lambda: np.zeros(2))
    thumbnail: npt.NDArray[np.float32] = field(default_factory=lambda: np.zeros(_THUMBNAIL[::-1], np.float32))
    finer: int = 0

    def level(self, level: int) -> int:
        """Its level that is low-passed as a reference's is, whose pixels are those of depth images.

        At the finest one both are as sharp as they come, at 0: points are exact whatever lies between them.
        """
        return max(0, level + self.finer) if level else 0


def octaves_finer(color: Camera, depth: Camera) -> int:
    """`ColorImage.finer` of two cameras."""
    return round(math.log2(color.fx / depth.fx))


def depth_image(
    e: Engine, exposure: Exposure, z: npt.NDArray[Any], max_depth: float, resolution: float = 0.0
) -> DepthImage:
    """z (h, w) in metres; what is not finite, not positive or beyond max_depth counts as missing."""
    z = np.asarray(z, np.float32)
    good = (z > 0.0) & (z < max_depth)
    z = np.where(good, z, np.float32(0.0))
    inverse = np.divide(np.float32(1.0), z, out=np.zeros_like(z), where=good)
    return DepthImage(
        exposure, e.upload(z), e.upload(inverse), int(np.count_nonzero(good)), thumbnail(inverse, good), resolution
    )


def depth_resolution(z: npt.NDArray[Any]) -> float:
    """Step δ (1/m) of a depth image (h, w): neighbouring values differ by δ z², as those of whole disparities do.

    0 where depth is not quantised so that it shows: where most pixels have values of their own.
    """
    z = np.asarray(z)[::2, ::2]
    values, counts = np.unique(z[(z > 0) & np.isfinite(z)], return_counts=True)
    if len(values) < 2 or counts.sum() < 5 * len(values):
        return 0.0
    # As seen by the pixels: rare values in between are noise.
    steps = np.diff(values) / values[1:] ** 2
    order = np.argsort(steps)
    seen = np.cumsum(counts[1:][order])
    return float(steps[order][np.searchsorted(seen, 0.5 * seen[-1])])


def thumbnail(image: npt.NDArray[np.float32], known: npt.NDArray[np.bool_] | None = None) -> npt.NDArray[np.float32]:
    """An image (h, w) in 15 rows of 20, to be recognised by; 0 where less than half of it is known."""
    if known is None:
        return np.asarray(cv2.resize(image, _THUMBNAIL, interpolation=cv2.INTER_AREA))
    share = np.asarray(cv2.resize(known.astype(np.float32), _THUMBNAIL, interpolation=cv2.INTER_AREA))
    mean = np.asarray(cv2.resize(np.where(known, image, np.float32(0.0)), _THUMBNAIL, interpolation=cv2.INTER_AREA))
    return np.where(share > 0.5, mean / np.maximum(share, np.float32(1e-3)), np.float32(0.0)).astype(np.float32)


def intensity(color: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    """Grey (h, w) in [0, 1] of an RGB image (h, w, 3), ITU-R BT.601 weights, slightly blurred."""
    grey = np.asarray(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), np.float32) * np.float32(1.0 / 255.0)
    return np.asarray(cv2.GaussianBlur(grey, (0, 0), _BLUR_PX))


def corner_distance2(width: int, height: int) -> npt.NDArray[np.float32]:
    """Square (h, w) of the distance from an image's centre, over that of its corners."""
    u, v = np.arange(width) - (width - 1) / 2, np.arange(height) - (height - 1) / 2
    return ((u**2 + v[:, None] ** 2) / (u[0] ** 2 + v[0] ** 2)).astype(np.float32)


def color_image(
    e: Engine, exposure: Exposure, color: npt.NDArray[np.uint8], finer: int = 0,
    evening: npt.NDArray[np.float32] | None = None,
) -> ColorImage:  # fmt: skip
    """RGB (h, w, 3) uint8 to a pyramid, NaN where a pixel or one beside it is saturated or black; see `ColorImage`.

    evening (h, w): what intensities are multiplied by, since the camera darkens them.
    """
    grey = intensity(color)
    levels = pyramid(grey if evening is None else grey * evening, LEVELS + max(0, finer))
    moments = np.array([levels[-1].mean(), levels[-1].std()], np.float64)
    shown = tuple(e.upload(level) for level in in_range(levels, color))
    return ColorImage(exposure, shown, moments, thumbnail(levels[-1]), finer)


def in_range(levels: list[npt.NDArray[np.float32]], color: npt.NDArray[np.uint8]) -> list[npt.NDArray[np.float32]]:
    """Levels of a pyramid of intensities (h, w) of an image, NaN where that is saturated or black."""
    masks = _beyond_range(color, len(levels))
    return [np.where(mask, np.float32(np.nan), level) for level, mask in zip(levels, masks, strict=True)]


def _beyond_range(color: npt.NDArray[np.uint8], count: int) -> list[npt.NDArray[np.bool_]]:
    """For each level the pixels (h, w) whose intensity is unknown: clipped, or smoothed with what was.

    Two channels have to be saturated: white paper in warm light saturates red alone, still shows its print, and holds
    the motion against what shines beside it. All three have to be black.
    """
    red, green, blue = cv2.split(color)
    less, more = cv2.min(red, green), cv2.max(red, green)
    most, second = cv2.max(more, blue), cv2.max(less, cv2.min(more, blue))
    clipped = ((second >= _SATURATED) | (most <= _BLACK)).astype(np.uint8)
    weight = cv2.dilate(clipped, np.ones((_MARGIN_PX, _MARGIN_PX), np.uint8)).astype(np.float32)
    out = [weight > _LEAST_CLIPPED]
    for _ in range(count - 1):
        weight = np.asarray(cv2.pyrDown(weight))
        out.append(weight > _LEAST_CLIPPED)
    return out


def pyramid(image: npt.NDArray[np.float32], count: int = LEVELS) -> list[npt.NDArray[np.float32]]:
    """`count` levels; pixel (x, y) of a level lies at (2x, 2y) of the one below."""
    levels = [image]
    for _ in range(count - 1):
        levels.append(np.asarray(cv2.pyrDown(levels[-1])))
    return levels


def masked_pyramid(
    image: npt.NDArray[np.float32], valid: npt.NDArray[np.bool_]
) -> list[tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]]:
    """Pyramid of an image with holes, by normalised convolution; a pixel is valid where half its weight is."""
    weight = valid.astype(np.float32)
    value = np.where(valid, image, np.float32(0.0))
    out = [(value, valid)]
    for _ in range(LEVELS - 1):
        value, weight = np.asarray(cv2.pyrDown(value)), np.asarray(cv2.pyrDown(weight))
        out.append((value / np.maximum(weight, np.float32(1e-3)), weight > 0.5))
    return out


def camera_rays(exposure: Exposure) -> FloatArray:
    """Undistorted normalised coordinates (h, w, 2) of every pixel; 0 where the lens sees nothing (`lens_sees`)."""
    camera = exposure.lens.camera
    return np.nan_to_num(camera.unproject(camera.pixel_grid())[..., :2])


def lens_sees(camera: Camera) -> npt.NDArray[np.bool_]:
    """Pixels (h, w) through which the camera's model sees a direction."""
    return np.asarray(np.isfinite(camera.unproject(camera.pixel_grid())).all(axis=-1))
