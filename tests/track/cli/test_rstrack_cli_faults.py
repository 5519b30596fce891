"""`rstrack track` where something is missing, damaged, interrupted or lost: what there is is kept, the rest named."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import synthetic
from rstrack_command import FRAMES, make_seq, read_info, refused, run

import rsgen.console.progress
from rstrack.data.estimate import read_estimate
from rstrack.data.rig import Frame
from rstrack.tracking.frame_report import Fault, FrameReport
from rstrack.tracking.spline_tracker import Tracker


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a sequence seq/."""
    folder = tmp_path_factory.mktemp("rstrack")
    make_seq(folder / "seq")
    return folder


# --- what sequences may lack -----------------------------------------------------------------------------------------


def test_a_tum_folder_without_truth_is_tracked_but_not_evaluated(
    place: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    for name in ("sequence.yaml", "spline.npz", "groundtruth.txt"):
        Path("seq", name).unlink()
    refused(capfd, "track seq --out r", "seq", "camera")
    camera = "{width: 160, height: 120, intrinsics: [120.0, 120.0, 79.5, 59.5], readout_s: 0.028}"
    T = synthetic.T_COLOR_DEPTH.tolist()
    Path("c.yaml").write_text(f"color: {camera}\ndepth: {camera}\nT_color_depth: {T}\n")
    assert "truth    none" in run(capfd, "info seq --camera c.yaml")[1]
    status, out, error = run(capfd, "track seq --camera c.yaml --out r --frames 0:8")
    assert status == 0 and "ATE" not in out + error and read_info("r")["metrics"] is None
    refused(capfd, "evaluate seq r --camera c.yaml", "ground truth")
    assert run(capfd, "report r --sequence seq --camera c.yaml --out p.png")[0] == 0


def test_one_frame_is_a_run_that_cannot_be_evaluated(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    status, out, _ = run(capfd, "track seq --out r --frames 3 --quiet")
    assert status == 0 and "1 frame" in out and "ATE" not in out
    assert len(Path("r/trajectory.txt").read_text().splitlines()) == 3
    refused(capfd, "evaluate seq r", "trajectory.txt", "1 poses")


def test_depth_without_a_measurement_is_no_crash(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for path in Path("seq/depth").iterdir():
        cv2.imwrite(str(path), np.zeros((120, 160), np.uint16))
    status, out, _ = run(capfd, "track seq --out r --method rs-g --quiet")
    assert status == 1 and "rs-g on synthetic" in out and Path("r/run.json").exists()


def test_damaged_images_are_left_out_counted_and_named(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    os.truncate("seq/depth/000007.png", 100)
    os.truncate("seq/rgb/000009.png", 100)
    status, out, error = run(capfd, "track seq --out r --method gs-pg --quiet")
    assert status == 1 and error == "" and "13 of 14 frames" in out and "none lost" in out
    assert "left out: 2 images that cannot be read, first seq/depth/000007.png: is not a whole PNG" in out
    info = read_info("r")
    assert info["end"] == "done" and info["lost"] == 0
    assert [(left["frame"], left["error"].split(":")[0]) for left in info["unreadable"]] == [
        (7, "seq/depth/000007.png"), (9, "seq/rgb/000009.png"),
    ]  # fmt: skip
    kept = [k / 30 for k in range(FRAMES) if k != 7]
    np.testing.assert_allclose(read_estimate(Path("r")).stamps, kept, atol=1e-6)
    assert [frame["stamp"] for frame in info["frames"]] == pytest.approx(kept)
    assert info["frames"][8]["pixels_color"] == 0 < info["frames"][9]["pixels_color"]
    assert info["metrics"]["frames_tracked"] == 13 and info["metrics"]["ate_rmse_m"] < 0.02


def test_a_first_image_that_is_damaged_costs_one_frame_only(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    os.truncate("seq/depth/000000.png", 100)
    assert run(capfd, "track seq --out r --method gs-g --quiet")[0] == 1
    assert read_info("r")["timings"]["frame_ms"][13:] == [] and len(read_info("r")["frames"]) == 13


def test_nothing_but_damaged_images_is_no_run(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for path in Path("seq/depth").iterdir():
        os.truncate(path, 100)
    refused(capfd, "track seq --out r --quiet", "depth/000000.png", "no other frame of the 14")
    assert not Path("r/run.json").exists()


def test_a_dataset_is_never_overwritten_by_a_run(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    before = Path("seq/spline.npz").read_bytes()
    refused(capfd, "track seq --out seq", "seq", "sequence.yaml", "choose another --out")
    assert Path("seq/spline.npz").read_bytes() == before


# --- runs that end early or go wrong ---------------------------------------------------------------------------------


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Ctrl-C as in a terminal: a shell starts its background jobs with SIGINT ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_ctrl_c_writes_what_there_is(
    place: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    show = rsgen.console.progress.ProgressDisplay.__call__

    def press(self: rsgen.console.progress.ProgressDisplay, stage: str, fraction: float, note: str) -> None:
        show(self, stage, fraction, note)
        if fraction == 8 / FRAMES:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(rsgen.console.progress.ProgressDisplay, "__call__", press)
    before = signal.getsignal(signal.SIGINT)
    status, out, error = run(capfd, "track seq --out r --method gs-g --quiet")
    assert status == 130 and "8 of 14 frames" in out and "interrupted" in error
    assert read_info("r")["end"] == "interrupted" and len(read_estimate(Path("r")).stamps) == 8
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.usefixtures("interruptible")
def test_a_second_ctrl_c_breaks_off(
    place: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def press_twice(*_: object) -> None:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(rsgen.console.progress.ProgressDisplay, "__call__", press_twice)
    status, out, error = run(capfd, "track seq --out r --method gs-g")
    assert (status, out, error) == (130, "", "rstrack: interrupted; nothing was written\n")
    assert not Path("r/run.json").exists()


@pytest.mark.usefixtures("interruptible")
def test_a_background_job_leaves_ctrl_c_to_others(
    place: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    monkeypatch.setattr(
        rsgen.console.progress.ProgressDisplay, "__call__", lambda *_: signal.raise_signal(signal.SIGINT)
    )
    status, out, _ = run(capfd, "track seq --out r --method gs-g")
    assert status == 0 and "14 frames" in out and read_info("r")["end"] == "done"


def test_lost_frames_are_left_out_and_reported(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for k in (0, 1):
        cv2.imwrite(f"seq/depth/{k:06d}.png", np.zeros((120, 160), np.uint16))
    status, out, _ = run(capfd, "track seq --out r --method rs-g --quiet")
    info, estimate = read_info("r"), read_estimate(Path("r"))
    assert status == 1 and "2 lost" in out and "12 of 14" in out
    assert f"lost because: {Fault.NO_START} (2)" in out
    assert [k for k, frame in enumerate(info["frames"]) if frame["lost"]] == [0, 1]
    assert [frame["fault"] for frame in info["frames"]] == [Fault.NO_START] * 2 + [""] * 12
    assert info["lost"] == 2 and info["end"] == "done" and info["metrics"]["frames_tracked"] == 12
    np.testing.assert_allclose(estimate.stamps, np.arange(2, FRAMES) / 30, atol=1e-6)
    assert not estimate.spline_covers(1.0 / 30) and estimate.spline_covers(5.0 / 30)


def test_a_tracker_that_breaks_down_keeps_what_it_had(
    place: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    feed = Tracker.feed

    def fail(self: Tracker, frame: Frame) -> FrameReport:
        if len(self.reports) == 8:
            raise np.linalg.LinAlgError("33th leading minor not positive definite")
        return feed(self, frame)

    monkeypatch.setattr(Tracker, "feed", fail)
    status, _, error = run(capfd, "track seq --out r --method gs-g --quiet")
    assert status == 1 and error.count("\n") == 1 and "frame 8" in error
    assert len(read_info("r")["timings"]["frame_ms"]) == 8 and read_info("r")["end"] == "broke down"
