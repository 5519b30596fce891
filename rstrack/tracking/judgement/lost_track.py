"""Tell a lost track from a good one: every term is judged on its own, and the motion with them."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from statistics import median

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rstrack.alignment.observation import Observation
from rstrack.alignment.optimizer import Solved
from rstrack.alignment.pull import Pulls
from rstrack.tracking.judgement.fault import Fault

# A term has to see this share of the reference's pixels, and so many at least, to say anything.
_LEAST_SHARE = 0.08
_LEAST_PIXELS = 60
# Part of the compared pixels that must not be outliers for certain (real recordings: 0.88 and 0.98 at least).
_LEAST_FIT_DEPTH, _LEAST_FIT_COLOR = 0.65, 0.8
# Scales that no aligned images have, and growth over the last frames' median that none shows (m at one metre,
# growing with the distance; intensity).
_WORST_DEPTH, _WORST_INTENSITY = 0.03, 0.12
_GROWTH, _HARMLESS_DEPTH, _HARMLESS_INTENSITY = 6.0, 2e-3, 0.03
# In a piece of the track that has just begun nothing of its own says yet what is right: growth there (of 481 frames
# found under vibration all but one stayed within 3.0; that one, at 4.5, was 26 mm off).
_NEW_GROWTH = 3.5
# What each term may reach alone it may not together with the other: geometric mean of the two scales, each over its
# limit (fr1_rpy in six forms, where it is tracked well: 0.43 at most), and what colours that were left out count for.
_WORST_TOGETHER, _LEFT_OUT = 0.45, 0.6
# Depth alone that hardly tells a motion (see `FrameReport.observability`; less where pixels are larger than those of
# this focal length, by the square of their size, since corners count the less there) has to fit as it usually does:
# part of the limit. Frames that slid along a wall for 100 mm and more fit two to three times worse than those before.
_WEAKLY_SEEN, _FINE_FOCAL, _WORST_WEAK = 5e-3, 240.0, 0.33
# At coarse levels, before all is aligned, scales are up to 1.3 times these limits, and 2 to 50 where nothing fits.
_HOPELESS = 2.0
# What counts as usual grows no further than this over the best that was usual: bad must not become usual.
_DECAY = 2.0
# A camera at rest repeats its rounding: what counts as usual then says little. Multiple of the rounding that is fine.
_ROUNDING = 2.5
# Lines that still move so far (pixels) have not been found.
_WORST_SHIFT_PX = 2.0
# Changes of velocity that no hand makes, m/s² and rad/s² (hand-held cameras reach 35 m/s²), nor over a longer time, m/s
# and rad/s, and what is always allowed.
_MOST_ACCELERATION, _MOST_VELOCITY = np.array([100.0, 200.0]), np.array([4.0, 8.0])
_ALWAYS = np.array([0.05, np.radians(4.0)])
_MEMORY = 30
# How far a frame's images, or one term alone, may pull (see `alignment.pull`) where a piece of the track has just begun
# and no prediction says whether it is right: so many times the usual, and always so many metres; and so many times the
# usual number of σ, and always so many. Further in both is too far. Usual is what a quarter of the last frames stays
# below, lest bad becomes usual; in the first frames nothing is.
_PULLS = "whole", "depth", "color"
_PULL_WHOLE, _PULL_ALONE, _PULL_SIGMAS = (4.0, 6e-3), (7.0, 8e-3), (3.0, 5.0)
# So far (m, of what is within so many metres; noise of depth grows with the square beyond) and so many σ is too far
# whatever is usual: where a track begins before a wall, depth alone slides from the first frame on, and that would be
# usual: 0.25 to 1 m at 14 to 23 σ; where that wall was taken for another place 0.06 to 0.12 m at 6 to 8 σ.
_MOST_PULL, _PULL_WITHIN = (0.06, 6.0), 2.5
_USUAL, _FEW = 0.25, 5
# By how much less than usual a colour image's pixels tell where its lines do not show one motion.
_UNSTEADY = 10.0
# Frames from which on their median says what is best, and the distance (m) below which limits shrink no further.
_SETTLED, _CLOSE = 15, 0.5


@dataclass
class _Usual:
    """Scales of one term in the last good frames, those of depth as they would be at one metre."""

    worst: float
    harmless: float
    recent: deque[float] = field(default_factory=lambda: deque(maxlen=_MEMORY))
    best: float = np.inf

    def limit(self, floor: float, distance: float = 1.0, growth: float = _GROWTH) -> float:
        """Scale beyond which a frame does not fit. distance (m): of what is seen; the noise of depth grows with its
        square."""
        worst = self.worst * max(_CLOSE, distance)
        usual = distance**2 * min(median(self.recent), _DECAY * self.best) if self.recent else worst
        return min(worst, max(self.harmless, _ROUNDING * floor, growth * usual))

    def learn(self, sigma: float, distance: float = 1.0) -> None:
        self.recent.append(sigma / distance**2)
        if len(self.recent) >= _SETTLED:
            self.best = min(self.best, median(self.recent))


class FitHistory:
    """Remembers how well the last good frames fitted.

    is_modelled: whether the lines' times are; taken for a global one, a rolling shutter makes both terms fit worse
    whenever the camera moves fast.
    """

    def __init__(self, is_modelled: bool = True) -> None:
        self.is_modelled = is_modelled
        self.forget()

    def forget(self) -> None:
        """Nothing is usual yet."""
        self._depth = _Usual(_WORST_DEPTH, _HARMLESS_DEPTH)
        self._color = _Usual(_WORST_INTENSITY, _HARMLESS_INTENSITY)
        self._pulls: deque[Pulls] = deque(maxlen=_MEMORY)

    def misfits(self, fresh: Sequence[Observation], expected: int) -> list[tuple[Observation, Fault]]:
        """Observations that do not fit, and why. expected: pixels that a whole image puts on the reference."""
        return [(o, why) for o in fresh if (why := self._misfit(o, expected))]

    def fault(
        self, fresh: Sequence[Observation], solved: Solved, expected: int, pulls: Pulls | None = None,
        new: bool = False, colorless: bool = False,
    ) -> Fault:  # fmt: skip
        """Why a frame has not been found, `Fault.NONE` if it has: then it is learnt from.

        expected: as in `misfits`. pulls: of `fresh`, where they are judged. new: whether its piece has just begun.
        colorless: whether colours that do not fit have been left out.
        """
        if not fresh or not any(o.is_linearised for o in fresh):
            return Fault.NOTHING_SEEN
        if not is_settled(solved):
            return Fault.UNSETTLED
        misfits = self.misfits(fresh, expected)
        if misfits:
            return misfits[0][1]
        if new:
            if self.is_modelled and self._together(fresh, colorless) > _WORST_TOGETHER:
                return Fault.MISFIT
            if all(o.is_depth for o in fresh) and any(self._is_doubtful(o) for o in fresh):
                return Fault.MISFIT
            if any(o.inflation * o.independent > _UNSTEADY for o in fresh if not o.is_depth):
                return Fault.MOTION
            if any(o.lin.next_sigma > self._limit(o, _NEW_GROWTH) for o in fresh):
                return Fault.MISFIT
        if pulls is not None:
            distance = max(_CLOSE, fresh[0].ref.median_depth)
            if new and self._pulls_away(pulls, distance):
                return Fault.MOTION
            self._pulls.append(pulls.scaled(distance**-2))
        for o in fresh:
            if o.is_depth:
                self._depth.learn(o.lin.next_sigma, o.ref.median_depth)
            else:
                self._color.learn(o.lin.next_sigma)
        return Fault.NONE

    def _together(self, fresh: Sequence[Observation], colorless: bool) -> float:
        depth = max((o.lin.next_sigma / self._limit(o) for o in fresh if o.is_depth), default=0.0)
        color = max((o.lin.next_sigma / self._limit(o) for o in fresh if not o.is_depth), default=0.0)
        return float(np.sqrt(depth * max(color, _LEFT_OUT if colorless else 0.0)))

    def _is_doubtful(self, o: Observation) -> bool:
        is_weak = o.lin.observability < _WEAKLY_SEEN * coarseness(o) ** -2
        return is_weak and o.lin.next_sigma > _WORST_WEAK * self._limit(o)

    def _pulls_away(self, now: Pulls, distance: float) -> bool:
        """distance (m), `_CLOSE` at least: of what is seen; where noise grows with its square, so do pulls."""
        return slides(now, distance) or any(self._is_far(name, n, now, distance) for n, name in enumerate(_PULLS))

    def _is_far(self, name: str, n: int, now: Pulls, distance: float) -> bool:
        """Of the pull of that name, the nth: whether it is too far."""
        usual = [(pull, before.sigmas[n]) for before in self._pulls if np.isfinite(pull := getattr(before, name))]
        pull, sigmas = getattr(now, name), now.sigmas[n]
        if len(usual) < _FEW or not np.isfinite(pull):
            return False
        metres, known = np.quantile(usual, _USUAL, axis=0)
        (growth, always), (times, least) = _PULL_WHOLE if name == "whole" else _PULL_ALONE, _PULL_SIGMAS
        is_odd = sigmas > max(least, times * known)
        return bool(is_odd and pull > max(always, growth * distance**2 * metres))

    def is_hopeless(self, fresh: Sequence[Observation], moving: float = 0.0) -> bool:
        """Whether no term of a frame, aligned at a coarse level, fits so far that it could at a finer one.

        moving: part of the pixels that need not fit, as they may be left out yet since they move by themselves.
        """
        return not any(
            o.is_linearised
            and o.lin.fit >= (1.0 - moving) * _least_fit(o)
            and o.lin.next_sigma <= _HOPELESS * self._limit(o)
            for o in fresh
        )

    def _misfit(self, o: Observation, expected: int) -> Fault:
        if not o.is_linearised or o.pixels < max(_LEAST_PIXELS, _LEAST_SHARE * expected):
            return Fault.NOTHING_SEEN
        if o.lin.fit < _least_fit(o):
            return Fault.MISFIT
        if max(o.lin.contrast, _HARMLESS_INTENSITY) < o.lin.next_sigma:
            return Fault.MISFIT  # what it is expected to show is not in it
        if o.lin.next_sigma > self._limit(o):
            return Fault.MISFIT
        return Fault.NONE

    def _limit(self, o: Observation, growth: float = _GROWTH) -> float:
        usual, distance = (self._depth, o.ref.median_depth) if o.is_depth else (self._color, 1.0)
        return usual.limit(o.lin.floor, distance, growth)


def coarseness(o: Observation) -> float:
    """How many times larger than usual a reference's pixels are, at least 1: the less do corners count in them."""
    return max(1.0, _FINE_FOCAL / o.ref.lens.camera.fx)


def slides(now: Pulls, distance: float) -> bool:
    """Whether images of a piece of the track that has just begun pull further than any do that have been found.

    distance (m): of what is seen.
    """
    metres, sigmas = _MOST_PULL
    return now.sigmas[0] > sigmas and now.whole > metres * max(1.0, distance / _PULL_WITHIN) ** 2


def _least_fit(o: Observation) -> float:
    return _LEAST_FIT_DEPTH if o.is_depth else _LEAST_FIT_COLOR


def is_settled(solved: Solved) -> bool:
    """Whether the last step hardly moved a line, or by no more than noise does."""
    return solved.is_within_noise or solved.last_shift <= _WORST_SHIFT_PX


def implausible(T_predicted: FloatArray, T_found: FloatArray, dt: float) -> bool:
    """Whether a pose (4, 4) is further from the one predicted (4, 4) dt seconds ahead than a hand could move it."""
    off = se3.log(se3.inverse(T_predicted) @ T_found)
    most = _ALWAYS + np.minimum(_MOST_ACCELERATION * dt**2, _MOST_VELOCITY * dt)
    return bool((np.linalg.norm(off.reshape(2, 3), axis=1) > most).any())
