"""Loops closed: the spline and its keyframes moved to where loops and the track's own frames together have them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rsgen.console.progress import Progress, no_progress
from rsgen.geometry import se3
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


@dataclass(frozen=True)
class Closed:
    """The state with its loops closed. refused (n,): loops that do not go with the others."""

    state: State
    refused: tuple[bool, ...]


def closed(graph: Graph, loops: Sequence[Loop], begin: float, progress: Progress = no_progress) -> Closed:
    """Close loops of the track that a graph describes; the camera stays where it was at time `begin` (s).

    A loop that contradicts the others and the track is left out (Geman and McClure's kernel, made narrower step by
    step). Raises numpy.linalg.LinAlgError where the system has no solution.
    """
    sightings = [s for loop in loops for s in loop.sightings]
    count, whole = len(graph.sightings), replace(graph, sightings=[*graph.sightings, *sightings])
    state, width = graph.at, np.inf
    weights = np.ones(len(whole.sightings))
    informations = np.array([s.information for s in sightings])
    for steps in range(1, _MOST_STEPS + 1):
        state, x = whole.step(state, weights)
        e = state.errors(sightings)
        squares = np.einsum("ni,nij,nj->n", e, informations, e)
        if width > 1.0:
            width = max(1.0, min(width, 2.0 * float(squares.max(initial=0.0)) / _OUTLIER) / _NARROWER)
        weights[count:] = (width * _OUTLIER / (squares + width * _OUTLIER)) ** 2
        progress("closing loops", steps / _MOST_STEPS, f"{len(loops)} loops")
        if width == 1.0 and float(np.abs(x).max()) < _SMALL:
            break
    progress("closing loops", 1.0, f"{len(loops)} loops")
    refused = tuple(bool((pair < _REFUSED).all()) for pair in weights[count:].reshape(-1, 2))
    back = graph.at.spline.pose(begin) @ se3.inverse(state.spline.pose(begin))
    return Closed(state.placed(back), refused)
