"""Kalibr's and EuRoC's folders and registered depth, read back by evo, rstrack or by hand, against closed forms."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic
from evo.tools import file_interface
from exported import EPOCH_NS, IMU, RADTAN, T_IMU_DEPTH, load, make_plain, with_color, with_imu
from scipy.spatial.transform import Rotation
from shutter_reference import line_window

from rsgen.errors import UserError
from rsgen.formats.export.euroc import export_euroc
from rsgen.formats.export.kalibr import export_kalibr, row_clock
from rsgen.formats.export.registered import export_registered
from rsgen.formats.export.shared import ExportOptions
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Scan, Shutter
from rsgen.geometry.spline import Spline
from rsgen.sensors.depth import register_depth
from rsgen.sequence.format import STREAMS
from rsgen.sequence.images import Sequence
from rsgen.sequence.reader import read_sequence
from rsgen.sequence.trajectory import read_trajectory
from rstrack.data.dataset import open_dataset


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    return make_plain(tmp_path_factory.mktemp("plain"))


@pytest.fixture(scope="module")
def sequence(plain: Sequence) -> Sequence:
    """The same with an IMU."""
    return with_imu(plain, IMU)


# --- Kalibr ----------------------------------------------------------------------------------------------------------


def test_kalibr_files_hold_what_its_reader_demands(sequence: Sequence, tmp_path: Path) -> None:
    message = export_kalibr(sequence, tmp_path / "kalibr")
    assert "camchain.yaml, imu.yaml" in message
    chain, imu = load(tmp_path / "kalibr/camchain.yaml"), load(tmp_path / "kalibr/imu.yaml")
    assert list(chain) == ["cam0", "cam1"]
    for cam, name in zip(chain.values(), STREAMS, strict=True):
        camera = sequence.streams[name].camera
        # Kalibr's own checks: types, counts, signs (kalibr_common/ConfigReader.py).
        assert cam["camera_model"] == "pinhole" and cam["distortion_model"] == "radtan"
        assert all(type(value) is float and value >= 0 for value in cam["intrinsics"])
        assert cam["intrinsics"] == [camera.fx, camera.fy, camera.cx, camera.cy]
        assert len(cam["distortion_coeffs"]) == 4
        assert cam["resolution"] == [camera.width, camera.height] and isinstance(cam["rostopic"], str)
    assert chain["cam0"]["distortion_coeffs"] == RADTAN["distortion"]
    assert chain["cam0"]["line_delay"] == pytest.approx(0.028 / 48, rel=1e-12)
    assert chain["cam1"]["line_delay"] == pytest.approx(0.02 / 48, rel=1e-12)
    assert chain["cam0"]["timeshift_cam_imu"] == -0.005 and chain["cam1"]["timeshift_cam_imu"] == 0.0
    assert imu["update_rate"] == 100.0 and imu["gyroscope_noise_density"] == 1.6968e-4
    assert imu["accelerometer_random_walk"] == 3e-3 and imu["rostopic"] == "/imu0"
    assert imu["accelerometer_noise_density"] == 2e-3 and imu["gyroscope_random_walk"] == 1.9393e-5


def test_kalibrs_chain_of_transforms_closes(sequence: Sequence, tmp_path: Path) -> None:
    export_kalibr(sequence, tmp_path / "kalibr")
    cam0, cam1 = load(tmp_path / "kalibr/camchain.yaml").values()
    T_1_0, T_0_imu, T_1_imu = (np.array(m) for m in (cam1["T_cn_cnm1"], cam0["T_cam_imu"], cam1["T_cam_imu"]))
    np.testing.assert_allclose(T_1_0 @ T_0_imu, T_1_imu, atol=1e-12)
    np.testing.assert_allclose(T_1_imu @ T_IMU_DEPTH, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(T_1_0 @ synthetic.T_COLOR_DEPTH, np.eye(4), atol=1e-12)


@pytest.mark.parametrize("scan", ["top-bottom", "bottom-top"])
def test_kalibrs_two_numbers_give_every_rows_time(scan: Scan) -> None:
    camera, shutter = Camera(64, 48, 50, 50, 31.5, 23.5), Shutter(0.028, 0.01, scan)
    first_s, delay_s = row_clock("color", camera, shutter)
    for v in (0, 1, 20, 47):
        start, end = line_window(shutter, 3.0, shutter.line_of_pixel([5, v], camera), camera)
        assert 3.0 + first_s + v * delay_s == pytest.approx((start + end) / 2, abs=1e-15)
    assert (delay_s < 0) == (scan == "bottom-top")


def test_kalibr_without_an_imu(plain: Sequence, tmp_path: Path) -> None:
    assert "no IMU" in export_kalibr(plain, tmp_path / "kalibr")
    assert [path.name for path in (tmp_path / "kalibr").iterdir()] == ["camchain.yaml"]
    assert "T_cam_imu" not in load(tmp_path / "kalibr/camchain.yaml")["cam0"]


def test_a_fisheye_is_called_equidistant_and_zero_noise_is_pointed_out(sequence: Sequence, tmp_path: Path) -> None:
    camera = Camera(64, 48, 40, 40, 31.5, 23.5, "fisheye", (0.1, 0.02, 0.0, 0.001))
    silent = with_imu(with_color(sequence, camera=camera), {"gyroscope_random_walk": 0})
    assert "gyroscope_random_walk of 0" in export_kalibr(silent, tmp_path / "kalibr")
    cam0 = load(tmp_path / "kalibr/camchain.yaml")["cam0"]
    assert cam0["distortion_model"] == "equidistant" and cam0["distortion_coeffs"] == [0.1, 0.02, 0.0, 0.001]


def test_a_double_sphere_is_kalibrs_ds_and_not_eurocs(plain: Sequence, tmp_path: Path) -> None:
    camera = Camera(64, 48, 40, 41, 31.5, 23.5, "double_sphere", (-0.2, 0.6))
    export_kalibr(with_color(plain, camera=camera), tmp_path / "kalibr")
    cam0 = load(tmp_path / "kalibr/camchain.yaml")["cam0"]
    assert (cam0["camera_model"], cam0["distortion_model"], cam0["distortion_coeffs"]) == ("ds", "none", [])
    assert cam0["intrinsics"] == [-0.2, 0.6, 40, 41, 31.5, 23.5]  # as Kalibr has them: xi alpha fu fv pu pv
    with pytest.raises(UserError, match="EuRoC has no double_sphere lens"):
        export_euroc(with_color(plain, camera=camera), tmp_path / "euroc")


# --- EuRoC -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def mav0(sequence: Sequence, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("euroc")
    assert str(out / "mav0") in export_euroc(sequence, out)
    return out / "mav0"


def matrix(data: dict[str, Any]) -> np.ndarray:
    assert (data["rows"], data["cols"], len(data["data"])) == (4, 4, 16)
    return np.array(data["data"]).reshape(4, 4)


def times(trajectory: Any) -> np.ndarray:
    """evo's stamps without the epoch; seconds since one of 1e9 s are 0.12 microseconds apart in a float64."""
    return np.round(np.asarray(trajectory.timestamps) - 1e9, 6)


def test_euroc_images_are_the_same_files_named_by_stamp(sequence: Sequence, mav0: Path) -> None:
    for name, stream in (("cam0", sequence.streams["color"]), ("depth0", sequence.streams["depth"])):
        header, *lines = (mav0 / name / "data.csv").read_text().splitlines()
        assert header == "#timestamp [ns],filename"
        assert len(lines) == len(stream.paths) == len(list((mav0 / name / "data").iterdir()))
        for line, stamp, path in zip(lines, stream.stamps, stream.paths, strict=True):
            ns, file = line.split(",")
            assert file == f"{ns}.png" and len(ns) == 19
            assert int(ns) - EPOCH_NS == round(stamp * 1e9)
            assert (mav0 / name / "data" / file).samefile(path)
        assert lines == sorted(lines)


def test_evo_reads_eurocs_ground_truth(sequence: Sequence, mav0: Path) -> None:
    trajectory = file_interface.read_euroc_csv_trajectory(str(mav0 / "state_groundtruth_estimate0/data.csv"))
    valid, details = trajectory.check()
    assert valid, details
    t = times(trajectory)
    assert len(t) == 151
    T = sequence.spline.pose(t) @ np.linalg.inv(T_IMU_DEPTH)
    np.testing.assert_allclose(np.array(trajectory.poses_se3), T, atol=1e-9)
    # Our own reader knows the file for what it is.
    np.testing.assert_allclose(read_trajectory(mav0 / "state_groundtruth_estimate0/data.csv").T_world_cam, T, atol=1e-9)


def test_eurocs_state_is_consistent_with_its_imu(sequence: Sequence, mav0: Path) -> None:
    truth = np.loadtxt(mav0 / "state_groundtruth_estimate0/data.csv", delimiter=",")
    header = (mav0 / "imu0/data.csv").read_text().splitlines()[0]
    assert header.startswith("#timestamp [ns],w_RS_S_x [rad s^-1],") and header.endswith(",a_RS_S_z [m s^-2]")
    imu = np.loadtxt(mav0 / "imu0/data.csv", delimiter=",")
    np.testing.assert_array_equal(truth[:, 0], imu[:, 0])
    dt = 0.01
    # Simpson's rule: the step in position is the integral of the velocity; off at knots by jumps of the jerk.
    p, v = truth[:, 1:4], truth[:, 8:11]
    np.testing.assert_allclose(p[2:] - p[:-2], dt / 3 * (v[2:] + 4 * v[1:-1] + v[:-2]), atol=2e-6)
    # Readings less bias, turned into the world, are the acceleration less gravity, but for 0.02 m/s² of white noise.
    R = Rotation.from_quat(truth[:, [5, 6, 7, 4]])
    force = R.apply(imu[:, 4:7] - truth[:, 14:17])[1:-1]
    expected = (v[2:] - v[:-2]) / (2 * dt) + [0, 9.80665, 0]
    assert np.abs(force - expected).max() < 5 * 0.02 + 0.1
    turn = (R[:-2].inv() * R[2:]).as_rotvec() / (2 * dt)
    assert np.abs(imu[1:-1, 1:4] - truth[1:-1, 11:14] - turn).max() < 5 * 1.7e-3 + 5e-3
    np.testing.assert_allclose(truth[0, 11:], IMU["gyroscope_bias"] + IMU["accelerometer_bias"], atol=1e-12)


def test_eurocs_sensors_stand_where_they_are(sequence: Sequence, mav0: Path) -> None:
    stamp = sequence.streams["color"].stamps[2]
    T_world_body = sequence.spline.pose(stamp) @ np.linalg.inv(T_IMU_DEPTH)
    color, depth, imu = (load(mav0 / name / "sensor.yaml") for name in ("cam0", "depth0", "imu0"))
    T_world_color = sequence.spline.pose(stamp) @ np.linalg.inv(synthetic.T_COLOR_DEPTH)
    np.testing.assert_allclose(T_world_body @ matrix(color["T_BS"]), T_world_color, atol=1e-12)
    np.testing.assert_allclose(T_world_body @ matrix(depth["T_BS"]), sequence.spline.pose(stamp), atol=1e-12)
    np.testing.assert_array_equal(matrix(imu["T_BS"]), np.eye(4))
    assert color["sensor_type"] == "camera" and color["distortion_model"] == "radial-tangential"
    assert color["rolling_shutter"]["line_delay_s"] == pytest.approx(0.028 / 48)
    assert color["rolling_shutter"]["exposure_s"] == 0.01
    assert depth["depth_scale"] == 5000 and depth["rate_hz"] == 15.0 and imu["gyroscope_noise_density"] == 1.6968e-4
    body = load(mav0 / "body.yaml")
    assert body["gravity"] == [0, -9.80665, 0] and body["epoch_s"] == 10**9


def test_euroc_without_an_imu_and_with_copies(plain: Sequence, tmp_path: Path) -> None:
    stages: list[float] = []
    message = export_euroc(
        plain, tmp_path, ExportOptions(copy=True), progress=lambda stage, done, note: stages.append(done)
    )
    assert "no IMU" in message and stages == sorted(stages) and stages[-1] == 1.0
    assert not (tmp_path / "mav0/imu0").exists()
    trajectory = file_interface.read_euroc_csv_trajectory(str(tmp_path / "mav0/state_groundtruth_estimate0/data.csv"))
    T = plain.spline.pose(times(trajectory))
    np.testing.assert_allclose(np.array(trajectory.poses_se3), T, atol=1e-9)
    first = min((tmp_path / "mav0/cam0/data").iterdir())
    assert first.read_bytes() == plain.streams["color"].paths[0].read_bytes()
    assert not first.samefile(plain.streams["color"].paths[0])


# --- registered depth ------------------------------------------------------------------------------------------------


def test_registered_depth_is_what_the_colour_camera_sees(tmp_path: Path) -> None:
    """At rest, where ignoring the rows' times costs nothing, against a ray caster in the colour camera."""
    still = Spline(np.broadcast_to(se3.exp(np.array([0.1, 0, -0.3, 0, 0.2, 0])), (33, 4, 4)), -0.2, 0.05)
    size = {"width": 96, "height": 72, "intrinsics": [72.0, 72.0, 47.5, 35.5]}
    config = synthetic.make_config(depth=size)
    writer = synthetic.open_writer(tmp_path / "seq", config, 2, still)
    synthetic.write_frames(writer)
    writer.finish()
    sequence = read_sequence(tmp_path / "seq")
    assert "registered" in export_registered(sequence, tmp_path / "tum")

    camera = config.color.camera
    expected = synthetic.render_depth(still, camera, Shutter(), 0.0, synthetic.T_COLOR_DEPTH)
    dataset = open_dataset(tmp_path / "tum")
    z = dataset.frame(0).depth.pixels
    assert z.shape == expected.shape
    filled = z > 0
    assert filled.mean() > 0.8
    # Half a pixel beside the ray: a few per cent of z on a wall seen at an angle, more at the ball's edge.
    error = np.abs(z - expected)[filled] / expected[filled]
    assert np.median(error) < 0.006 and np.quantile(error, 0.95) < 0.04
    np.testing.assert_array_equal(dataset.frame(1).depth.pixels, z)


def test_registered_folder_reads_back_as_tum(sequence: Sequence, tmp_path: Path) -> None:
    export_registered(sequence, tmp_path / "tum")
    for name in ("depth.txt", "camera.yaml"):
        assert "registered to the colour camera" in (tmp_path / "tum" / name).read_text().splitlines()[0]
    dataset = open_dataset(tmp_path / "tum")
    color = sequence.streams["color"]
    assert dataset.rig.color_camera == dataset.rig.depth_camera == color.camera
    assert dataset.rig.color_shutter == color.shutter
    np.testing.assert_array_equal(dataset.rig.T_color_depth, np.eye(4))
    np.testing.assert_array_equal(dataset.color_stamps, color.stamps)
    depth, shutter = sequence.streams["depth"], dataset.rig.depth_shutter
    assert (shutter.exposure_s, shutter.scan) == (depth.shutter.exposure_s, depth.shutter.scan)
    # Times of rows as the depth camera took what they show, point by point through both cameras.
    pixels = color.camera.pixel_grid()[4:-4:3, 4:-4:3].reshape(-1, 2)
    p_depth = se3.transform(se3.inverse(sequence.T_color_depth), 2.0 * color.camera.unproject(pixels))
    uv, _ = depth.camera.project(p_depth)
    seen = depth.camera.contains(uv)
    line = depth.shutter.line_of_pixel(uv[seen], depth.camera)
    expected = depth.shutter.line_mid_time(depth.stamps[0], line, depth.camera)
    line = shutter.line_of_pixel(pixels[seen], color.camera)
    found = shutter.line_mid_time(dataset.stamps[0], line, color.camera)
    assert np.count_nonzero(seen) > 50 and np.abs(found - expected).max() < 0.06 * depth.shutter.readout_s
    assert abs(np.median(found - expected)) < 0.01 * depth.shutter.readout_s
    np.testing.assert_array_equal(dataset.frame(0).colors[0].pixels, sequence.color(0))
    trajectory = file_interface.read_tum_trajectory_file(str(tmp_path / "tum/groundtruth.txt"))
    T = sequence.spline.pose(np.asarray(trajectory.timestamps)) @ np.linalg.inv(synthetic.T_COLOR_DEPTH)
    np.testing.assert_allclose(np.array(trajectory.poses_se3), T, atol=1e-9)
    assert np.isin(color.stamps, np.asarray(trajectory.timestamps)).all()


def test_the_nearest_point_hides_those_behind_it() -> None:
    color = Camera(5, 5, 4.0, 4.0, 2.0, 2.0)
    T_color_depth = np.eye(4)
    T_color_depth[2, 3] = 0.5
    rays = np.array([[[0.0, 0.0, 1.0], [-0.1, 0.0, 1.0], [0.0, -0.1, 1.0], [9.0, 0.0, 1.0], [np.nan, 0.0, 1.0]]])
    z = np.array([[3.0, 1.0, 2.0, 1.0, 0.0]], np.float32)
    out = register_depth(rays, z, color, T_color_depth)
    expected = np.zeros((5, 5), np.float32)
    expected[2, 2] = 1.5
    np.testing.assert_array_equal(out, expected)
    T_color_depth[2, 3] = -5  # all of it behind the camera
    assert not register_depth(rays, z, color, T_color_depth).any()
