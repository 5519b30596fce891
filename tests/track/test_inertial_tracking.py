"""The tracker with an IMU: blackouts are bridged, runs resume to the same bits, and what a run says of the unit."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic

from rsgen.config.imu import ImuConfig
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.sensors.imu import simulate_imu, write_imu_csv
from rstrack.data.dataset import open_dataset
from rstrack.data.estimate import read_estimate
from rstrack.data.imu.recording import ImuNoise, ImuRecording
from rstrack.data.rig import Frame, Image, Rig
from rstrack.inertial.record import upright
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


def imu_of(gravity: tuple[float, float, float] = (0.0, -9.80665, 0.0)) -> ImuRecording:
    config = ImuConfig(
        gravity=gravity, gyroscope_noise_density=7e-5, accelerometer_noise_density=1e-3, gyroscope_bias=BIAS,
        gyroscope_random_walk=1e-5, accelerometer_random_walk=1e-4, accelerometer_bias=(0.1, -0.07, 0.05),
    )  # fmt: skip
    read = simulate_imu(TRUTH, config, TRUTH.t_begin, TRUTH.t_end, 1)
    return ImuRecording(read.t, read.gyro, read.accel, ImuNoise(7e-5, 1e-5, 1e-3, 1e-4), np.eye(4), 200.0)


def frame_at(k: int, dark: bool = False) -> Frame:
    depth = synthetic.render_depth(TRUTH, CAMERA, SHUTTER, k / 30.0)
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


def test_a_run_says_what_it_found_and_resumes_to_the_same_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stream = {"readout_s": 0.02}
    config = synthetic.make_config(width=80, height=60, color=stream, depth=stream)
    synthetic.make_sequence(tmp_path / "seq", config, 16)
    dataset = open_dataset(tmp_path / "seq")
    assert dataset.truth is not None
    read = simulate_imu(dataset.truth, ImuConfig(gyroscope_bias=BIAS), dataset.truth.t_begin, dataset.truth.t_end, 2)
    write_imu_csv(dataset.root / "imu.csv", read)
    (dataset.root / "imu.yaml").write_text(f"{_NOISE}T_imu_depth: {np.eye(4).tolist()}\n")
    with_imu = open_dataset(dataset.root)
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
    told = json.loads((tmp_path / "cut" / "run.json").read_text())["imu"]
    assert told == json.loads((tmp_path / "whole" / "run.json").read_text())["imu"]
    assert told["usable_s"] > 0.1 and np.linalg.norm(told["gravity"]) == pytest.approx(9.80665, abs=0.1)
    off = np.abs(np.array(told["gyro_bias"]) - BIAS) / told["gyro_bias_sigma"]
    assert (off < 3.0).all() and max(told["gyro_bias_sigma"]) < 5e-3
    assert "IMU: gravity known to" in whole.text()
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
