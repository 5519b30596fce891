"""How a camera should be exposed in a scene that nobody has photographed: a quick, noisy look along the way."""

from __future__ import annotations

from typing import Any

import numpy as np

from rsgen.array_types import Float32Array, FloatArray
from rsgen.device.pose_table import PoseFunction
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.produce.frame_source import small_camera

_VIEWS, _WIDTH, _SPP, _DEPTH = 6, 48, 32, 16
_BLOCK = 12  # pixels: noise of so few samples is averaged over blocks
_GREY = 0.18  # what half of the blocks are to be brighter than
_MOST, _WHITE = 0.7, 0.6  # of the blocks, that are not to be brighter than this: windows may, white walls not
_ENOUGH = 2.0  # a factor that is not worth the while


def suggested_gain(scene: Any, camera: Camera, T_world_cam: PoseFunction, until_s: float, gain: float) -> float | None:
    """`color.exposure_gain` that makes the typical surface mid-grey, or less where it would make most of a picture's
    bright part white: dark floors below white walls. None if `gain` does so within a factor of 2.

    Path traced by `camera`, made small, at poses T_world_cam(t), at a few instants from 0 to `until_s`, in s. None too
    where all is dark.
    """
    import mitsuba as mi

    from rsgen.light.lamps import straight_through_bulbs
    from rsgen.render.images import ColorRenderer

    path = mi.load_dict({"type": "path", "max_depth": _DEPTH})
    renderer = ColorRenderer(scene, path, small_camera(camera, _WIDTH), Shutter(), _SPP)
    stamps = until_s * (np.arange(_VIEWS) + 0.5) / _VIEWS
    with straight_through_bulbs(scene):
        light = np.concatenate([_blocks(renderer.render(T_world_cam, float(t), k)) for k, t in enumerate(stamps)])
    light = light[light > 0]
    if not len(light):
        return None
    wanted = min(_GREY / float(np.median(light)), _WHITE / float(np.quantile(light, _MOST)))
    if 1 / _ENOUGH <= wanted / gain <= _ENOUGH:
        return None
    return float(f"{wanted:.2g}")


def _blocks(image: Float32Array) -> FloatArray:
    """Mean light (n,), all channels, of whole blocks of an image (h, w, 3)."""
    rows, columns = (size // _BLOCK for size in image.shape[:2])
    whole = image[: rows * _BLOCK, : columns * _BLOCK].reshape(rows, _BLOCK, columns, _BLOCK, 3)
    return np.asarray(whole.mean(axis=(1, 3, 4), dtype=np.float64)).ravel()
