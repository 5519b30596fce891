"""What a track tells of the calibration: the filter against a batch solution, and a clock found while tracking."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from shaken_recording import OPTIONS, SHORT, told

from rstrack.data.dataset import Dataset
from rstrack.data.rig import CalibrationSigma
from rstrack.tracking.judgement.calibration_errors import CalibrationErrors
from rstrack.tracking.judgement.consider import CLOCK, COUNT
from rstrack.tracking.runs.run import track


def test_it_is_the_solution_of_all_frames_at_once() -> None:
    """Of normal equations with the prior, as if the clock had not been put right after every frame."""
    rng = np.random.default_rng(5)
    true, known = rng.normal(size=COUNT), CalibrationErrors()
    A, b = np.eye(COUNT), np.zeros(COUNT)
    for _ in range(40):
        D, root = rng.normal(size=(6, COUNT)), rng.normal(size=(6, 6))
        R = root @ root.T + np.eye(6)
        apart = D @ true + np.linalg.cholesky(R) @ rng.normal(size=6)
        A += D.T @ np.linalg.solve(R, D) / 30.0
        b += D.T @ np.linalg.solve(R, apart) / 30.0
        known = known.with_frame(apart - D[:, CLOCK] * known.clock[0], D, R)
    np.testing.assert_allclose(known.mean, np.linalg.solve(A, b), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(known.covariance, np.linalg.inv(A), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("late_s", [0.006, -0.006])
def test_a_clock_is_found_while_tracking(shaken: Dataset, tmp_path: Path, late_s: float) -> None:
    """As far as σ says, though the first keyframes have the old one; what is done with the run later goes by it."""
    wrong = told(shaken, shaken.rig.color_shutter.readout_s, late_s, np.zeros(6))
    unsure = replace(wrong, rig=replace(wrong.rig, sigma=CalibrationSigma(offset_s=0.015)))
    found = track(unsure, OPTIONS, tmp_path, SHORT)
    late = found.estimate.info["color_late"]
    assert late["seconds"] == pytest.approx(-late_s, abs=min(2e-3, 3.0 * late["sigma_s"])) and late["sigma_s"] < 4e-3
    assert f"{1e3 * late['seconds']:+.1f} ±" in found.text()
    again = wrong.as_seen_by(found.estimate.info)
    np.testing.assert_allclose(again.color_stamps, wrong.color_stamps + late["seconds"], atol=1e-9)


def test_a_clock_that_is_exact_stays(shaken: Dataset, tmp_path: Path) -> None:
    found = track(shaken, OPTIONS, tmp_path, slice(0, 4))
    assert "color_late" not in found.estimate.info and "while tracking" not in found.text()
