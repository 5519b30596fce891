"""Depth of one frame carried to the next with the poses of their rows, and compared with what is seen there."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from rsgen.array_types import BoolArray, FloatArray, IntArray
from rsgen.check.objects import RelativeMotion
from rsgen.geometry import se3
from rsgen.geometry.shutter import project_rolling
from rsgen.sequence.reader import Sequence

# Depth is interpolated bilinearly in 1/z, exact on planes. Where second differences say that this is off by more, there
# is an edge, or a curve too tight for the pixels: such places say nothing about poses, at any resolution.
INTERPOLATION_M = 0.0005
# A point this much (relative to its depth) behind the surface seen at its place is hidden by that surface.
OCCLUDED = 0.02
_STEP_PX = 4
_TARGET_PIXELS = 3000  # small images are sampled more densely than every fourth pixel


@dataclass(frozen=True)
class Reprojection:
    """Depth of one frame in the next: predicted minus observed z (n,) in metres where both see the same surface.

    `occluded` more pixels are hidden there by a nearer surface. number (n,): of the object that moves; 0: the scene.
    """

    residual: FloatArray
    occluded: int
    number: IntArray


def reproject_depth(sequence: Sequence, k: int, next_k: int) -> Reprojection:
    """Compare exact depth of listed frame k with that of frame next_k, every fourth pixel and row by row.

    Pixels of frame k go to the world with their own line's pose and into the other frame with the rolling-shutter
    projection (3); the planar z predicted there is compared with the observed one, interpolated bilinearly in inverse
    depth. What is on a thing that moves by itself goes with it. Left out: places where that is not good to 0.5 mm
    (edges), and points hidden by a nearer surface.
    Raises UserError for unreadable files.
    """
    stream = sequence.streams["depth"]
    stamp = float(stream.stamps[next_k])
    next_z = sequence.truth_depth(next_k).astype(np.float64)
    seen = _seen(sequence, k)
    residuals, numbers, occluded = [np.zeros(0)], [np.zeros(0, np.int64)], 0
    for which in range(len(sequence.objects) + 1):
        here = seen.number == which
        if not here.any():
            continue
        points: FloatArray = seen.p_world[here]
        motion: Any = sequence.spline
        if which:
            thing = sequence.objects[which - 1]
            points = se3.transform(se3.inverse(thing.spline.pose(seen.t[here])), points)
            motion = RelativeMotion(sequence.spline, thing.spline)
        uv_next, t, valid = project_rolling(motion, np.eye(4), stream.camera, stream.shutter, stamp, points)
        uv_next, t = uv_next[valid], t[valid]
        predicted = se3.transform(se3.inverse(motion.pose(t)), points[valid])[..., 2]
        observed, smooth = _interpolate_inverse(next_z, uv_next)
        predicted, observed = predicted[smooth], observed[smooth]
        hidden = predicted - observed > OCCLUDED * predicted
        residuals.append((predicted - observed)[~hidden])
        numbers.append(np.full(len(residuals[-1]), which))
        occluded += int(hidden.sum())
    return Reprojection(np.concatenate(residuals), occluded, np.concatenate(numbers))


def depth_points(sequence: Sequence, k: int) -> FloatArray:
    """Points (n, 3) in the world that every fourth pixel of exact depth k shows, each from its own line's pose.

    Without those on things that move by themselves. Raises UserError for unreadable files.
    """
    seen = _seen(sequence, k)
    return seen.p_world[seen.number == 0]


@dataclass(frozen=True)
class _Seen:
    """n pixels: points (n, 3) in the world, numbers (n,) of the objects they are on, and their lines' times (n,), s."""

    p_world: FloatArray
    number: IntArray
    t: FloatArray


def _seen(sequence: Sequence, k: int) -> _Seen:
    """What every fourth row and column of exact depth k shows."""
    stream = sequence.streams["depth"]
    camera = stream.camera
    step = max(1, min(_STEP_PX, math.isqrt(camera.width * camera.height // _TARGET_PIXELS)))
    z = sequence.truth_depth(k)[::step, ::step].astype(np.float64)
    uv = camera.pixel_grid()[::step, ::step][z > 0]
    p_world = se3.transform(sequence.pixel_poses("depth", k, uv), camera.backproject(uv, z[z > 0]))
    t = stream.shutter.line_mid_time(float(stream.stamps[k]), stream.shutter.line_of_pixel(uv, camera), camera)
    return _Seen(p_world, sequence.object_ids("depth", k)[::step, ::step][z > 0].astype(np.int64), np.asarray(t))


def _interpolate_inverse(z: FloatArray, uv: FloatArray) -> tuple[FloatArray, BoolArray]:
    """z (n,) at pixels uv (n, 2), bilinear in 1/z, and where that holds: inside, measured, smooth."""
    h, w = z.shape
    inverse = np.where(z > 0, 1 / np.where(z > 0, z, 1.0), 0.0)
    bend = np.full((h, w), 1e9)
    bend[1:-1, 1:-1] = np.abs(np.diff(inverse, 2, axis=1)[1:-1]) + np.abs(np.diff(inverse, 2, axis=0)[:, 1:-1])
    smooth = bend / 8 * z**2 <= INTERPOLATION_M  # a parabola's largest distance from its chord; dz = z² d(1/z)
    corner = np.clip(np.floor(uv).astype(np.int64), 0, (w - 2, h - 2))
    (x, y), (a, b) = corner.T, (uv - corner).T
    at = [(y, x), (y, x + 1), (y + 1, x), (y + 1, x + 1)]
    inside = (a >= 0) & (a <= 1) & (b >= 0) & (b <= 1)
    holds = inside & np.all([smooth[i] & (z[i] > 0) for i in at], axis=0)
    weights = [(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b]
    sum_inverse = sum(weight * inverse[i] for weight, i in zip(weights, at, strict=True))
    return 1 / np.where(holds, sum_inverse, 1.0), holds
