"""Loops of a track are found and closed; what is none is refused. On a ray-cast room."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loop_room import FRAMES, NOISE, OPTIONS

from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.adjustment.rigid import align
from rstrack.data.dataset import Dataset
from rstrack.data.estimate import read_estimate
from rstrack.data.rig import DEFAULT_SIGMA, Frame
from rstrack.options import Options
from rstrack.report.build import write_report
from rstrack.tracking import loop_closing
from rstrack.tracking.any_tracker import make_tracker
from rstrack.tracking.loop_closing import close_loops, judge_of
from rstrack.tracking.runs.run import track
from rstrack.tracking.spline_tracker import Tracker


@pytest.fixture
def dataset(to_and_fro: Dataset) -> Dataset:
    return to_and_fro


@pytest.fixture
def run(closed_at_end: Path) -> Path:
    return closed_at_end


@pytest.fixture(scope="module")
def tracker(to_and_fro: Dataset) -> Tracker:
    """At the end of its track, without noise: looking for loops leaves it as it is."""
    tracker = make_tracker(to_and_fro.rig, OPTIONS)
    assert isinstance(tracker, Tracker)
    for k in range(FRAMES):
        tracker.feed(to_and_fro.frame(k))
    return tracker


def interrupted(*_: Any) -> None:
    raise KeyboardInterrupt


def ate(run: Path, name: str = "metrics") -> float:
    return float(json.loads((run / "run.json").read_text())[name]["ate_rmse_m"])


def test_loops_are_closed_and_both_tracks_written(run: Path, dataset: Dataset) -> None:
    info = json.loads((run / "run.json").read_text())
    assert info["loops"]["count"] >= 5 and info["loops"]["refused"] == 0 and info["loops"]["problem"] is None
    assert ate(run) < 0.8 * ate(run, "metrics_online")
    final, online = read_estimate(run), read_estimate(run / "trajectory_online.txt")
    np.testing.assert_array_equal(final.stamps, online.stamps)
    assert np.abs(final.T_world_depth - online.T_world_depth).max() > 1e-4
    # Poses go with the spline, and the first one stays.
    assert final.spline is not None
    np.testing.assert_allclose(final.spline.pose(final.stamps), final.T_world_depth, atol=2e-8)
    np.testing.assert_allclose(final.T_world_depth[0], online.T_world_depth[0], atol=2e-8)
    before = Spline.load(run / "spline_online.npz")
    np.testing.assert_allclose(before.pose(online.stamps), online.T_world_depth, atol=2e-8)
    early, late = info["loops"]["pairs"][0]["frames"]
    assert 0 <= early < late < FRAMES


def test_the_report_says_what_became_of_loops(run: Path) -> None:
    page = write_report(run).read_text()
    count = json.loads((run / "run.json").read_text())["loops"]["count"]
    assert f"{count} closed, 0 refused; ATE before" in page


def test_without_loops_a_track_stays_as_it_is(dataset: Dataset, run: Path, tmp_path: Path) -> None:
    result = track(dataset, Options(**(vars(OPTIONS) | {"loops": "off"})), tmp_path / "run", noise=NOISE)
    assert result.loops == "" and not (tmp_path / "run" / "trajectory_online.txt").exists()
    assert (tmp_path / "run" / "trajectory.txt").read_bytes() == (run / "trajectory_online.txt").read_bytes()
    assert (tmp_path / "run" / "spline.npz").read_bytes() == (run / "spline_online.npz").read_bytes()


def test_ctrl_c_while_loops_are_closed_leaves_the_track(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop_closing, "closed", interrupted)
    # Nobody says here that the lens is even: the run finds how even it is, and goes on with what it found.
    dataset = replace(dataset, rig=replace(dataset.rig, color_falloff=None))
    result = track(dataset, OPTIONS, tmp_path / "run", noise=NOISE)
    assert result.end == "interrupted"
    online, info = (tmp_path / "run" / "trajectory.txt").read_bytes(), tmp_path / "run" / "run.json"
    falloff = json.loads(info.read_text())["dataset"]["color_falloff"]
    # Where it was interrupted it goes on: nothing is left but the loops.
    monkeypatch.undo()
    again = track(dataset, OPTIONS, tmp_path / "run", noise=NOISE, resume=True)
    assert again.end == "done"
    assert (tmp_path / "run" / "trajectory_online.txt").read_bytes() == online
    assert (tmp_path / "run" / "trajectory.txt").read_bytes() != online
    assert json.loads(info.read_text())["dataset"]["color_falloff"] == falloff
    assert json.loads(info.read_text())["loops"]["count"] >= 5


def test_ctrl_c_while_loops_are_closed_changes_nothing(
    dataset: Dataset, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop_closing, "closed", interrupted)
    assert track(dataset, OPTIONS, tmp_path / "run", noise=NOISE).end == "interrupted"
    assert (tmp_path / "run" / "trajectory.txt").read_bytes() == (run / "trajectory_online.txt").read_bytes()
    monkeypatch.undo()
    assert track(dataset, OPTIONS, tmp_path / "run", noise=NOISE, resume=True).end == "done"
    assert (tmp_path / "run" / "trajectory.txt").read_bytes() == (run / "trajectory.txt").read_bytes()


def test_an_image_that_is_gone_costs_the_loops_not_the_track(tracker: Tracker) -> None:
    def gone(k: int) -> Frame:
        raise UserError(f"frame {k}: is gone")

    closing = close_loops(tracker, gone)
    assert closing.moves is None and "not closed: frame" in closing.text(0.0)
    assert closing.info()["problem"].endswith("is gone") and closing.info()["pairs"] == []


def test_a_frame_is_aligned_to_a_keyframe_of_another_time(dataset: Dataset, tracker: Tracker) -> None:
    truth = dataset.truth
    assert truth is not None and tracker.spline is not None
    keyframes = tracker.track.all_keyframes()
    early = keyframes.get(min(keyframes.indices))
    frame = tracker.track.upload_again(FRAMES - 3, dataset.frame(FRAMES - 3))
    mid = frame.depth.exposure.mid_time
    T_true = se3.inverse(truth.pose(early.t)) @ truth.pose(mid)
    start = T_true @ se3.exp(np.array([0.015, -0.01, 0.01, 0.01, -0.01, 0.01]))
    found = align(
        tracker.track.terms, tracker.options, frame, early, tracker.spline, start, (2, 1, 0), judge_of(tracker)
    )  # fmt: skip
    assert found.fault == ""
    off = np.abs(se3.log(se3.inverse(T_true) @ found.T_ref_cam))
    assert off[:3].max() < 1.5e-3 and off[3:].max() < 1e-3
    sigma = np.sqrt(np.diag(np.linalg.inv(found.information)))
    assert (sigma < 0.01).all()
    # Another place is none.
    elsewhere = align(
        tracker.track.terms, tracker.options, frame, early, tracker.spline,
        T_true @ se3.exp(np.array([0.6, 0.0, 0.0, 0.0, 0.5, 0.0])), (1, 0), judge_of(tracker),
    )  # fmt: skip
    assert elsewhere.fault


def test_a_frame_whose_depth_and_colour_are_of_two_places_is_found_at_none(dataset: Dataset, tracker: Tracker) -> None:
    assert dataset.truth is not None and tracker.spline is not None
    keyframes = tracker.track.all_keyframes()
    early = keyframes.get(min(keyframes.indices))
    own, other = dataset.frame(FRAMES - 3), dataset.frame(FRAMES - 8)
    colors = tuple(replace(a, pixels=b.pixels) for a, b in zip(own.colors, other.colors, strict=True))
    frame = tracker.track.upload_again(FRAMES - 3, replace(own, colors=colors))
    T_true = se3.inverse(dataset.truth.pose(early.t)) @ dataset.truth.pose(frame.depth.exposure.mid_time)
    given = tracker.track.terms, tracker.options, frame, early, tracker.spline, T_true, (1, 0)
    assert align(*given, judge_of(tracker)).fault
    frame = tracker.track.upload_again(FRAMES - 3, own)
    assert not align(*given[:2], frame, *given[3:], judge_of(tracker)).fault


def test_the_search_leaves_what_the_tracker_remembers_of_keyframes(dataset: Dataset) -> None:
    """A keyframe's landmarks are of when it was first looked at; since then other depth was fused in."""
    tracker = make_tracker(replace(dataset.rig, sigma=DEFAULT_SIGMA), OPTIONS)
    assert isinstance(tracker, Tracker)
    for k in range(FRAMES):
        tracker.feed(dataset.frame(k))
    calibration = tracker.track.covariances.calibration
    before = dict(calibration._landmarks)
    assert before and close_loops(tracker, dataset.frame).loops
    assert calibration._landmarks == before


def test_what_shows_another_place_closes_no_loop(dataset: Dataset, tracker: Tracker) -> None:
    """Frames of other moments stand in for the keyframes': they fit, but elsewhere, and the two ways contradict."""
    honest = close_loops(tracker, dataset.frame)
    assert len(honest.loops) > 3
    wrong = close_loops(tracker, lambda k: dataset.frame((k + 7) % FRAMES))
    assert not wrong.loops and wrong.tried > 10 and sum(wrong.faults.values()) > 0.8 * wrong.tried
    assert wrong.moves is None and "none found" in wrong.text(0.0)
