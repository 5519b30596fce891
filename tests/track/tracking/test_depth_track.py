"""The motion that depth alone gives, against the truth of rendered sequences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rsgen.array_types import Float32Array
from rsgen.errors import UserError
from rsgen.geometry import se3
from rstrack.data.dataset import Dataset
from rstrack.tracking.first_look import depth_track as module
from rstrack.tracking.first_look.depth_track import DepthTrack, depth_track


def motions(track: DepthTrack, dataset: Dataset, over_s: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """Twists (n, 6) of found and true motion over so many seconds, at the stamps of the frames that allow it."""
    t = dataset.stamps[track.frames]
    t = t[(t >= track.begin) & (t + over_s <= track.end)]
    assert dataset.truth is not None
    found, true = (se3.log(se3.inverse(path.pose(t)) @ path.pose(t + over_s)) for path in (track.spline, dataset.truth))
    return found, true


def test_depth_alone_gives_the_motion(shaken: Dataset) -> None:
    shares: list[float] = []
    track = depth_track(shaken, range(len(shaken)), shares.append)
    assert track is not None and track.frames == range(len(shaken))
    assert shares == sorted(shares) and shares[-1] == 1.0
    found, true = motions(track, shaken)
    off = np.linalg.norm(found - true, axis=1) / np.median(np.linalg.norm(true, axis=1))
    assert np.median(off) < 0.05


def test_lines_are_moved_to_the_middle_of_their_image(shaken: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """Depth in the last lines alone is seen late: without that the motion comes out a third of the readout early."""

    class Lower:
        color = shaken.images.color

        def depth(self, k: int) -> Float32Array:
            z = shaken.images.depth(k).copy()
            z[: 2 * len(z) // 3] = 0.0
            return z

    below = replace(shaken, images=Lower())

    def late_s() -> float:
        """Seconds by which the true motion has to be shifted to be like the one found."""
        track = depth_track(below, range(len(below)), lambda _: None)
        assert track is not None and below.truth is not None
        t = np.linspace(track.begin + 0.1, track.end - 0.1, 200)
        found = track.spline.velocity(t)[:, 3:]
        shifts = np.linspace(-0.02, 0.02, 41)
        costs = [((found - below.truth.velocity(t + s)[:, 3:]) ** 2).sum() for s in shifts]
        return float(shifts[int(np.argmin(costs))])

    readout_s = shaken.rig.depth_shutter.readout_s
    assert abs(late_s()) < 0.1 * readout_s
    monkeypatch.setattr(module._Odometry, "at_middle", lambda self, image, k, spline: image)
    assert late_s() == pytest.approx(readout_s / 3, abs=0.12 * readout_s)


def test_it_is_the_same_to_the_bit_whatever_threads_do(shaken: Dataset) -> None:
    import cv2

    before, found = cv2.getNumThreads(), []
    try:
        for threads in (1, 2, 3):
            cv2.setNumThreads(threads)
            track = depth_track(shaken, range(12), lambda _: None)
            assert track is not None
            found.append(track.spline.control_points.tobytes())
    finally:
        cv2.setNumThreads(before)
    assert len(set(found)) == 1


def test_what_does_not_hang_together_is_left_out(shaken: Dataset) -> None:
    class Gap:
        color = shaken.images.color

        def depth(self, k: int) -> Float32Array:
            if k == 5:
                raise UserError("depth/5.png: is not there")
            return shaken.images.depth(k) if k < 20 else np.zeros_like(shaken.images.depth(k))

    gap = replace(shaken, images=Gap())
    track = depth_track(gap, range(len(gap)), lambda _: None)
    assert track is not None and track.frames == range(6, 20)
    assert gap.stamps[6] < track.begin < track.end < gap.stamps[20]
    assert depth_track(gap, range(3, 8), lambda _: None) is None
