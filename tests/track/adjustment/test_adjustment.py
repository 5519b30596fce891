"""The graph of control points, keyframes and loops: against dense algebra, SciPy's least squares and a known drift."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from util import random_spline

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.adjustment import system
from rstrack.adjustment.chain import BandedHessian, KeyframeModel
from rstrack.adjustment.closing import closed
from rstrack.adjustment.graph import Graph, Sighting, State
from rstrack.adjustment.loops import Loop
from rstrack.alignment.normal_equations import Quadratic, assemble
from rstrack.alignment.priors import ACCELERATION


def quadratic(rng: np.random.Generator, first: int, size: int, strength: float = 1.0) -> Quadratic:
    A = rng.normal(size=(6 * size, 6 * size + 4))
    return Quadratic(first, strength * (A @ A.T), np.zeros(6 * size))


def summed(models: list[Quadratic]) -> BandedHessian:
    band = BandedHessian()
    for model in models:
        band.add(model)
    return band


def dense(band: BandedHessian, count: int) -> FloatArray:
    """H (6n, 6n) of a band over control points 0 to n − 1."""
    H = np.zeros((count, 6, count, 6))
    for i in range(min(len(band), count - band.first)):
        for d in range(band.blocks.shape[1]):
            if band.first + i + d < count:
                H[band.first + i, :, band.first + i + d] += band.blocks[i, d]
                if d:
                    H[band.first + i + d, :, band.first + i] += band.blocks[i, d].T
    return H.reshape(6 * count, 6 * count)


# -- bands ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", [(3, 9, 5), (9, 3, 5), (5, 3, 9)])
def test_a_band_is_the_sum_of_its_models(order: tuple[int, ...]) -> None:
    rng = np.random.default_rng(1)
    models = [quadratic(rng, first, size) for first, size in zip(order, (4, 6, 5), strict=True)]
    H, _ = assemble(models, 0, 16)
    band = summed(models)
    np.testing.assert_allclose(dense(band, 16), H, atol=1e-12)
    packed = band.packed()
    assert packed.blocks.dtype == np.float32 and len(packed) <= 16
    np.testing.assert_allclose(dense(packed, 16), H, rtol=1e-6, atol=1e-5)


def test_a_band_that_is_cut_holds_what_is_before() -> None:
    rng = np.random.default_rng(2)
    models = [quadratic(rng, first, 4) for first in (2, 4, 7)]
    band = summed(models)
    band.cut(6)
    np.testing.assert_allclose(dense(band, 6), assemble(models, 0, 6)[0], atol=1e-12)
    assert band.last == 6
    band.cut(1)
    assert not len(band)


# -- the graph -----------------------------------------------------------------------------------------------------


def moved_state(rng: np.random.Generator, state: State, size: float) -> State:
    return state.moved(
        rng.normal(scale=size, size=(len(state.spline.control_points), 6)),
        rng.normal(scale=size, size=(len(state.keyframes), 6)),
    )


def test_steps_end_where_least_squares_do() -> None:
    rng = np.random.default_rng(3)
    spline = random_spline(11)
    mid = 0.5 * (spline.t_begin + spline.t_end)
    other = se3.exp(np.full(6, 0.1)) @ spline.pose(mid)
    at = State(spline, {4: spline.pose(mid), 9: other})
    models = {k: quadratic(rng, first, size, 1e5) for k, first, size in ((4, 0, 5), (9, 3, 6))}
    # They contradict each other.
    sightings = []
    for k, after in ((9, 0.02), (4, -0.03), (9, -0.06), (4, 0.07)):
        A, off = rng.normal(size=(6, 8)), rng.normal(scale=0.01, size=6)
        T_ref_cam = se3.inverse(at.keyframes[k]) @ spline.pose(mid + after) @ se3.exp(off)
        sightings.append(Sighting(k, mid + after, T_ref_cam, 1e6 * A @ A.T))
    # One keyframe's frames were not where they wanted to be when their models were made.
    gradients = {4: 1e3 * rng.normal(size=(5, 6)), 9: np.zeros((6, 6))}
    seen = [KeyframeModel(4, summed([models[4]]), gradients[4]), KeyframeModel(9, summed([models[9]]))]
    graph = Graph(at, seen, sightings)

    def residuals(x: FloatArray) -> FloatArray:
        state = at.moved(x[:54].reshape(-1, 6), x[54:].reshape(-1, 6))
        out = []
        for k, m in models.items():
            D = state.spline.control_points @ se3.inverse(at.spline.control_points)
            D = D[m.first : m.last]
            E = state.keyframes[k] @ se3.inverse(at.keyframes[k])
            own = se3.log(se3.inverse(E) @ D).ravel()
            root = np.linalg.cholesky(m.H)
            out.append(root.T @ own + np.linalg.solve(root, gradients[k].ravel()))
        for s in sightings:
            T = se3.inverse(state.keyframes[s.keyframe]) @ state.spline.pose(s.t)
            out.append(np.linalg.cholesky(s.information).T @ se3.log(se3.inverse(s.T_ref_cam) @ T))
        omega = state.spline.increments - spline.increments
        sigma = np.repeat(ACCELERATION[None] * spline.dt**2, len(omega) - 1, axis=0)
        sigma[:2] *= 0.1
        sigma[-2:] *= 0.1
        out.append(((omega[1:] - omega[:-1]) / sigma).ravel())
        out.append(np.sqrt(system._HELD) * se3.log(state.spline.control_points[0] @ se3.inverse(start)))
        return np.concatenate(out)

    start = at.spline.control_points[0]
    state = at
    for _ in range(30):
        state, x = graph.step(state)
    found = [*state.spline.control_points, *state.keyframes.values()]
    begun = [*at.spline.control_points, *at.keyframes.values()]
    # From there, which is quick, and where it stays only if that is the least.
    there = se3.log(np.array(found) @ se3.inverse(np.array(begun))).ravel()
    best = least_squares(residuals, there, x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-12)
    expected = at.moved(best.x[:54].reshape(-1, 6), best.x[54:].reshape(-1, 6))
    assert np.abs(x).max() < 1e-9
    assert np.abs(state.spline.control_points - at.spline.control_points).max() > 1e-3
    np.testing.assert_allclose(state.spline.control_points, expected.spline.control_points, atol=2e-6)
    for k, K in expected.keyframes.items():
        np.testing.assert_allclose(state.keyframes[k], K, atol=2e-6)


def test_nothing_moves_where_nothing_pulls() -> None:
    rng = np.random.default_rng(4)
    spline = random_spline(12)
    at = State(spline, {0: spline.pose(spline.t_begin)})
    model = quadratic(rng, 0, 9)
    still = Quadratic(0, model.H, np.zeros(54))
    graph = Graph(at, [KeyframeModel(0, summed([still]))], [])
    _, x = graph.step(at)
    assert np.abs(x).max() < 1e-12
    # Nor does what is moved as one body, which changes nothing.
    body = at.placed(se3.exp(np.array([0.3, -0.2, 0.5, 0.4, 0.1, -0.6])))
    _, x = graph.step(body)
    assert np.abs(x).max() < 1e-9


def test_frames_among_themselves_move_as_one_body() -> None:
    rng = np.random.default_rng(7)
    spline = random_spline(13)
    at = State(spline, {})
    # As of frames against one that is rolling still: a motion of all says nothing.
    together = np.tile(np.eye(6), (9, 1))
    free = np.eye(54) - together @ np.linalg.pinv(together)
    model = quadratic(rng, 0, 9, 1e6)
    graph = Graph(at, [KeyframeModel(None, summed([Quadratic(0, free @ model.H @ free, np.zeros(54))]))], [])
    bent = moved_state(rng, at, 1e-4).placed(se3.exp(np.array([0.3, -0.2, 0.5, 0.4, 0.1, -0.6])))
    for _ in range(5):
        bent, x = graph.step(bent)
    assert np.abs(x).max() < 1e-9
    back = at.placed(bent.spline.control_points[0] @ se3.inverse(at.spline.control_points[0]))
    np.testing.assert_allclose(bent.spline.control_points, back.spline.control_points, atol=1e-9)


# -- loops ---------------------------------------------------------------------------------------------------------

EVERY = 10  # control points from keyframe to keyframe


def drifted_track(rng: np.random.Generator) -> tuple[Graph, State, list[Loop]]:
    """Three rounds on a circle, tracked with errors from keyframe to keyframe; the truth; and true loops."""
    dt, count = 0.05, 243
    angle = 3 * 2.0 * np.pi * np.arange(count) / count
    xi = np.stack([np.cos(angle), np.sin(angle), 0.1 * np.sin(2 * angle)], axis=1)
    T = np.stack([np.eye(4)] * count)
    T[:, :3, 3] = xi
    T[:, :3, :3] = se3.exp(np.stack([0 * angle] * 5 + [0.5 * np.sin(angle)], axis=1))[:, :3, :3]
    truth = Spline(T, 0.0, dt)
    points = T.copy()
    for i in range(1, count):
        off = se3.exp(rng.normal(scale=np.repeat([1e-3, 4e-4], 3))) if i % EVERY == 0 else np.eye(4)
        points[i] = points[i - 1] @ se3.inverse(T[i - 1]) @ T[i] @ off
    spline = Spline(se3.orthonormalise(points), 0.0, dt)
    times = {k: (k + 1) * dt for k in range(0, count - 12, EVERY)}
    at = State(spline, {k: spline.pose(t) for k, t in times.items()})
    information = np.diag(np.repeat([1e-3, 4e-4], 3) ** -2.0)
    seen, ties = [], []
    for k in times:
        band = BandedHessian()
        for i in range(k, k + 9):
            local = np.tile(se3.adjoint(se3.inverse(spline.pose(times[k]))), (1, 4))
            J = np.zeros((24, 24))
            for n in range(4):
                J[6 * n : 6 * n + 6, 6 * n : 6 * n + 6] = local[:, :6]
            band.add(Quadratic(i, J.T @ np.kron(np.eye(4), information) @ J, np.zeros(24)))
        seen.append(KeyframeModel(k, band))
        ties.append(Sighting(k, times[k], np.eye(4), 100.0 * information))
    loops = []
    round_ = count // 3
    for k in list(times)[: len(times) * 2 // 3]:
        late = min(times, key=lambda other: abs(other - k - round_))
        if late <= k + 20:
            continue
        rel = se3.inverse(truth.pose(times[k])) @ truth.pose(times[late])
        noisy = [rel @ se3.exp(rng.normal(scale=np.repeat([2e-4, 1e-4], 3))) for _ in range(2)]
        tight = np.diag(np.repeat([3e-4, 1.4e-4], 3) ** -2.0)
        one = Sighting(k, times[late], noisy[0], tight)
        other = Sighting(late, times[k], se3.inverse(noisy[1]), tight)
        loops.append(Loop(k, late, (one, other), (0.0, 0.0)))
    return Graph(at, seen, ties), State(truth, {}), loops


def ate(found: Spline, truth: Spline) -> float:
    """RMS position error (m), both at the same place at the begin."""
    t = np.linspace(found.t_begin, found.t_end - 1e-9, 500)
    moved = truth.pose(0.0) @ se3.inverse(found.pose(0.0)) @ found.pose(t)
    return float(np.sqrt(np.mean(np.sum((moved - truth.pose(t))[:, :3, 3] ** 2, axis=1))))


def test_loops_take_the_drift_away_and_a_false_one_is_refused() -> None:
    graph, truth, loops = drifted_track(np.random.default_rng(5))
    before = ate(graph.at.spline, truth.spline)
    done = closed(graph, loops, 0.0)
    after = ate(done.state.spline, truth.spline)
    assert after < before / 3 and not any(done.refused)
    np.testing.assert_allclose(done.state.spline.pose(0.0), graph.at.spline.pose(0.0), atol=1e-9)
    # Half a metre and ten degrees wrong, and as sure of it as the others.
    one, other = loops[3].sightings
    wrong = se3.exp(np.array([0.5, 0.1, 0.0, 0.0, 0.0, 0.17]))
    false = Loop(
        loops[3].early, loops[-1].late,
        (Sighting(one.keyframe, loops[-1].sightings[0].t, wrong, one.information),
         Sighting(loops[-1].late, other.t, se3.inverse(wrong), other.information)),
        (0.0, 0.0),
    )  # fmt: skip
    fooled = closed(graph, [*loops, false], 0.0)
    assert fooled.refused == (*([False] * len(loops)), True)
    assert ate(fooled.state.spline, truth.spline) < 1.5 * after


def too_sure(graph: Graph, times: float) -> Graph:
    """Frames that think they know so many times better than they do."""
    seen = [
        KeyframeModel(each.keyframe, BandedHessian(each.band.first, each.band.blocks * times**2)) for each in graph.seen
    ]
    ties = [replace(each, information=each.information * times**2) for each in graph.sightings]
    return Graph(graph.at, seen, ties)


def test_loops_that_agree_are_believed_against_a_track_that_is_too_sure_of_itself() -> None:
    graph, truth, loops = drifted_track(np.random.default_rng(5))
    fair = ate(closed(graph, loops, 0.0).state.spline, truth.spline)
    found = closed(too_sure(graph, 30.0), loops, 0.0)
    assert found.spread > 1.0 and sum(found.refused) <= len(loops) / 4
    assert ate(found.state.spline, truth.spline) < min(2.0 * fair, ate(graph.at.spline, truth.spline) / 2)


def test_a_track_that_is_bent_in_one_place_is_mended_there() -> None:
    """As by one blurred stretch: loops across it are refused, those before and after are not, and they are the most."""
    graph, truth, loops = drifted_track(np.random.default_rng(5))
    at = 80
    bend = se3.exp(np.array([0.02, -0.02, 0.01, 0.01, 0.02, -0.02]))
    T = graph.at.spline.control_points
    points = np.concatenate([T[:at], T[at] @ bend @ se3.inverse(T[at]) @ T[at:]])
    spline = Spline(se3.orthonormalise(points), 0.0, graph.at.spline.dt)
    time = {tie.keyframe: tie.t for tie in graph.sightings}
    bent = replace(graph, at=State(spline, {k: spline.pose(t) for k, t in time.items()}))
    across = [loop for loop in loops if loop.early < at <= loop.late]
    beside = [loop for loop in loops if not loop.early < at <= loop.late]
    few = [*across[:5], *beside[:8]]
    assert len(across) >= 5 and len(beside) >= 8
    bent = too_sure(bent, 5.0)
    found = closed(bent, few, 0.0)
    assert found.spread > 1.0 and not any(found.refused)
    assert ate(found.state.spline, truth.spline) < ate(closed(bent, beside[:8], 0.0).state.spline, truth.spline) / 2


def test_false_loops_that_agree_with_nothing_stay_refused() -> None:
    """More than a quarter of all, so that the track is doubted: nothing comes of it."""
    graph, truth, loops = drifted_track(np.random.default_rng(5))
    true, fooled = loops[:7], []
    for n, loop in enumerate(loops[8:11]):
        wrong = se3.exp(np.array([0.3 - 0.2 * n, 0.1 * n, -0.2, 0.1 * n, 0.05, 0.17]))
        fooled.append(replace(loop, sightings=(
            replace(loop.sightings[0], T_ref_cam=loop.sightings[0].T_ref_cam @ wrong),
            replace(loop.sightings[1], T_ref_cam=se3.inverse(loop.sightings[0].T_ref_cam @ wrong)),
        )))  # fmt: skip
    found = closed(graph, [*true, *fooled], 0.0)
    assert found.refused == (False,) * 7 + (True,) * 3 and found.spread == 1.0
    assert ate(found.state.spline, truth.spline) < 1.01 * ate(closed(graph, true, 0.0).state.spline, truth.spline)


def test_where_all_loops_are_refused_nothing_moves() -> None:
    """Three loops are too few to blame the track."""
    graph, _, loops = drifted_track(np.random.default_rng(5))
    sure = too_sure(graph, 30.0)
    found = closed(sure, loops[:3], 0.0)
    assert found.refused == (True, True, True) and found.spread == 1.0 and found.closed == 0
    before = sure.at.spline.control_points
    np.testing.assert_allclose(found.state.spline.control_points, before, rtol=0, atol=1e-12)


def test_a_keyframe_goes_with_its_part_of_the_spline() -> None:
    graph, _, loops = drifted_track(np.random.default_rng(6))
    done = closed(graph, loops, 0.0)
    for tie in graph.sightings:
        between = se3.log(se3.inverse(done.state.keyframes[tie.keyframe]) @ done.state.spline.pose(tie.t))
        assert np.abs(between).max() < 2e-4
