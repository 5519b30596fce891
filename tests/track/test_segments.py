"""A lost camera's own tracks: when they begin and end, where they lie, what is written of them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from test_spline_tracker import TRUTH, blank, frame_at, tracker_of

from rsgen.geometry import se3
from rsgen.sequence.trajectory import read_trajectory
from rstrack.data.estimate import SEGMENTS, Estimate
from rstrack.data.rig import Frame
from rstrack.tracking.frame_report import frame_report
from rstrack.tracking.judgement.fault import Fault
from rstrack.tracking.runs.segments import Segments


def true_poses(stamps: np.ndarray) -> np.ndarray:
    return np.asarray(se3.exp(stamps[:, None] * np.array([0.4, 0.1, -0.2, 0.3, 0.5, -0.2])))


BLANK = blank(frame_at(0))
FRAMES = [replace(BLANK, depth=replace(BLANK.depth, stamp=k / 30.0)) for k in range(60)]
POSE = se3.exp(np.array([0.3, -0.2, 0.1, 0.2, 0.4, -0.1]))


@dataclass
class Scripted:
    """A tracker that finds the frames it is told to, where they are but for its world, which is at POSE."""

    finds: set[int]
    at: list[int] = field(default_factory=list)

    def feed(self, frame: Frame) -> Any:
        k = round(30.0 * frame.depth.stamp)
        self.at += [k] if k in self.finds else []
        fault = Fault.NONE if k in self.finds else Fault.NO_PLACE
        return frame_report(frame.depth.stamp, [], None, keyframe=False, fault=fault, overlap=1.0)

    @property
    def trajectory(self) -> tuple[np.ndarray, np.ndarray]:
        stamps = np.array(self.at) / 30.0
        return stamps, se3.inverse(POSE) @ true_poses(stamps)


def segments_of(finds: set[int], lost: range, frames: int = 60) -> Segments:
    made = Segments(lambda: Scripted(finds))  # type: ignore[arg-type, return-value]
    for k in range(frames):
        made.feed(FRAMES[k], k in lost)
    made.end()
    return made


def first_track(lost: range) -> tuple[np.ndarray, np.ndarray]:
    stamps = np.array([k for k in range(60) if k not in lost]) / 30.0
    return stamps, true_poses(stamps)


def test_half_a_second_after_the_last_pose_a_segment_begins_and_the_next_pose_ties_it() -> None:
    lost = range(10, 40)
    made = segments_of(set(range(60)), lost)
    (segment,) = made.found
    # The last pose is frame 9's; half a second later is frame 24, and the next is beyond.
    assert np.rint(30.0 * segment.stamps).tolist() == [*range(25, 41)] and segment.tie == 40 / 30.0
    joined = made.joined(Estimate(*first_track(lost)))
    stamps, T = joined.stamps, joined.T_world_depth
    assert np.rint(30.0 * stamps).tolist() == [*range(10), *range(25, 60)]
    np.testing.assert_allclose(T, true_poses(stamps), atol=1e-12)
    reports = [Scripted(set(range(60)) - set(lost)).feed(frame) for frame in FRAMES]
    told = made.told(reports)
    assert [k for k, r in enumerate(told) if r.lost] == [*range(10, 25)]
    assert [k for k, r in enumerate(told) if r.segment] == [*range(25, 40)]


def test_without_a_frame_in_common_nobody_knows_where_a_segment_lies(tmp_path: Path) -> None:
    for finds, lost in ((set(range(40)), range(10, 40)), (set(range(60)), range(10, 60))):
        made = segments_of(finds, lost)
        assert [one.tie for one in made.found] == [None]
        own = Estimate(*first_track(lost), None, {"segments": made.info()})
        np.testing.assert_array_equal(made.joined(own).T_world_depth, own.T_world_depth)
        reports = made.told([Scripted(set()).feed(frame) for frame in FRAMES])
        assert all(r.lost for r in reports) and reports[30].segment == 1 and reports[5].segment == 0
        made.write(tmp_path)
        poses = read_trajectory(tmp_path / SEGMENTS / "1.txt", format="tum")
        np.testing.assert_allclose(poses.T_world_cam, made.found[0].T_segment_depth, atol=1e-8)
        poses = len(made.found[0].stamps)
        assert made.text().startswith(
            f"lost for more than 0.5 s: {poses} poses in a segment of its own, 1 of them tied"
        )
        (note,) = own.untied
        assert note.startswith(f"{poses} poses more in segments/ are tied to nothing")


def test_a_segment_that_is_lost_itself_ends_and_another_begins() -> None:
    made = segments_of({*range(25, 30), *range(46, 60)}, range(10, 60))
    assert [np.rint(30.0 * one.stamps).tolist() for one in made.found] == [[*range(25, 30)], [*range(46, 60)]]


def test_short_losses_and_tracks_that_never_began_have_none() -> None:
    assert segments_of(set(range(60)), range(10, 25)).found == []
    assert segments_of(set(range(60)), range(60)).found == []
    assert segments_of({30}, range(10, 60)).found == [], "one pose is no track"
    assert Segments(lambda: Scripted(set())).text() == ""  # type: ignore[arg-type, return-value]


def test_a_real_tracker_goes_on_where_the_first_one_is_lost() -> None:
    made, lost = Segments(lambda: tracker_of("rs-g")), range(5, 34)
    for k in range(36):
        made.feed(frame_at(k), k in lost)
    stamps = np.array([k for k in range(36) if k not in lost]) / 30.0
    joined = made.joined(Estimate(stamps, TRUTH.pose(stamps)))
    assert np.rint(30.0 * joined.stamps).tolist() == [*range(5), *range(20, 36)]
    error = se3.inverse(TRUTH.pose(joined.stamps)) @ joined.T_world_depth
    assert np.linalg.norm(error[:, :3, 3], axis=1).max() < 3e-3
