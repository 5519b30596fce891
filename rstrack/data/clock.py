"""The clock behind a stream's stamps: what drivers write are times of arrival, and cameras expose at even intervals.

clock, even = straightened(stamps)        # period, jitter, dropped images; when the images of that clock were taken
live = RunningClock(); live.feed(stamp)   # the same, causal

A stream's images are counted (each is a whole number of periods after the one before), and a line, or over minutes a
slow curve, is fitted through stamps against counts. Arrival is late or early by a mix of polling and load. Where the
earliest stamps have a sharp edge, the line is laid along that edge, otherwise through the middle. Either way its level
is that of the middle, so that the mean delay stays what it was.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.interpolate import BSpline
from scipy.sparse import csr_array
from scipy.sparse.linalg import spsolve

from rsgen.array_types import FloatArray, IntArray

Verdict = Literal["regular", "jittered", "irregular", "too short"]

# Rounding of stamps to four decimals has 29 µs RMS. A sensor's own line timing is steadier than that by far.
_REGULAR_S = 50e-6
# Jitter (robust, in periods) above which even intervals do not describe the stamps; uniformly random ones have 0.29.
_IRREGULAR = 0.15
# A line through fewer stamps is worse than the stamps.
_FEWEST = 20
# A pause after which a camera may have been started anew: the clock is fitted on each side by itself.
_PAUSE_S = 2.0
# Knots of the slow curve: a clock that warms up drifts by some ppm in minutes; driver queues shift stamps for seconds.
_KNOTS_S = 60.0
# Most that the curve's rate may leave the mean period by: quartz stays within tens of ppm.
_MOST_DRIFT = 300e-6
# Quantile of residuals that an edge of earliest stamps has below it; spread of the lowest stamps against that of the
# middle below which there is such an edge (normal jitter: 0.95, uniform: 0.28, late by an exponential time: 0.13).
_EDGE, _SHARP = 0.03, 0.4
# How far back a late image may have been counted one too far, when a later one turns up in its place.
_LATE = 8
_PASSES, _SETTLED_S = 30, 1e-6


@dataclass(frozen=True)
class StampClock:
    """The clock behind a stream's stamps, as far as they show it.

    images: number of stamps. period_s: between images (0: too few stamps). first_s: straightened stamp of the first.
    jitter_rms_s, jitter_max_s: stamps against the straightened ones. dropped: periods without an image, pauses left
    out. repeated: images beyond one in a period. verdict: regular, nothing to mend; jittered, arrival times of a steady
    clock; irregular, no steady clock; too short to say.
    """

    images: int
    period_s: float
    first_s: float
    jitter_rms_s: float
    jitter_max_s: float
    dropped: int
    repeated: int
    verdict: Verdict


def drift_ppm(clock: StampClock, other: StampClock) -> float | None:
    """Parts per million by which a clock runs fast against another stream's.

    Rates may be multiples of each other (15 and 30 Hz). None where they are not, within 1 %, or one is not known.
    """
    if min(clock.period_s, other.period_s) <= 0.0 or {"irregular", "too short"} & {clock.verdict, other.verdict}:
        return None
    ratio = other.period_s / clock.period_s
    nominal = round(ratio) if ratio >= 1.0 else 1.0 / round(1.0 / ratio)
    drift = ratio / nominal - 1.0
    return 1e6 * drift if abs(drift) < 0.01 else None


def straightened(stamps: npt.ArrayLike) -> tuple[StampClock, FloatArray]:
    """The clock of stamps (n,) in seconds, not decreasing, and the stamps as it has them, whatever its verdict.

    Strictly increasing where `stamps` are; repeated images are a hundredth of a period apart.
    """
    t = np.asarray(stamps, np.float64)
    steps = np.diff(t)
    if len(t) < _FEWEST or not (steps > 0).any():
        period = float(np.median(steps)) if len(steps) else 0.0
        return StampClock(len(t), period, float(t[0]) if len(t) else 0.0, 0.0, 0.0, 0, 0, "too short"), t
    # Most steps are one period; where more than half are two, because images were dropped, the short ones decide.
    found = _with_period(t, float(np.median(steps[steps > 0])))
    if found[0].verdict != "irregular":
        return found
    other = _with_period(t, float(np.quantile(steps[steps > 0], 0.1)))
    return found if other[0].verdict == "irregular" else other


def _with_period(t: FloatArray, guess: float) -> tuple[StampClock, FloatArray]:
    """The clock whose period is near `guess` seconds, and the stamps on it."""
    period = _refined(np.diff(t), guess)
    parts = np.split(np.arange(len(t)), np.flatnonzero(np.diff(t) > max(_PAUSE_S, 10.0 * period)) + 1)
    even, dropped, repeated, periods, lengths = t.copy(), 0, 0, [period], [0]
    steady = True
    for part in parts:
        count, again = _counted(t[part], period)
        dropped += int(count[-1] - count[0] + 1 - (len(part) - again.sum()))
        repeated += int(again.sum())
        if len(part) < _FEWEST:
            continue
        on_clock, part_period = _on_clock(count, t[part], again)
        steady &= _is_steady(on_clock, count)
        index = np.arange(len(part))
        in_a_row = (index - np.maximum.accumulate(np.where(again, 0, index))).astype(np.float64)  # repetitions
        even[part] = on_clock + 0.01 * part_period * in_a_row
        periods.append(part_period)
        lengths.append(len(part))
    period = periods[int(np.argmax(lengths))]
    error = t - even
    rms, most = float(np.sqrt(np.mean(error**2))), float(np.abs(error).max())
    # Of most stamps: a few that were held up by a busy computer do not make a clock irregular.
    typical = float(np.sqrt(np.mean(np.sort(error**2)[: int(np.ceil(0.95 * len(t)))])))
    verdict: Verdict = "regular" if rms <= _REGULAR_S else "jittered"
    if not steady or typical > _IRREGULAR * period or repeated > 0.5 * len(t):
        verdict = "irregular"
    return StampClock(len(t), period, float(even[0]), rms, most, dropped, repeated, verdict), even


def _refined(steps: FloatArray, guess: float) -> float:
    """Mean of the steps of one period: stamps on a coarse grid have a median that is off by several per cent."""
    for _ in range(3):
        single = steps[(steps > 0.5 * guess) & (steps < 1.5 * guess)]
        guess = float(single.mean()) if len(single) else guess
    return guess


def _counted(t: FloatArray, period: float) -> tuple[IntArray, npt.NDArray[np.bool_]]:
    """Number of the period (n,) that each image belongs to, and whether it repeats the one before it.

    The phase is followed slowly, so that a late image is not counted into the next period for good.
    """
    count = np.zeros(len(t), np.int64)
    again = np.zeros(len(t), bool)
    start = t[: min(len(t), 4 * _LATE)] - t[0]
    turns = np.exp(2j * np.pi * start / period)
    phase = float(t[0] + period * np.angle(turns.mean()) / (2.0 * np.pi))
    for i, stamp in enumerate(t):
        offset = (stamp - phase) / period
        k = int(np.rint(offset))
        if i and k <= count[i - 1]:
            k = int(count[i - 1]) + 1
            slack = next((j for j in range(i - 1, max(i - _LATE, 0), -1) if count[j] - count[j - 1] > 1), None)
            if slack is not None and offset < k - 0.5:
                count[slack:i] -= 1  # the images before were late: this one stands where the last was put
                k -= 1
            elif offset < k - 0.75:
                again[i], k = True, k - 1
        count[i] = k
        phase += 0.05 * period * float(np.clip(offset - k, -0.25, 0.25)) if i else 0.0
    return count, again


def _on_clock(count: IntArray, t: FloatArray, again: npt.NDArray[np.bool_]) -> tuple[FloatArray, float]:
    """Stamps (n,) of a steady clock that made images `count` (n,) arrive at t (n,), and its mean period in seconds."""
    A = _basis(count, (t[-1] - t[0]))
    # Seconds of today have few digits left: the curve is fitted to what remains beside a line.
    line = np.polynomial.Polynomial.fit(count, t - t[0], 1)
    rest = t - t[0] - line(count)
    weight = np.where(again, 1e-6, 1.0)
    fits = [_fit(A, rest, weight, edge) for edge in (False, True)]
    errors = rest - fits[1]
    low, first, third, sharp = np.quantile(errors[~again], [0.01, 0.25, 0.75, 0.15])
    fit = fits[1] if sharp - low < _SHARP * (third - first) else fits[0]
    even = t[0] + line(count) + fit
    even = even + np.median((t - even)[~again])
    slope = np.polynomial.Polynomial.fit(count, even - t[0], 1).convert().coef
    return even, float(slope[1])


def _basis(count: IntArray, duration_s: float) -> csr_array:
    """Functions (n, m) of the count: a line's for a recording of two minutes or less, then cubic B-splines."""
    segments = max(int(duration_s / _KNOTS_S), 1)
    degree = 1 if segments < 2 else 3
    inner = np.linspace(count[0], count[-1], segments + 1)
    knots = np.concatenate([[inner[0]] * degree, inner, [inner[-1]] * degree])
    return csr_array(BSpline.design_matrix(count.astype(np.float64), knots, degree))


def _fit(A: csr_array, y: FloatArray, weight: FloatArray, edge: bool) -> FloatArray:
    """Robust fit A x (n,) to y (n,): Huber's, or a quantile regression along the edge of the smallest values.

    Iteratively reweighted least squares; coefficients that no stamp fixes are kept smooth.
    """
    columns = A.shape[1]
    bend = np.diff(np.eye(columns), 2, axis=0) if columns > 2 else np.zeros((0, columns))
    smooth = csr_array(1e-6 * len(y) / columns * (bend.T @ bend))
    w, fit = weight, np.full(len(y), np.inf)
    for _ in range(_PASSES):
        Aw = A.multiply(w[:, None]).tocsc()
        x = np.atleast_1d(spsolve((A.T @ Aw + smooth).tocsc(), Aw.T @ y))
        before, fit = fit, np.asarray(A @ x)
        if np.abs(fit - before).max() < _SETTLED_S:
            break
        r = y - fit
        if edge:
            w = weight * np.where(r > 0.0, _EDGE, 1.0 - _EDGE) / np.maximum(np.abs(r), 1e-4)
        else:
            scale = max(1.3 * 1.4826 * float(np.median(np.abs(r))), 1e-7)
            w = weight / np.maximum(1.0, np.abs(r) / scale)
    return fit


def _is_steady(even: FloatArray, count: IntArray) -> bool:
    """Whether the fitted clock keeps its rate as quartz does."""
    counts = np.diff(count)
    steps = np.diff(even)[counts > 0] / counts[counts > 0]
    return bool(np.ptp(steps) < 2.0 * _MOST_DRIFT * np.median(steps))


# Stamps that pass unchanged before there is a line; seconds after which a stamp counts 1/e.
_FIRST, _MEMORY_S = 12, 20.0
# Part of the last ten or so stamps off the line by more than a third of a period, from which on the rate has changed.
_MOST_OFF = 0.4
# Least step between two stamps given, in periods.
_LEAST_STEP = 0.05


@dataclass
class RunningClock:
    """Straightens one stream's stamps (s), which must increase. The first few come back as they are.

    A change of rate, or a pause, starts anew. Later stamps are not known: the first seconds are straightened less.
    """

    _recent: list[float] = field(default_factory=list)
    _period: float = 0.0
    # Weighted sums of 1, k, k², y, k·y: the count k and residual time y are relative to the newest image's.
    _sums: np.ndarray = field(default_factory=lambda: np.zeros(5))
    _base: float = 0.0
    _scale: float = 0.0
    _off: float = 0.0
    _last: float = -math.inf

    def feed(self, stamp: float) -> float:
        """The stamp on the clock so far. At least a twentieth of a period after the one before."""
        if self._period > 0.0 and stamp - self._base > max(_PAUSE_S, 10.0 * self._period):
            self._restart()
        even = self._on_line(stamp) if self._period > 0.0 else self._collect(stamp)
        self._last = max(even, self._last + _LEAST_STEP * self._period)
        return self._last

    def _restart(self) -> None:
        self._recent, self._period, self._off = [], 0.0, 0.0

    def _collect(self, stamp: float) -> float:
        self._recent.append(stamp)
        if len(self._recent) == _FIRST:
            behind = np.array(self._recent) - stamp
            steps = np.diff(behind)
            median = float(np.median(steps))
            self._period = float(np.mean(steps[np.abs(steps - median) <= 0.5 * median]))
            self._base, self._sums, self._scale = stamp, np.zeros(5), 0.1 * self._period
            for time in behind:
                self._add(float(np.rint(time / self._period)), float(time), 1.0)
        return stamp

    def _on_line(self, stamp: float) -> float:
        """Predict, count, weigh by the residual (Huber), fit."""
        level, period = self._line()
        count = max(round((stamp - self._base - level) / period), 1)
        residual = stamp - self._base - level - count * period
        self._off += 0.1 * (float(abs(residual) > period / 3.0) - self._off)
        if self._off > _MOST_OFF:
            self._restart()
            return self._collect(stamp)
        self._shift(count, count * period + level)
        self._scale += 0.02 * (min(abs(residual), 3.0 * self._scale) - self._scale)
        self._add(0.0, residual, min(1.0, 1.5 * self._scale / max(abs(residual), 1e-9)))
        level, self._period = self._line()
        return self._base + level

    def _line(self) -> tuple[float, float]:
        """Time of count 0 after `_base`, and the period, in seconds."""
        n, k, kk, y, ky = self._sums
        slope = (n * ky - k * y) / (n * kk - k * k)
        return (y - slope * k) / n, slope

    def _shift(self, count: int, time: float) -> None:
        """Count and time from an image `count` periods and `time` seconds later; older stamps weigh a little less."""
        n, k, kk, y, ky = self._sums
        moved = (n, k - count * n, kk - 2 * count * k + count**2 * n, y - time * n,
                 ky - time * k - count * y + count * time * n)  # fmt: skip
        self._sums = math.exp(-count * self._period / _MEMORY_S) * np.array(moved)
        self._base += time

    def _add(self, k: float, y: float, weight: float) -> None:
        self._sums += weight * np.array([1.0, k, k * k, y, k * y])
