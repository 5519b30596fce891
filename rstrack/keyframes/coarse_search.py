"""Where a frame was taken, roughly: keyframes and the frame as small images, aligned from many starts at once.

for place, T_ref_cam in ranked(small_frame(frame, rig, geometric), [(small_keyframe(ref), T_ref_cam), ...]):
    ...

Direct alignment of images of 20×15 pixels, blurred by their size, in the spirit of the small blurry images of Klein and
Murray, ECCV 2008, but with depth, so that all six degrees of freedom are found. Turns of up to 30° are tried; the
residuals' basin does the rest. Rolling shutters are taken for global ones: a pose is good to about a degree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rstrack.data.rig import Rig
from rstrack.images.device_frame import DeviceFrame
from rstrack.images.pyramid import thumbnail
from rstrack.keyframes.keyframe import Reference

# Scales of the residuals: of depth as a part of it, of intensity over the image's standard deviation.
_SIGMA_DEPTH, _SIGMA_COLOR = 0.10, 0.5
# A point counts 1 where it fits, and less than nothing where it does not; one that is not seen counts nothing.
_UNFIT = 0.4
# Turns (rad) about x, y and z that are tried in each combination, how many starts are followed, and for how many steps.
_PITCH, _YAW = np.radians([-16.0, -8.0, 0.0, 8.0, 16.0]), np.radians([-30.0, -20.0, -10.0, 0.0, 10.0, 20.0, 30.0])
_FOLLOWED, _STEPS = 12, 12
_DAMPING, _LONGEST = 1e-3, np.array([0.3, 0.2])
# Score below which a place is none, and part of the best score that another place needs to be tried.
_LEAST_SCORE, _RIVAL = 0.15, 0.6
# Points on a keyframe below which there is no search.
_LEAST_POINTS = 40


@dataclass(frozen=True)
class SmallImage:
    """A pinhole image (h, w) and its camera matrix's fx, fy, cx, cy (4,); NaN where nothing is known."""

    values: FloatArray
    intrinsics: FloatArray


@dataclass(frozen=True)
class SmallFrame:
    """A frame's inverse depth (1/m) and intensity, either may be missing; T_color_depth (4, 4)."""

    inverse_depth: SmallImage | None
    intensity: SmallImage | None
    T_color_depth: FloatArray


@dataclass(frozen=True)
class SmallKeyframe:
    """A keyframe's points (n, 3) in its camera's frame, m, and their intensities (n,), NaN where unknown."""

    points: FloatArray
    intensity: FloatArray


def small_frame(frame: DeviceFrame, rig: Rig, geometric: bool) -> SmallFrame:
    """A frame as the search takes it. geometric: whether its depth is looked at."""
    depth = frame.depth.thumbnail
    inverse_depth = _pinhole(np.where(depth > 0, depth, np.nan), rig.depth_camera) if geometric else None
    intensity = None
    if frame.colors:
        grey = frame.colors[0].thumbnail
        intensity = _pinhole(np.where(grey > 0, grey, np.nan), rig.color_camera)
    return SmallFrame(inverse_depth, intensity, rig.T_color_depth)


def small_keyframe(ref: Reference) -> SmallKeyframe:
    """A keyframe as the search takes it."""
    rho = np.asarray(ref.depth_thumbnail, float)
    uv = _centres(rho.shape, ref.lens.camera)[rho > 0]
    points = ref.lens.camera.unproject(uv) / rho[rho > 0][:, None]
    if ref.intensity is None:
        return SmallKeyframe(points, np.full(len(points), np.nan))
    known = np.isfinite(ref.intensity)
    grey = np.asarray(thumbnail(np.where(known, ref.intensity, np.float32(0.0)), known), float)[rho > 0]
    return SmallKeyframe(points, np.where(grey > 0, grey, np.nan))


def ranked(frame: SmallFrame, places: Sequence[tuple[SmallKeyframe, FloatArray]]) -> list[tuple[int, FloatArray]]:
    """Places, keyframes with a pose T_ref_cam (4, 4) to begin at, where a frame may have been taken: their numbers and
    its pose T_ref_cam there, the best first."""
    found = [search(frame, keyframe, T[None]) for keyframe, T in places]
    best = max((score for _, score in found), default=0.0)
    order = sorted(range(len(found)), key=lambda k: -found[k][1])
    return [(k, found[k][0]) for k in order if found[k][1] > max(_LEAST_SCORE, _RIVAL * best)]


def search(frame: SmallFrame, keyframe: SmallKeyframe, T_ref_cam: FloatArray) -> tuple[FloatArray, float]:
    """Pose T_ref_cam (4, 4) at which a frame fits a keyframe best, and how well: 1 as well as can be, 0 not at all.

    T_ref_cam (k, 4, 4): where to begin, each turned in many ways.
    """
    if len(keyframe.points) < _LEAST_POINTS or (frame.inverse_depth is None and frame.intensity is None):
        return T_ref_cam[0], 0.0
    turns = np.array([[0.0, 0.0, 0.0, pitch, yaw, 0.0] for pitch in _PITCH for yaw in _YAW])
    starts = (T_ref_cam[:, None] @ se3.exp(turns)[None]).reshape(-1, 4, 4)
    T = se3.inverse(starts)
    score = _Fit.at(frame, keyframe, T).score
    T = T[np.argsort(-score, kind="stable")[:_FOLLOWED]]
    best, best_score = T.copy(), np.full(len(T), -np.inf)
    for _ in range(_STEPS):
        fit = _Fit.at(frame, keyframe, T)
        better = fit.score > best_score
        best[better], best_score[better] = T[better], fit.score[better]
        T = se3.exp(fit.step()) @ T
    chosen = int(np.argmax(best_score))
    return se3.inverse(best[chosen]), float(best_score[chosen])


# ---------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Fit:
    """Residuals over their scales (s, m), NaN where there is none, and derivatives (s, m, 6) by twists of s poses.

    score (s,): see `search`.
    """

    residuals: FloatArray
    derivatives: FloatArray
    score: FloatArray

    @classmethod
    def at(cls, frame: SmallFrame, keyframe: SmallKeyframe, T_cam_ref: FloatArray) -> _Fit:
        q = keyframe.points @ np.swapaxes(T_cam_ref[:, :3, :3], 1, 2) + T_cam_ref[:, None, :3, 3]
        terms = []
        if frame.inverse_depth is not None:
            rho, slope = _sampled(frame.inverse_depth, q)
            z = q[..., 2]
            gradient = z[..., None] * slope
            gradient[..., 2] += rho
            terms.append(((z * rho - 1.0) / _SIGMA_DEPTH, gradient / _SIGMA_DEPTH))
        if frame.intensity is not None:
            R, t = frame.T_color_depth[:3, :3], frame.T_color_depth[:3, 3]
            value, slope = _sampled(frame.intensity, q @ R.T + t)
            gain, offset = _regression(keyframe.intensity, value)
            values = frame.intensity.values
            spread = float(np.nanstd(values)) if np.isfinite(values).any() else 0.0
            scale = _SIGMA_COLOR * max(spread, 1e-3)
            terms.append(((value - gain * keyframe.intensity - offset) / scale, slope @ R / scale))
        residuals = np.concatenate([r for r, _ in terms], axis=1)
        gradients = np.concatenate([g for _, g in terms], axis=1)
        points = np.concatenate([q] * len(terms), axis=1)
        derivatives = np.concatenate([gradients, np.cross(points, gradients)], axis=-1)
        scores = [np.where(np.isnan(r), 0.0, 1.0 / (1.0 + r * r) - _UNFIT).mean(axis=1) for r, _ in terms]
        return cls(residuals, derivatives, np.asarray(np.mean(scores, axis=0) / (1.0 - _UNFIT)))

    def step(self) -> FloatArray:
        """Increments (s, 6) of the poses, Gauss-Newton with Cauchy weights, no longer than is sensible."""
        seen = np.isfinite(self.residuals) & np.isfinite(self.derivatives).all(axis=-1)
        r = np.where(seen, self.residuals, 0.0)
        J = np.where(seen[..., None], self.derivatives, 0.0)
        wJ = J / (1.0 + r * r)[..., None] ** 2
        H = np.swapaxes(wJ, 1, 2) @ J
        H += _DAMPING * np.maximum(np.trace(H, axis1=1, axis2=2), 1.0)[:, None, None] * np.eye(6)
        step = -np.linalg.solve(H, np.einsum("smk,sm->sk", wJ, r)[..., None])[..., 0]
        sizes = np.linalg.norm(step.reshape(-1, 2, 3), axis=2)
        return np.asarray(step * np.minimum(1.0, (_LONGEST / np.maximum(sizes, 1e-9)).min(axis=1))[:, None])


def _centres(shape: tuple[int, ...], camera: Camera) -> FloatArray:
    """Where in a camera's image the pixels (h, w) of a smaller one have their centres (h, w, 2)."""
    scale = np.array([camera.width / shape[1], camera.height / shape[0]])
    small = np.stack(np.meshgrid(np.arange(shape[1]), np.arange(shape[0])), axis=-1)
    return np.asarray((small + 0.5) * scale - 0.5)


def _pinhole(image: FloatArray, camera: Camera) -> SmallImage:
    """A small image of a camera without its distortion."""
    h, w = image.shape
    scale = np.array([camera.width / w, camera.height / h])
    fx, fy = np.array([camera.fx, camera.fy]) / scale
    cx, cy = (np.array([camera.cx, camera.cy]) + 0.5) / scale - 0.5
    values = np.asarray(image, float)
    if camera.model != "pinhole":
        u, v = np.meshgrid(np.arange(w), np.arange(h))
        rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(u.shape)], axis=-1)
        at = (camera.project(rays)[0] + 0.5) / scale - 0.5
        at = np.nan_to_num(at, nan=-9.0).astype(np.float32)
        values = cv2.remap(values, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderValue=float("nan"))
    return SmallImage(np.asarray(values), np.array([fx, fy, cx, cy]))


def _sampled(image: SmallImage, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Values (s, n) of an image where points (s, n, 3) fall, NaN elsewhere, and their gradients (s, n, 3) by these."""
    fx, fy, cx, cy = image.intrinsics
    h, w = image.values.shape
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(q[..., 2] > 0.05, 1.0 / q[..., 2], np.nan)
        x, y = q[..., 0] * inverse, q[..., 1] * inverse
        u, v = fx * x + cx, fy * y + cy
        inside = (u >= 0.0) & (v >= 0.0) & (u < w - 1.0) & (v < h - 1.0)
    u, v = np.where(inside, u, 0.0), np.where(inside, v, 0.0)
    i, j = u.astype(np.intp), v.astype(np.intp)
    du, dv = u - i, v - j
    flat = image.values.ravel()
    at = j * w + i
    a, b, c, d = flat[at], flat[at + 1], flat[at + w], flat[at + w + 1]
    along_u, along_v = (b - a) * (1.0 - dv) + (d - c) * dv, (c - a) * (1.0 - du) + (d - b) * du
    value = np.where(inside, a + (b - a) * du + (c - a) * dv + (a - b - c + d) * du * dv, np.nan)
    gu, gv = fx * along_u * inverse, fy * along_v * inverse
    return value, np.stack([gu, gv, -(gu * x + gv * y)], axis=-1)


def _regression(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gain and offset (s, 1) with which x (n,) comes closest to y (s, n) where both are known."""
    both = np.isfinite(x) & np.isfinite(y)
    count = np.maximum(both.sum(axis=1, keepdims=True), 1)
    x, y = np.where(both, x, 0.0), np.where(both, y, 0.0)
    mean_x, mean_y = x.sum(axis=1, keepdims=True) / count, y.sum(axis=1, keepdims=True) / count
    spread = (x * x).sum(axis=1, keepdims=True) / count - mean_x**2
    shared = (x * y).sum(axis=1, keepdims=True) / count - mean_x * mean_y
    gain = np.clip(shared / np.maximum(spread, 1e-6), 0.3, 3.0)
    return gain, mean_y - gain * mean_x
