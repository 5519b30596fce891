"""Recordings of others' formats: frames, stamps, cameras and truth equal what was written; one line for each fault."""

from __future__ import annotations

import json
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import recordings
import synthetic
import yaml
from recordings import COLOR, COLOR_K, COLOR_SIZE, COUNT, DEPTH, DEPTH_K, FRAME, T_COLOR_DEPTH, Content, Talker

from rsgen.cli.main import main as rsgen
from rsgen.config.imu import ImuConfig
from rsgen.files import encode_png
from rsgen.geometry import se3
from rstrack.cli.info import describe
from rstrack.cli.main import main
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.data.own_intrinsics import SharedImages

CONTENT = recordings.make_content()


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(capfd: pytest.CaptureFixture[str], words: str) -> tuple[int, str, str]:
    capfd.readouterr()
    status = main(["import", *words.split(), "--quiet"])
    out, error = capfd.readouterr()
    assert "Traceback" not in error
    return status, out, error


def imported(capfd: pytest.CaptureFixture[str], words: str) -> tuple[Dataset, str]:
    status, out, error = run(capfd, f"{words} out")
    assert status == 0 and not error, error
    assert not [path for path in Path().iterdir() if path.name.endswith(".tmp")]
    return open_dataset(Path("out")), out


def refused(capfd: pytest.CaptureFixture[str], words: str, *said: str) -> None:
    before = sorted(Path().iterdir())
    status, out, error = run(capfd, f"{words} out")
    assert (status, out) == (2, "") and error.count("\n") == 1, (status, out, error)
    assert all(word in error for word in said), error
    assert sorted(Path().iterdir()) == before


def check_frames(dataset: Dataset, content: Content = CONTENT, colors: bool = True) -> None:
    """Images and stamps to the bit and the nanosecond."""
    assert len(dataset) == COUNT
    for k in range(COUNT):
        assert (dataset.images.depth(k) == content.units[k] / np.float32(1000)).all()
        if colors:
            assert (dataset.images.color(k) == content.colors[k]).all()
    for name, stamps, folder in (("depth", content.depth_ns, "depth"), ("rgb", content.color_ns, "rgb")):
        lines = (dataset.root / f"{name}.txt").read_text().splitlines()[1:]
        assert [int(line.split()[0].replace(".", "")) for line in lines] == list(stamps)
        assert all(line.split()[1].startswith(f"{folder}/") for line in lines)


def check_cameras(dataset: Dataset, tolerance: float = 1e-12) -> None:
    for camera, K, size in (
        (dataset.rig.color_camera, COLOR_K, COLOR_SIZE),
        (dataset.rig.depth_camera, DEPTH_K, recordings.DEPTH_SIZE),
    ):
        assert (camera.width, camera.height) == size and camera.model == "pinhole"
        assert np.allclose((camera.fx, camera.fy, camera.cx, camera.cy), K, atol=tolerance, rtol=0)
    assert np.allclose(dataset.rig.T_color_depth, T_COLOR_DEPTH, atol=max(tolerance, 1e-9), rtol=0)


# --- bags ------------------------------------------------------------------------------------------------------------


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
    assert not Path("out/imu.yaml").exists() and "where the IMU sits is not told" in said


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


Maker = Callable[[Talker, int, int], tuple[str, Any]]


def rgb(k: int) -> np.ndarray:
    return CONTENT.colors[k]


ENCODINGS: dict[str, tuple[Maker, float]] = {
    "bgr8": (lambda t, k, ns: ("sensor_msgs/Image", t.image(ns, "c", rgb(k)[..., ::-1], "bgr8", padding=5)), 0),
    "bgra8": (
        lambda t, k, ns: ("sensor_msgs/Image", t.image(ns, "c", cv2.cvtColor(rgb(k), cv2.COLOR_RGB2BGRA), "bgra8")), 0,
    ),
    "mono8": (lambda t, k, ns: ("sensor_msgs/Image", t.image(ns, "c", rgb(k)[..., 1], "mono8")), 0),
    "yuyv": (lambda t, k, ns: ("sensor_msgs/Image", t.image(ns, "c", yuyv(smooth(k)), "yuv422_yuy2")), 12),
    "uyvy": (
        lambda t, k, ns: ("sensor_msgs/Image", t.image(ns, "c", yuyv(smooth(k))[..., ::-1], "yuv422")), 12,
    ),
    "png": (lambda t, k, ns: ("sensor_msgs/CompressedImage", t.compressed(ns, "c", encode_png(rgb(k)), "png")), 0),
    "jpeg": (
        lambda t, k, ns: ("sensor_msgs/CompressedImage",
                          t.compressed(ns, "c", recordings.jpeg(smooth(k)), "rgb8; jpeg compressed bgr8")), 12,
    ),
}  # fmt: skip


def smooth(k: int) -> np.ndarray:
    """An image that survives half the chroma and a JPEG."""
    x, y = np.meshgrid(np.arange(COLOR_SIZE[0]), np.arange(COLOR_SIZE[1]))
    return np.stack([60 + 3 * x, 40 + 5 * y, 200 - 2 * x + 0 * y + 5 * k], axis=-1).astype(np.uint8)


def yuyv(pixels: np.ndarray) -> np.ndarray:
    """(h, w, 2) by BT.601's formulas in video range."""
    r, g, b = (pixels[..., i].astype(float) for i in range(3))
    luma = 16 + 0.257 * r + 0.504 * g + 0.098 * b
    u, v = 128 - 0.148 * r - 0.291 * g + 0.439 * b, 128 + 0.439 * r - 0.368 * g - 0.071 * b
    chroma = np.empty_like(luma)
    chroma[:, 0::2], chroma[:, 1::2] = u[:, 0::2], v[:, 0::2]
    return np.rint(np.stack([luma, chroma], axis=-1)).astype(np.uint8)


@pytest.mark.parametrize("name", ENCODINGS)
def test_colour_of_every_encoding(place: Path, capfd: pytest.CaptureFixture[str], name: str) -> None:
    talker, (maker, tolerance) = Talker(True), ENCODINGS[name]
    topic = f"{COLOR}/compressed" if name in ("png", "jpeg") else COLOR
    spoken = recordings.speak(talker, CONTENT, color=lambda k, ns: maker(talker, k, ns), color_topic=topic)
    recordings.write_spoken(place / "one.bag", talker, spoken)
    dataset, _ = imported(capfd, "one.bag")
    for k in range(COUNT):
        wanted = rgb(k)[..., 1][..., None].repeat(3, 2) if name == "mono8" else smooth(k) if tolerance else rgb(k)
        assert np.abs(dataset.images.color(k).astype(float) - wanted).max() <= tolerance
    if name in ("png", "jpeg"):
        first = encode_png(rgb(0)) if name == "png" else recordings.jpeg(smooth(0))
        assert next(Path("out/rgb").glob("000000.*")).read_bytes() == first


@pytest.mark.parametrize("kind", ["32FC1", "compressed", "compressed 32FC1", "bigendian"])
def test_depth_of_every_encoding(place: Path, capfd: pytest.CaptureFixture[str], kind: str) -> None:
    talker = Talker(False)
    a, b = 100.0, 1.0 / 100  # compressed_depth_image_transport: inverse depth = A / z + B

    def depth(k: int, ns: int) -> tuple[str, Any]:
        z = np.where(CONTENT.units[k] > 0, CONTENT.units[k] / 1000, np.nan)
        frame = FRAME["depth"]
        if kind == "32FC1":
            return "sensor_msgs/Image", talker.image(ns, frame, z.astype(np.float32), "32FC1", padding=8)
        if kind == "bigendian":
            message = talker.image(ns, frame, CONTENT.units[k].astype(">u2"), "16UC1")
            message.is_bigendian = 1
            return "sensor_msgs/Image", message
        if kind == "compressed":
            data, format = bytes(12) + encode_png(CONTENT.units[k]), "16UC1; compressedDepth"
        else:
            inverse = np.nan_to_num(np.rint(a / z + b), nan=0.0).astype(np.uint16)
            data = np.array([0, a, b], "<f4").tobytes() + encode_png(inverse)
            format = "32FC1; compressedDepth png"
        return "sensor_msgs/CompressedImage", talker.compressed(ns, frame, data, format)

    topic = f"{DEPTH}/compressedDepth" if kind.startswith("compressed") else DEPTH
    spoken = recordings.speak(talker, CONTENT, depth=depth, depth_topic=topic)
    recordings.write_spoken(place / "two", talker, spoken, "mcap")
    dataset, _ = imported(capfd, "two")
    for k in range(COUNT):
        z, wanted = dataset.images.depth(k), CONTENT.units[k] / 1000
        assert ((z == 0) == (wanted == 0)).all()
        if kind == "compressed 32FC1":  # half a quantum of inverse depth, and 0.1 mm
            seen = wanted > 0
            assert (np.abs(1 / z[seen] - 1 / wanted[seen]) <= 0.5 / a + 1e-4 / wanted[seen] ** 2).all()
        else:  # a millimetre is 1 or 5 units
            assert np.abs(z - wanted).max() < 1e-6


def test_lens_models_and_undistorted_images(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    talker = Talker(False)
    D, fish = [0.1, -0.2, 0.001, 0.002, 0.05], [0.01, -0.02, 0.003, -0.001]
    spoken = recordings.speak(talker, CONTENT, color_info=("plumb_bob", D), depth_info=("equidistant", fish),
                              depth_topic="/camera/depth/image_raw")  # fmt: skip
    recordings.write_spoken(place / "a", talker, spoken, "mcap")
    dataset, _ = imported(capfd, "a")
    assert dataset.rig.color_camera.model == "radtan" and dataset.rig.color_camera.distortion == tuple(D)
    assert dataset.rig.depth_camera.model == "fisheye" and dataset.rig.depth_camera.distortion == tuple(fish)
    spoken = recordings.speak(talker, CONTENT, color_info=("rational_polynomial", [*D, 0.0, 0.0, 0.0]),
                              depth_info=("plumb_bob", D))  # fmt: skip
    recordings.write_spoken(place / "b", talker, spoken, "mcap")
    dataset, _ = imported(capfd, "b --force")
    assert dataset.rig.color_camera.model == "radtan" and dataset.rig.color_camera.distortion == tuple(D)
    assert dataset.rig.depth_camera.model == "pinhole"  # image_rect_raw: what is published is undistorted
    full = [0.5, -2.6, 6e-4, -1e-4, 1.5, 0.38, -2.45, 1.46]
    spoken = recordings.speak(talker, CONTENT, color_info=("rational_polynomial", full))
    recordings.write_spoken(place / "d", talker, spoken, "mcap")
    dataset, _ = imported(capfd, "d --force")
    assert dataset.rig.color_camera.model == "rational" and dataset.rig.color_camera.distortion == tuple(full)
    spoken = recordings.speak(talker, CONTENT, color_info=("double_sphere", [-0.2, 0.6]))
    recordings.write_spoken(place / "e", talker, spoken, "mcap")
    dataset, _ = imported(capfd, "e --force")
    assert dataset.rig.color_camera.model == "double_sphere"
    assert dataset.rig.color_camera.distortion == (-0.2, 0.6)
    spoken = recordings.speak(talker, CONTENT, color_info=("double_sphere", D))
    recordings.write_spoken(place / "c", talker, spoken, "mcap")
    (place / "out").rename(place / "before")
    refused(capfd, "c", "double_sphere", "undistort")


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
        "info.bag": ("/camera/color/camera_info", ("nothing tells the camera", "/camera/depth/camera_info")),
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


# --- others ----------------------------------------------------------------------------------------------------------


def check_truth(dataset: Dataset, poses: np.ndarray) -> None:
    assert dataset.truth_poses is not None
    wanted = poses @ dataset.rig.T_color_depth
    assert np.allclose(dataset.truth_poses.T_world_cam, wanted, atol=1e-6)


@pytest.mark.parametrize("stamped", [True, False])
def test_scannets_files_come_back(place: Path, capfd: pytest.CaptureFixture[str], stamped: bool) -> None:
    recordings.write_sens(place / "scene.sens", CONTENT, stamped)
    dataset, said = imported(capfd, "scene.sens")
    check_cameras(dataset, 1e-6)
    assert all((dataset.images.depth(k) == CONTENT.units[k] / np.float32(1000)).all() for k in range(COUNT))
    assert Path("out/rgb/000002.jpg").read_bytes() == recordings.jpeg(CONTENT.colors[2])
    check_truth(dataset, CONTENT.poses[[0, 2, 3, 4]])
    assert "1 of 5 poses" in said and "estimated, not measured: BundleFusion" in describe(dataset)
    gaps = np.diff(dataset.stamps)
    assert np.allclose(gaps, 0.0333667 if stamped else 1 / 30, atol=2e-6) and ("1/30 s" in said) != stamped


def fake_lzfse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Unpacks what is stored as it is; the library itself, where there is one, does too."""

    def decompress(data: bytes) -> bytes:
        if data[:4] != b"bvx-" or data[-4:] != b"bvx$":
            raise ValueError("no block")
        return data[8:-4]

    module = types.ModuleType("liblzfse")
    module.decompress = decompress  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "liblzfse", module)


def test_record3ds_files_come_back(
    place: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    fake_lzfse(monkeypatch)
    recordings.write_r3d(place / "one.r3d", CONTENT)
    dataset, said = imported(capfd, "one.r3d")
    assert not (place.parent / "outside.txt").exists() and not Path("/absolute.txt").exists()
    assert isinstance(dataset.images, SharedImages)
    for k in range(COUNT):
        assert np.allclose(dataset.images.images.depth(k), CONTENT.units[k, :15, :20] / 1000, atol=1e-7)
    check_truth(dataset, CONTENT.poses)
    assert dataset.rig.color_camera.fx == pytest.approx(COLOR_K[0] + 0.2) and "medians" in said
    depth = dataset.rig.depth_camera
    # A ray through the colour image's corner goes through depth's corner, whatever their pixels.
    corner = dataset.rig.color_camera.unproject([-0.5, -0.5])
    assert np.allclose(depth.project(corner)[0], [-0.5, -0.5]) and (depth.width, depth.height) == (20, 15)
    table, own = (np.loadtxt(f"out/{name}.csv", delimiter=",") for name in ("intrinsics", "intrinsics_depth"))
    assert np.allclose(table[:, 1], COLOR_K[0] + 0.1 * np.arange(COUNT)) and table.shape == (COUNT, 5)
    assert np.allclose(own[:, 1], table[:, 1] * depth.width / COLOR_SIZE[0]) and (own[:, 0] == table[:, 0]).all()
    assert "ARKit" in describe(dataset)


def test_record3d_without_its_unpacker_says_what_to_install(
    place: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "liblzfse", None)
    refused(capfd, str(recordings.write_r3d(place / "one.r3d", CONTENT).name), "LZFSE", "[record3d]")


def test_bags_without_rosbags_say_what_to_install(
    place: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    recordings.write_realsense(place / "rs.bag", CONTENT)
    monkeypatch.setitem(sys.modules, "rosbags.rosbag1", None)
    refused(capfd, "rs.bag", "[ros]")


@pytest.mark.parametrize("per_frame", [True, False])
def test_stray_scanners_folders_come_back(place: Path, capfd: pytest.CaptureFixture[str], per_frame: bool) -> None:
    recordings.write_stray(place / "scan", CONTENT, per_frame)
    dataset, _ = imported(capfd, "scan")
    check_truth(dataset, CONTENT.poses)
    assert np.allclose(np.diff(dataset.stamps), 1 / 60, atol=1e-8)
    units = CONTENT.units[:, :15, :20]
    images = dataset.images.images if isinstance(dataset.images, SharedImages) else dataset.images
    assert isinstance(dataset.images, SharedImages) == per_frame
    for k in range(COUNT):
        z = images.depth(k)
        sure = (np.arange(20) >= 10)[None]
        assert (z == np.where(sure, units[k], 0) / np.float32(1000)).all()
        assert np.abs(images.color(k).astype(int) - (40 * k + 30)).max() < 6  # the video's own loss
    assert Path("out/intrinsics.csv").exists() == per_frame
    assert np.loadtxt("out/imu.csv", delimiter=",")[0].tolist() == [1e11, 0.1, 0.2, 0.3, 1.0, 2.0, 3.0]
    dataset, _ = imported(capfd, "scan --force --confidence 0")
    images = dataset.images.images if isinstance(dataset.images, SharedImages) else dataset.images
    assert (images.depth(0) == units[0] / np.float32(1000)).all()


def test_an_exported_euroc_folder_comes_back(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    config = synthetic.make_config(32, 24, color={"readout_s": 0.02}, depth={"readout_s": 0.01, "scan": "bottom-top"})
    imu = ImuConfig(T_imu_depth=recordings.T_IMU_DEPTH.tolist(), accelerometer_range=50.0)
    writer = synthetic.open_writer(place / "seq", config.model_copy(update={"imu": imu}), 4)
    synthetic.write_frames(writer)
    synthetic.write_scene(place / "seq")
    writer.finish()
    assert rsgen(["export", "euroc", "seq"]) == 0
    dataset, said = imported(capfd, "seq")
    exact = open_dataset(Path("seq"))
    assert dataset.rig.color_shutter == exact.rig.color_shutter and dataset.rig.depth_shutter == exact.rig.depth_shutter
    assert dataset.rig.color_camera == exact.rig.color_camera and dataset.rig.depth_camera == exact.rig.depth_camera
    assert np.allclose(dataset.rig.T_color_depth, exact.rig.T_color_depth, atol=1e-12)
    assert "calibrate" not in said and dataset.depth_scale == exact.depth_scale
    assert dataset.imu is not None and exact.imu is not None
    assert np.allclose(dataset.imu.T_imu_depth, exact.imu.T_imu_depth, atol=1e-8)
    assert np.allclose(dataset.imu.accel, exact.imu.accel[-len(dataset.imu.accel) :], atol=1e-9)
    assert dataset.imu.noise.gyro_density == exact.imu.noise.gyro_density
    for k in range(len(exact)):
        assert (dataset.images.depth(k) == exact.images.depth(k)).all()
        assert (dataset.images.color(k) == exact.images.color(k)).all()
    assert dataset.truth_poses is not None and exact.truth is not None
    stamps = dataset.truth_poses.stamps
    epoch = np.round(dataset.stamps[0] - exact.stamps[0])
    inside = (stamps - epoch > exact.truth.t_begin) & (stamps - epoch < exact.truth.t_end)
    T = exact.truth.pose(stamps[inside] - epoch)
    assert inside.sum() > 10
    assert np.abs(se3.log(se3.inverse(T) @ dataset.truth_poses.T_world_cam[inside])).max() < 1e-6
    for name in ("data.csv", "sensor.yaml"):
        (place / "seq/mav0/depth0" / name).unlink()
    (place / "out").rename(place / "before")
    refused(capfd, "seq", "no depth images", "cam0")


def test_an_exported_bag_comes_back_with_its_shutters(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Its first stamp is 0, and counts."""
    config = synthetic.make_config(32, 24, color={"readout_s": 0.02}, depth={"readout_s": 0.01, "scan": "bottom-top"})
    writer = synthetic.open_writer(place / "seq", config, 4)
    synthetic.write_frames(writer)
    synthetic.write_scene(place / "seq")
    writer.finish()
    assert rsgen(["export", "mcap", "seq", "--out", "seq.mcap"]) == 0
    dataset, said = imported(capfd, "seq.mcap")
    exact = open_dataset(Path("seq"))
    assert exact.stamps[0] == 0.0 and dataset.stamps == pytest.approx(exact.stamps, abs=1e-9)
    assert dataset.rig.color_shutter == exact.rig.color_shutter and dataset.rig.depth_shutter == exact.rig.depth_shutter
    assert "calibrate" not in said and np.allclose(dataset.rig.T_color_depth, exact.rig.T_color_depth, atol=1e-9)
    for k in range(len(exact)):
        assert (dataset.images.depth(k) == exact.images.depth(k)).all()
        assert (dataset.images.color(k) == exact.images.color(k)).all()


# --- the folder ------------------------------------------------------------------------------------------------------


def test_a_folder_is_replaced_only_if_it_was_imported(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    recordings.write_realsense(place / "rs.bag", CONTENT)
    (place / "out").mkdir()
    imported(capfd, "rs.bag")  # an empty one will do
    refused(capfd, "rs.bag", "--force")
    (place / "out/rgb/000000.png").write_bytes(b"damaged")
    check_frames(imported(capfd, "rs.bag --force")[0])
    (place / "out/import.json").unlink()
    refused(capfd, "rs.bag --force", "import.json")
    assert (place / "out/camera.yaml").exists()


def test_a_failed_import_leaves_the_folder_before_it(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    recordings.write_sens(place / "scene.sens", CONTENT)
    imported(capfd, "scene.sens")
    before = {path: path.read_bytes() for path in sorted((place / "out").rglob("*")) if path.is_file()}
    data = bytearray((place / "scene.sens").read_bytes())
    data[-200:] = bytes(200)
    (place / "scene.sens").write_bytes(data)
    refused(capfd, "scene.sens --force", "frame 4", "damaged")
    assert before == {path: path.read_bytes() for path in sorted((place / "out").rglob("*")) if path.is_file()}


def test_what_is_no_recording_is_said_to_be_none(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (place / "empty").mkdir()
    (place / "none.bag").touch()
    (place / "text.bag").write_text("<!DOCTYPE html>")
    for name, said in (("nowhere", "no such"), ("empty", "known format"), ("none.bag", "empty"), ("text.bag", "known")):
        refused(capfd, name, said)
    recordings.write_realsense(place / "rs.bag", CONTENT)
    refused(capfd, "rs.bag --device nothing", "realsense-d435")
