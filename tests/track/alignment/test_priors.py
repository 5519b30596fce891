"""The priors' models against finite differences of their costs."""

from __future__ import annotations

import numpy as np
import pytest
from rstrack_util import moved
from util import numeric_jacobian, random_spline, random_twists

from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.alignment.normal_equations import Quadratic, assemble, solve
from rstrack.alignment.priors import acceleration_prior, acceleration_sigmas, pose_constraint, velocity_prior
from rstrack.alignment.spline_state import SplineState


@pytest.mark.parametrize("of", ["acceleration", "velocity"])
@pytest.mark.parametrize("seed", range(2))
def test_motion_priors_are_those_of_their_costs(seed: int, of: str) -> None:
    spline, rng = random_spline(seed), np.random.default_rng(seed)
    first, last = 2, 8
    sigma = rng.uniform(0.5, 2.0, (last - first - 2, 6) if of == "acceleration" else 6)

    def errors(x: np.ndarray) -> np.ndarray:
        T = moved(spline, x.reshape(-1, 6), first).control_points[first:last]
        omega = se3.log(np.linalg.inv(T[:-1]) @ T[1:])
        return ((omega[1:] - omega[:-1] if of == "acceleration" else omega) / sigma).ravel()

    model, cost = (acceleration_prior if of == "acceleration" else velocity_prior)(spline, first, last, sigma)
    assert cost == pytest.approx(0.5 * (errors(np.zeros(36)) ** 2).sum())
    assert (model.first, model.last) == (first, last)
    J = numeric_jacobian(errors, 6 * (last - first))
    np.testing.assert_allclose(model.H, J.T @ J, atol=1e-6 * np.abs(J.T @ J).max())
    np.testing.assert_allclose(model.g, J.T @ errors(np.zeros(36)), atol=1e-7 * np.abs(model.g).max())
    assert np.abs(model.g).max() > 0.1


def test_the_ends_of_a_spline_are_held_tighter() -> None:
    sigma = acceleration_sigmas(np.full(6, 4.0), 0.5, 7, last=1)
    np.testing.assert_allclose(sigma[:, 0], [0.1, 0.1, 1.0, 1.0, 1.0, 1.0, 0.1])
    assert (acceleration_sigmas(np.full(6, 4.0), 0.5, 3, 0, 0) == 1.0).all()


def test_acceleration_prior_asks_nothing_of_constant_velocity() -> None:
    T = se3.exp(np.arange(8)[:, None] * np.array([0.1, -0.05, 0.2, 0.02, 0.1, -0.04]))
    model, cost = acceleration_prior(Spline(T, 0.0, 0.05), 0, 8, np.ones((6, 6)))
    assert cost < 1e-24
    assert np.abs(model.g).max() < 1e-12
    assert np.linalg.matrix_rank(model.H) == 36  # free: pose and velocity


@pytest.mark.parametrize("size", [0.0, 1e-6, 0.3])
def test_pose_constraint_is_that_of_its_cost(size: float) -> None:
    spline, t = random_spline(7), 0.43
    sigma = np.array([0.5, 0.6, 0.7, 1.0, 1.2, 1.4])
    target = se3.exp(random_twists(np.random.default_rng(8), (), size, size)) @ spline.pose(t)

    def errors(x: np.ndarray) -> np.ndarray:
        return se3.log(moved(spline, x.reshape(-1, 6), 2).pose(t) @ np.linalg.inv(target)) / sigma

    model, cost = pose_constraint(spline, t, target, sigma)
    assert cost == pytest.approx(0.5 * (errors(np.zeros(24)) ** 2).sum(), rel=1e-6, abs=1e-25)
    assert (model.first, model.last) == (2, 6)
    J = numeric_jacobian(errors, 24)
    np.testing.assert_allclose(model.H, J.T @ J, atol=1e-6 * np.abs(J.T @ J).max())
    np.testing.assert_allclose(model.g, J.T @ errors(np.zeros(24)), atol=1e-6 * max(size, 1e-8))


def test_a_tight_pose_constraint_is_met() -> None:
    state = SplineState.still(0.3, 0.05, np.eye(4), 9)
    target = se3.exp(np.array([0.02, -0.01, 0.03, 0.04, 0.01, -0.02]))
    for _ in range(4):
        prior, _ = acceleration_prior(state.spline, 0, 9, np.full((7, 6), 0.01))
        hold, _ = pose_constraint(state.spline, 0.43, target, np.full(6, 1e-6))
        still = Quadratic(0, 1e-3 * np.eye(54), np.zeros(54))
        H, g = assemble([prior, hold, still], 0, 9)
        state.apply(0, solve(H, g, 54).reshape(-1, 6))
    np.testing.assert_allclose(state.spline.pose(0.43), target, atol=1e-9)
