"""Drift, ATE and errors by line against evo, closed forms and plain loops, and what `rstrack evaluate` says of them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import synthetic
from estimates import FRAMES, SPLINE, moved, noisy, one_line, rows_of, spline_estimate, truth, walk
from evo.core import metrics as evo_metrics
from evo.core.trajectory import PoseTrajectory3D
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.sequence.trajectory import Trajectory
from rstrack.data.estimate import Estimate, write_estimate
from rstrack.metrics.association import compare
from rstrack.metrics.evaluate import Metrics, compared, evaluate, pairs_apart, pairs_one_second_apart
from rstrack.metrics.run_evaluate import run_evaluate

# --- against evo and closed forms ------------------------------------------------------------------------------------


@given(seed=st.integers(0, 2**32 - 1), n=st.integers(35, 120))
@settings(max_examples=15, deadline=None, derandomize=True)
def test_ate_and_drift_are_those_of_evo(seed: int, n: int) -> None:
    stamps = 5.0 + np.arange(n) / 30.0
    true, est = walk(seed, n), se3.orthonormalise(walk(seed + 1, 1)[0] @ noisy(walk(seed, n), seed + 2))
    ours = evaluate(truth(Trajectory(stamps, true)), Estimate(stamps, est))

    ref, other = (PoseTrajectory3D(poses_se3=list(T), timestamps=stamps) for T in (true, est))
    relations = evo_metrics.PoseRelation
    for relation, value in (
        (relations.translation_part, ours.rpe_trans_rmse_m_per_s),
        (relations.rotation_angle_deg, ours.rpe_rot_rmse_deg_per_s),
    ):
        rpe = evo_metrics.RPE(relation, delta=30, delta_unit=evo_metrics.Unit.frames, all_pairs=True)
        rpe.process_data((ref, other))
        assert value == pytest.approx(rpe.get_statistic(evo_metrics.StatisticsType.rmse), abs=1e-9)
    assert ours.rpe_pairs == n - 30
    other.align(ref)
    ape = evo_metrics.APE(relations.translation_part)
    ape.process_data((ref, other))
    for name in ("rmse", "mean", "median", "std", "max"):
        expected = ape.get_statistic(evo_metrics.StatisticsType(name))
        assert getattr(ours, f"ate_{name}_m") == pytest.approx(expected, abs=1e-9)


def test_constant_drift_has_a_closed_form() -> None:
    # The camera stands still, so alignment takes the mean off and nothing else: what stays is the stamps' spread.
    stamps = np.arange(91) / 30.0
    true = np.tile(np.eye(4), (91, 1, 1))
    est = true.copy()
    est[:, 0, 3] = 0.02 * stamps
    result = evaluate(truth(Trajectory(stamps, true), stamps), Estimate(stamps, est))
    assert result.rpe_trans_rmse_m_per_s == pytest.approx(0.02, abs=1e-12)
    assert result.rpe_rot_rmse_deg_per_s == pytest.approx(0.0, abs=1e-9)
    assert result.ate_rmse_m == pytest.approx(0.02 * stamps.std(), rel=1e-9)
    assert result.rpe_pairs == 61


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=15, deadline=None, derandomize=True)
def test_another_world_frame_of_the_estimate_changes_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    bent = Spline(noisy(SPLINE.control_points, seed, 0.003), SPLINE.t0, SPLINE.dt)
    T = se3.exp(rng.normal(size=6) * [5, 5, 5, 1, 1, 1])
    a, b = (evaluate(truth(SPLINE), spline_estimate(s)) for s in (bent, moved(bent, T)))
    for name, value in a.as_dict().items():
        if isinstance(value, float):
            assert b.as_dict()[name] == pytest.approx(value, rel=1e-6, abs=1e-9), name
    assert a.ate_rmse_m > 1e-4


# --- pairs -----------------------------------------------------------------------------------------------------------


def loop_pairs(stamps: np.ndarray, seconds: float = 1.0, within: float = 0.1) -> list[tuple[int, int]]:
    """The definition in words, as a loop."""
    pairs = []
    for i, stamp in enumerate(stamps):
        j = min(range(len(stamps)), key=lambda k: abs(stamps[k] - (stamp + seconds)))
        if stamp + seconds <= stamps[-1] + 1e-3 and abs(stamps[j] - (stamp + seconds)) <= within:
            pairs.append((i, j))
    return pairs


def tum_pairs(stamps: np.ndarray) -> list[tuple[int, int]]:
    """Pairs as evaluate_rpe.py chooses them: the nearest one, unless it is the last."""
    nearest = [int(np.argmin(np.abs(stamps - (stamp + 1.0)))) for stamp in stamps]
    return [(i, j) for i, j in enumerate(nearest) if j != len(stamps) - 1]


@given(st.lists(st.floats(0.004, 0.16), min_size=1, max_size=60), st.floats(0.0, 3.0), st.integers(0, 60))
@settings(max_examples=100, deadline=None, derandomize=True)
def test_pairs_on_unequal_stamps_are_those_of_a_plain_loop(steps: list[float], gap: float, at: int) -> None:
    steps = [*steps[:at], gap + 0.01, *steps[at:]]
    stamps = np.concatenate([[100.0], 100.0 + np.cumsum(steps)])
    i, j = pairs_one_second_apart(stamps)
    assert list(zip(i.tolist(), j.tolist(), strict=True)) == loop_pairs(stamps)
    i, j = pairs_apart(stamps, 0.1)
    assert list(zip(i.tolist(), j.tolist(), strict=True)) == loop_pairs(stamps, 0.1, 0.05) and (i < j).all()


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None, derandomize=True)
def test_without_gaps_pairs_are_those_of_the_tum_script_but_for_the_last_pose(seed: int) -> None:
    stamps = np.cumsum(np.random.default_rng(seed).uniform(0.01, 0.1, size=60))
    i, j = pairs_one_second_apart(stamps)
    inner = [(a, b) for a, b in zip(i.tolist(), j.tolist(), strict=True) if b != len(stamps) - 1]
    assert inner == tum_pairs(stamps)


def test_drift_counts_pairs_with_two_true_poses_only() -> None:
    stamps = np.arange(90) / 30.0
    poses = walk(14, 90)
    true = noisy(poses, 15)
    known = np.r_[5:40, 46:81]
    result = evaluate(truth(Trajectory(stamps[known], true[known]), stamps), Estimate(stamps, poses))
    errors = []
    for i in range(60):
        if i in known and i + 30 in known:
            step = np.linalg.inv(true[i]) @ true[i + 30]
            errors.append(np.linalg.norm((np.linalg.inv(step) @ np.linalg.inv(poses[i]) @ poses[i + 30])[:3, 3]))
    assert result.rpe_pairs == len(errors) < 55
    assert result.rpe_trans_rmse_m_per_s == pytest.approx(np.sqrt(np.mean(np.square(errors))), rel=1e-9)


def test_no_pair_bridges_a_gap_and_none_is_a_pose_with_itself() -> None:
    stamps = np.concatenate([np.arange(10) / 30.0, 5.0 + np.arange(40) / 30.0])
    assert (0, 9) in tum_pairs(stamps) and (9, 9) in tum_pairs(stamps)
    i, j = pairs_one_second_apart(stamps)
    assert i.tolist() == list(range(10, 20)) and j.tolist() == list(range(40, 50))


def test_shorter_than_a_second_has_no_drift_but_says_so() -> None:
    stamps = FRAMES[:20]
    result = evaluate(truth(SPLINE, stamps), Estimate(stamps, noisy(SPLINE.pose(stamps), 1)))
    assert result.rpe_trans_rmse_m_per_s is None and result.rpe_rot_rmse_deg_per_s is None
    assert any("one second apart" in note for note in result.notes)
    assert json.loads(json.dumps(result.as_dict(), allow_nan=False))["rpe_trans_rmse_m_per_s"] is None
    assert " - " in result.text() + " "


# --- errors by line --------------------------------------------------------------------------------------------------


def test_the_same_spline_has_no_error_in_any_line() -> None:
    world = se3.exp(np.array([3.0, -1.0, 2.0, 0.9, -1.3, 0.4]))
    stamps = FRAMES[:38]
    result = evaluate(truth(SPLINE, stamps), spline_estimate(moved(SPLINE, world), stamps))
    assert result.row_rmse_m is not None and result.row_rmse_m < 1e-12
    assert result.row_rot_rmse_deg is not None and result.row_rot_rmse_deg < 1e-6
    assert result.rows == result.rows_total == 38 * 12


def test_errors_by_line_are_those_of_a_loop_over_lines() -> None:
    bent = Spline(noisy(SPLINE.control_points, 5, 0.01), SPLINE.t0, SPLINE.dt)
    stamps = FRAMES[:38]
    estimate = spline_estimate(bent, stamps)
    result = evaluate(truth(SPLINE, stamps), estimate)
    T = compare(truth(SPLINE, stamps), estimate).T_true_est
    positions, angles = [], []
    for stamp in stamps:
        for line in range(12):
            t = stamp + line * 0.028 / 12 - 0.002  # mid-exposure
            a, b = SPLINE.pose(t), T @ bent.pose(t)
            positions.append(np.linalg.norm(a[:3, 3] - b[:3, 3]))
            angles.append(np.degrees(Rotation.from_matrix(a[:3, :3].T @ b[:3, :3]).magnitude()))
    assert result.row_rmse_m == pytest.approx(np.sqrt(np.mean(np.square(positions))), rel=1e-9)
    assert result.row_rot_rmse_deg == pytest.approx(np.sqrt(np.mean(np.square(angles))), rel=1e-6)
    assert result.row_rmse_m > 1e-3


def test_lines_in_which_the_track_was_lost_do_not_count() -> None:
    bad = SPLINE.control_points.copy()
    bad[20:] = bad[20:] @ se3.exp(np.array([1.0, 0, 0, 0, 0, 0]))  # touches t >= -0.2 + 17 * 0.05 = 0.65 s
    broken = Spline(se3.orthonormalise(bad), SPLINE.t0, SPLINE.dt)
    stamps = FRAMES[:18]
    poses = se3.orthonormalise(SPLINE.pose(stamps))
    all_of_it = evaluate(truth(SPLINE), Estimate(stamps, poses, broken))
    valid = {"spline_valid": [[-0.1, 0.3], [0.4, 0.6]]}
    result = evaluate(truth(SPLINE), Estimate(stamps, poses, broken, valid))
    assert all_of_it.row_rmse_m is not None and all_of_it.row_rmse_m > 0.1
    assert result.row_rmse_m is not None and result.row_rmse_m < 1e-12
    t = (FRAMES[:, None] + np.arange(12) * 0.028 / 12 - 0.002).ravel()
    assert result.rows == int((((t >= -0.1) & (t <= 0.3)) | ((t >= 0.4) & (t <= 0.6))).sum())
    none = evaluate(truth(SPLINE), Estimate(stamps, poses, broken, {"spline_valid": []}))
    assert none.rows == 0 and none.row_rmse_m is None


def test_without_a_spline_there_are_no_errors_by_line() -> None:
    result = evaluate(truth(SPLINE), Estimate(FRAMES, se3.orthonormalise(SPLINE.pose(FRAMES))))
    assert result.row_rmse_m is None and result.rows == 0
    poses = Trajectory(FRAMES, SPLINE.pose(FRAMES))
    assert evaluate(truth(poses), spline_estimate(SPLINE)).row_rot_rmse_deg is None


# --- whole commands --------------------------------------------------------------------------------------------------


def test_a_run_is_evaluated_against_an_rsgen_sequence(tmp_path: Path) -> None:
    root = synthetic.make_sequence(tmp_path / "seq", frames=6)
    stamps = np.arange(6) / 30.0
    write_estimate(tmp_path / "run", stamps, SPLINE.pose(stamps), SPLINE, {})
    result = run_evaluate(root, tmp_path / "run").metrics
    assert (result.frames, result.frames_tracked, result.poses_compared) == (6, 6, 6)
    assert result.ate_rmse_m < 1e-8 and result.rows == 6 * 48
    assert result.row_rmse_m is not None and result.row_rmse_m < 1e-6
    late = tmp_path / "late.txt"
    late.write_text(rows_of([70.0, 71.0, 72.0, 73.0]))
    with pytest.raises(UserError) as error:
        run_evaluate(root, late)
    assert "late.txt" in one_line(error) and "0 of 4 poses" in str(error.value)


def test_the_table_has_units_and_lines_up() -> None:
    ate = (0.000131, 0.0001, 0.00009, 0.00002, 0.123456)
    result = Metrics(882, 878, 878, 877, *ate, 0.0042, 0.0611, 848, 0.0002, 0.01, 421440, 423360, ("a note",))
    text = result.text().splitlines()
    assert text[0].endswith("878 of 882 (99.5 %)")
    assert text[2].split() == ["error", "RMSE", "mean", "median", "std", "max", "over"]
    assert text[3].split()[:7] == ["ATE,", "mm", "0.131", "0.100", "0.090", "0.020", "123.456"]
    assert text[3].endswith("  877 of 878 poses") and text[3].index("877") == text[2].index("over")
    assert "drift, mm/s" in text[4] and "4.200" in text[4] and text[4].index("4.200") + 5 == text[2].index("RMSE") + 4
    assert "drift, deg/s" in text[5] and "0.061" in text[5]
    assert text[-1] == "note: a note"


def test_two_runs_are_compared_in_one_line(tmp_path: Path) -> None:
    ours, theirs = (Metrics(9, 9, 9, 9, ate, 0, 0, 0, 0, None, None, 0, None, None, 0, 0) for ate in (0.000095, 0.0091))
    for method in ("rs-pg", "gs-pg", "rs-g"):
        write_estimate(tmp_path / method, FRAMES[:9], SPLINE.pose(FRAMES[:9]), None, {"method": method})
    rs, gs, other = (tmp_path / method for method in ("rs-pg", "gs-pg", "rs-g"))
    model, neglect = "the rolling-shutter model", "taking the shutter for a global one"
    assert compared(rs, ours, gs, theirs) == f"{model}: ATE 0.095 mm; {neglect}: 9.1 mm (95.8 times worse)"
    assert compared(gs, theirs, rs, ours) == f"{neglect}: ATE 9.1 mm; {model}: 0.095 mm (95.8 times better)"
    assert compared(rs, ours, other, theirs).startswith(f"{rs}: ATE 0.095 mm; {other}: 9.1 mm")
