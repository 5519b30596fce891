"""A tracked motion at any time, and small corrections of it: what an IMU on it would feel is a function of both.

The camera was at R exp(φ), p + δ where the track has R, p: φ (body axes, rad) and δ (world axes, m) are cubic B-splines
of coefficients x (k, 6) = [φ δ], on the track's own knots or on finer ones among which those are. Then, up to terms of
φ times its derivatives,

    ω' = exp(−φ) ω + Jr(φ) φ',   ω'' = exp(−φ) ω̇ + φ'' + ω × φ',   a' = a + δ''.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from rsgen.array_types import FloatArray, IntArray
from rsgen.geometry import so3
from rsgen.geometry.so3 import cross
from rsgen.geometry.spline import Spline

# Weights of four control points as polynomials in u, constant term first, and what derives them.
_BASIS = np.array([[1.0, -3.0, 3.0, -1.0], [4.0, 0.0, -6.0, 3.0], [1.0, 3.0, 3.0, -3.0], [0.0, 0.0, 0.0, 1.0]]).T / 6.0
_BY_U = np.diag([1.0, 2.0, 3.0], 1)


@dataclass(frozen=True)
class Track:
    """spline: T_world_depth(t). parts: into how many each of its knots' spacings is cut for the corrections."""

    spline: Spline
    parts: int = 1

    @property
    def count(self) -> int:
        """Of the corrections' coefficients."""
        return self.parts * (len(self.spline.control_points) - 3) + 3


@dataclass(frozen=True)
class Motion:
    """At n times: R_world_body (n, 3, 3), angular rate (rad/s) and its derivative in body axes, acceleration in the
    world (m/s²), each (n, 3); and where the corrections' coefficients count: the first of four (n,), and their weights
    (3, n, 4), of order 0, 1 and 2 in time."""

    R: FloatArray
    rate: FloatArray
    rate_change: FloatArray
    acceleration: FloatArray
    first: IntArray
    weights: FloatArray


def motion_at(whole: Track, t: FloatArray) -> Motion:
    """The track's motion at times t (n,), s, within it. Raises UserError outside."""
    track, parts = whole.spline, whole.parts
    T, twist = track.pose_and_velocity(t)
    change = track.acceleration(t)
    body = change[:, :3] + cross(twist[:, 3:], twist[:, :3])
    segment, u = track.locate(t)
    within = np.minimum((parts * u).astype(int), parts - 1)
    powers = (parts * u - within)[:, None] ** np.arange(4)
    dt = track.dt / parts
    bases = _BASIS, _BY_U @ _BASIS / dt, _BY_U @ _BY_U @ _BASIS / dt**2
    weights = np.stack([powers @ basis for basis in bases])
    R = T[:, :3, :3]
    acceleration = np.einsum("nij,nj->ni", R, body)
    return Motion(R, twist[:, 3:], change[:, 3:], acceleration, parts * (segment - track.first) + within, weights)


def corrections(motion: Motion, x: FloatArray) -> FloatArray:
    """[φ δ] and its first and second derivatives (3, n, 6) for coefficients x (k, 6)."""
    near = x[motion.first[:, None] + np.arange(4)]
    return np.einsum("onk,nkc->onc", motion.weights, near)


def corrected(motion: Motion, x: FloatArray) -> Motion:
    """The motion with its corrections applied."""
    value, speed, change = corrections(motion, x)
    phi, back = value[:, :3], so3.exp(-value[:, :3])
    rate = _turned(back, motion.rate) + _turned(so3.right_jacobian(phi), speed[:, :3])
    rate_change = _turned(back, motion.rate_change) + change[:, :3] + cross(motion.rate, speed[:, :3])
    R = motion.R @ so3.exp(phi)
    return Motion(R, rate, rate_change, motion.acceleration + change[:, 3:], motion.first, motion.weights)


def spread(motion: Motion, blocks: FloatArray, count: int) -> sparse.csr_array:
    """Derivatives by all coefficients (3 n, 6 count) of n three-vectors, sparse.

    blocks (3, n, 3, 6): derivatives by the corrections and by their first and second derivatives.
    """
    n = len(motion.first)
    values = np.einsum("onk,onic->nikc", motion.weights, blocks)
    columns = 6 * (motion.first[:, None] + np.arange(4))[:, None, :, None] + np.arange(6)
    columns = np.broadcast_to(columns, values.shape)
    ends = np.arange(3 * n + 1) * (4 * 6)
    return sparse.csr_array((values.ravel(), columns.ravel(), ends), shape=(3 * n, 6 * count))


def _turned(R: FloatArray, v: FloatArray) -> FloatArray:
    return np.asarray((R @ v[..., None])[..., 0])
