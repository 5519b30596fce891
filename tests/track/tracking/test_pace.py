"""A frame's time: what is left out where there is none, by an artificial clock."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import synthetic

from rsgen.errors import UserError
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rstrack.alignment import optimizer
from rstrack.alignment.pace import Pace
from rstrack.data.rig import Frame, Image, Rig
from rstrack.options import Options
from rstrack.tracking.spline_tracker import Tracker

CAMERA, SHUTTER = Camera(160, 120, 120.0, 120.0, 79.5, 59.5), Shutter(readout_s=0.028)
TRUTH = synthetic.make_spline(0.6)


class Clock:
    """Seconds that pass when they are told to, or by `tick` whenever somebody looks."""

    def __init__(self, tick: float = 0.0) -> None:
        self.now, self.tick = 0.0, tick

    def __call__(self) -> float:
        self.now += self.tick
        return self.now


def frame(pace: Pace, clock: Clock, steps: list[tuple[int, float]], rest: float, keyframe: float = 0.0) -> None:
    pace.begin()
    for level, seconds in steps:
        with pace.step(level):
            clock.now += seconds
    if keyframe:
        with pace.part("keyframe"):
            clock.now += keyframe
    clock.now += rest
    pace.end()


def test_a_part_is_allowed_if_what_such_take_and_what_follows_fit() -> None:
    clock = Clock()
    pace = Pace(30.0, clock)
    frame(pace, clock, [(1, 0.004), (0, 0.006), (0, 0.006)], rest=0.010, keyframe=0.050)
    pace.begin()
    clock.now += 0.0099  # 6 + 10 ms are needed for a step on the finest level, 4 more for a coarse one before
    assert pace.allows_step(0) and pace.allows_step(1) and not pace.allows("keyframe")
    clock.now += 0.0003
    assert pace.allows_step(0) and not pace.allows_step(1)
    clock.now += 0.0039
    assert not pace.allows_step(0)
    pace.lift()
    assert pace.allows_step(1) and pace.allows("keyframe")
    # A keyframe that has to be made takes its time from the alignment.
    pace.reserve("keyframe")
    pace.begin()
    assert not pace.allows_step(0)
    pace.reserve()
    assert pace.allows_step(0)
    # What was long is forgotten after a hundred frames.
    for _ in range(100):
        frame(pace, clock, [(0, 0.002)], rest=0.001)
    pace.begin()
    clock.now += 0.0265
    assert pace.allows_step(0)
    # One in ten may be as long as it was.
    frame(pace, clock, [(0, 0.5)], rest=0.001)
    pace.begin()
    clock.now += 0.0265
    assert pace.allows_step(0)


def test_without_a_budget_everything_is_allowed() -> None:
    pace = Pace(None, Clock(tick=1e3))
    frame(pace, Clock(), [(0, 1.0)], rest=1.0)
    pace.begin()
    assert pace.allows_step(1) and pace.allows("keyframe")
    with pytest.raises(UserError, match="budget_ms = 0"):
        Options(budget_ms=0)


def tracked(clock: Callable[[], float] | None, budget_ms: float | None = None) -> Tracker:
    tracker = Tracker(Rig(CAMERA, SHUTTER, CAMERA, SHUTTER, synthetic.T_COLOR_DEPTH), Options(keyframe_distance=0.03))
    if clock is not None:
        tracker.track.terms.pace = Pace(budget_ms, clock)
    for k in range(26):
        depth = synthetic.render_depth(TRUTH, CAMERA, SHUTTER, k / 30.0)
        color = synthetic.render_color(TRUTH, CAMERA, SHUTTER, k / 30.0, synthetic.T_COLOR_DEPTH)
        tracker.feed(Frame(Image(k / 30.0, depth), (Image(k / 30.0, color),)))
    return tracker


def test_frames_without_time_are_cut_and_say_so_and_are_no_worse_than_their_covariance() -> None:
    free, ample = tracked(None), tracked(Clock(tick=1e-3), 1e6)
    np.testing.assert_array_equal(free.trajectory[1], ample.trajectory[1])
    assert not any(report.is_cut for report in (*free.reports, *ample.reports))
    # Somebody looks at the clock a few times in each part: every frame is over its time after its first steps.
    short = tracked(Clock(tick=1e-3), 10.0)
    cut = [report for report in short.reports if report.is_cut]
    assert len(cut) > 10 and not any(report.lost for report in short.reports)
    assert sum(r.iterations for r in short.reports) < sum(r.iterations for r in free.reports)
    # Keyframes wait for a frame, and are made all the same.
    assert 1 < short.keyframes <= free.keyframes
    ratios = [
        np.trace(a.covariance) / np.trace(b.covariance)
        for a, b in zip(short.reports, free.reports, strict=True)
        if a.is_cut and a.covariance is not None and b.covariance is not None
    ]
    assert np.median(ratios) > 1.2
    stamps, T = short.trajectory
    T_true = np.linalg.inv(TRUTH.pose(stamps[0])) @ TRUTH.pose(stamps)
    error = np.linalg.norm((np.linalg.inv(T[0]) @ T)[:, :3, 3] - T_true[:, :3, 3], axis=1)
    sigma = [
        np.sqrt(np.trace((r.covariance + r.drift_world)[:3, :3])) for r in short.reports if r.covariance is not None
    ]
    assert error.max() < 0.02 and np.mean(error[-len(sigma) :] < 3.0 * np.array(sigma)) > 0.9


def test_no_time_is_too_short_for_the_steps_without_which_a_frame_would_be_lost(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    settled_px = 0.02  # of images that are as small as these a step moves lines by little
    monkeypatch.setattr(optimizer, "SETTLED_PX", settled_px)
    cut = [report for report in tracked(Clock(tick=1e-3), 10.0).reports if report.is_cut]
    assert len(cut) > 3 and max(r.iterations for r in cut) > 3 and max(r.last_shift_px for r in cut) <= settled_px
