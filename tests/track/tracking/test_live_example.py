"""The live loop: images from a camera go in one by one, poses come out on the way. The README shows `live`."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
import pytest
import synthetic

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rstrack.alignment.optimizer import STOP_PX
from rstrack.data.rig import Frame, Image, Rig
from rstrack.options import Options
from rstrack.tracking.spline_tracker import Tracker

CAMERA, SHUTTER = Camera(160, 120, 120.0, 120.0, 79.5, 59.5), Shutter(readout_s=0.028)
FRAMES = 20
TRUTH = synthetic.make_spline(0.3)
# Twice what it reaches, and twice where the optimiser ends its steps (0.02 px are 0.17 mrad here). With a global
# shutter's model the same images give 0.9 mm and 1.1 mrad.
TOLERANCE_M, TOLERANCE_RAD = 0.4e-3, 2.0 * STOP_PX[0] / CAMERA.fx

Grabbed = tuple[float, npt.NDArray[np.float32], npt.NDArray[np.uint8]]


def grab() -> Iterator[Grabbed]:
    """Stamp (s), depth (m) and RGB of each frame, as a camera would deliver them."""
    for stamp in np.arange(FRAMES) / 30.0:
        depth = synthetic.render_depth(TRUTH, CAMERA, SHUTTER, stamp)
        yield float(stamp), depth, synthetic.render_color(TRUTH, CAMERA, SHUTTER, stamp, synthetic.T_COLOR_DEPTH)


def live(tracker: Tracker) -> list[FloatArray]:
    """Feed a camera's frames and note the newest pose after each: T_world_depth (4, 4), at the frame's stamp."""
    newest = []
    for stamp, depth, rgb in grab():
        report = tracker.feed(Frame(Image(stamp, depth), colors=(Image(stamp, rgb),)))
        stamps, T_world_depth = tracker.trajectory
        assert not report.lost and stamps[-1] == stamp
        newest.append(T_world_depth[-1])
    return newest


@pytest.fixture(scope="module")
def followed() -> tuple[Tracker, list[FloatArray]]:
    rig = Rig(CAMERA, SHUTTER, CAMERA, SHUTTER, synthetic.T_COLOR_DEPTH)
    tracker = Tracker(rig, Options(method="rs-pg"))
    return tracker, live(tracker)


def step_errors(T_est: FloatArray, T_true: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Errors (n,) in m and rad of the motions since the first of the poses (n, 4, 4): no alignment has any say."""
    error = se3.inverse(se3.inverse(T_true[0]) @ T_true) @ (se3.inverse(T_est[0]) @ T_est)
    twist = se3.log(error)
    return np.linalg.norm(error[:, :3, 3], axis=1), np.linalg.norm(twist[:, 3:], axis=1)


def test_the_final_trajectory_is_the_true_one(followed: tuple[Tracker, list[FloatArray]]) -> None:
    stamps, T = followed[0].trajectory
    np.testing.assert_array_equal(stamps, np.arange(FRAMES) / 30.0)
    moved = np.linalg.norm(T[-1, :3, 3] - T[0, :3, 3])
    assert moved > 0.1  # there was something to track
    distance, angle = step_errors(T[1:], TRUTH.pose(stamps[1:]))
    assert distance.max() < TOLERANCE_M and angle.max() < TOLERANCE_RAD, (distance.max(), angle.max())


def test_the_spline_is_right_at_every_line(followed: tuple[Tracker, list[FloatArray]]) -> None:
    spline = followed[0].spline
    assert spline is not None
    # All but the first frame and the newest, at whose last lines the spline's end is still loose.
    t = SHUTTER.line_mid_time(np.arange(1, FRAMES - 1)[:, None] / 30.0, np.arange(0, 120, 7), CAMERA).ravel()
    distance, angle = step_errors(spline.pose(t), TRUTH.pose(t))
    assert distance.max() < TOLERANCE_M and angle.max() < TOLERANCE_RAD, (distance.max(), angle.max())


def test_poses_read_on_the_way_are_good_once_it_has_started(followed: tuple[Tracker, list[FloatArray]]) -> None:
    tracker, newest = followed
    begin = tracker.options.bootstrap_frames
    stamps = np.arange(begin, FRAMES) / 30.0
    distance, angle = step_errors(np.array(newest[begin:]), TRUTH.pose(stamps))
    assert distance.max() < TOLERANCE_M and angle.max() < TOLERANCE_RAD, (distance.max(), angle.max())


def test_every_frame_has_a_report(followed: tuple[Tracker, list[FloatArray]]) -> None:
    reports = followed[0].reports
    assert len(reports) == FRAMES and sum(report.keyframe for report in reports) >= 2
    assert all(report.inliers_depth > 0 and report.iterations > 0 for report in reports[1:])
