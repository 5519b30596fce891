"""The measure `speed`: all time is accounted for, and a peer takes turns with the method."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from bench_task import make_task
from rstrack_command import FRAMES, make_seq

import rstrack.alignment.normal_equations
from rsgen.console.progress import no_progress
from rsgen.errors import UserError
from rstrack.bench.measures import speed
from rstrack.bench.measures.speed import Stopwatch, speed_cell
from rstrack.bench.task import Absent


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("speed") / "seq"
    make_seq(path)
    return path


class _Peer:
    """Waits as long as the frame's number says, and loses its last."""

    def __init__(self, name: str, camera: Any, fed: list[Any]) -> None:
        self.name, self.fed, self.keyframes = name, fed, 2
        self.reports: list[Any] = []

    def feed(self, stamp: float, image: Any) -> None:
        assert image.color.shape == (120, 160, 3)
        self.fed.append((self.name, stamp))
        self.reports.append(SimpleNamespace(lost=len(self.reports) == 11))


def test_all_time_is_accounted_for(root: Path) -> None:
    solve = rstrack.alignment.normal_equations.solve
    found = speed_cell(make_task(root, "rs-pg", frames="0:12"), no_progress)
    assert found["frames"] == 6 and found["lost"] == 0 and found["keyframes"] >= 1 and found["read_ms"] > 0
    parts = {name: value for name, value in found.items() if name.startswith("part_")}
    assert sum(parts.values()) == pytest.approx(found["mean_ms"])
    needed = {f"part_geometric_kernel_level_{level}_ms" for level in range(2)} | {"part_photometric_kernel_level_0_ms"}
    needed |= {"part_preparing_images_ms", "part_poses_of_lines_ms"}
    needed |= {f"part_linear_algebra_{what}_ms" for what in ("chain", "assemble", "solve")}
    assert needed <= set(parts) and all(parts[name] > 0 for name in needed)
    assert parts["part_other_ms"] < 0.5 * found["mean_ms"]
    assert found["median_ms"] <= found["p95_ms"] <= found["p99_ms"] <= found["max_ms"]
    assert rstrack.alignment.normal_equations.solve is solve and "ratio" not in found


def test_a_peer_takes_turns_on_the_same_frames(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fed: list[Any] = []
    monkeypatch.setattr(speed, "PeerTracker", lambda name, camera: _Peer(name, camera, fed))
    monkeypatch.setattr(speed, "_TURN", 5)

    def ours(rig: Any, options: Any, timer: Any, **_: Any) -> Any:
        reports: list[Any] = []

        def feed(frame: Any) -> None:
            with timer("solve: all"):
                fed.append((options.method, frame.depth.stamp))
            reports.append(SimpleNamespace(lost=False))

        return SimpleNamespace(feed=feed, reports=reports, keyframes=3)

    monkeypatch.setattr(speed, "make_tracker", ours)
    task = make_task(root, "rs-g", settings={"peer": "open3d-icp"}, frames="2:14")
    found = speed_cell(task, no_progress)
    stamps = task.dataset.stamps[2:14].tolist()
    turns = [("rs-g", 0, 5), ("open3d-icp", 0, 5), ("rs-g", 5, 10), ("open3d-icp", 5, 10), ("rs-g", 10, 12)]
    turns += [("open3d-icp", 10, 12)]
    assert fed == [(name, stamp) for name, first, last in turns for stamp in stamps[first:last]]
    assert found["frames"] == 6 and found["peer_lost"] == 1 and found["peer_keyframes"] == 2 and found["keyframes"] == 3
    for name, ratio in (("median", "ratio"), ("p99", "ratio_p99")):
        theirs = found["peer_ms"] if name == "median" else found[f"peer_{name}_ms"]
        assert found[ratio] == pytest.approx(found[f"{name}_ms"] / theirs)
    assert found["peer_read_ms"] > 0 and found["part_solve_all_ms"] > 0 and "peer_median_ms" not in found


def test_a_peer_alone_is_timed_too(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fed: list[Any] = []
    monkeypatch.setattr(speed, "PeerTracker", lambda name, camera: _Peer(name, camera, fed))
    found = speed_cell(make_task(root, "open3d-hybrid"), no_progress)
    assert len(fed) == FRAMES and found["frames"] == FRAMES // 2 and found["lost"] == 1 and "part_other_ms" not in found


def test_what_cannot_be_timed_is_named(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(match: str, error: type[UserError] = UserError, method: str = "rs-g", **given: Any) -> None:
        with pytest.raises(error, match=match):
            speed_cell(make_task(root, method, **given), no_progress)

    refused("2 frames", frames="0:1")
    refused("settings: peer", settings={"peer": "orb-slam3"})
    refused("kiss-icp: speed times our methods and open3d-hybrid", method="kiss-icp")

    def missing(*_: Any) -> Any:
        raise UserError("the peers need Open3D")

    monkeypatch.setattr(speed, "PeerTracker", missing)
    refused("need Open3D", Absent, settings={"peer": "open3d-icp"})

    def broken(_: Any) -> None:
        raise np.linalg.LinAlgError("singular")

    monkeypatch.setattr(speed, "make_tracker", lambda *_, **__: SimpleNamespace(feed=broken))
    refused("broke down at frame 3", frames="3:6")


def test_a_stopwatch_counts_an_inner_part_once() -> None:
    now = iter([0.0, 1.0, 4.0, 10.0])
    watch = Stopwatch(clock=lambda: next(now))
    with watch.timed("outer"), watch.timed("inner"):
        pass
    assert watch.seconds == {"inner": 3.0, "outer": 7.0}
