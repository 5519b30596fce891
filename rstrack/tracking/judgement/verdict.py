"""Whether a frame has been found, after second thoughts about its depth."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from rstrack.alignment.observation import Observation
from rstrack.alignment.optimizer import Solved
from rstrack.alignment.pull import Pulls, pulls
from rstrack.alignment.spline_state import SplineState
from rstrack.tracking.judgement.fault import Fault
from rstrack.tracking.judgement.lost_track import VOUCHES, FitHistory


def verdict(
    fits: FitHistory, fresh: Sequence[Observation], solved: Solved, state: SplineState, expected: int, new: bool,
    colorless: bool, again: Callable[[], Solved],
) -> tuple[Fault, Pulls, Solved]:  # fmt: skip
    """Why a frame has not been found, if so, how its images pull, and the solution: `solved`, or another.

    fresh: its observations, aligned, of a spline in this state. expected, new, colorless: see `FitHistory.fault`.
    again: solves once more.

    Before a wall depth's errors, which hang together as no count of its pixels shows, pull by a metre what colours tell
    to millimetres. Where the two do not agree, and it is colour that tells the motion, depth counts so little that its
    pull is one σ.
    """
    pulled = pulls(fresh, state)
    fault = fits.fault(fresh, solved, expected, pulled, new, colorless)
    if (
        fault is not Fault.DIVIDED
        or not pulled.sigmas[1] > 1.0
        or pulled.color_spread > min(VOUCHES, pulled.depth_spread)
    ):
        return fault, pulled, solved
    for o in fresh:
        if o.is_depth:
            o.count_as(o.independent / pulled.sigmas[1] ** 2)
    solved = again()
    pulled = pulls(fresh, state)
    return fits.fault(fresh, solved, expected, pulled, new, colorless), pulled, solved
