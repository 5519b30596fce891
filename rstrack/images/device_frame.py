"""A rig on the device as the chosen method sees it, its frames there, and frames without what moves by itself."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import Any

import cv2
import drjit as dr
import numpy as np
import numpy.typing as npt

from rsgen.array_types import FloatArray
from rsgen.device.arrays import Engine, engine
from rsgen.device.lens import Lens
from rsgen.errors import UserError
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rstrack.data.moving_masks import Mask
from rstrack.data.rig import Frame, Image, Rig
from rstrack.images.line_poses import Exposure
from rstrack.images.pyramid import (
    ColorImage,
    DepthImage,
    camera_rays,
    color_image,
    corner_distance2,
    depth_image,
    depth_resolution,
    lens_sees,
    octaves_finer,
    thumbnail,
)
from rstrack.options import Options

# Frames within which the depth camera's resolution is looked for: it does not change.
_SETTLED = 3

MARGIN = 0.0125
"""Part of the width about what moves within which colours may be its own: they are taken later, and from beside."""


@dataclass(frozen=True)
class DeviceFrame:
    """A frame on the device. depth_share: part of its depth pixels that have a value. color_late_s: what has been added
    to the stamps of its colours."""

    index: int
    stamp: float
    depth: DepthImage
    colors: tuple[ColorImage, ...]
    depth_share: float
    color_late_s: float = 0.0

    @property
    def exposures(self) -> list[Exposure]:
        """Of all its images."""
        return [self.depth.exposure, *(c.exposure for c in self.colors)]

    @property
    def first_time(self) -> float:
        """Time in s of the first line of all its images."""
        return min(exposure.first_time for exposure in self.exposures)

    @property
    def last_time(self) -> float:
        """Time in s of their last line."""
        return max(exposure.last_time for exposure in self.exposures)


Timer = Callable[[str], AbstractContextManager[Any]]
"""Watches a part of the work by its name: `with timer("linear algebra: solve"):`; the measure `speed` counts."""


def untimed(_: str) -> AbstractContextManager[None]:
    """The timer that does nothing."""
    return nullcontext()


class DeviceRig:
    """Lenses and rays of a rig as a method sees them; takes its frames to the device.

    rays (h, w, 2): normalised coordinates of the depth camera's pixels; device_rays: the same on the device. sees
    (h, w): see `lens_sees`. depth_lens, color_lens: the cameras. sigma: how far the rig may be wrong. resolution: step
    of the depth camera (1/m), 0 until its first images have shown one.
    """

    def __init__(self, rig: Rig, options: Options, timer: Timer = untimed) -> None:
        self.timer = timer
        self._rig, self._options = rig, options
        self.sigma = rig.sigma
        self.e = engine(options.backend)
        self.depth_lens = Lens(rig.depth_camera, _seen_as(rig.depth_shutter, options.rolling))
        self.color_lens = Lens(rig.color_camera, _seen_as(rig.color_shutter, options.rolling))
        self.sees = lens_sees(rig.depth_camera)
        self._finer = octaves_finer(rig.color_camera, rig.depth_camera)
        size = rig.color_camera.width, rig.color_camera.height
        self._evening = 1.0 + np.float32(rig.color_falloff) * corner_distance2(*size) if rig.color_falloff else None
        self.rays = camera_rays(Exposure(self.depth_lens, 0.0, np.eye(4)))
        self.device_rays = self.e.upload(self.rays[..., 0]), self.e.upload(self.rays[..., 1])
        self.resolution = 0.0

    def upload(self, index: int, frame: Frame, color_late_s: float = 0.0) -> DeviceFrame:
        """Frame `index` of a recording, whose colour was taken so much later than its stamps.

        Raises UserError if an image's size or type is not the rig's.
        """
        rig, options = self._rig, self._options
        with self.timer("preparing images"):
            z = _checked(frame.depth, rig.depth_camera, "depth", (), "float metres, 0 = missing", np.floating)
            if self.resolution == 0.0 and index < _SETTLED:
                self.resolution = depth_resolution(z)
            z = np.where(self.sees, z, 0.0)
            depth = depth_image(self.e, self.depth_exposure(frame.depth), z, options.max_depth, self.resolution)
            colors = []
            for image in frame.colors if options.photometric else ():
                pixels = _checked(image, rig.color_camera, "colour", (3,), "uint8 RGB", np.uint8)
                exposure = self.color_exposure(replace(image, stamp=image.stamp + color_late_s))
                colors.append(color_image(self.e, exposure, pixels, self._finer, self._evening))
            return DeviceFrame(index, frame.depth.stamp, depth, tuple(colors), depth.count / z.size, color_late_s)

    def depth_exposure(self, image: Image) -> Exposure:
        """When and how the lines of a depth image are exposed."""
        return self._exposure(image, self.depth_lens, self._rig.depth_shutter, np.eye(4))

    def color_exposure(self, image: Image) -> Exposure:
        """The same of a colour image."""
        return self._exposure(image, self.color_lens, self._rig.color_shutter, self._rig.T_color_depth)

    @staticmethod
    def _exposure(image: Image, lens: Lens, true: Shutter, T_cam_body: FloatArray) -> Exposure:
        """Seen as a global shutter, an image has the time of its middle line: the best that such a model can do."""
        lines = true.line_count(lens.camera)
        middle = 0.0 if lens.lines > 1 else 0.5 * (lines - 1) * true.line_delay(lens.camera)
        return Exposure(lens, image.stamp + middle, T_cam_body)


def _checked(
    image: Image, camera: Camera, name: str, channels: tuple[int, ...], form: str, kind: type[np.generic]
) -> npt.NDArray[Any]:
    shape = (camera.height, camera.width, *channels)
    pixels = np.asarray(image.pixels)
    if pixels.shape != shape or not np.issubdtype(pixels.dtype, kind):
        raise UserError(
            f"tracker: {name} image stamped {image.stamp:.6f} is {pixels.dtype} {pixels.shape}; "
            f"the rig's camera gives {shape}, {form}"
        )
    return pixels


def _seen_as(shutter: Shutter, rolling: bool) -> Shutter:
    return shutter if rolling else Shutter(0.0, shutter.exposure_s, shutter.scan)


# -- what moves by itself --------------------------------------------------------------------------------------------


def full_size(values: npt.NDArray[Any], stride: int, height: int, width: int) -> npt.NDArray[Any]:
    """Values (gh, gw) of every stride-th pixel for all of them (height, width)."""
    return values.repeat(stride, axis=0).repeat(stride, axis=1)[:height, :width]


def without_pixels(e: Engine, depth: DepthImage, mask: Mask, stride: int) -> DepthImage:
    """A depth image without every stride-th pixel that the mask (gh, gw) has, and those that these stand for.

    As it was before it goes on to hide what it did, and what moves some more.
    """
    camera, whole = depth.exposure.lens.camera, depth.occluder
    shape = camera.height, camera.width
    keep = e.upload(~full_size(mask, stride, *shape))
    z, inverse_z = depth.z * keep, depth.inverse_z * keep
    dr.eval(z, inverse_z)
    rest, all_ = e.download(inverse_z, shape), e.download(whole.inverse_z, shape)
    screen = replace(whole, z=e.upload(_widened(np.where(rest > 0, np.float32(0.0), all_), all_)))
    left_out = mask if depth.left_out is None else mask | depth.left_out
    return replace(
        depth, z=z, inverse_z=inverse_z, count=int(np.count_nonzero(rest)), whole=whole, screen=screen,
        left_out=left_out, left_out_stride=stride,
    )  # fmt: skip


def frame_without(e: Engine, frame: DeviceFrame, mask: Mask, stride: int) -> DeviceFrame:
    """A frame whose depth, and whose thumbnails, do without the pixels of a mask (gh, gw); see `without_pixels`."""
    depth = without_pixels(e, frame.depth, mask, stride)
    camera = depth.exposure.lens.camera
    rho = e.download(depth.inverse_z, (camera.height, camera.width))
    depth = replace(depth, thumbnail=thumbnail(rho, rho > 0))
    colors = tuple(replace(color, thumbnail=thumbnail_without(color, depth)) for color in frame.colors)
    return replace(frame, depth=depth, colors=colors)


def thumbnail_without(color: ColorImage, depth: DepthImage) -> npt.NDArray[np.float32]:
    """A colour image's thumbnail (15, 20), 0 where the depth image taken with it shows something that moves.

    As if both cameras were at one place: a cell is wider than what lies between them.
    """
    if depth.left_out is None:
        return color.thumbnail
    camera, other = color.exposure.lens.camera, depth.exposure.lens.camera
    mask = full_size(depth.left_out, depth.left_out_stride, other.height, other.width)
    cells = np.asarray(cv2.blur(mask.astype(np.float32), (other.width // 20, other.height // 15)))
    h, w = color.thumbnail.shape
    u, v = np.meshgrid((np.arange(w) + 0.5) * camera.width / w - 0.5, (np.arange(h) + 0.5) * camera.height / h - 0.5)
    rays = camera.unproject(np.stack([u, v], axis=-1))
    uv, seen = other.project(rays @ color.exposure.T_cam_body[:3, :3])
    inside = seen & other.contains(uv)
    x, y = (np.rint(np.where(inside, uv[..., i], 0.0)).astype(int) for i in (0, 1))
    moves = inside & (cells[y, x] > 0.5)
    return np.where(moves, np.float32(0.0), color.thumbnail)


def _widened(moving: npt.NDArray[np.float32], whole: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """z (h, w), m, of what hides points: 1/z of what moves (h, w), and as far beside it as colours may show it."""
    margin = 2 * round(MARGIN * whole.shape[1]) + 1
    rho = np.maximum(whole, cv2.dilate(moving, np.ones((margin, margin), np.uint8)))
    return np.divide(np.float32(1.0), rho, out=np.zeros_like(rho), where=rho > 0)
