"""What most of the first images agrees on: points followed through colour, and the one motion that fits most of them.

At the start no keyframe is known to be at rest, and something large and near may hold more of the weight than the room
behind it: aligned from nothing, the camera then seems to go along with it. Points are spread evenly over the image, so
that areas count, not gradients; RANSAC finds their motion, and those that do not follow it are left out of the first
image for as long as it takes to align the others to the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np
import numpy.typing as npt

from rsgen.array_types import FloatArray
from rsgen.device.arrays import Engine
from rsgen.geometry import se3
from rstrack.alignment.free_space import grid_shape
from rstrack.images.device_frame import DeviceFrame, Mask
from rstrack.images.pyramid import ColorImage
from rstrack.keyframes.keyframe import Image, on_one_surface
from rstrack.tracking.moving.depth_majority import apart, averaged, goes_elsewhere

# Points across the image, the window in which each is followed (px), and how far (px) following it back may miss it.
_ACROSS, _WINDOW, _BACK_PX = 40, 15, 1.0
# How far (px of the colour image) a point may be from where the motion takes it, trials, and confidence in the best.
_MISS_PX, _TRIALS, _CONFIDENCE = 2.0, 500, 0.999
# The fewest points that tell, and the part of them that has to agree.
_FEWEST, _MAJORITY = 40, 0.5


def not_with_most(e: Engine, frames: Sequence[DeviceFrame], rays: FloatArray) -> Mask | None:
    """Pixels (gh, gw) of the first frame's grid that do not move as most of it does; None where that cannot be told.

    frames: in order; rays (h, w, 2): of the depth camera. Lines are taken to be exposed at once: pixels are asked for,
    not tenths.
    """
    if len(frames) < 2:
        return None
    first = frames[0].depth
    lens = first.exposure.lens
    shape = lens.camera.height, lens.camera.width
    step = max(1, lens.camera.width // _ACROSS)
    pick = (slice(step // 2, None, step), slice(step // 2, None, step))
    rho = e.download(first.inverse_z, shape)
    known = on_one_surface(rho)[pick]

    def points(rho: Image) -> FloatArray:
        z = 1.0 / rho[pick][known]
        return np.stack([rays[..., 0][pick][known] * z, rays[..., 1][pick][known] * z, z], axis=-1)

    if all(frame.colors for frame in frames):
        told = _by_colors(e, frames, points(rho))
    else:
        later = [e.download(frame.depth.inverse_z, shape) for frame in frames[1:]]
        off = apart(points(averaged(rho)), later, rays, lens.camera)
        told = np.isfinite(off), goes_elsewhere(off)
    if told is None:
        return None
    good, elsewhere = told
    if np.count_nonzero(good) < _FEWEST or np.count_nonzero(good & ~elsewhere) < _MAJORITY * np.count_nonzero(good):
        return None
    # +1: goes another way, -1: with most, 0: not known, to be told by those about it.
    cells = np.zeros(known.shape, np.float32)
    cells[known] = np.where(good, np.where(elsewhere, 1.0, -1.0), 0.0)
    odd = np.where(cells == 0.0, cv2.blur(cells, (3, 3)), cells + 0.25 * cv2.blur(cells, (3, 3))) > 0.0
    size = grid_shape(lens)[::-1]
    return np.asarray(cv2.resize(odd.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0)


def _by_colors(e: Engine, frames: Sequence[DeviceFrame], p_depth: FloatArray) -> tuple[Mask, Mask] | None:
    """Which points (n, 3) of the first frame, in its depth camera, could be followed, and which go elsewhere."""
    exposure = frames[0].colors[0].exposure
    camera = exposure.lens.camera
    p_color = se3.transform(exposure.T_cam_body, p_depth)
    uv, _ = camera.project(p_color)
    followed, good = _follow([_grey(e, frame.colors[0]) for frame in frames], uv)
    good &= camera.contains(uv) & camera.contains(followed)
    if np.count_nonzero(good) < _FEWEST:
        return None
    to = camera.unproject(followed[good])[:, :2]
    found, _, _, inliers = cv2.solvePnPRansac(
        p_color[good], to, np.eye(3), None, iterationsCount=_TRIALS, reprojectionError=_MISS_PX / camera.fx,
        confidence=_CONFIDENCE, flags=cv2.SOLVEPNP_EPNP,
    )  # fmt: skip
    if not found or inliers is None:
        return None
    elsewhere = good.copy()
    elsewhere[np.flatnonzero(good)[inliers[:, 0]]] = False
    return good, elsewhere


def _grey(e: Engine, image: ColorImage) -> npt.NDArray[np.uint8]:
    camera = image.exposure.lens.camera
    values = e.download(image.levels[0], (camera.height, camera.width))
    return np.asarray(np.nan_to_num(255.0 * values, nan=255.0).clip(0, 255).astype(np.uint8))


def _follow(images: Sequence[npt.NDArray[np.uint8]], uv: FloatArray) -> tuple[FloatArray, Mask]:
    """Where points (n, 2) of the first image are in the last one, and whether they could be followed from image to
    image."""
    at, good = uv.astype(np.float32)[:, None], np.ones(len(uv), bool)
    for before, after in pairwise(images):
        to, seen = _flow(before, after, at)
        back, seen_back = _flow(after, before, to)
        good &= seen & seen_back & (np.linalg.norm((back - at)[:, 0], axis=1) < _BACK_PX)
        at = to
    return at[:, 0].astype(np.float64), good


def _flow(
    before: npt.NDArray[np.uint8], after: npt.NDArray[np.uint8], at: npt.NDArray[np.float32]
) -> tuple[npt.NDArray[np.float32], Mask]:
    to, seen, _ = cv2.calcOpticalFlowPyrLK(before, after, at, at.copy(), winSize=(_WINDOW, _WINDOW))
    return np.asarray(to, np.float32), np.asarray(seen)[:, 0] > 0
