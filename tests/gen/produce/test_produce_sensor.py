"""Sequences as awkward as a real sensor's, made whole: motion, blur, noise, exact images, IMU, and their exports."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tiny
import yaml

from rsgen.check.verify import verify_sequence
from rsgen.cli.main import main
from rsgen.config.config import load_config
from rsgen.motion.statistics import motion_statistics
from rsgen.produce.parts import load_motion, open_frames
from rsgen.sequence.reader import read_sequence

MOTION = {
    "kind": "line", "length_m": 0.6, "mean_speed_m_s": 0.3, "mean_rotation_deg_s": 12.0, "strokes": 2, "ramp_s": 0.3,
    "position": [0.0, 0.0, -0.8], "target": [0.1, 0.1, 1.0], "shake_position_m": 0.002, "shake_rotation_deg": 0.3,
}  # fmt: skip
TRUTH = {"sharp": True, "global_shutter": ["middle"], "flow": ["global", "next"], "normals": True,
         "blur_length": True, "color_depth": True, "spp": 4}  # fmt: skip
RADTAN = {"model": "radtan", "distortion": [0.05, -0.12, 0.0008, -0.0006]}


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A line through the tiny room: both streams noisy, distorted, with their own clocks and exposures."""
    folder = tmp_path_factory.mktemp("sensor")
    path = tiny.write_config(
        folder,
        color=RADTAN | {"exposure_s": 0.012, "offset_s": 0.006, "noise": {"model": "camera"}},
        depth=RADTAN | {"rate_hz": 15.0, "readout_s": 0.02, "noise": {"model": "kinect"}},
        truth=TRUTH,
        imu={"rate_hz": 100.0},
        motion=MOTION,
    )
    text = yaml.safe_load(path.read_text())
    del text["trajectory"]
    path.write_text(yaml.safe_dump(text))
    return path


@pytest.fixture(scope="module")
def whole(config: Path) -> Path:
    out = config.parent / "whole"
    assert main(["render", str(config), "--out", str(out), "--frames", "0:8", "--quiet"]) == 0
    return out


def test_it_verifies(whole: Path) -> None:
    report = verify_sequence(whole)
    assert report.ok, report.text()
    assert "truth images" in report.text() and "imu" in report.text()


def test_the_motion_is_the_one_that_was_asked_for(config: Path) -> None:
    motion = load_motion(load_config(config))
    stats = motion_statistics(motion.spline, motion.first_stamp, motion.last_stamp)
    assert stats.length_m == pytest.approx(0.6, rel=0.02)
    assert stats.mean_speed_m_s == pytest.approx(0.3, rel=0.02)
    assert stats.mean_rotation_deg_s == pytest.approx(12.0, rel=0.02)


def test_clean_values_are_kept(whole: Path) -> None:
    sequence = read_sequence(whole)
    assert sequence.meta["noise"] == {"color": "camera", "depth": "kinect"}
    noisy, clean = sequence.color(3).astype(int), sequence.truth("color", 3).astype(int)
    assert 0.5 < np.abs(noisy - clean).std() < 30 and abs(np.median(noisy - clean)) < 10
    z, exact = sequence.depth(3), sequence.truth_depth(3)
    both = (z > 0) & (exact > 0)
    assert both.mean() > 0.3 and (z == 0).sum() > (exact == 0).sum()
    # Rounding to an eighth of a pixel of disparity, with 7.5 cm of baseline: a quarter of a step in the median.
    step = exact[both] ** 2 / (8 * 0.075 * 36.0)
    assert 0.15 < np.median(np.abs(z - exact)[both] / step) < 0.4


def test_a_second_run_is_the_same_bit_for_bit_whatever_came_first(config: Path, whole: Path, tmp_path: Path) -> None:
    for frames in ("5:8", "0:5"):
        assert main(["render", str(config), "--out", str(tmp_path / "seq"), "--frames", frames, "--quiet"]) == 0
    assert tiny.digests(tmp_path / "seq") == tiny.digests(whole)


def test_a_frame_without_one_of_its_images_is_rendered_again(config: Path, whole: Path) -> None:
    before = tiny.digests(whole)
    (whole / "truth/flow_next/000002.exr").unlink()
    report = verify_sequence(whole)
    assert not report.ok and "truth/flow_next/000002.exr" in report.text()
    assert main(["render", str(config), "--out", str(whole), "--frames", "0:8", "--quiet"]) == 0
    assert tiny.digests(whole) == before


def test_images_of_truth_are_those_of_their_frame(config: Path, whole: Path) -> None:
    sequence, loaded = read_sequence(whole), load_config(config)
    stamps = sequence.streams["color"].stamps
    shot = open_frames(loaded).color.expose(sequence.spline, float(stamps[4]), 4, float(stamps[5]))
    assert set(shot.truth) | {"color"} == set(sequence.truth_images)
    for name, image in shot.truth.items():
        np.testing.assert_array_equal(sequence.truth(name, 4), image)
    assert sequence.truth("flow_next", 4)[..., 2].mean() > 0.5
    assert 0.1 < np.median(sequence.truth("blur_length", 4)) < 5.0


def test_a_motion_that_meets_a_wall_is_refused(config: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    words = ["render", str(config), "--out", str(tmp_path / "seq"), "--motion.clearance_m", "3", "--quiet"]
    assert main(words) == 2
    error = capfd.readouterr().err
    assert error.count("\n") == 1 and "clearance_m" in error and not (tmp_path / "seq").exists()


@pytest.mark.parametrize(
    ("to", "made"),
    [("kalibr", "kalibr/camchain.yaml"), ("euroc", "mav0/imu0/data.csv"), ("registered", "registered/rgb.txt"),
     ("video", "shutter.mp4")],
)  # fmt: skip
def test_exports_by_command(whole: Path, capfd: pytest.CaptureFixture[str], to: str, made: str) -> None:
    assert main(["export", to, str(whole), "--quiet"]) == 0
    out = capfd.readouterr().out
    assert out.count("\n") == 1 and (whole / made).stat().st_size > 100
    assert main(["export", to, str(whole), "--quiet"]) == 2  # it is there already
    assert capfd.readouterr().err.count("\n") == 1


def test_motion_stats_by_command(config: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["motion", "stats", str(config)]) == 0
    table = capfd.readouterr().out.splitlines()
    assert len(table) == 2 and table[1].split()[:3] == ["tiny", "2.00", "0.600"]
