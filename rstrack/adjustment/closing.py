"""Loops closed: the spline and its keyframes moved to where loops and the track's own frames together have them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress, no_progress
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.adjustment.graph import Graph, State
from rstrack.adjustment.loops import Loop

# Squared error of a sighting, in σ, from which on it counts less: six numbers' 99 % quantile.
_OUTLIER = 16.8
# Graduated non-convexity (Yang et al., RA-L 2020): the kernel is this much narrower with every step.
_NARROWER, _MOST_STEPS = 4.0, 40
# Increments (m, rad) that end it.
_SMALL = 1e-7
# Weight below which a loop has been refused by the others.
_REFUSED = 0.1
# By what the track's own errors may be larger than estimated, where loops show it: widened until no more than this part
# of them is refused. So many must agree: a few may as well be false. The second, for where only some are refused: a
# track that may bend much more goes with false ones too (tested).
_MOST_SPREADS, _SOME_SPREADS = (2.0, 4.0, 8.0, 16.0), (2.0, 4.0)
_REFUSED_SHARE, _AGREEING = 0.25, 4


@dataclass(frozen=True)
class Closed:
    """The state with its loops closed. refused (n,): loops that do not go with the others, and count for nothing.

    spread: by what the track's own errors were taken to be larger than estimated.
    """

    state: State
    refused: tuple[bool, ...]
    spread: float = 1.0

    @property
    def closed(self) -> int:
        """Loops that count."""
        return len(self.refused) - sum(self.refused)


def closed(graph: Graph, loops: Sequence[Loop], begin: float, progress: Progress = no_progress) -> Closed:
    """Close loops of the track that a graph describes; the camera stays where it was at time `begin` (s).

    A loop that contradicts the others and the track is left out. Where that were more than a few, though they go with
    each other, it is the track that is wrong by more than estimated: with a slightly wrong camera file, frame after
    frame errs alike, and one blurred part may bend all that follows, which no single frame shows. Raises
    numpy.linalg.LinAlgError where the system has no solution.
    """
    found = _closed(graph, loops, 1.0, progress)
    if len(loops) >= _AGREEING and sum(found.refused) > _REFUSED_SHARE * len(loops):
        for spread in _MOST_SPREADS if 2 * found.closed <= len(loops) else _SOME_SPREADS:
            wider = _closed(graph.weakened(spread), loops, spread, progress)
            if wider.closed >= max(_AGREEING, (1.0 - _REFUSED_SHARE) * len(loops)):
                found = wider
                break
    back = graph.at.spline.pose(begin) @ se3.inverse(found.state.spline.pose(begin))
    return replace(found, state=found.state.placed(back))


def _closed(graph: Graph, loops: Sequence[Loop], spread: float, progress: Progress) -> Closed:
    """By graduated non-convexity: Geman and McClure's kernel, made narrower step by step; then without the refused."""
    refused, state, width = np.zeros(len(loops), bool), graph.at, np.inf
    while not refused.all():
        state, weights = _settled(
            graph, [loop for loop, no in zip(loops, refused, strict=True) if not no], width, progress
        )
        width = 1.0
        weak = (weights.reshape(-1, 2) < _REFUSED).all(axis=1)
        if not weak.any():
            return Closed(state, tuple(refused.tolist()), spread)
        refused[np.flatnonzero(~refused)[weak]] = True
    return Closed(graph.at, tuple(refused.tolist()), spread)


def _settled(graph: Graph, loops: Sequence[Loop], width: float, progress: Progress) -> tuple[State, FloatArray]:
    """The state with these loops, and the weights of their sightings; width: of the kernel, inf at first."""
    sightings = [s for loop in loops for s in loop.sightings]
    count, whole = len(graph.sightings), replace(graph, sightings=[*graph.sightings, *sightings])
    state = graph.at
    weights = np.ones(len(whole.sightings))
    largest: list[float] = []
    progress("closing loops", 0.0, f"{len(loops)} loops")
    informations = np.array([s.information for s in sightings])
    for steps in range(1, _MOST_STEPS + 1):
        state, x = whole.step(state, weights)
        e = state.errors(sightings)
        squares = np.einsum("ni,nij,nj->n", e, informations, e)
        if width > 1.0:
            width = max(1.0, min(width, 2.0 * float(squares.max(initial=0.0)) / _OUTLIER) / _NARROWER)
        weights[count:] = (width * _OUTLIER / (squares + width * _OUTLIER)) ** 2
        largest.append(float(np.abs(x).max()))
        # Steps shrink by about the same factor each.
        part = np.log(largest[0] / max(_SMALL, largest[-1])) / np.log(max(2.0, largest[0] / _SMALL))
        progress("closing loops", float(np.clip(part, 0.0, 1.0)), f"{len(loops)} loops, step {steps}")
        if width == 1.0 and largest[-1] < _SMALL:
            break
    progress("closing loops", 1.0, f"{len(loops)} loops")
    return state, weights[count:]


@dataclass(frozen=True)
class Moves:
    """Left motions (in the world) of a spline's control points.

    points (n, 4, 4): of the first n. later: of all from a number on, up to the next, as one body each; where there are
    none of these they go with the last of `points`.
    """

    points: FloatArray = field(default_factory=lambda: np.zeros((0, 4, 4)))
    later: tuple[tuple[int, FloatArray], ...] = ()

    @classmethod
    def between(cls, before: Spline, after: Spline) -> Moves:
        """Those that make the one spline of the other."""
        return cls(se3.orthonormalise(after.control_points @ se3.inverse(before.control_points)))

    def then(self, first: int, T: FloatArray) -> Moves:
        """From control point number `first` on, T (4, 4) from now on; what is before stays as it is."""
        kept = [(n, before) for n, before in self.later if n < first]
        return replace(self, later=(*kept, (first, T)))

    def of(self, first: int, count: int) -> FloatArray:
        """Motions (count, 4, 4) of control points from number `first` on."""
        numbers = first + np.arange(count)
        known = self.points if len(self.points) else np.eye(4)[None]
        T = known[np.minimum(numbers, len(known) - 1)]
        for begin, motion in self.later:
            T[numbers >= begin] = motion
        return T

    def spline(self, found: Spline) -> Spline:
        """A spline as it was found, moved."""
        T = self.of(found.first, len(found.control_points)) @ found.control_points
        return replace(found, control_points=se3.orthonormalise(T))

    def poses(self, found: Spline, stamps: FloatArray, T_world_depth: FloatArray) -> FloatArray:
        """Poses (n, 4, 4) at stamps (n,) in s, moved as the spline is that was found with them."""
        moved = self.spline(found).pose(stamps) @ se3.inverse(found.pose(stamps))
        return se3.orthonormalise(moved @ T_world_depth)
