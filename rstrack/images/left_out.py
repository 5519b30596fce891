"""Images without what moves by itself."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import drjit as dr
import numpy as np
import numpy.typing as npt

from rsgen.device.arrays import Engine
from rstrack.images.device_frame import DeviceFrame
from rstrack.images.pyramid import ColorImage, DepthImage, thumbnail

Mask = npt.NDArray[np.bool_]

MARGIN = 0.0125
"""Part of the width about what moves within which colours may be its own: they are taken later, and from beside."""


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
