"""Images that are compared: depth images as surfaces, and lines whose times are unknown, with the derivatives of their
poses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from rsgen.array_types import FloatArray
from rsgen.device.arrays import Engine
from rsgen.device.lens import Lens
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.spline import Spline
from rstrack.alignment.block_sums import block_counts
from rstrack.alignment.normal_equations import by_points
from rstrack.calibration.parameters import DRIFT, EXTRINSICS, POSES, Parameters
from rstrack.images.line_poses import rows_of
from rstrack.images.sampling import EDGE
from rstrack.keyframes.keyframe import depth_scaling
from rstrack.keyframes.surface import surface_bends, surface_slopes

# Part of the width over which inverse depth is averaged, to either side.
_WINDOW = 1.0 / 160.0
# Inverse depth larger by this part may hide a point from the colour camera.
_HIDES = 0.2
Float32Image = npt.NDArray[np.float32]


def pair_lens(camera: Camera, shutter: Shutter) -> Lens:
    """The lens that kernels are compiled for: with any readout, since that is an unknown."""
    return Lens(camera, Shutter(1.0, 0.0, shutter.scan))


@dataclass(frozen=True)
class ImageTiming:
    """When an image was taken. lens: see `pair_lens`. stamp: s, as the dataset has it; exposure_s: of a line."""

    lens: Lens
    stamp: float
    exposure_s: float
    is_depth: bool

    def begin(self, p: Parameters) -> tuple[float, float]:
        """Mid-exposure of line 0 and the readout, s."""
        if self.is_depth:
            return self.stamp - 0.5 * self.exposure_s, p.depth_readout_s
        return p.color_time(self.stamp) - 0.5 * self.exposure_s, p.color_readout_s

    def span(self, p: Parameters) -> tuple[float, float]:
        """Times (s) within which its lines lie."""
        first, readout = self.begin(p)
        return min(first, first + readout), max(first, first + readout)

    def mid_time(self, p: Parameters) -> float:
        """Mid readout, s."""
        first, readout = self.begin(p)
        return first + 0.5 * readout * (1.0 - 1.0 / self.lens.lines)


@dataclass(frozen=True)
class LinePoses:
    """The lines of an image for some spline and parameters.

    T_world_cam (lines, 4, 4); twist (lines, 6): the camera's own per line delay. Derivatives of the twist, in the
    world, of each block's middle: by the control points `first`, `first` + 1, ...: by_points (blocks, 6, 6k); by the
    those parameters that move poses: by_parameters (blocks, 6, 10).
    """

    T_world_cam: FloatArray
    twist: FloatArray
    first: int
    by_points: FloatArray
    by_parameters: FloatArray

    def to_base(self, T_base_world: FloatArray) -> FloatArray:
        """T_base_cam of each line (lines, 12): rotation row-major, translation."""
        return rows_of(T_base_world @ self.T_world_cam)

    def from_base(self, T_base_world: FloatArray) -> FloatArray:
        """T_cam_base of each line and the camera's twist per line delay (lines, 18)."""
        return np.concatenate([rows_of(se3.inverse(T_base_world @ self.T_world_cam)), self.twist], axis=1)


def lines_of(images: Sequence[ImageTiming], spline: Spline, p: Parameters) -> list[LinePoses]:
    """Where the lines of images were, which one camera took, and what that depends on.

    A line's time is begin + readout l / lines: a later one moves its pose by its velocity. Extrinsics move the colour
    camera against the body, which is the depth camera: by −Ad(T_world_color) ε. All images at once: calls of the
    spline cost more than numbers do.
    """
    if not images:
        return []
    lens, is_depth = images[0].lens, images[0].is_depth
    first, readout = np.array([taken.begin(p) for taken in images]).T[..., None]
    count = lens.lines
    blocks, _, per, _ = block_counts(lens, lens)
    start = np.arange(blocks) * per
    middle = 0.5 * (start + np.minimum(start + per, count) - 1) / count
    # Times that a step too far has led out of the spline are brought back: the next one leads back.
    t = np.clip(first + readout * np.concatenate([np.arange(count) / count, middle]), spline.t_begin, spline.t_end)
    T_world_body, velocity = spline.pose_and_velocity(t)
    T_cam_body = np.eye(4) if is_depth else p.T_color_depth
    T_world_cam = T_world_body[:, :count] @ se3.inverse(T_cam_body)
    twist = readout[..., None] / count * velocity[:, :count] @ se3.adjoint(T_cam_body).T

    Ad = se3.adjoint(T_world_body[:, count:])
    w_world = (Ad @ velocity[:, count:, :, None])[..., 0]
    by_parameters = np.zeros((len(images), blocks, 6, POSES))
    if is_depth:
        by_parameters[..., 0] = w_world * middle[:, None]
    else:
        by_parameters[..., 1] = w_world * middle[:, None]
        by_parameters[..., 2] = w_world
        since = np.array([taken.stamp - p.epoch_s for taken in images])
        by_parameters[..., DRIFT] = w_world * since[:, None, None]
        by_parameters[..., EXTRINSICS] = -Ad @ se3.adjoint(se3.inverse(T_cam_body))
    points, J = spline.pose_jacobian(t[:, count:])
    found = []
    for k, at in enumerate(points):
        begin, several = int(at.min()), int(np.ptp(at)) + 4
        moved = by_points(at, J[k], begin, several)
        found.append(LinePoses(T_world_cam[k], twist[k], begin, moved, by_parameters[k]))
    return found


def span(images: Sequence[ImageTiming], p: Parameters) -> tuple[float, float]:
    """Times (s) within which the lines of all images lie."""
    spans = [image.span(p) for image in images]
    return min(begin for begin, _ in spans), max(end for _, end in spans)


@dataclass(frozen=True)
class DepthSurface:
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


def surface_of(e: Engine, rho: Float32Image, fx: float, fy: float, baseline_m: float = 0.0) -> DepthSurface:
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
    return DepthSurface(*on_device, *depth_scaling(rho))


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
