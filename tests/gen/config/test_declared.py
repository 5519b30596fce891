"""Sequences that declare wrong cameras: only what is said changes, and truth/cameras.yaml has what is true."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic
import tiny
import yaml

from rsgen.check.verify import verify_sequence
from rsgen.cli.main import main
from rsgen.config.config import Config, load_config
from rsgen.errors import UserError
from rsgen.formats.export.euroc import export_euroc
from rsgen.formats.export.kalibr import export_kalibr
from rsgen.formats.export.registered import export_registered
from rsgen.geometry import se3
from rsgen.sequence.camera_yaml import TRUE_CAMERAS
from rsgen.sequence.reader import read_sequence, sequence_info
from rstrack.data.dataset import open_dataset
from rstrack.data.rig import sigma_of_file
from rstrack.metrics.association import truth_of

T_WRONG = se3.exp(np.array([0.02, 0.0, -0.01, 0.0, 0.03, 0.0])) @ synthetic.T_COLOR_DEPTH
DECLARED: dict[str, Any] = {
    "color": {"readout_s": 0.010, "intrinsics": [50.0, 50.0, 31.0, 24.0]},
    "depth": {"readout_s": 0.020, "scan": "bottom-top", "depth_scale": 5100.0, "exposure_s": 0.003,
              "model": "radtan", "distortion": [0.05, 0.0, 0.0, 0.0]},
    "T_color_depth": T_WRONG.tolist(),
}  # fmt: skip


def config_with(declared: Any, **sections: Any) -> Config:
    said = {} if declared is None else {"faults": {"declared": declared}}
    return Config.model_validate(synthetic.make_config(color={"offset_s": 0.004}).model_dump() | said | sections)


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The same sequence as it is, and with wrong cameras declared."""
    folder = tmp_path_factory.mktemp("declared")
    return (
        synthetic.make_sequence(folder / "honest", config_with(None), 4),
        synthetic.make_sequence(folder / "wrong", config_with(DECLARED), 4),
    )


def test_only_what_is_said_differs(pair: tuple[Path, Path]) -> None:
    honest, wrong = (tiny.digests(root) for root in pair)
    assert wrong.keys() - honest.keys() == {TRUE_CAMERAS} and not honest.keys() - wrong.keys()
    assert {name for name in honest if honest[name] != wrong[name]} == {"sequence.yaml"}


def test_the_renderer_sees_nothing_of_what_is_declared(tmp_path: Path) -> None:
    declared = {"faults": {"declared": {"color": {"readout_s": 0.0}, "depth": {"readout_s": 0.05}}}}
    for name, sections in (("honest", {}), ("wrong", declared)):
        config = tiny.write_config(tmp_path, 4, name, **sections)
        assert main(["render", str(config), "--out", str(tmp_path / "out" / name), "--quiet"]) == 0
    honest, wrong = (tiny.digests(tmp_path / "out" / name) for name in ("honest", "wrong"))
    said = {"sequence.yaml", "rgb.txt", "depth.txt", "groundtruth.txt", TRUE_CAMERAS}  # the listings hold the name
    assert len(honest) > 10 and {name for name in wrong if honest.get(name) != wrong[name]} <= said
    assert verify_sequence(tmp_path / "out" / "wrong").ok


def test_readers_get_what_is_declared_and_the_truth_on_request(pair: tuple[Path, Path]) -> None:
    honest, wrong = (read_sequence(root) for root in pair)
    color, depth = wrong.streams["color"], wrong.streams["depth"]
    assert color.camera == replace(honest.streams["color"].camera, fx=50.0, fy=50.0, cx=31.0, cy=24.0)
    assert (color.shutter.readout_s, depth.shutter.readout_s, depth.shutter.exposure_s) == (0.010, 0.020, 0.003)
    assert (depth.shutter.scan, depth.depth_scale, depth.camera.model) == ("bottom-top", 5100.0, "radtan")
    np.testing.assert_array_equal(wrong.T_color_depth, T_WRONG)
    np.testing.assert_allclose(wrong.depth(1) * 5100.0, honest.depth(1) * 5000.0, rtol=1e-6)

    taken = wrong.as_taken
    for name in ("color", "depth"):
        mine, theirs = taken.streams[name], honest.streams[name]
        assert (mine.camera, mine.shutter, mine.depth_scale) == (theirs.camera, theirs.shutter, theirs.depth_scale)
    np.testing.assert_array_equal(taken.T_color_depth, honest.T_color_depth)
    assert taken.as_taken is taken and honest.as_taken is honest
    assert "truth/cameras.yaml" in sequence_info(pair[1]) and "claims" not in sequence_info(pair[0])


def test_a_tracker_gets_what_is_declared_and_the_truth_with_the_true_camera_file(pair: tuple[Path, Path]) -> None:
    honest, wrong = (open_dataset(root) for root in pair)
    assert wrong.rig.color_shutter.readout_s == 0.010 and wrong.rig.depth_shutter.readout_s == 0.020
    np.testing.assert_array_equal(wrong.rig.T_color_depth, T_WRONG)
    assert honest.rig.sigma.is_exact and wrong.rig.sigma == sigma_of_file(wrong.rig.color_camera)
    mended = open_dataset(pair[1], pair[1] / TRUE_CAMERAS)
    assert mended.rig.color_camera == honest.rig.color_camera and mended.rig.depth_camera == honest.rig.depth_camera
    assert mended.rig.color_shutter == honest.rig.color_shutter
    assert mended.rig.depth_shutter == honest.rig.depth_shutter
    np.testing.assert_allclose(mended.rig.T_color_depth, honest.rig.T_color_depth, atol=1e-15)
    np.testing.assert_array_equal(mended.color_stamps, honest.color_stamps)
    np.testing.assert_array_equal(mended.frame(2).depth.pixels, honest.frame(2).depth.pixels)
    # What an estimate is compared with does not depend on what was declared.
    truths = truth_of(honest), truth_of(wrong)
    assert truths[0] is not None and truths[1] is not None
    np.testing.assert_array_equal(truths[0].line_times, truths[1].line_times)


def test_the_truth_has_colours_clock_against_depths(tmp_path: Path) -> None:
    """Colour's listed stamps with the true offset and drift are what depth's driver would have listed."""
    clocks = {"color": {"offset_s": 0.008, "drift_ppm": 300.0}, "depth": {"offset_s": 0.030, "drift_ppm": -200.0}}
    config = config_with(None, faults={"declared": {}, **clocks}, color=synthetic.make_config().color.model_dump())
    root = synthetic.make_sequence(tmp_path / "seq", config, 20)
    dataset, sequence = open_dataset(root, root / TRUE_CAMERAS), read_sequence(root)
    true = sequence.streams["color"].stamps
    first = sequence.streams["depth"].stamps[0]
    np.testing.assert_allclose(dataset.color_stamps, true + 0.030 - 200e-6 * (true - first), atol=2e-9, rtol=0)
    assert np.abs(open_dataset(root).color_stamps - dataset.color_stamps).min() > 0.02


def test_registered_depth_keeps_its_sensor_in_the_truth(tmp_path: Path) -> None:
    config = config_with(DECLARED, depth=synthetic.make_config(depth={"registered": True}).depth.model_dump())
    writer = synthetic.open_writer(tmp_path / "seq", config, 2)
    z = np.ones((48, 64), np.float32)
    for k in range(2):
        writer.write_color(k, np.zeros((48, 64, 3), np.uint8))
        writer.write_depth(k, z, z)
    writer.finish()
    sequence = read_sequence(tmp_path / "seq")
    assert sequence.as_taken.streams["depth"].camera == config.depth.camera
    np.testing.assert_array_equal(sequence.as_taken.T_color_depth, synthetic.T_COLOR_DEPTH)
    rig = open_dataset(tmp_path / "seq", tmp_path / "seq" / TRUE_CAMERAS).rig
    assert rig.is_registered and rig.color_camera == config.color.camera


def test_exports_say_what_is_declared_and_their_poses_are_true(pair: tuple[Path, Path], tmp_path: Path) -> None:
    honest, wrong = (read_sequence(root) for root in pair)
    export_kalibr(wrong, tmp_path / "kalibr")
    cam0 = yaml.safe_load((tmp_path / "kalibr/camchain.yaml").read_text())["cam0"]
    assert cam0["line_delay"] == pytest.approx(0.010 / 48) and cam0["intrinsics"][0] == 50.0
    export_euroc(wrong, tmp_path / "wrong")
    export_euroc(honest, tmp_path / "honest")
    T_BS = yaml.safe_load((tmp_path / "wrong/mav0/cam0/sensor.yaml").read_text())["T_BS"]["data"]
    np.testing.assert_allclose(np.reshape(T_BS, (4, 4)), np.linalg.inv(T_WRONG), atol=1e-12)
    for sequence, name in ((wrong, "wrong"), (honest, "honest")):
        export_registered(sequence, tmp_path / name / "tum")
    assert open_dataset(tmp_path / "wrong/tum").rig.color_shutter.readout_s == 0.010
    for file in ("tum/groundtruth.txt", "mav0/state_groundtruth_estimate0/data.csv"):
        assert (tmp_path / "wrong" / file).read_bytes() == (tmp_path / "honest" / file).read_bytes()


def test_verify_goes_by_the_truth_and_finds_edits(pair: tuple[Path, Path], tmp_path: Path) -> None:
    report = verify_sequence(pair[1])
    assert report.ok, report.text()
    assert "true cameras" in report.text() and "true cameras" not in verify_sequence(pair[0]).text()
    text = (pair[1] / TRUE_CAMERAS).read_text()
    for old, new, found in (
        ("readout_s: 0.028", "readout_s: 0.02", "color.readout_s is 0.02, but config says 0.028"),
        ("depth_scale: 5000.0", "depth_scale: 5001.0", "depth.depth_scale is 5001.0, but config says 5000.0"),
    ):
        copy = tmp_path / found.split()[0]
        shutil.copytree(pair[1], copy)
        assert old in text
        (copy / TRUE_CAMERAS).write_text(text.replace(old, new, 1))
        assert found in verify_sequence(copy).text()
        (copy / TRUE_CAMERAS).unlink()
        assert "is missing, but sequence.yaml declares other cameras" in verify_sequence(copy).text()


def test_a_run_that_declares_something_else_is_another_sequence(pair: tuple[Path, Path]) -> None:
    with pytest.raises(UserError, match="declared"):
        synthetic.open_writer(pair[0], config_with(DECLARED), 4)
    with pytest.raises(UserError, match=r"faults\.declared\.color\.readout_s is 0\.01 there and 0\.011 now"):
        changed = DECLARED | {"color": DECLARED["color"] | {"readout_s": 0.011}}
        synthetic.open_writer(pair[1], config_with(changed), 4)


@pytest.mark.parametrize(
    ("declared", "complaint"),
    [
        ({"color": {"scan": "left-right"}}, "faults.declared.color.scan: left-right is across the true one"),
        ({"depth": {"model": "radtan"}}, "faults.declared.depth.* radtan takes 4 or 5 finite distortion coefficients"),
        ({"color": {"intrinsics": [-5, 5, 1, 1]}}, "faults.declared.color.* fx"),
        ({"depth": {"depth_scale": 0}}, "faults.declared.depth.*depth_scale: must lie in"),
        ({"color": {"readout_s": -1}}, "faults.declared.color.readout_s: must be 0 or lie in"),
        ({"color": {"offset_s": 0.01}}, "faults.declared.color.offset_s: no such field"),
        ({"color": {"distortion": [float("nan")] * 4, "model": "radtan"}}, "faults.declared.color.*distortion"),
    ],
)
def test_impossible_cameras_are_refused_in_one_line(declared: Any, complaint: str, tmp_path: Path) -> None:
    config = tiny.write_config(tmp_path, 2, faults={"declared": declared})
    with pytest.raises(UserError, match=complaint) as error:
        load_config(config)
    assert "\n" not in str(error.value)
