"""Any tracker's TUM file through `rstrack evaluate`: against evo and the benchmark's own script."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic
from evo.core import metrics as evo_metrics
from evo.core import sync
from evo.tools import file_interface
from scipy.spatial.transform import Rotation

from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.sequence.trajectory import Trajectory
from rstrack.cli.main import main
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.data.estimate import Estimate
from rstrack.metrics.association import Truth
from rstrack.metrics.evaluate import evaluate, pairs_one_second_apart

GLOBAL = Shutter(0.0)
PLAIN = Camera(160, 120, 120.0, 120.0, 79.5, 59.5)


def foreign_file(path: Path, stamps: np.ndarray, T: np.ndarray, stamp_digits: int) -> None:
    """A TUM file as other trackers write them: few digits, comments."""
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for stamp, pose in zip(stamps, T, strict=True):
        values = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
        lines.append(f"{stamp:.{stamp_digits}f} " + " ".join(f"{value:.7f}" for value in values))
    path.write_text("\n".join(lines) + "\n")


@pytest.fixture
def long(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A sequence of 38 frames, 1.23 s."""
    monkeypatch.setattr(synthetic, "DURATION_S", 1.25)
    return synthetic.make_sequence(tmp_path / "seq", synthetic.make_config(16, 12), frames=38)


def perturbed(dataset: Dataset, stamps: np.ndarray, seed: int) -> np.ndarray:
    """T_world_depth (n, 4, 4), wrong by a centimetre or so and some degrees, in another world."""
    assert dataset.truth is not None
    rng = np.random.default_rng(seed)
    xi = np.cumsum(rng.normal(size=(len(stamps), 6)) * 0.003, axis=0)
    return se3.exp(rng.normal(size=6)) @ dataset.truth.pose(stamps) @ se3.exp(xi)


def evaluated(capfd: pytest.CaptureFixture[str], root: Path, file: Path) -> dict[str, Any]:
    capfd.readouterr()
    assert main(["evaluate", str(root), str(file), "--json"]) == 0
    metrics: dict[str, Any] = json.loads(capfd.readouterr().out)
    return metrics


def test_metrics_of_files_are_those_of_evo(long: Path, capfd: pytest.CaptureFixture[str]) -> None:
    dataset = open_dataset(long)
    assert len(dataset) == 38
    est = long.parent / "est.txt"
    # Our truth is taken at the estimate's stamps, evo's at the nearest of its own: round them no further.
    foreign_file(est, dataset.stamps, perturbed(dataset, dataset.stamps, 3), 9)
    ours = evaluated(capfd, long, est)

    ref = file_interface.read_tum_trajectory_file(long / "groundtruth.txt")
    other = file_interface.read_tum_trajectory_file(est)
    ref, other = sync.associate_trajectories(ref, other, max_diff=0.02)
    relations, rmse = evo_metrics.PoseRelation, evo_metrics.StatisticsType.rmse
    for relation, key in (
        (relations.translation_part, "rpe_trans_rmse_m_per_s"),
        (relations.rotation_angle_deg, "rpe_rot_rmse_deg_per_s"),
    ):
        rpe = evo_metrics.RPE(relation, delta=30, delta_unit=evo_metrics.Unit.frames, all_pairs=True)
        rpe.process_data((ref, other))
        assert ours[key] == pytest.approx(rpe.get_statistic(rmse), abs=1e-6)
    other.align(ref)
    ape = evo_metrics.APE(relations.translation_part)
    ape.process_data((ref, other))
    assert ours["ate_rmse_m"] == pytest.approx(ape.get_statistic(rmse), abs=1e-6)
    assert ours["rpe_pairs"] == 8 and ours["ate_rmse_m"] > 3e-3 and ours["rpe_rot_rmse_deg_per_s"] > 0.3


def tum_errors(stamps: np.ndarray, true: np.ndarray, est: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Translations and angles (degrees) that the benchmark's evaluate_rpe.py finds with a fixed delta of one second.

    Its own order of products, ominus(ominus(est_j, est_i), ominus(true_j, true_i)), with our pairs.
    """

    def ominus(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.linalg.inv(a) @ b

    trans, angles = [], []
    for i, j in zip(*pairs_one_second_apart(stamps), strict=True):
        error = ominus(ominus(est[j], est[i]), ominus(true[j], true[i]))
        trans.append(np.linalg.norm(error[:3, 3]))
        angles.append(np.degrees(np.arccos(np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1))))
    return np.array(trans), np.array(angles)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_drift_of_a_file_with_gaps_is_that_of_the_tum_script(long: Path, capfd: pytest.CaptureFixture[str]) -> None:
    dataset = open_dataset(long)
    assert dataset.truth is not None
    stamps = np.delete(dataset.stamps, [2, 3, 33])
    est = long.parent / "est.txt"
    foreign_file(est, stamps, perturbed(dataset, stamps, 5), 6)
    ours = evaluated(capfd, long, est)
    rows = np.loadtxt(est)
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.from_quat(rows[:, 4:]).as_matrix(), rows[:, 1:4]
    trans, angles = tum_errors(rows[:, 0], dataset.truth.pose(rows[:, 0]), T)
    assert ours["rpe_pairs"] == len(angles) and ours["poses"] == 35 and ours["frames"] == 38
    assert ours["rpe_rot_rmse_deg_per_s"] == pytest.approx(rms(angles), abs=1e-6)
    # The script sees each step from its end, the definition (Sturm et al. 2012) and evo from its beginning: turning
    # errors swing the translation by another lever. Nearly the same as a rule, exactly so with time reversed.
    assert ours["rpe_trans_rmse_m_per_s"] == pytest.approx(rms(trans), rel=0.2)
    assert abs(ours["rpe_trans_rmse_m_per_s"] - rms(trans)) > 1e-6


def test_the_tum_script_is_the_definition_with_time_reversed(long: Path) -> None:
    dataset = open_dataset(long)
    assert dataset.truth is not None
    stamps = dataset.stamps
    true, est = dataset.truth.pose(stamps), perturbed(dataset, stamps, 7)
    trans, _ = tum_errors(stamps, true, est)
    backwards = stamps[-1] - stamps[::-1]
    truth = Truth(Trajectory(backwards, true[::-1]), backwards, PLAIN, GLOBAL)
    metrics = evaluate(truth, Estimate(backwards, se3.orthonormalise(est[::-1])))
    assert metrics.rpe_pairs == len(trans) == 8
    assert metrics.rpe_trans_rmse_m_per_s == pytest.approx(rms(trans), abs=1e-9)
