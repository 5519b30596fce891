"""Datasets: sequences and foreign folders as frames, grouping of streams, reading ahead, one line for each fault."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from synthetic import DURATION_S, T_COLOR_DEPTH, make_config, make_sequence

from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.shutter import Shutter
from rsgen.sequence.reader import read_sequence
from rstrack.data.dataset import group_colors, open_dataset
from rstrack.data.image_files import repeated
from rstrack.data.prefetch import prefetched

WIDTH, HEIGHT = 32, 24
STAMPS = (1305031102.1758, 1305031102.2091, 1305031102.2424, 1305031102.2757)
INTRINSICS = [24.0, 25.0, 15.5, 11.5]
COLOR = {"width": WIDTH, "height": HEIGHT, "intrinsics": INTRINSICS, "readout_s": 0.028}


def color_pixels(k: int) -> np.ndarray:
    return np.random.default_rng([1, k]).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def depth_units(k: int) -> np.ndarray:
    return np.random.default_rng([2, k]).integers(0, 65536, (HEIGHT, WIDTH), dtype=np.uint16)


def write_listing(path: Path, lines: list[str]) -> None:
    path.write_text("# a comment\n\n" + "\n".join(lines) + "\n")


def make_tum(root: Path, camera: dict[str, Any] | None = None) -> Path:
    """A TUM folder of four depth and four colour images."""
    (root / "rgb").mkdir(parents=True)
    (root / "depth").mkdir()
    for k, stamp in enumerate(STAMPS):
        cv2.imwrite(str(root / f"rgb/{stamp:.4f}.png"), color_pixels(k)[..., ::-1])
        cv2.imwrite(str(root / f"depth/{stamp:.4f}.png"), depth_units(k))
    write_listing(root / "rgb.txt", [f"{t:.4f} rgb/{t:.4f}.png" for t in STAMPS])
    write_listing(root / "depth.txt", [f"{t:.4f} depth/{t:.4f}.png" for t in STAMPS])
    write_camera(root, {"color": COLOR} if camera is None else camera)
    return root


def write_camera(root: Path, camera: dict[str, Any]) -> None:
    (root / "camera.yaml").write_text(yaml.safe_dump(camera))


@pytest.fixture(scope="module")
def uneven(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sequence whose colour runs at 45 Hz and 7 ms late, with another shutter, and has lost two images."""
    color = {"rate_hz": 45.0, "offset_s": 0.007, "readout_s": 0.01, "exposure_s": 0.002, "scan": "right-left"}
    root = make_sequence(tmp_path_factory.mktemp("uneven") / "seq", make_config(color=color), frames=9)
    listing = root / "rgb.txt"
    lines = [line for line in listing.read_text().splitlines() if not line.endswith(("3.png", "4.png"))]
    listing.write_text("\n".join(lines) + "\n")
    return root


# --- rsgen sequences -------------------------------------------------------------------------------------------------


def test_sequence_gives_images_cameras_and_truth(uneven: Path) -> None:
    dataset, sequence = open_dataset(uneven), read_sequence(uneven)
    rig = dataset.rig
    assert (dataset.name, len(dataset), len(dataset.color_stamps)) == ("synthetic", 9, 7)
    assert (rig.depth_camera, rig.color_camera) == tuple(sequence.streams[name].camera for name in ("depth", "color"))
    assert (rig.depth_shutter.readout_s, rig.depth_shutter.scan) == (0.028, "top-bottom")
    assert (rig.color_shutter.readout_s, rig.color_shutter.exposure_s) == (0.01, 0.002)
    assert rig.color_shutter.scan == "right-left"
    np.testing.assert_allclose(rig.T_color_depth, T_COLOR_DEPTH, atol=1e-12)
    for k, frame in enumerate(dataset.frames()):
        np.testing.assert_array_equal(frame.depth.pixels, sequence.depth(k))
        assert frame.depth.pixels.dtype == np.float32 and frame.depth.stamp == sequence.streams["depth"].stamps[k]
        for image in frame.colors:
            i = int(np.flatnonzero(sequence.streams["color"].stamps == image.stamp)[0])
            np.testing.assert_array_equal(image.pixels, sequence.color(i))
    assert dataset.truth is not None and dataset.truth_poses is None
    rows = dataset.rows("depth")
    assert rows is not None and rows.shape == (9, rig.depth_camera.height, 7)
    middle = rig.depth_shutter.line_mid_time(dataset.stamps[4], 20, rig.depth_camera)
    np.testing.assert_allclose(rows[4, 20, :3], dataset.truth.pose(middle)[:3, 3], atol=1e-9)


def test_colours_go_with_the_nearest_depth_whatever_the_rates_and_dropouts(uneven: Path) -> None:
    dataset = open_dataset(uneven)
    for k, group in enumerate(dataset.groups):
        for i in group:
            assert np.argmin(np.abs(dataset.stamps - dataset.color_stamps[i])) == k
    assert [i for group in dataset.groups for i in group] == list(range(7))
    # 7 ms + (0, 1, 2, 5 ... 8) / 45 s next to k / 30 s; numbers 3 and 4 are lost.
    assert [len(group) for group in dataset.groups] == [1, 1, 1, 0, 2, 1, 1, 0, 0]


def test_grouping_equals_brute_force_and_ties_go_to_the_earlier() -> None:
    rng = np.random.default_rng(5)
    for trial in range(50):
        depth = np.sort(rng.uniform(0, 1, rng.integers(1, 12)))
        color = np.sort(rng.uniform(-0.2, 1.2, rng.integers(1, 25)))
        expected: list[list[int]] = [[] for _ in depth]
        for i, t in enumerate(color):
            expected[int(np.argmin(np.abs(depth - t)))].append(i)
        assert group_colors(depth, color) == tuple(map(tuple, expected)), trial
    assert group_colors([0.0, 1.0, 2.0], [0.5, 1.5, 2.5]) == ((0,), (1,), (2,))
    # Half a period apart, but for the last digits.
    unix = 1305031102.0 + np.arange(20) / 30
    for jitter in (-3e-7, 3e-7):
        assert group_colors(unix, unix + 1 / 60 + jitter) == tuple((k,) for k in range(20))


def test_a_range_of_frames_and_single_frames(uneven: Path) -> None:
    dataset = open_dataset(uneven)
    assert [frame.depth.stamp for frame in dataset.frames(2, 5)] == list(dataset.stamps[2:5])
    assert [frame.depth.stamp for frame in dataset.frames(7, None, prefetch=100)] == list(dataset.stamps[7:])
    np.testing.assert_array_equal(dataset.frame(3).depth.pixels, read_sequence(uneven).depth(3))
    for k in (-1, 9):
        with pytest.raises(IndexError, match="frames 0 to 8"):
            dataset.frame(k)


def test_a_camera_file_for_a_sequence_stands_in_for_its_cameras(uneven: Path, tmp_path: Path) -> None:
    plain, file = open_dataset(uneven), tmp_path / "camera.yaml"
    depth, color = plain.rig.depth_camera, plain.rig.color_camera
    sizes = [f"width: {c.width}, height: {c.height}, intrinsics: [50, 50, 31, 23]" for c in (depth, color)]
    clock = "offset_s: 0.003, drift_ppm: 200"
    file.write_text(f"depth: {{{sizes[0]}, readout_s: 0.01}}\ncolor: {{{sizes[1]}, readout_s: 0.02, {clock}}}")
    told = open_dataset(uneven, file)
    assert told.rig.depth_camera.fx == 50.0 and told.rig.color_shutter.readout_s == 0.02 and not told.scan_named
    expected = plain.color_stamps + 0.003 + 2e-4 * (plain.color_stamps - plain.stamps[len(plain) // 2])
    np.testing.assert_allclose(told.color_stamps, expected, atol=1e-12)
    assert told.truth is not None and (told.stamps == plain.stamps).all()
    file.write_text("color: {width: 8, height: 6, intrinsics: [5, 5, 3, 2], readout_s: 0.01}")
    with pytest.raises(
        UserError, match=r"camera\.yaml: cameras \(colour and depth\) of 8x6 and 8x6 pixels, but images"
    ):
        open_dataset(uneven, file)


# --- reading ahead ---------------------------------------------------------------------------------------------------


def threads() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name.startswith("prefetch")]


def test_stopping_early_leaves_no_thread_and_loads_no_more() -> None:
    loaded: list[int] = []

    def load(k: int) -> int:
        loaded.append(k)
        return k

    iterator = prefetched(load, range(1000), 3)
    assert threads() == []
    assert next(iterator) == 0 and next(iterator) == 1
    assert len(threads()) == 1
    iterator.close()  # type: ignore[attr-defined]
    assert threads() == [] and max(loaded) <= 4

    for k in prefetched(load, range(1000), 2):
        if k == 5:
            break
    assert threads() == []
    assert list(prefetched(load, range(20), 2)) == list(range(20)) and threads() == []


def test_the_next_image_is_loaded_while_this_one_is_used() -> None:
    begun = [threading.Event() for _ in range(3)]

    def load(k: int) -> int:
        begun[k].set()
        return k

    for k in prefetched(load, range(3), 1):
        assert begun[min(k + 1, 2)].wait(timeout=5), "the thread waits for the consumer"


def test_an_error_in_the_thread_surfaces_in_its_turn(tmp_path: Path) -> None:
    root = make_tum(tmp_path / "tum")
    dataset = open_dataset(root)
    broken = root / f"depth/{STAMPS[2]:.4f}.png"
    broken.write_bytes(broken.read_bytes()[:-40])
    seen = []
    with pytest.raises(UserError, match=rf"{STAMPS[2]:.4f}\.png: is not a whole image \(truncated\)"):
        for frame in dataset.frames():
            seen.append(frame.depth.stamp)
    assert seen == list(dataset.stamps[:2])
    assert threads() == []


# --- TUM and ICL-NUIM ------------------------------------------------------------------------------------------------


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
    assert dataset.rows("color") is None


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


def write_opencv(root: Path, header: str = "%YAML:1.0", **entries: Any) -> Path:
    """calibration.yaml as OpenCV itself writes it, matrices and all; the header by default that of versions 2 to 4."""
    path = root / "calibration.yaml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in entries.items():
        storage.write(name, np.atleast_2d(value).astype(float) if isinstance(value, list) else value)
    storage.release()
    first, _, rest = path.read_text().partition("\n")
    assert first.startswith("%YAML")
    path.write_text(f"{header}\n{rest}")
    (root / "camera.yaml").unlink(missing_ok=True)
    return path


K = [[24.0, 0, 15.5], [0, 25.0, 11.5], [0, 0, 1]]


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


# --- faults ----------------------------------------------------------------------------------------------------------

COLOR_0, DEPTH_0 = f"rgb/{STAMPS[0]:.4f}.png", f"depth/{STAMPS[0]:.4f}.png"
Fault = Callable[[Path], object]


def listing(name: str, *lines: str) -> Fault:
    return lambda root: (root / name).write_text("\n".join(lines))


def remove(*names: str) -> Fault:
    return lambda root: list(map(Path.unlink, map(root.joinpath, names)))


def camera(**changes: Any) -> Fault:
    return lambda root: write_camera(root, {"color": COLOR | changes})


def rewrite(name: str, change: Callable[[bytes], bytes]) -> Fault:
    return lambda root: (root / name).write_bytes(change((root / name).read_bytes()))


def opencv(**entries: Any) -> Fault:
    return lambda root: write_opencv(root, **entries)


def flip(data: bytes) -> bytes:
    return data[:70] + bytes([data[70] ^ 4]) + data[71:]


def jpeg_start(_: bytes) -> bytes:
    return cv2.imencode(".jpg", color_pixels(0))[1].tobytes()[:-300]


def image(name: str, pixels: np.ndarray) -> Fault:
    return lambda root: cv2.imwrite(str(root / name), pixels)


def outside(root: Path) -> None:
    (root.parent / "secret.png").write_bytes((root / DEPTH_0).read_bytes())
    (root / DEPTH_0).unlink()
    (root / DEPTH_0).symlink_to(root.parent / "secret.png")


FAULTS: dict[str, tuple[Fault, str]] = {
    "no listings": (remove("rgb.txt", "depth.txt"), "neither an rsgen sequence"),
    "no colour listing": (remove("rgb.txt"), r"rgb\.txt: cannot be read"),
    "empty listing": (listing("depth.txt", ""), r"depth\.txt: is empty"),
    "comments only": (listing("depth.txt", "# nothing", ""), r"depth\.txt: lists no image"),
    "binary listing": (lambda root: (root / "rgb.txt").write_bytes(b"\xff\xfe\x00"), r"rgb\.txt: is not a text file"),
    "three columns": (listing("depth.txt", f"0.0 {DEPTH_0} x"), r"depth\.txt line 1: expected 'stamp path"),
    "no number": (listing("depth.txt", f"zero {DEPTH_0}"), r"depth\.txt line 1: 'zero' is not a time"),
    "nan stamp": (listing("rgb.txt", f"nan {COLOR_0}"), r"rgb\.txt line 1: 'nan' is not a time"),
    "nanoseconds": (listing("rgb.txt", f"1305031102175800000 {COLOR_0}"), r"line 1: stamp .* divide"),
    "back in time": (listing("depth.txt", f"0.5 {DEPTH_0}", f"0.4 {DEPTH_0}"), r"depth\.txt line 2: .*does not come"),
    "repeated stamp": (listing("depth.txt", "#", f"0.5 {DEPTH_0}", f"0.5 {DEPTH_0}"), "line 3: repeats the stamp 0.5"),
    "two colours at once": (listing("rgb.txt", f"0.5 {COLOR_0}", f"0.5 {DEPTH_0}"), r"rgb\.txt line 2: repeats"),
    "missing image": (listing("depth.txt", f"0.1 {DEPTH_0}", "0.2 depth/x.png"), r"line 2: .*depth/x\.png is missing"),
    "absolute path": (listing("depth.txt", "0.1 /etc/hostname"), "line 1: path '/etc/hostname' leaves"),
    "parent path": (listing("depth.txt", "0.1 ../secret.png"), r"line 1: path '\.\./secret\.png' leaves"),
    "link out": (outside, r"depth\.txt line 3: .*leaves the folder"),
    "nul in path": (listing("depth.txt", "0.1 depth/\0.png"), "line 1: .*not a usable path"),
    "truncated depth": (rewrite(DEPTH_0, lambda data: data[:-30]), rf"{DEPTH_0}: .*truncated"),
    "flipped bit": (rewrite(DEPTH_0, flip), rf"{DEPTH_0}: .*checksum"),
    "truncated jpeg": (rewrite(COLOR_0, jpeg_start), rf"{COLOR_0}: .*truncated"),
    "empty image": (rewrite(COLOR_0, lambda _: b""), rf"{COLOR_0}: is empty"),
    "no image": (rewrite(COLOR_0, lambda _: b"hello"), rf"{COLOR_0}: .*neither PNG nor JPEG"),
    "small depth": (image(DEPTH_0, depth_units(0)[:-1]), rf"{DEPTH_0}: is 32x23, but the camera is 32x24"),
    "small colour": (image(COLOR_0, color_pixels(0)[:, :-2]), rf"{COLOR_0}: is 30x24, but the camera is 32x24"),
    "8-bit depth": (image(DEPTH_0, color_pixels(0)[..., 0]), rf"{DEPTH_0}: is a 8-bit grey image"),
    "16-bit colour": (image(COLOR_0, depth_units(0)), rf"{COLOR_0}: is a 16-bit grey image"),
    "no cameras": (remove("camera.yaml"), r"nothing tells the cameras: write .*camera\.yaml.*fx"),
    "broken yaml": (lambda root: (root / "camera.yaml").write_text("a: [\nb"), r"camera\.yaml: line 2 is not valid"),
    "empty camera": (lambda root: write_camera(root, {}), r"color: Field required; write e\.g\. 'color: \{width"),
    "unknown entry": (camera(redout_s=0.0), r"color\.redout_s: no such entry"),
    "no readout": (lambda root: write_camera(root, {"color": {"width": 32}}), "Field required; write"),
    "three intrinsics": (camera(intrinsics=[1, 2, 3]), r"color\.intrinsics\.3"),
    "y-up camera": (camera(intrinsics=[481.2, -480.0, 319.5, 239.5]), r"color\.intrinsics: fy = -480 .*write 480"),
    "no focal length": (camera(intrinsics=[0, 1, 2, 3]), r"camera\.yaml: color: camera: fx = 0"),
    "bad distortion": (camera(model="radtan", distortion=[1.0]), "radtan takes 4 or 5"),
    "skewed extrinsics": (
        lambda root: write_camera(root, {"color": COLOR, "T_color_depth": (2 * np.eye(4)).tolist()}),
        "T_color_depth: not a rigid transform",
    ),
    "opencv, empty": (opencv(), "no camera matrix for color: add .*keys that are there: none"),
    "opencv, no readout": (opencv(K=K, foo=1.0), "no readout time for color: add 'readout_s.*are there: k, foo"),
    "opencv, no matrix": (opencv(readout=28.0), "no camera matrix for color: .*are there: readout"),
    "opencv, 2x2 matrix": (opencv(K=[[1.0, 0], [0, 1]], readout=28.0), "camera matrix of color is neither"),
    "opencv, y-up": (opencv(K=[24.0, -25, 15, 11], readout=28.0), "fy = -25 .*write 25"),
    "opencv, negative readout": (opencv(K=K, readout=-1.0), r"color shutter: readout_s = -1"),
    "opencv, word for readout": (opencv(K=K, readout="soon"), r"color shutter: readout_s = nan"),
    "opencv, odd width": (opencv(K=K, readout=0.0, width=31.5), "color camera: width"),
    "opencv, metres per unit": (opencv(K=K, readout=0.0, depth_scale=0.001), "depth_scale 0.001 is not a number of un"),
    "opencv, damaged": (
        lambda root: write_opencv(root, K=K).write_text("%YAML:1.0\nK: !!opencv-matrix\n  rows: 3\n"),
        r"calibration\.yaml: line 2 is not valid OpenCV YAML",
    ),
    "associations of one kind": (
        lambda root: [
            remove("rgb.txt")(root),
            listing("associations.txt", f"0.1 {DEPTH_0} 0.1 {DEPTH_0}")(root),
        ],
        r"associations\.txt line 1: has two depth images",
    ),
    "truth damaged": (listing("groundtruth.txt", "1 2 3"), r"groundtruth\.txt holds 1 poses"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_every_fault_is_one_line_that_says_where(fault: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    damage, message = FAULTS[fault]
    root = make_tum(tmp_path / "tum")
    damage(root)
    with pytest.raises(UserError, match=message) as error:
        open_dataset(root).frame(0)
    assert "\n" not in str(error.value) and len(str(error.value)) < 700
    assert capfd.readouterr() == ("", ""), "a decoder complained"


@pytest.mark.parametrize("name", ["camera.yaml", "calibration.yaml", "rgb.txt", "depth.txt", COLOR_0, DEPTH_0])
def test_no_garbage_raises_anything_but_one_line(name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    root = make_tum(tmp_path / "tum")
    if name == "calibration.yaml":
        write_opencv(root, camera_matrix=K, readout=28.0, D=[0.1, 0.2, 0.0, 0.0])
    whole, rng, refused = (root / name).read_bytes(), np.random.default_rng(8), 0
    for _ in range(40):
        data = bytearray(whole)
        for at in rng.integers(0, len(data), rng.integers(1, 6)):
            data[at] = rng.integers(0, 256)
        (root / name).write_bytes(bytes(data[: rng.integers(1, len(data) + 1)] if rng.random() < 0.3 else data))
        try:
            open_dataset(root).frame(0)
        except UserError as error:
            refused += 1
            assert "\n" not in str(error), error
    assert refused > 10
    assert capfd.readouterr().err == "", "a decoder complained"


def test_no_such_folder(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such folder"):
        open_dataset(tmp_path / "nowhere")
    with pytest.raises(UserError, match=r"lost\.yaml: cannot be read"):
        open_dataset(make_tum(tmp_path / "tum"), tmp_path / "lost.yaml")


def test_rendered_time_span_is_covered(uneven: Path) -> None:
    dataset = open_dataset(uneven)
    assert dataset.truth is not None
    assert dataset.truth.t_begin <= dataset.stamps[0] and dataset.truth.t_end >= DURATION_S
