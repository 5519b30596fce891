"""A rig of several cameras: format 2 against format 1, its poses, stereo depth, dots, configs, and what reads it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tiny
import yaml
from shutter_reference import line_window

from rsgen.check.verify import verify_sequence
from rsgen.cli.main import main
from rsgen.config.config import load_config
from rsgen.config.rig import StereoConfig
from rsgen.console.progress import no_progress
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.produce.generate import render_block
from rsgen.sensors.depth import stereo_depth
from rsgen.sequence.images import Rig, Sequence
from rsgen.sequence.reader import read_rig, read_sequence
from rstrack.data.dataset import open_dataset

T_COLOR_DEPTH = se3.exp(np.array([-0.03, 0.01, 0.0, 0.01, -0.02, 0.03]))
GREY = {**tiny.CAMERA, "kind": "infrared", "readout_s": 0.0, "spp": 4}
NOISE = {"model": "camera"}
BALL = {"name": "ball", "shape": {"kind": "sphere", "size_m": [0.3, 0.3, 0.3]},
        "motion": {"kind": "circle", "position": [0, 0, 1.2], "radius_m": 0.1, "period_s": 4.0}}  # fmt: skip
FRAMES = 3


def rows(T: np.ndarray) -> list[list[float]]:
    return [[float(value) for value in row] for row in T]


def rig_config(folder: Path, streams: dict[str, Any], **more: Any) -> Path:
    """tiny's config with these cameras in place of its own."""
    path = tiny.write_config(folder)
    data = yaml.safe_load(path.read_text())
    for name in ("color", "depth", "T_color_depth"):
        data.pop(name, None)
    path.write_text(yaml.safe_dump(data | {"streams": streams} | more, sort_keys=False))
    return path


def render(config: Path, out: Path) -> None:
    assert main(["render", str(config), "--out", str(out), "--frames", f"0:{FRAMES}", "--quiet"]) == 0


T_BODY_LEFT, T_BODY_RIGHT = (rows(se3.exp(np.array([x, 0.1, 0, 0, 0, 0]))) for x in (0.0, 0.1))
STREAMS = {
    "left": GREY | {"dots": {"count": 200, "dot_deg": 2.0}, "T_body_cam": T_BODY_LEFT},
    "right": GREY | {"T_body_cam": T_BODY_RIGHT},
    "matched": {"kind": "depth", "stereo": {"left": "left", "right": "right", "disparities": 16, "block_px": 3}},
    "front": {**tiny.CAMERA, "kind": "color", "readout_s": 0.02, "exposure_s": 0.01, "scan": "bottom-top",
              "noise": NOISE, "rate_hz": 20, "T_body_cam": rows(np.linalg.inv(T_COLOR_DEPTH))},
    "range": {**tiny.CAMERA, "kind": "depth", "readout_s": 0.015, "scan": "left-right", "offset_s": 0.004,
              "T_body_cam": rows(T_COLOR_DEPTH)},
}  # fmt: skip


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    truth = {"color_depth": True, "flow": ["next"]}
    return rig_config(tmp_path_factory.mktemp("rig"), STREAMS, truth=truth, imu={"rate_hz": 100.0})


@pytest.fixture(scope="module")
def root(config: Path) -> Path:
    out = config.parent / "seq"
    render(config, out)
    return out


@pytest.fixture(scope="module")
def rig(root: Path) -> Rig:
    return read_rig(root)


def test_two_cameras_as_a_rig_take_the_same_images(tmp_path: Path) -> None:
    """Format 2 against format 1, byte for byte: images, exact depth, rows' poses."""
    color = {**tiny.CAMERA, "readout_s": 0.028, "exposure_s": 0.01, "spp": 4, "noise": NOISE}
    depth = {**tiny.CAMERA, "readout_s": 0.02, "noise": {"model": "kinect"}}
    pose = rows(T_COLOR_DEPTH)
    render(tiny.write_config(tmp_path / "a", color=color, depth=depth, T_color_depth=pose), tmp_path / "one")
    T_body_color = rows(se3.inverse(np.array(pose)))
    streams = {"color": color | {"kind": "color", "T_body_cam": T_body_color}, "depth": depth | {"kind": "depth"}}
    render(rig_config(tmp_path / "b", streams), tmp_path / "two")
    one, two = tiny.digests(tmp_path / "one"), tiny.digests(tmp_path / "two")
    moved = {"rgb/": "color/", "truth/depth/": "truth/depth/depth/", "truth/color/": "truth/color/color/"}
    for name in (name for name in one if name.endswith((".png", ".exr"))):
        prefix = next((p for p in moved if name.startswith(p)), None)
        there = name if prefix is None else moved[prefix] + name.removeprefix(prefix)
        assert two[there] == one[name], name
    assert one["spline.npz"] == two["spline.npz"] and one["depth.txt"] == two["depth.txt"]
    assert one["truth/rows_depth.npy"] == two["truth/depth/rows.npy"]
    np.testing.assert_allclose(
        read_rig(tmp_path / "two").rows("color"), read_rig(tmp_path / "one").rows("color"), atol=1e-12
    )


def test_it_verifies_and_every_camera_is_where_an_independent_caster_sees_it(root: Path) -> None:
    report = verify_sequence(root, raycast=2)
    assert report.ok, report.text()
    casts = [check.name for check in report.checks if check.name.startswith("ray casting")]
    assert casts == [f"ray casting {name}" for name in ("left", "right", "matched", "front", "range")]


@pytest.mark.parametrize("name", list(STREAMS))
def test_lines_have_the_bodys_pose_at_their_own_time_times_the_cameras(rig: Rig, name: str) -> None:
    stream = rig.streams[name]
    T_body_cam = np.array(STREAMS[name].get("T_body_cam", STREAMS["left"]["T_body_cam"]), float)
    for line in (0, stream.line_count - 1):
        begin, end = line_window(stream.shutter, float(stream.stamps[1]), line, stream.camera)
        expected = rig.spline.pose(0.5 * (begin + end)) @ T_body_cam
        uv = np.array([line, line], float)
        at = stream.line_count - 1 - line if stream.shutter.scan in ("bottom-top", "right-left") else line
        uv[:] = at
        np.testing.assert_allclose(rig.pixel_poses(name, 1, uv), expected, atol=1e-9)


def test_grey_cameras_write_one_channel_and_others_three(rig: Rig) -> None:
    assert rig.picture("left", 0).shape == (36, 48) and rig.picture("front", 0).shape == (36, 48, 3)
    assert rig.exact_image("front", "flow_next", 0).shape == (36, 48, 3)


def test_a_pair_is_a_sequence_whose_body_is_its_depth_camera(rig: Rig) -> None:
    pair = rig.pair("front", "range")
    T_depth_body = se3.inverse(np.array(STREAMS["range"]["T_body_cam"]))
    T_color_body = se3.inverse(np.array(STREAMS["front"]["T_body_cam"]))
    np.testing.assert_allclose(pair.T_color_depth, T_color_body @ se3.inverse(T_depth_body), atol=1e-12)
    for t in (0.05, 0.1):
        np.testing.assert_allclose(pair.spline.pose(t), rig.spline.pose(t) @ se3.inverse(T_depth_body), atol=1e-12)
        turned, own = pair.spline.velocity(t), rig.spline.velocity(t)
        np.testing.assert_allclose(turned, se3.adjoint(T_depth_body) @ own, atol=1e-10)
    np.testing.assert_array_equal(pair.truth_depth(0), rig.exact_depth("range", 0))
    np.testing.assert_array_equal(pair.rows("color"), rig.rows("front"))


def test_the_tracker_opens_two_cameras_by_name(root: Path) -> None:
    chosen, first = open_dataset(Path(f"{root}:right,range")), open_dataset(root)
    assert isinstance(chosen.sequence, Sequence) and first.sequence is not None
    image = read_rig(root).picture("right", 0)
    np.testing.assert_array_equal(chosen.images.color(0), np.repeat(image[..., None], 3, axis=-1))
    assert chosen.rig.depth_shutter.scan == "left-right" and first.rig.color_shutter.scan == "bottom-top"
    assert chosen.imu is not None and first.imu is not None
    for words, message in ((":left", "DIR:COLOR,DEPTH"), (":nobody,range", "choose one of front, left, right")):
        with pytest.raises(UserError, match=message):
            open_dataset(Path(f"{root}{words}"))


def test_a_worker_renders_the_same_bytes(config: Path, root: Path, tmp_path: Path) -> None:
    files = render_block(tiny.render_job(load_config(config), tmp_path, (1, "matched"), (2, "left")), no_progress)
    assert {"matched/000001.png", "left/000002.png"} <= set(files)
    assert all((root / name).read_bytes() == data for name, data in files.items())


def test_euroc_and_kalibr_have_all_cameras_where_they_are(root: Path, rig: Rig, tmp_path: Path) -> None:
    assert main(["export", "euroc", str(root), "--out", str(tmp_path), "--quiet"]) == 0
    T_imu_body = np.eye(4)
    for sensor, name in {
        "cam0": "left",
        "cam1": "right",
        "cam2": "front",
        "depth0": "matched",
        "depth1": "range",
    }.items():
        found = yaml.safe_load((tmp_path / f"mav0/{sensor}/sensor.yaml").read_text())
        T_BS = np.array(found["T_BS"]["data"]).reshape(4, 4)
        np.testing.assert_allclose(T_BS, T_imu_body @ se3.inverse(rig.streams[name].T_cam_body), atol=1e-12)
        assert len(list((tmp_path / f"mav0/{sensor}/data").iterdir())) == FRAMES
    streams = {name: STREAMS[name] for name in ("left", "right", "front")}
    other = tmp_path / "three"
    render(rig_config(tmp_path / "c", streams), other)
    assert main(["export", "kalibr", str(other), "--quiet"]) == 0
    chain = yaml.safe_load((other / "kalibr/camchain.yaml").read_text())
    assert list(chain) == ["cam0", "cam1", "cam2"] and chain["cam1"]["cam_overlaps"] == [0, 2]
    T_2_0 = np.array(chain["cam2"]["T_cn_cnm1"]) @ np.array(chain["cam1"]["T_cn_cnm1"])
    expected = se3.inverse(np.array(STREAMS["front"]["T_body_cam"])) @ np.array(STREAMS["left"]["T_body_cam"])
    np.testing.assert_allclose(T_2_0, expected, atol=1e-12)
    assert main(["export", "colmap", str(other), "--quiet"]) == 2  # there is no depth camera


@pytest.mark.parametrize(("kind", "name"), [("ros1", "rig.bag"), ("ros2", "rig"), ("mcap", "rig.mcap")])
def test_a_bag_has_every_image_and_camera(root: Path, rig: Rig, tmp_path: Path, kind: str, name: str) -> None:
    rosbags = pytest.importorskip("rosbags.highlevel")
    assert main(["export", kind, str(root), "--out", str(tmp_path / name), "--quiet"]) == 0
    facts = None
    with rosbags.AnyReader([tmp_path / name]) as reader:
        seen: dict[str, int] = {}
        for connection, _, raw in reader.messages():
            seen[connection.topic] = seen.get(connection.topic, 0) + 1
            message = reader.deserialize(raw, connection.msgtype)
            if connection.topic == "/camera/left/image_raw" and seen[connection.topic] == 1:
                assert message.encoding == "mono8" and message.header.frame_id == "left_optical_frame"
                np.testing.assert_array_equal(message.data.reshape(36, 48), rig.picture("left", 0))
            if connection.topic == "/tf_static":
                children = {t.child_frame_id: t for t in message.transforms}
            if connection.topic == "/camera/rolling_shutter":
                facts = json.loads(message.data)
    assert {f"{one}_optical_frame" for one in STREAMS} < set(children)
    found = children["front_optical_frame"].transform.translation
    np.testing.assert_allclose([found.x, found.y, found.z], np.array(STREAMS["front"]["T_body_cam"])[:3, 3], atol=1e-12)
    assert all(seen[f"/camera/{one}/image_{'rect_raw' if 'depth' in STREAMS[one]['kind'] else 'raw'}"] == FRAMES
               for one in STREAMS)  # fmt: skip
    assert facts is not None and set(facts["streams"]) == set(STREAMS)


def test_ncore_has_every_image_and_line(root: Path, rig: Rig, tmp_path: Path) -> None:
    v4 = pytest.importorskip("ncore.data.v4")
    assert main(["export", "ncore", str(root), "--out", str(tmp_path / "out"), "--quiet"]) == 0
    (path,) = (tmp_path / "out").iterdir()
    loader = v4.SequenceLoaderV4(v4.SequenceComponentGroupsReader([path]))
    assert sorted(loader.camera_ids) == sorted(STREAMS)
    for name, stream in rig.streams.items():
        camera = loader.get_camera_sensor(name)
        of_file = cv2.imread(str(stream.paths[1]), cv2.IMREAD_UNCHANGED)
        of_library = np.asarray(camera.get_frame_handle(1).get_data().get_decoded_image())
        np.testing.assert_array_equal(of_library, of_file if of_file.ndim == 2 else of_file[..., ::-1])
        # The pose of each line, as the library interpolates it between the times that it has of the first and the last.
        part = np.arange(stream.line_count) / max(stream.line_count - 1, 1)
        at = camera.frames_timestamps_us[1].astype(float) @ np.stack([1 - part, part])
        T_world_cam = loader.pose_graph.evaluate_poses(name, "world", np.rint(at).astype(np.uint64))
        windows = [line_window(stream.shutter, stream.stamps[1], k, stream.camera) for k in range(stream.line_count)]
        expected = rig.spline.pose(np.mean(windows, axis=1)) @ se3.inverse(stream.T_cam_body)
        np.testing.assert_allclose(T_world_cam, expected, atol=1e-5)


def changed(name: str, **fields: Any) -> dict[str, Any]:
    return STREAMS | {name: STREAMS[name] | fields}


@pytest.mark.parametrize(
    ("streams", "more", "message"),
    [
        (changed("front", kind="lidar"), {}, "streams.front"),
        (changed("left", noise={"model": "camera", "bayer": "bilinear"}), {}, "has no colours"),
        (changed("front", dots={}), {}, "make it kind: infrared"),
        (changed("right", T_body_cam=rows(np.eye(4))), {}, "rectified pair"),
        (changed("right", readout_s=0.01), {}, "readout_s of left and right must be the same"),
        (changed("matched", rate_hz=15), {}, "has the left camera's pixels and clock"),
        (changed("matched", stereo={"left": "left", "right": "range"}), {}, "must name a colour, mono or infrared"),
        ({"Left eye": STREAMS["left"]}, {}, "streams"),
        ({"truth": STREAMS["left"]}, {}, "choose another"),
        (changed("matched", stereo={"left": "left", "right": "right", "block_px": 4}), {}, "block_px"),
        (STREAMS, {"color": {"width": 64}}, "a rig has its cameras in streams"),
        (STREAMS, {"objects": [BALL]}, "dots do not fall on what moves"),
        (STREAMS, {"faults": {"color": {"offset_s": 0.01}}}, "can be those of the IMU only"),
    ],
)  # fmt: skip
def test_a_rig_that_cannot_be_is_refused_in_one_line(
    tmp_path: Path, streams: dict[str, Any], more: dict[str, Any], message: str
) -> None:
    with pytest.raises(UserError, match=message) as error:
        load_config(rig_config(tmp_path, streams, **more))
    assert "\n" not in str(error.value)


def test_stereo_depth_of_a_wall_is_its_distance_and_what_one_eye_sees_has_none() -> None:
    rng = np.random.default_rng(2)
    shift, width = 12.5, 160
    wide = rng.integers(40, 220, (60, 2 * width)).astype(np.float32)
    wide = np.repeat(wide, 2, axis=1)[:, : 2 * width]  # textured at two pixels
    x = np.arange(width)
    left = wide[:, :width]
    right = np.stack([np.interp(x + shift, np.arange(2 * width), row) for row in wide])
    left, right = (np.rint(image).astype(np.uint8) for image in (left, right))
    z = stereo_depth(left, right, 25.0, StereoConfig(left="a", right="b", disparities=32, block_px=5))
    inside = z[5:-5, 40:-5]
    assert np.median(inside) == pytest.approx(2.0, rel=0.01) and (inside > 0).mean() > 0.95
    assert (z[:, : int(shift)] == 0).mean() > 0.8  # left of what the right camera sees
    assert (stereo_depth(left, np.full_like(right, 128), 25.0, StereoConfig(left="a", right="b")) > 0).mean() < 0.2


def test_a_damaged_rig_is_one_line(root: Path, tmp_path: Path) -> None:
    text = (root / "sequence.yaml").read_text()
    broken = tmp_path / "seq"
    broken.mkdir()
    for old, new in (("kind: infrared", "kind: sonar"), ("T_body_cam", "T_somewhere")):
        (broken / "sequence.yaml").write_text(text.replace(old, new, 1))
        with pytest.raises(UserError, match="streams") as error:
            read_sequence(broken)
        assert "\n" not in str(error.value)


def test_fields_of_a_camera_are_options(config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["render", str(config), "--out", str(tmp_path / "seq"), "--frames", "0:1", "--quiet"]
    assert main([*words, "--streams.range.readout_s", "0", "--streams.front.noise.model=none"]) == 0
    made = read_rig(tmp_path / "seq")
    assert made.streams["range"].shutter.readout_s == 0 and made.meta["noise"]["front"] == "none"
    assert main([*words, "--streams.range.colour", "0"]) == 2
    assert "streams.range.colour: no such field" in capsys.readouterr().err
