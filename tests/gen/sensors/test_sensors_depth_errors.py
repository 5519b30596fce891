"""A depth camera's lasting faults and its exposure's blur, against their formulas; registered depth in a sequence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tiny
import yaml
from pydantic import ValidationError

from rsgen.check.verify import verify_sequence
from rsgen.cli.main import main
from rsgen.config.cameras import DepthConfig, DepthNoiseConfig
from rsgen.config.config import load_config
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.produce.parts import open_frames
from rsgen.sensors.depth import disparity_error, mixed_depth, with_fixed_errors
from rsgen.sequence.reader import read_sequence
from rsgen.sequence.trajectory import read_trajectory

CAMERA = Camera(320, 240, 285.0, 285.0, 159.5, 119.5)
BF = 0.075 * 285.0


def flat(z: float) -> np.ndarray:
    return np.full((240, 320), z, np.float32)


def faulty(z: np.ndarray, seed: int = 3, **settings: float) -> np.ndarray:
    return with_fixed_errors(z, CAMERA, DepthNoiseConfig.model_validate({"model": "kinect"} | settings), seed)


def test_a_camera_without_faults_and_what_is_missing_stay() -> None:
    z = flat(2.0)
    assert faulty(z) is z
    z[5, 7] = 0
    assert (faulty(z, distortion_px=0.5, scale_error=0.1) == 0).sum() == 1


def test_scale_is_relative() -> None:
    assert faulty(flat(2.0), scale_error=0.02) == pytest.approx(2.04)


def test_errors_of_the_disparity_grow_with_the_square_of_the_distance_and_stay_the_same() -> None:
    errors = [(faulty(flat(z), distortion_px=0.05, pattern_px=0.02) - z) / z**2 for z in (0.5, 1.0, 2.0)]
    expected = -disparity_error(320, 240, 0.05, 320.0, 0.02, 3) / BF
    for error, z in zip(errors, (0.5, 1.0, 2.0), strict=True):
        # The second order of 1/d: 4 sigma of the error against the disparity.
        assert np.abs(error - expected).max() < np.abs(expected).max() * 0.22 * z / BF * 4
    assert errors[1].std() == pytest.approx(np.hypot(0.05, 0.02) / BF, rel=0.02)
    assert np.array_equal(faulty(flat(1.0), pattern_px=0.1), faulty(flat(1.0), pattern_px=0.1))
    assert not np.array_equal(faulty(flat(1.0), pattern_px=0.1), faulty(flat(1.0), pattern_px=0.1, seed=4))


def test_bends_are_smooth_as_wide_as_asked_and_the_pattern_is_white() -> None:
    bends, pattern = disparity_error(640, 480, 1.0, 200.0, 0.0, 1), disparity_error(640, 480, 0.0, 200.0, 1.0, 1)
    for field in (bends, pattern):
        assert field.std() == pytest.approx(1.0, rel=1e-3) and abs(field.mean()) < 1e-3
    # A wave of 200 px and RMS 1 has slopes of 2 pi / 200 RMS.
    slope = np.diff(bends, axis=1).std()
    assert 0.4 < slope / (2 * np.pi / 200) < 1.6
    assert np.diff(pattern, axis=1).std() == pytest.approx(np.sqrt(2), rel=0.02)
    crossings = (np.diff(np.sign(bends), axis=1) != 0).sum(1).mean()
    assert 2 < crossings < 10  # 640 px hold 3.2 periods: about six


def test_a_moving_surface_is_seen_at_its_mean_disparity() -> None:
    depths = np.array([1.0, 1.01, 1.02], np.float32)
    mixed = mixed_depth([flat(z) for z in depths], flying=False)
    assert mixed == pytest.approx(1 / np.mean(1 / depths.astype(float)), rel=1e-6)


def test_an_edge_that_moves_shows_the_surface_of_the_longer_time_or_for_light_that_flies_both() -> None:
    samples = [np.where(np.arange(320) < 100 + 4 * k, np.float32(1), np.float32(2)) * np.ones((240, 1), "f4")
               for k in range(5)]  # fmt: skip
    sharp, flying = mixed_depth(samples, flying=False), mixed_depth(samples, flying=True)
    assert set(np.unique(sharp)) == {1.0, 2.0} and (sharp[0] == np.where(np.arange(320) < 108, 1, 2)).all()
    assert flying[0, 101] == pytest.approx((2 + 4 * 1) / 5) and flying[0, 110] == pytest.approx((1 * 2 + 3 * 2) / 5)


def test_what_is_missing_most_of_the_time_is_missing() -> None:
    seen, nothing = flat(1.5), flat(0.0)
    assert (mixed_depth([nothing, nothing, seen], flying=False) == 0).all()
    assert mixed_depth([nothing, seen, seen], flying=False) == pytest.approx(1.5)
    assert mixed_depth([nothing, nothing, seen], flying=True) == pytest.approx(1.5)
    assert (mixed_depth([nothing] * 3, flying=True) == 0).all()


def test_mixing_without_an_exposure_is_refused() -> None:
    with pytest.raises(ValidationError, match="exposure_s must be above 0"):
        DepthConfig(blur_samples=3)


# --- whole sequences

T = se3.exp(np.array([-0.03, 0.002, 0.001, 0.01, -0.02, 0.005]))
SENSOR = {"width": 64, "height": 48, "intrinsics": [52.0, 52.0, 31.5, 23.5], "exposure_s": 0.02, "blur_samples": 5}


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("registered")
    return tiny.write_config(folder, 4, depth=SENSOR | {"registered": True}, T_color_depth=T.tolist(),
                             truth={"color_depth": True})  # fmt: skip


@pytest.fixture(scope="module")
def whole(config: Path) -> Path:
    out = config.parent / "whole"
    assert main(["render", str(config), "--out", str(out), "--quiet"]) == 0
    return out


def test_registered_depth_verifies_and_keeps_the_sensors_truth(whole: Path) -> None:
    report = verify_sequence(whole)
    assert report.ok, report.text()
    sequence = read_sequence(whole)
    assert sequence.depth(1).shape == (36, 48) and sequence.truth_depth(1).shape == (48, 64)
    assert sequence.rows("depth").shape == (4, 48, 7)
    truth = read_trajectory(whole / "groundtruth.txt")
    expected = sequence.spline.pose(truth.stamps) @ se3.inverse(T)
    assert np.abs(truth.T_world_cam - expected).max() < 1e-8
    assert main(["preview", str(whole), "--out", str(whole.parent / "p.png")]) == 0


def test_it_is_what_the_colour_camera_sees(whole: Path) -> None:
    sequence = read_sequence(whole)
    z, seen = sequence.depth(2), sequence.truth("color_depth", 2)
    filled = z > 0
    # The colour camera's own depth at about the same time: 0.3 m/s, 0.3 rad/s, and edges a pixel off.
    assert filled.mean() > 0.8 and np.median(np.abs(z - seen)[filled]) < 0.01


def test_blur_of_depth_is_that_of_its_exposure(config: Path, whole: Path) -> None:
    spline, stamp = read_sequence(whole).spline, 2 / 30
    shot = open_frames(load_config(config)).depth.expose(spline, stamp, 2)
    assert shot.blurred is not None
    sharp = open_frames(load_config(config, {"depth.exposure_s": "0", "depth.blur_samples": "1"}))
    samples = [sharp.depth.exact(spline, stamp - 0.02 + 0.004 * (k + 0.5)) for k in range(5)]
    np.testing.assert_allclose(samples[2], shot.z, rtol=1e-6)
    expected = 1 / np.mean([1 / z.astype(float) for z in samples], axis=0)
    assert np.isclose(shot.blurred, expected, rtol=1e-5).mean() > 0.99  # the rest are edges
    assert np.ptp(samples, axis=0).max() > 2e-3


def test_the_export_links_it_and_tells_the_sensor(whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "tum"
    assert main(["export", "registered", str(whole), "--out", str(out), "--quiet"]) == 0
    assert (out / "depth/000002.png").read_bytes() == (whole / "depth/000002.png").read_bytes()
    text = (out / "camera.yaml").read_text()
    assert "registered: true" in text and "stamps: raw" in text and "T_color_sensor" in text
    assert main(["export", "euroc", str(whole), "--out", str(tmp_path / "e"), "--quiet"]) == 0
    described = yaml.safe_load((tmp_path / "e/mav0/depth0/sensor.yaml").read_text())
    assert described["resolution"] == [48, 36]
