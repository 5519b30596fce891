"""Plain NumPy twins of the passes over a keyframe's surface and its points: whole arrays, one operation at a time."""

from __future__ import annotations

import numpy as np

from rstrack.images.sampling import EDGE


def slopes(rho: np.ndarray, fx: float, fy: float) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of inverse depth (h, w), averaged over 5×5 pixels, mirrored at the border."""
    along_x = _along_x(rho.astype(float), fx)
    return along_x, _along_x(rho.T.astype(float), fy).T


def _along_x(rho: np.ndarray, focal: float) -> np.ndarray:
    height, width = rho.shape
    step = np.diff(rho, axis=1)
    on = (rho[:, 1:] > 0) & (rho[:, :-1] > 0) & (np.abs(step) < EDGE * rho[:, 1:])
    total, count = np.zeros((2, height, width))
    for side in (slice(None, -1), slice(1, None)):
        total[:, side] += np.where(on, step, 0.0)
        count[:, side] += on
    total, count = (np.pad(a, 2, mode="reflect") for a in (total, count))
    windows = [np.lib.stride_tricks.sliding_window_view(a, (5, 5)).sum(axis=(2, 3)) for a in (total, count)]
    return focal * windows[0] / np.maximum(windows[1], 1.0)


def roughness(rho: np.ndarray, slope_x: np.ndarray, slope_y: np.ndarray, fx: float, fy: float) -> np.ndarray:
    """Five eighths of z² times the larger second difference (h, w), from slopes on both sides."""
    bend = np.zeros((2, *rho.shape))
    bend[0, :, 1:-1] = np.abs(slope_x[:, 2:] - slope_x[:, :-2]) / (2.0 * fx)
    bend[1, 1:-1] = np.abs(slope_y[2:] - slope_y[:-2]) / (2.0 * fy)
    z = np.where(rho > 0, 1.0 / np.where(rho > 0, rho, 1.0), 0.0)
    return 0.625 * z**2 * bend.max(axis=0)


def one_surface(rho: np.ndarray) -> np.ndarray:
    """Pixels (h, w) with depth and no edge to the right, left, above or below."""
    valid = rho > 0
    for axis in (0, 1):
        a, b = (rho[1:], rho[:-1]) if axis == 0 else (rho[:, 1:], rho[:, :-1])
        edge = np.abs(a - b) > np.float32(EDGE) * np.maximum(a, b)
        later, earlier = (np.s_[1:], np.s_[:-1]) if axis == 0 else (np.s_[:, 1:], np.s_[:, :-1])
        valid[later] &= ~edge
        valid[earlier] &= ~edge
    return valid


def points(
    rho: np.ndarray, rays: np.ndarray, image: np.ndarray, known: np.ndarray, stride: int, level: int
) -> tuple[np.ndarray, ...]:
    """x, y, z, intensity and slope of every stride-th pixel; image, known: of a level."""
    pick = (slice(None, None, stride),) * 2
    on_level = (slice(None, None, stride // 2**level),) * 2
    z = np.where(one_surface(rho)[pick] & known[on_level], 1.0 / np.maximum(rho[pick], 1e-6), 0.0)
    gy, gx = np.gradient(image.astype(float))
    slope = np.where(z > 0, np.hypot(gx, gy)[on_level] / 2**level * rho[pick], -1.0)
    return rays[..., 0][pick] * z, rays[..., 1][pick] * z, z, image[on_level], slope
