"""Covariances of motions against errors drawn from their model, and what `rstrack evaluate` says of them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from estimates import truth, walk
from scipy.stats import norm

from rsgen.geometry import se3
from rsgen.sequence.trajectory import Trajectory
from rstrack.cli.main import main
from rstrack.data.estimate import Estimate, write_estimate
from rstrack.metrics.association import Truth
from rstrack.metrics.consistency import Covariances, TruthNoise, motion_covariance, motion_errors
from rstrack.metrics.evaluate import Metrics, evaluate

SIGMAS = np.array([1e-3, 2e-3, 3e-3, 1e-3, 5e-4, 2e-3])


def spread(rng: np.random.Generator, sigma: float = 1e-3) -> np.ndarray:
    A = rng.normal(size=(6, 6))
    return sigma**2 * (A @ A.T / 6.0 + 0.2 * np.eye(6))


def whitened(found: np.ndarray, claimed: np.ndarray) -> np.ndarray:
    """A sample's covariance in units of the claimed one: the identity if that is right."""
    half = np.linalg.inv(np.linalg.cholesky(claimed))
    return half @ found @ half.T


def test_covariances_of_motions_are_those_of_errors_drawn_from_the_model() -> None:
    """Every pose errs by itself, from the second keyframe on with that keyframe, and all with the calibration."""
    rng, count = np.random.default_rng(1), 40_000
    true = walk(3, 5, step=0.4)
    pose, worlds = np.stack([spread(rng) for _ in true]), [spread(rng), spread(rng)]
    common = 2e-3 * rng.normal(size=(5, 6, 3))
    keyframe = np.array([0, 0, 1, 1, 1])
    drift = np.stack([np.sum(worlds[: k + 1], axis=0) for k in keyframe])

    world = np.cumsum([rng.multivariate_normal(np.zeros(6), C, count) for C in worlds], axis=0)
    own = np.stack([rng.multivariate_normal(np.zeros(6), C, count) for C in pose])
    calibration = np.einsum("nam,cm->nca", common, rng.normal(size=(count, 3)))
    est = se3.exp(world[keyframe]) @ true[:, None] @ se3.exp(own + calibration)

    i, j = np.array([0, 0, 1, 2, 4]), np.array([1, 3, 4, 4, 1])
    claimed = motion_covariance(true, Covariances(pose, drift, common), i, j)
    alone = motion_covariance(true, Covariances(pose, drift, np.zeros((5, 6, 0))), i, j)
    trues = np.repeat(true[:, None], count, axis=1)
    for n in range(len(i)):
        found = np.cov(motion_errors(trues, est, i[n], j[n]).T)
        np.testing.assert_allclose(whitened(found, claimed[n]), np.eye(6), atol=0.04)
        assert np.abs(whitened(found, alone[n]) - np.eye(6)).max() > 0.5


def test_what_the_calibration_does_to_all_poses_alike_does_nothing_to_motions() -> None:
    """A camera that is taken to be elsewhere: T exp(d) everywhere, whose motions still differ where it turns."""
    T = np.stack([np.eye(4), se3.exp([0.3, 0.1, 0.0, 0.0, 0.0, 0.0]), se3.exp([0.3, 0.1, 0.0, 0.0, 0.0, 1.0])])
    zeros, common = np.tile(1e-12 * np.eye(6), (3, 1, 1)), np.zeros((3, 6, 1))
    common[:, 0] = 0.01
    slide, turn = motion_covariance(T, Covariances(zeros, 0.0 * zeros, common), np.array([0, 1]), np.array([1, 2]))
    np.testing.assert_allclose(slide, 2e-12 * np.eye(6), atol=1e-12)
    shift = 0.01 * np.array([1.0 - np.cos(1.0), np.sin(1.0), 0.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(turn, np.outer(shift, shift), atol=1e-11)


# ---------------------------------------------------------------------------------------------------------------------


def frames_of(stamps: np.ndarray, sigmas: np.ndarray = SIGMAS) -> list[dict[str, Any]]:
    """run.json's frames: every pose errs by itself."""
    upper, nothing = np.diag(sigmas**2)[np.triu_indices(6)].tolist(), [0.0] * 21
    return [{"stamp": float(t), "covariance": upper, "drift_world": nothing} for t in stamps]


def erring(seconds: float, claimed: np.ndarray = SIGMAS) -> tuple[Truth, Estimate]:
    """A truth at 30 Hz, and an estimate whose poses err by SIGMAS and claim to do so by `claimed`."""
    stamps = np.arange(round(30 * seconds)) / 30.0
    true = walk(5, len(stamps))
    off = SIGMAS * np.random.default_rng(6).normal(size=(len(stamps), 6))
    info = {"frames": frames_of(stamps, claimed)}
    return truth(Trajectory(stamps, true), stamps), Estimate(
        stamps, se3.orthonormalise(true @ se3.exp(off)), None, info
    )


def within(metrics: Metrics) -> list[list[float]]:
    return [list(horizon.within.values()) for horizon in metrics.consistency]


def test_where_errors_are_as_large_as_they_are_told_to_be_every_horizon_says_so() -> None:
    found = evaluate(*erring(60.0))
    assert [(h.seconds, h.pairs) for h in found.consistency] == [(0.1, 1797), (1.0, 1770), (5.0, 1650)]
    np.testing.assert_allclose([h.nees for h in found.consistency], 1.0, atol=0.05)
    np.testing.assert_allclose(within(found), [[0.5, 0.9, 0.99]] * 3, atol=0.04)
    axes = [list(axis.values()) for h in found.consistency for axis in h.axes.values()]
    np.testing.assert_allclose(axes, [[0.5, 0.9, 0.99]] * 18, atol=0.05)
    one = found.over(1.0)
    assert one is not None and (found.nees, found.coverage_90) == (one.nees, one.within[90])


def test_an_axis_along_which_errors_are_larger_than_told_is_named() -> None:
    """Two of six: σ is told to be half of what it is, so that 50 % are what lies within 0.34 σ."""
    told = SIGMAS * [1.0, 1.0, 0.5, 1.0, 0.5, 1.0]
    found = evaluate(*erring(60.0, told))
    one = found.over(1.0)
    assert one is not None and one.nees == pytest.approx((4.0 + 2.0 * 4.0) / 6.0, rel=0.1)
    for name, axis in one.axes.items():
        at = norm.ppf([0.75, 0.95, 0.995]) * (0.5 if name in ("z", "ry") else 1.0)
        # Motions of a second turn by some degrees, and so mix their axes a little.
        np.testing.assert_allclose(list(axis.values()), norm.cdf(at) - norm.cdf(-at), atol=0.09)


def test_horizons_without_pairs_are_left_out_and_so_is_all_of_it_without_covariances() -> None:
    short = evaluate(*erring(3.0))
    assert [h.seconds for h in short.consistency] == [0.1, 1.0]
    told = json.loads(json.dumps(short.as_dict(), allow_nan=False))
    assert told["consistency"][1]["within"]["90"] == told["coverage_90"] and told["nees"] == short.nees
    assert list(told["consistency"][0]["axes"]) == ["x", "y", "z", "rx", "ry", "rz"] and told["truth_noise"] is None
    lines = short.text().splitlines()
    head = next(n for n, line in enumerate(lines) if line.startswith("motions over"))
    assert lines[head - 1] == "errors beside their covariances (NEES/6: 1 if as large):"
    first = lines[head + 1].split()
    one = short.consistency[0]
    assert first == ["0.1", "s", "87", f"{one.nees:.2f}", *(f"{100 * part:.1f}" for part in one.within.values())]
    assert [line.split()[2] for line in lines[head + 3 : head + 9]] == ["x", "y", "z", "rx", "ry", "rz"]

    true, est = erring(3.0)
    without = evaluate(true, Estimate(est.stamps, est.T_world_depth))
    assert without.consistency == () and without.nees is None and "NEES" not in without.text()
    noise = Truth(true.motion, true.frame_stamps, noise=TruthNoise(2.0, 0.25))
    notes = evaluate(noise, Estimate(est.stamps, est.T_world_depth)).notes
    assert any("there are no covariances" in note for note in notes)


def test_errors_of_the_truth_itself_are_counted_where_they_are_told() -> None:
    """A truth that strays at random, by 2 mm and 0.25 degrees a second, of an estimate that is exact."""
    stamps = np.arange(3000) / 10.0
    sigmas = np.repeat([2e-3, np.radians(0.25)], 3) * np.sqrt(0.1)
    est, strays = walk(8, len(stamps)), np.random.default_rng(9).normal(size=(len(stamps), 6)) * sigmas
    true = [est[0]]
    for step, stray in zip(se3.inverse(est[:-1]) @ est[1:], strays[1:], strict=True):
        true.append(true[-1] @ step @ se3.exp(stray))
    motion = Trajectory(stamps, se3.orthonormalise(np.stack(true)))
    estimate = Estimate(stamps, est, None, {"frames": frames_of(stamps, np.full(6, 1e-5))})
    exact, counted = (evaluate(Truth(motion, stamps, noise=noise), estimate) for noise in (None, TruthNoise(2.0, 0.25)))
    assert exact.nees is not None and exact.nees > 1e3
    np.testing.assert_allclose([h.nees for h in counted.consistency], 1.0, atol=0.15)
    np.testing.assert_allclose(within(counted), [[0.5, 0.9, 0.99]] * 3, atol=0.08)
    assert ", the truth's own errors of 2 mm and 0.25 deg in 1 s counted (" in counted.text()
    assert counted.ate_rmse_m == exact.ate_rmse_m


def write_files(folder: Path, seconds: float = 3.0) -> Sequence[str]:
    true, est = erring(seconds)
    for name, T in (("truth", true.motion.T_world_cam), ("run", est.T_world_depth)):  # type: ignore[union-attr]
        write_estimate(folder / name, est.stamps, T, None, est.info)
    return "evaluate", str(folder / "truth/trajectory.txt"), str(folder / "run")


def test_the_command_takes_the_truths_noise(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    words = write_files(tmp_path)
    assert main([*words, "--json"]) == 0
    exact = json.loads(capfd.readouterr().out)
    assert main([*words, "--truth-noise", "2,0.25", "--truth-offset", "0", "--json"]) == 0
    counted = json.loads(capfd.readouterr().out)
    assert counted["truth_noise"] == {"translation_mm": 2.0, "rotation_deg": 0.25}
    for metrics in (counted, counted["truth_offset"]["metrics"]):
        assert 0.2 * exact["nees"] < metrics["nees"] < 0.9 * exact["nees"] and metrics["truth_noise"] is not None


@pytest.mark.parametrize("text", ["2", "2,", "two,0.25", "-2,0.25", "2,nan", "2,0.25,1", "inf,1"])
def test_a_noise_that_is_none_is_refused_in_one_line(
    text: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main([*write_files(tmp_path), "--truth-noise", text]) == 2
    error = capfd.readouterr().err
    assert f"--truth-noise {text}: expected MM,DEG" in error and error.count("\n") == 1
