"""Bags of every kind: frames, stamps, cameras, transforms and readouts equal what was written, faults are named."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import recordings
import yaml
from import_command import CONTENT, check_cameras, check_frames, imported, refused, run
from recordings import COLOR, COLOR_K, COLOR_SIZE, COUNT, DEPTH, FRAME, T_COLOR_DEPTH, Content, Talker

from rsgen.geometry import se3


@pytest.mark.parametrize(
    ("name", "is_ros1", "storage"),
    [
        ("one.bag", True, ""), ("packed.bag", True, "bz2"), ("quick.bag", True, "lz4"), ("two", False, "sqlite3"),
        ("two_mcap", False, "mcap"), ("bare.db3", False, "sqlite3"), ("bare.mcap", False, "mcap"),
    ],
)  # fmt: skip
def test_every_kind_of_bag_comes_back(
    place: Path, capfd: pytest.CaptureFixture[str], name: str, is_ros1: bool, storage: str
) -> None:
    talker = Talker(is_ros1)
    recordings.write_spoken(place / name, talker, recordings.speak(talker, CONTENT), storage)
    dataset, said = imported(capfd, name)
    check_frames(dataset)
    check_cameras(dataset)
    assert "rstrack calibrate out --out out/camera.yaml" in said and "colour and depth" in said
    imu = np.loadtxt("out/imu.csv", delimiter=",")
    assert imu[:, 0].tolist() == list(map(float, CONTENT.color_ns))
    assert np.allclose(imu[2, 1:], [0.1, 0.2, 2.3, 0.0, -9.81, 1.0])
    record = json.loads(Path("out/import.json").read_text())
    assert record["file"] == name and record["source"]["depth"] == DEPTH and str(place) not in json.dumps(record)


def test_what_librealsense_records_comes_back(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    recordings.write_realsense(place / "rs.bag", CONTENT)
    dataset, said = imported(capfd, "rs.bag --device realsense-d435")
    check_frames(dataset)
    check_cameras(dataset)
    assert dataset.depth_scale == 1000 and "RealSense" in said
    # The table has a global shutter for depth and no time for colour.
    assert "readout of colour:" in said and "--device realsense-d435" in said
    assert dataset.imu_files is not None and (T_imu := dataset.imu_files.description().T_imu_depth) is not None
    assert np.allclose(T_imu, recordings.T_IMU_DEPTH, atol=1e-6)
    imu = np.loadtxt("out/imu.csv", delimiter=",")  # accel is 3 ms later: interpolated, the first sample has none
    assert imu.shape == (COUNT - 1, 7) and np.allclose(imu[:, 3], [1, 2, 3, 4]) and "interpolated" in said
    assert np.allclose(imu[:, 5], np.array([1, 2, 3, 4]) - 3e6 / 33_366_700, atol=1e-6)
    assert np.allclose(imu[:, 1], 0.5) and np.allclose(imu[:, 6], 9.0)


def test_where_the_imu_sits_comes_along_by_tf(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    talker, edge = Talker(True), ("imu", FRAME["depth"], recordings.T_IMU_DEPTH)
    color = (FRAME["depth"], FRAME["color"], se3.inverse(T_COLOR_DEPTH))
    recordings.write_spoken(place / "one.bag", talker, recordings.speak(talker, CONTENT, tf=[edge, color]))
    dataset, said = imported(capfd, "one.bag")
    assert dataset.imu_files is not None and (T_imu := dataset.imu_files.description().T_imu_depth) is not None
    assert np.allclose(T_imu, recordings.T_IMU_DEPTH, atol=1e-6) and "--free imu" not in said
    recordings.write_spoken(place / "none.bag", talker, recordings.speak(talker, CONTENT))
    dataset, said = imported(capfd, "none.bag --force")
    assert not Path("out/imu.yaml").exists() and "where the IMU sits is not known" in said


def test_the_unit_of_depth_is_the_cameras(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    recordings.write_realsense(place / "rs.bag", CONTENT, unit=0.0001)
    dataset, _ = imported(capfd, "rs.bag")
    assert dataset.depth_scale == 10000
    assert (dataset.images.depth(1) == CONTENT.units[1] / np.float32(10000)).all()


def test_librealsenses_sqlite_has_stamps_in_its_metadata(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    whole = [tuple(ns // 1000 * 1000 for ns in stamps) for stamps in (CONTENT.color_ns, CONTENT.depth_ns)]
    content = Content(CONTENT.colors, CONTENT.units, whole[0], whole[1], CONTENT.poses)
    recordings.write_realsense_db3(place / "rs.db3", content)
    dataset, _ = imported(capfd, "rs.db3")
    check_cameras(dataset)
    stamps = [float(line.split()[0]) for line in Path("out/rgb.txt").read_text().splitlines()[1:]]
    assert np.allclose(stamps, np.array(content.color_ns) * 1e-9, atol=1e-6, rtol=0)  # a double's last digits in ms
    assert (dataset.images.depth(2) == content.units[2] / np.float32(1000)).all()
    assert (dataset.images.color(3) == content.colors[3]).all()


@pytest.mark.parametrize("how", ["aligned", "same frame"])
def test_registered_depth_is_known_by_its_topic_or_frame(
    place: Path, capfd: pytest.CaptureFixture[str], how: str
) -> None:
    talker = Talker(True)
    units = np.pad(CONTENT.units, ((0, 0), (0, 6), (0, 8)))
    topic = "/camera/aligned_depth_to_color/image_raw" if how == "aligned" else "/camera/depth/image"
    frame = FRAME["depth"] if how == "aligned" else FRAME["color"]
    spoken = recordings.speak(
        talker, CONTENT, depth=lambda k, ns: ("sensor_msgs/Image", talker.image(ns, frame, units[k], "16UC1")),
        depth_topic=topic, depth_size=COLOR_SIZE, depth_K=COLOR_K,
    )  # fmt: skip
    recordings.write_spoken(place / "one.bag", talker, spoken)
    dataset, _ = imported(capfd, "one.bag")
    assert dataset.rig.is_registered and yaml.safe_load(Path("out/camera.yaml").read_text())["depth"]["registered"]
    assert (dataset.images.depth(1) == units[1] / np.float32(1000)).all()


def test_the_sensors_own_depth_goes_before_registered_where_transforms_connect_it(
    place: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    talker = Talker(True)
    aligned = "/camera/aligned_depth_to_color"
    units = np.pad(CONTENT.units[0], ((0, 6), (0, 8)))
    more = []
    for kind, name, message in (
        ("sensor_msgs/Image", "image_raw", talker.image(CONTENT.depth_ns[0], FRAME["color"], units, "16UC1")),
        ("sensor_msgs/CameraInfo", "camera_info", talker.info(FRAME["color"], COLOR_SIZE, COLOR_K, "plumb_bob", [])),
    ):
        more.append((f"{aligned}/{name}", kind, CONTENT.depth_ns[0], talker.bytes(kind, message)))
    for name, edges, registered in (("a.bag", None, False), ("b.bag", [], True)):
        change = {} if edges is None else {"tf": edges}
        recordings.write_spoken(place / name, talker, recordings.speak(talker, CONTENT, more=more, **change))
        status, _, error = run(capfd, f"{name} out_{name}")
        assert status == 0, error
        assert ("registered" in yaml.safe_load(Path(f"out_{name}/camera.yaml").read_text())["depth"]) == registered
    dataset, said = imported(capfd, f"b.bag --depth {DEPTH}")
    assert "no transforms connect" in said and (dataset.rig.T_color_depth == np.eye(4)).all()


def test_without_stamps_the_times_of_recording_are_taken(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    talker = Talker(True)
    recordings.write_spoken(place / "one.bag", talker, recordings.speak(talker, CONTENT, stamped=False))
    _, said = imported(capfd, "one.bag")
    assert "no stamps" in said
    first = Path("out/depth.txt").read_text().splitlines()[1].split()[0]
    assert int(first.replace(".", "")) == CONTENT.depth_ns[0] + 5_000_000


@pytest.mark.parametrize("form", ["KeyValue", "json", "pairs"])
def test_a_readout_that_the_recording_states_is_written(
    place: Path, capfd: pytest.CaptureFixture[str], form: str
) -> None:
    talker = Talker(False)
    key, topic = "android.sensor.rollingShutterSkew", "/camera/color/metadata"
    said = {"KeyValue": ("SENSOR_ROLLING_SHUTTER_SKEW", "19500000"), "json": ("data", json.dumps({key: 19500000})),
            "pairs": ("data", "Frame number=3;SENSOR_ROLLING_SHUTTER_SKEW=19500000;")}[form]  # fmt: skip
    kind = "diagnostic_msgs/KeyValue" if form == "KeyValue" else "std_msgs/String"
    fields = {"key": said[0], "value": said[1]} if form == "KeyValue" else {"data": said[1]}
    more = [(topic, kind, CONTENT.color_ns[0], talker.bytes(kind, talker.make(kind, **fields)))]
    recordings.write_spoken(place / "two", talker, recordings.speak(talker, CONTENT, more=more), "mcap")
    dataset, out = imported(capfd, "two")
    assert dataset.rig.color_shutter.readout_s == pytest.approx(0.0195, abs=1e-12)
    assert "readout of depth:" in out


def test_what_is_missing_in_a_bag_is_named_with_what_there_is(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    talker = Talker(True)
    spoken = recordings.speak(talker, CONTENT)
    without = {
        "depth.bag": (DEPTH, ("no depth images", COLOR, "--depth")),
        "color.bag": (COLOR, ("no colour images", DEPTH, "--color")),
        "info.bag": ("/camera/color/camera_info", ("nothing states the camera", "/camera/depth/camera_info")),
    }
    for name, (topic, said) in without.items():
        recordings.write_spoken(place / name, talker, [entry for entry in spoken if entry[0] != topic])
        refused(capfd, name, *said)
    other = [(t.replace("/camera/", "/second/"), *rest) for t, *rest in spoken]
    recordings.write_spoken(place / "two.bag", talker, [*spoken, *other])  # type: ignore[list-item]
    refused(capfd, "two.bag", "several topics", COLOR, "/second/color/image_raw")
    refused(capfd, f"two.bag --color {COLOR} --depth /nowhere", "/nowhere", DEPTH)
    dataset, _ = imported(capfd, f"two.bag --color {COLOR} --depth {DEPTH}")
    check_frames(dataset)


def test_sizes_that_disagree_are_refused(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    talker = Talker(True)
    spoken = recordings.speak(talker, CONTENT, depth_size=(33, 24))
    recordings.write_spoken(place / "one.bag", talker, spoken)
    refused(capfd, "one.bag", "32x24", "33x24", DEPTH)


def test_bags_without_rosbags_say_what_to_install(
    place: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    recordings.write_realsense(place / "rs.bag", CONTENT)
    monkeypatch.setitem(sys.modules, "rosbags.rosbag1", None)
    refused(capfd, "rs.bag", "pip install", "rosbags")


@pytest.mark.parametrize(("name", "is_ros1", "storage"), [("packed.bag", True, "bz2"), ("two.mcap", False, "mcap")])
def test_a_chunk_that_unpacks_to_too_much_is_refused(
    place: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, name: str, is_ros1: bool,
    storage: str,
) -> None:  # fmt: skip
    talker = Talker(is_ros1)
    recordings.write_spoken(place / name, talker, recordings.speak(talker, CONTENT), storage)
    monkeypatch.setattr("rstrack.formats.bags.bag._MOST_CHUNK_BYTES", 1000)
    refused(capfd, name, "unpacks to more than 1000 bytes")
