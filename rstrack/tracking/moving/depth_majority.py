"""The one motion of the camera that most of the first depth images' area agrees on, where there are no colours."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rstrack.images.device_frame import Mask
from rstrack.images.sampling import EDGE
from rstrack.keyframes.keyframe import Image, surface_slopes

# Pixels over which inverse depth is averaged.
_AVERAGED = 5
# How far (m, and m at one metre growing with the square of the distance) a point may be off the surface.
_OFF_M, _OFF_Z2 = 0.002, 1.5e-3
# Metres behind a surface from which on a point is hidden by it.
_HIDDEN_M = 0.15
# Trials of six points each, how many of the best are made better, in how many rounds, how many that differ are tried,
# and how many motions are followed to the next image. Seed of the trials; what holds directions that no point tells.
_TRIALS, _REFINED, _ROUNDS, _APART, _FOLLOWED, _SEED, _HOLD = 300, 12, 6, 4, 3, 0, 1e-3


def averaged(rho: Image) -> Image:
    """Inverse depth (h, w; 0 missing) averaged over a few pixels that have it, but for edges."""
    size = (_AVERAGED, _AVERAGED)
    share = cv2.blur((rho > 0).astype(np.float32), size)
    mean = cv2.blur(rho, size) / np.maximum(share, 1e-6)
    return np.where((rho > 0) & (np.abs(mean - rho) < EDGE * rho), mean, rho).astype(np.float32)


def apart(points: FloatArray, images: Sequence[Image], rays: FloatArray, camera: Camera) -> FloatArray:
    """How far (n,), in tolerances, points of a first image are off the last one's surface, NaN where hidden or unknown.

    points (n, 3): in the first image's camera frame, m. images: inverse depth (h, w) of those that follow; rays
    (h, w, 2): of their pixels. The camera has moved as most of the points, which are spread evenly, agree on: RANSAC
    over distances to planes, from image to image. Lines are taken to be exposed at once.
    """
    off = np.full(len(points), np.nan)
    steps = [(np.eye(4), np.eye(4))]  # motions to the image before, and to the one before that
    for rho in images:
        smooth = averaged(rho)
        surface = smooth, surface_slopes(smooth, camera.fx, camera.fy), rays, camera
        tried = []
        for T, before in steps:
            ahead = T @ se3.inverse(before) @ T
            tried += [(se3.exp(xi) @ ahead, T) for xi in _agreed(*_equations(points, ahead, *surface))]
        rated = []
        for T, before in tried:
            A, r, scale = _equations(points, T, *surface)
            T = se3.exp(_refined(A, r, scale, np.zeros((1, 6)))[0]) @ T
            _, r, scale = _equations(points, T, *surface)
            r = np.where(r < -_HIDDEN_M, np.nan, r / scale)
            rated.append((float(_hold(np.nan_to_num(r, nan=np.inf))), r, (T, before)))
        # What one image shows may be taken for another motion: the last one, furthest off, tells.
        rated.sort(key=lambda one: -one[0])
        off, steps = rated[0][1], [step for _, _, step in rated[:_FOLLOWED]]
    return off


def _equations(
    points: FloatArray, T: FloatArray, rho: Image, slopes: tuple[Image, ...], rays: FloatArray, camera: Camera
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Rows (n, 6) of increments exp(ξ) T, distances (n,) in front of the planes (m; NaN: none), and tolerances (n,)."""
    q = se3.transform(T, points)
    uv, valid = camera.project(q)
    valid = valid & camera.contains(uv)
    column, row = (np.rint(np.where(valid, uv[:, i], 0.0)).astype(int) for i in (0, 1))
    at, mx, my = (image[row, column].astype(float) for image in (rho, *slopes))
    xn, yn = rays[row, column, 0], rays[row, column, 1]
    m = np.stack([mx, my, at - mx * xn - my * yn], axis=-1)
    size = np.linalg.norm(m, axis=-1)
    known = valid & (at > 0) & (size > 0)
    n = m / np.where(known, size, 1.0)[:, None]
    r = np.where(known, (1.0 - (m * q).sum(-1)) / np.where(known, size, 1.0), np.nan)
    scale = _OFF_M + _OFF_Z2 * q[:, 2] ** 2
    return np.concatenate([n, np.cross(q, n)], axis=-1), r, scale


def _agreed(A: FloatArray, r: FloatArray, scale: FloatArray) -> FloatArray:
    """Motions ξ (k, 6) with which many of A ξ = r hold to their tolerances, each another one."""
    rows, goal = _known(A, r, scale)
    if len(goal) < 12:
        return np.zeros((1, 6))
    pick = np.random.default_rng(_SEED).integers(0, len(goal), (_TRIALS, 6))
    H = np.einsum("tij,tik->tjk", rows[pick], rows[pick]) + _HOLD * np.eye(6)
    found = np.linalg.solve(H, np.einsum("tij,ti->tj", rows[pick], goal[pick])[..., None])[..., 0]
    order = np.argsort(-_hold(goal - found @ rows.T), kind="stable")
    found = _refined(A, r, scale, np.concatenate([np.zeros((1, 6)), found[order[:_REFINED]]]))
    kept: list[FloatArray] = []
    for xi in found[np.argsort(-_hold(goal - found @ rows.T), kind="stable")]:
        if len(kept) < _APART and all(np.sqrt(np.mean((rows @ (xi - other)) ** 2)) > 0.5 for other in kept):
            kept.append(xi)
    return np.array(kept)


def _refined(A: FloatArray, r: FloatArray, scale: FloatArray, xi: FloatArray) -> FloatArray:
    """ξ (k, 6) at the next best of what they say of A ξ = r: Cauchy's weights, squared."""
    rows, goal = _known(A, r, scale)
    for _ in range(_ROUNDS):
        weight = 1.0 / (1.0 + (goal - xi @ rows.T) ** 2) ** 2
        H = np.einsum("tn,nj,nk->tjk", weight, rows, rows, optimize=True) + _HOLD * np.eye(6)
        xi = np.linalg.solve(H, np.einsum("tn,nj,n->tj", weight, rows, goal, optimize=True)[..., None])[..., 0]
    return xi


def _known(A: FloatArray, r: FloatArray, scale: FloatArray) -> tuple[FloatArray, FloatArray]:
    known = np.isfinite(r)
    return A[known] / scale[known, None], r[known] / scale[known]


def _hold(off: FloatArray) -> FloatArray:
    """How many of (..., n) hold, those that hardly do for less."""
    return np.asarray((1.0 / (1.0 + off**2)).sum(axis=-1))


def goes_elsewhere(off: FloatArray) -> Mask:
    """Which points (n,) with such distances do not move as most do."""
    return np.asarray(np.abs(np.nan_to_num(off)) > 1.0)
