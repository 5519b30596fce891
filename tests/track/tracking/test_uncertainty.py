"""Covariances of poses: the filter against least squares over the whole motion, drift and errors by simulation."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.stats

from rsgen.errors import UserError
from rsgen.geometry import se3
from rstrack.data.estimate import Estimate
from rstrack.metrics.consistency import Covariances, covariances, motion_covariance, motion_errors, step_nees
from rstrack.tracking.judgement import uncertainty as module
from rstrack.tracking.judgement.uncertainty import SYSTEMATIC_PX, Systematic, Uncertainty, of_pixels

DT = 1.0 / 30.0


def seen(rng: np.random.Generator, sigma: float = 1e-3) -> np.ndarray:
    A = rng.normal(size=(6, 6)) + 3.0 * np.eye(6)
    return A @ A.T / (9.0 * sigma**2)


def test_the_filter_is_least_squares_over_the_whole_motion() -> None:
    rng = np.random.default_rng(2)
    images = [seen(rng) for _ in range(5)]
    uncertainty = Uncertainty()
    start = uncertainty.state.copy()
    for H in images:
        uncertainty = uncertainty.after(DT, H)
    # Unknowns: pose and velocity at the start, and the acceleration of each interval.
    n = 12 + 6 * len(images)
    A = np.zeros((n, n))
    A[:12, :12] = np.linalg.inv(start)
    for k in range(len(images)):
        at = slice(12 + 6 * k, 18 + 6 * k)
        A[at, at] = np.diag(1.0 / np.array([5.0, 5.0, 5.0, 10.0, 10.0, 10.0]) ** 2)
    rows = np.zeros((6, n))
    rows[:, :6] = np.eye(6)
    speed = np.zeros((6, n))
    speed[:, 6:12] = np.eye(6)
    for k, H in enumerate(images):
        at = slice(12 + 6 * k, 18 + 6 * k)
        rows = rows + DT * speed
        rows[:, at] += 0.5 * DT**2 * np.eye(6)
        speed[:, at] += DT * np.eye(6)
        A += rows.T @ H @ rows
    np.testing.assert_allclose(uncertainty.pose, rows @ np.linalg.solve(A, rows.T), rtol=1e-6, atol=1e-15)


def test_a_motion_that_no_image_shows_is_known_ever_less_until_it_is_unknown() -> None:
    H = seen(np.random.default_rng(3), 1e-4)
    uncertainty = Uncertainty().found_anew(H)
    for _ in range(5):
        uncertainty = uncertainty.after(DT, H)
    assert uncertainty.is_known and uncertainty.held_by_motion < 0.05
    wall = np.diag([0.0, 1e8, 1e8, 1e8, 1e8, 1e8])  # nothing states how it moves along x
    sigmas = []
    while uncertainty.is_known:
        uncertainty = uncertainty.after(DT, wall)
        sigmas.append(np.sqrt(uncertainty.pose[0, 0]))
        assert uncertainty.held_by_motion == pytest.approx(1.0, abs=1e-6)
        assert len(sigmas) < 60
    assert len(sigmas) > 3 and (np.diff(sigmas) > 0).all() and np.sqrt(uncertainty.pose[1, 1]) < 2e-4


def test_a_gyroscope_knows_turns_as_its_noise_adds_up_and_nothing_of_places() -> None:
    """On imu_walls turns about the wall's normal were held to be unknown by degrees, and gravity's direction too."""
    rate, told, steps = 4e-4, np.repeat([0.1, 2 * 4e-4 / DT], 3), 180
    seen = np.diag([1e8, 1e8, 1e8, 1e10, 1e10, 1e10])
    start = Uncertainty().of_first().after(DT, seen).after(DT, seen)
    known = wandering = start
    for _ in range(steps):
        known = known.after(DT, np.zeros((6, 6)), told, rate)
        wandering = wandering.after(DT, np.zeros((6, 6)), told)
    turn, lost = (np.sqrt(u.pose[3, 3]) for u in (known, wandering))
    assert turn == pytest.approx(rate * DT * steps**0.5, rel=0.4) and lost > 30.0 * turn
    np.testing.assert_allclose(known.pose[:3, :3], wandering.pose[:3, :3], rtol=1e-9)


def test_what_is_systematic_is_a_part_of_a_pixel() -> None:
    H = 1e20 * np.eye(6)
    sigma = np.sqrt(np.diag(Uncertainty().found_anew(H).covariance(500.0, 2.0)))
    np.testing.assert_allclose(sigma, [4e-5] * 3 + [2e-5] * 3, rtol=1e-3)


def test_errors_of_a_chain_of_keyframes_are_as_large_as_their_covariances() -> None:
    """Poses found at keyframes that were found at others: NEES/6 of the motion between them is 1 in the mean."""
    rng = np.random.default_rng(5)
    true = se3.exp(np.cumsum(rng.normal(size=(9, 6)) * 0.3, axis=0))
    noise = [np.linalg.inv(seen(rng, 2e-4)) for _ in range(9)]
    uncertainty, pose, drift = Uncertainty(), np.zeros((9, 6, 6)), np.zeros((9, 6, 6))
    keyframe = [0, 0, 0, 2, 2, 2, 5, 5, 5]
    for k in range(9):
        pose[k] = noise[k] if k else 0.0
        drift[k] = uncertainty.drift_of(keyframe[k])
        if k in (2, 5):
            uncertainty = uncertainty.with_keyframe(k, keyframe[k], true[k], pose[k])
    i, j = np.array([1, 1, 4, 7]), np.array([4, 7, 8, 3])
    known = Covariances(pose, drift, np.zeros((9, 6, 0)))
    found = []
    for _ in range(1500):
        off = [rng.multivariate_normal(np.zeros(6), C) for C in pose]
        # A keyframe's own error moves all that was found at it.
        world = {0: np.eye(4)}
        est = np.empty_like(true)
        for k in range(9):
            est[k] = world[keyframe[k]] @ true[k] @ se3.exp(off[k])
            if k in (2, 5):
                world[k] = est[k] @ se3.inverse(true[k])
        found.append(step_nees(motion_errors(true, est, i, j), motion_covariance(est, known, i, j)))
    # Of 6 degrees of freedom: σ of the mean over 1500 is 0.015.
    np.testing.assert_allclose(np.mean(found, axis=0), 1.0, atol=0.06)


def test_motions_between_keyframes_neither_of_which_hangs_on_the_other_are_left_out() -> None:
    T, one, two = np.tile(np.eye(4), (2, 1, 1)), np.array([0]), np.array([1])
    pose, drift = np.tile(1e-4 * np.eye(6), (2, 1, 1)), np.tile(1e-2 * np.eye(6), (2, 1, 1))
    drift[1] = np.diag([3e-2, 3e-2, 1e-3, 3e-2, 3e-2, 3e-2])
    known = Covariances(pose, drift, np.zeros((2, 6, 0)))
    assert np.isnan(motion_covariance(T, known, one, two)).all()
    drift[1] = 3e-2 * np.eye(6)
    np.testing.assert_allclose(motion_covariance(T, known, one, two), [2.02e-2 * np.eye(6)], rtol=1e-12)


def test_covariances_are_read_from_a_runs_frames() -> None:
    C = np.arange(36.0).reshape(6, 6)
    C = C + C.T
    upper = C[np.triu_indices(6)].tolist()
    frames: list[dict[str, Any]] = [
        {"stamp": 1.0, "covariance": upper, "drift_world": upper},
        {"stamp": 2.0, "covariance": None, "drift_world": None},
    ]
    estimate = Estimate(np.array([1.0, 2.0, 3.0]), np.tile(np.eye(4), (3, 1, 1)), None, {"frames": frames})
    known = covariances(estimate)
    np.testing.assert_array_equal(known.pose[0], C)
    np.testing.assert_array_equal(known.drift_world[0], C)
    assert np.isnan(known.pose[1:]).all() and known.common.shape == (3, 6, 0)
    assert np.isnan(covariances(replace(estimate, info={})).pose).all()

    common = np.arange(12.0).reshape(6, 2)
    frames[0]["common"] = common.tolist()
    frames.append({"stamp": 3.0, "covariance": upper, "drift_world": upper})
    known = covariances(estimate)
    np.testing.assert_array_equal(known.common, [common, 0.0 * common, 0.0 * common])
    for wrong in (
        {"covariance": upper[:20]},
        {"drift_world": "much"},
        {"common": [[1.0] * 3] * 6},
        {"common": [1.0] * 7},
    ):
        with pytest.raises(
            UserError, match=r"^estimate: covariance and drift_world of the frames in run\.json [^\n]*$"
        ):
            covariances(replace(estimate, info={"frames": [frames[0], frames[2] | wrong]}))


# -- what all pixels of an image have in common -----------------------------------------------------------------------

FOCAL, DEPTH = 500.0, 2.0


def learnt_px(sigma_px: float, noise_px: float, frames: int, seed: int = 3, assumed: float = 1.0) -> float:
    """From frames whose two images both have errors of sigma_px, and noise, assumed to be so many times larger."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(6, 6)) + 3.0 * np.eye(6)
    size = np.sqrt(of_pixels(1.0, FOCAL, DEPTH))
    noise = size @ A @ A.T @ size * noise_px**2 / 9.0
    known = Systematic()
    for _ in range(frames):
        apart = rng.multivariate_normal(np.zeros(6), noise + 2.0 * of_pixels(sigma_px, FOCAL, DEPTH))
        known = known.with_frame(apart, assumed**2 * noise, FOCAL, DEPTH)
    return known.px


@pytest.mark.parametrize("sigma", [0.002, 0.004, 0.008])
def test_errors_that_images_do_not_share_are_found(sigma: float) -> None:
    # The first value counts as one frame beside some thirty.
    expected = np.sqrt((SYSTEMATIC_PX**2 + 30 * sigma**2) / 31)
    found = np.median([learnt_px(sigma, 0.5 * sigma, 90, seed) for seed in range(9)])
    assert found == pytest.approx(expected, rel=0.2)


def test_nothing_is_learnt_from_noise() -> None:
    assert Systematic().px == SYSTEMATIC_PX
    assert learnt_px(0.002, 1.0, 60) == SYSTEMATIC_PX
    # Nor where there is less noise than was assumed, as with a camera that is better than its file says.
    assert learnt_px(0.002, 1.0, 60, assumed=4.0) == SYSTEMATIC_PX


def test_it_is_never_more_than_where_nothing_is_known() -> None:
    assert learnt_px(1.0, 0.002, 60) == SYSTEMATIC_PX


def test_likelihoods_are_those_of_normal_distances() -> None:
    rng = np.random.default_rng(4)
    spread, off = rng.uniform(1e-6, 1e-4, 6), rng.normal(size=6) * 1e-2
    found = module._likelihoods(off**2, spread)
    true = [scipy.stats.norm.logpdf(off, scale=np.sqrt(spread + 2.0 * sigma**2)).sum() for sigma in module._GRID]
    np.testing.assert_allclose(np.diff(found), np.diff(true), rtol=1e-9)
