"""How long a frame may take: what there is no time left for is left out, and its report says so."""

from __future__ import annotations

import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

# Parts of one kind that are remembered, and which part of them the next one takes at most: the longest are of kernels
# that were compiled.
_MEMORY, _MOST = 100, 0.9
# What comes after a frame's last step, but for parts of their own.
_REST = "rest"


class Pace:
    """Tells whether another part of the work on a frame fits into its time, by how long such parts took of late.

    budget_ms: for a frame from `begin` to `end`; None: as long as it takes. clock: in s. A frame that has to be looked
    for, or that begins a track, takes as long as it takes.
    """

    def __init__(self, budget_ms: float | None = None, clock: Callable[[], float] = time.perf_counter) -> None:
        self._budget_s = None if budget_ms is None else 1e-3 * budget_ms
        self._clock = clock
        self._took: defaultdict[str, deque[float]] = defaultdict(lambda: deque(maxlen=_MEMORY))
        self._is_on, self._reserved = False, ""
        self._begin = self._worked = self._elsewhere = 0.0

    def begin(self) -> None:
        """A frame has come."""
        self._is_on = self._budget_s is not None
        self._begin = self._worked = self._clock()
        self._elsewhere = 0.0

    def lift(self) -> None:
        """This frame takes as long as it takes."""
        self._is_on = False

    def end(self) -> None:
        """The frame is done."""
        if self._is_on:
            self._took[_REST].append(self._clock() - self._worked - self._elsewhere)
        self._is_on = False

    def reserve(self, name: str = "") -> None:
        """From the next frame on keep time for a part that has to be done; nothing: for none."""
        self._reserved = name

    def allows(self, *parts: str) -> bool:
        """Whether these parts would be done in time, with what always follows."""
        if not self._is_on or self._budget_s is None:
            return True
        needed = sum(self._longest(part) for part in {*parts, self._reserved, _REST})
        return self._clock() - self._begin + needed <= self._budget_s

    def _longest(self, part: str) -> float:
        took = self._took[part]
        return float(np.quantile(took, _MOST)) if took else 0.0

    def allows_step(self, level: int) -> bool:
        """Whether a step of the optimiser on a level would be; after a coarse one comes another on the finest."""
        return self.allows(*(_step(k) for k in {level, 0}))

    @contextmanager
    def step(self, level: int) -> Iterator[None]:
        """A step of the optimiser on a level is done within."""
        with self.part(_step(level)):
            yield
        if self._is_on:
            self._worked, self._elsewhere = self._clock(), 0.0

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """A part is done within."""
        if not self._is_on:
            yield
            return
        begin = self._clock()
        yield
        took = self._clock() - begin
        self._took[name].append(took)
        self._elsewhere += took


def _step(level: int) -> str:
    return f"step on level {level}"
