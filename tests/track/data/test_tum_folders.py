"""Datasets: folders as TUM's and ICL-NUIM's, and OpenCV's calibration in them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from tum_recording import (
    COLOR,
    HEIGHT,
    STAMPS,
    WIDTH,
    K,
    color_pixels,
    depth_units,
    make_tum,
    write_camera,
    write_listing,
    write_opencv,
)

from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.shutter import Shutter
from rstrack.data.dataset import open_dataset, open_tracked
from rstrack.data.estimate import read_estimate, write_estimate
from rstrack.data.image_files import repeated
from rstrack.options import Options
from rstrack.tracking.first_look import wants_pattern
from rstrack.tracking.runs.record import Noise, settings


def test_tum_folder_with_colour_only_in_camera_yaml(tmp_path: Path) -> None:
    dataset = open_dataset(make_tum(tmp_path / "fr1_desk"))
    rig = dataset.rig
    assert dataset.name == "fr1_desk" and dataset.truth is None and dataset.truth_poses is None
    assert rig.depth_camera == rig.color_camera and rig.color_camera.fy == 25.0
    assert rig.color_shutter.readout_s == rig.depth_shutter.readout_s == 0.028, "registered: rows keep their times"
    assert dataset.timing is not None and "read out like colour, 28 ms" in dataset.timing.notes[0]
    np.testing.assert_array_equal(rig.T_color_depth, np.eye(4))
    for k, frame in enumerate(dataset.frames()):
        np.testing.assert_array_equal(frame.depth.pixels, (depth_units(k) / 5000).astype(np.float32))
        np.testing.assert_array_equal(frame.colors[0].pixels, color_pixels(k))
        assert frame.depth.stamp == STAMPS[k] and frame.depth.pixels.dtype == np.float32
    assert dataset.sequence is None


def test_tum_folder_with_everything_told_and_truth_of_the_colour_camera(tmp_path: Path) -> None:
    T_color_depth = se3.exp(np.array([0.05, 0.01, 0.0, 0.02, -0.01, 0.03]))
    depth = COLOR | {"readout_s": 0.03, "scan": "bottom-top", "depth_scale": 1000, "model": "radtan"}
    depth |= {"distortion": [0.1, -0.05, 0.001, 0.002]}
    camera = {"color": COLOR, "depth": depth, "T_color_depth": T_color_depth.tolist()}
    root = make_tum(tmp_path / "tum", {})
    (root / "camera.yaml").unlink()
    (tmp_path / "other.yaml").write_text(yaml.safe_dump(camera))
    poses = "\n".join(f"{t:.4f} {k} 0 0 0 0 0 1" for k, t in enumerate(STAMPS)) + f"\n{STAMPS[-1] + 9} 9 0 0 0 0 0 1\n"
    (root / "groundtruth.txt").write_text(poses)
    dataset = open_dataset(root, tmp_path / "other.yaml")
    assert dataset.rig.depth_shutter.scan == "bottom-top" and dataset.rig.depth_camera.distortion[0] == 0.1
    np.testing.assert_allclose(dataset.rig.T_color_depth, T_color_depth, atol=1e-12)
    np.testing.assert_array_equal(dataset.frame(0).depth.pixels, (depth_units(0) / 1000).astype(np.float32))
    assert dataset.truth_poses is not None
    np.testing.assert_allclose(dataset.truth_poses.T_world_cam[0], T_color_depth, atol=1e-12)
    assert dataset.truth_poses.positions[3, 0] == pytest.approx(3 + T_color_depth[0, 3])


REGISTERED = COLOR | {"registered": True}


def test_registered_depth_keeps_its_rows_times(tmp_path: Path) -> None:
    root = make_tum(tmp_path / "tum", {"color": COLOR, "depth": REGISTERED | {"readout_s": 0.02, "scan": "bottom-top"}})
    dataset = open_dataset(root)
    assert dataset.rig.depth_shutter == Shutter(0.02, 0.0, "bottom-top")
    np.testing.assert_array_equal(dataset.stamps, STAMPS)
    # No readout: the whole image at mid readout of colour.
    write_camera(root, {"color": COLOR, "depth": REGISTERED | {"readout_s": 0.0}})
    dataset = open_dataset(root)
    assert dataset.rig.depth_shutter == Shutter()
    np.testing.assert_allclose(dataset.stamps - STAMPS, 0.014, atol=1e-6)
    # A sensor of 48 lines, twice as fine and seven lines off: of its 0.03 s the 24 rows see every second line.
    sensor = {"width": 64, "height": 48, "intrinsics": [48.0, 50.0, 31.0, 16.0]}
    write_camera(root, {"color": COLOR, "depth": REGISTERED | {"readout_s": 0.03, "sensor": sensor}})
    dataset = open_dataset(root)
    assert dataset.rig.depth_shutter.readout_s == pytest.approx(0.03, rel=1e-9)
    np.testing.assert_allclose(dataset.stamps - STAMPS, (16.0 - 2 * 11.5) * 0.03 / 48, atol=1e-6)


def test_depths_pattern_is_whole_or_none_or_looked_for(tmp_path: Path) -> None:
    for stated, held in (([], ()), ("auto", None), ([0.001] * 27, (0.001,) * 27)):
        root = make_tum(tmp_path / str(stated)[:4], {"color": COLOR, "depth": COLOR | {"error": {"pattern": stated}}})
        seen = open_dataset(root)
        assert seen.depth_error.pattern == held and wants_pattern(seen) == (held is None)
    write_camera(root, {"color": COLOR, "depth": COLOR | {"error": {"pattern": [0.1, 0.2]}}})
    with pytest.raises(UserError, match=r"camera\.yaml: .*pattern has 2 values: give the 27"):
        open_dataset(root)


def test_a_sensor_without_registration_or_sight_is_refused(tmp_path: Path) -> None:
    sensor = {"width": 64, "height": 48, "intrinsics": [48.0, 50.0, 31.0, 23.0]}
    root = make_tum(tmp_path / "tum", {"color": COLOR, "depth": COLOR | {"sensor": sensor}})
    with pytest.raises(UserError, match=r"add 'registered: true'"):
        open_dataset(root)
    behind = np.diag([-1.0, 1.0, -1.0, 1.0]).tolist()
    write_camera(root, {"color": COLOR, "depth": REGISTERED | {"sensor": sensor | {"T_color_sensor": behind}}})
    with pytest.raises(UserError, match=r"camera\.yaml: depth\.sensor: does not see"):
        open_dataset(root)


def jittered_tum(root: Path, **camera: Any) -> tuple[np.ndarray, np.ndarray]:
    """40 images a stream that arrive up to 4 ms late, colour said 10 ms too early; true depth and colour times."""
    make_tum(root, {"color": COLOR | {"offset_s": 0.01}} | camera)
    rng = np.random.default_rng(11)
    depth = 1305031102.0 + np.arange(40) / 30
    color = depth + 0.012
    for name, times in (("depth", depth), ("rgb", color - 0.01)):
        stamps = times + rng.uniform(0.0, 4e-3, 40)
        write_listing(root / f"{name}.txt", [f"{t:.6f} {name}/{STAMPS[0]:.4f}.png" for t in stamps])
    return depth, color


def test_a_run_json_opens_the_folder_as_the_run_saw_it(tmp_path: Path) -> None:
    """Readouts, lenses, extrinsics, clocks, depth's scale and error, and offsets of registered depth, to the bit."""
    lens = {"model": "radtan", "distortion": [0.1, -0.05, 0.001, 0.002], "scan": "bottom-top", "exposure_s": 0.004}
    sensor = {"width": 64, "height": 48, "intrinsics": [48.0, 50.0, 31.0, 23.0]}
    moved = se3.exp(np.array([0.05, 0.01, 0.0, 0.02, -0.01, 0.03])).tolist()
    error = {"offset_m": 0.01, "inverse_offset": 0.02, "radial": -0.01, "pattern": [0.001 * n for n in range(27)]}
    asked: list[dict[str, Any]] = [
        {"depth": COLOR | lens | {"depth_scale": 1000, "error": error}, "T_color_depth": moved, "stamps": "regular"},
        {"depth": REGISTERED | {"sensor": sensor}, "stamps": "raw"},
        {"depth": REGISTERED | {"readout_s": 0.0, "offset_s": 0.003}, "color": COLOR | {"drift_ppm": 900.0}},
        {},
    ]
    for k, camera in enumerate(asked):
        root, run = tmp_path / f"tum{k}", tmp_path / f"run{k}"
        jittered_tum(root, **camera)
        (root / "groundtruth.txt").write_text("".join(f"{t:.4f} {t - STAMPS[0]} 0 0 0 0 0 1\n" for t in STAMPS))
        seen = open_dataset(root)
        info = settings(seen, range(40), Options(), Noise())
        write_estimate(run, STAMPS, np.tile(np.eye(4), (4, 1, 1)), None, info)
        write_camera(root, {"color": COLOR | {"readout_s": 0.001, "offset_s": 0.5}})
        again = open_tracked(root, run, read_estimate(run).info)
        assert again.rig.depth_camera == seen.rig.depth_camera and again.rig.depth_shutter == seen.rig.depth_shutter
        assert again.rig.color_camera == seen.rig.color_camera and again.rig.color_shutter == seen.rig.color_shutter
        assert again.rig.is_registered == seen.rig.is_registered and again.depth_error == seen.depth_error
        np.testing.assert_allclose(again.rig.T_color_depth, seen.rig.T_color_depth, atol=1e-15)
        np.testing.assert_array_equal(again.stamps, seen.stamps)
        np.testing.assert_allclose(again.color_stamps, seen.color_stamps, rtol=0, atol=1e-6)
        np.testing.assert_array_equal(again.depth(0), seen.depth(0))
        assert again.truth_poses is not None and seen.truth_poses is not None
        np.testing.assert_allclose(again.truth_poses.T_world_cam, seen.truth_poses.T_world_cam, atol=1e-12)
        named = open_tracked(root, run, info, root / "camera.yaml")
        assert named.rig.color_shutter.readout_s == 0.001 and named.rig != seen.rig
        del info["dataset"]["camera"]
        assert open_tracked(root, run, info).rig.color_shutter.readout_s == 0.001
    write_estimate(run, STAMPS, np.tile(np.eye(4), (4, 1, 1)), None, info)
    with pytest.raises(UserError, match=r"run\.json: states no cameras"):
        open_dataset(root, run / "run.json")
    write_estimate(
        run, STAMPS, np.tile(np.eye(4), (4, 1, 1)), None, {"dataset": {"camera": {"color": COLOR | {"x": 1}}}}
    )
    with pytest.raises(UserError, match=r"run\.json: color\.x: no such entry"):
        open_tracked(root, run, read_estimate(run).info)


def test_arrival_times_are_straightened_and_colour_is_shifted_and_grouped(tmp_path: Path) -> None:
    depth, color = jittered_tum(tmp_path / "tum")
    dataset = open_dataset(tmp_path / "tum")
    timing = dataset.timing
    assert timing is not None and timing.depth.is_even and timing.color.is_even and not timing.wants_color_offset
    for found, true in ((dataset.stamps, depth), (dataset.color_stamps, color)):
        assert (found - true).std() < 0.5e-3 and np.abs(np.mean(found - true) - 2e-3) < 1e-3
    assert dataset.groups == tuple((k,) for k in range(40))
    shifted = dataset.with_color_offset(0.01 + 1 / 30)
    assert shifted.groups[:2] == ((), (0,)) and shifted.timing is not None
    np.testing.assert_allclose(shifted.color_stamps - dataset.color_stamps, 1 / 30, atol=1e-6)
    assert dataset.as_seen_by({"clocks": {"color_offset_s": 0.02}}).color_stamps[0] > dataset.color_stamps[0]
    assert dataset.as_seen_by({"clocks": None}) is dataset
    text = "\n".join(timing.lines())
    assert "depth: 33.3" in text and "RMS straightened" in text and "+10.0 ms added" in text


def test_stamps_raw_regular_and_auto(tmp_path: Path) -> None:
    root = tmp_path / "tum"
    jittered_tum(root, stamps="raw")
    dataset = open_dataset(root)
    listed = [float(line.split()[0]) for line in (root / "depth.txt").read_text().splitlines()[2:]]
    np.testing.assert_array_equal(dataset.stamps, listed)
    steps = np.random.default_rng(12).uniform(0.02, 0.06, 40)
    write_listing(root / "depth.txt", [f"{t:.6f} depth/{STAMPS[0]:.4f}.png" for t in np.cumsum(steps)])
    write_camera(root, {"color": COLOR, "stamps": "auto"})
    timing = open_dataset(root).timing
    assert timing is not None and not timing.depth.is_even and "no steady clock" in timing.lines()[0]
    write_camera(root, {"color": COLOR, "stamps": "regular"})
    with pytest.raises(UserError, match=r"tum: depth stamps follow no steady clock"):
        open_dataset(root)


@pytest.mark.parametrize("depth_first", [True, False])
def test_icl_folder_of_associations_alone(tmp_path: Path, depth_first: bool) -> None:
    root = make_tum(tmp_path / "icl")
    (root / "rgb.txt").unlink()
    (root / "depth.txt").unlink()
    names = [(f"{k + 1} depth/{t:.4f}.png", f"{k + 1} rgb/{t:.4f}.png") for k, t in enumerate(STAMPS)]
    (root / "associations.txt").write_text("\n".join(" ".join(pair if depth_first else pair[::-1]) for pair in names))
    (root / "livingRoom0.gt.freiburg").write_text("".join(f"{k} 0 0 {-2.25 + k} 0 0 0 1\n" for k in range(1, 6)))
    dataset = open_dataset(root)
    np.testing.assert_allclose(dataset.stamps, np.arange(1, 5) / 30, atol=1e-12)
    np.testing.assert_array_equal(dataset.frame(1).colors[0].pixels, color_pixels(1))
    np.testing.assert_array_equal(dataset.frame(1).depth.pixels, (depth_units(1) / 5000).astype(np.float32))
    assert dataset.truth_poses is not None and dataset.truth_poses.stamps[0] == dataset.stamps[0]
    assert dataset.truth_poses.positions[0, 2] == pytest.approx(1)


def test_an_image_associated_twice_is_read_once(tmp_path: Path) -> None:
    root = make_tum(tmp_path / "tum")
    (root / "rgb.txt").unlink()
    a, b, c = (f"{t:.4f}" for t in STAMPS[:3])
    (root / "associations.txt").write_text(f"{a} rgb/{a}.png {a} depth/{a}.png\n{a} rgb/{a}.png {b} depth/{b}.png\n")
    dataset = open_dataset(root)
    assert dataset.groups == ((0,), ())
    # With both listings there, the associations are not needed.
    write_listing(root / "rgb.txt", [f"{t} rgb/{t}.png" for t in (c, a, b)])
    dataset = open_dataset(root)
    assert dataset.groups == ((0,), (1,), (2,), ())
    np.testing.assert_array_equal(dataset.frame(2).colors[0].pixels, color_pixels(2))


def test_images_that_are_the_one_before_again_are_left_out(tmp_path: Path) -> None:
    root = make_tum(tmp_path / "tum")
    first, second, *_ = (root / f"depth/{t:.4f}.png" for t in STAMPS)
    second.write_bytes(first.read_bytes())
    dataset = open_dataset(root)
    assert dataset.stamps.tolist() == [STAMPS[0], *STAMPS[2:]] and len(dataset.color_stamps) == 4
    np.testing.assert_allclose(dataset.frame(1).depth.pixels, depth_units(2) / 5000.0, rtol=1e-6)
    assert dataset.notes == (
        "1 of 4 depth images are the one before again, byte for byte: they were not taken anew, and are left out",
    )


def test_a_long_row_of_the_same_image_is_a_camera_at_rest(tmp_path: Path) -> None:
    paths = [tmp_path / f"{k}.png" for k in range(80)]
    for k, path in enumerate(paths):
        path.write_bytes(b"rest" if 10 <= k < 60 else b"a new one" if k == 70 else bytes([k // 2]))
    again = repeated([*paths, tmp_path / "missing.png"])
    assert np.flatnonzero(again[:10]).tolist() == [1, 3, 5, 7, 9] and not again[10:60].any()
    assert np.flatnonzero(again[60:]).tolist() == [1, 3, 5, 7, 9, 13, 15, 17, 19]
    assert not repeated(paths[20:24]).any()
    assert repeated([]).shape == (0,)


def test_grey_alpha_and_jpeg_colour_images_become_rgb(tmp_path: Path) -> None:
    root = make_tum(tmp_path / "tum")
    names = [root / f"rgb/{t:.4f}.png" for t in STAMPS]
    grey = color_pixels(0)[..., 0]
    cv2.imwrite(str(names[0]), grey)
    cv2.imwrite(str(names[1]), np.dstack([color_pixels(1)[..., ::-1], grey]))
    ramp = np.tile(np.linspace(0, 200, WIDTH, dtype=np.uint8)[:, None], (HEIGHT, 1, 1)) + np.array(
        [0, 20, 50], np.uint8
    )
    names[2].write_bytes(cv2.imencode(".jpg", ramp[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes())
    images = [frame.colors[0].pixels for frame in open_dataset(root).frames(0, 3)]
    np.testing.assert_array_equal(images[0], np.repeat(grey[..., None], 3, axis=2))
    np.testing.assert_array_equal(images[1], color_pixels(1))
    assert images[2].shape == (HEIGHT, WIDTH, 3) and np.abs(images[2].astype(int) - ramp).mean() < 3


# --- OpenCV calibration ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("readout", "seconds"),
    [
        ({"readout_time": 28.0}, 0.028), ({"readout": 0.028}, 0.028), ({"readout_ms": 0.5}, 0.0005),
        ({"readout_s": 0.028}, 0.028), ({"rolling_shutter_readout_time": 28}, 0.028), ({"Readout": 0.0}, 0.0),
    ],
)  # fmt: skip
def test_opencv_calibration_of_one_camera(tmp_path: Path, readout: dict[str, Any], seconds: float) -> None:
    root = make_tum(tmp_path / "tum")
    write_opencv(root, camera_matrix=K, distortion_coefficients=[0.0] * 5, anything="else", **readout)
    rig = open_dataset(root).rig
    for camera, shutter in ((rig.color_camera, rig.color_shutter), (rig.depth_camera, rig.depth_shutter)):
        assert (camera.width, camera.height, camera.fx, camera.cy) == (WIDTH, HEIGHT, 24.0, 11.5)
        assert camera.model == "pinhole" and shutter.readout_s == pytest.approx(seconds, abs=1e-15)


@pytest.mark.parametrize("header", ["%YAML:1.0", "%YAML 1.2"])
def test_opencv_calibration_of_two_cameras(tmp_path: Path, header: str) -> None:
    root = make_tum(tmp_path / "tum")
    T = np.eye(4)
    T[0, 3] = 0.025
    path = write_opencv(
        root, header, rgb_intrinsics=[30.0, 31.0, 14.0, 13.0], depth_camera_matrix=K, rgb_readout=28.0,
        readout=5.0, depth_readout=20.0, rgb_distortion=[0.1, -0.1, 0.001, 0.002, 0.0],
        image_width=WIDTH, image_height=HEIGHT, exposure=0.005, depth_scale=1000.0, extrinsics=T.tolist(),
    )  # fmt: skip
    assert "!!opencv-matrix" in path.read_text()
    dataset = open_dataset(root)
    rig = dataset.rig
    assert (rig.color_camera.fx, rig.depth_camera.fx) == (30.0, 24.0)
    assert rig.color_camera.model == "radtan" and rig.color_camera.distortion == (0.1, -0.1, 0.001, 0.002, 0.0)
    assert (rig.color_shutter.readout_s, rig.depth_shutter.readout_s) == (pytest.approx(0.028), pytest.approx(0.02))
    assert rig.color_shutter.exposure_s == rig.depth_shutter.exposure_s == 0.005
    assert rig.T_color_depth[0, 3] == 0.025
    np.testing.assert_array_equal(dataset.frame(0).depth.pixels, (depth_units(0) / 1000).astype(np.float32))


def test_opencv_calibration_nested_and_by_scalars(tmp_path: Path) -> None:
    root = make_tum(tmp_path / "tum")
    (root / "camera.yaml").unlink()
    text = (
        "%YAML:1.0\n---\nrgb:\n   fx: 24.\n   fy: 25.\n   cx: 15.5\n   cy: 11.5\n   readout: 28\nDepth.readout: 30.\n"
    )
    (root / "calibration.yaml").write_text(text)
    rig = open_dataset(root).rig
    assert rig.depth_camera == rig.color_camera and rig.color_camera.cx == 15.5
    assert (rig.color_shutter.readout_s, rig.depth_shutter.readout_s) == (pytest.approx(0.028), pytest.approx(0.03))
