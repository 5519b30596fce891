"""Benchmarks of robustness: what is moved is moved as told, convergence and its end are seen, starts are judged."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import synthetic
from scipy.spatial.transform import Rotation

from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.bench import convergence as conv
from rstrack.bench.bootstrap import BootstrapResult, Start, bootstraps
from rstrack.cli.main import main
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.data.rig import Frame
from rstrack.options import Options
from rstrack.tracking.spline_tracker import Tracker

FRAMES = 26
SPEED = 0.3  # of `synthetic`: 0.27 m/s and 0.3 rad/s
OPTIONS = Options(method="rs-pg", knot_spacing_s=0.03)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("robustness") / "seq"
    writer = synthetic.open_writer(path, synthetic.make_config(128, 96), FRAMES, synthetic.make_spline(SPEED))
    synthetic.write_frames(writer)
    synthetic.write_scene(path)
    writer.finish()
    return path


@pytest.fixture(scope="module")
def dataset(root: Path) -> Dataset:
    return open_dataset(root)


def truth_of(dataset: Dataset) -> Spline:
    assert dataset.truth is not None
    return dataset.truth


def run(capfd: pytest.CaptureFixture[str], words: list[str]) -> tuple[int, str, str]:
    capfd.readouterr()
    status = main(words)
    out, error = capfd.readouterr()
    assert "Traceback" not in error
    return status, out, error


# --- convergence -----------------------------------------------------------------------------------------------------


def test_a_resampled_spline_goes_through_the_truth(dataset: Dataset) -> None:
    truth = truth_of(dataset)
    spline = conv.resampled(truth, -0.21, 0.02)
    assert spline.t0 == -0.21 and spline.dt == 0.02 and spline.t_end >= truth.t_end
    knots = spline.t0 + 0.02 * np.arange(8, 64)
    np.testing.assert_allclose(spline.pose(knots), truth.pose(knots), atol=1e-8)
    between = knots[:-1] + 0.007
    off = np.linalg.norm(spline.pose(between)[:, :3, 3] - truth.pose(between)[:, :3, 3], axis=1)
    assert off.max() < 2e-6


@pytest.mark.parametrize("factor", [0.0, 1.0, 4.0])
def test_a_frame_is_moved_by_the_given_length_and_angle_as_a_whole(dataset: Dataset, factor: float) -> None:
    spline = conv.resampled(truth_of(dataset), -0.1, 0.03)
    aligner = conv._Aligner(dataset.rig, OPTIONS)
    new = aligner.prepare(9, dataset.frame(9))
    pair = conv.Pair(7, 9, np.array([0.6, 0.0, 0.8]), np.array([0.0, 1.0, 0.0]))
    state = conv.moved_state(spline, new, pair, factor)
    t = new.depth.exposure.mid_time
    D = se3.inverse(spline.pose(t)) @ state.spline.pose(t)
    np.testing.assert_allclose(D[:3, 3], factor * 0.02 * pair.direction, atol=1e-9)
    angle = np.radians(factor)
    turned = [[np.cos(angle), 0.0, np.sin(angle)], [0.0, 1.0, 0.0], [-np.sin(angle), 0.0, np.cos(angle)]]
    np.testing.assert_allclose(D[:3, :3], turned, atol=1e-9)
    # As a whole: the motion within the frame, seen from its camera, is what it was.
    first, last = new.first_time, new.last_time
    steps = [se3.inverse(s.pose(first)) @ s.pose(last) for s in (spline, state.spline)]
    np.testing.assert_allclose(steps[0], steps[1], atol=1e-9)
    before = state.segment(first)
    np.testing.assert_array_equal(state.points[:before], spline.control_points[:before])
    assert len(state.points) == state.segment(last) + 4


def test_pairs_are_random_repeatable_and_within_the_truth(dataset: Dataset) -> None:
    truth = truth_of(dataset)
    pairs = conv.choose_pairs(dataset, truth, OPTIONS, 400, 5)
    assert {p.frame - p.keyframe for p in pairs} == set(range(1, 11))
    margin = 6 * OPTIONS.knot_spacing_s
    for p in pairs:
        assert dataset.stamps[p.keyframe] - margin >= truth.t_begin
        assert dataset.stamps[p.frame] + 0.028 + margin <= truth.t_end
        assert np.linalg.norm(p.direction) == pytest.approx(1) and np.linalg.norm(p.axis) == pytest.approx(1)
    assert np.abs(np.mean([(p.direction, p.axis) for p in pairs], axis=0)).max() < 0.15
    again = conv.choose_pairs(dataset, truth, OPTIONS, 400, 5)
    assert all(a.keyframe == b.keyframe and (a.axis == b.axis).all() for a, b in zip(pairs, again, strict=True))
    other = conv.choose_pairs(dataset, truth, OPTIONS, 400, 6)
    assert any(a.keyframe != b.keyframe for a, b in zip(pairs, other, strict=True))


def test_near_starts_converge_and_far_ones_do_not(dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    # From the last hardly a pixel falls on the keyframe; in between (32 cm, 16 degrees) it is luck, and differs between
    # machines.
    monkeypatch.setattr(conv, "FACTORS", (0.0, 0.5, 1.0, 64.0))
    start, half, near, far = conv.convergence(dataset, OPTIONS, pairs=3, seed=2).rows()
    for row in (start, half, near):
        assert row["converged"] == 1.0 and row["median_error_m"] < 1e-3 and row["median_steps"] > 0
    assert far["moved_m"] == pytest.approx(1.28) and far["converged"] == far["wrong_but_believed"] == 0


def test_errors_are_those_of_the_pose_that_was_found(dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a tracker that leaves everything where it is, the errors are what the frame was moved by."""
    monkeypatch.setattr(conv._Aligner, "align", lambda *_: (0, True))
    stuck = conv.convergence(dataset, OPTIONS, pairs=2)
    for trial in stuck.trials:
        assert trial.error_m == pytest.approx(0.02 * trial.factor, abs=stuck.resampling_m + 1e-6)
        assert trial.error_deg == pytest.approx(trial.factor, abs=1e-3)
    rows = stuck.rows()
    assert [row["moved_m"] for row in rows] == [0.0, 0.01]  # the first without any convergence ends the table
    assert [row["converged"] for row in rows] == [1.0, 0.0] and rows[1]["wrong_but_believed"] == 2
    assert "0 % of 2 frames converge from 2 cm" in stuck.text()


def test_the_prior_alone_does_not_bring_a_frame_back(dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """Blind images leave the pose open: the control points before the frame must not tell where it is."""
    blind = dataclasses.replace(dataset, images=_Blind(dataset.images))
    trials = conv.convergence(blind, OPTIONS, pairs=2).trials
    assert not any(t.converged or t.believed for t in trials if t.factor)


class _Blind:
    """Grey images and no depth."""

    def __init__(self, images: Any) -> None:
        self._images = images

    def color(self, k: int) -> Any:
        return np.full_like(self._images.color(k), 128)

    def depth(self, k: int) -> Any:
        return np.zeros_like(self._images.depth(k))


def test_the_convergence_command(root: Path, capfd: pytest.CaptureFixture[str]) -> None:
    words = ["bench-convergence", str(root), "--pairs", "1", "--method", "rs-g", "--seed", "1"]
    status, out, error = run(capfd, words)
    assert status == 0 and "synthetic, rs-g: 100 %" in out and "of 1 frames converge from 2 cm and 1 deg" in out
    assert "aligning" in error
    status, out, error = run(capfd, [*words, "--json"])
    data = json.loads(out)
    assert status == 0 and error == "" and data["method"] == "rs-g" and data["pairs"] == 1
    assert len(data["trials"]) == len(conv.FACTORS) and data["rows"][0]["moved_m"] == 0.0


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["bench-convergence", "SEQ", "--method", "baseline"], "baseline"),
        (["bench-convergence", "SEQ", "--seed", "-1"], "--seed -1"),
        (["bench-convergence", "SEQ", "--pairs", "0"], "--pairs"),
        (["bench-convergence", "SEQ", "--knot-spacing-s", "0.3"], "longer sequence"),
        (["bench-convergence", "nowhere"], "nowhere"),
        (["bench-bootstrap", "SEQ", "--frames", "2"], "--frames 2"),
        (["bench-bootstrap", "SEQ", "--frames", "27"], "3 to 26"),
        (["bench-bootstrap", "SEQ", "--seed", "-1"], "--seed -1"),
        (["bench-bootstrap", "SEQ", "--starts", "0"], "--starts"),
    ],
)
def test_wrong_input_gets_one_line(words: list[str], part: str, root: Path, capfd: pytest.CaptureFixture[str]) -> None:
    status, out, error = run(capfd, [str(root) if word == "SEQ" else word for word in words])
    assert status == 2 and out == "" and error.startswith("rstrack: ") and error.count("\n") == 1 and part in error


@pytest.mark.parametrize("command", ["bench-convergence", "bench-bootstrap"])
def test_help_teaches(command: str, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit:
        main([command, "--help"])
    assert exit.value.code == 0 and f"example: rstrack {command} " in capfd.readouterr().out


# --- starts ----------------------------------------------------------------------------------------------------------


def test_starts_are_judged_by_their_own_frames(dataset: Dataset) -> None:
    report = bootstraps(dataset, OPTIONS, starts=2, frames=7, seed=1)
    assert len({s.frame for s in report.starts}) == 2 and all(0 <= s.frame <= FRAMES - 7 for s in report.starts)
    for start in report.starts:
        tracker = Tracker(dataset.rig, OPTIONS)
        for frame in dataset.frames(start.frame, start.frame + 7):
            tracker.feed(frame)
        stamps, T = tracker.trajectory
        p, p_true = (P[:, :3, 3] - P[:, :3, 3].mean(axis=0) for P in (T, truth_of(dataset).pose(stamps)))
        _, rmse_root_n = Rotation.align_vectors(p_true, p)
        assert len(stamps) == 7 and not start.failed and start.keyframes == tracker.keyframes
        assert start.ate_m == pytest.approx(rmse_root_n / np.sqrt(7), rel=1e-6) and 0 < start.ate_m < 2e-3
        assert start.worst_m is not None and start.ate_m < start.worst_m < 3 * start.ate_m


class _Feigned:
    """Knows the truth, says that it has lost frames 3 and 4, and breaks down at frame 20."""

    keyframes = 1

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset
        self.reports: list[Any] = []
        self._stamps: list[float] = []

    @property
    def trajectory(self) -> Any:
        return np.array(self._stamps), truth_of(self._dataset).pose(self._stamps)

    def feed(self, frame: Frame) -> None:
        k = self._dataset.stamps.tolist().index(frame.depth.stamp)
        if k == 20:
            raise np.linalg.LinAlgError("no solution")
        self.reports.append(SimpleNamespace(lost=k in (3, 4)))
        if k not in (3, 4):
            self._stamps.append(frame.depth.stamp)


def test_lost_and_broken_starts_are_listed(dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rstrack.bench.bootstrap.make_tracker", lambda *_, **__: _Feigned(dataset))
    report = bootstraps(dataset, OPTIONS, starts=99, frames=6)
    runs = {s.frame: s for s in report.starts}
    assert sorted(runs) == list(range(FRAMES - 5))
    assert runs[0].lost == (3, 4) and runs[4].lost == (4,) and not runs[5].failed
    assert runs[16].error == "frame 20: no solution" and runs[16].ate_m == pytest.approx(0, abs=1e-12)
    assert runs[19].ate_m is None and runs[20].ate_m is None
    failed = {s.frame for s in report.starts if s.failed}
    assert failed == set(range(5)) | set(range(15, 21)) and report.as_dict()["lost"] == len(failed)
    lines = report.text().splitlines()
    assert "21 starts, 6 frames each: 11 lost" in lines[-2]
    listed = {int(line.split()[0]): line for line in lines[1:22]}
    assert listed[0].endswith("lost: 3 to 4") and listed[20].endswith("broke down: frame 20: no solution")
    assert listed[5].split()[0] == "5" and "lost" not in listed[5]


def test_the_summary_leaves_lost_runs_out() -> None:
    def start(k: int, ate_mm: float | None, *lost: int) -> Start:
        return Start(k, lost, None if ate_mm is None else 1e-3 * ate_mm, None, 1, "")

    starts = start(7, 0.2), start(1, 6.0), start(3, 2.0), start(4, 900.0, 4, 5, 6, 9), start(5, None, 5)
    report = BootstrapResult("seq", "rs-pg", 20, starts)
    data = report.as_dict()
    assert data["lost"] == 2 and data["median_ate_m"] == 2e-3 and data["worst_ate_m"] == 6e-3
    assert data["over_1_mm"] == 2 and data["over_5_mm"] == 1
    text = report.text()
    assert "median 2.000 mm, worst 6.000 mm; 2 above 1 mm, 1 above 5 mm" in text
    assert "lost: 4 to 6, 9" in text
    assert [int(line.split()[0]) for line in text.splitlines()[1:6]] == [7, 3, 1, 5, 4]


def test_the_bootstrap_command(root: Path, capfd: pytest.CaptureFixture[str]) -> None:
    words = ["bench-bootstrap", str(root), "--starts", "2", "--frames", "4", "--method", "gs-g"]
    status, out, error = run(capfd, words)
    assert status == 0 and "synthetic, gs-g: 2 starts, 4 frames each: 0 lost" in out and "starting" in error
    status, out, error = run(capfd, [*words, "--json"])
    data = json.loads(out)
    assert status == 0 and error == "" and len(data["runs"]) == 2 and data["frames"] == 4 and data["lost"] == 0
