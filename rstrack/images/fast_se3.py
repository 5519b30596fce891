"""Rigid motions in compiled code: twins of `rsgen.geometry.se3` for one motion, which the tests compare.

A vector is a tuple of three numbers, a 3×3 matrix one of nine, row by row; an adjoint or left Jacobian [[D, C], [0, D]]
is its two blocks.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rsgen.geometry import se3, so3
from rstrack.compiled import compiled

EXP, _INVERSE, _CORNER = (np.ascontiguousarray(s.T) for s in (so3.EXP_SERIES, so3.INVERSE_SERIES, se3.CORNER_SERIES))
_IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
_NEWTON_STEPS = 3  # towards the nearest rotation: quadratic, from a product of two that has drifted by rounding

# -- vectors and matrices ---------------------------------------------------------------------------------------------


@compiled
def series(coefficients: Any, x: Any) -> Any:
    """Σ coefficients[k] xᵏ."""
    total = 0.0
    for k in range(len(coefficients) - 1, -1, -1):
        total = total * x + coefficients[k]
    return total


@compiled
def plus(a: Any, b: Any, factor: Any) -> Any:
    """a + factor b."""
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]


@compiled
def added(A: Any, B: Any, factor: Any) -> Any:
    """A + factor B."""
    f = factor
    return (
        A[0] + f * B[0], A[1] + f * B[1], A[2] + f * B[2], A[3] + f * B[3], A[4] + f * B[4], A[5] + f * B[5],
        A[6] + f * B[6], A[7] + f * B[7], A[8] + f * B[8],
    )  # fmt: skip


@compiled
def cross(a: Any, b: Any) -> Any:
    """a × b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled
def turned(A: Any, v: Any) -> Any:
    """A v."""
    return (
        A[0] * v[0] + A[1] * v[1] + A[2] * v[2],
        A[3] * v[0] + A[4] * v[1] + A[5] * v[2],
        A[6] * v[0] + A[7] * v[1] + A[8] * v[2],
    )


@compiled
def product(A: Any, B: Any) -> Any:
    """A B."""
    x, y, z = turned(A, (B[0], B[3], B[6])), turned(A, (B[1], B[4], B[7])), turned(A, (B[2], B[5], B[8]))
    return x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2]


@compiled
def transposed(A: Any) -> Any:
    """Aᵀ."""
    return A[0], A[3], A[6], A[1], A[4], A[7], A[2], A[5], A[8]


@compiled
def hat(v: Any) -> Any:
    """The matrix of v ×."""
    return 0.0, -v[2], v[1], v[2], 0.0, -v[0], -v[1], v[0], 0.0


@compiled
def matrix(T: Any) -> Any:
    """Rotation and translation of a pose (4, 4)."""
    R = (T[0, 0], T[0, 1], T[0, 2], T[1, 0], T[1, 1], T[1, 2], T[2, 0], T[2, 1], T[2, 2])
    return R, (T[0, 3], T[1, 3], T[2, 3])


@compiled
def store(R: Any, t: Any, out: Any) -> None:
    """Rotation and translation into the upper rows of a pose."""
    for i in range(3):
        for j in range(3):
            out[i, j] = R[3 * i + j]
        out[i, 3] = t[i]


# -- rigid motions ----------------------------------------------------------------------------------------------------


@compiled
def polynomial(phi: Any, first: Any, second: Any) -> Any:
    """I + first · hat(phi) + second · hat(phi)²."""
    skew = hat(phi)
    return added(added(_IDENTITY, skew, first), product(skew, skew), second)


@compiled
def exp(rho: Any, phi: Any) -> Any:
    """Rotation and translation of a twist [rho; phi], see `se3.exp`."""
    theta2 = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    if theta2 <= 1.0:
        a, b, c = series(EXP[0], theta2), series(EXP[1], theta2), series(EXP[2], theta2)
    else:
        x = math.sqrt(theta2)
        a, b, c = math.sin(x) / x, 2.0 * (math.sin(0.5 * x) / x) ** 2, (x - math.sin(x)) / x**3
    across = cross(phi, rho)
    return polynomial(phi, a, b), plus(plus(rho, across, b), cross(phi, across), c)


@compiled
def inverse_jacobian(phi: Any) -> Any:
    """Inverse left Jacobian of a rotation vector."""
    theta2 = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    if theta2 <= 1.0:
        return polynomial(phi, -0.5, series(_INVERSE[0], theta2))
    x = math.sqrt(theta2)
    return polynomial(phi, -0.5, (1.0 - 0.5 * x / math.tan(0.5 * x)) / theta2)


@compiled
def log(R: Any, t: Any) -> Any:
    """Translation and rotation part of a motion that turns by less than π."""
    axis = (R[7] - R[5], R[2] - R[6], R[3] - R[1])
    sine = math.sqrt(axis[0] * axis[0] + axis[1] * axis[1] + axis[2] * axis[2])
    scale = math.atan2(sine, R[0] + R[4] + R[8] - 1.0) / sine if sine > 0.0 else 0.5
    phi = (axis[0] * scale, axis[1] * scale, axis[2] * scale)
    return turned(inverse_jacobian(phi), t), phi


@compiled
def corner(rho: Any, phi: Any) -> Any:
    """Block C of the left Jacobian, see `se3.left_jacobian`."""
    theta2 = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    if theta2 <= 1.0:
        c1, c2 = series(_CORNER[0], theta2), series(_CORNER[1], theta2)
        c3, c4 = series(_CORNER[2], theta2), series(_CORNER[3], theta2)
    else:
        x = math.sqrt(theta2)
        s, c = math.sin(x), math.cos(x)
        c1, c2 = (4.0 - x * s - 4.0 * c) / (2.0 * x**2), (4.0 * x - 5.0 * s + x * c) / (2.0 * x**3)
        c3, c4 = (2.0 - x * s - 2.0 * c) / (2.0 * x**4), (2.0 * x - 3.0 * s + x * c) / (2.0 * x**5)
    across, along = hat(rho), hat(phi)
    mixed = product(across, along)
    second = added(product(along, across), mixed, 1.0)
    third = added(product(along, second), product(mixed, along), 1.0)
    fourth = added(product(along, third), mixed, -theta2)
    nothing = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    return added(added(added(added(nothing, across, c1), second, c2), third, c3), fourth, c4)


@compiled
def nearest_rotation(R: Any) -> Any:
    """Of a matrix that is one but for rounding: Newton's iteration of the polar decomposition, R ← (R + R⁻ᵀ) / 2."""
    for _ in range(_NEWTON_STEPS):
        x, y, z = (R[0], R[1], R[2]), (R[3], R[4], R[5]), (R[6], R[7], R[8])
        a, b, c = cross(y, z), cross(z, x), cross(x, y)
        det = x[0] * a[0] + x[1] * a[1] + x[2] * a[2]
        R = added(R, (*a, *b, *c), 1.0 / det)
        R = added(R, R, -0.5)
    return R
