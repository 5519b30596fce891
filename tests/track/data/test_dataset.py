"""Datasets: sequences as frames, grouping of streams, reading ahead."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest
from synthetic import DURATION_S, T_COLOR_DEPTH, make_config, make_sequence
from tum_recording import (
    STAMPS,
    make_tum,
)

from rsgen.errors import UserError
from rsgen.sequence.reader import read_sequence
from rstrack.data.dataset import group_colors, open_dataset
from rstrack.data.image_files import prefetched


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
    assert dataset.sequence is not None
    rows = dataset.sequence.rows("depth")
    assert rows.shape == (9, rig.depth_camera.height, 7)
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


def test_rendered_time_span_is_covered(uneven: Path) -> None:
    dataset = open_dataset(uneven)
    assert dataset.truth is not None
    assert dataset.truth.t_begin <= dataset.stamps[0] and dataset.truth.t_end >= DURATION_S


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
