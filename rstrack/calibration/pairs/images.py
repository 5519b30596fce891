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

from rsgen.array_types import FloatArray, IntArray
from rsgen.device.arrays import Engine
from rsgen.device.lens import Lens
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.spline import Spline
from rstrack.alignment.block_sums import block_counts
from rstrack.calibration.parameters import DRIFT, EXTRINSICS, Parameters
from rstrack.images.fast_spline import motions, rows
from rstrack.images.line_poses import NODES
from rstrack.images.sampling import EDGE
from rstrack.keyframes.keyframe import depth_scaling
from rstrack.keyframes.surface import surface_bends, surface_slopes

# Part of the width over which inverse depth is averaged, to either side.
_WINDOW = 1.0 / 160.0
# Inverse depth larger by this part may hide a point from the colour camera.
_HIDES = 0.2
ACROSS = 6
"""Images in a row of an atlas, which has as many rows at most: float32 places pixels to 2e-4 px still."""
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

    def mid_time(self, p: Parameters) -> float:
        """Mid readout, s."""
        first, readout = self.begin(p)
        return first + 0.5 * readout * (1.0 - 1.0 / self.lens.lines)


@dataclass(frozen=True)
class LinePoses:
    """The lines of one camera's images for some spline and parameters.

    to_base (images, lines, 12), from_base (images, lines, 18): as `line_poses` has them, of a base frame. Derivatives
    of the twist, in the base frame, of each block's middle: slopes (images, blocks, 6, 24 + m) by the four control
    points from `first` (images, blocks) on, and by the m parameters `moved` (places among NAMES).
    """

    to_base: Float32Image
    from_base: Float32Image
    first: IntArray
    slopes: FloatArray
    moved: tuple[int, ...]


def lines_of(images: Sequence[ImageTiming], spline: Spline, p: Parameters, T_base_world: FloatArray) -> LinePoses:
    """Where the lines of images were, which one camera took, and what that depends on.

    A line's time is begin + readout l / lines: a later one moves its pose by its velocity. Extrinsics move the colour
    camera against the body, which is the depth camera: by −Ad(T_world_color) ε. Derivatives of all images
    are worked out at once: calls of NumPy cost more than numbers do.
    """
    lens, is_depth = images[0].lens, images[0].is_depth
    begin = np.array([taken.begin(p) for taken in images])
    T_cam_body = np.eye(4) if is_depth else p.T_color_depth

    def times(lines: FloatArray) -> FloatArray:
        """Of lines (n,): (images, n)."""
        # Times that a step too far has led out of the spline are brought back: the next one leads back.
        return np.clip(begin[:, :1] + begin[:, 1:] * (lines / lens.lines), spline.t_begin, spline.t_end)

    blocks, _, per, _ = block_counts(lens, lens)
    middle = _middles(blocks, per, lens.lines)
    t = times(middle)
    T_world_body, velocity = motions(spline, t.ravel())
    Ad = se3.adjoint(T_base_world @ T_world_body.reshape(*t.shape, 4, 4))
    by_time = (Ad @ velocity.reshape(*t.shape, 6, 1))[..., 0]
    by_readout = by_time * (middle / lens.lines)[:, None]
    columns, moved = [by_readout[..., None]], (0,)
    if not is_depth:
        since = np.array([taken.stamp - p.epoch_s for taken in images])
        by_drift = by_time * since[:, None, None]
        by_pose = -Ad @ se3.adjoint(se3.inverse(T_cam_body))
        columns = [*(by[..., None] for by in (by_readout, by_time, by_drift)), by_pose]
        moved = (1, 2, DRIFT, *range(EXTRINSICS.start, EXTRINSICS.stop))
    first, J = spline.pose_jacobian(t)
    by_points = np.moveaxis(se3.adjoint(T_base_world) @ J, 2, 3).reshape(*first.shape, 6, 24)
    slopes = np.concatenate([by_points, *columns], axis=-1)
    # Poses of the lines from those of every few of them.
    per = max(1, lens.lines // NODES)
    nodes, delay = _middles(-(-lens.lines // per), per, lens.lines), begin[0, 1] / lens.lines
    after = delay * (np.arange(len(nodes) * per) - nodes.repeat(per)).reshape(len(nodes), per)
    to_base, from_base = (np.empty((len(images), lens.lines, n), np.float32) for n in (12, 18))
    for k, at in enumerate(times(nodes)):
        to_base[k] = rows(spline, at, after, lens.lines, T_base_world, se3.inverse(T_cam_body), False)
        from_base[k] = rows(spline, at, after, lens.lines, T_cam_body, se3.inverse(T_base_world), True, delay)
    return LinePoses(to_base, from_base, first, slopes, moved)


def _middles(blocks: int, per: int, lines: int) -> FloatArray:
    """The middle (blocks,) of each block of `per` lines, of which the last may have fewer."""
    first = np.arange(blocks) * per
    return np.asarray(0.5 * (first + np.minimum(first + per, lines) - 1))


def span(images: Sequence[ImageTiming], p: Parameters) -> tuple[float, float]:
    """Times (s) within which the lines of all images lie."""
    begin = np.array([image.begin(p) for image in images])
    ends = begin[:, 0], begin.sum(axis=1)
    return float(np.min(ends)), float(np.max(ends))


@dataclass(frozen=True)
class DepthSurface:
    """A depth image that others are compared with: inverse depth (1/m, 0 missing) averaged over a window, its slopes by
    normalised coordinates, how far averaging may have moved it (m), and z (m) of what the colour camera can see of it,
    else 0; all (h, w). median_depth, bound: see `Scaling`.
    """

    inverse_depth: Float32Image
    slope_x: Float32Image
    slope_y: Float32Image
    roughness: Float32Image
    shown_z: Float32Image
    median_depth: float
    bound: float


def surface_of(rho: Float32Image, fx: float, fy: float, baseline_m: float = 0.0) -> DepthSurface:
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
    return DepthSurface(rho, slope_x, slope_y, roughness, shown, *depth_scaling(rho))


@dataclass(frozen=True)
class WindowImages:
    """Images of a window's views, on the device.

    z, shown_z (views, points): m, of the pixels that are compared, 0 missing. inverse_depth, slope_*, roughness:
    atlases of `DepthSurface`; levels: atlases of intensities, NaN where they are unusable or there is no image.
    median_depth (views,): m. bounds: of depth and of colour, see `Scaling`.
    """

    z: Any
    shown_z: Any
    inverse_depth: Any
    slope_x: Any
    slope_y: Any
    roughness: Any
    levels: tuple[Any, ...]
    median_depth: FloatArray
    bounds: tuple[float, float]


def window_images(
    e: Engine, surfaces: Sequence[DepthSurface], colors: Sequence[Sequence[Float32Image]], bound: float, stride: int
) -> WindowImages:
    """From views' surfaces and their pyramids of intensities, empty where there is no image; bound: of colour."""
    rho = np.stack([surface.inverse_depth[::stride, ::stride] for surface in surfaces])
    z = np.divide(np.float32(1.0), rho, out=np.zeros_like(rho), where=rho > 0.0)
    shown = np.stack([surface.shown_z[::stride, ::stride] for surface in surfaces])
    names = "inverse_depth", "slope_x", "slope_y", "roughness"
    planes = {name: e.upload(_atlas([getattr(surface, name) for surface in surfaces])) for name in names}
    some = next(levels for levels in colors if levels)
    none = [np.full_like(level, np.nan) for level in some]
    levels = tuple(e.upload(_atlas(level)) for level in zip(*(each or none for each in colors), strict=True))
    depths, bounds = np.array([(surface.median_depth, surface.bound) for surface in surfaces]).T
    points = e.upload(z), e.upload(shown)
    return WindowImages(*points, **planes, levels=levels, median_depth=depths, bounds=(float(bounds.max()), bound))


def _atlas(images: Sequence[Float32Image]) -> Float32Image:
    """Images (h, w) side by side: a kernel that looks into any of them is handed one array."""
    height, width = images[0].shape
    if len(images) > ACROSS**2:
        raise ValueError(f"{len(images)} images do not fit into an atlas of {ACROSS} by {ACROSS}")
    out = np.zeros((-(-len(images) // ACROSS) * height, ACROSS * width), np.float32)
    for k, image in enumerate(images):
        x, y = width * (k % ACROSS), height * (k // ACROSS)
        out[y : y + height, x : x + width] = image
    return out


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
