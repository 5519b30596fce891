"""Which stamps a recording's images are tracked at: as listed, or on the clock behind them.

    stamps: auto       straightened where they are arrival times of a steady clock, otherwise as listed
    stamps: raw        as listed
    stamps: regular    on the clock, whatever the jitter

Arrival times say little of how long each stream took to arrive, so colour may be stamped early or late against depth
by tens of milliseconds: `color.offset_s` is added to its stamps. Where it is auto, it is looked for if stamps are
arrival times (`rstrack.tracking.first_look.color_clock`), and 0 otherwise.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rstrack.data.clock import StampClock, drift_ppm, straightened

StampsMode = Literal["auto", "raw", "regular"]


@dataclass(frozen=True)
class StreamTiming:
    """One stream's stamps (n,) in seconds, as listed and as used, and its clock. is_even: used are the clock's."""

    clock: StampClock
    listed: FloatArray
    used: FloatArray
    is_even: bool

    def text(self) -> str:
        """E.g. "33.369 ms period, jitter 1.9 ms RMS straightened, 2 frames dropped"."""
        clock = self.clock
        if clock.verdict == "too short":
            return "too few stamps to find the clock, used as they are"
        if clock.verdict == "irregular":
            used = "straightened all the same" if self.is_even else "used as they are"
            return f"stamps of no steady clock (about {1e3 * clock.period_s:.1f} ms apart), {used}"
        done = "straightened" if self.is_even else "left as it is"
        jitter = "regular" if clock.verdict == "regular" else f"jitter {1e3 * clock.jitter_rms_s:.2g} ms RMS {done}"
        parts = [f"{1e3 * clock.period_s:.3f} ms period", jitter]
        for number, what in ((clock.dropped, "dropped"), (clock.repeated, "repeated")):
            if number:
                parts.append(f"{number} frame{'' if number == 1 else 's'} {what}")
        return ", ".join(parts)


@dataclass(frozen=True)
class Timing:
    """Clocks of both streams. color_offset_s: added to colour's stamps; None: not known. notes: what was assumed."""

    depth: StreamTiming
    color: StreamTiming
    color_offset_s: float | None
    notes: tuple[str, ...] = ()

    @property
    def wants_color_offset(self) -> bool:
        """Whether colour's stamps may be off against depth's by more than they say."""
        return self.color_offset_s is None and self.is_jittered

    @property
    def is_jittered(self) -> bool:
        """Whether stamps are arrival times."""
        return "jittered" in (self.depth.clock.verdict, self.color.clock.verdict)

    @property
    def mode(self) -> StampsMode:
        """What makes these stamps of those listed: auto if that does."""
        streams = self.depth, self.color
        if all(stream.is_even == (stream.clock.verdict == "jittered") for stream in streams):
            return "auto"
        return "regular" if self.depth.is_even else "raw"

    def lines(self) -> list[str]:
        """For the screen: one line a stream, one for the offset between them, and what was assumed."""
        color = f"colour: {self.color.text()}"
        drift = drift_ppm(self.color.clock, self.depth.clock)
        if drift is not None and abs(drift) >= 1.0:
            color += f"; colour clock runs {abs(drift):.0f} ppm {'fast' if drift > 0.0 else 'slow'} against depth's"
        lines = [f"depth: {self.depth.text()}", color]
        if self.color_offset_s:
            lines.append(f"colour: {1e3 * self.color_offset_s:+.1f} ms added to its stamps")
        return [*lines, *self.notes]

    def as_dict(self) -> dict[str, Any]:
        """For run.json."""
        streams = {
            name: dataclasses.asdict(stream.clock) | {"straightened": stream.is_even}
            for name, stream in (("depth", self.depth), ("color", self.color))
        }
        drift = drift_ppm(self.color.clock, self.depth.clock)
        return streams | {"color_drift_ppm": drift, "color_offset_s": self.color_offset_s, "notes": list(self.notes)}


def stream_timing(name: str, listed: FloatArray, mode: StampsMode, offset_s: float) -> StreamTiming:
    """The stamps (n,) to use for those listed, `offset_s` added. Raises UserError: to be regular, but cannot."""
    clock, even = straightened(listed)
    if mode == "regular" and clock.verdict == "irregular":
        raise UserError(
            f"{name} stamps follow no steady clock (period {1e3 * clock.period_s:.1f} ms, off it by "
            f"{1e3 * clock.jitter_rms_s:.1f} ms RMS): set 'stamps: auto' or 'stamps: raw' in the camera file"
        )
    is_even = clock.verdict == "jittered" if mode == "auto" else mode == "regular"
    used = even if is_even else listed
    return StreamTiming(clock, listed, used + offset_s if offset_s else used, is_even)
