"""Images that are off as a whole: how often by chance, how much less they count, and which of two it is."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import chi2

from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.tracking.judgement.calibration_errors import CalibrationErrors
from rstrack.tracking.judgement.innovation import (
    Prediction,
    by_images,
    contradicts,
    disagreement,
    learnt,
    mixture,
    weighed,
)
from rstrack.tracking.judgement.uncertainty import Systematic

HALF = 0.015
LIMIT = float(chi2.ppf(0.999, 12))


def spread(metres: float, radians: float, rng: np.random.Generator) -> np.ndarray:
    """A covariance (12, 12) of pose and change over half a readout, with correlations."""
    size = np.tile([metres] * 3 + [radians] * 3, 2)
    A = np.eye(12) + 0.3 * rng.normal(size=(12, 12))
    return np.asarray(A @ A.T * np.outer(size, size))


def image(is_depth: bool, R: np.ndarray, off: np.ndarray) -> Any:
    """An image that has its own minimum at `off` (12,), with covariance R, in `Observation.steady`'s unknowns."""
    H = np.linalg.inv(R)
    exposure = SimpleNamespace(mid_time=0.1, first_time=0.1 - HALF, last_time=0.1 + HALF)
    o = SimpleNamespace(
        is_depth=is_depth, is_linearised=True, independent=0.5, image=SimpleNamespace(exposure=exposure),
        H=H, g=-H @ off, ref=SimpleNamespace(median_depth=0.0, lens=SimpleNamespace(camera=SimpleNamespace(fx=1e9))),
    )  # fmt: skip

    def count_as(independent: float) -> None:
        o.H, o.g, o.independent = (part * independent / o.independent for part in (o.H, o.g, o.independent))

    o.count_as, o.steady = count_as, lambda _: (o.H, o.g)
    return o


def at_rest() -> tuple[Any, Spline]:
    spline = Spline(np.repeat(np.eye(4)[None], 12, axis=0), 0.0, 0.025)
    return SimpleNamespace(spline=spline), spline


# The state has the velocity where `Observation.steady` has what it changes over half a readout.
BY = np.concatenate([np.ones(6), np.full(6, HALF)])


def predicted(P: np.ndarray) -> Prediction:
    return Prediction.of(at_rest()[1], 0.1, P / np.outer(BY, BY))


def test_chance_alone_is_called_odd_as_seldom_as_the_level_says() -> None:
    """Against draws: at 1 in 1,000 for one image, whatever its covariance and the prediction's."""
    rng, odd, trials = np.random.default_rng(3), 0, 1000
    P, R = spread(4e-3, 5e-3, rng), spread(3e-4, 4e-4, rng)
    draw_P, draw_R = np.linalg.cholesky(P), np.linalg.cholesky(R)
    for _ in range(trials):
        off = draw_P @ rng.normal(size=12) + draw_R @ rng.normal(size=12)
        odd += weighed([image(True, R, off)], at_rest()[0], predicted(P)).inflation > 1.0
    assert odd <= chi2.ppf(0.999, 2 * (1 + 1)) / 2, "one is expected"


@pytest.mark.parametrize("times", [3.0, 30.0])
def test_what_is_off_counts_so_little_that_its_innovation_is_just_what_may_be(times: float) -> None:
    rng = np.random.default_rng(7)
    P, R = spread(4e-3, 5e-3, rng), spread(1e-3, 1e-3, rng)
    off = times * np.linalg.cholesky(P) @ rng.normal(size=12)
    one = image(True, R, off)
    assert off @ np.linalg.solve(P + R, off) > LIMIT
    assert weighed([one], at_rest()[0], predicted(P)).inflation > 1.0
    factor = 0.5 / one.independent
    assert factor > 1.0
    # What an image leaves open is bounded, which matters where it counts for nothing.
    assert off @ np.linalg.solve(P + factor * R, off) == pytest.approx(LIMIT, rel=0.02)


@pytest.mark.parametrize("is_depth_off", [True, False])
def test_of_two_that_disagree_it_is_the_one_that_is_further_from_the_prediction(is_depth_off: bool) -> None:
    rng = np.random.default_rng(11)
    P, R = spread(4e-3, 5e-3, rng), spread(3e-4, 4e-4, rng)
    true = 0.5 * np.linalg.cholesky(P) @ rng.normal(size=12)
    wrong = true + 0.03 * np.eye(12)[0]
    depth = image(True, R, wrong if is_depth_off else true)
    color = image(False, R, true if is_depth_off else wrong)
    assert weighed([depth, color], at_rest()[0], predicted(P)).inflation > 1.0
    off, good = (depth, color) if is_depth_off else (color, depth)
    assert off.independent < 0.01 and good.independent == 0.5


def test_two_that_agree_are_followed_where_the_prediction_allows_it_and_none_says_nothing() -> None:
    rng = np.random.default_rng(13)
    P, R = spread(4e-3, 5e-3, rng), spread(3e-4, 4e-4, rng)
    true = np.linalg.cholesky(P) @ rng.normal(size=12)
    both = [image(True, R, true), image(False, R, true)]
    assert weighed(both, at_rest()[0], predicted(P)).inflation == 1.0 and [o.independent for o in both] == [0.5, 0.5]
    unseen: Any = SimpleNamespace(is_linearised=False)
    assert weighed([unseen], at_rest()[0], predicted(P)).inflation == 1.0


def test_of_images_exposed_at_once_the_last_two_poses_say_where_the_next_one_is() -> None:
    twist = np.array([0.4, -0.2, 0.3, 0.5, 0.1, -0.6])
    points = se3.exp(0.025 * np.arange(12)[:, None] * twist)
    spline = Spline(points, 0.0, 0.025)
    for earlier in (None, (0.05, 0.08)):
        predicted = Prediction.of(spline, 0.1, np.eye(12), earlier)
        np.testing.assert_allclose(predicted.velocity, twist, atol=1e-9)
        for t in (0.1, 0.12):
            np.testing.assert_allclose(predicted.pose(t), spline.pose(t), atol=1e-9)
    # A last control point that alternates leads the spline astray, not the two poses before it.
    points[-1] = points[-1] @ se3.exp(np.array([0.1, 0, 0, 0, 0, 0]))
    astray, t = Spline(points, 0.0, 0.025), 0.22
    assert np.linalg.norm((Prediction.of(astray, t, np.eye(12)).pose(t) - spline.pose(t))[:3, 3]) > 1e-3
    told = Prediction.of(astray, t, np.eye(12), (0.1, 0.13)).pose(t)
    np.testing.assert_allclose(told, spline.pose(t), atol=1e-9)


@pytest.mark.parametrize("what", ["image", "keyframe", "prediction", "lag"])
def test_what_a_wrong_calibration_explains_is_not_odd(what: str) -> None:
    """An image that is off along what one parameter does, by one σ of it, wherever it does that; or by a keyframe's
    older clock."""
    rng = np.random.default_rng(5)
    P, R = spread(1e-4, 1e-4, rng), spread(1e-4, 1e-4, rng)
    by = np.zeros((12, 1))
    by[:6, 0] = 1e-2 * rng.normal(size=6)

    def odd(given: Any) -> bool:
        return weighed([image(True, R, -by[:, 0])], at_rest()[0], predicted(P), given).inflation > 1.0

    considered = SimpleNamespace(
        moved=lambda *_: by * (what == "image"), of_keyframe=lambda *_: by[:6] * (what == "keyframe"),
        predicted=lambda *_: by * (what == "prediction"), lag=lambda *_: -by[:, 0] * (what == "lag"),
    )  # fmt: skip
    assert odd(None) and not odd(considered)


def test_what_all_images_and_the_prediction_have_in_common_explains_nothing() -> None:
    rng = np.random.default_rng(5)
    P, R = spread(1e-4, 1e-4, rng), spread(1e-4, 1e-4, rng)
    by = np.zeros((12, 1))
    by[:6, 0] = 1e-2 * rng.normal(size=6)
    considered: Any = SimpleNamespace(
        moved=lambda *_: by, of_keyframe=lambda *_: 0.0 * by[:6], predicted=lambda *_: by, lag=lambda *_: np.zeros(12)
    )  # fmt: skip
    assert weighed([image(True, R, -by[:, 0])], at_rest()[0], predicted(P), considered).inflation > 1.0


def sigmas(images: list[Any], P: np.ndarray) -> np.ndarray:
    """σ (12,) of `mixture` where the camera was found as predicted; in `Observation.steady`'s unknowns."""
    state, prediction = at_rest()[0], predicted(P)
    return np.asarray(np.sqrt(np.diag(mixture(weighed(images, state, prediction), images, state, prediction))) * BY)


def test_images_that_agree_far_from_the_prediction_leave_open_which_is_wrong() -> None:
    """The camera may have been moved while nothing was seen: a jump of 0.2 m that all images show is no outlier."""
    rng = np.random.default_rng(17)
    P, R = spread(3e-3, 3e-3, rng), spread(3e-4, 4e-4, rng)
    jump = 0.2 * np.eye(12)[0]
    for images in ([image(True, R, jump)], [image(True, R, jump), image(False, R, jump)]):
        assert sigmas(images, P)[0] == pytest.approx(0.2, rel=0.05)


def test_of_images_that_disagree_the_prediction_says_which_is_wrong() -> None:
    rng = np.random.default_rng(17)
    P, R = spread(3e-3, 3e-3, rng), spread(3e-4, 4e-4, rng)
    images = [image(True, R, 0.2 * np.eye(12)[0]), image(False, R, np.zeros(12))]
    assert sigmas(images, P)[0] < 0.01


def test_a_state_that_is_not_the_filters_mean_is_off_by_as_much() -> None:
    """Where the spline cannot follow, the camera is not found where its images and the prediction have it."""
    rng = np.random.default_rng(19)
    P, R, off = spread(5e-2, 5e-2, rng), spread(3e-4, 4e-4, rng), 0.03 * np.eye(12)[1]
    both = [image(True, R, off), image(False, R, off)]
    assert weighed(both, at_rest()[0], predicted(P)).inflation == 1.0
    np.testing.assert_allclose(sigmas(both, P)[1], P @ np.linalg.solve(P + R / 2, off) @ np.eye(12)[1], rtol=1e-3)


def test_of_images_that_nothing_predicts_either_may_be_right_where_they_disagree() -> None:
    """Each counts as if it were, and no more than what is beyond chance."""
    R, state = np.diag(np.full(12, 1e-8)), at_rest()[0]
    off = 0.02 * np.eye(12)[1]
    apart = disagreement([image(True, R, off), image(False, R, -off)], state)
    np.testing.assert_allclose(apart[:3, :3], 2.0 * np.outer(off, off)[:3, :3], rtol=0.01, atol=1e-9)
    unseen: Any = SimpleNamespace(is_linearised=False)
    assert not disagreement([unseen], state).any() and not disagreement([], state).any()
    agree = 1e-4 * np.eye(12)[1]
    assert np.abs(disagreement([image(True, R, agree), image(False, R, -agree)], state)).max() < 1e-9


@pytest.mark.parametrize("kinds", [[True], [False], [True, False]])
def test_where_all_of_a_frame_s_images_pull_it_away_it_may_be_there(kinds: list[bool]) -> None:
    """Before a wall depth alone slides: what the spline has is not what the image says."""
    R, off = np.diag(np.full(12, 1e-8)), 0.3 * np.eye(12)[0]
    apart = disagreement([image(is_depth, R, off) for is_depth in kinds], at_rest()[0])
    np.testing.assert_allclose(apart[:3, :3], np.outer(off, off)[:3, :3], rtol=0.02, atol=1e-6)


def test_what_a_wrong_calibration_explains_divides_no_images() -> None:
    R, by = np.diag(np.full(12, 1e-8)), np.zeros((12, 1))
    by[1] = 0.02
    off = 0.02 * np.eye(12)[1]
    images = [image(True, R, off), image(False, R, -off)]
    sides: Any = SimpleNamespace(
        moved=lambda o, _: by if o.is_depth else -by, of_keyframe=lambda *_: np.zeros((6, 1)),
        predicted=lambda *_: np.zeros((12, 1)), lag=lambda *_: np.zeros(12),
    )  # fmt: skip
    assert np.abs(disagreement(images, at_rest()[0], sides)[:3, :3]).max() < 0.1 * 0.02**2


def test_images_that_disagree_as_they_always_do_say_nothing_of_this_frame() -> None:
    """With a wrong camera file depth and colour are apart in all frames, and lost ones are found all the same."""
    R, off = np.diag(np.full(12, 1e-8)), 0.02 * np.eye(12)[1]
    images, state = [image(True, R, off), image(False, R, -off)], at_rest()[0]
    alone = disagreement(images, state)
    twice = disagreement([image(True, R, 2.0 * off), image(False, R, -2.0 * off)], state)
    # The inflation that these need is some (2 off)² over their covariances, and is the median.
    inflation = brentq(lambda s: disagreement(images, state, None, s)[1, 1] - 0.5 * alone[1, 1], 1.0, 1e9)
    assert not disagreement(images, state, None, 2.1 * inflation).any()
    assert disagreement(images, state, None, 0.2 * inflation)[1, 1] == pytest.approx(0.9 * alone[1, 1], rel=0.02)
    assert twice[1, 1] == pytest.approx(4.0 * alone[1, 1], rel=0.01)


def test_inflations_of_predicted_frames_are_learnt() -> None:
    R, P = np.diag(np.full(12, 1e-8)), np.diag(np.full(12, 1e-2))
    off, known = 0.02 * np.eye(12)[1], Systematic()
    assert known.median_inflation == 1.0
    medians = []
    for apart in (0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0):
        images = [image(True, R, apart * off), image(False, R, -apart * off)]
        for o in images:
            o.ref.median_depth, o.ref.lens.camera.fx = 2.0, 500.0
        found = weighed(images, at_rest()[0], predicted(P))
        known, errors = learnt(found, known, CalibrationErrors(), 1.0)
        assert not errors.mean.any(), "of an exact calibration"
        medians.append(known.median_inflation)
    assert medians[:5] == [1.0] * 5 and medians[6] == found.own > 1e3  # a median: two of five frames do not move it


def test_what_images_say_by_themselves() -> None:
    rng = np.random.default_rng(8)
    R, off = spread(1e-3, 1e-3, rng), 1e-3 * rng.normal(size=12)
    said = by_images([image(True, R, off)], at_rest()[0], median=4.0)
    assert said is not None and by_images([], at_rest()[0]) is None and said.t == 0.1
    np.testing.assert_allclose(se3.log(said.T_world_depth), off[:6], rtol=3e-3, atol=2e-6)
    np.testing.assert_allclose(said.velocity, off[6:] / HALF, rtol=3e-3, atol=2e-4)
    np.testing.assert_allclose(said.covariance * np.outer(BY, BY) / R, 4.0, rtol=5e-2)


def test_two_states_contradict_each_other_as_seldom_as_the_level_says() -> None:
    """Against draws of a motion whose acceleration is random, one in 1,000."""
    rng, dt, trials = np.random.default_rng(4), 0.05, 1000
    P, R, drift = (spread(4e-3, 5e-3, rng) / np.outer(BY, BY) for _ in range(3))
    sigma = np.array([5.0, 5.0, 5.0, 10.0, 10.0, 10.0])
    draw = [np.linalg.cholesky(C) for C in (P, R, drift[:6, :6])]
    odd = 0
    for _ in range(trials):
        a, off = sigma * rng.normal(size=6), draw[0] @ rng.normal(size=12)
        pose = off[:6] + dt * off[6:] + 0.5 * dt**2 * a + draw[2] @ rng.normal(size=6)
        seen = np.concatenate([pose, off[6:] + dt * a]) + draw[1] @ rng.normal(size=12)
        now = Prediction(0.1 + dt, se3.exp(seen[:6]), seen[6:], R)
        odd += contradicts(Prediction(0.1, np.eye(4), np.zeros(6), P), now, sigma, drift[:6, :6])
    assert odd <= chi2.ppf(0.999, 2 * (1 + 1)) / 2, "one is expected"
    assert contradicts(Prediction(0.1, np.eye(4), np.zeros(6), P), replace_velocity(now), sigma, drift[:6, :6])


def replace_velocity(state: Prediction) -> Prediction:
    return Prediction(state.t, state.T_world_depth, state.velocity + 50.0, state.covariance)


def test_an_innovation_of_a_start_that_diverged_is_a_number() -> None:
    """Regression: before a bare wall one of 10⁹ σ ended the run with SciPy's error, since rounding hid the limit."""
    rng, R = np.random.default_rng(5), 1e-6 * np.eye(12)
    for size in np.repeat(10.0 ** np.arange(2, 14), 20):
        off = 1e-3 * size * rng.normal(size=12)
        found = weighed([image(True, R, off)], at_rest()[0], predicted(R))
        assert found.inflation == pytest.approx(off @ off / 1e-6 / LIMIT, rel=2e-2)
