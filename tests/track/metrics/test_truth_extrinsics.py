"""The extrinsics of the truth: a known transform is found again, with an honest spread; what stays open is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import synthetic
from test_truth_clock import MOCAP, SPLINE, STAMPS, WIGGLE, estimate, write_tum

from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.sequence.trajectory import Trajectory
from rstrack.cli.main import main
from rstrack.data.estimate import Estimate
from rstrack.metrics.association import Truth
from rstrack.metrics.evaluate import evaluate
from rstrack.metrics.run_evaluate import evaluate_clocks, evaluate_extrinsics, run_evaluate
from rstrack.metrics.truth_fit import fit_extrinsics, mounted

# Camera in the body's frame: a few centimetres and degrees, and a body with axes of its own.
SMALL = se3.exp([0.035, -0.031, 0.009, 0.01, 0.02, -0.005])
TURNED = se3.exp([0.1, 0.2, -0.3, 1.2, -1.9, 1.4])


def of_a_body(motion: Spline | Trajectory, T_body_camera: np.ndarray) -> Truth:
    """The truth of a body in whose frame the camera, which `motion` is of, lies at T_body_camera."""
    return mounted(Truth(motion, STAMPS, interpolate=True), se3.inverse(T_body_camera))


@pytest.mark.parametrize("motion", [SPLINE, MOCAP], ids=["spline", "poses"])
@pytest.mark.parametrize("T", [np.eye(4), SMALL, TURNED], ids=["none", "small", "turned"])
def test_a_known_transform_is_found(motion: Spline | Trajectory, T: np.ndarray) -> None:
    truth = of_a_body(motion, T)
    fit = fit_extrinsics(truth, estimate())
    # Between 100 Hz poses the truth is a chord of the motion, so that it is not met exactly.
    np.testing.assert_allclose(fit.T_body_camera, T, atol=1e-9 if motion is SPLINE else 3e-4)
    assert evaluate(mounted(truth, fit.T_body_camera), estimate()).ate_rmse_m < 2e-4
    np.testing.assert_allclose(fit.translation_m, T[:3, 3], atol=3e-4)


def test_mounting_is_exact_between_control_points() -> None:
    t = np.linspace(0.2, 7.0, 50)
    moved = of_a_body(SPLINE, TURNED).motion
    assert isinstance(moved, Spline)
    np.testing.assert_allclose(moved.pose(t), SPLINE.pose(t) @ se3.inverse(TURNED), atol=1e-12)


def test_the_standard_deviation_is_that_of_repeated_recordings() -> None:
    truth = of_a_body(MOCAP, SMALL)
    fits = [fit_extrinsics(truth, estimate(0.0, 1e-3, seed)) for seed in range(16)]
    errors = np.stack([[*(fit.translation_m - SMALL[:3, 3]), *fit.rotation_deg] for fit in fits])
    errors[:, 3:] -= np.degrees([0.01, 0.02, -0.005])
    claimed = np.sqrt(np.mean([[*fit.sigma_m**2, *fit.sigma_deg**2] for fit in fits], axis=0))
    rms = np.sqrt(np.mean(errors**2, axis=0))
    assert (rms[:3] > 1e-3).all()  # there is something to be honest about
    assert 0.5 < np.sqrt(np.mean((rms / claimed) ** 2)) < 2.0
    assert ((rms / claimed > 0.3) & (rms / claimed < 3.0)).all()


@pytest.mark.parametrize(
    ("free", "part"), [([0, 1, 2], "the translation altogether"), ([0, 1, 2, 4], "along the axis of the turns")]
)
def test_a_motion_that_leaves_it_open_is_refused(free: list[int], part: str) -> None:
    twists = np.zeros((95, 6))
    twists[:, free] = WIGGLE[:, free]
    motion = Spline(se3.exp(twists), -0.5, 0.1)
    with pytest.raises(UserError, match=part):
        fit_extrinsics(Truth(motion, STAMPS), Estimate(STAMPS, se3.orthonormalise(motion.pose(STAMPS))))


def test_too_few_poses_are_refused() -> None:
    with pytest.raises(UserError, match="9 pairs of poses one second apart"):
        fit_extrinsics(Truth(MOCAP, STAMPS, interpolate=True), estimate(stamps=STAMPS[:39]))


def test_both_figures_are_told_and_the_plain_one_stays() -> None:
    truth, late = of_a_body(MOCAP, SMALL), estimate(0.03, 5e-5)
    found = evaluate_extrinsics(truth, late, "auto")
    assert found.metrics == evaluate_clocks(truth, late, "auto").metrics
    assert found.mounted is not None and found.moved is not None and found.chosen is found.mounted
    assert found.mounted.ate_rmse_m < 0.5 * found.moved.ate_rmse_m < found.metrics.ate_rmse_m
    lines = found.text().splitlines()
    assert lines[0].startswith("clocks as they are: ATE") and lines[1].startswith("the truth ")
    assert lines[3].startswith("the truth's camera moved by (3") and "± " in lines[3] and "ATE" in lines[3]
    same_clock = evaluate_extrinsics(of_a_body(SPLINE, SMALL), estimate(0.0, 2e-4))
    assert same_clock.text().startswith("the truth as it is: ATE") and same_clock.truth_offset is None


def test_files_and_sequences_take_it(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    truth = of_a_body(MOCAP, SMALL).motion
    assert isinstance(truth, Trajectory)
    found = estimate()
    true_file = write_tum(tmp_path / "truth.txt", truth.stamps, se3.orthonormalise(truth.T_world_cam))
    est_file = write_tum(tmp_path / "estimate.txt", found.stamps, found.T_world_depth)
    words = ["evaluate", str(true_file), str(est_file), "--truth-offset", "0"]
    assert main([*words, "--truth-extrinsics", "auto", "--json"]) == 0
    told = json.loads(capfd.readouterr().out)
    with_it = told["truth_extrinsics"]
    np.testing.assert_allclose(with_it["T_body_camera"], SMALL, atol=3e-4)
    assert with_it["metrics"]["ate_rmse_m"] < 2e-4 < 1e-3 < told["truth_offset"]["metrics"]["ate_rmse_m"]
    assert main([*words, "--json"]) == 0 and json.loads(capfd.readouterr().out)["truth_extrinsics"] is None
    assert main([*words, "--truth-extrinsics", "some"]) == 2 and "truth-extrinsics" in capfd.readouterr().err

    root = synthetic.make_sequence(tmp_path / "seq", synthetic.make_config(32, 24), frames=4)
    with pytest.raises(UserError, match="pairs of poses one second apart"):
        run_evaluate(root, est_file, truth_extrinsics="auto")
