"""From 6×6 systems to control points and the banded solve, against dense algebra."""

from __future__ import annotations

import numpy as np
import pytest
from rstrack_util import moved
from util import numeric_jacobian, random_spline

from rsgen.geometry import se3
from rstrack.alignment.block_sums import BlockSums
from rstrack.alignment.normal_equations import (
    AndersonMixing,
    Quadratic,
    Slopes,
    assemble,
    chain,
    solve,
    solve_damped,
)
from rstrack.images.fast_spline import jacobians

TIMES = np.array([0.34, 0.352, 0.41, 0.43, 0.449, 0.452])  # segments 0 (twice), 2 (three times) and 3


def random_spd(rng: np.random.Generator, shape: tuple[int, ...], size: int = 6) -> np.ndarray:
    A = rng.normal(size=(*shape, size, size + 2))
    return A @ np.swapaxes(A, -1, -2)


def random_sums(rng: np.random.Generator, current: int, reference: int) -> BlockSums:
    return BlockSums(random_spd(rng, (current, reference)), rng.normal(size=(current, reference, 6)), 0.0, 0.0, 1)


# -- chain rule ----------------------------------------------------------------------------------------------------


def test_line_jacobian_is_the_derivative_of_the_twist_in_the_base_frame() -> None:
    spline = random_spline(3)
    T_world_base = se3.exp(np.array([0.4, -0.2, 0.3, 0.5, 0.1, -0.7]))

    def twist(x: np.ndarray) -> np.ndarray:
        T = moved(spline, x.reshape(-1, 6)).pose(TIMES)
        return se3.log(se3.inverse(T_world_base) @ T @ se3.inverse(spline.pose(TIMES)) @ T_world_base)

    numeric = numeric_jacobian(twist, 6 * 9)
    J = jacobians(spline, se3.inverse(T_world_base), TIMES, 0, 7)
    np.testing.assert_allclose(J, numeric[:, :, :42], atol=1e-7)
    assert np.abs(numeric[:, :, 42:]).max() == 0.0
    # Control points moved alike move every line alike.
    to_base = se3.adjoint(se3.inverse(T_world_base))
    np.testing.assert_allclose(J.reshape(6, 6, 7, 6).sum(axis=2), np.broadcast_to(to_base, (6, 6, 6)), atol=1e-12)


def test_chain_equals_the_sum_over_blocks() -> None:
    rng, spline, T = np.random.default_rng(1), random_spline(4), se3.exp(np.full(6, 0.2))
    sums, own = random_sums(rng, len(TIMES), 1), rng.normal(size=(len(TIMES), 1, 6, 3))
    slopes = Slopes.of(spline, T, TIMES, None)
    model, coupling = chain(sums, slopes, own)
    assert (model.first, model.last) == (0, 7) and slopes.current.shape == (6, 6, 42)
    J = jacobians(spline, se3.inverse(T), TIMES, 0, 7)
    np.testing.assert_array_equal(slopes.current, J)
    H = sum(J[i].T @ sums.H[i, 0] @ J[i] for i in range(6))
    g = sum(J[i].T @ sums.g[i, 0] for i in range(6))
    np.testing.assert_allclose(model.H, H, atol=1e-11 * np.abs(H).max())
    np.testing.assert_allclose(model.g, g, atol=1e-11 * np.abs(g).max())
    np.testing.assert_array_equal(model.H, model.H.T)
    np.testing.assert_allclose(coupling, sum(J[i].T @ own[i, 0] for i in range(6)), atol=1e-9)
    late, _ = chain(random_sums(rng, 2, 1), Slopes.of(spline, np.eye(4), TIMES[-2:], None))
    assert (late.first, late.last, late.H.shape) == (2, 7, (30, 30))


def test_a_rolling_reference_moves_the_other_way() -> None:
    rng, spline, T = np.random.default_rng(2), random_spline(5), se3.exp(np.full(6, -0.3))
    times, ref_times = TIMES[3:], TIMES[:3]
    sums = random_sums(rng, 3, 3)
    # Pairs of blocks that no pixel connects.
    for a, b in ((0, 2), (2, 1)):
        sums.H[a, b], sums.g[a, b] = 0.0, 0.0
    slopes = Slopes.of(spline, T, times, ref_times)
    model, _ = chain(sums, slopes)
    assert (model.first, model.last) == (0, 7)
    J, K = jacobians(spline, se3.inverse(T), times, 0, 7), jacobians(spline, se3.inverse(T), ref_times, 0, 7)
    np.testing.assert_array_equal(slopes.current, J)
    H, g = np.zeros((42, 42)), np.zeros(42)
    for a in range(3):
        for b in range(3):
            H += (J[a] - K[b]).T @ sums.H[a, b] @ (J[a] - K[b])
            g += (J[a] - K[b]).T @ sums.g[a, b]
    np.testing.assert_allclose(model.H, H, atol=1e-11 * np.abs(H).max())
    np.testing.assert_allclose(model.g, g, atol=1e-11 * np.abs(g).max())
    # A motion of everything changes nothing.
    gauge = np.tile(rng.normal(size=6), 7)
    assert np.abs(model.H @ gauge).max() < 1e-10 * np.abs(model.H).max()
    assert abs(model.g @ gauge) < 1e-10 * np.abs(model.g).max()


# -- models, assembly and solution ---------------------------------------------------------------------------------


def test_a_moved_model_is_the_same_parabola() -> None:
    rng = np.random.default_rng(3)
    model = Quadratic(2, random_spd(rng, (), 18), rng.normal(size=18))
    value = lambda m, x: 0.5 * x @ m.H @ x + m.g @ x  # noqa: E731
    step = rng.normal(size=(8, 6))
    there = model.moved(step[2:5])
    own = step[2:5].ravel()
    for x in rng.normal(size=(5, 18)):
        assert value(there, x) + value(model, own) == pytest.approx(value(model, own + x))
    step[2:5] = 0.0
    assert model.moved(step[2:5]) is model


def test_assembly_restricts_to_the_free_control_points() -> None:
    rng = np.random.default_rng(4)
    models = [Quadratic(first, random_spd(rng, (), 24), rng.normal(size=24)) for first in (0, 2, 5, 9)]
    total, slope = np.zeros((78, 78)), np.zeros(78)
    for m in models:
        at = slice(6 * m.first, 6 * m.last)
        total[at, at] += m.H
        slope[at] += m.g
    for first, last in ((0, 13), (3, 8), (4, 5), (12, 13)):
        H, g = assemble(models, first, last)
        free = slice(6 * first, 6 * last)
        np.testing.assert_allclose(H, total[free, free])
        np.testing.assert_allclose(g, slope[free])
    H, g = assemble(models[:1], 4, 6)
    assert not H.any() and not g.any()


@pytest.mark.parametrize("points", [1, 3, 4, 12, 40])
def test_solution_equals_that_of_dense_algebra(points: int) -> None:
    rng = np.random.default_rng(points)
    size, width = 6 * points, min(points, 4)
    H = 1e-3 * np.eye(size)
    for first in range(points - width + 1):
        at = slice(6 * first, 6 * (first + width))
        H[at, at] += random_spd(rng, (), 6 * width)
    # Units and weights that differ by many orders of magnitude.
    scale = 10.0 ** rng.uniform(-5, 5, size)
    H, g = H * scale[:, None] * scale, rng.normal(size=size) * scale
    x = solve(H, g)
    want = np.linalg.solve(H / scale[:, None] / scale, -g / scale) / scale
    np.testing.assert_allclose(x * scale, want * scale, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(H @ x, -g, rtol=1e-6, atol=1e-9 * np.abs(g).max())


@pytest.mark.parametrize("least", [0.0, -1.0])
def test_a_system_without_a_minimum_is_refused(least: float) -> None:
    H = np.diag([*np.ones(11), least])
    H[0, 1] = H[1, 0] = 0.5
    with pytest.raises(np.linalg.LinAlgError):
        solve(H, np.ones(12))


@pytest.mark.parametrize("broken", ["H is NaN", "g is NaN", "a diagonal is negative"])
def test_equations_that_are_not_finite_have_no_solution(broken: str) -> None:
    """A track that ran away, lr kt0 with a global shutter, once ended in scipy's ValueError."""
    H, g = np.eye(24), np.ones(24)
    if broken == "a diagonal is negative":
        H[3, 3], H[3, 5], H[5, 3] = -1e-9, 1e200, 1e200
    else:
        (H if broken == "H is NaN" else g)[3] = np.nan
    with pytest.raises(np.linalg.LinAlgError):
        solve(H, g)


def test_a_system_that_rounding_made_indefinite_is_damped() -> None:
    """An IMU beside a bare wall, imu_walls: seconds of motions that no image tells ended the run."""
    rng = np.random.default_rng(6)
    axes = np.linalg.qr(rng.normal(size=(60, 60)))[0]
    sizes = np.geomspace(1.0, 1e6, 60)
    g = axes @ (sizes * rng.normal(size=60))
    H = (axes * sizes) @ axes.T
    np.testing.assert_array_equal(solve_damped(H, g, 60), solve(H, g, 60))
    sizes[0] = -1e-4
    H = (axes * sizes) @ axes.T
    with pytest.raises(np.linalg.LinAlgError):
        solve(H, g, 60)
    told = axes[:, 1:].T @ solve_damped(H, g, 60)
    np.testing.assert_allclose(told, -axes[:, 1:].T @ g / sizes[1:], rtol=0.05, atol=0.05)
    with pytest.raises(np.linalg.LinAlgError):
        solve_damped(H, np.full(60, np.nan), 60)


# -- Anderson mixing -------------------------------------------------------------------------------------------------

RNG = np.random.default_rng(4)
A = RNG.normal(size=(12, 12))
NORMAL = A @ A.T / 12 + 0.1 * np.eye(12)
GOAL = RNG.normal(size=12)


def iterations(H: np.ndarray, accelerated: bool, most: int = 5000) -> int:
    """Steps with the Hessian H until the quadratic cost with the Hessian NORMAL is at its minimum."""
    x, acceleration = np.zeros(12), AndersonMixing()
    for n in range(most):
        if np.linalg.norm(x - GOAL) < 1e-4:
            return n
        step = -np.linalg.solve(H, NORMAL @ (x - GOAL))
        x = x + (acceleration.extrapolated(x, step, H) if accelerated else step)
    return most


def test_a_hessian_that_is_too_large_costs_a_third_of_the_steps() -> None:
    noise = 8.0 * np.diag(np.abs(RNG.normal(size=12)))  # adds up in every direction, as squared noise of gradients does
    plain = iterations(NORMAL + noise, accelerated=False)
    assert plain > 100 and iterations(NORMAL + noise, accelerated=True) < plain // 3


def test_one_slow_motion_is_found_in_two_more_steps() -> None:
    d = np.linalg.eigh(NORMAL)[1][:, 0]
    slow = NORMAL + 0.25 * np.outer(d, d)
    assert iterations(slow, accelerated=False) > 20
    assert iterations(slow, accelerated=True) <= 4


def test_increments_may_be_moved_in_place_afterwards() -> None:
    found = []
    for in_place in (False, True):
        at, acceleration = np.zeros(12), AndersonMixing()
        for n in range(4):
            given = at if in_place else at.copy()
            step = acceleration.extrapolated(given, 0.9**n * np.linspace(0.1, 0.5, 12), NORMAL)
            at += step
        found.append(at)
    np.testing.assert_array_equal(*found)


def test_fast_steps_stay_as_they_are() -> None:
    acceleration, step = AndersonMixing(), np.full(12, 0.5)
    assert acceleration.extrapolated(np.zeros(12), step, NORMAL) is step
    shorter = 0.2 * step
    assert acceleration.extrapolated(step, shorter, NORMAL) is shorter


def test_it_goes_four_times_as_far_as_the_plain_step_at_most() -> None:
    acceleration, step = AndersonMixing(), np.full(12, 0.5)
    acceleration.extrapolated(np.zeros(12), step, NORMAL)
    further = acceleration.extrapolated(step, 0.99 * step, NORMAL)
    np.testing.assert_allclose(further, 4.0 * 0.99 * step)
