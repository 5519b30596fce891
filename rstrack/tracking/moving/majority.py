"""What most of the first images agrees on, in the motion of one camera: by colours, or by depth alone.

At the start no keyframe is known to be at rest, and something large and near may hold more of the weight than the room
behind it: aligned from nothing, the camera then seems to go along with it. Points are spread evenly over the image, so
that areas count, not gradients. They are followed through colours, or held against later depth images; RANSAC finds the
motion of most. What does not follow it is left out of the first image while the others are aligned to the rest.
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
from rsgen.geometry.camera import Camera
from rstrack.alignment.free_space import grid_shape
from rstrack.data.moving_masks import Mask
from rstrack.images.device_frame import DeviceFrame
from rstrack.images.pyramid import ColorImage
from rstrack.images.sampling import EDGE
from rstrack.keyframes.surface import FloatImage, on_one_surface, surface_slopes

# Pixels over which inverse depth is averaged.
_AVERAGED = 5
# How far (m, and m at one metre growing with the square of the distance) a point may be off the surface.
_OFF_M, _OFF_Z2 = 0.002, 1.5e-3
# Metres behind a surface from which on a point is hidden by it.
_HIDDEN_M = 0.15
# Trials of six points each, how many of the best are made better, in how many rounds, how many that differ are tried,
# and how many motions are followed to the next image. Seed of the trials; what holds directions that no point tells.
_TRIALS, _REFINED, _ROUNDS, _APART, _FOLLOWED, _SEED, _HOLD = 300, 12, 6, 4, 3, 0, 1e-3
# Points across the image, the window in which each is followed (px), and how far (px) following it back may miss it.
_ACROSS, _WINDOW, _BACK_PX = 40, 15, 1.0
# How far (px of the colour image) a point may be from where the motion takes it, trials, and confidence in the best.
_MISS_PX, _COLOR_TRIALS, _CONFIDENCE = 2.0, 500, 0.999
# The fewest points that tell, and the part of them that has to agree.
_FEWEST, _MAJORITY = 40, 0.5


def averaged(rho: FloatImage) -> FloatImage:
    """Inverse depth (h, w; 0 missing) averaged over a few pixels that have it, but for edges."""
    size = (_AVERAGED, _AVERAGED)
    share = cv2.blur((rho > 0).astype(np.float32), size)
    mean = cv2.blur(rho, size) / np.maximum(share, 1e-6)
    return np.where((rho > 0) & (np.abs(mean - rho) < EDGE * rho), mean, rho).astype(np.float32)


def apart(points: FloatArray, images: Sequence[FloatImage], rays: FloatArray, camera: Camera) -> FloatArray:
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
    points: FloatArray, T: FloatArray, rho: FloatImage, slopes: tuple[FloatImage, ...], rays: FloatArray, camera: Camera
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


def not_with_most(e: Engine, frames: Sequence[DeviceFrame], rays: FloatArray) -> Mask | None:
    """Pixels (gh, gw) of the first frame's grid that do not move as most of it does; None where that is not known.

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

    def points(rho: FloatImage) -> FloatArray:
        z = 1.0 / rho[pick][known]
        return np.stack([rays[..., 0][pick][known] * z, rays[..., 1][pick][known] * z, z], axis=-1)

    if all(frame.colors for frame in frames):
        found = _by_colors(e, frames, points(rho))
    else:
        later = [e.download(frame.depth.inverse_z, shape) for frame in frames[1:]]
        off = apart(points(averaged(rho)), later, rays, lens.camera)
        found = np.isfinite(off), goes_elsewhere(off)
    if found is None:
        return None
    good, elsewhere = found
    if np.count_nonzero(good) < _FEWEST or np.count_nonzero(good & ~elsewhere) < _MAJORITY * np.count_nonzero(good):
        return None
    # +1: goes another way, -1: with most, 0: not known, to be filled in from those about it.
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
        p_color[good], to, np.eye(3), None, iterationsCount=_COLOR_TRIALS, reprojectionError=_MISS_PX / camera.fx,
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
