"""Bags read back by rosbags, and by mcap's own reader where it is installed: all bits, and the pose of every line."""

from __future__ import annotations

import importlib
import json
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import synthetic
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation, Slerp

from rsgen.errors import UserError
from rsgen.formats.export.ros import export_ros, loss_of_tf
from rsgen.formats.export.shared import ExportOptions, Storage
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.spline import Spline
from rsgen.sensors.reports import sequence_imu
from rsgen.sequence.format import ground_truth, poses_of_rows
from rsgen.sequence.images import Sequence
from rsgen.sequence.reader import read_sequence

KINDS: list[tuple[str, Storage, str]] = [
    ("ros1", "sqlite3", "a.bag"),
    ("ros2", "sqlite3", "a"),
    ("ros2", "mcap", "a"),
    ("mcap", "mcap", "a.mcap"),
]
Messages = dict[str, list[tuple[int, Any]]]


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    """Six frames: distorted colour that is read upwards, with exposure, depth by another clock, and an IMU."""
    color = {"model": "radtan", "distortion": [-0.05, 0.02, 0.001, -0.002], "exposure_s": 0.01, "scan": "bottom-top"}
    config = synthetic.make_config(color=color, depth={"readout_s": 0.02, "offset_s": 0.004, "rate_hz": 15.0})
    found = read_sequence(synthetic.make_sequence(tmp_path_factory.mktemp("ros") / "seq", config))
    return replace(found, meta=found.meta | {"config": {**found.meta["config"], "imu": {"rate_hz": 100.0}}})


def read(path: Path) -> Messages:
    """Topic to (time of the bag, message), in the bag's order."""
    found: Messages = defaultdict(list)
    with AnyReader([path]) as reader:
        for connection, ns, data in reader.messages():
            found[connection.topic].append((ns, reader.deserialize(data, connection.msgtype)))
    return found


@pytest.fixture(scope="module", params=KINDS, ids="-".join)
def messages(request: pytest.FixtureRequest, sequence: Sequence, tmp_path_factory: pytest.TempPathFactory) -> Messages:
    kind, storage, name = request.param
    out = tmp_path_factory.mktemp("bag") / name
    said = export_ros(sequence, out, ExportOptions(kind, storage=storage))
    assert "6 colour and 6 depth images, IMU" in said and "px at most" in said
    assert [path.name for path in out.parent.iterdir()] == [name]
    return read(out)


def stamp(message: Any) -> int:
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


def matrix(where: Any, how: Any) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([how.x, how.y, how.z, how.w]).as_matrix()
    T[:3, 3] = where.x, where.y, where.z
    return T


def statics(messages: Messages) -> dict[str, np.ndarray]:
    ((_, message),) = messages["/tf_static"]
    assert {t.header.frame_id for t in message.transforms} == {"camera_depth_optical_frame"}
    return {t.child_frame_id: matrix(t.transform.translation, t.transform.rotation) for t in message.transforms}


def facts(messages: Messages, topic: str = "/camera/rolling_shutter") -> dict[str, Any]:
    ((_, message),) = messages[topic]
    data: dict[str, Any] = json.loads(message.data)
    return data


def test_images_and_stamps_come_back_bit_for_bit(sequence: Sequence, messages: Messages) -> None:
    for name, topic, frame in (("color", "color/image_raw", "color"), ("depth", "depth/image_rect_raw", "depth")):
        found = messages[f"/camera/{topic}"]
        stream = sequence.streams[name]  # type: ignore[index]
        assert [stamp(m) for _, m in found] == [round(t * 1e9) for t in stream.listed] == [ns for ns, _ in found]
        assert {m.header.frame_id for _, m in found} == {f"camera_{frame}_optical_frame"}
    for k, (_, image) in enumerate(messages["/camera/color/image_raw"]):
        assert image.encoding == "rgb8" and image.step == 3 * image.width
        np.testing.assert_array_equal(image.data.reshape(image.height, image.width, 3), sequence.color(k))
    for k, (_, image) in enumerate(messages["/camera/depth/image_rect_raw"]):
        assert image.encoding == "32FC1" and image.step == 4 * image.width and not image.is_bigendian
        z = image.data.view("<f4").reshape(image.height, image.width)
        units = sequence.depth_units(k)
        np.testing.assert_array_equal(np.isnan(z), units == 0)
        np.testing.assert_array_equal(np.rint(np.nan_to_num(z) * 5000.0), units)
    assert all(ns == sorted(ns) for ns in ([t for t, _ in found] for found in messages.values()))
    assert min(ns for found in messages.values() for ns, _ in found) == 0


def test_every_line_s_pose_follows_from_the_bag_alone(sequence: Sequence, messages: Messages) -> None:
    """Points before each row's camera, projected with OpenCV by the bag's camera and pose, against the truth's rows."""
    shutter, curve = facts(messages)["streams"]["color"], facts(messages, "/ground_truth/spline")
    spline = Spline(np.array(curve["control_points"]), curve["t0"], curve["dt"])
    T_depth_color = statics(messages)["camera_color_optical_frame"]
    lines = shutter["lines"]
    assert lines == 48 and shutter["scan"] == "bottom-top" and "end of the exposure" in facts(messages)["stamp"]
    camera = sequence.streams["color"].camera
    for k, (_, info) in enumerate(messages["/camera/color/camera_info"]):
        K = (info.K if hasattr(info, "K") else info.k).reshape(3, 3)
        D = info.D if hasattr(info, "D") else info.d
        assert info.distortion_model == "plumb_bob" and len(D) == 5 and (info.width, info.height) == (64, 48)
        i = lines - 1 - np.arange(lines)  # of the rows from the top, which are read last
        t = stamp(info) * 1e-9 + i * shutter["readout_s"] / lines - 0.5 * shutter["exposure_s"]
        T_world_color = spline.pose(t) @ T_depth_color
        truth = poses_of_rows(sequence.rows("color")[k])
        for row in range(lines):
            pixels = np.array([[0.0, row], [30.0, row], [63.0, row]])
            p_world = se3.transform(truth[row], 1.5 * camera.unproject(pixels))
            p_color = se3.transform(se3.inverse(T_world_color[row]), p_world)
            uv, _ = cv2.projectPoints(p_color, np.zeros(3), np.zeros(3), K, D)
            assert np.abs(uv[:, 0] - pixels).max() < 0.01


def test_tf_leads_from_the_world_to_the_camera(sequence: Sequence, messages: Messages) -> None:
    """tf as tf2 interpolates it, at the lines of an image, and what the export says that this loses."""
    times, poses = [], []
    for ns, message in messages["/tf"]:
        (t,) = message.transforms
        assert (t.header.frame_id, t.child_frame_id) == ("world", "camera_depth_optical_frame") and stamp(t) == ns
        times.append(ns * 1e-9)
        poses.append(matrix(t.transform.translation, t.transform.rotation))
    T = np.array(poses)
    np.testing.assert_allclose(T, sequence.spline.pose(np.array(times)), atol=1e-9)
    stamps = {round(s * 1e9) for stream in sequence.streams.values() for s in stream.stamps}
    assert stamps <= {ns for ns, _ in messages["/tf"]}
    at = np.linspace(0.05, 0.15, 40)
    turned = Slerp(times, Rotation.from_matrix(T[:, :3, :3]))(at).as_matrix()
    moved = np.stack([np.interp(at, times, T[:, i, 3]) for i in range(3)], axis=-1)
    true = sequence.spline.pose(at)
    assert np.abs(turned - true[:, :3, :3]).max() < 1e-4 and np.abs(moved - true[:, :3, 3]).max() < 1e-4
    ((_, posed), *_), ((_, first), *_) = messages["/ground_truth/pose"], messages["/tf"]
    pose = matrix(posed.pose.position, posed.pose.orientation)
    np.testing.assert_array_equal(
        pose, matrix(first.transforms[0].transform.translation, first.transforms[0].transform.rotation)
    )
    loss = facts(messages)["loss_px"]["tf, interpolated"]
    assert 0 < loss["median_px"] < loss["max_px"] < 0.01


def test_the_imu_is_the_sequence_s_from_time_0_on(sequence: Sequence, messages: Messages) -> None:
    found = sequence_imu(sequence)
    assert found is not None
    config, samples, _ = found
    later = samples.t >= 0
    assert 0 < later.sum() < len(later)
    read = messages["/camera/imu"]
    for values, name in ((samples.gyro, "angular_velocity"), (samples.accel, "linear_acceleration")):
        vectors = [getattr(m, name) for _, m in read]
        np.testing.assert_array_equal([[v.x, v.y, v.z] for v in vectors], values[later])
    assert [stamp(m) for _, m in read] == [round(t * 1e9) for t in samples.t[later]]
    message = read[0][1]
    assert message.orientation_covariance[0] == -1 and message.header.frame_id == "camera_imu_optical_frame"
    assert message.angular_velocity_covariance[4] == pytest.approx(config.gyroscope_noise_density**2 * 100)
    np.testing.assert_allclose(statics(messages)["camera_imu_optical_frame"], config.T_depth_imu(), atol=1e-12)


def test_latched_topics_say_so(sequence: Sequence, tmp_path: Path) -> None:
    latched = {"/tf_static", "/camera/rolling_shutter", "/ground_truth/spline"}
    export_ros(sequence, tmp_path / "a.bag", ExportOptions("ros1"))
    with AnyReader([tmp_path / "a.bag"]) as reader:
        assert {c.topic for c in reader.connections if c.ext.latching} == latched  # type: ignore[union-attr]
    export_ros(sequence, tmp_path / "a", ExportOptions("ros2"))
    with AnyReader([tmp_path / "a"]) as reader:
        qos = {c.topic: c.ext.offered_qos_profiles for c in reader.connections}  # type: ignore[union-attr]
    assert {topic for topic, profiles in qos.items() if profiles} == latched
    assert qos["/tf_static"][0].durability.name == "TRANSIENT_LOCAL"


def test_mcaps_own_reader_decodes_the_file(sequence: Sequence, tmp_path: Path) -> None:
    reader = pytest.importorskip("mcap.reader")
    decoder = pytest.importorskip("mcap_ros2.decoder")
    export_ros(sequence, tmp_path / "a.mcap", ExportOptions("mcap"))
    with (tmp_path / "a.mcap").open("rb") as file:
        opened = reader.make_reader(file, decoder_factories=[decoder.DecoderFactory()])
        images = [m for _, _, _, m in opened.iter_decoded_messages(topics=["/camera/color/image_raw"])]
    assert len(images) == 6
    np.testing.assert_array_equal(np.frombuffer(images[3].data, np.uint8), sequence.color(3).ravel())


def test_registered_depth_and_millimetres(sequence: Sequence, tmp_path: Path) -> None:
    depth = replace(sequence.streams["depth"], registered=True, depth_scale=1000.0)
    warped = replace(sequence, streams={**sequence.streams, "depth": depth}, meta={})
    assert "no IMU" in export_ros(warped, tmp_path / "a.bag", ExportOptions("ros1"))
    found = read(tmp_path / "a.bag")
    assert "/camera/imu" not in found and not any("camera/depth" in topic for topic in found)
    image = found["/camera/aligned_depth_to_color/image_raw"][2][1]
    assert (image.encoding, image.header.frame_id) == ("16UC1", "camera_color_optical_frame")
    np.testing.assert_array_equal(image.data.view("<u2").reshape(48, 64), sequence.depth_units(2))
    assert found["/camera/aligned_depth_to_color/camera_info"][0][1].D[0] == -0.05
    assert "registered" in facts(found)["streams"]["depth"]


def with_lens(sequence: Sequence, model: Any, distortion: tuple[float, ...]) -> Sequence:
    color = replace(sequence.streams["color"], camera=Camera(64, 48, 40, 41, 31.5, 23.5, model, distortion))
    return replace(sequence, streams={**sequence.streams, "color": color})


@pytest.mark.parametrize(
    ("model", "theirs", "distortion"),
    [
        ("rational", "rational_polynomial", (0.3, 0.1, 0.004, -0.003, 0.02, 0.5, 0.1, 0.01)),
        ("fisheye", "equidistant", (0.1, 0.02, 0.0, 0.001)),
    ],
)
def test_lenses_that_ros_has_keep_their_coefficients(
    sequence: Sequence, tmp_path: Path, model: str, theirs: str, distortion: tuple[float, ...]
) -> None:
    export_ros(with_lens(sequence, model, distortion), tmp_path / "a.mcap", ExportOptions("mcap"))
    info = read(tmp_path / "a.mcap")["/camera/color/camera_info"][0][1]
    assert (info.distortion_model, tuple(info.d)) == (theirs, distortion)
    assert info.k.tolist() == [40, 0, 31.5, 0, 41, 23.5, 0, 0, 1] and info.p.tolist()[:8:5] == [40, 41]


def test_a_lens_that_ros_has_not_is_refused(sequence: Sequence, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="has no double_sphere lens"):
        export_ros(with_lens(sequence, "double_sphere", (-0.2, 0.6)), tmp_path / "b.bag", ExportOptions("ros1"))
    assert not list(tmp_path.iterdir())


def test_the_loss_of_tf_grows_with_its_spacing(sequence: Sequence) -> None:
    truth = ground_truth(sequence.spline)
    fine, coarse = (loss_of_tf(sequence, truth[::step]) for step in (1, 10))
    assert 50 < coarse.max_px / fine.max_px < 200  # the square of ten


@pytest.mark.parametrize(
    ("kind", "name", "said"),
    [
        ("ros1", "a.db3", "named .bag"),
        ("mcap", "a.bag", "named .mcap"),
        ("ros2", "there", "is there already"),
        ("ros1", "no/a.bag", "no such folder"),
    ],
)
def test_where_a_bag_cannot_be(sequence: Sequence, tmp_path: Path, kind: str, name: str, said: str) -> None:
    (tmp_path / "there").mkdir()
    with pytest.raises(UserError, match=said):
        export_ros(sequence, tmp_path / name, ExportOptions(kind))
    assert [path.name for path in tmp_path.iterdir()] == ["there"]


@pytest.mark.parametrize(("kind", "storage", "name"), KINDS, ids="-".join)
def test_nothing_is_left_of_a_bag_that_could_not_be_finished(
    sequence: Sequence, tmp_path: Path, kind: str, storage: Storage, name: str
) -> None:
    whole = sequence.streams["color"]
    absent = replace(whole, paths=(*whole.paths[:5], whole.paths[5].with_name("999999.png")))
    with pytest.raises(UserError, match="999999"):
        export_ros(
            replace(sequence, streams={**sequence.streams, "color": absent}),
            tmp_path / name,
            ExportOptions(kind, storage=storage),
        )
    assert not list(tmp_path.iterdir())


def test_a_full_disk_is_one_line(sequence: Sequence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("rosbags.rosbag1.Writer.write", full)
    with pytest.raises(UserError, match="No space left"):
        export_ros(sequence, tmp_path / "a.bag", ExportOptions("ros1"))
    assert not list(tmp_path.iterdir())


def test_without_rosbags_and_before_time_0(sequence: Sequence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    early = replace(sequence.streams["color"], listed=sequence.streams["color"].listed - 0.01)
    with pytest.raises(UserError, match="cannot be negative"):
        export_ros(
            replace(sequence, streams={**sequence.streams, "color": early}), tmp_path / "a.bag", ExportOptions("ros1")
        )

    def absent(name: str) -> None:
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", absent)
    with pytest.raises(UserError, match="pip install 'rosbags"):
        export_ros(sequence, tmp_path / "a.bag", ExportOptions("ros1"))
    assert not list(tmp_path.iterdir())
