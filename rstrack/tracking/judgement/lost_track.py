"""Tell a lost track from a good one: every term is judged on its own, and the motion with them."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from statistics import median

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rstrack.alignment.observation import Observation
from rstrack.alignment.optimizer import SETTLED_PX, Solved
from rstrack.tracking.frame_report import Fault

# The share of the reference's pixels that a term has to see. Without it, and `SETTLED_PX`, a fault on table1-320 is
# silent, and wild2-320 with depth x 0.99, from frame 30, loses 40 frames instead of 4.
_LEAST_SHARE = 0.08
# Part of the compared pixels that must not be outliers for certain (real recordings: 0.88 and 0.98 at least).
_LEAST_FIT_DEPTH, _LEAST_FIT_COLOR = 0.65, 0.8
# Growth of scales over their running medians from which on an image does not fit as others do (without it fr1_rpy, from
# frame 24, runs away after a place is found again, and two faults on lr_kt2-320 are silent, 0.1 and 0.5 m off), and
# scales that are harmless anyway (m at one metre, intensity): a camera at rest repeats its rounding, and a keyframe
# without contrast shows nothing.
GROWTH, _HARMLESS_DEPTH, _HARMLESS_INTENSITY = 3.5, 2e-3, 0.03
# Frames of a running median.
_MEMORY = 30
# Changes of velocity that no hand makes, m/s² and rad/s² (hand-held cameras reach 35 m/s²), nor over a longer time, m/s
# and rad/s, and what is always allowed. Without them faults on demo and on table1-320 are silent.
_MOST_ACCELERATION, _MOST_VELOCITY = np.array([100.0, 200.0]), np.array([4.0, 8.0])
_ALWAYS = np.array([0.05, np.radians(4.0)])


class RunningScales:
    """Scales of the last good frames' residuals: how well an image usually fits."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """No scale is known."""
        # Depth's as they would be at one metre.
        self._depth: deque[float] = deque(maxlen=_MEMORY)
        self._color: deque[float] = deque(maxlen=_MEMORY)

    def learn(self, fresh: Sequence[Observation]) -> None:
        """A frame has been found."""
        for o in fresh:
            if o.is_depth:
                self._depth.append(o.lin.next_sigma / o.ref.median_depth**2)
            else:
                self._color.append(o.lin.next_sigma)

    def exceeded(self, fresh: Sequence[Observation]) -> list[Observation]:
        """Images of a frame that fit worse than the last ones did; none where no scale is known."""
        return [o for o in fresh if o.lin.next_sigma > self._most(o)]

    def _most(self, o: Observation) -> float:
        last, harmless = (self._depth, _HARMLESS_DEPTH) if o.is_depth else (self._color, _HARMLESS_INTENSITY)
        distance = o.ref.median_depth if o.is_depth else 1.0
        return distance**2 * max(harmless, GROWTH * median(last)) if last else np.inf


def misfits(fresh: Sequence[Observation], expected: int) -> list[tuple[Observation, Fault]]:
    """Observations that do not fit, and why. expected: pixels that a whole image puts on the reference."""
    return [(o, why) for o in fresh if (why := _misfit(o, expected))]


def lost(fresh: Sequence[Observation], solved: Solved, expected: int) -> Fault:
    """Why a frame has not been found, `Fault.NONE` if it has. expected: as in `misfits`."""
    if not any(o.is_linearised and o.pixels for o in fresh):
        return Fault.NOTHING_SEEN
    if not is_settled(solved):
        return Fault.UNSETTLED
    return next((why for _, why in misfits(fresh, expected)), Fault.NONE)


def is_hopeless(fresh: Sequence[Observation], moving: float = 0.0) -> bool:
    """Whether no term of a frame, aligned at a coarse level, fits so far that it could at a finer one.

    moving: part of the pixels that need not fit, as they may be left out yet since they move by themselves.
    """
    return not any(o.is_linearised and o.lin.fit >= (1.0 - moving) * _least_fit(o) for o in fresh)


def _misfit(o: Observation, expected: int) -> Fault:
    if not o.is_linearised or o.pixels < max(1.0, _LEAST_SHARE * expected):
        return Fault.NOTHING_SEEN
    # What it is expected to show is not in it, or most of that is something else (3 silent faults on table1-320).
    if o.lin.fit < _least_fit(o) or max(o.lin.contrast, _HARMLESS_INTENSITY) < o.lin.next_sigma:
        return Fault.MISFIT
    return Fault.NONE


def _least_fit(o: Observation) -> float:
    return _LEAST_FIT_DEPTH if o.is_depth else _LEAST_FIT_COLOR


def is_settled(solved: Solved) -> bool:
    """Whether the last step hardly moved a row, or by no more than noise does; also if it was cut for time."""
    return solved.is_within_noise or solved.last_shift <= SETTLED_PX


def implausible(T_predicted: FloatArray, T_found: FloatArray, dt: float) -> bool:
    """Whether a pose (4, 4) is further from the one predicted (4, 4) dt seconds ahead than a hand could move it."""
    off = se3.log(se3.inverse(T_predicted) @ T_found)
    most = _ALWAYS + np.minimum(_MOST_ACCELERATION * dt**2, _MOST_VELOCITY * dt)
    return bool((np.linalg.norm(off.reshape(2, 3), axis=1) > most).any())
