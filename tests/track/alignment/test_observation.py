"""An observation: its scale at each level, how long its linearisation and its slopes are good, and what is hidden."""

from __future__ import annotations

import numpy as np
import pytest
from pose_terms import PoseTerms, sighting
from rstrack_util import disturbed, hand_held

from rstrack.alignment.observation import Observation
from rstrack.alignment.spline_state import SplineState
from rstrack.keyframes.keyframe import THINNED

TRUTH = hand_held(3)
TIMES = np.linspace(0.4, 0.5, 20)


@pytest.fixture
def state() -> SplineState:
    return SplineState(disturbed(TRUTH, 1, 0.01))


def seen() -> Observation:
    return sighting(TIMES, TRUTH.pose(TIMES))


@pytest.mark.parametrize(("level", "pixels"), [(0, 1.0), (1, 4.0), (2, 16.0)])
def test_a_coarse_levels_pixels_stand_for_those_left_out(level: int, pixels: float, state: SplineState) -> None:
    sight = seen()
    assert not sight.is_linearised and sight.shift(state, 500.0) == np.inf
    sight.linearise(PoseTerms(), state, level)  # type: ignore[arg-type]
    assert sight.is_linearised and sight.stands_for == pixels and sight.shift(state, 500.0) == 0.0
    np.testing.assert_allclose(sight.model(state).H, pixels * sight.lin.model.H)
    np.testing.assert_allclose(sight.model(state).g, pixels * sight.lin.model.g)


@pytest.mark.parametrize(("counted", "is_thinned"), [(1 / 15, False), (1 / 17, True)])
def test_where_few_pixels_count_a_quarter_of_them_is_looked_at(
    counted: float, is_thinned: bool, state: SplineState
) -> None:
    sight, terms = seen(), PoseTerms()
    sight.independent = counted
    for level in (2, 1, 0):
        sight.linearise(terms, state, level)  # type: ignore[arg-type]
    assert [level for level, _ in terms.calls] == [2, 1, THINNED if is_thinned else 0]
    quarter = 4.0 if is_thinned else 1.0
    assert sight.pixels == quarter * len(TIMES) and sight.stands_for == quarter * counted
    np.testing.assert_allclose(sight.model(state).H, quarter * counted * sight.lin.model.H)


def test_its_model_is_moved_along_with_the_state(state: SplineState) -> None:
    sight, terms = seen(), PoseTerms()
    sight.linearise(terms, state, 0)  # type: ignore[arg-type]
    model = sight.lin.model
    step = 1e-3 * np.random.default_rng(0).normal(size=(len(state.points), 6))
    assert sight.change(state) == 0.0
    state.apply(0, step)
    own = step[model.first : model.last].ravel()
    np.testing.assert_allclose(sight.model(state).g, model.g + model.H @ own)
    # By its model the cost has changed as it really has, nearly.
    again = seen()
    again.linearise(terms, state, 0)  # type: ignore[arg-type]
    really = terms.costs[1] - terms.costs[0]
    assert sight.change(state) == pytest.approx(really, rel=0.02) and abs(really) > 1e-6
    assert sight.shift(state, 500.0) > 0.1
    # Control points that are new since have not moved it.
    state.extend(1.5)
    assert sight.change(state) == pytest.approx(really, rel=0.02)


def test_slopes_are_kept_until_control_points_have_moved_by_two_centimetres(state: SplineState) -> None:
    sight, terms = seen(), PoseTerms()
    sight.linearise(terms, state, 0)  # type: ignore[arg-type]
    there = state.spline
    for step, is_kept in ((16e-3, True), (3.6e-3, True), (0.8e-3, False)):
        state.apply(3, np.array([[0.0, step, 0.0, 0.0, 0.0, 0.0]]))
        sight.linearise(terms, state, 0)  # type: ignore[arg-type]
        assert (terms.slopes[-1] is there) == is_kept
    assert terms.slopes[-1] is state.spline


def test_what_is_hidden_is_told_once_at_the_finest_level(state: SplineState) -> None:
    sight, terms = seen(), PoseTerms()
    sight.occluder = "a depth image"  # type: ignore[assignment]
    for level, shown in ((2, None), (1, None), (0, "some"), (0, "some"), (1, None)):
        sight.linearise(terms, state, level)  # type: ignore[arg-type]
        assert sight.image.shown == shown  # type: ignore[union-attr]
        assert terms.visible_asked == len({0} & {at for at, _ in terms.calls})
    alone = seen()
    alone.linearise(terms, state, 0)  # type: ignore[arg-type]
    assert alone.image.shown is None and terms.visible_asked == 1  # type: ignore[union-attr]
