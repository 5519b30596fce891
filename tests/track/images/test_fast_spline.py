"""Compiled splines against those of NumPy, which have tests of their own."""

from __future__ import annotations

import numpy as np
import pytest

from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.alignment.normal_equations import by_points
from rstrack.images.fast_spline import changed, jacobians, motions, moved

# Increments between control points (m, rad): hardly any, a hand's, and where closed forms take over from series.
STEPS = [1e-9, 0.05, 0.9]


def wandering(step: float, count: int = 12) -> Spline:
    rng, points = np.random.default_rng(5), [np.eye(4)]
    for xi in step * rng.standard_normal((count - 1, 6)):
        points.append(se3.orthonormalise(points[-1] @ se3.exp(xi)))
    return Spline(np.array(points), 0.3, 0.05)


@pytest.mark.parametrize("step", STEPS)
def test_poses_and_twists_are_those_of_the_spline(step: float) -> None:
    for spline in (wandering(step), wandering(step).tail(3)):
        times = np.linspace(spline.t_begin, spline.t_end, 40)
        for found, expected in zip(motions(spline, times), spline.pose_and_velocity(times), strict=True):
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13 * max(1.0, np.abs(expected).max()))


@pytest.mark.parametrize("step", STEPS)
def test_jacobians_are_those_of_the_spline_in_the_base_frame(step: float) -> None:
    T_base_world = se3.exp(np.array([0.4, -0.2, 0.3, 0.5, 0.1, -0.7]))
    for spline in (wandering(step), wandering(step).tail(3)):
        times = np.linspace(spline.t_begin, spline.t_end, 40)
        at, J = spline.pose_jacobian(times)
        expected = by_points(at, se3.adjoint(T_base_world) @ J, spline.first, 12 - spline.first)
        found = jacobians(spline, T_base_world, times, spline.first, 12 - spline.first)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13 * np.abs(expected).max())


def test_times_outside_a_spline_are_refused() -> None:
    spline = wandering(0.05)
    for times in ([0.2], [0.4, spline.t_end + 0.01], [np.nan]):
        with pytest.raises(UserError, match="outside"):
            motions(spline, np.array(times))
        with pytest.raises(UserError, match="outside"):
            jacobians(spline, np.eye(4), np.array(times), 0, 12)
    # Rounding of the times themselves is not outside.
    np.testing.assert_allclose(motions(spline, np.array([spline.t_end + 1e-12]))[0][0], spline.pose(spline.t_end))


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize(("first", "count"), [(0, 1), (1, 3), (7, 3), (11, 1), (12, 3)])
def test_changed_control_points_derive_what_a_new_spline_would(step: float, first: int, count: int) -> None:
    spline = wandering(step)
    points = (
        se3.exp(step * np.random.default_rng(7).standard_normal((count, 6))) @ spline.control_points[[min(first, 11)]]
    )
    found = changed(spline, first, points)
    expected = Spline(found.control_points, spline.t0, spline.dt)
    assert len(found.control_points) == max(12, first + count)
    np.testing.assert_array_equal(found.control_points[first : first + count], points)
    np.testing.assert_array_equal(found.control_points[:first], spline.control_points[:first])
    np.testing.assert_array_equal(found.control_points[first + count :], spline.control_points[first + count :])
    np.testing.assert_allclose(found.increments, expected.increments, rtol=0, atol=1e-14)
    np.testing.assert_allclose(found.left_gains, expected.left_gains, rtol=0, atol=1e-13)
    if first > 3:
        end = changed(spline.tail(3), first, points)
        assert end.first == 3
        for name in ("control_points", "increments", "left_gains"):
            np.testing.assert_array_equal(getattr(end, name), getattr(found, name)[3:])


def test_moved_poses_are_proper_rotations_whatever_had_drifted() -> None:
    rng = np.random.default_rng(8)
    T, increments = wandering(0.9).control_points.copy(), rng.standard_normal((12, 6))
    expected = se3.orthonormalise(se3.exp(increments) @ T)
    np.testing.assert_allclose(moved(T, increments), expected, rtol=0, atol=1e-14)
    T[:, :3, :3] += 1e-5 * rng.standard_normal((12, 3, 3))
    expected = se3.orthonormalise(se3.exp(increments) @ T)
    np.testing.assert_allclose(moved(T, increments), expected, rtol=0, atol=1e-14)
