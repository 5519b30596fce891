"""Body twist and its rate on the spline, differentiated by control points: what an IMU's residuals need.

Left increments T_i ← exp(δ_i) T_i throughout, as for the images (DESIGN section 4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsgen.array_types import FloatArray, IntArray
from rsgen.geometry import se3
from rsgen.geometry.so3 import powers
from rsgen.geometry.spline import Spline

# b_1..b_3 as polynomials in u, and their derivatives by u: see `rsgen.geometry.spline`.
_BASIS = np.array([[5.0, 3.0, -3.0, 1.0], [1.0, 3.0, 3.0, -2.0], [0.0, 0.0, 0.0, 1.0]]).T / 6.0
_BY_U = np.diag([1.0, 2.0, 3.0], 1)
_BASES = _BASIS, _BY_U @ _BASIS, _BY_U @ _BY_U @ _BASIS


@dataclass(frozen=True)
class Motion:
    """At n times: first (n,), the first of the four control points; rotation (n, 3, 3), body to world.

    twist (n, 6) = [v; ω] and rate (n, 6) = [v̇; ω̇] in body coordinates (m/s, rad/s). Their derivatives by the four
    control points' left increments: by_twist, by_rate (n, 6, 24); by_turn (n, 3, 24) of the pose's left rotation.
    """

    first: IntArray
    rotation: FloatArray
    twist: FloatArray
    rate: FloatArray
    by_twist: FloatArray
    by_rate: FloatArray
    by_turn: FloatArray


def motion(spline: Spline, t: FloatArray) -> Motion:
    """Of a spline at times t (n,) s within it. Raises UserError outside.

    With y = Ad(A_j⁻¹) w_{j−1} and x = Ad(A_j⁻¹) ẇ_{j−1}, both of which Ω_j turns by ad(·) b_j Jr(b_j Ω_j):
    dw_j = Ad(A_j⁻¹) dw_{j−1} + (b_j ad(y) Jr + ḃ_j) dΩ_j,
    dẇ_j = Ad(A_j⁻¹) dẇ_{j−1} + (b_j ad(x) Jr + ḃ_j ad(w_j) + b̈_j) dΩ_j − ḃ_j ad(Ω_j) dw_j.
    The pose's right increment likewise: e_j = Ad(A_j⁻¹) e_{j−1} + b_j Jr dΩ_j, from e_0 = Ad(T_0⁻¹) δ_0.
    """
    segment, u = spline.locate(t)
    held, n = segment - spline.first, len(u)
    p = powers(u, 4)
    b, db, ddb = (p @ basis / spline.dt**k for k, basis in enumerate(_BASES))
    three = held[:, None] + np.arange(3)
    omega = spline.increments[three]
    parts = b[..., None] * omega
    A, ad = se3.exp(parts), se3.ad(omega)
    turned = b[..., None, None] * se3.right_jacobian(parts)
    back = se3.adjoint(se3.inverse(A))
    T = spline.control_points[held]
    state = np.zeros((n, 6, 2))  # w and ẇ
    by = np.zeros((n, 6, 60))  # of w and ẇ by Ω_1..Ω_3, of e by those and by δ_0
    by[:, :, 54:] = se3.adjoint(se3.inverse(T))
    one = np.eye(6)
    for j in range(3):
        bj, bbj = db[:, j, None, None], ddb[:, j, None, None]
        state, by = back[:, j] @ state, back[:, j] @ by
        pushed = bj[..., 0] * omega[:, j]
        # Of y, x and w_j = y + ḃ_j Ω_j at once: a call costs more than the numbers.
        ad_y, ad_x, ad_w = se3.ad(np.stack([state[..., 0], state[..., 1], state[..., 0] + pushed]))
        state[..., 0] += pushed
        state[..., 1] += ((bj * ad_w + bbj * one) @ omega[:, j, :, None])[..., 0]
        own = 6 * j
        by[:, :, own : own + 6] += ad_y @ turned[:, j] + bj * one
        by[:, :, 18:36] -= bj * (ad[:, j] @ by[:, :, :18])
        by[:, :, 18 + own : 24 + own] += ad_x @ turned[:, j] + bj * ad_w + bbj * one
        by[:, :, 36 + own : 42 + own] += turned[:, j]
        T = T @ A[:, j]
    R = T[:, :3, :3]
    by[:, 3:, 36:] = R @ by[:, 3:, 36:]
    # Twist, rate and turn, one below the other: a call costs more than the numbers.
    rows = np.concatenate([by[:, :, :18], by[:, :, 18:36], by[:, 3:, 36:54]], axis=1)
    points = _by_points(rows, spline.left_gains[three])
    points[:, 12:, :6] += by[:, 3:, 54:]
    return Motion(segment, R, state[..., 0], state[..., 1], points[:, :6], points[:, 6:12], points[:, 12:])


def _by_points(by_increments: FloatArray, gains: FloatArray) -> FloatArray:
    """From Ω_1..Ω_3 (n, k, 18) to the four control points (n, k, 24): dΩ_j = G_j (δ_j − δ_{j−1})."""
    out = np.zeros((*by_increments.shape[:2], 24))
    for j in range(3):
        part = by_increments[:, :, 6 * j : 6 * j + 6] @ gains[:, j]
        out[:, :, 6 * j : 6 * j + 6] -= part
        out[:, :, 6 * j + 6 : 6 * j + 12] += part
    return out
