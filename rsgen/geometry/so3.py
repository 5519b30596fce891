"""Rotations: exponential, logarithm, Jacobians and quaternions, batched over leading axes.

Rotation vectors `phi` are (..., 3) in radians, rotation matrices (..., 3, 3), quaternions (..., 4) as x y z w.
To first order exp(phi + d) = exp(Jl(phi) d) exp(phi) = exp(phi) exp(Jr(phi) d), with left and right Jacobian Jl and Jr.
Formulas after Barfoot, "State Estimation for Robotics", 2017, section 7.1.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
from scipy.special import zeta

from rsgen.array_types import FloatArray

# The Jacobians' coefficients divide a difference that cancels by up to theta**5. Below one radian their power series in
# theta**2, cut off under 1e-17, is the more exact form; above it the closed form loses two digits at most.
_SERIES_BELOW = 1.0

# sin θ / θ, (1 − cos θ) / θ² and (θ − sin θ) / θ³: sum_k (−1)^k θ^2k / (2k + 1)!, … / (2k + 2)!, … / (2k + 3)!
EXP_SERIES = np.array([[(-1.0) ** k / math.factorial(2 * k + n) for n in (1, 2, 3)] for k in range(10)])
# sum_n |B_2n| theta^(2n - 2) / (2n)!  =  (1 - theta/2 cot theta/2) / theta^2;  |B_2n| / (2n)! = 2 zeta(2n) / (2 pi)^2n
INVERSE_SERIES = np.array([[2.0 * float(zeta(2 * n)) / (2.0 * math.pi) ** (2 * n)] for n in range(1, 12)])


def coefficients(
    theta2: FloatArray, series: FloatArray, closed_forms: Callable[[FloatArray], Sequence[FloatArray]]
) -> FloatArray:
    """Even functions (..., k) of angles given as theta2 = theta² (...,).

    Below one radian their power series (n, k) in theta2, lowest order first, are used; above, `closed_forms(theta)`.
    """
    value = powers(np.minimum(theta2, _SERIES_BELOW**2), len(series)) @ series
    large = theta2 > _SERIES_BELOW**2
    if np.any(large):
        value[large] = np.stack(closed_forms(np.sqrt(np.asarray(theta2)[large])), axis=-1)
    return np.asarray(value)


def powers(x: FloatArray, n: int) -> FloatArray:
    """1, x, x², ... (..., n) of numbers (...,)."""
    out = np.empty((*x.shape, n))
    out[..., 0], out[..., 1:] = 1.0, x[..., None]
    return np.asarray(np.multiply.accumulate(out, axis=-1, out=out))


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross products (..., 3) of vectors (..., 3)."""
    # np.cross spends more time on moving axes than on these six products.
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    out[..., 0] = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    out[..., 1] = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    out[..., 2] = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return out


def squared_norm(v: FloatArray) -> FloatArray:
    """|v|² (...,) of vectors (..., 3)."""
    return np.asarray(v[..., 0] * v[..., 0] + v[..., 1] * v[..., 1] + v[..., 2] * v[..., 2])


def exp_coefficients(theta2: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """sin θ / θ, (1 − cos θ) / θ² and (θ − sin θ) / θ³ of squared angles (...,)."""
    # 2 sin²(θ/2) is 1 − cos θ free of cancellation.
    found = coefficients(
        theta2, EXP_SERIES, lambda x: (np.sin(x) / x, 2.0 * (np.sin(0.5 * x) / x) ** 2, (x - np.sin(x)) / x**3)
    )
    return found[..., 0], found[..., 1], found[..., 2]


def hat(v: npt.ArrayLike) -> FloatArray:
    """Skew-symmetric matrices (..., 3, 3) of vectors (..., 3): hat(v) @ x = v × x."""
    v = np.asarray(v, dtype=np.float64)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1] = -v[..., 2]
    out[..., 0, 2] = v[..., 1]
    out[..., 1, 0] = v[..., 2]
    out[..., 1, 2] = -v[..., 0]
    out[..., 2, 0] = -v[..., 1]
    out[..., 2, 1] = v[..., 0]
    return out


def hat_squared(v: npt.ArrayLike) -> FloatArray:
    """hat(v) @ hat(v) = v vᵀ − |v|² I for vectors (..., 3), as (..., 3, 3)."""
    v = np.asarray(v, dtype=np.float64)
    out = v[..., :, None] * v[..., None, :]
    n2 = squared_norm(v)
    for i in range(3):
        out[..., i, i] -= n2
    return out


def polynomial(phi: FloatArray, first: npt.ArrayLike, second: npt.ArrayLike) -> FloatArray:
    """I + first · hat(phi) + second · hat(phi)², (..., 3, 3), of vectors (..., 3) and coefficients (...,)."""
    out = np.asarray(second)[..., None, None] * hat_squared(phi)
    v = np.asarray(first)[..., None] * phi
    for i in range(3):
        out[..., i, i] += 1.0
    out[..., 0, 1] -= v[..., 2]
    out[..., 0, 2] += v[..., 1]
    out[..., 1, 0] += v[..., 2]
    out[..., 1, 2] -= v[..., 0]
    out[..., 2, 0] -= v[..., 1]
    out[..., 2, 1] += v[..., 0]
    return out


def exp(phi: npt.ArrayLike) -> FloatArray:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) in radians (Rodrigues)."""
    phi = np.asarray(phi, dtype=np.float64)
    a, b, _ = exp_coefficients(squared_norm(phi))
    return polynomial(phi, a, b)


def log(R: npt.ArrayLike) -> FloatArray:
    """Rotation vectors (..., 3), angle in [0, π], of rotation matrices (..., 3, 3).

    Goes through the quaternion, so it keeps full precision near 0 and near π; at exactly π
    either of the two axes is returned.
    """
    q = to_quat(R)
    v, w = q[..., :3], q[..., 3]
    n = np.sqrt(squared_norm(v))
    # w >= 0, hence w is about 1 where n vanishes and the quotient tends to 2.
    scale = np.where(n > 0.0, 2.0 * np.arctan2(n, w) / np.where(n > 0.0, n, 1.0), 2.0)
    return np.asarray(scale[..., None] * v)


def left_jacobian(phi: npt.ArrayLike) -> FloatArray:
    """Left Jacobians (..., 3, 3) of rotation vectors (..., 3): ∫₀¹ exp(s phi) ds."""
    phi = np.asarray(phi, dtype=np.float64)
    _, b, c = exp_coefficients(squared_norm(phi))
    return polynomial(phi, b, c)


def left_jacobian_inv(phi: npt.ArrayLike) -> FloatArray:
    """Inverse left Jacobians (..., 3, 3) of rotation vectors (..., 3), |phi| < 2π."""
    phi = np.asarray(phi, dtype=np.float64)
    d = coefficients(squared_norm(phi), INVERSE_SERIES, lambda x: [(1.0 - 0.5 * x / np.tan(0.5 * x)) / (x * x)])
    return polynomial(phi, -0.5, d[..., 0])


def right_jacobian(phi: npt.ArrayLike) -> FloatArray:
    """Right Jacobians (..., 3, 3) of rotation vectors (..., 3): Jl(−phi)."""
    return left_jacobian(-np.asarray(phi, dtype=np.float64))


def right_jacobian_inv(phi: npt.ArrayLike) -> FloatArray:
    """Inverse right Jacobians (..., 3, 3) of rotation vectors (..., 3), |phi| < 2π."""
    return left_jacobian_inv(-np.asarray(phi, dtype=np.float64))


def from_quat(q_xyzw: npt.ArrayLike) -> FloatArray:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4), x y z w, of any length but zero (they are normalised)."""
    q = np.asarray(q_xyzw, dtype=np.float64)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    v, w = q[..., :3], q[..., 3]
    # R = I + 2 w hat(v) + 2 hat(v)²
    return polynomial(v, 2.0 * w, np.full_like(w, 2.0))


def to_quat(R: npt.ArrayLike) -> FloatArray:
    """Unit quaternions (..., 4), x y z w with w ≥ 0, of rotation matrices (..., 3, 3) (Shepperd's method)."""
    R = np.asarray(R, dtype=np.float64)
    r00, r11, r22 = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    xy, xz, yz = R[..., 0, 1] + R[..., 1, 0], R[..., 0, 2] + R[..., 2, 0], R[..., 1, 2] + R[..., 2, 1]
    wx, wy, wz = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    # Row i is 4 q_i q; the row with the largest q_i is the one that divides by something far from zero.
    rows = np.stack(
        [
            np.stack([1.0 + r00 - r11 - r22, xy, xz, wx], axis=-1),
            np.stack([xy, 1.0 - r00 + r11 - r22, yz, wy], axis=-1),
            np.stack([xz, yz, 1.0 - r00 - r11 + r22, wz], axis=-1),
            np.stack([wx, wy, wz, 1.0 + r00 + r11 + r22], axis=-1),
        ],
        axis=-2,
    )
    best = np.argmax(np.diagonal(rows, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.asarray(np.where(q[..., 3:] < 0.0, -q, q))
