"""A whole track beside something that moves by itself: where the camera goes, and what is kept of the masks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import synthetic
from moving_ball import RIG, picture

from rstrack.data.estimate import Estimate
from rstrack.data.rig import Frame, Image
from rstrack.keyframes.coarse_search import small_frame
from rstrack.metrics.association import Truth, compare
from rstrack.options import Method, Options
from rstrack.tracking.spline_tracker import Tracker

TRUTH = synthetic.make_spline(0.5)
FRAMES = 16
RADIUS = 0.3


def made(k: int, radius: float) -> tuple[Frame, np.ndarray]:
    """Frame k, 2 mm of noise on depth, and where the ball is in its depth image."""
    rng = np.random.default_rng(100 + k)
    z, _, ball = picture(TRUTH, k / 30, np.eye(4), radius)
    _, color, _ = picture(TRUTH, k / 30 + 0.004, RIG.T_color_depth, radius)
    z = (z + rng.normal(0.0, 2e-3, z.shape)).astype(np.float32)
    color = np.clip(np.rint(color + rng.normal(0.0, 1.5, color.shape)), 0, 255).astype(np.uint8)
    return Frame(Image(k / 30, z), (Image(k / 30 + 0.004, color),)), ball


@dataclass(frozen=True)
class Run:
    """A tracker that has seen all frames, and where the ball was in them."""

    tracker: Tracker
    balls: list[np.ndarray]

    @property
    def ate_m(self) -> float:
        """RMS error of the positions."""
        stamps = np.arange(FRAMES) / 30
        errors = compare(Truth(TRUTH, stamps), Estimate(*self.tracker.trajectory)).position_errors_m
        return float(np.sqrt(np.mean(errors**2)))


def run(radius: float, moving: bool = True, method: Method = "rs-pg", growth: float = 0.0) -> Run:
    """growth: of the ball's radius with every frame after the start, m."""
    tracker, balls = Tracker(RIG, Options(method=method, backend="llvm", loops="off", moving=moving)), []
    for k in range(FRAMES):
        frame, ball = made(k, radius + growth * max(0, k - 6))
        tracker.feed(frame)
        balls.append(ball)
    return Run(tracker, balls)


@pytest.fixture(scope="module")
def beside_ball() -> Run:
    return run(RADIUS)


@pytest.fixture(scope="module")
def alone() -> Run:
    return run(1e-6)


def test_a_track_beside_a_ball_is_about_as_good_as_without(beside_ball: Run, alone: Run) -> None:
    shares = [ball.mean() for ball in beside_ball.balls]
    assert 0.08 < np.mean(shares) < 0.25
    assert not any(report.lost for report in beside_ball.tracker.reports)
    assert beside_ball.ate_m < 2.0 * alone.ate_m and alone.ate_m < 1e-3
    for k in range(6, FRAMES):
        left_out, ball = beside_ball.tracker.left_out.of(k, *beside_ball.balls[k].shape), beside_ball.balls[k]
        assert left_out is not None
        assert left_out[ball].mean() > 0.95 and ball[left_out].mean() > 0.55
    assert not any(report.moving for report in alone.tracker.reports)


def test_without_looking_it_is_worse(beside_ball: Run) -> None:
    assert run(RADIUS, moving=False).ate_m > 3.0 * beside_ball.ate_m


def test_depth_alone_does_without_the_ball_too() -> None:
    """Where no colours tell which of two motions is the room's; also once it fills so much that the frame as a whole
    would not fit any more."""
    beside = run(0.25, method="rs-g", growth=0.025)
    assert not any(report.lost for report in beside.tracker.reports)
    assert beside.ate_m < 1.5 * run(1e-6, method="rs-g").ate_m
    assert beside.balls[6].mean() < 0.12 and beside.balls[-1].mean() > 0.4
    assert beside.tracker.reports[-1].moving > 0.4


def test_a_frame_that_is_looked_at_again_does_without_it(beside_ball: Run) -> None:
    """As loops do: its depth, and the small images that places are known by."""
    tracker, k = beside_ball.tracker, FRAMES - 1
    assert tracker.left_out.grid(k) is not None
    frame, ball = made(k, RADIUS)
    again = tracker.track.upload_again(k, frame)
    z = tracker.track.device.e.download(again.depth.z, ball.shape)
    assert (z[ball] == 0.0).mean() > 0.9 and (z[~ball] > 0.0).mean() > 0.85
    small = small_frame(again, RIG, geometric=True)
    assert small.inverse_depth is not None and small.intensity is not None
    rows, columns = np.nonzero(ball)
    middle = int(rows.mean() / ball.shape[0] * 15), int(columns.mean() / ball.shape[1] * 20)
    assert np.isnan(small.inverse_depth.values[middle]) and np.isnan(small.intensity.values[middle])
    assert np.isfinite(small.intensity.values).mean() > 0.6


def test_a_frame_that_is_found_again_does_without_it() -> None:
    """After half a second without images: the frame before tells nothing."""
    tracker = Tracker(RIG, Options(backend="llvm", loops="off"))
    for k in range(10):
        tracker.feed(made(k, RADIUS)[0])
    for k in (20, 21, 22):
        frame, ball = made(k, RADIUS)
        report = tracker.feed(frame)
        if not report.lost:
            break
    assert not report.lost
    left_out = tracker.left_out.of(len(tracker.reports) - 1, *ball.shape)
    assert left_out is not None
    assert left_out[ball].mean() > 0.8
