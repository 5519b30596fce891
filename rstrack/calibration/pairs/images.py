"""Images whose lines' times are unknown: poses of the lines, and derivatives by control points and parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.device.lens import Lens
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.spline import Spline
from rstrack.alignment.block_sums import block_counts
from rstrack.alignment.normal_equations import Slopes
from rstrack.calibration.unknowns.parameters import DRIFT, EXTRINSICS, POSES, Parameters
from rstrack.images.line_poses import rows_of


def pair_lens(camera: Camera, shutter: Shutter) -> Lens:
    """The lens that kernels are compiled for: with any readout, since that is an unknown."""
    return Lens(camera, Shutter(1.0, 0.0, shutter.scan))


@dataclass(frozen=True)
class Taken:
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
class Lines:
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


def lines_of(taken: Taken, spline: Spline, p: Parameters) -> Lines:
    """Where the lines of an image were, and what that depends on.

    A line's time is begin + readout l / lines: a later one moves its pose by its velocity. Extrinsics move the colour
    camera against the body, which is the depth camera: by −Ad(T_world_color) ε.
    """
    first, readout = taken.begin(p)
    count = taken.lens.lines
    share = np.arange(count) / count
    T_world_body, velocity = spline.pose_and_velocity(_within(spline, first + readout * share))
    T_cam_body = np.eye(4) if taken.is_depth else p.T_color_depth
    T_world_cam = T_world_body @ se3.inverse(T_cam_body)
    twist = readout / count * velocity @ se3.adjoint(T_cam_body).T

    blocks, _, per, _ = block_counts(taken.lens, taken.lens)
    start = np.arange(blocks) * per
    middle = 0.5 * (start + np.minimum(start + per, count) - 1) / count
    t = _within(spline, first + readout * middle)
    slopes = Slopes.of(spline, np.eye(4), t, None)
    T, w = spline.pose_and_velocity(t)
    Ad = se3.adjoint(T)
    w_world = (Ad @ w[..., None])[..., 0]
    by_parameters = np.zeros((blocks, 6, POSES))
    if taken.is_depth:
        by_parameters[..., 0] = w_world * middle[:, None]
    else:
        by_parameters[..., 1] = w_world * middle[:, None]
        by_parameters[..., 2] = w_world
        by_parameters[..., DRIFT] = w_world * (taken.stamp - p.epoch_s)
        by_parameters[..., EXTRINSICS] = -Ad @ se3.adjoint(se3.inverse(T_cam_body))
    return Lines(T_world_cam, twist, slopes.first, slopes.current, by_parameters)


def _within(spline: Spline, t: FloatArray) -> FloatArray:
    """Times (n,) that a step too far has led out of the spline are brought back: the next one leads back."""
    return np.clip(t, spline.t_begin, spline.t_end)


def span(images: Sequence[Taken], p: Parameters) -> tuple[float, float]:
    """Times (s) within which the lines of all images lie."""
    spans = [image.span(p) for image in images]
    return min(begin for begin, _ in spans), max(end for _, end in spans)
