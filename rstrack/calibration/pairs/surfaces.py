"""Depth images that others are compared with."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from rsgen.device.arrays import Engine
from rstrack.images.sampling import EDGE
from rstrack.keyframes.keyframe import depth_scaling, surface_bends, surface_slopes

# Part of the width over which inverse depth is averaged, to either side.
_WINDOW = 1.0 / 160.0
# Inverse depth larger by this part may hide a point from the colour camera.
_HIDES = 0.2

Float32Image = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Surface:
    """A depth image that others are compared with, on the device: inverse depth (1/m, 0 missing) averaged over a
    window, its slopes by normalised coordinates, how far averaging may have moved it (m), and z (m) of what the colour
    camera can see of it, else 0. median_depth, bound: see `Scaling`.
    """

    inverse_depth: Any
    slope_x: Any
    slope_y: Any
    roughness: Any
    shown_z: Any
    median_depth: float
    bound: float


def surface_of(e: Engine, rho: Float32Image, fx: float, fy: float, baseline_m: float = 0.0) -> Surface:
    """Of `averaged` inverse depth (h, w).

    baseline_m: at most so far is the colour camera away, from where nearer things hide some of what is seen.
    """
    width = rho.shape[1]
    slope_x, slope_y = surface_slopes(rho, fx, fy)
    z = np.divide(np.float32(1.0), rho, out=np.zeros_like(rho), where=rho > 0)
    bend_x, bend_y = surface_bends(slope_x, slope_y, fx, fy)
    # A parabola's mean over the window is off by that.
    roughness = (_window(width) ** 2 - 1) / 24.0 * z * z * (bend_x + bend_y)
    reach = max(1, math.ceil(baseline_m * fx * float(np.percentile(rho[rho > 0], 90.0)))) if (rho > 0).any() else 1
    nearest = np.asarray(cv2.dilate(rho, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)))
    shown = np.where((z > 0) & (nearest < np.float32(1.0 + _HIDES) * rho), z, np.float32(0.0))
    on_device = e.upload(rho), e.upload(slope_x), e.upload(slope_y), e.upload(roughness), e.upload(shown)
    return Surface(*on_device, *depth_scaling(rho))


def averaged(rho: Float32Image) -> Float32Image:
    """Inverse depth (h, w) averaged over windows on one surface, 0 elsewhere: exact on planes, where it is affine.

    Noise of single pixels bends surfaces, and steps of the camera's resolution move with it, not with the scene: raw
    depth gives readouts of a Kinect's images four times as badly.
    """
    window = _window(rho.shape[1])
    size = np.ones((window, window), np.uint8)
    most, least = np.asarray(cv2.dilate(rho, size)), np.asarray(cv2.erode(rho, size))
    mean = np.asarray(cv2.boxFilter(rho, cv2.CV_32F, (window, window)))
    inside = np.zeros(rho.shape, bool)
    half = window // 2
    inside[half : rho.shape[0] - half, half : rho.shape[1] - half] = True
    is_smooth = inside & (least > 0) & (most - least < np.float32(EDGE * max(1.0, window / 4.0)) * most)
    return np.where(is_smooth, mean, np.float32(0.0))


def _window(width: int) -> int:
    return 2 * max(1, round(width * _WINDOW)) + 1


def intensity_bound(image: Float32Image, fx: float, median_depth: float) -> float:
    """`Scaling.bound` of the colour term from intensities (h, w), NaN where unknown."""
    gy, gx = np.gradient(image[::2, ::2])
    slope = 0.5 * np.hypot(gx, gy)
    slope = slope[np.isfinite(slope)]
    steep = float(np.percentile(slope, 99.5)) if slope.size else 1.0
    return max(1e-2, 2.0 * fx * steep / median_depth)
