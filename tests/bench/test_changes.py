"""Changed datasets against their definitions and against a renderer."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import synthetic
from changed_frames import colors, depths, true_positions

from rsgen.errors import UserError
from rsgen.geometry.shutter import Scan
from rstrack.bench.changes import (
    CHANGES,
    camera_told,
    changed,
    color_late,
    darkened,
    depth_in_blocks,
    depth_told_global,
    flashed,
    gained,
    jittered,
    readout_told,
    reduced,
    reordered,
    swinging_gain,
    with_color,
    with_depth,
    with_stamps,
)
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.data.rig import sigma_of_file
from rstrack.data.timing import Timing, stream_timing

FRAMES = 30
SPLINE = synthetic.make_spline()


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    config = synthetic.make_config(32, 24, color={"offset_s": 0.004})
    return open_dataset(synthetic.make_sequence(tmp_path_factory.mktemp("s") / "seq", config, FRAMES))


def at(stamps: np.ndarray) -> np.ndarray:
    return SPLINE.pose(stamps)[:, :3, 3]


# --- changes ---------------------------------------------------------------------------------------------------------


def test_images_change_and_nothing_else(dataset: Dataset) -> None:
    doubled = with_depth(dataset, lambda k, z: z * (2 + k))
    np.testing.assert_allclose(depths(doubled), depths(dataset) * (2 + np.arange(FRAMES))[:, None, None], rtol=1e-6)
    np.testing.assert_array_equal(colors(doubled), colors(dataset))
    inverted = with_color(doubled, lambda _, pixels: 255 - pixels)
    np.testing.assert_array_equal(colors(inverted), 255 - colors(dataset))
    np.testing.assert_array_equal(depths(inverted), depths(doubled))
    assert inverted.truth is dataset.truth and inverted.stamps is dataset.stamps


def test_other_stamps_leave_the_truth_with_the_images(dataset: Dataset) -> None:
    stamps = dataset.stamps * 1.5 + 7.0
    moved = with_stamps(dataset, stamps, dataset.color_stamps * 1.5 + 7.0)
    np.testing.assert_allclose(true_positions(moved), at(dataset.stamps), atol=1e-9)
    assert moved.frame(3).depth.stamp == stamps[3] and moved.groups == dataset.groups
    with pytest.raises(UserError, match="must increase"):
        with_stamps(dataset, stamps[::-1], stamps)


def test_reordered_frames_bring_their_colours_and_their_truth(dataset: Dataset) -> None:
    shown = [5, 5, 2, 20]
    stamps = np.array([0.0, 0.1, 0.2, 0.3])
    made = reordered(dataset, shown, stamps)
    np.testing.assert_array_equal(depths(made), depths(dataset)[shown])
    np.testing.assert_array_equal(colors(made), colors(dataset)[shown])
    np.testing.assert_allclose([made.frame(k).colors[0].stamp for k in range(4)], stamps + 0.004)
    np.testing.assert_allclose(true_positions(made), at(dataset.stamps[shown]), atol=1e-9)
    swapped = reordered(dataset, shown, stamps, colors=[1, 2, 3, 4])
    np.testing.assert_array_equal(colors(swapped), colors(dataset)[[1, 2, 3, 4]])
    np.testing.assert_array_equal(depths(swapped), depths(dataset)[shown])
    # Twice is once: frames of frames.
    twice = reordered(made, [3, 0], stamps[:2])
    np.testing.assert_array_equal(colors(twice), colors(dataset)[[20, 5]])
    np.testing.assert_allclose(true_positions(twice), at(dataset.stamps[[20, 5]]), atol=1e-9)


@pytest.mark.parametrize("scan", ["top-bottom", "bottom-top", "left-right", "right-left"])
@pytest.mark.parametrize("factor", [2, 4])
def test_reduced_images_are_those_that_the_smaller_cameras_take(scan: Scan, factor: int, tmp_path: Path) -> None:
    # 34 x 27 pixels: what is cut off must not move lines' times.
    stream = {"scan": scan, "exposure_s": 0.004}
    config = synthetic.make_config(34, 35, color=stream, depth=stream)
    original = open_dataset(synthetic.make_sequence(tmp_path / "seq", config, 3))
    small = reduced(original, factor)
    rig = small.rig
    assert (rig.depth_camera.width, rig.depth_camera.height) == (34 // factor, 35 // factor)
    for k in range(3):
        frame = small.frame(k)
        z = synthetic.render_depth(SPLINE, rig.depth_camera, rig.depth_shutter, frame.depth.stamp)
        np.testing.assert_allclose(frame.depth.pixels, z, atol=2e-4)  # stored to 0.2 mm
        shot = frame.colors[0]
        image = synthetic.render_color(SPLINE, rig.color_camera, rig.color_shutter, shot.stamp, rig.T_color_depth)
        difference = np.abs(shot.pixels.astype(float) - image)
        wrong = dataclasses.replace(rig.color_camera, cx=rig.color_camera.cx + 0.5)
        other = synthetic.render_color(SPLINE, wrong, rig.color_shutter, shot.stamp, rig.T_color_depth)
        assert np.median(difference) < 0.5 * np.median(np.abs(shot.pixels.astype(float) - other))
    np.testing.assert_allclose(true_positions(small), at(small.stamps), atol=1e-9)


# --- cases -----------------------------------------------------------------------------------------------------------


def test_what_the_cases_change(dataset: Dataset) -> None:
    np.testing.assert_allclose(color_late(dataset, 0.01).color_stamps, dataset.color_stamps + 0.01)
    assert readout_told(dataset, shift_s=-0.003).rig.depth_shutter.readout_s == pytest.approx(0.025)
    assert readout_told(dataset, factor=0.7).rig.color_shutter.readout_s == pytest.approx(0.0196)
    assert readout_told(depth_told_global(dataset), shift_s=0.005).rig.depth_shutter.readout_s == 0.0
    rig = depth_told_global(dataset).rig
    assert (rig.depth_shutter.readout_s, rig.color_shutter.readout_s) == (0.0, 0.028)
    grey = np.array([[[0, 100, 250]]], np.uint8)
    assert gained(grey, 1.35).tolist() == [[[0, 135, 255]]] and gained(grey, 0.924).tolist() == [[[0, 92, 231]]]
    dark = colors(darkened(dataset)) / np.maximum(colors(dataset), 1)
    assert (dark[:10] == 1).mean() > 0.99 and np.median(dark[10:]) == pytest.approx(0.92, abs=0.01)
    lit = colors(flashed(with_color(dataset, lambda _, p: np.full_like(p, 100))))[:, 0, 0, 0]
    np.testing.assert_array_equal(lit, np.where(np.isin(np.arange(FRAMES), [8, 17, 26]), 200, 100))
    swung = with_color(swinging_gain(with_color(dataset, lambda _, p: np.full_like(p, 100)), 0.35), lambda _, p: p)
    expected = 100 * (1 + 0.35 * np.sin(2 * np.pi * np.arange(FRAMES) / 30.0))
    np.testing.assert_allclose(colors(swung)[:, 0, 0, 0], expected, atol=0.51)


def test_jitter_is_of_its_size_seeded_and_keeps_the_order(dataset: Dataset) -> None:
    many = dataclasses.replace(
        dataset, stamps=np.arange(3000) / 30.0, color_stamps=np.arange(3000) / 30.0, truth=None, sequence=None
    )
    made = jittered(many, 0.002, 1)
    errors = made.stamps - many.stamps, made.color_stamps - many.color_stamps
    for error in errors:
        assert error.std() == pytest.approx(0.002, rel=0.05) and abs(error.mean()) < 2e-4
    assert abs(np.corrcoef(*errors)[0, 1]) < 0.1
    np.testing.assert_array_equal(made.stamps, jittered(many, 0.002, 1).stamps)
    assert (made.stamps != jittered(many, 0.002, 2).stamps).all()
    assert (np.diff(jittered(many, 1.0, 1).stamps) > 0).all()


def test_half_the_depth_is_missing_in_blocks(dataset: Dataset) -> None:
    made, again, other = (depths(depth_in_blocks(dataset, seed)) for seed in (1, 1, 2))
    whole = depths(dataset)
    np.testing.assert_array_equal(made, again)
    assert ((made == 0) | (made == whole)).all() and (made > 0).mean() == pytest.approx(0.5, abs=0.03)
    assert (made != other).any() and ((made[0] > 0) != (made[1] > 0)).any()
    blocks = (made[0] > 0).reshape(12, 2, 16, 2).swapaxes(1, 2).reshape(12, 16, 4)
    assert (blocks.all(axis=2) | ~blocks.any(axis=2)).all()


def test_changes_by_name_and_what_is_wrong_with_them(dataset: Dataset) -> None:
    wanted: dict[str, dict[str, float]] = {"depth_scaled": {"factor": 2.0}, "depth_to": {"metres": 1e-3}}
    for (name, arguments), factor in zip(wanted.items(), (2, 0), strict=True):
        made = changed(dataset, name, 0, arguments)
        np.testing.assert_allclose(depths(made), factor * depths(dataset), rtol=1e-6)
    np.testing.assert_array_equal(depths(changed(dataset, "every", 0, {"nth": 3})), depths(dataset)[::3])
    holed = [depths(changed(dataset, "depth_in_blocks", seed, {})) for seed in (1, 2)]
    np.testing.assert_array_equal(holed[0], depths(depth_in_blocks(dataset, 1)))
    assert (holed[0] != holed[1]).any()
    with pytest.raises(UserError, match=r"no change 'rain': choose color_late, .*camera_told"):
        changed(dataset, "rain", 0, {})
    with pytest.raises(UserError, match=r"change every: .*'mth'"):
        changed(dataset, "every", 0, {"mth": 2})
    assert all(change.__doc__ for change in CHANGES.values())


# --- a camera file that is wrong -------------------------------------------------------------------------------------


def test_a_wrong_camera_file(dataset: Dataset) -> None:
    rig = dataset.rig
    assert rig.sigma.is_exact and camera_told(dataset).rig == dataclasses.replace(
        rig, sigma=sigma_of_file(rig.color_camera)
    )
    made = camera_told(dataset, focal=1.02, cx_px=1.5, cy_px=-2.0, readout_ms=-3.0, rotation_deg=0.5)
    for before, after in ((rig.depth_camera, made.rig.depth_camera), (rig.color_camera, made.rig.color_camera)):
        assert (after.fx, after.fy) == pytest.approx((1.02 * before.fx, 1.02 * before.fy))
        assert (after.cx, after.cy) == pytest.approx((before.cx + 1.5, before.cy - 2.0))
    assert made.rig.color_shutter.readout_s == pytest.approx(0.025) == made.rig.depth_shutter.readout_s
    # Turned in its place: its centre stays where it was, its y axis too.
    T_told_color = made.rig.T_color_depth @ np.linalg.inv(rig.T_color_depth)
    np.testing.assert_allclose(T_told_color[:3, 3], 0.0, atol=1e-12)
    np.testing.assert_allclose(T_told_color @ [0, 1, 0, 0], [0, 1, 0, 0], atol=1e-12)
    assert np.degrees(np.arccos((np.trace(T_told_color) - 2) / 2)) == pytest.approx(0.5)
    assert made.truth is dataset.truth and made.images is dataset.images
    late = camera_told(dataset, color_ms=5.0)
    np.testing.assert_allclose(late.color_stamps, dataset.color_stamps + 0.005)
    np.testing.assert_array_equal(late.stamps, dataset.stamps)


def test_colour_is_not_told_late_where_its_offset_is_looked_for(dataset: Dataset) -> None:
    late_s = 0.001 * np.random.default_rng(0).uniform(0.0, 2.0, (2, FRAMES))
    depth, color = (stream_timing("a", dataset.stamps + late, "auto", 0.0) for late in late_s)
    recording = dataclasses.replace(dataset, timing=Timing(depth, color, None))
    assert recording.timing is not None and recording.timing.wants_color_offset
    with pytest.raises(UserError, match=r"^[^\n]*offset is looked for[^\n]*$"):
        camera_told(recording, color_ms=3.0)
    camera_told(recording, readout_ms=3.0)
    known = dataclasses.replace(dataset, timing=Timing(depth, color, 0.0))
    np.testing.assert_allclose(camera_told(known, color_ms=3.0).color_stamps, dataset.color_stamps + 0.003)


def test_a_camera_file_without_distortion_and_one_camera_for_both(dataset: Dataset) -> None:
    bent = dataclasses.replace(dataset.rig.depth_camera, model="radtan", distortion=(0.1, 0.0, 0.0, 0.0))
    rig = dataclasses.replace(dataset.rig, depth_camera=bent, color_camera=bent, T_color_depth=np.eye(4))
    registered = dataclasses.replace(dataset, rig=rig)
    plain = camera_told(registered, undistorted=True, focal=0.99).rig
    assert plain.depth_camera.model == "pinhole" and plain.depth_camera.distortion == () and plain.is_registered
    with pytest.raises(UserError, match="depth is registered"):
        camera_told(registered, rotation_deg=0.1)
