"""Sequences of rsgen with a driver's stamps and registered depth, as the tracker gets them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny

from rsgen.cli.main import main
from rsgen.geometry import se3
from rsgen.sequence.reader import read_sequence
from rstrack.data.dataset import open_dataset
from rstrack.data.estimate import Estimate
from rstrack.data.layouts.generated import sigma_of
from rstrack.data.rig import DEFAULT_SIGMA
from rstrack.metrics.association import truth_of
from rstrack.metrics.evaluate import evaluate

T = se3.exp(np.array([-0.03, 0.002, 0.001, 0.01, -0.02, 0.005]))
FRAMES = 40
LATE = {"jitter_s": 0.0015, "grid_s": 0.004, "dropped": 0.05}
SENSOR = {"width": 64, "height": 48, "intrinsics": [52.0, 52.0, 31.5, 23.5], "registered": True}


@pytest.fixture(scope="module")
def wild(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wild")
    config = tiny.write_config(
        folder, FRAMES, color={"spp": 1}, depth=SENSOR, T_color_depth=T.tolist(),
        faults={"color": LATE | {"offset_s": 0.02}, "depth": LATE | {"offset_s": 0.04, "drift_ppm": 200.0}},
    )  # fmt: skip
    assert main(["render", str(config), "--out", str(folder / "seq"), "--quiet"]) == 0
    return folder / "seq"


def test_stamps_are_seen_as_arrival_times(wild: Path) -> None:
    dataset, sequence = open_dataset(wild), read_sequence(wild)
    timing = dataset.timing
    assert timing is not None and timing.is_jittered and timing.wants_color_offset
    for found, name in ((timing.depth, "depth"), (timing.color, "color")):
        stream = sequence.streams[name]  # type: ignore[index]
        assert found.clock.dropped == stream.indices[-1] - stream.indices[0] + 1 - len(stream.paths)
        np.testing.assert_array_equal(found.listed, stream.listed)
        # Straightened, they are late by a constant but for a fraction of the jitter.
        late = found.used - stream.stamps
        assert late.std() < 0.4 * (stream.listed - stream.stamps).std()
    assert np.mean(timing.color.used - sequence.streams["color"].stamps) == pytest.approx(0.02, abs=1e-3)


def test_registered_depth_has_the_colour_camera_and_its_sensors_lines(wild: Path) -> None:
    dataset, sequence = open_dataset(wild), read_sequence(wild)
    rig = dataset.rig
    assert rig.depth_camera == rig.color_camera and np.array_equal(rig.T_color_depth, np.eye(4))
    assert dataset.frame(3).depth.pixels.shape == (36, 48)
    # 36 px at a focal length of 36 px are 52 of the sensor's 48 lines: longer than its own readout.
    sensor = sequence.streams["depth"]
    expected = sensor.shutter.line_delay(sensor.camera) * 36 * 52 / 36
    assert rig.depth_shutter.readout_s == pytest.approx(expected, rel=0.03)


def test_truth_is_where_each_image_was_taken(wild: Path) -> None:
    dataset, sequence = open_dataset(wild), read_sequence(wild)
    truth = truth_of(dataset)
    assert truth is not None and dataset.truth is None and dataset.sequence is None
    depth = sequence.streams["depth"]
    late = dataset.timing.depth.used - depth.listed if dataset.timing else np.zeros(0)
    assert np.abs(late).max() < 0.01
    # A tracker that finds each image's own pose has no error, whatever the stamps say.
    shutter_late = float(np.mean(dataset.stamps - depth.listed))
    taken = np.maximum(depth.stamps + shutter_late, sequence.spline.t_begin)
    poses = sequence.spline.pose(taken) @ se3.inverse(T)
    metrics = evaluate(truth, Estimate(dataset.stamps, poses))
    assert metrics.poses_compared == len(depth.paths) and metrics.ate_rmse_m < 5e-4


def test_an_automatic_camera_alone_stays_an_exact_sequence(tmp_path: Path) -> None:
    config = tiny.write_config(tmp_path, 6, color={"exposure_s": 0.005, "auto_exposure": {}, "spp": 1})
    assert main(["render", str(config), "--out", str(tmp_path / "seq"), "--quiet"]) == 0
    dataset = open_dataset(tmp_path / "seq")
    assert dataset.truth is not None and dataset.sequence is not None and dataset.timing is None


def test_the_exported_folder_is_tracked_alike(wild: Path, tmp_path: Path) -> None:
    out = tmp_path / "tum"
    assert main(["export", "registered", str(wild), "--out", str(out), "--quiet"]) == 0
    exported, own = open_dataset(out), open_dataset(wild)
    assert exported.rig.depth_shutter == own.rig.depth_shutter and exported.rig.depth_camera == own.rig.depth_camera
    np.testing.assert_allclose(exported.stamps, own.stamps, atol=1e-9)
    assert exported.timing is not None and exported.timing.wants_color_offset
    np.testing.assert_array_equal(exported.frame(5).depth.pixels, own.frame(5).depth.pixels)


def test_a_depth_camera_with_fixed_errors_is_not_exact(wild: Path) -> None:
    sequence = read_sequence(wild)
    assert sigma_of(sequence).is_exact
    for name in ("scale_error", "distortion_px"):
        depth = sequence.meta["config"]["depth"] | {"noise": {"model": "kinect", name: 0.01}}
        faulty = replace(sequence, meta=sequence.meta | {"config": sequence.meta["config"] | {"depth": depth}})
        found = sigma_of(faulty)
        own = "depth_scale", "depth_inverse_offset", "depth_image"
        assert all(getattr(found, name) == getattr(DEFAULT_SIGMA, name) for name in own)
        assert replace(found, **dict.fromkeys(own, 0.0)).is_exact
