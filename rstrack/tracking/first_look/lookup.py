"""Points of depth images looked up in pairs of colour images, along a track that depth alone gives."""

from __future__ import annotations

from functools import reduce

import cv2
import numpy as np

from rsgen.array_types import BoolArray, Float32Array, FloatArray
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.spline import Spline
from rstrack.data.dataset import Dataset
from rstrack.images.pyramid import intensity
from rstrack.tracking.first_look.depth_track import DepthTrack

# Of the frames every so manieth has its depth looked up in pairs of images so many frames apart.
_EVERY, _APART = 4, (4, 8)
# Depth pixels looked up in a line: of 106 clocks are known no better than tracks are.
_ACROSS = 53
# 8-bit values that are clipped, and their neighbours; in any channel, since how bright images are is compared here.
_BLACK, _WHITE = 4, 250
_ROUNDS = 3
# Poses of so many lines are blended from those at both ends: half a millisecond, over which no camera turns noticeably.
_BLENDED = 8
# A depth image shows a point where it is no further off than this and this part of its distance: noise, and a pixel.
_SAME_M, _SAME = 0.02, 0.02
# Noise of colour images against each other, over their contrast, above which a track is not to be believed.
MOST_NOISE = 0.25


def pairs_in(dataset: Dataset, frames: range, begin: float, end: float) -> list[tuple[int, int, int]]:
    """(frame, colour image, colour image) whose lines lie in [begin, end] seconds."""
    readout = max(dataset.rig.depth_shutter.readout_s, dataset.rig.color_shutter.readout_s)
    latest = end - readout

    def color(k: int) -> int | None:
        group = dataset.groups[k] if k in frames else ()
        return next((i for i in group if begin <= dataset.color_stamps[i] <= latest), None)

    pairs = []
    for k in frames[::_EVERY]:
        for apart in _APART:
            i, j = color(k), color(k + apart)
            if i is not None and j is not None and begin <= dataset.stamps[k] <= latest:
                pairs.append((k, i, j))
    return pairs


def points_of(dataset: Dataset, spline: Spline, k: int) -> FloatArray:
    """Points (n, 3) in the world of frame k's depth, each line with its own pose."""
    camera, shutter = dataset.rig.depth_camera, dataset.rig.depth_shutter
    step = max(camera.width // _ACROSS, 1)
    pixels = camera.pixel_grid()[::step, ::step].reshape(-1, 2)
    z = dataset.depth(k)[::step, ::step].reshape(-1)
    rays = camera.unproject(pixels)
    known = (z > 0.0) & np.isfinite(rays).all(axis=1)
    lines = shutter.line_of_pixel(pixels[known], camera)
    T = spline.pose(shutter.line_mid_time(dataset.stamps[k], np.arange(shutter.line_count(camera)), camera))
    return se3.transform(T[lines.astype(np.int64)], rays[known] * z[known, None])


def rests(dataset: Dataset, spline: Spline, p_world: FloatArray, k: int) -> BoolArray:
    """Which of points (n, 3) depth image k shows where they were: not what moves by itself, or what it hides."""
    camera, shutter = dataset.rig.depth_camera, dataset.rig.depth_shutter
    times = shutter.line_mid_time(dataset.stamps[k], np.arange(shutter.line_count(camera)), camera)
    uv, p_cam = (found[0] for found in _projected(camera, shutter, se3.inverse(spline.pose(times))[None], p_world))
    seen = camera.contains(uv)
    u, v = np.rint(np.where(seen[:, None], uv, 0.0)).astype(np.int64).T
    z = dataset.depth(k)[np.minimum(v, camera.height - 1), np.minimum(u, camera.width - 1)]
    off = np.abs(z - p_cam[:, 2])
    return np.asarray(seen & (z > 0.0) & (off < _SAME_M + _SAME * p_cam[:, 2]))


def _projected(
    camera: Camera, shutter: Shutter, T_cam_world: FloatArray, p_world: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Pixels (m, n, 2) and points (m, n, 3) in the camera of points (n, 3), in m images whose lines have poses (m,
    lines, 4, 4).

    Equation (3) by fixed-point iteration, with the pose of the nearest line: a hundredth of a pixel.
    """
    images, last = np.arange(len(T_cam_world))[:, None], T_cam_world.shape[1] - 1
    line = np.full((len(T_cam_world), 1), (last + 1) // 2)
    for _ in range(_ROUNDS):
        p_cam = se3.transform(T_cam_world[images, line], p_world)
        uv, _ = camera.project(p_cam)
        line = np.clip(np.rint(np.nan_to_num(shutter.line_of_pixel(uv, camera))), 0, last).astype(np.int64)
    return uv, p_cam


def image_of(dataset: Dataset, track: DepthTrack, i: int) -> Float32Array:
    """Intensities (h/2, w/2) of colour image i, NaN near clipped pixels; made once for all looks along a track.

    Raises UserError: it cannot be read.
    """
    if i not in track.halves:
        color = dataset.images.color(i)
        grey = np.asarray(cv2.pyrDown(intensity(color)))
        brightest = np.asarray(reduce(cv2.max, cv2.split(color)))
        clipped = ((brightest >= _WHITE) | (brightest <= _BLACK)).astype(np.uint8)
        near = cv2.dilate(clipped, np.ones((7, 7), np.uint8))[::2, ::2]
        track.halves[i] = np.where(near > 0, np.float32(np.nan), grey)
    return track.halves[i]


def pixels_of(dataset: Dataset, spline: Spline, p_world: FloatArray, stamps: FloatArray) -> FloatArray:
    """Where colour images stamped `stamps` (m,) have points (n, 3): pixels (m, n, 2), NaN where they are not seen."""
    camera, shutter, T_color_depth = dataset.rig.color_camera, dataset.rig.color_shutter, dataset.rig.T_color_depth
    count = shutter.line_count(camera)
    lines = np.arange(0, count + _BLENDED - 1, _BLENDED)
    times = np.clip(shutter.line_mid_time(stamps[:, None], lines, camera), spline.t_begin, spline.t_end)
    known = T_color_depth @ se3.inverse(spline.pose(times))
    first, part = np.divmod(np.arange(count), _BLENDED)
    part = part[:, None, None] / _BLENDED
    uv, _ = _projected(camera, shutter, (1.0 - part) * known[:, first] + part * known[:, first + 1], p_world)
    return np.where(camera.contains(uv)[..., None], uv, np.nan)


def values_at(half: Float32Array, uv: FloatArray) -> FloatArray:
    """Values (m, n) at pixels (m, n, 2) of an image that is stored in half its size; NaN beside it and beside NaN."""
    u, v = np.nan_to_num(0.5 * uv, nan=-10.0).astype(np.float32).transpose(2, 0, 1)
    border = cv2.BORDER_CONSTANT
    return np.asarray(cv2.remap(half, u, v, cv2.INTER_LINEAR, borderMode=border, borderValue=float("nan")), np.float64)


def disagreement(a: FloatArray, b: FloatArray) -> tuple[FloatArray, float]:
    """Student-t cost (m,) of intensities b (m, n) against gain · a + offset, fitted to each of the m; and its σ over
    that of b.

    One σ for all, from where they agree best: the costs are log-likelihoods up to a constant, for n independent points.
    """
    errors = _residuals(a, b)
    sigma = max(float(np.min(1.4826 * np.median(np.abs(errors), axis=1))), 1e-3)
    contrast = max(1.4826 * float(np.median(np.abs(b - np.median(b)))), 1e-3)
    return np.asarray(3.0 * np.log1p((errors / sigma) ** 2 / 5.0).sum(axis=1)), sigma / contrast


def _residuals(x: FloatArray, y: FloatArray) -> FloatArray:
    """y − gain · x − offset (m, n), each of the m fitted with Student-t weights (ν = 5); closed form in every round."""

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(np.einsum("mn,mn->m", w, values)[:, None] / w.sum(axis=1, keepdims=True))

    w = np.ones_like(x)
    for _ in range(4):
        dx, dy = x - mean(x), y - mean(y)
        gain = mean(dx * dy) / np.maximum(mean(dx * dx), 1e-12)
        r = dy - gain * dx
        sigma = np.maximum(1.4826 * np.median(np.abs(r), axis=1, keepdims=True), 1e-3)
        w = 6.0 / (5.0 + (r / sigma) ** 2)
    return r
