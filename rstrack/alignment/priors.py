"""What is known of a motion beside the images and added to equation (12): small accelerations, and the gauge."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.alignment.normal_equations import Quadratic
from rstrack.compiled import compiled

ACCELERATION = np.array([5.0, 5.0, 5.0, 10.0, 10.0, 10.0])
"""Motion prior: standard deviation of accelerations, m/s² and rad/s². Hand-held cameras reach 35 m/s²,
so it hardly counts where there are data."""
VELOCITY = np.array([1.5, 1.5, 1.5, 3.0, 3.0, 3.0])
"""And of velocities, m/s and rad/s, where nothing is known."""

ENDS = 2
"""Second differences at an end of a spline that are held tighter: few lines touch its outermost control points (in the
newest lines they weigh u³/6), so that small systematic errors of the lines would throw them about."""
_END_FACTOR = 0.1

Prior = Callable[[Spline], tuple[Quadratic, float]]
"""The quadratic model of a prior around a spline, and its cost there."""


def acceleration_sigmas(
    accelerations: FloatArray, dt: float, count: int, first: int = ENDS, last: int = ENDS
) -> FloatArray:
    """σ (count, 6) of `acceleration_prior` by those (6,) of accelerations; tighter for the first and last so many."""
    sigma = np.repeat(accelerations[None] * dt**2, count, axis=0)
    sigma[:first] *= _END_FACTOR
    sigma[max(0, count - last) :] *= _END_FACTOR
    return sigma


def acceleration_prior(spline: Spline, first: int, last: int, sigma: FloatArray) -> tuple[Quadratic, float]:
    """Ω_{i+1} − Ω_i ~ N(0, diag σ²) for the triples of control points within first..last (exclusive).

    sigma (triples, 6): m and rad per knot squared, so acceleration times dt². Derivative of Ω_j = log(T_{j−1}⁻¹ T_j) by
    left increments: Jl⁻¹(Ω_j) Ad(T_{j−1}⁻¹) (δ_j − δ_{j−1}). Returns the model and the cost.
    """
    pairs = slice(first - spline.first, last - 1 - spline.first)
    gains, omega = spline.left_gains[pairs], spline.increments[pairs]
    r = omega[1:] - omega[:-1]
    J = np.concatenate([gains[:-1], -gains[1:] - gains[:-1], gains[1:]], axis=2)
    return _summed(first, last, J, r, sigma)


def velocity_prior(spline: Spline, first: int, last: int, sigma: FloatArray) -> tuple[Quadratic, float]:
    """Ω_i ~ N(0, diag σ²) for the pairs of control points within first..last (exclusive): hardly anything moves faster.

    sigma (6,): m and rad per knot, so velocity times dt. Returns the model and the cost.
    """
    pairs = slice(first - spline.first, last - 1 - spline.first)
    gains, r = spline.left_gains[pairs], spline.increments[pairs]
    J = np.concatenate([-gains, gains], axis=2)
    return _summed(first, last, J, r, np.broadcast_to(sigma, r.shape))


def pose_constraint(spline: Spline, t: float, T_world_body: FloatArray, sigma: FloatArray) -> tuple[Quadratic, float]:
    """T(t) = T_world_body up to sigma (6,) (m, rad): fixes the gauge while the reference's control points are free.

    Returns the model and the cost.
    """
    segment, J = spline.pose_jacobian(t)
    e = se3.log(spline.pose(t) @ se3.inverse(T_world_body))
    J = se3.left_jacobian_inv(e) @ np.hstack(list(J))
    model = Quadratic(int(segment), J.T @ (J / sigma[:, None] ** 2), J.T @ (e / sigma**2))
    return model, 0.5 * float(np.sum((e / sigma) ** 2))


def _summed(first: int, last: int, J: FloatArray, r: FloatArray, sigma: FloatArray) -> tuple[Quadratic, float]:
    """Model and cost of residuals r (n, 6) ~ N(0, diag sigma²), the i-th with derivative J[i] by control points from
    first + i on."""
    H, g, cost = _added(J, r, sigma, last - first)
    return Quadratic(first, H, g), cost


@compiled
def _added(J: Any, r: Any, sigma: Any, points: Any) -> Any:
    H, g, cost = np.zeros((6 * points, 6 * points)), np.zeros(6 * points), 0.0
    count, _, columns = J.shape
    for i in range(count):
        for k in range(6):
            information = 1.0 / sigma[i, k] ** 2
            cost += 0.5 * r[i, k] ** 2 * information
            for a in range(columns):
                weighted = J[i, k, a] * information
                g[6 * i + a] += weighted * r[i, k]
                for b in range(columns):
                    H[6 * i + a, 6 * i + b] += weighted * J[i, k, b]
    return H, g, cost
