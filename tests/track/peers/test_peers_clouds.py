"""Lidar odometries as peers: points, times and deskewing against ray casting; the rules, with stand-ins for them."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import synthetic

import rstrack.peers.clouds
from rsgen.errors import UserError
from rsgen.geometry import se3
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.metrics.association import truth_of
from rstrack.metrics.evaluate import evaluate
from rstrack.options import CLOUD_PEERS
from rstrack.peers.clouds import KissIcp, cloud_of, deskewed, run_cloud_peer


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    config = synthetic.make_config(160, 120, depth={"readout_s": 0.028, "scan": "bottom-top"})
    return open_dataset(synthetic.make_sequence(tmp_path_factory.mktemp("clouds") / "seq", config, 12))


def test_points_lie_on_the_walls_at_their_own_times(dataset: Dataset) -> None:
    points, line = cloud_of(dataset)(3)
    last_s = 119 / 120 * 0.028
    assert len(points) == 160 * 120 and line.max() == 1.0
    assert line.min() == pytest.approx(1.0 - 30.0 * last_s, abs=1e-6)
    truth = dataset.truth
    assert truth is not None
    p_world = se3.transform(truth.pose(dataset.stamps[3] + last_s + (line - 1.0) / 30.0), points)
    off_wall = np.minimum(np.abs(p_world - synthetic.BOX[0]), np.abs(p_world - synthetic.BOX[1])).min(axis=-1)
    off_ball = np.abs(np.linalg.norm(p_world - synthetic.BALL, axis=-1) - synthetic.BALL_RADIUS)
    assert np.minimum(off_wall, off_ball).max() < 2e-4  # depth is stored in fifths of a millimetre


def test_deskewed_points_are_where_the_last_line_sees_them() -> None:
    velocity = np.array([0.02, -0.01, 0.03, 0.01, 0.05, -0.02])
    p_world, line = np.random.default_rng(1).uniform(1.0, 3.0, (200, 3)), np.linspace(0.0, 1.0, 200)
    seen = se3.transform(se3.inverse(se3.exp(line[:, None] * velocity)), p_world)
    there = se3.transform(se3.inverse(se3.exp(velocity)), p_world)
    assert np.abs(deskewed(seen, line, se3.exp(velocity)) - there).max() < 2e-3
    assert np.abs(seen - there).max() > 0.05


class Guided:
    """Answers with the truth at the last line, and keeps what it was given."""

    def __init__(self, dataset: Dataset) -> None:
        self.dataset, self.given, self.settings = dataset, [], {}

    def register(self, p_cam: np.ndarray, line: np.ndarray) -> np.ndarray:
        self.given.append((p_cam, line))
        assert self.dataset.truth is not None
        stamp = self.dataset.stamps[len(self.given) + 1]
        return np.asarray(self.dataset.truth.pose(stamp + 119 / 120 * 0.028))


def test_poses_are_those_of_the_last_line(dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rstrack.peers.clouds, "_tracker", lambda _: Guided(dataset))
    monkeypatch.setattr(rstrack.peers.clouds, "version", lambda _: "0")
    estimate = run_cloud_peer("kiss-icp", dataset, slice(2, 12))
    truth = truth_of(dataset)
    assert truth is not None
    errors = evaluate(replace(truth, frame_stamps=dataset.stamps[2:12]), estimate)
    assert errors.ate_rmse_m < 2e-3 and errors.frames_tracked == 10  # 30 mm if they were those of the stamps
    info = estimate.info
    assert info["method"] == "kiss-icp" and info["versions"]["kiss-icp"] == "0"
    assert len(info["timings"]["frame_ms"]) == 10


def test_kiss_icp_is_told_no_times_where_all_points_have_one(monkeypatch: pytest.MonkeyPatch) -> None:
    # It would divide by what lies between the first and the last, and end the process.
    given: list[np.ndarray] = []
    odometry = SimpleNamespace(register_frame=lambda _, times: given.append(times), last_pose=np.eye(4))
    config = SimpleNamespace(data=SimpleNamespace(), mapping=SimpleNamespace(), adaptive_threshold=SimpleNamespace())
    monkeypatch.setitem(sys.modules, "kiss_icp.kiss_icp", SimpleNamespace(KissICP=lambda _: odometry))
    monkeypatch.setitem(sys.modules, "kiss_icp.config", SimpleNamespace(load_config=lambda _: config))
    tracker = KissIcp(5.0)
    for line in (np.ones(4), np.linspace(0.5, 1.0, 4)):
        tracker.register(np.ones((4, 3)), line)
    assert given[0].size == 0
    np.testing.assert_array_equal(given[1], np.linspace(0.5, 1.0, 4))


def test_small_gicp_gets_a_guess_and_a_new_keyframe(dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    step = se3.exp(np.array([0.12, 0.0, 0.0, 0.0, 0.0, 0.0]))
    calls: list[tuple[Any, np.ndarray]] = []

    def align(target: Any, source: Any, tree: Any, guess: np.ndarray, **_: Any) -> SimpleNamespace:
        calls.append((target, guess))
        return SimpleNamespace(T_target_source=guess @ step if len(calls) == 1 else guess)

    module = SimpleNamespace(align=align, preprocess_points=lambda points, resolution: (len(calls), "tree"))
    monkeypatch.setitem(sys.modules, "small_gicp", module)
    monkeypatch.setattr(rstrack.peers.clouds, "version", lambda _: "0")
    estimate = run_cloud_peer("small-gicp", dataset, slice(0, 6))
    # It moves on by 0.12 m a frame: after the third, 0.36 m on, the keyframe is another one.
    assert [target for target, _ in calls] == [0, 0, 0, 2, 2]
    np.testing.assert_allclose([guess[0, 3] for _, guess in calls], [0.0, 0.24, 0.36, 0.12, 0.24], atol=1e-9)
    assert np.diff(estimate.T_world_depth[:, 0, 3]) == pytest.approx(np.full(5, 0.12), abs=1e-7)


@pytest.mark.parametrize("name", CLOUD_PEERS)
def test_a_peer_that_is_not_there_is_one_line(name: str, dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("kiss_icp", "kiss_icp.kiss_icp", "small_gicp"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(UserError, match="pip install"):
        run_cloud_peer(name, dataset)


def test_what_they_cannot_track(dataset: Dataset, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(rstrack.peers.clouds, "_tracker", lambda _: Guided(dataset))
    with pytest.raises(UserError, match="has no frame 40"):
        run_cloud_peer("kiss-icp", dataset, slice(40, 50))
    empty = SimpleNamespace(depth=lambda _: np.zeros((120, 160), np.float32), color=dataset.images.color)
    with pytest.raises(UserError, match="frame 0 holds next to nothing"):
        run_cloud_peer("kiss-icp", replace(dataset, images=empty))
    monkeypatch.undo()
    with pytest.raises(UserError, match="unknown peer 'nope'"):
        run_cloud_peer("nope", dataset)


@pytest.mark.parametrize(("name", "most_m"), [("kiss-icp", 0.05), ("small-gicp", 0.02)])
def test_the_peers_themselves_follow_a_room(name: str, most_m: float, dataset: Dataset) -> None:
    pytest.importorskip({"kiss-icp": "kiss_icp.kiss_icp", "small-gicp": "small_gicp"}[name])
    estimate = run_cloud_peer(name, dataset)
    truth = truth_of(dataset)
    assert truth is not None and evaluate(truth, estimate).ate_rmse_m < most_m
