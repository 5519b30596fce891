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
    """
    segment, u = spline.locate(t)
    held, n = segment - spline.first, len(u)
    b, db, ddb = (powers(u, 4) @ basis / spline.dt**k for k, basis in enumerate(_BASES))
    omega = spline.increments[held[:, None] + np.arange(3)]
    parts = b[..., None] * omega
    A, Jr, ad = se3.exp(parts), se3.right_jacobian(parts), se3.ad(omega)
    back = se3.adjoint(se3.inverse(A))
    w, dw = np.zeros((n, 6)), np.zeros((n, 6))
    by_w, by_dw = np.zeros((n, 6, 18)), np.zeros((n, 6, 18))
    one = np.eye(6)
    for j in range(3):
        own, bj, dbj, ddbj = slice(6 * j, 6 * j + 6), b[:, j, None], db[:, j, None], ddb[:, j, None]
        y, x = np.moveaxis(back[:, j] @ np.stack([w, dw], axis=-1), -1, 0)
        w = y + dbj * omega[:, j]
        ad_w = se3.ad(w)
        dw = x + dbj * (ad_w @ omega[:, j, :, None])[..., 0] + ddbj * omega[:, j]
        turned = bj[..., None] * Jr[:, j]
        by_w = back[:, j] @ by_w
        by_w[:, :, own] += se3.ad(y) @ turned + dbj[..., None] * one
        by_dw = back[:, j] @ by_dw - dbj[..., None] * (ad[:, j] @ by_w)
        by_dw[:, :, own] += se3.ad(x) @ turned + dbj[..., None] * ad_w + ddbj[..., None] * one
    gains = spline.left_gains[held[:, None] + np.arange(3)]
    T, J = spline.pose(t), spline.pose_jacobian(t)[1]
    by_turn = np.moveaxis(J[:, :, 3:], 1, 2).reshape(n, 3, 24)
    return Motion(segment, T[:, :3, :3], w, dw, _by_points(by_w, gains), _by_points(by_dw, gains), by_turn)


def _by_points(by_increments: FloatArray, gains: FloatArray) -> FloatArray:
    """From Ω_1..Ω_3 (n, 6, 18) to the four control points (n, 6, 24): dΩ_j = G_j (δ_j − δ_{j−1})."""
    n = len(gains)
    out = np.zeros((n, 6, 24))
    for j in range(3):
        part = by_increments[:, :, 6 * j : 6 * j + 6] @ gains[:, j]
        out[:, :, 6 * j : 6 * j + 6] -= part
        out[:, :, 6 * j + 6 : 6 * j + 12] += part
    return out
