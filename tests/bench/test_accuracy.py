"""Figures of the measure `track`: what the truth's extrinsics and its own errors change, and what they leave alone."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
from estimates import CAMERA, SHUTTER

from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.sequence.trajectory import Trajectory
from rstrack.bench.cells import CaseEntry
from rstrack.bench.measures.track import accuracy
from rstrack.data.estimate import Estimate
from rstrack.metrics.association import truth_of
from rstrack.metrics.run_evaluate import evaluate_clocks

SIGMA = 1e-3
STAMPS = np.arange(250) / 30.0
SURE = ("nees_01", "nees", "nees_5", "coverage_50", "coverage_90", "coverage_99")


def figures(free: slice = slice(6), stamps: np.ndarray = STAMPS, **case: Any) -> dict[str, Any]:
    """Of poses that err by SIGMA, of a truth of a body 3 cm from the camera. free: in which directions it moves."""
    twists = np.zeros((110, 6))
    twists[:, free] = 0.06 * np.random.default_rng(1).normal(size=(110, 6))[:, free]
    spline, body = Spline(se3.exp(twists), -0.5, 0.1), se3.exp([0.03, -0.02, 0.01, 0.01, 0.02, 0.0])
    at = np.arange(-0.4, 9.0, 0.01)
    truth = Trajectory(at, se3.orthonormalise(spline.pose(at) @ body))
    T = spline.pose(stamps) @ se3.exp(SIGMA * np.random.default_rng(2).normal(size=(len(stamps), 6)))
    upper = (SIGMA**2 * np.eye(6))[np.triu_indices(6)].tolist()
    told = [{"stamp": float(t), "covariance": upper, "drift_world": [0.0] * 21} for t in stamps]
    estimate = Estimate(stamps, se3.orthonormalise(T), None, {"frames": told})
    rig = SimpleNamespace(depth_camera=CAMERA, depth_shutter=SHUTTER)
    dataset: Any = SimpleNamespace(truth=None, truth_poses=truth, rig=rig, sequence=None, stamps=stamps)
    cell = SimpleNamespace(case_entry=CaseEntry(sequence="s", **case))
    task: Any = SimpleNamespace(frames=range(len(stamps)), dataset=dataset, cell=cell)
    found = accuracy(task, estimate)
    on_the_clock = evaluate_clocks(truth_of(dataset), estimate, case.get("truth_offset")).chosen  # type: ignore[arg-type]
    assert found["ate_mm"] == 1e3 * on_the_clock.ate_rmse_m
    return found


def test_extrinsics_and_noise_of_the_truth_count_in_nees_and_coverage_alone() -> None:
    plain = figures(truth_offset="auto")
    mounted = figures(truth_offset="auto", truth_extrinsics="auto")
    noisy = figures(truth_offset="auto", truth_extrinsics="auto", truth_noise=(2.0, 0.25))
    for other in (mounted, noisy):
        assert {k: v for k, v in plain.items() if k not in SURE} == {k: v for k, v in other.items() if k not in SURE}
    assert plain["ate_mm"] > 2.0 and plain["nees"] > 2.0
    np.testing.assert_allclose([mounted[name] for name in SURE], [1.0, 1.0, 1.0, 0.5, 0.9, 0.99], atol=0.15)
    # Two poses' own errors of 1 mm and 1 mrad each, beside the truth's.
    expected = np.mean([2e-6 / (2e-6 + 4e-6), 2e-6 / (2e-6 + np.radians(0.25) ** 2)])
    assert abs(noisy["nees"] / mounted["nees"] / expected - 1.0) < 0.1
    assert noisy["coverage_50"] > mounted["coverage_50"] and noisy["nees_5"] < noisy["nees"] < noisy["nees_01"]


def test_where_extrinsics_stay_open_only_nees_and_coverage_are_missing() -> None:
    open_ones = figures(free=slice(4), truth_extrinsics="auto")
    assert open_ones["ate_mm"] > 0.0 and all(open_ones[name] is None for name in SURE)
    short = figures(stamps=STAMPS[:90])
    assert short["nees_5"] is None and short["nees"] is not None and short["nees_01"] is not None
