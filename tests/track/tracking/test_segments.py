"""A lost camera's own tracks: when they begin and end, where they lie, what is written of them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from test_spline_tracker import TRUTH, blank, feed, frame_at, tracker_of

from rsgen.geometry import se3
from rsgen.sequence.trajectory import read_trajectory
from rstrack.data.estimate import SEGMENTS, Estimate
from rstrack.data.rig import Frame
from rstrack.tracking.frame_report import Fault, FrameReport, frame_report
from rstrack.tracking.runs.segments import Segment, Segments, segments_beside
from rstrack.tracking.spline_tracker import Tracker


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
    reports: list[FrameReport] = field(default_factory=list)

    def feed(self, frame: Frame) -> Any:
        k = round(30.0 * frame.depth.stamp)
        self.at += [k] if k in self.finds else []
        fault = Fault.NONE if k in self.finds else Fault.NO_PLACE
        self.reports.append(frame_report(frame.depth.stamp, [], None, keyframe=False, fault=fault, overlap=1.0))
        return self.reports[-1]

    @property
    def trajectory(self) -> tuple[np.ndarray, np.ndarray]:
        stamps = np.array(self.at) / 30.0
        return stamps, se3.inverse(POSE) @ true_poses(stamps)


def reports_of(finds: set[int], frames: int = 60) -> list[FrameReport]:
    tracker = Scripted(finds)
    for frame in FRAMES[:frames]:
        tracker.feed(frame)
    return tracker.reports


def segments_of(finds: set[int], lost: range) -> Segments:
    """Of a first track that loses some frames, where others are there to be found."""
    made = Segments(lambda: Scripted(finds), FRAMES.__getitem__, 6)  # type: ignore[arg-type, return-value]
    reports = reports_of(set(range(60)) - set(lost))
    for k in range(60):
        made.feed(FRAMES[k], reports[: k + 1])
    made.end(reports)
    return made


def first_track(lost: range) -> tuple[np.ndarray, np.ndarray]:
    stamps = np.array([k for k in range(60) if k not in lost]) / 30.0
    return stamps, true_poses(stamps)


def test_after_half_a_second_a_segment_begins_with_the_last_frames_found_and_ends_with_the_next() -> None:
    lost = range(10, 40)
    made = segments_of(set(range(60)), lost)
    (segment,) = made.found
    assert np.rint(30.0 * segment.stamps).tolist() == [*range(4, 41)]
    assert np.rint(30.0 * segment.ties).tolist() == [*range(4, 10), 40]
    joined = made.joined(Estimate(*first_track(lost)))
    assert np.rint(30.0 * joined.stamps).tolist() == [*range(60)]
    np.testing.assert_allclose(joined.T_world_depth, true_poses(joined.stamps), atol=1e-12)
    told = made.reports(reports_of(set(range(60)) - set(lost)), joined)
    assert not any(r.lost for r in told)
    assert [k for k, r in enumerate(told) if r.segment] == [*lost]


def test_where_the_first_track_finds_the_camera_the_way_there_bends_to_it() -> None:
    lost = range(10, 40)
    stamps, T = first_track(lost)
    T[stamps > 0.5, 0, 3] += 0.031  # frames 9 and 40 are 31 frames apart
    joined = segments_of(set(range(60)), lost).joined(Estimate(stamps, T))
    off = joined.T_world_depth - true_poses(joined.stamps)
    np.testing.assert_allclose(off[10:40, 0, 3], 0.001 * np.arange(1, 31), atol=1e-12)
    assert np.abs(off[10:40, :, :3]).max() < 1e-12


def test_a_segment_knows_its_errors_and_those_of_the_frame_that_ties_it() -> None:
    rng, tie, frame = np.random.default_rng(4), 9, 20
    factors = 1e-3 * rng.normal(size=(6, 6, 6))  # of covariances: own and drift of the tie in both tracks and the frame
    common = rng.normal(size=(3, 6, 2))

    def known(report: FrameReport, k: int) -> FrameReport:
        own, drift = (factors[i] @ factors[i].T for i in (2 * k, 2 * k + 1))
        return replace(report, covariance=own, drift_world=drift, common=common[k])

    stamps, found = np.array([tie, frame]) / 30.0, reports_of({tie, frame})
    first = [*found[:tie], known(found[tie], 0), *reports_of(set())[tie + 1 :]]
    own = {stamps[0]: known(found[tie], 1), stamps[1]: known(found[frame], 2)}

    def segments(twists: np.ndarray) -> tuple[Segments, Estimate]:
        """Of poses with an error (3, 6) each of their own, and one (3, 6) of their keyframe's in its world."""
        poses = np.concatenate([true_poses(stamps[:1]), se3.inverse(POSE) @ true_poses(stamps)])
        off = se3.exp(twists[1]) @ poses @ se3.exp(twists[0])
        made = segments_of(set(), range(0))
        made.found = [Segment(stamps, off[1:], own, stamps[:1])]
        return made, Estimate(stamps[:1], off[:1])

    # By differences: what each of these errors does to the frame.
    made, track = segments(np.zeros((2, 3, 6)))
    at, step, J = made.joined(track).T_world_depth[1], 1e-6, np.zeros((2, 3, 6, 6))
    for index in np.ndindex(2, 3, 6):
        twists = np.zeros((2, 3, 6))
        twists[index] = step
        moved, by = segments(twists)
        J[index[0], index[1], :, index[2]] = se3.log(se3.inverse(at) @ moved.joined(by).T_world_depth[1]) / step
    told = made.reports(first, made.joined(track))[frame]
    assert not told.lost and told.segment == 1
    assert told.covariance is not None and told.drift_world is not None and told.common is not None
    expected = sum(J[k % 2, k // 2] @ f @ f.T @ J[k % 2, k // 2].T for k, f in enumerate(factors))
    from_world = se3.adjoint(se3.inverse(at))
    np.testing.assert_allclose(told.covariance + from_world @ told.drift_world @ from_world.T, expected, atol=1e-10)
    np.testing.assert_allclose(told.common, sum(J[0, k] @ common[k] for k in range(3)), atol=1e-5)


def test_frames_that_a_segment_could_make_nothing_of_are_not_tried_twice() -> None:
    fed: list[int] = []
    made = Segments(lambda: Scripted({*range(46, 60)}), lambda k: (fed.append(k), FRAMES[k])[1], 6)  # type: ignore[arg-type, func-returns-value, return-value]
    reports = reports_of(set(range(10)))
    for k in range(60):
        made.feed(FRAMES[k], reports[: k + 1])
    made.end(reports)
    assert fed == [*range(4, 25)]
    assert [np.rint(30.0 * one.stamps).tolist() for one in made.found] == [[*range(46, 60)]]


def test_without_a_frame_in_common_nobody_knows_where_a_segment_lies(tmp_path: Path) -> None:
    for finds, lost in ((set(range(25, 40)), range(10, 41)), (set(range(25, 60)), range(10, 60))):
        made = segments_of(finds, lost)
        assert [one.is_tied for one in made.found] == [False]
        own = Estimate(*first_track(lost), None, {"segments": made.info()})
        np.testing.assert_array_equal(made.joined(own).T_world_depth, own.T_world_depth)
        reports = made.reports(reports_of(set()), own)
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


def test_where_a_tied_segment_is_lost_the_next_one_is_tied_to_it() -> None:
    finds = iter([set(range(30)), set(range(60))])
    made = Segments(lambda: Scripted(next(finds)), FRAMES.__getitem__, 6)  # type: ignore[arg-type, return-value]
    reports = reports_of(set(range(10)))
    for k in range(60):
        made.feed(FRAMES[k], reports[: k + 1])
    made.end(reports)
    _, second = made.found
    assert np.rint(30.0 * second.stamps).tolist() == [*range(24, 60)]
    assert np.rint(30.0 * second.ties).tolist() == [*range(24, 30)]
    joined = made.joined(Estimate(*first_track(range(10, 60))))
    assert np.rint(30.0 * joined.stamps).tolist() == [*range(60)]
    np.testing.assert_allclose(joined.T_world_depth, true_poses(joined.stamps), atol=1e-12)
    assert [r.segment for r in made.reports(reports, joined)] == [*[0] * 10, *[1] * 20, *[2] * 30]


def test_short_losses_and_tracks_that_never_began_have_none() -> None:
    assert segments_of(set(range(60)), range(10, 25)).found == []
    assert segments_of(set(range(60)), range(60)).found == []
    assert segments_of({30}, range(10, 60)).found == [], "one pose is no track"
    assert segments_of(set(range(10)), range(10, 60)).found == [], "all of its poses are the first track's"
    assert Segments(lambda: Scripted(set()), FRAMES.__getitem__, 6).text() == ""  # type: ignore[arg-type, return-value]


def test_a_real_tracker_goes_on_where_the_first_one_is_lost() -> None:
    made, lost = Segments(lambda: tracker_of("rs-g"), frame_at, 6), range(8, 34)
    reports = reports_of(set(range(36)) - set(lost), 36)
    for k in range(36):
        made.feed(frame_at(k), reports[: k + 1])
    stamps = np.array([k for k in range(36) if k not in lost]) / 30.0
    joined = made.joined(Estimate(stamps, TRUTH.pose(stamps)))
    assert np.rint(30.0 * joined.stamps).tolist() == [*range(36)]
    error = se3.inverse(TRUTH.pose(joined.stamps)) @ joined.T_world_depth
    assert np.linalg.norm(error[:, :3, 3], axis=1).max() < 3e-3


def test_a_segment_begins_with_what_the_first_track_knows_of_the_images() -> None:
    """Regression: where it did not know how well images fit, a jump to another place passed, 0.3 m off."""
    first = feed(tracker_of("rs-g"), (frame_at(k) for k in range(12)))
    made = segments_beside(first, first.rig, first.options, frame_at).make()
    assert isinstance(made, Tracker)

    def known(tracker: Tracker) -> list[Any]:
        return [
            list(seen) for part in (tracker.track.scales, *tracker.track.independence) for seen in vars(part).values()
        ]

    usual = known(first)
    assert known(made) == usual and usual[0] and usual[2]
    feed(made, (frame_at(k) for k in range(6, 14)))
    assert known(first) == usual != known(made), "each learns for itself"
