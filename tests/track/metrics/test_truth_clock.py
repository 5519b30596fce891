"""The clock of the truth: known offsets are found again, with an honest spread; two files of poses, as evo has them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import synthetic
from evo.core import metrics as evo_metrics
from evo.core import sync
from evo.core.trajectory import PoseTrajectory3D
from evo.tools import file_interface

from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.sequence.format import pose_rows
from rsgen.sequence.trajectory import Trajectory
from rstrack.cli.main import main
from rstrack.data.estimate import Estimate
from rstrack.metrics.association import Truth
from rstrack.metrics.evaluate import evaluate
from rstrack.metrics.run_evaluate import aligned_clock, evaluate_clocks, run_evaluate
from rstrack.metrics.truth_fit import fit_clock, shifted

KNOT_S = 0.1
WIGGLE = np.random.default_rng(1).normal(size=(95, 6)) * [0.05, 0.05, 0.05, 0.06, 0.06, 0.06]
SPLINE = Spline(se3.exp(WIGGLE), -0.5, KNOT_S)  # 8 s and more, quick and never the same
STAMPS = np.arange(7 * 30) / 30.0 + 0.2
MOCAP = Trajectory(np.arange(-0.4, 8.0, 0.01), se3.orthonormalise(SPLINE.pose(np.arange(-0.4, 8.0, 0.01))))


def estimate(offset_s: float = 0.0, sigma: float = 0.0, seed: int = 0, stamps: np.ndarray = STAMPS) -> Estimate:
    """Poses that were really those of `offset_s` after their stamps, drifting by sigma a frame, world elsewhere."""
    T = SPLINE.pose(stamps + offset_s)
    steps = se3.inverse(T[:-1]) @ T[1:] @ se3.exp(sigma * np.random.default_rng(seed).normal(size=(len(T) - 1, 6)))
    poses = [se3.exp(np.array([1.0, 2.0, 3.0, 0.4, 0.5, 0.6]))]
    for step in steps:
        poses.append(poses[-1] @ step)
    return Estimate(stamps, se3.orthonormalise(np.stack(poses)))


@pytest.mark.parametrize("motion", [SPLINE, MOCAP], ids=["spline", "poses"])
@pytest.mark.parametrize("offset_s", [-0.0371, -0.0005, 0.0, 0.0213, 0.0936])
def test_a_known_offset_is_found_by_every_error(motion: Spline | Trajectory, offset_s: float) -> None:
    truth = Truth(motion, STAMPS)
    fit = fit_clock(truth, estimate(offset_s))
    # Between 100 Hz poses the truth is a chord of the motion, so that it is not met exactly.
    assert fit.offset_s == pytest.approx(offset_s, abs=1e-4)
    assert set(fit.least_s) == {"rotational drift", "translational drift", "trajectory"}
    for name, least in fit.least_s.items():
        assert least == pytest.approx(offset_s, abs=2e-4), name
    assert fit.is_clear == (abs(offset_s) > 2e-3)
    assert evaluate(shifted(truth, fit.offset_s), estimate(offset_s)).ate_rmse_m < 2e-4


def test_the_standard_deviation_is_that_of_repeated_recordings() -> None:
    truth = Truth(MOCAP, STAMPS)
    fits = [fit_clock(truth, estimate(0.02, 1.5e-3, seed)) for seed in range(16)]
    errors = np.array([fit.offset_s - 0.02 for fit in fits])
    claimed = float(np.sqrt(np.mean([fit.sigma_s**2 for fit in fits])))
    assert errors.std() > 3e-4  # there is something to be honest about
    assert 0.5 < errors.std() / claimed < 2.0
    assert abs(errors.mean()) < 3.0 * errors.std() / np.sqrt(len(errors)) + 1e-4


def test_a_stretch_where_the_track_was_wrong_does_not_decide() -> None:
    wrong = estimate(0.015)
    T = wrong.T_world_depth.copy()
    T[60:75] = T[60:75] @ se3.exp(np.random.default_rng(3).normal(size=(15, 6)) * 0.5)
    fit = fit_clock(Truth(MOCAP, STAMPS), Estimate(wrong.stamps, se3.orthonormalise(T)))
    assert fit.offset_s == pytest.approx(0.015, abs=1e-3)


def test_a_motion_without_rotation_is_decided_by_translation() -> None:
    shifts = np.zeros((95, 6))
    shifts[:, :3] = WIGGLE[:, :3]
    slide = Spline(se3.exp(shifts), -0.5, KNOT_S)
    noise = se3.exp(np.random.default_rng(5).normal(size=(len(STAMPS), 6)) * 1e-4)
    T = se3.orthonormalise(slide.pose(STAMPS + 0.03) @ noise)
    fit = fit_clock(Truth(slide, STAMPS), Estimate(STAMPS, T))
    assert fit.criterion == "translational drift" and fit.offset_s == pytest.approx(0.03, abs=5e-4)


def test_what_cannot_be_found_is_said() -> None:
    with pytest.raises(UserError, match="9 pairs of poses one second apart"):
        fit_clock(Truth(MOCAP, STAMPS), estimate(stamps=STAMPS[:39]))
    with pytest.raises(UserError, match="no minimum within 100 ms"):
        fit_clock(Truth(MOCAP, STAMPS), estimate(0.2))


def test_shifting_moves_the_clock_and_nothing_else() -> None:
    for motion in (SPLINE, MOCAP):
        later = evaluate(shifted(Truth(motion, STAMPS), 0.03), estimate(0.03))
        assert later.frames == later.poses_compared == len(STAMPS) and later.ate_rmse_m < 2e-4
    assert aligned_clock(truth := Truth(MOCAP, STAMPS), estimate(), None) is truth


def test_an_offset_is_hinted_at_for_poses_but_not_for_our_own_spline() -> None:
    late = estimate(0.03)
    hinted = evaluate_clocks(Truth(MOCAP, STAMPS), late)
    assert hinted.offset_s == pytest.approx(0.03, abs=1e-4) and not hinted.asked
    assert hinted.moved is not None and hinted.moved.ate_rmse_m < 2e-4 < hinted.metrics.ate_rmse_m
    line = hinted.text().splitlines()[-1]
    assert line.startswith("hint: errors are least with the truth 30.0 ± ") and "after the stamps" in line
    for same in (evaluate_clocks(Truth(SPLINE, STAMPS), late), evaluate_clocks(Truth(MOCAP, STAMPS), estimate())):
        assert same.truth_offset is None and same.hint is None
    asked = evaluate_clocks(Truth(SPLINE, STAMPS), late, "auto")
    assert asked.moved is not None and asked.moved.ate_rmse_m < 1e-6 < asked.metrics.ate_rmse_m
    assert "clocks as they are" in asked.text() and asked.hint is None
    given = evaluate_clocks(Truth(SPLINE, STAMPS), late, 0.03)
    assert given.truth_offset is not None and given.truth_offset["sigma_s"] is None
    assert given.moved is not None and given.moved.ate_rmse_m < 1e-6


# --- files -----------------------------------------------------------------------------------------------------------


def write_tum(path: Path, stamps: np.ndarray, T: np.ndarray) -> Path:
    rows = pose_rows(T)
    path.write_text(
        "\n".join(f"{t:.9f} " + " ".join(f"{v:.12f}" for v in r) for t, r in zip(stamps, rows, strict=True))
    )
    return path


def test_two_files_give_what_evo_gives(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    found = estimate(0.0, 2e-3)
    true_file = write_tum(tmp_path / "truth.txt", MOCAP.stamps, MOCAP.T_world_cam)
    est_file = write_tum(tmp_path / "estimate.txt", found.stamps, found.T_world_depth)
    assert main(["evaluate", str(true_file), str(est_file), "--json"]) == 0
    ours = json.loads(capfd.readouterr().out)

    pair: list[PoseTrajectory3D] = [file_interface.read_tum_trajectory_file(str(f)) for f in (true_file, est_file)]
    ref, other = sync.associate_trajectories(*pair, max_diff=0.02)
    relations, rmse = evo_metrics.PoseRelation, evo_metrics.StatisticsType.rmse
    for relation, name in (
        (relations.translation_part, "rpe_trans_rmse_m_per_s"),
        (relations.rotation_angle_deg, "rpe_rot_rmse_deg_per_s"),
    ):
        rpe = evo_metrics.RPE(relation, delta=30, delta_unit=evo_metrics.Unit.frames, all_pairs=True)
        rpe.process_data((ref, other))
        assert ours[name] == pytest.approx(rpe.get_statistic(rmse), rel=1e-7)
    other.align(ref)
    ape = evo_metrics.APE(relations.translation_part)
    ape.process_data((ref, other))
    assert ours["ate_rmse_m"] == pytest.approx(ape.get_statistic(rmse), rel=1e-7)
    assert ours["frames"] == 0 and ours["poses_compared"] == ours["poses"] == len(STAMPS) and ours["ate_rmse_m"] > 1e-3

    text = run_evaluate(true_file, est_file).text()
    assert "frames tracked" not in text and f"{1e3 * ours['ate_rmse_m']:.3f}" in text


def test_files_take_an_offset_and_no_cameras(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    late = estimate(-0.025)
    true_file = write_tum(tmp_path / "truth.txt", MOCAP.stamps, MOCAP.T_world_cam)
    est_file = write_tum(tmp_path / "estimate.txt", late.stamps, late.T_world_depth)
    words = ["evaluate", str(true_file), str(est_file)]
    assert main([*words, "--truth-offset", "auto", "--json"]) == 0
    offset = json.loads(capfd.readouterr().out)["truth_offset"]
    assert offset["offset_s"] == pytest.approx(-0.025, abs=1e-4) and offset["metrics"]["ate_rmse_m"] < 2e-4
    assert main([*words, "--truth-offset", "-0.025"]) == 0
    assert "the truth 25.0 ms before the stamps: ATE 0." in capfd.readouterr().out
    for wrong, part in ((["--truth-offset", "soon"], "soon"), (["--camera", "c.yaml"], "c.yaml")):
        assert main([*words, *wrong]) == 2
        error = capfd.readouterr().err
        assert part in error and error.count("\n") == 1


def test_a_sequence_takes_an_offset(tmp_path: Path) -> None:
    root = synthetic.make_sequence(tmp_path / "seq", synthetic.make_config(32, 24), frames=4)
    spline = synthetic.make_spline()
    stamps = np.arange(4) / 30.0
    file = write_tum(tmp_path / "e.txt", stamps, spline.pose(stamps + 0.004))
    moved = run_evaluate(root, file, truth_offset=0.004)
    assert moved.moved is not None and moved.moved.ate_rmse_m < 1e-8 < 1e-5 < moved.metrics.ate_rmse_m
    assert len(stamps) == moved.metrics.frames
