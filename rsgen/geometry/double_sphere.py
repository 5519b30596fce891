"""The double sphere lens in normalised coordinates: Usenko, Demmel, Cremers, The Double Sphere Camera Model, 3DV 2018.

A point at distance d1 is moved by xi along the axis, seen at distance d2 from there, and mixed by alpha: with z = 1,
k = xi d1 + 1, d1² = r² + 1, d2² = r² + k², coordinates are divided by D = alpha d2 + (1 − alpha) k. Focal lengths are
Kalibr's and Basalt's: pixels per unit of these coordinates, which on the axis is fx / (1 + xi) per tangent.
"""

from __future__ import annotations

import math

import numpy as np

from rsgen.array_types import FloatArray


def is_lens(xi: float, alpha: float) -> bool:
    """Whether there is such a lens: xi in (−1, 1], alpha in [0, 1]."""
    return -1.0 < xi <= 1.0 and 0.0 <= alpha <= 1.0


def max_radius(xi: float, alpha: float) -> float:
    """Radius x/z up to which it is one to one, infinite if that is up to 90°.

    D > 0 and d(r / D)/dr = (1 + xi / d1) (alpha k / d2 + 1 − alpha) / D² > 0 are both k / d2 > −w. With c = 1 / d1 that
    is (xi + c) / sqrt(1 + 2 xi c + xi²) > −w, which grows with c. (The paper's (43) is another bound: at xi = −0.6,
    alpha = 1 it lets points in that fold back.)
    """
    w = alpha / (1.0 - alpha) if alpha <= 0.5 else (1.0 - alpha) / alpha
    rest = 1.0 - w * w
    c = -xi * rest - w * math.sqrt(1.0 - xi * xi * rest)
    return math.inf if c <= 0.0 else math.sqrt(max(1.0 / (c * c) - 1.0, 0.0))


def scale(xi: float, alpha: float, r2: FloatArray) -> tuple[FloatArray, FloatArray]:
    """s = 1 / D at squared radii, and g = (ds/dr) / r."""
    d1 = np.sqrt(1.0 + r2)
    k = xi * d1 + 1.0
    d2 = np.sqrt(r2 + k * k)
    s = 1.0 / (alpha * d2 + (1.0 - alpha) * k)
    slope = xi / d1  # k' / r
    return s, -s * s * (alpha * (1.0 + k * slope) / d2 + (1.0 - alpha) * slope)


def undistort(xi: float, alpha: float, m: FloatArray) -> FloatArray:
    """Coordinates x/z, y/z (..., 2) of distorted ones m (..., 2), in closed form (equations 47 to 50); NaN if none."""
    r2 = (m * m).sum(axis=-1)
    under = 1.0 - (2.0 * alpha - 1.0) * r2
    known = under >= 0.0
    mz = (1.0 - alpha * alpha * r2) / (alpha * np.sqrt(np.where(known, under, 0.0)) + 1.0 - alpha)
    inner = mz * mz + (1.0 - xi * xi) * r2
    known &= inner >= 0.0
    factor = (mz * xi + np.sqrt(np.where(known, inner, 0.0))) / (mz * mz + r2)
    z = factor * mz - xi
    known &= z > 0.0
    return np.where(known[..., None], m * (factor / np.where(known, z, 1.0))[..., None], np.nan)
