"""Stamps straightened as they come: a line through arrival times with forgetting, at constant cost."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

# Stamps that pass unchanged before there is a line; seconds after which a stamp counts 1/e; a pause that ends the line.
_FIRST, _MEMORY_S, _PAUSE_S = 12, 20.0, 2.0
# Part of the last ten or so stamps off the line by more than a third of a period, from which on the rate has changed.
_MOST_OFF = 0.4
# Least step between two stamps given, in periods.
_LEAST_STEP = 0.05


@dataclass
class RunningClock:
    """Straightens one stream's stamps (s), which must increase. The first few come back as they are.

    A change of rate, or a pause, starts anew. In contrast to `regular` nothing is known of later stamps: the first
    seconds are straightened less.
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
        """Count and time from an image `count` periods and `time` seconds later, and forget a little."""
        n, k, kk, y, ky = self._sums
        moved = (n, k - count * n, kk - 2 * count * k + count**2 * n, y - time * n,
                 ky - time * k - count * y + count * time * n)  # fmt: skip
        self._sums = math.exp(-count * self._period / _MEMORY_S) * np.array(moved)
        self._base += time

    def _add(self, k: float, y: float, weight: float) -> None:
        self._sums += weight * np.array([1.0, k, k * k, y, k * y])
