"""The tracker with an IMU: blackouts are bridged, runs resume to the same bits, and what a run says of the unit."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic

from rsgen.config.sections import ImuConfig
from rsgen.errors import UserError
from rsgen.geometry import se3, so3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.spline import Spline
from rsgen.sensors.imu import simulate_imu, write_imu_csv
from rstrack.data.dataset import open_dataset
from rstrack.data.estimate import read_estimate
from rstrack.data.imu.description import ImuNoise
from rstrack.data.imu.recording import ImuRecording
from rstrack.data.rig import Frame, Image, Rig
from rstrack.inertial.band import MotionBand
from rstrack.inertial.estimate import upright
from rstrack.options import Options
from rstrack.tracking.runs import checkpoint
from rstrack.tracking.runs.run import track
from rstrack.tracking.spline_tracker import Tracker

CAMERA, SHUTTER = Camera(80, 60, 60.0, 60.0, 39.5, 29.5), Shutter(readout_s=0.028)
TRUTH = synthetic.make_spline(0.3)
OPTIONS: dict[str, Any] = {"method": "rs-gi", "bootstrap_frames": 3, "backend": "llvm"}
BIAS = (0.01, -0.008, 0.006)
_NOISE = """
gyroscope_noise_density: 1.7e-4
gyroscope_random_walk: 2.0e-5
accelerometer_noise_density: 2.0e-3
accelerometer_random_walk: 3.0e-3
"""


def imu_of(truth: Spline = TRUTH, gravity: tuple[float, float, float] = (0.0, -9.80665, 0.0)) -> ImuRecording:
    config = ImuConfig(
        gravity=gravity, gyroscope_noise_density=7e-5, accelerometer_noise_density=1e-3, gyroscope_bias=BIAS,
        gyroscope_random_walk=1e-5, accelerometer_random_walk=1e-4, accelerometer_bias=(0.1, -0.07, 0.05),
    )  # fmt: skip
    read = simulate_imu(truth, config, truth.t_begin, truth.t_end, 1)
    return ImuRecording(read.t, read.gyro, read.accel, ImuNoise(7e-5, 1e-5, 1e-3, 1e-4), np.eye(4), 200.0)


def frame_at(k: int, dark: bool = False, truth: Spline = TRUTH) -> Frame:
    depth = synthetic.render_depth(truth, CAMERA, SHUTTER, k / 30.0)
    return Frame(Image(k / 30.0, np.zeros_like(depth) if dark else depth), ())


def test_a_blackout_is_bridged_and_the_track_goes_on() -> None:
    tracker = Tracker(Rig(CAMERA, SHUTTER, CAMERA, SHUTTER, np.eye(4)), Options(**OPTIONS), imu=imu_of())
    dark = range(14, 22)
    for k in (*range(21), *range(24, 28)):  # dark first, then nothing at all: as long as 0.3 s
        report = tracker.feed(frame_at(k, k in dark))
        assert report.lost == (k in dark)
    bridged = [k for k, report in enumerate(tracker.reports) if report.bridged]
    assert bridged == list(range(14, 21)) and not any(report.lost for report in tracker.reports)
    assert all(tracker.reports[k].fault for k in bridged) and len(tracker.spline_valid) == 1
    stamps, T = tracker.trajectory
    assert len(stamps) == 25 and (np.diff(stamps) > 0.0).all()
    off = se3.log(se3.inverse(se3.inverse(TRUTH.pose(stamps[13])) @ TRUTH.pose(stamps)) @ se3.inverse(T[13]) @ T)
    assert np.linalg.norm(off[14:21, :3], axis=1).max() < 2e-3
    assert np.degrees(np.linalg.norm(off[14:21, 3:], axis=1).max()) < 0.05
    assert tracker.inertia is not None and tracker.inertia.is_usable


def vibrating() -> Spline:
    """The same motion on something that vibrates at 25 Hz, by 1.4 mm and 0.4 degrees."""
    dt = 1 / 250
    t = TRUTH.t_begin + dt * (np.arange(round((TRUTH.t_end - TRUTH.t_begin) / dt) + 2) - 1)
    wave = np.sin(2 * np.pi * 25.0 * t[:, None] + np.arange(6)) * np.repeat([1.4e-3, 7e-3], 3)
    return Spline(TRUTH.pose(np.clip(t, TRUTH.t_begin, TRUTH.t_end)) @ se3.exp(wave), TRUTH.t_begin, dt)


def turned_off(truth: Spline, knot_spacing_s: float | None = None) -> tuple[float, Tracker]:
    """Root mean square (degrees) by which lines of frames 4 to 13 are turned wrongly, infinite where one is lost."""
    rig, options = Rig(CAMERA, SHUTTER, CAMERA, SHUTTER, np.eye(4)), Options(**OPTIONS, knot_spacing_s=knot_spacing_s)
    tracker = Tracker(rig, options, imu=imu_of(truth))
    reports = [tracker.feed(frame_at(k, truth=truth)) for k in range(14)]
    if any(report.lost for report in reports) or tracker.spline is None:
        return float("inf"), tracker
    t = np.linspace(4 / 30, 13 / 30, 200)
    R_true, R = truth.pose(t)[:, :3, :3], tracker.spline.pose(t)[:, :3, :3]
    turns = so3.log(np.swapaxes(R_true, 1, 2) @ R_true[0] @ R[0].T @ R)
    return float(np.degrees(np.sqrt(((turns - turns.mean(axis=0)) ** 2).sum(axis=1).mean()))), tracker


def test_what_vibrates_is_followed_by_knots_as_dense_as_its_unit_asks_for() -> None:
    truth = vibrating()
    error, tracker = turned_off(truth)
    dt = tracker.options.knot_spacing_s
    assert dt is not None and dt < 0.01
    assert error < 0.03 and turned_off(truth, 0.025)[0] > 5.0 * error
    # What it cannot follow is told beforehand, and does not grow because images count for more where it is large.
    assert tracker.inertia is not None and tracker.inertia.sigma[0] < 3.0 * MotionBand.of(imu_of(truth)).scatter(dt)[0]


def test_a_method_without_imu_takes_no_notice_of_one_and_one_with_needs_it() -> None:
    rig = Rig(CAMERA, SHUTTER, CAMERA, SHUTTER, np.eye(4))
    with pytest.raises(UserError, match=r"rs-gi: needs an IMU"):
        Tracker(rig, Options(**OPTIONS))
    plain = Options(**OPTIONS | {"method": "rs-g"})
    trackers = [Tracker(rig, plain), Tracker(rig, plain, imu=imu_of())]
    for k in range(5):
        for tracker in trackers:
            tracker.feed(frame_at(k))
    np.testing.assert_array_equal(trackers[0].trajectory[1], trackers[1].trajectory[1])
    assert trackers[1].inertia is None


def test_an_accelerometer_alone_changes_nothing() -> None:
    """Without a gyroscope it is never sure enough of biases and gravity, and must not harm."""
    rig, alone = Rig(CAMERA, SHUTTER, CAMERA, SHUTTER, np.eye(4)), replace(imu_of(vibrating()), gyro=None)
    trackers = [Tracker(rig, Options(**OPTIONS | {"method": "rs-g"})), Tracker(rig, Options(**OPTIONS), imu=alone)]
    for k in range(8):
        for tracker in trackers:
            tracker.feed(frame_at(k))
    np.testing.assert_array_equal(trackers[0].trajectory[1], trackers[1].trajectory[1])


def test_a_run_says_what_it_found_and_resumes_to_the_same_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stream = {"readout_s": 0.02}
    config = synthetic.make_config(width=80, height=60, color=stream, depth=stream)
    synthetic.make_sequence(tmp_path / "seq", config, 16)
    dataset = open_dataset(tmp_path / "seq")
    assert dataset.truth is not None
    read = simulate_imu(dataset.truth, ImuConfig(gyroscope_bias=BIAS), dataset.truth.t_begin, dataset.truth.t_end, 2)
    write_imu_csv(dataset.root / "imu.csv", read)
    (dataset.root / "imu.yaml").write_text(f"{_NOISE}T_imu_depth: {np.eye(4).tolist()}\n")
    with_imu = open_dataset(dataset.root, imu_file=dataset.root / "imu.yaml")
    options = Options(**OPTIONS)
    with pytest.raises(UserError, match="has no IMU, which --method rs-gi needs: take rs-g"):
        track(dataset, options, tmp_path / "none")
    with pytest.raises(UserError, match="--gravity: method rs-g does not tell"):
        track(dataset, Options(method="rs-g"), tmp_path / "none", gravity=True)
    whole = track(with_imu, options, tmp_path / "whole")
    monkeypatch.setattr(checkpoint, "_EVERY_S", 0.0)
    monkeypatch.setattr(checkpoint, "_SHARE", np.inf)
    fed: list[object] = []

    def crash(*_: object) -> None:
        fed.append(None)
        if len(fed) > 11:
            raise RuntimeError("crashed")

    with pytest.raises(RuntimeError, match="crashed"):
        track(with_imu, options, tmp_path / "cut", progress=crash)
    track(with_imu, options, tmp_path / "cut", resume=True)
    for name in ("trajectory.txt", "spline.npz"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "cut" / name).read_bytes()
    info = json.loads((tmp_path / "cut" / "run.json").read_text())
    told = info["imu"]
    # Where it was described is said, and used of the run from then on.
    assert info["dataset"]["imu_file"] == str((dataset.root / "imu.yaml").resolve())
    files = open_dataset(dataset.root).as_seen_by(info).imu_files
    assert files is not None and files.given == (dataset.root / "imu.yaml").resolve()
    assert told == json.loads((tmp_path / "whole" / "run.json").read_text())["imu"]
    assert told["usable_s"] > 0.1 and np.linalg.norm(told["gravity"]) == pytest.approx(9.80665, abs=0.1)
    off = np.abs(np.array(told["gyro_bias"]) - BIAS) / told["gyro_bias_sigma"]
    assert (off < 3.0).all() and max(told["gyro_bias_sigma"]) < 5e-3
    turn = np.abs(told["T_imu_depth_turn"]) / told["T_imu_depth_turn_sigma"]
    assert (turn < 3.0).all() and told["T_imu_depth_is_contradicted"] is False
    assert "IMU: gravity known to" in whole.text() and "turned by" not in whole.text()
    track(with_imu, options, tmp_path / "up", gravity=True)
    level, world = (read_estimate(tmp_path / name) for name in ("up", "whole"))
    T = level.T_world_depth @ se3.inverse(world.T_world_depth)
    np.testing.assert_allclose(T, T[:1].repeat(len(T), 0), atol=1e-6)
    down = T[0, :3, :3] @ np.array(told["gravity"])
    np.testing.assert_allclose(down / np.linalg.norm(down), [0.0, 0.0, -1.0], atol=1e-6)


@pytest.mark.parametrize("gravity", [(0.0, 0.0, -9.8), (0.0, 0.0, 9.8), (1.0, -9.0, 3.0)])
def test_upright_points_gravity_down(gravity: tuple[float, float, float]) -> None:
    T = upright(np.array(gravity))
    down = T[:3, :3] @ gravity
    np.testing.assert_allclose(down, [0.0, 0.0, -np.linalg.norm(gravity)], atol=1e-12)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
