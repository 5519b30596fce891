"""Tell a lost track from a good one, by pixels that still fit and by how well."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from statistics import median

from rstrack.alignment.observation import Observation
from rstrack.alignment.optimizer import Solved

# A term has to see this share of the pixels that it saw at first, and so many at least, to count.
_LEAST_SHARE = 0.08
_LEAST_PIXELS = 200
# Scales that no aligned images have, and growth over the last frames' median that none shows (m; intensity).
_WORST_DEPTH, _WORST_INTENSITY = 0.03, 0.15
_GROWTH, _HARMLESS_DEPTH, _HARMLESS_INTENSITY = 6.0, 2e-3, 0.03
# A camera at rest repeats its rounding: what counts as usual then says little. Multiple of the rounding that is fine.
_ROUNDING = 2.5
# Lines that still move so far (pixels) have not been found.
_WORST_SHIFT_PX = 2.0
_MEMORY = 30


class FitHistory:
    """Remembers the scales of the last good frames."""

    def __init__(self) -> None:
        self._depth: deque[float] = deque(maxlen=_MEMORY)
        self._intensity: deque[float] = deque(maxlen=_MEMORY)

    def fault(self, fresh: Sequence[Observation], solved: Solved, expected: int) -> str:
        """Why a frame has not been found, '' if it has. expected: pixels that a whole image puts on the reference."""
        seen = [o for o in fresh if o.is_linearised and o.lin.count >= max(_LEAST_PIXELS, _LEAST_SHARE * expected)]
        if not seen:
            return "hardly a pixel falls on the keyframe"
        if solved.last_shift > _WORST_SHIFT_PX:
            return "the alignment does not settle"
        for o in seen:
            history = self._depth if o.is_depth else self._intensity
            worst = _WORST_DEPTH if o.is_depth else _WORST_INTENSITY
            harmless = _HARMLESS_DEPTH if o.is_depth else _HARMLESS_INTENSITY
            harmless = max(harmless, _ROUNDING * o.lin.floor)
            usual = median(history) if history else worst
            if o.lin.next_sigma > min(worst, max(harmless, _GROWTH * usual)):
                return f"the {'depth' if o.is_depth else 'colour'} image does not fit"
        for o in seen:
            (self._depth if o.is_depth else self._intensity).append(o.lin.next_sigma)
        return ""
