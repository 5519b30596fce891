"""Levenberg-Marquardt on costs in closed form: steps taken back, lazy relinearisation, stops, what is held fixed."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pose_terms import DEPTH_M, FOCAL, PoseTerms, problem, sighting
from rstrack_util import disturbed, hand_held

from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.alignment import optimizer
from rstrack.alignment.normal_equations import Quadratic, assemble, solve
from rstrack.alignment.optimizer import Solved, optimise
from rstrack.alignment.spline_state import SplineState

MOST = (15, 8, 30)
TRUTH = hand_held(3)
TIMES = np.linspace(TRUTH.t_begin, TRUTH.t_end - 1e-6, 60)


def shift_px(a: Spline, b: Spline, times: np.ndarray = TIMES) -> float:
    """How far the two are apart, as the optimiser measures it."""
    e = np.abs(se3.log(b.pose(times) @ se3.inverse(a.pose(times))))
    return float((FOCAL * (e[:, :3].max(axis=1) / DEPTH_M + e[:, 3:].max(axis=1))).max())


def aside(spline: Spline, px: float) -> Spline:
    """Moved as a whole, so that its lines lie that many pixels further."""
    T = se3.exp(np.array([px * DEPTH_M / FOCAL, 0.0, 0.0, 0.0, 0.0, 0.0]))
    return Spline(T @ spline.control_points, spline.t0, spline.dt)


def start(size: float = 0.03) -> SplineState:
    return SplineState(disturbed(TRUTH, 5, size))


def run(terms: PoseTerms, state: SplineState, *of: Any, levels: tuple[int, ...] = (0,), **how: Any) -> Solved:
    return optimise(terms, state, problem(*of, **how), levels, how.pop("most", MOST))  # type: ignore[arg-type]


def test_the_truth_is_found() -> None:
    state = start()
    assert shift_px(state.spline, TRUTH) > 10.0
    done = run(PoseTerms(), state, [sighting(TIMES, TRUTH.pose(TIMES))], state)
    assert shift_px(state.spline, TRUTH) < 1e-3
    assert done.refused == 0 and done.iterations <= 4 and done.last_shift < 0.02


# -- steps that make things worse --------------------------------------------------------------------------------------


def test_a_step_that_raises_the_cost_is_taken_back_and_damped() -> None:
    state, terms = start(), PoseTerms(curvature=0.2)
    sight, before = sighting(TIMES, TRUTH.pose(TIMES)), state.points.copy()
    done = optimise(terms, state, problem([sight], state), (0,), (2, 0, 0))
    assert (done.iterations, done.refused, done.evaluations) == (2, 1, 2)
    assert terms.costs[1] > terms.costs[0] and sight.lin.cost == terms.costs[0]
    # From where it was, with the diagonal raised by a thousandth.
    model = PoseTerms(curvature=0.2).photometric(sight.image, None, Spline(before, 0.3, 0.05), 0, 1.0, start().spline)()
    H, g = assemble([model.model], 0, len(before))
    H[np.diag_indices_from(H)] *= 1.001
    want = solve(H, g).reshape(-1, 6)
    np.testing.assert_allclose(state.moved, want, atol=1e-9 * np.abs(want).max())
    np.testing.assert_allclose(state.points, se3.exp(want) @ before, atol=1e-9)


def test_steps_five_times_too_long_still_lead_downhill() -> None:
    state, terms = start(0.1), PoseTerms(curvature=0.2)
    sight = sighting(TIMES, TRUTH.pose(TIMES))
    done = optimise(terms, state, problem([sight], state), (0,), (60, 0, 0))  # type: ignore[arg-type]
    assert done.refused > 5 and sight.lin.cost < 0.01 * terms.costs[0]
    # Untamed, each step makes it four times worse.
    wild, terms = start(), PoseTerms(curvature=0.2)
    for _ in range(4):
        sight.linearise(terms, wild, 0)  # type: ignore[arg-type]
        wild.apply(0, solve(*assemble([sight.model(wild)], 0, 15)).reshape(-1, 6))
    assert terms.costs[3] > 100.0 * terms.costs[0]


def test_priors_count_when_a_step_is_judged() -> None:
    """A prior that asks for 2 mm, with steps ten times too long; the images would have them all the way."""
    state = SplineState(TRUTH)

    def prior(spline: Spline) -> tuple[Quadratic, float]:
        e = spline.control_points[:, 0, 3] - TRUTH.control_points[:, 0, 3] - 2e-3
        g = np.zeros((15, 6))
        g[:, 0] = 1e4 * e
        return Quadratic(0, 1e3 * np.eye(90), g.ravel()), 0.5e4 * float((e**2).sum())

    far = SplineState(TRUTH)
    far.apply(0, np.tile([0.02, 0.0, 0.0, 0.0, 0.0, 0.0], (15, 1)))
    terms = PoseTerms()
    sight = sighting(TIMES, far.spline.pose(TIMES))
    assert optimise(terms, state, problem([sight], state, priors=[prior]), (0,), (2, 0, 0)).refused == 1  # type: ignore[arg-type]
    assert terms.costs[1] < terms.costs[0]


# -- lazy relinearisation ----------------------------------------------------------------------------------------------


def test_to_relinearise_only_what_has_moved_leads_to_the_same_place(monkeypatch: pytest.MonkeyPatch) -> None:
    # Frames of twelve lines each that do not quite agree, as with noise; all but the last are settled.
    rng = np.random.default_rng(0)
    frames = []
    for k in range(6):
        times = TIMES[10 * k : 10 * k + 10]
        frames.append((times, se3.exp(1e-4 * rng.normal(size=(10, 6))) @ TRUTH.pose(times)))
    found, evaluations = [], []
    for limit in (optimizer.RELINEARISE_PX, 0.0):
        monkeypatch.setattr(optimizer, "RELINEARISE_PX", limit)
        state, terms, seen = start(0.002), PoseTerms(), [sighting(*frame) for frame in frames]
        run(terms, state, [*seen[:5], sighting(TIMES[48:], TRUTH.pose(TIMES[48:]))], state)
        before = len(terms.calls)
        done = run(terms, state, seen[5:], state, seen[:5])
        found.append(state.spline)
        evaluations.append(len(terms.calls) - before)
        assert done.evaluations == evaluations[-1] and done.last_shift < 0.02
    assert 0.0 < shift_px(*found) < 0.02
    assert evaluations[0] < 0.6 * evaluations[1]


@pytest.mark.parametrize(("px", "is_kept"), [(0.019, True), (0.021, False)])
def test_settled_models_are_kept_while_their_lines_hardly_move(px: float, is_kept: bool) -> None:
    state = SplineState(TRUTH)
    old, new = sighting(TIMES, TRUTH.pose(TIMES)), sighting(TIMES, aside(TRUTH, 2.0 * px).pose(TIMES))
    old.linearise(PoseTerms(), state, 0)  # type: ignore[arg-type]
    kept, terms = old.linearisation, PoseTerms()
    run(terms, state, [new], state, [old])
    # Both count alike: the lines end halfway, kept or not.
    assert shift_px(state.spline, aside(TRUTH, px)) < 1e-4
    assert (old.linearisation is kept) == is_kept


def test_settled_models_are_of_the_finest_level_only() -> None:
    state = SplineState(TRUTH)
    old, new = sighting(TIMES, TRUTH.pose(TIMES)), sighting(TIMES, aside(TRUTH, 50.0).pose(TIMES))
    old.linearise(PoseTerms(), state, 0)  # type: ignore[arg-type]
    kept = old.linearisation
    terms = PoseTerms()
    run(terms, state, [new], state, [old], levels=(2, 1))
    assert old.linearisation is kept and {level for level, _ in terms.calls} == {2, 1}
    run(terms, state, [new], state, [old])
    assert old.linearisation is not kept


def test_what_is_predicted_takes_its_scale_from_the_finest_level_all_the_same() -> None:
    """Lines that hardly move would keep the first linearisation, and with it the σ of a coarser level."""
    for predicted, sigmas in ((False, [0.03]), (True, [0.03, 0.7])):
        state, terms = SplineState(TRUTH), PoseTerms(next_sigma=0.7)
        seen = [sighting(TIMES, aside(TRUTH, 0.004).pose(TIMES))]
        done = run(terms, state, seen, state, predicted=predicted)
        assert [sigma for _, sigma in terms.calls] == sigmas and done.iterations == len(sigmas)
        assert shift_px(state.spline, aside(TRUTH, 0.004)) < 1e-4


# -- levels and stops --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("level", "px", "steps"), [(0, 0.019, 1), (0, 0.021, 2), (1, 0.099, 1), (1, 0.101, 2), (2, 0.29, 1), (2, 0.31, 2)]
)
def test_a_level_ends_when_no_line_moves_any_more(level: int, px: float, steps: int) -> None:
    state = SplineState(TRUTH)
    done = run(PoseTerms(), state, [sighting(TIMES, aside(TRUTH, px).pose(TIMES))], state, levels=(level,))
    assert done.iterations == steps
    assert shift_px(state.spline, aside(TRUTH, px)) < 1e-4


def test_levels_go_from_coarse_to_fine_and_keep_the_scale() -> None:
    state, terms = start(), PoseTerms(next_sigma=0.7)
    run(terms, state, [sighting(TIMES, TRUTH.pose(TIMES))], state, levels=(2, 1, 0))
    assert [level for level, _ in terms.calls] == sorted((level for level, _ in terms.calls), reverse=True)
    assert {level for level, _ in terms.calls} == {2, 1, 0}
    # The first linearisation knows no scale.
    assert [sigma for _, sigma in terms.calls] == [0.03] + [0.7] * (len(terms.calls) - 1)
    sight = sighting(TIMES, TRUTH.pose(TIMES))
    for _ in range(2):  # nor does it in another optimisation
        terms.calls.clear()
        run(terms, state, [sight], state, levels=(1, 0))
        assert terms.calls[0] == (1, 0.03)


def test_control_points_that_are_not_free_stay() -> None:
    state = start()
    before = state.points.copy()
    run(PoseTerms(), state, [sighting(TIMES, TRUTH.pose(TIMES))], state, free=(4, 12))
    held = np.r_[:4, 12:15]
    np.testing.assert_array_equal(state.points[held], before[held])
    assert not state.moved[held].any() and np.abs(state.moved[4:12]).max(axis=1).min() > 1e-3


# -- systems without a solution ----------------------------------------------------------------------------------------


def test_motions_that_nothing_tells_are_damped() -> None:
    """One line for four control points: 6 equations for 24 unknowns."""
    state = start()
    t = TIMES[30:31]
    at = state.segment(float(t[0]))
    run(PoseTerms(), state, [sighting(t, TRUTH.pose(t))], state, free=(at, at + 4))
    assert np.isfinite(state.points).all() and shift_px(state.spline, TRUTH, t) < 0.02


@pytest.mark.parametrize("broken", ["H", "g"])
def test_a_system_that_is_not_finite_is_refused(broken: str) -> None:
    class Broken(PoseTerms):
        def photometric(self, *given: Any) -> Any:
            lin = super().photometric(*given)()
            spoilt = np.full_like(getattr(lin.model, broken), np.nan)
            return lambda: replace(lin, model=replace(lin.model, **{broken: spoilt}))

    state = start()
    with pytest.raises(np.linalg.LinAlgError, match="no finite solution"):
        run(Broken(), state, [sighting(TIMES, TRUTH.pose(TIMES))], state)
    assert not state.moved.any()


def test_where_noise_limits_a_step_much_shorter_than_the_errors_is_the_last() -> None:
    done = []
    for floor in (1.0, 0.0):
        state = start()
        sight = sighting(TIMES, TRUTH.pose(TIMES))  # poses with σ = 1 m: any start is as good as the truth
        done.append(optimise(PoseTerms(curvature=2.0, floor=floor), state, problem([sight], state), (0,), MOST))
    assert done[1].iterations == 1 < done[0].iterations
