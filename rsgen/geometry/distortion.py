"""Lens distortion in normalised coordinates: odd polynomials and their quotients, and the double sphere.

The double sphere is that of Usenko, Demmel, Cremers, The Double Sphere Camera Model, 3DV 2018. A point at distance d1
is moved by xi along the axis, seen at distance d2 from there, and mixed by alpha: with z = 1, k = xi d1 + 1,
d1² = r² + 1, d2² = r² + k², coordinates are divided by D = alpha d2 + (1 − alpha) k. Focal lengths are Kalibr's and
Basalt's: pixels per unit of these coordinates, which on the axis is fx / (1 + xi) per tangent.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.polynomial import Polynomial
from numpy.polynomial.polynomial import polyval

from rsgen.array_types import FloatArray


def odd(ks: Sequence[float], x: FloatArray) -> FloatArray:
    """x (1 + k1 x² + k2 x⁴ + ...)."""
    return np.asarray(x * polyval(x * x, (1.0, *ks)))


def odd_slope(ks: Sequence[float]) -> list[float]:
    """Coefficients, in x² and with the constant term first, of the derivative of `odd`."""
    return [1.0, *((2 * i + 3) * k for i, k in enumerate(ks))]


def rational_radius(above: Sequence[float], below: Sequence[float], tangential: float) -> float:
    """As `Camera.max_radius` of N / D, D positive: the conditions of radtan, times D and D².

    above, below (3,): coefficients of r², r⁴, r⁶ of N and of D.
    """
    N, D = (Polynomial([1.0, 0.0, k[0], 0.0, k[1], 0.0, k[2]]) for k in (above, below))
    r = Polynomial([0.0, 1.0])
    across = N - tangential * r * D
    along = N * D + r * (N.deriv() * D - N * D.deriv()) - tangential * r * D * D
    return min(first_root(p.coef.tolist()) for p in (D, across, along))


def first_root(coefficients: Sequence[float]) -> float:
    """Smallest positive root of a polynomial that starts at 1 (constant term first), infinite if it has none."""
    # Solved for 1/x: its leading coefficient is the 1, so that a vanishing last coefficient does no harm.
    inverses = np.roots(coefficients)
    # A root where the polynomial only touches zero comes out as a nearly real pair.
    real = inverses.real[(np.abs(inverses.imag) < 1e-7 * np.abs(inverses)) & (inverses.real > 1e-100)]
    return 1.0 / float(real.max()) if real.size else math.inf


def invert_odd(ks: Sequence[float], target: FloatArray, upper: float) -> FloatArray:
    """x in [0, upper] with odd(ks, x) = target ≥ 0, NaN where there is none; odd must increase on [0, upper].

    Newton's method, bisecting where a step would leave the bracket.
    """
    reachable = target <= odd(ks, np.array(upper))
    goal = np.where(reachable, target, 0.0)
    slope = odd_slope(ks)
    low, high = np.zeros_like(goal), np.full_like(goal, upper)
    x = np.minimum(goal, high)
    for _ in range(80):
        error = odd(ks, x) - goal
        if not (np.abs(error) > 4e-16 * (1.0 + goal)).any():
            break
        low, high = np.where(error < 0.0, x, low), np.where(error > 0.0, x, high)
        rate = polyval(x * x, slope)
        newton = x - error / np.where(rate > 0.0, rate, np.inf)
        strays = (newton < low) | (newton > high) | (rate <= 0.0)
        x = np.where(error == 0.0, x, np.where(strays, 0.5 * (low + high), newton))
    return np.where(reachable, x, np.nan)


def double_sphere_radius(xi: float, alpha: float) -> float:
    """Radius x/z up to which it is one to one, infinite if that is up to 90°.

    D > 0 and d(r / D)/dr = (1 + xi / d1) (alpha k / d2 + 1 − alpha) / D² > 0 are both k / d2 > −w. With c = 1 / d1 that
    is (xi + c) / sqrt(1 + 2 xi c + xi²) > −w, which grows with c. (The paper's (43) is another bound: at xi = −0.6,
    alpha = 1 it lets points in that fold back.)
    """
    w = alpha / (1.0 - alpha) if alpha <= 0.5 else (1.0 - alpha) / alpha
    rest = 1.0 - w * w
    c = -xi * rest - w * math.sqrt(1.0 - xi * xi * rest)
    return math.inf if c <= 0.0 else math.sqrt(max(1.0 / (c * c) - 1.0, 0.0))


def double_sphere_scale(xi: float, alpha: float, r2: FloatArray) -> tuple[FloatArray, FloatArray]:
    """s = 1 / D at squared radii, and g = (ds/dr) / r."""
    d1 = np.sqrt(1.0 + r2)
    k = xi * d1 + 1.0
    d2 = np.sqrt(r2 + k * k)
    s = 1.0 / (alpha * d2 + (1.0 - alpha) * k)
    slope = xi / d1  # k' / r
    return s, -s * s * (alpha * (1.0 + k * slope) / d2 + (1.0 - alpha) * slope)


def undistort_double_sphere(xi: float, alpha: float, m: FloatArray) -> FloatArray:
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
