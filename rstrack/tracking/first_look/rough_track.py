"""A track that need not be exact: by depth alone unless the method wants colour, and then from thinned images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rsgen.errors import UserError
from rsgen.geometry.camera import Camera
from rstrack.data.dataset import Dataset
from rstrack.data.rig import Frame, Image
from rstrack.options import Options
from rstrack.tracking.any_tracker import AnyTracker, make_tracker

# Depth images as wide as that are thinned out: they take most of the time.
_LARGE = 480


def rough_track(dataset: Dataset, frames: range, options: Options, done: Callable[[float], None]) -> AnyTracker:
    """The tracker of options.method after it has been fed the frames, as far as it, and the images, went.

    done: told what part (0 to 1) of the frames it has seen.
    """
    has_color = options.photometric
    step = 2 if dataset.rig.depth_camera.width >= _LARGE and not has_color else 1
    rig = replace(dataset.rig, depth_camera=_thinned(dataset.rig.depth_camera, step))
    tracker = make_tracker(rig, options, interval_s=dataset.interval_s(frames))
    for count, k in enumerate(frames, 1):
        try:
            frame = dataset.frame(k, color=has_color)
            z = np.ascontiguousarray(frame.depth.pixels[::step, ::step])
            tracker.feed(Frame(Image(frame.depth.stamp, z), frame.colors))
        except (UserError, np.linalg.LinAlgError):
            break
        done(count / len(frames))
    return tracker


def _thinned(camera: Camera, step: int) -> Camera:
    """The camera whose pixels are every step-th of a camera's, from the first."""
    fx, fy, cx, cy = (value / step for value in (camera.fx, camera.fy, camera.cx, camera.cy))
    width, height = -(-camera.width // step), -(-camera.height // step)
    return replace(camera, width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)
