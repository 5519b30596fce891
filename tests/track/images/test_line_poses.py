"""Times and poses of an image's lines, and the tables made from them, against the spline at each line."""

from __future__ import annotations

import numpy as np
import pytest
from rstrack_util import ENGINE, SCANS, T_COLOR_DEPTH, hand_held

from rsgen.device.projection import FROM_BASE, TO_BASE, Lens
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Scan, Shutter
from rsgen.geometry.spline import Spline
from rstrack.images.line_poses import (
    Exposure,
    from_base_table,
    line_twists,
    to_base_table,
)

CAMERA = Camera(640, 480, 525.0, 520.0, 319.5, 241.0)
STAMP = 0.45


def exposure(scan: Scan = "top-bottom", readout_s: float = 0.028, camera: Camera = CAMERA) -> Exposure:
    return Exposure(Lens(camera, Shutter(readout_s, 0.004, scan)), STAMP, T_COLOR_DEPTH)


def rows_of(T: np.ndarray) -> np.ndarray:
    return np.array([*T[:3, :3].ravel(), *T[:3, 3]])


def line_poses(spline: Spline, image: Exposure) -> np.ndarray:
    """T_world_body (lines, 4, 4), by the table that kernels take."""
    rows = to_base_table(spline, np.eye(4), image)
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = rows[:, :9].reshape(-1, 3, 3), rows[:, 9:]
    return np.asarray(T @ image.T_cam_body)


@pytest.mark.parametrize("scan", SCANS)
def test_lines_of_pixels_and_their_times(scan: Scan) -> None:
    image = exposure(scan)
    camera, shutter = image.lens.camera, image.lens.shutter
    uv = np.array([[0.0, 0.0], [639.0, 479.0], [12.5, 400.25]])
    line = shutter.line_of_pixel(uv, camera)
    np.testing.assert_allclose(ENGINE.download(image.lens.line_of(*(ENGINE.upload(c) for c in uv.T)), (3,)), line)
    times = image.times()
    assert len(times) == image.lens.lines == (480 if scan in ("top-bottom", "bottom-top") else 640)
    # The first line stops being exposed at the stamp; the last one is a line's delay short of the readout later.
    read = 0.028 * (image.lens.lines - 1) / image.lens.lines
    assert sorted(times[[0, -1]]) == pytest.approx([STAMP - 0.002, STAMP - 0.002 + read])
    backwards = scan in ("bottom-top", "right-left")
    assert (line[0] == 0) != backwards or times[0] > times[-1]
    assert (np.diff(times) > 0).all() or (np.diff(times) < 0).all()
    assert (image.first_time, image.last_time) == pytest.approx((times[0], times[-1]))
    assert image.mid_time == pytest.approx(times.mean())
    np.testing.assert_allclose(image.block_times(8), times.reshape(-1, 8).mean(axis=1))


@pytest.mark.parametrize("scan", SCANS)
@pytest.mark.parametrize("height", [480, 477])
def test_poses_are_those_of_the_spline_at_each_line(scan: Scan, height: int) -> None:
    # Sizes that eight divides, and others: the last block is shorter then.
    camera = Camera(height + 160, height, 525.0, 520.0, 319.5, 241.0)
    for seed in range(4):
        spline, image = hand_held(seed), exposure(scan, camera=camera)
        T, twist = line_poses(spline, image), line_twists(spline, image)
        exact = spline.pose(image.times())
        # 20 m/s² and 40 rad/s², which change within a knot. 1e-8 rad are 5e-6 px.
        np.testing.assert_allclose(T[:, :3, 3], exact[:, :3, 3], atol=1e-8)
        np.testing.assert_allclose(T[:, :3, :3], exact[:, :3, :3], atol=2e-8)
        h = 1e-4
        before, after = spline.pose(image.times() - h), spline.pose(image.times() + h)
        difference = se3.log(se3.inverse(before) @ after) / (2.0 * h)
        np.testing.assert_allclose(twist, difference, atol=3e-4)


def test_a_hand_that_jerks_costs_nanometres_where_a_constant_twist_costs_a_micrometre() -> None:
    # 35 m/s², the most that hands did in TUM's recordings, and back within two knots.
    dt, acceleration = 0.025, 35.0
    sway = 0.5 * acceleration * dt**2 * np.cos(0.5 * np.pi * np.arange(24))
    spline = Spline(se3.exp(sway[:, None] * [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]), 0.3, dt)
    image = exposure()
    reached = np.abs(np.diff(spline.velocity(image.times())[:, 0]) / np.diff(image.times())).max()
    assert reached == pytest.approx(acceleration, rel=0.02)
    T = line_poses(spline, image)
    exact = spline.pose(image.times())[:, 0, 3]
    assert np.abs(T[:, 0, 3] - exact).max() < 2e-8
    middle = image.block_times(8).repeat(8)
    straight = spline.pose(middle)[:, 0, 3] + spline.velocity(middle)[:, 0] * (image.times() - middle)
    assert np.abs(straight - exact).max() > 5e-7


def test_a_global_shutter_has_one_line_whose_pose_is_that_of_the_spline() -> None:
    spline, image = hand_held(1), exposure(readout_s=0.0)
    assert image.lens.lines == 1 and image.times() == pytest.approx([STAMP - 0.002])
    assert image.first_time == image.mid_time == image.last_time
    T, twist = line_poses(spline, image), line_twists(spline, image)
    exact, velocity = spline.pose_and_velocity(np.array([STAMP - 0.002]))
    np.testing.assert_allclose(T, exact, atol=1e-15)
    np.testing.assert_allclose(twist, velocity, atol=1e-15)


@pytest.mark.parametrize("scan", SCANS)
def test_tables_hold_each_lines_camera_in_the_base_frame_and_its_twist(scan: Scan) -> None:
    spline, image = hand_held(6), exposure(scan)
    T_world_base, k = spline.pose(0.40), 137
    to_base = to_base_table(spline, T_world_base, image)
    from_base = from_base_table(spline, T_world_base, image)
    assert to_base.shape == (image.lens.lines, TO_BASE) and from_base.shape == (image.lens.lines, FROM_BASE)
    T_world_cam = spline.pose(image.times()[k]) @ np.linalg.inv(T_COLOR_DEPTH)
    T_base_cam = np.linalg.inv(T_world_base) @ T_world_cam
    np.testing.assert_allclose(to_base[k], rows_of(T_base_cam), atol=1e-8)
    np.testing.assert_allclose(from_base[k, :12], rows_of(np.linalg.inv(T_base_cam)), atol=1e-8)
    # The camera's own twist per line: T_world_cam(t + h) = T_world_cam(t) exp(h · twist).
    delay = image.lens.shutter.line_delay(image.lens.camera)
    later = spline.pose(image.times()[k] + np.array([-0.5, 0.5]) * delay) @ np.linalg.inv(T_COLOR_DEPTH)
    np.testing.assert_allclose(from_base[k, 12:], se3.log(np.linalg.inv(later[0]) @ later[1]), atol=1e-9)
