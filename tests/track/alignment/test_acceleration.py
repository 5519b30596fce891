"""Accelerated iterations: fewer where Gauss-Newton is slow, none changed where it is fast."""

from __future__ import annotations

import numpy as np

from rstrack.alignment.normal_equations import AndersonMixing

RNG = np.random.default_rng(4)
A = RNG.normal(size=(12, 12))
TRUE = A @ A.T / 12 + 0.1 * np.eye(12)
GOAL = RNG.normal(size=12)


def iterations(H: np.ndarray, accelerated: bool, most: int = 5000) -> int:
    """Steps with the Hessian H until the quadratic cost with the Hessian TRUE is at its minimum."""
    x, acceleration = np.zeros(12), AndersonMixing()
    for n in range(most):
        if np.linalg.norm(x - GOAL) < 1e-4:
            return n
        step = -np.linalg.solve(H, TRUE @ (x - GOAL))
        x = x + (acceleration.extrapolated(x, step, H) if accelerated else step)
    return most


def test_a_hessian_that_is_too_large_costs_a_third_of_the_steps() -> None:
    noise = 8.0 * np.diag(np.abs(RNG.normal(size=12)))  # adds up in every direction, as squared noise of gradients does
    plain = iterations(TRUE + noise, accelerated=False)
    assert plain > 100 and iterations(TRUE + noise, accelerated=True) < plain // 3


def test_one_slow_motion_is_found_in_two_more_steps() -> None:
    d = np.linalg.eigh(TRUE)[1][:, 0]
    slow = TRUE + 0.25 * np.outer(d, d)
    assert iterations(slow, accelerated=False) > 20
    assert iterations(slow, accelerated=True) <= 4


def test_increments_may_be_moved_in_place_afterwards() -> None:
    found = []
    for in_place in (False, True):
        at, acceleration = np.zeros(12), AndersonMixing()
        for n in range(4):
            given = at if in_place else at.copy()
            step = acceleration.extrapolated(given, 0.9**n * np.linspace(0.1, 0.5, 12), TRUE)
            at += step
        found.append(at)
    np.testing.assert_array_equal(*found)


def test_fast_steps_stay_as_they_are() -> None:
    acceleration, step = AndersonMixing(), np.full(12, 0.5)
    assert acceleration.extrapolated(np.zeros(12), step, TRUE) is step
    shorter = 0.2 * step
    assert acceleration.extrapolated(step, shorter, TRUE) is shorter


def test_it_goes_four_times_as_far_as_the_plain_step_at_most() -> None:
    acceleration, step = AndersonMixing(), np.full(12, 0.5)
    acceleration.extrapolated(np.zeros(12), step, TRUE)
    further = acceleration.extrapolated(step, 0.99 * step, TRUE)
    np.testing.assert_allclose(further, 4.0 * 0.99 * step)


def test_what_is_forgotten_is_not_extrapolated_from() -> None:
    acceleration, step = AndersonMixing(), np.full(12, 0.5)
    acceleration.extrapolated(np.zeros(12), step, TRUE)
    acceleration.reset()
    np.testing.assert_array_equal(acceleration.extrapolated(step, 0.9 * step, TRUE), 0.9 * step)
