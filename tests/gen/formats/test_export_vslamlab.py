"""VSLAM-LAB's layout, stated here as its readers look for it, and the dataset class that makes it."""

from __future__ import annotations

import csv
import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest
import synthetic
import yaml
from exported import RADTAN, make_plain, with_color
from nightly import sampled

from rsgen.cli.main import main
from rsgen.errors import UserError
from rsgen.formats.export.vslamlab import export_vslamlab
from rsgen.geometry import se3
from rsgen.sequence.images import Sequence
from rsgen.sequence.reader import read_sequence
from rstrack.data.dataset import open_dataset

EXAMPLES = Path(__file__).parents[3] / "docs/examples/vslamlab"


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    return make_plain(tmp_path_factory.mktemp("plain"))


def rows_of(path: Path) -> tuple[list[str], list[list[str]]]:
    with path.open(newline="") as file:
        head, *rows = csv.reader(file)
    return head, rows


def camera_of(path: Path) -> dict[str, Any]:
    text = path.read_text()
    assert text.startswith("%YAML 1.2\n---\n")
    (camera,) = yaml.safe_load(text)["cameras"]
    return dict(camera)


def test_the_folder_holds_what_vslam_lab_reads(plain: Sequence, tmp_path: Path) -> None:
    out = tmp_path / "RSGEN/plain"
    export_vslamlab(plain, out)
    color, depth = plain.streams["color"], plain.streams["depth"]
    head, rows = rows_of(out / "rgb.csv")
    assert head == ["ts_rgb_0 (ns)", "path_rgb_0", "ts_depth_0 (ns)", "path_depth_0"]
    assert [int(row[0]) for row in rows] == [round(1e9 * t) for t in color.stamps]
    for row, path in zip(rows, color.paths, strict=True):
        assert row[1] == f"rgb_0/{path.name}" and (out / row[1]).read_bytes() == path.read_bytes()
        z = cv2.imread(str(out / row[3]), cv2.IMREAD_UNCHANGED)
        assert z.dtype == np.uint16 and z.shape == (color.camera.height, color.camera.width)
        nearest = np.abs(depth.stamps - int(row[0]) / 1e9).argmin()
        assert int(row[2]) == round(1e9 * depth.stamps[nearest]) and (z > 0).mean() > 0.5

    head, rows = rows_of(out / "groundtruth.csv")
    assert head == ["ts (ns)", "tx (m)", "ty (m)", "tz (m)", "qx", "qy", "qz", "qw"]
    values = np.array(rows, float)
    assert {round(1e9 * t) for t in color.stamps} <= {int(row[0]) for row in rows}
    T = se3.from_quat_trans(values[:, 4:], values[:, 1:4])
    T_true = plain.spline.pose(values[:, 0] / 1e9) @ se3.inverse(synthetic.T_COLOR_DEPTH)
    np.testing.assert_allclose(T, T_true, atol=1e-8)

    camera = camera_of(out / "calibration.yaml")
    assert camera["cam_name"] == "rgb_0" and camera["depth_name"] == "depth_0" and camera["cam_model"] == "pinhole"
    assert camera["focal_length"] + camera["principal_point"] == [color.camera.fx, color.camera.fy, 31.5, 23.5]
    assert camera["image_dimension"] == [64, 48] and camera["fps"] == 30.0 and camera["depth_factor"] == 5000.0
    np.testing.assert_array_equal(np.reshape(camera["T_BS"], (4, 4)), np.eye(4))


@pytest.mark.parametrize(
    ("model", "distortion", "name"),
    [
        ("radtan", [0.1, -0.05, 0.001, 0.002], "radtan4"),
        ("radtan", [0.1, -0.05, 0.001, 0.002, 0.01], "radtan5"),
        ("fisheye", [0.01, 0.02, 0.0, 0.001], "equid4"),
    ],
)
def test_lenses_have_vslam_labs_names(
    model: str, distortion: list[float], name: str, plain: Sequence, tmp_path: Path
) -> None:
    camera = synthetic.make_config(color={"model": model, "distortion": distortion}).color.camera
    export_vslamlab(with_color(plain, camera=camera), tmp_path / "out")
    found = camera_of(tmp_path / "out/calibration.yaml")
    assert (found["distortion_type"], found["distortion_coefficients"]) == (name, distortion)


def test_a_lens_without_a_name_is_refused_before_anything_is_written(plain: Sequence, tmp_path: Path) -> None:
    camera = synthetic.make_config(color={"model": "double_sphere", "distortion": [0.1, 0.5]}).color.camera
    with pytest.raises(UserError, match="VSLAM-LAB has no double_sphere lens"):
        export_vslamlab(with_color(plain, camera=camera), tmp_path / "out")
    assert not (tmp_path / "out").exists()


# --- the dataset and the baseline ------------------------------------------------------------------------------------


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class StandIn:
    """What both of VSLAM-LAB's base classes set that the examples use."""

    def __init__(self, name: str, place: Path | str, parameters: object = None) -> None:
        self.dataset_path, self.baseline_path = Path(place) / name.upper(), Path(place)
        self.yaml_file, self.parameters = EXAMPLES / f"dataset_{name}.yaml", parameters
        self.sequence_names = yaml.safe_load(self.yaml_file.read_text())["sequence_names"] if parameters is None else []


def test_the_dataset_class_exports_into_the_benchmarks_folder(
    plain: Sequence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = ModuleType("Datasets.DatasetVSLAMLab")
    module.DatasetVSLAMLab = StandIn  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "Datasets", ModuleType("Datasets"))
    monkeypatch.setitem(sys.modules, "Datasets.DatasetVSLAMLab", module)
    monkeypatch.setattr(subprocess, "run", lambda words, check: main([*map(str, words[1:])]))
    dataset = load("dataset_rsgen").RSGEN_dataset(tmp_path)
    assert dataset.sequence_names == ["demo"] and dataset.depth_factor == 5000.0
    dataset.sequences_root = plain.root.parent
    dataset.dataset_path.mkdir()
    dataset.download_sequence_data(plain.root.name)
    for name in ("rgb_0", "depth_0", "rgb.csv", "calibration.yaml", "groundtruth.csv"):
        assert (tmp_path / "RSGEN" / plain.root.name / name).exists()


def test_the_baseline_names_its_script_and_modes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType("Baselines.BaselineVSLAMLab")
    module.BaselineVSLAMLab = StandIn  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "Baselines", ModuleType("Baselines"))
    monkeypatch.setitem(sys.modules, "Baselines.BaselineVSLAMLab", module)
    baseline = load("baseline_rstrack").RSTRACK_baseline("rstrack", str(tmp_path))
    assert baseline.parameters["mode"] == "rgbd" in baseline.modes and not baseline.is_installed()[0]
    (tmp_path / "vslamlab_rstrack_rgbd.py").touch()
    assert baseline.is_installed()[0]


@pytest.mark.parametrize("rows_are_known", sampled([True, False], 2))
def test_the_baselines_script_tracks_what_an_experiment_lists(rows_are_known: bool, tmp_path: Path) -> None:
    root = synthetic.make_sequence(tmp_path / "seq", synthetic.make_config(160, 120), frames=8)
    sequence = tmp_path / "benchmark"
    export_vslamlab(read_sequence(root), sequence)
    if not rows_are_known:
        (sequence / "camera.yaml").unlink()
    listed = (sequence / "rgb.csv").read_text().splitlines()
    (tmp_path / "exp").mkdir()
    (tmp_path / "exp/rgb_exp.csv").write_text("\n".join(listed[:7]) + "\n")
    words = [
        "--sequence_path", sequence, "--calibration_yaml", sequence / "calibration.yaml", "--exp_it", "3",
        "--rgb_csv", tmp_path / "exp/rgb_exp.csv", "--exp_folder", tmp_path / "exp", "--verbose", "1",
        "--settings_yaml", "none.yaml", "--mode", "rgbd", "--method", "rs-g" if rows_are_known else "gs-g",
    ]  # fmt: skip
    assert load("vslamlab_rstrack_rgbd").main([*map(str, words)]) == 0
    head, rows = rows_of(tmp_path / "exp/00003_KeyFrameTrajectory.csv")
    assert head == ["ts (ns)", "tx (m)", "ty (m)", "tz (m)", "qx", "qy", "qz", "qw"]
    assert [int(row[0]) for row in rows] == [int(line.split(",")[0]) for line in listed[1:7]]
    values = np.array(rows, float)
    T = se3.from_quat_trans(values[:, 4:], values[:, 1:4])
    T_true = synthetic.make_spline().pose(values[:, 0] / 1e9) @ se3.inverse(synthetic.T_COLOR_DEPTH)
    off = se3.inverse(se3.inverse(T_true[0]) @ T_true) @ (se3.inverse(T[0]) @ T)
    assert np.linalg.norm(off[:, :3, 3], axis=1).max() < (0.02 if rows_are_known else 0.1)


def test_without_rows_times_the_calibration_is_read(plain: Sequence, tmp_path: Path) -> None:
    camera = synthetic.make_config(color=RADTAN).color.camera
    sequence, folder = tmp_path / "seq", tmp_path / "folder"
    export_vslamlab(with_color(plain, camera=camera), sequence)
    (sequence / "camera.yaml").unlink()
    make = load("vslamlab_rstrack_rgbd").make_folder
    make(sequence, sequence / "rgb.csv", sequence / "calibration.yaml", folder)
    rig = open_dataset(folder).rig
    assert rig.color_camera == rig.depth_camera == camera and rig.color_shutter.readout_s == 0.0
