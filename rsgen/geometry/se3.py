"""Rigid motions: exponential, logarithm, adjoints and Jacobians, batched over leading axes.

A pose `T` is (..., 4, 4); a twist `xi` = [rho; phi] is (..., 6), translation (metres) first, then rotation (radians).
Left Jacobian: exp(xi + d) = exp(Jl(xi) d) exp(xi) to first order. Closed forms with c1..c4 after Sommer et al.,
CVPR 2020, and Barfoot, "State Estimation for Robotics", 2017, section 7.1.5.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from rsgen.array_types import BoolArray, FloatArray
from rsgen.geometry import so3
from rsgen.geometry.so3 import coefficients, cross, exp_coefficients, hat

# How far R Rᵀ of a rigid motion may be from the identity.
_ORTHONORMAL_WITHIN = 1e-6
# Power series of c1..c4 in theta^2; see so3.coefficients for where they replace the closed forms.
CORNER_SERIES = np.array(
    [
        [
            (-1.0) ** (k + 1) * (k - 1) / math.factorial(2 * k + 2),
            (-1.0) ** (k + 1) * (k - 1) / math.factorial(2 * k + 3),
            (-1.0) ** k * (k + 1) / math.factorial(2 * k + 4),
            (-1.0) ** k * (k + 1) / math.factorial(2 * k + 5),
        ]
        for k in range(11)
    ]
)


def exp(xi: npt.ArrayLike) -> FloatArray:
    """Poses (..., 4, 4) of twists (..., 6)."""
    xi = np.asarray(xi, dtype=np.float64)
    rho, phi = xi[..., :3], xi[..., 3:]
    a, b, c = exp_coefficients(so3.squared_norm(phi))
    out = np.empty((*xi.shape[:-1], 4, 4))
    out[..., :3, :3] = so3.polynomial(phi, a, b)
    phi_rho = cross(phi, rho)
    out[..., :3, 3] = rho + b[..., None] * phi_rho + c[..., None] * cross(phi, phi_rho)
    out[..., 3, :] = (0.0, 0.0, 0.0, 1.0)
    return out


def log(T: npt.ArrayLike) -> FloatArray:
    """Twists (..., 6), angle in [0, π], of poses (..., 4, 4)."""
    T = np.asarray(T, dtype=np.float64)
    phi = so3.log(T[..., :3, :3])
    rho = (so3.left_jacobian_inv(phi) @ T[..., :3, 3:])[..., 0]
    return np.concatenate([rho, phi], axis=-1)


def inverse(T: npt.ArrayLike) -> FloatArray:
    """Inverse poses (..., 4, 4); the rotation must be orthonormal, its transpose is its inverse."""
    T = np.asarray(T, dtype=np.float64)
    out = np.empty_like(T)
    out[..., :3, :3] = np.swapaxes(T[..., :3, :3], -1, -2)
    out[..., :3, 3:] = -(out[..., :3, :3] @ T[..., :3, 3:])
    out[..., 3, :] = (0.0, 0.0, 0.0, 1.0)
    return out


def adjoint(T: npt.ArrayLike) -> FloatArray:
    """Adjoints (..., 6, 6) = [[R, t^ R], [0, R]] of poses (..., 4, 4): T exp(xi) T⁻¹ = exp(adjoint(T) xi)."""
    T = np.asarray(T, dtype=np.float64)
    R = T[..., :3, :3]
    return _upper_blocks(R, hat(T[..., :3, 3]) @ R)


def ad(xi: npt.ArrayLike) -> FloatArray:
    """Lie-algebra adjoints (..., 6, 6) = [[phi^, rho^], [0, phi^]] of twists (..., 6): ad(a) b = [a, b]."""
    xi = np.asarray(xi, dtype=np.float64)
    return _upper_blocks(hat(xi[..., 3:]), hat(xi[..., :3]))


def left_jacobian(xi: npt.ArrayLike) -> FloatArray:
    """Left Jacobians (..., 6, 6) of twists (..., 6): I + c1 ad + c2 ad² + c3 ad³ + c4 ad⁴ = ∫₀¹ Ad(exp(s xi)) ds."""
    xi = np.asarray(xi, dtype=np.float64)
    return _upper_blocks(so3.left_jacobian(xi[..., 3:]), _jacobian_corner(xi))


def left_jacobian_inv(xi: npt.ArrayLike) -> FloatArray:
    """Inverse left Jacobians (..., 6, 6) of twists (..., 6) with |phi| < 2π: [[K, −K Q K], [0, K]]."""
    xi = np.asarray(xi, dtype=np.float64)
    K = so3.left_jacobian_inv(xi[..., 3:])
    return _upper_blocks(K, -(K @ _jacobian_corner(xi) @ K))


def right_jacobian(xi: npt.ArrayLike) -> FloatArray:
    """Right Jacobians (..., 6, 6) of twists (..., 6): Jl(−xi)."""
    return left_jacobian(-np.asarray(xi, dtype=np.float64))


def right_jacobian_inv(xi: npt.ArrayLike) -> FloatArray:
    """Inverse right Jacobians (..., 6, 6) of twists (..., 6) with |phi| < 2π."""
    return left_jacobian_inv(-np.asarray(xi, dtype=np.float64))


def orthonormalise(T: npt.ArrayLike) -> FloatArray:
    """Poses (..., 4, 4) with each rotation replaced by the nearest proper one (polar decomposition), bottom row exact.

    Repeated products drift: with Rᵀ taken as inverse the error grows exponentially, so long chains call this.
    """
    T = np.asarray(T, dtype=np.float64)
    U, _, Vt = np.linalg.svd(T[..., :3, :3])
    U[..., :, 2] *= np.linalg.det(U @ Vt)[..., None]
    out = np.empty_like(T)
    out[..., :3, :3] = U @ Vt
    out[..., :3, 3] = T[..., :3, 3]
    out[..., 3, :] = (0.0, 0.0, 0.0, 1.0)
    return out


def is_rigid(T: FloatArray) -> BoolArray:
    """Whether (n,) finite matrices (n, 4, 4) are rigid motions, up to rounding."""
    R = T[:, :3, :3]
    off = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2), initial=0.0)
    is_turn = (off <= _ORTHONORMAL_WITHIN) & (np.linalg.det(R) >= 0.0)
    return np.asarray(is_turn & (T[:, 3] == (0.0, 0.0, 0.0, 1.0)).all(axis=1))


def from_quat_trans(q_xyzw: npt.ArrayLike, t: npt.ArrayLike) -> FloatArray:
    """Poses (..., 4, 4) of quaternions (..., 4), x y z w, and translations (..., 3) in metres."""
    R, t = so3.from_quat(q_xyzw), np.asarray(t, dtype=np.float64)
    out = np.empty((*np.broadcast_shapes(R.shape[:-2], t.shape[:-1]), 4, 4))
    out[..., :3, :3] = R
    out[..., :3, 3] = t
    out[..., 3, :] = (0.0, 0.0, 0.0, 1.0)
    return out


def transform(T_a_b: npt.ArrayLike, p_b: npt.ArrayLike) -> FloatArray:
    """Points p_a (..., 3) = T_a_b p_b; leading axes of poses (..., 4, 4) and points (..., 3) broadcast."""
    T, p = np.asarray(T_a_b, dtype=np.float64), np.asarray(p_b, dtype=np.float64)
    if T.ndim == 2:
        return np.asarray(p @ T[:3, :3].T + T[:3, 3])
    return np.asarray(np.einsum("...ij,...j->...i", T[..., :3, :3], p) + T[..., :3, 3])


def interpolated(times: FloatArray, poses: FloatArray, t: FloatArray) -> FloatArray:
    """Poses (m, 4, 4) at times t (m,) on the geodesics between poses (n, 4, 4) at increasing times (n,), n ≥ 1.

    Times before the first pose and after the last lie on the first and the last geodesic.
    """
    if len(times) == 1:
        return np.repeat(poses, len(t), axis=0)
    i = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 2)
    u = (t - times[i]) / (times[i + 1] - times[i])
    twist = log(inverse(poses[i]) @ poses[i + 1])
    return np.asarray(poses[i] @ exp(u[:, None] * twist))


def _upper_blocks(diagonal: FloatArray, corner: FloatArray) -> FloatArray:
    out = np.zeros((*diagonal.shape[:-2], 6, 6))
    out[..., :3, :3] = diagonal
    out[..., 3:, 3:] = diagonal
    out[..., :3, 3:] = corner
    return out


def _jacobian_corner(xi: FloatArray) -> FloatArray:
    """Top-right block Q (..., 3, 3) of the left Jacobian: Σ c_k times the top-right blocks of ad^k."""
    theta2 = so3.squared_norm(xi[..., 3:])
    c = coefficients(theta2, CORNER_SERIES, _corner_coefficients)[..., None, None, :]
    rho_hat, phi_hat, phi_hat2 = hat(xi[..., :3]), hat(xi[..., 3:]), so3.hat_squared(xi[..., 3:])
    # ad^(k+1) = ad ad^k: corner_(k+1) = phi^ corner_k + rho^ phi^^k, and phi^³ = −θ² phi^.
    corner2 = phi_hat @ rho_hat + rho_hat @ phi_hat
    corner3 = phi_hat @ corner2 + rho_hat @ phi_hat2
    corner4 = phi_hat @ corner3 - theta2[..., None, None] * (rho_hat @ phi_hat)
    return np.asarray(c[..., 0] * rho_hat + c[..., 1] * corner2 + c[..., 2] * corner3 + c[..., 3] * corner4)


def _corner_coefficients(x: FloatArray) -> tuple[FloatArray, ...]:
    sin, cos = np.sin(x), np.cos(x)
    return (
        (4.0 - x * sin - 4.0 * cos) / (2.0 * x**2),
        (4.0 * x - 5.0 * sin + x * cos) / (2.0 * x**3),
        (2.0 - x * sin - 2.0 * cos) / (2.0 * x**4),
        (2.0 * x - 3.0 * sin + x * cos) / (2.0 * x**5),
    )
