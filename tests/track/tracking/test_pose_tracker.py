"""The baseline tracker on an analytic scene: exact where its model holds, off where it does not, and when lost."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
import synthetic

from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.spline import Spline
from rstrack.data.rig import Frame, Image, Rig
from rstrack.options import Options
from rstrack.tracking.any_tracker import make_tracker as make_any_tracker
from rstrack.tracking.pose_tracker import BaselineTracker

CAMERA = Camera(160, 120, 120.0, 120.0, 79.5, 59.5)
# Looking into a corner of the box: walls in all directions, so that every motion is seen.
_STRAIGHT = synthetic.make_spline(0.7)
MOTION = Spline(_STRAIGHT.control_points @ se3.exp(np.array([0, 0, 0, 0.3, 0.7, 0])), _STRAIGHT.t0, _STRAIGHT.dt)
RATE_HZ = 30.0


def make_rig(shutter: Shutter) -> Rig:
    return Rig(CAMERA, shutter, CAMERA, shutter, np.eye(4))


def make_frame(stamp: float, shutter: Shutter, motion: Spline = MOTION, scale: float = 1.0) -> Frame:
    depth = synthetic.render_depth(motion, CAMERA, shutter, stamp)
    return Frame(Image(stamp, depth * np.float32(scale)), ())


def noisy(frame: Frame, rng: np.random.Generator) -> Frame:
    """With noise of 3 mm, as a depth camera's.

    Without any, σ falls so fast that hardly a pixel is smooth enough to count: starts from further off are then lost.
    """
    z = frame.depth.pixels + 3e-3 * rng.standard_normal(frame.depth.pixels.shape, np.float32)
    return Frame(Image(frame.depth.stamp, z), ())


def still(T_world_depth: np.ndarray) -> Spline:
    return Spline(np.repeat(T_world_depth[None], 5, axis=0), -1.0, 2.0)


def blank(stamp: float) -> Frame:
    return Frame(Image(stamp, np.zeros((CAMERA.height, CAMERA.width), np.float32)), ())


def make_tracker(shutter: Shutter, **options: Any) -> BaselineTracker:
    return BaselineTracker(make_rig(shutter), Options(method="baseline", backend="llvm", **options))


def track(shutter: Shutter, frames: int = 16, **options: Any) -> BaselineTracker:
    tracker = make_tracker(shutter, **options)
    for k in range(frames):
        tracker.feed(make_frame(k / RATE_HZ, shutter))
    return tracker


def mid_time(stamp: Any, shutter: Shutter) -> Any:
    return shutter.line_mid_time(stamp, 0.5 * (shutter.line_count(CAMERA) - 1), CAMERA)


def errors_mm(tracker: BaselineTracker, shutter: Shutter, motion: Spline = MOTION, late: float = 0.0) -> np.ndarray:
    """Distances of the estimated positions from the true ones `late` seconds after the stamps, in the world that the
    estimate defines: no alignment."""
    stamps, T = tracker.trajectory
    true = se3.inverse(motion.pose(mid_time(0.0, shutter))) @ motion.pose(stamps + late)
    return 1e3 * np.linalg.norm((T - true)[:, :3, 3], axis=1)


GLOBAL = Shutter(0.0, 0.012)
ROLLING = Shutter(0.028)


@pytest.fixture(scope="module")
def on_global() -> BaselineTracker:
    return track(GLOBAL)


def test_global_shutter_is_tracked_exactly_at_the_stamps(on_global: BaselineTracker) -> None:
    assert [report.lost for report in on_global.reports] == [False] * 16
    assert on_global.spline is None
    assert errors_mm(on_global, GLOBAL).max() < 1.0
    # The images show the middle of a 12 ms exposure, which ends at the stamp: to ignore that costs 3 mm or more.
    assert errors_mm(on_global, GLOBAL, late=-0.006).min() > 2.0


def test_rolling_shutter_is_taken_at_mid_readout_and_costs_accuracy(on_global: BaselineTracker) -> None:
    tracker = track(ROLLING)
    rolling, other = errors_mm(tracker, ROLLING), errors_mm(on_global, GLOBAL)
    assert rolling.max() > 3.0 * other.max()
    # With the poses taken for those of the first or the last line it would be far worse still.
    assert rolling.mean() < 0.5 * min(errors_mm(tracker, ROLLING, late=late).mean() for late in (-0.014, 0.014))


@pytest.mark.parametrize("fuse", [True, False])
def test_keyframes_follow_the_options(on_global: BaselineTracker, fuse: bool) -> None:
    tracker = track(GLOBAL, keyframe_distance=0.05, fuse=fuse)
    assert errors_mm(tracker, GLOBAL).max() < 1.0
    assert tracker.keyframes == sum(report.keyframe for report in tracker.reports)
    p = tracker.trajectory[1][:, :3, 3]
    made = np.flatnonzero([report.keyframe for report in tracker.reports])
    assert len(made) > 4 > on_global.keyframes
    for first, last in itertools.pairwise(made):
        assert np.linalg.norm(p[last] - p[first]) > 0.045 > np.linalg.norm(p[last - 1] - p[first]) - 0.01


@pytest.mark.parametrize(
    ("method", "shutter", "fuses"),
    [("baseline", ROLLING, False), ("baseline", GLOBAL, True), ("gs-g", ROLLING, False), ("gs-pg", GLOBAL, True),
     ("rs-g", ROLLING, True), ("rs-pg", GLOBAL, True)],
)  # fmt: skip
def test_depth_is_averaged_where_it_is_known_when_lines_were_taken(method: Any, shutter: Shutter, fuses: bool) -> None:
    rig = make_rig(shutter)
    assert make_any_tracker(rig, Options(method=method, backend="llvm")).options.fuse is fuses
    for said in (True, False):
        assert make_any_tracker(rig, Options(method=method, backend="llvm", fuse=said)).options.fuse is said


@pytest.mark.parametrize("keyframe_overlap", [0.65, 1.01])
def test_depth_is_averaged_within_a_keyframe_and_passed_on_to_the_next(keyframe_overlap: float) -> None:
    # With an overlap of more than one, every frame becomes a keyframe.
    clean = make_frame(0.0, Shutter(), still(MOTION.pose(0.3))).depth.pixels
    errors = {}
    for fuse in (True, False):
        rng = np.random.default_rng(1)
        tracker = make_tracker(Shutter(), fuse=fuse, keyframe_overlap=keyframe_overlap)
        for k in range(6):
            noisy = clean + 2e-3 * rng.normal(size=clean.shape).astype(np.float32)
            tracker.feed(Frame(Image(k / RATE_HZ, noisy), ()))
        assert tracker.keyframes == (6 if keyframe_overlap > 1.0 else 1)
        assert tracker._reference is not None
        found = np.array(tracker._reference.inverse_depth.numpy()).reshape(clean.shape)
        errors[fuse] = np.sqrt(np.mean((1.0 / found - clean)[10:-10, 10:-10] ** 2))
    assert 0.3 < errors[True] / errors[False] < 0.6


def test_jumps_are_found() -> None:
    # With a curvature of 0.2 in the kernel, steps were up to five times too long, and two of these jumps diverged.
    rng = np.random.default_rng(0)
    T = MOTION.pose(0.3)
    for _ in range(7):
        jump = rng.normal(size=(2, 3))
        jump *= np.array([[0.03], [np.radians(1.5)]]) / np.linalg.norm(jump, axis=1, keepdims=True)
        tracker = make_tracker(Shutter())
        tracker.feed(noisy(make_frame(0.0, Shutter(), still(T)), rng))
        assert not tracker.feed(noisy(make_frame(0.1, Shutter(), still(T @ se3.exp(jump.ravel()))), rng)).lost
        _, T_world_depth = tracker.trajectory
        assert np.linalg.norm((T_world_depth[-1] - se3.exp(jump.ravel()))[:3, 3]) < 2e-3  # of 30


def test_lost_frames_are_left_out_and_the_keyframe_is_tried_again() -> None:
    tracker = make_tracker(Shutter())
    rng = np.random.default_rng(0)
    frames = [noisy(make_frame(k / RATE_HZ, Shutter()), rng) for k in range(9)]
    for k in (3, 4, 5):
        frames[k] = blank(k / RATE_HZ)
    reports = [tracker.feed(frame) for frame in frames]
    assert [report.lost for report in reports] == [k in (3, 4, 5) for k in range(9)]
    assert [bool(report.fault) for report in reports] == [report.lost for report in reports]
    assert reports[4].fault == "hardly a pixel falls on the keyframe"
    assert tracker.keyframes == 1
    np.testing.assert_allclose(tracker.trajectory[0], np.delete(np.arange(9) / RATE_HZ, (3, 4, 5)))
    assert errors_mm(tracker, Shutter()).max() < 1.0


def test_a_lost_camera_is_also_looked_for_at_the_keyframe() -> None:
    # Constant velocity predicts 0.2 m and 11 degrees, but the camera has gone back.
    T, moved = MOTION.pose(0.3), se3.exp(np.array([0.02, 0.02, 0.0, 0.0, 0.025, 0.0]))
    tracker = make_tracker(Shutter())
    for stamp, pose in ((0.0, T), (0.03, T @ moved), (0.27, T)):
        report = tracker.feed(make_frame(stamp, Shutter(), still(pose)))
    assert not report.lost
    np.testing.assert_allclose(tracker.trajectory[1][-1], np.eye(4), atol=1e-3)


def test_frames_without_depth_start_nothing() -> None:
    tracker = make_tracker(Shutter())
    assert tracker.feed(blank(0.0)).lost
    assert [len(part) for part in tracker.trajectory] == [0, 0]
    assert not tracker.feed(make_frame(0.1, Shutter())).lost
    assert tracker.keyframes == 1
    assert [tracker.feed(blank(0.2 + 0.1 * k)).lost for k in range(7)] == [True] * 7
    assert tracker.keyframes == 1
    np.testing.assert_array_equal(tracker.trajectory[0], [0.1])


def test_stamps_must_increase() -> None:
    tracker = make_tracker(Shutter())
    tracker.feed(make_frame(0.1, Shutter()))
    with pytest.raises(UserError, match=r"stamped 0\.100000 s follows one stamped 0\.100000 s"):
        tracker.feed(make_frame(0.1, Shutter()))


def test_five_lost_frames_start_anew_at_the_last_pose() -> None:
    tracker = make_tracker(Shutter())
    first = [make_frame(k / RATE_HZ, Shutter()) for k in range(3)]
    # A world three times as large matches nowhere.
    there = MOTION.pose(2 / RATE_HZ)
    later = [make_frame(k / RATE_HZ, Shutter(), still(there), 3.0) for k in range(3, 10)]
    reports = [tracker.feed(frame) for frame in (*first, *later)]
    assert [report.lost for report in reports] == [k in range(3, 8) for k in range(10)]
    assert [report.keyframe for report in reports] == [k in (0, 7) for k in range(10)]
    stamps, T = tracker.trajectory
    np.testing.assert_allclose(stamps, np.array([0, 1, 2, 8, 9]) / RATE_HZ)
    np.testing.assert_allclose(T[3:], np.repeat(T[2:3], 2, axis=0), atol=1e-4)


def test_only_frames_lost_in_a_row_count() -> None:
    tracker = make_tracker(Shutter())
    for k in range(9):
        frame = make_frame(k / RATE_HZ, Shutter(), still(MOTION.pose(0.3)), scale=1.0 if k in (0, 4) else 3.0)
        assert tracker.feed(frame).lost == (k not in (0, 4))
    assert tracker.keyframes == 1


def test_a_single_plane_does_not_fix_a_pose() -> None:
    wall = np.full((CAMERA.height, CAMERA.width), 1.5, np.float32)
    tracker = make_tracker(Shutter())
    tracker.feed(Frame(Image(0.0, wall), ()))
    assert tracker.feed(Frame(Image(0.1, wall), ())).lost
