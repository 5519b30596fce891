"""Loops closed while the camera goes on: live, from files, killed and resumed. On a ray-cast room."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from loop_room import FRAMES, NOISE, OPTIONS
from loop_room import to_and_fro as true_path

from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.adjustment.closing import Moves
from rstrack.data.dataset import Dataset
from rstrack.data.estimate import read_estimate
from rstrack.data.image_files import with_noise
from rstrack.data.rig import Frame, Image
from rstrack.keyframes.archive import StoredFrames
from rstrack.metrics.association import truth_of
from rstrack.metrics.evaluate import evaluate
from rstrack.metrics.run_evaluate import add_errors
from rstrack.tracking import loop_tracker
from rstrack.tracking.any_tracker import make_tracker
from rstrack.tracking.loop_tracker import LoopTracker
from rstrack.tracking.runs import checkpoint
from rstrack.tracking.runs.run import track

ONLINE = replace(OPTIONS, loops="online")
NEW = loop_tracker._NEW


@pytest.fixture(scope="module", autouse=True)
def little_is_news() -> Iterator[None]:
    """Within a second the camera drifts by less than what would be closed while it goes on."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop_tracker, "_NEW", 5.0)
        yield


@pytest.fixture
def dataset(to_and_fro: Dataset) -> Dataset:
    return to_and_fro


@pytest.fixture(scope="module")
def run(to_and_fro: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("online-run") / "run"
    result = track(to_and_fro, ONLINE, out, noise=NOISE)
    assert result.lost == 0 and "closed" in result.loops
    add_errors(out, truth_of(to_and_fro), result.estimate, result.online)
    return out


def frames(dataset: Dataset) -> list[Frame]:
    noisy = NOISE.sigma_depth, NOISE.sigma_intensity, NOISE.seed
    return [with_noise(dataset.frame(k), k, *noisy) for k in range(FRAMES)]


def test_it_ends_as_well_as_loops_closed_at_the_end(run: Path, closed_at_end: Path) -> None:
    online, end = (json.loads((folder / "run.json").read_text()) for folder in (run, closed_at_end))
    assert online["metrics"]["ate_rmse_m"] < 1.05 * end["metrics"]["ate_rmse_m"]
    assert online["metrics"]["ate_rmse_m"] < 0.8 * online["metrics_online"]["ate_rmse_m"]
    assert online["loops"]["count"] >= 0.8 * end["loops"]["count"] and online["loops"]["problem"] is None
    # The tracker within goes its own way, to the same bits.
    for name in ("trajectory_online.txt", "spline_online.npz"):
        assert (run / name).read_bytes() == (closed_at_end / name).read_bytes()
    final = read_estimate(run)
    assert final.spline is not None
    np.testing.assert_allclose(final.spline.pose(final.stamps), final.T_world_depth, atol=2e-8)


@pytest.mark.parametrize("memory_gb", [2.0, 1e-9])
def test_live_it_knows_where_it_is_and_ends_as_a_run_from_files(dataset: Dataset, run: Path, memory_gb: float) -> None:
    """Without files to read again; with images of keyframes in memory, or not even room for one."""
    tracker = make_tracker(dataset.rig, replace(ONLINE, memory_gb=memory_gb))
    assert isinstance(tracker, LoopTracker)
    truth, off = true_path(), []
    for frame in frames(dataset):
        tracker.feed(frame)
        stamps, T = tracker.trajectory
        within = tracker.uncorrected.trajectory[1]
        T_true = se3.inverse(truth.pose(stamps[0])) @ truth.pose(stamps[-1])
        off.append([np.linalg.norm((se3.inverse(P[0]) @ P[-1])[:3, 3] - T_true[:3, 3]) for P in (T, within)])
        spline = tracker.spline
        assert spline is not None
        np.testing.assert_allclose(spline.pose(stamps), T, atol=1e-9)
    corrected, uncorrected = np.sqrt(np.mean(np.square(off[FRAMES // 2 :]), axis=0))
    assert tracker.closing.closed is not None and corrected < 0.8 * uncorrected
    closing = tracker.finished()
    assert closing.moves is not None and len(closing.loops) > 5
    np.testing.assert_allclose(tracker.trajectory[1], read_estimate(run).T_world_depth, atol=2e-8)


def test_a_run_that_is_killed_goes_on_to_the_same_bits(
    dataset: Dataset, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checkpoint, "_EVERY_S", 0.0)
    monkeypatch.setattr(checkpoint, "_SHARE", np.inf)
    told: list[str] = []

    def killed(name: str, *_: object) -> None:
        told.append(name)
        if told.count("tracking") == 21:
            raise RuntimeError("killed")

    with pytest.raises(RuntimeError, match="killed"):
        track(dataset, ONLINE, tmp_path / "run", noise=NOISE, progress=killed)
    track(dataset, ONLINE, tmp_path / "run", noise=NOISE, resume=True)
    for name in ("trajectory.txt", "spline.npz", "trajectory_online.txt"):
        assert (tmp_path / "run" / name).read_bytes() == (run / name).read_bytes()


def test_what_was_closed_before_ctrl_c_is_kept(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(LoopTracker, "finished", interrupted)
    result = track(dataset, ONLINE, tmp_path / "run", noise=NOISE)
    assert result.end == "interrupted" and "closed" in result.loops
    truth = truth_of(dataset)
    assert result.online is not None and truth is not None
    assert evaluate(truth, result.estimate).ate_rmse_m < 0.9 * evaluate(truth, result.online).ate_rmse_m


def test_an_image_that_is_gone_costs_its_loops_only(dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    def gone(number: int) -> Frame:
        if number > 12:
            return dataset.frame(number)
        raise UserError(f"frame {number}: is gone")

    tracker = LoopTracker(dataset.rig, ONLINE, load=gone)
    for k in range(FRAMES):
        tracker.feed(dataset.frame(k))
    closing = tracker.finished()
    assert closing.problem.endswith("is gone")
    assert all(min(loop.early, loop.late) > 12 for loop in closing.loops)
    assert "is gone" in closing.text(0.0)


def test_nothing_is_adjusted_for_loops_that_say_nothing_new(dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without noise the track hardly drifts: one adjustment at the end, or a few."""
    calls = []
    real = loop_tracker.closed
    monkeypatch.setattr(loop_tracker, "closed", lambda *given: (calls.append(1), real(*given))[1])
    monkeypatch.setattr(loop_tracker, "_NEW", NEW)
    tracker = LoopTracker(dataset.rig, ONLINE, load=dataset.frame)
    for k in range(FRAMES):
        tracker.feed(dataset.frame(k))
    clean, looked = len(calls), len(tracker.closing.loops)
    calls.clear()
    monkeypatch.setattr(loop_tracker, "_NEW", 0.0)
    tracker = LoopTracker(dataset.rig, ONLINE, load=dataset.frame)
    for k in range(FRAMES):
        tracker.feed(dataset.frame(k))
    assert looked > 5 and clean < 0.5 * len(calls)


def test_moves_of_control_points() -> None:
    rng = np.random.default_rng(3)
    before = Spline(se3.exp(0.1 * rng.normal(size=(9, 6))), 0.0, 0.1)
    after = Spline(se3.exp(0.02 * rng.normal(size=(9, 6))) @ before.control_points, 0.0, 0.1)
    moves = Moves.between(before, after)
    np.testing.assert_allclose(moves.spline(before).control_points, after.control_points, atol=1e-12)
    # Control points that have come since go with the last; from a number on with another body.
    T, U = se3.exp(np.full(6, 0.3)), se3.exp(np.full(6, -0.2))
    np.testing.assert_array_equal(moves.of(8, 3), np.repeat(moves.points[8:], 3, axis=0))
    two = moves.then(10, T).then(12, U)
    np.testing.assert_array_equal(two.of(9, 4), [moves.points[8], T, T, U])
    np.testing.assert_array_equal(two.then(11, U).of(9, 4), [moves.points[8], T, U, U])
    np.testing.assert_array_equal(Moves().of(2, 2), np.repeat(np.eye(4)[None], 2, axis=0))
    # A pose beside the spline moves as the spline does there.
    t, T_pose = np.array([0.25]), before.pose(np.array([0.25])) @ se3.exp(np.full(6, 1e-3))
    expected = after.pose(t) @ se3.inverse(before.pose(t)) @ T_pose
    np.testing.assert_allclose(moves.poses(before, t, T_pose), expected, atol=1e-12)


def test_stored_frames_come_back_from_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    rng = np.random.default_rng(1)

    def frame(stamp: float) -> Frame:
        depth, rgb = rng.random((4, 5), np.float32), rng.integers(0, 255, (4, 5, 3), np.uint8)
        return Frame(Image(stamp, depth), (Image(stamp + 0.01, rgb),))

    made = {k: frame(0.1 * k) for k in (2, 5, 9)}
    kept = StoredFrames(made[2].depth.pixels.nbytes + made[2].colors[0].pixels.nbytes)
    for k, each in made.items():
        kept.add(k, each)
    assert len(list(tmp_path.rglob("*.npz"))) == 2
    for k, each in made.items():
        back = kept.get(k)
        assert back.depth.stamp == each.depth.stamp and back.colors[0].stamp == each.colors[0].stamp
        np.testing.assert_array_equal(back.depth.pixels, each.depth.pixels)
        np.testing.assert_array_equal(back.colors[0].pixels, each.colors[0].pixels)
    with pytest.raises(UserError, match="frame 3: its images were not stored"):
        kept.get(3)
    next(tmp_path.rglob("frame-00000002-*.npz")).unlink()
    with pytest.raises(UserError, match="cannot be read again"):
        kept.get(2)
