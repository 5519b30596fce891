"""The measure `bootstrap`: starts are judged by their own frames."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import synthetic
from bench_task import make_task
from scipy.spatial.transform import Rotation

from benchmarks.measures import bootstrap
from benchmarks.measures.bootstrap import Start, bootstrap_cell, figures_of, started
from rsgen.console.progress import no_progress
from rsgen.errors import UserError
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.data.rig import Frame
from rstrack.metrics.association import truth_of
from rstrack.options import Options
from rstrack.tracking.spline_tracker import Tracker

FRAMES = 24
SPEED = 0.3  # of `synthetic`: 0.27 m/s and 0.3 rad/s
OPTIONS = Options(method="rs-pg", knot_spacing_s=0.03)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("starts") / "seq"
    writer = synthetic.open_writer(path, synthetic.make_config(80, 60), FRAMES, synthetic.make_spline(SPEED))
    synthetic.write_frames(writer)
    writer.finish()
    return path


@pytest.fixture(scope="module")
def dataset(root: Path) -> Dataset:
    return open_dataset(root)


def test_a_start_is_judged_by_its_own_frames(dataset: Dataset) -> None:
    truth = truth_of(dataset)
    assert truth is not None and dataset.truth is not None
    start = started(dataset, truth, OPTIONS, range(5, 12))
    tracker = Tracker(dataset.rig, OPTIONS)
    for frame in dataset.frames(5, 12):
        tracker.feed(frame)
    stamps, T = tracker.trajectory
    p, p_true = (P[:, :3, 3] - P[:, :3, 3].mean(axis=0) for P in (T, dataset.truth.pose(stamps)))
    _, rmse_root_n = Rotation.align_vectors(p_true, p)
    assert len(stamps) == 7 and not start.failed and start.keyframes == tracker.keyframes and start.wrong == 0
    assert start.ate_m == pytest.approx(rmse_root_n / np.sqrt(7), rel=1e-6) and 0 < start.ate_m < 5e-3
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
        assert self._dataset.truth is not None
        return np.array(self._stamps), self._dataset.truth.pose(self._stamps)

    def feed(self, frame: Frame) -> None:
        k = self._dataset.stamps.tolist().index(frame.depth.stamp)
        if k == 20:
            raise np.linalg.LinAlgError("no solution")
        self.reports.append(SimpleNamespace(lost=k in (3, 4)))
        if k not in (3, 4):
            self._stamps.append(frame.depth.stamp)


def test_lost_and_broken_starts_are_told_apart(
    root: Path, dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    monkeypatch.setattr(bootstrap, "make_tracker", lambda *_, **__: _Feigned(dataset))
    starts: list[Start] = []
    monkeypatch.setattr(bootstrap, "started", lambda *given: (starts.append(started(*given)), starts[-1])[1])
    found = bootstrap_cell(make_task(root, "rs-pg", settings={"starts": 99, "frames": 6}), no_progress)
    runs = {start.frame: start for start in starts}
    assert sorted(runs) == list(range(FRAMES - 5))
    assert runs[0].lost == (3, 4) and runs[4].lost == (4,) and not runs[5].failed
    assert runs[16].error == "frame 20: no solution" and runs[16].ate_m == pytest.approx(0, abs=1e-12)
    assert runs[18].ate_m is None
    failed = {start.frame for start in starts if start.failed}
    assert failed == set(range(5)) | set(range(15, 19)) and found["failed"] == len(failed)
    assert found["starts"] == 19 and found["broken"] == 4 and found["lost"] == 9


def test_starts_are_random_repeatable_and_of_the_cases_frames(
    root: Path, dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    asked: list[range] = []
    monkeypatch.setattr(bootstrap, "started", lambda *given: (asked.append(given[3]), Start(0, (), 0, 0, 0, 1, ""))[1])
    for seed in (0, 0, 1):
        task = make_task(root, "rs-pg", settings={"starts": 4, "frames": 5}, frames="10:20", seed=seed)
        bootstrap_cell(task, no_progress)
    assert asked[:4] == asked[4:8] != asked[8:] and len(set(asked[:4])) == 4
    assert all(len(frames) == 5 and frames.start >= 10 and frames.stop <= 20 for frames in asked)


def test_errors_are_those_of_starts_that_lost_nothing() -> None:
    def start(k: int, ate_mm: float | None, *lost: int, wrong: int = 0) -> Start:
        return Start(k, lost, None if ate_mm is None else 1e-3 * ate_mm, 0.05, wrong, 1, "")

    found = figures_of([
        start(7, 0.2), start(1, 6.0, wrong=2), start(3, 2.0), start(4, 900.0, 4, 5, 6, 9, wrong=9), start(5, None, 5)
    ])  # fmt: skip
    assert found["failed"] == 2 and found["silent"] == 1 and found["lost"] == 5
    assert found["ate_mm"] == pytest.approx(2.0) and found["ate_max_mm"] == pytest.approx(6.0)
    assert found["ate_p95_mm"] == pytest.approx(5.6) and found["pose_max_mm"] == pytest.approx(50.0)
    assert found["over_1_mm"] == 2 and found["over_5_mm"] == 1
    nothing = figures_of([start(5, None, 5)])
    assert nothing["ate_mm"] is None and nothing["pose_max_mm"] is None and nothing["over_1_mm"] == 0


@pytest.mark.parametrize(
    ("settings", "part"), [({"frames": 2}, "frames"), ({"starts": 0}, "starts"), ({"frames": 25}, "24 frames, too few")]
)
def test_wrong_input_is_named(settings: Any, part: str, root: Path) -> None:
    with pytest.raises(UserError, match=part):
        bootstrap_cell(make_task(root, settings=settings), no_progress)
