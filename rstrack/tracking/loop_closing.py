"""The loops of a track that has come to its end, closed on its spline.

stamps, T_world_depth = tracker.trajectory
closing = close_loops(tracker, load)
T_world_depth = closing.moves.poses(tracker.spline, stamps, T_world_depth)
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.adjustment.closing import Closed, Moves, closed
from rstrack.adjustment.graph import Graph, Sighting, State
from rstrack.adjustment.loops import Loop, LoopSearch
from rstrack.adjustment.rigid import Judge
from rstrack.alignment.observation import Observation
from rstrack.alignment.optimizer import Solved
from rstrack.alignment.spline_state import SplineState
from rstrack.data.rig import Frame
from rstrack.keyframes.archive import Archive
from rstrack.keyframes.keyframe import Reference
from rstrack.tracking.judgement.uncertainty import SYSTEMATIC_PX
from rstrack.tracking.matching import judge_alone
from rstrack.tracking.spline_tracker import Tracker

# Loops that `info` lists at most.
_LISTED = 1000


@dataclass(frozen=True)
class Closing:
    """What became of it. closed: None where there is nothing to close; seconds: that it took.

    tried: alignments of pairs; faults: why some were none, and how often. problem: why it could not be done, or not for
    all. moves: by what the track is corrected.
    """

    loops: list[Loop]
    closed: Closed | None
    seconds: float
    tried: int = 0
    faults: Mapping[str, int] = field(default_factory=dict)
    problem: str = ""
    moves: Moves | None = None

    def info(self) -> dict[str, Any]:
        """For run.json."""
        refused = () if self.closed is None else self.closed.refused
        return {
            "count": 0 if self.closed is None else self.closed.closed,
            "refused": sum(refused),
            "track_errors_widened": None if self.closed is None else self.closed.spread,
            "tried": self.tried,
            "faults": dict(self.faults),
            "problem": self.problem or None,
            "pairs": [
                {"frames": [loop.early, loop.late], "disagreement": loop.disagreement, "refused": no}
                for loop, no in zip(self.loops, refused, strict=False)
            ][:_LISTED],
        }

    def text(self, moved_m: float) -> str:
        """A summary of one line. moved_m: the furthest that a pose was moved."""
        if self.closed is None:
            return f"loops: not closed: {self.problem}" if self.problem else f"loops: none found ({self.seconds:.1f} s)"
        info = self.info()
        refused = f", {info['refused']} refused" if info["refused"] else ""
        moved = f"poses moved by up to {1e3 * moved_m:.2f} mm"
        spread = self.closed.spread
        wider = f"; they say that the track's errors are about {spread:g} times what it thinks" if spread > 1.0 else ""
        problem = f"; not all were looked for: {self.problem}" if self.problem else ""
        return f"loops: {info['count']} closed{refused} in {self.seconds:.1f} s; {moved}{wider}{problem}"


def close_loops(
    tracker: Tracker, load: Callable[[int], Frame], progress: Progress = no_progress
) -> Closing:  # fmt: skip
    """Look for places that a track has come back to, and correct it. load: a frame by its number in the track.

    What goes wrong (an image that can no longer be read, a system without a solution) is no reason to lose the track:
    it is said in `Closing.problem`.
    """
    begin = time.perf_counter()
    spline, keyframes = tracker.spline, tracker.track.all_keyframes()
    if spline is None or len(keyframes) < 2:
        return Closing([], None, time.perf_counter() - begin)
    search = search_of(tracker, keyframes, spline, load)
    loops: list[Loop] = []
    result: Closed | None = None
    moves: Moves | None = None
    problem = ""
    try:
        loops = search.find(progress)
        if loops:
            result = closed(graph_of(tracker, keyframes), loops, float(tracker.trajectory[0][0]), progress)
            moves = Moves.between(spline, result.state.spline)
    except (UserError, np.linalg.LinAlgError) as error:
        problem = str(error)
    return Closing(loops, result, time.perf_counter() - begin, search.tried, search.faults, problem, moves)


def search_of(
    tracker: Tracker, keyframes: Archive, spline: Spline, load: Callable[[int], Frame],
    poses: Mapping[int, FloatArray] | None = None,
) -> LoopSearch:  # fmt: skip
    """The search for loops of a track; load: a frame by its number in the track; poses: as in `LoopSearch`."""
    track = tracker.track
    return LoopSearch(
        track.terms, track.rig, track.options, keyframes, lambda k: track.upload_again(k, load(k)), spline,
        track.covariances.uncertainty.drift, judge_of(tracker), track.inflations, poses or {},
    )  # fmt: skip


def graph_of(tracker: Tracker, keyframes: Archive) -> Graph:
    """What a track's frames said of its spline and its keyframes; each of these was where the spline was then."""
    spline = tracker.spline
    assert spline is not None
    poses = {k: keyframes.pose(k) for k in sorted(keyframes.indices)}
    turn = SYSTEMATIC_PX / tracker.rig.depth_camera.fx
    ties = []
    for k, T_world_base in poses.items():
        small = keyframes.small(k)
        information = np.diag(np.repeat([turn * small.median_depth, turn], 3) ** -2.0)
        ties.append(Sighting(k, small.t, se3.inverse(T_world_base) @ spline.pose(small.t), information))
    return Graph(State(spline, poses), tracker.track.chain.seen, ties)


def judge_of(tracker: Tracker) -> Judge:
    """Judges a loop as a frame that nothing predicts, by what the track has learnt of its images and cameras."""
    # The tracker must go on to the same bits, whether or not loops are looked for.
    scales, own = tracker.track.scales, tracker.track.covariances
    covariances = replace(own, calibration=own.calibration.anew())

    def judge(
        fresh: Sequence[Observation], solved: Solved, state: SplineState, ref: Reference
    ) -> tuple[str, FloatArray]:  # fmt: skip
        verdict = judge_alone(scales, covariances, fresh, solved, state, ref.pixels)
        return verdict.fault.value, verdict.score.information

    return judge
