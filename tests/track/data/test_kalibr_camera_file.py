"""Kalibr's camera chains as camera files, and as what tells where the IMU sits."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic
import yaml

from rsgen.config.faults import FaultsConfig, ImuFaults
from rsgen.config.sections import ImuConfig
from rsgen.errors import UserError
from rsgen.formats.export.kalibr import export_kalibr
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.sequence.images import Sequence
from rsgen.sequence.reader import read_sequence
from rstrack.data.camera_file import RigFile, read_rig
from rstrack.data.dataset import open_dataset
from rstrack.data.imu.description import read_imu_yaml

SIZE = (64, 48)
T_IMU_DEPTH = se3.exp(np.array([0.006, -0.005, -0.012, 0.02, 0.01, -0.03]))
SHIFT_S = 0.013


def exported(folder: Path, color: dict[str, Any], depth: dict[str, Any]) -> tuple[Sequence, Path]:
    """A sequence with an IMU whose clock is SHIFT_S ahead, and its folder for Kalibr."""
    config = synthetic.make_config(color=color, depth=depth)
    imu = ImuConfig(T_imu_depth=T_IMU_DEPTH.tolist(), accelerometer_range=60.0)
    faults = FaultsConfig(imu=ImuFaults(clock_offset_s=SHIFT_S))
    writer = synthetic.open_writer(folder / "seq", config.model_copy(update={"imu": imu, "faults": faults}), 4)
    synthetic.write_frames(writer)
    synthetic.write_scene(folder / "seq")
    writer.finish()
    sequence = read_sequence(folder / "seq")
    export_kalibr(sequence, folder / "kalibr")
    return sequence, folder / "kalibr/camchain.yaml"


@pytest.mark.parametrize("scan", ["top-bottom", "bottom-top"])
@pytest.mark.parametrize(
    "lens",
    [
        {"model": "pinhole"},
        {"model": "radtan", "distortion": [-0.05, 0.02, 0.001, -0.002]},
        {"model": "fisheye", "distortion": [0.02, -0.01, 0.003, -0.001]},
        {"model": "double_sphere", "distortion": [0.1, 0.55]},
    ],
)
def test_what_rsgen_exports_comes_back(tmp_path: Path, lens: dict[str, Any], scan: str) -> None:
    """Each line of either stream is taken when it was: stamp and offset of the file against the shutter's own word."""
    sequence, path = exported(
        tmp_path,
        {**lens, "scan": scan, "exposure_s": 0.008, "readout_s": 0.02},
        {"readout_s": 0.012, "exposure_s": 0.004},
    )
    file = read_rig(path, SIZE, SIZE)
    rig, (color, depth) = file.rig, (sequence.streams["color"], sequence.streams["depth"])
    for found, stream in ((rig.color_camera, color), (rig.depth_camera, depth)):
        same = (found.width, found.height, found.fx, found.fy, found.cx, found.cy)
        camera = stream.camera
        assert same == (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        rays = np.array([[0.2, -0.1, 1.0], [-0.3, 0.25, 1.0]])
        np.testing.assert_allclose(found.project(rays)[0], camera.project(rays)[0], atol=1e-9)
    np.testing.assert_allclose(rig.T_color_depth, sequence.T_color_depth, atol=1e-9)
    assert rig.color_shutter.scan == scan and file.notes == () and file.scan_named and file.color_offset_s is not None
    lines = np.arange(48.0)
    true = [stream.shutter.line_mid_time(stream.stamps[2], lines, stream.camera) for stream in (color, depth)]
    told = [
        rig.color_shutter.line_mid_time(color.stamps[2] + file.color_offset_s, lines, rig.color_camera),
        rig.depth_shutter.line_mid_time(depth.stamps[2], lines, rig.depth_camera),
    ]
    late = told[1] - true[1]  # depth's clock is the one that counts: it is late by half an exposure
    np.testing.assert_allclose(late, 0.002, atol=1e-9)
    np.testing.assert_allclose(told[0] - true[0], 0.002, atol=1e-9)

    said = read_imu_yaml(path)
    assert said.source == "camchain.yaml" and said.noise is not None  # of the imu.yaml beside it
    np.testing.assert_allclose(said.extrinsics(np.eye(4)), T_IMU_DEPTH, atol=1e-9)
    # What is stamped t_true + SHIFT_S comes to depth's clock, by which an instant is named 0.002 s late.
    assert said.offset_s == pytest.approx(-SHIFT_S + 0.002, abs=1e-9)


def test_a_sequence_is_tracked_with_it(tmp_path: Path) -> None:
    sequence, path = exported(tmp_path, {"readout_s": 0.02}, {"readout_s": 0.02})
    dataset = open_dataset(tmp_path / "seq", path, path)
    assert dataset.rig.color_shutter.readout_s == pytest.approx(0.02)
    assert dataset.imu is not None and np.allclose(dataset.imu.T_imu_depth, T_IMU_DEPTH)
    assert dataset.frame(1).depth.pixels.shape == (48, 64) and sequence.name == dataset.name


CAM = {
    "camera_model": "pinhole", "intrinsics": [48.0, 49.0, 31.0, 23.0], "distortion_model": "radtan",
    "distortion_coeffs": [0.01, 0.0, 0.0, 0.0], "resolution": [64, 48], "cam_overlaps": [1],
}  # fmt: skip
T_10 = se3.exp(np.array([0.05, 0.002, -0.001, 0.01, -0.02, 0.003]))


def read(tmp_path: Path, data: dict[str, Any]) -> RigFile:
    path = tmp_path / "camchain-imucam.yaml"
    path.write_text(yaml.safe_dump(data))
    return read_rig(path, SIZE, SIZE)


def test_topics_tell_which_camera_is_which(tmp_path: Path) -> None:
    first, second = CAM | {"intrinsics": [40.0, 41.0, 30.0, 22.0]}, CAM | {"T_cn_cnm1": T_10.tolist()}
    plain = read(tmp_path, {"cam0": first, "cam1": second})
    assert plain.rig.color_camera.fx == 40.0 and plain.rig.depth_camera.fx == 48.0
    np.testing.assert_allclose(plain.rig.T_color_depth, se3.inverse(T_10), atol=1e-12)
    swapped = read(
        tmp_path,
        {"cam0": first | {"rostopic": "/camera/infra1/image"}, "cam1": second | {"rostopic": "/camera/color/image"}},
    )
    assert swapped.rig.color_camera.fx == 48.0 and swapped.rig.depth_camera.fx == 40.0
    np.testing.assert_allclose(swapped.rig.T_color_depth, T_10, atol=1e-12)
    # Nothing of the shutters, nor of the clock, is told: it is found, or asked for.
    assert len(plain.notes) == 2 and "calibrate" in plain.notes[0] and plain.color_offset_s is None
    assert not plain.scan_named and not plain.scale_named


def test_three_cameras_and_a_chain_that_is_broken(tmp_path: Path) -> None:
    T_20 = se3.exp(np.array([-0.02, 0.01, 0.0, 0.0, 0.1, 0.0]))
    T_imu = se3.exp(np.array([0.01, 0.02, 0.03, 0.1, 0.2, -0.3]))  # cam0 from the IMU
    cams = {
        "cam0": CAM | {"rostopic": "/left", "T_cam_imu": T_imu.tolist()},
        "cam1": CAM | {"rostopic": "/rgb/image", "T_cn_cnm1": T_10.tolist()},
        "cam2": CAM | {"rostopic": "/depth/image", "T_cam_imu": (T_20 @ T_imu).tolist()},
    }
    file = read(tmp_path, cams)
    np.testing.assert_allclose(file.rig.T_color_depth, T_10 @ se3.inverse(T_20), atol=1e-9)
    for cam in cams.values():
        cam["rostopic"] = "/x"
    with pytest.raises(UserError, match="which of cam0, cam1, cam2"):
        read(tmp_path, cams)


def test_one_camera_is_colours_with_registered_depth(tmp_path: Path) -> None:
    file = read(tmp_path, {"cam0": CAM | {"line_delay": 1e-4, "rostopic": "/camera/color/image"}})
    assert file.rig.is_registered and file.rig.depth_shutter.readout_s == pytest.approx(0.0048)
    assert file.rig.color_camera == Camera(64, 48, 48.0, 49.0, 31.0, 23.0, "radtan", (0.01, 0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"camera_model": "omni"}, "omni"),
        ({"distortion_model": "fov", "distortion_coeffs": [0.9]}, "'pinhole with fov' is not supported"),
        ({"intrinsics": [48.0, 49.0, 31.0]}, "cam0.intrinsics"),
        ({"intrinsics": [0.1, 0.5, 48.0, 49.0, 31.0, 23.0]}, "cam0.intrinsics"),
        ({"intrinsics": [48.0, -49.0, 31.0, 23.0]}, "cam0"),
        ({"intrinsics": [48.0, float("nan"), 31.0, 23.0]}, "cam0.intrinsics"),
        ({"resolution": [64]}, "cam0.resolution"),
        ({"resolution": [10**9, 48]}, "cam0.resolution"),
        ({"line_delay": 1.0}, "cam0.line_delay"),
        ({"timeshift_cam_imu": 1e300}, "cam0.timeshift_cam_imu"),
        ({"T_cam_imu": np.zeros((4, 4)).tolist()}, "cam0.T_cam_imu"),
        ({"distortion_coeffs": [0.1]}, "radtan takes"),
    ],
)
def test_what_is_wrong_is_one_line(tmp_path: Path, change: dict[str, Any], said: str) -> None:
    with pytest.raises(UserError) as caught:
        read(tmp_path, {"cam0": CAM | change})
    assert said in str(caught.value) and "camchain-imucam.yaml" in str(caught.value) and "\n" not in str(caught.value)
    with pytest.raises(UserError, match="T_cn_cnm1"):
        read(tmp_path, {"cam0": CAM, "cam1": CAM})
    with pytest.raises(UserError, match="T_cam_imu"):
        read_imu_yaml(_written(tmp_path, {"cam0": CAM}))


def _written(folder: Path, data: dict[str, Any]) -> Path:
    path = folder / "chain.yaml"
    path.write_text(yaml.safe_dump(data))
    return path
