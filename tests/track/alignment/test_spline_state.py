"""The spline while it grows, moves, is smoothed at its end and starts anew."""

from __future__ import annotations

import numpy as np
import pytest
from rstrack_util import hand_held
from util import random_twists

from rsgen.geometry import se3
from rstrack.alignment.priors import acceleration_prior, velocity_prior
from rstrack.alignment.spline_state import PointStore, SplineState


def test_extension_keeps_the_velocity() -> None:
    step = np.array([0.01, -0.02, 0.03, 0.04, -0.01, 0.02])
    state = SplineState.still(0.0, 0.05, np.eye(4))
    state.apply(0, np.arange(4)[:, None] * step)  # exp(k ξ)
    state.extend(1.0)
    assert len(state.points) == 24 == len(state.moved)
    np.testing.assert_allclose(state.points, se3.exp(np.arange(24)[:, None] * step), atol=1e-12)
    np.testing.assert_allclose(state.spline.velocity(0.97), step / 0.05, atol=1e-9)
    assert not state.moved[4:].any()


def test_extension_covers_the_time_and_no_more() -> None:
    state = SplineState.still(0.1, 0.05, np.eye(4))
    state.extend(0.12)
    assert len(state.points) == 4
    before = state.spline
    assert state.spline is before
    state.extend(0.31)
    assert state.spline.t_end == pytest.approx(0.35) and state.spline is not before
    assert state.segment(0.31) == 4 and state.spline.locate(0.31)[0] == 4


def test_increments_multiply_from_the_left() -> None:
    rng, truth = np.random.default_rng(6), hand_held(3)
    state = SplineState(truth)
    delta, again = random_twists(rng, (2, 4), 0.3, 0.2)
    state.apply(5, delta)
    want = truth.control_points.copy()
    want[5:9] = se3.exp(delta) @ want[5:9]
    np.testing.assert_allclose(state.spline.control_points, want, atol=1e-14)
    state.apply(7, again)
    want[7:11] = se3.exp(again) @ want[7:11]
    np.testing.assert_allclose(state.spline.control_points, want, atol=1e-14)
    total = np.zeros((15, 6))
    total[5:9] += delta
    total[7:11] += again
    np.testing.assert_allclose(state.moved, total)


def test_poses_stay_rotations_for_ever() -> None:
    rng = np.random.default_rng(7)
    state = SplineState.still(0.0, 0.05, se3.exp(np.array([0.3, 0.1, 0.2, 0.5, -0.4, 0.8])))
    for k in range(1000):
        state.extend(0.05 * (k + 1))
        state.apply(len(state.points) - 4, random_twists(rng, (4,), 0.02, 0.01))
    R = state.points[:, :3, :3]
    assert len(state.points) == 1004
    assert np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max() < 1e-14
    assert np.linalg.det(R).min() > 0.0


def test_a_long_extrapolation_stays_rotations() -> None:
    # With the transpose taken as inverse, what is left of orthogonality would grow 2.4 times a knot.
    state = SplineState.still(0.0, 0.05, np.eye(4))
    state.apply(0, np.arange(4)[:, None] * np.array([0.01, -0.02, 0.03, 0.3, -0.2, 0.25]))
    for k in range(300):
        state.extend(0.05 * (k + 1))
    R = state.points[:, :3, :3]
    assert np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max() < 1e-14


def test_a_copy_changes_alone() -> None:
    state = SplineState(hand_held(2))
    before, twin = state.points.copy(), state.copy()
    twin.apply(3, np.full((4, 6), 0.1))
    twin.extend(2.0)
    np.testing.assert_array_equal(state.points, before)
    assert not state.moved.any() and len(state.moved) == 15 and twin.moved[3:7].all()


def at_end(u: float) -> tuple[SplineState, float]:
    """A state with a last control point that jumps, and a time at position u of the last knot interval."""
    step = np.array([0.01, -0.02, 0.03, 0.04, -0.01, 0.02])
    state = SplineState.still(0.1, 0.05, np.eye(4), 9)
    state.apply(0, np.arange(9)[:, None] * step)
    state.apply(8, np.array([[0.05, -0.1, 0.02, 0.1, 0.2, -0.1]]))
    return state, 0.1 + 0.05 * (5 + u)


@pytest.mark.parametrize(("u", "is_smoothed"), [(0.01, True), (0.59, True), (0.61, False), (0.99, False)])
def test_an_end_that_lines_hardly_saw_is_laid_on_with_constant_velocity(u: float, is_smoothed: bool) -> None:
    state, t = at_end(u)
    before, moved = state.points.copy(), state.moved.copy()
    state.smooth_end(t)
    np.testing.assert_array_equal(state.points[:8], before[:8])
    if not is_smoothed:
        np.testing.assert_array_equal(state.points[8], before[8])
        return
    np.testing.assert_allclose(state.points[8], before[7] @ se3.inverse(before[6]) @ before[7], atol=1e-12)
    # What was done counts as moved, so that linearisations know.
    np.testing.assert_allclose(se3.exp(state.moved[8] - moved[8]) @ before[8], state.points[8], atol=1e-12)
    np.testing.assert_array_equal(state.moved[:8], moved[:8])


def test_an_end_beyond_the_lines_is_left_alone() -> None:
    state, t = at_end(0.3)
    before = state.points.copy()
    state.smooth_end(t - 0.05)  # another control point follows those that the lines touch
    np.testing.assert_array_equal(state.points, before)


@pytest.mark.parametrize(("gap_knots", "last"), [(0.4, 1.3), (3.0, 4.0), (9.7, 10.4)])
def test_a_restart_keeps_what_was_and_stands_still_at_the_pose(gap_knots: float, last: float) -> None:
    spline = hand_held(3)
    end = spline.t_end - 0.12
    T = se3.exp(np.array([1.0, 2.0, 3.0, 0.5, -0.3, 0.2]))
    first_time, last_time = end + gap_knots * 0.05, end + last * 0.05
    state = SplineState(spline).restarted(end, first_time, last_time, T)
    assert state.spline.t0 == spline.t0 and state.dt == spline.dt and not state.moved.any()
    # Standing still while the new frame is taken, with no more control points than that needs.
    for t in np.linspace(first_time, last_time, 5):
        np.testing.assert_allclose(state.spline.pose(t), T, atol=1e-12)
        np.testing.assert_allclose(state.spline.velocity(t), 0.0, atol=1e-9)
    assert len(state.points) == state.segment(last_time) + 4 == len(state.moved)
    # What was is kept as far as the new piece's control points do not reach back.
    kept = min(state.segment(end) + 4, state.segment(first_time))
    np.testing.assert_array_equal(state.points[:kept], spline.control_points[:kept])
    if gap_knots > 4.0:
        np.testing.assert_allclose(state.spline.pose(end), spline.pose(end), atol=1e-12)
        # Between the two it rests where it was.
        between = state.points[state.segment(end) + 4 : state.segment(first_time)]
        assert len(between) > 3 and (between == spline.control_points[state.segment(end) + 3]).all()


def test_what_is_released_is_kept_and_all_goes_on_as_before() -> None:
    rng = np.random.default_rng(8)
    held, released = SplineState(hand_held(4)), SplineState(hand_held(4))
    for k in range(60):
        now = held.spline.t_end + 0.03
        delta = random_twists(rng, (4,), 0.02, 0.01)
        for state in (held, released):
            state.smooth_end(now - 0.03)
            state.extend(now)
            state.apply(state.end - 4, delta)
        if k % 7 == 6:
            released.release(released.end - 12)
    assert len(released.points) < 30 < len(held.points) and held.first == 0
    end = held.spline.t_end
    for a, b in ((held, released), (held.copy(), released.copy())):
        assert a.end == b.end == len(b.whole.control_points)
        np.testing.assert_array_equal(a.spline.control_points, b.whole.control_points)
        np.testing.assert_array_equal(a.received(a.end - 9, a.end), b.received(a.end - 9, a.end))
        assert a.segment(end - 0.1) == b.segment(end - 0.1)
    sigma = np.ones((4, 6))
    for prior, given in ((acceleration_prior, sigma), (velocity_prior, np.ones(6))):
        (one, cost), (two, other) = (prior(s.spline, held.end - 6, held.end, given) for s in (held, released))
        np.testing.assert_array_equal(one.H, two.H)
        assert cost == other and one.first == two.first
    T = se3.exp(np.array([1.0, 2.0, 3.0, 0.5, -0.3, 0.2]))
    one, two = (s.restarted(end - 0.12, end + 0.3, end + 0.4, T) for s in (held, released))
    np.testing.assert_array_equal(one.points, two.whole.control_points)
    assert one.untouched == two.untouched and two.first == released.first


def test_distances_are_of_the_control_points_that_both_hold() -> None:
    state = SplineState(hand_held(2))
    before = state.copy()
    state.apply(3, np.full((1, 6), 0.5))
    state.apply(9, np.full((1, 6), 0.1))
    state.extend(state.spline.t_end + 0.2)
    assert state.distance_from(before) == pytest.approx(0.5)
    state.release(6)
    assert state.distance_from(before) == pytest.approx(0.1)


def test_a_store_grows_at_its_end_and_may_be_cut() -> None:
    poses, store = np.random.default_rng(9).normal(size=(300, 4, 4)), PointStore()
    for at in range(0, 300, 7):
        store.put(at, poses[at : at + 7])
    np.testing.assert_array_equal(store.points, poses)
    with pytest.raises(ValueError):
        store.points[0] = 0.0
    store.put(100, poses[:5])
    np.testing.assert_array_equal(store.points, np.concatenate([poses[:100], poses[:5]]))
    for at in (-1, 106):
        with pytest.raises(IndexError, match="where there are 105"):
            store.put(at, poses[:1])
