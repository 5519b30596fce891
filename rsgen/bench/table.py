"""The times of a generator benchmark as a table, as ratios and as plain types; see `rsgen.bench.modes`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.console.tables import Table, fixed

BLUR_S = 0.020
READOUT_S = 0.028
AVERAGED = 64  # sharp renders in the place of a blurred one

# What is compared: mode, the mode it is divided by, and how the quotient reads.
_RATIOS = (
    ("rs-blur", "still", "rolling shutter + blur against a still, both baked"),
    ("path", "rs-blur", "path tracing against baked light"),
    ("rows", "rs-blur", "one render for each row against one for all"),
    ("averaged", "rs-blur", f"{AVERAGED} sharp renders averaged (all rows at once) against blur and rolling shutter"),
    ("blender", "rs-blur", "Blender Cycles against baked light, rolling shutter + blur"),
    ("blender", "path", "Blender Cycles against path tracing, rolling shutter + blur"),
    ("blender", "blender-still", "Blender Cycles: rolling shutter + blur against a still"),
)


@dataclass(frozen=True)
class ModeTimes:
    """Seconds a frame of one mode: a row for each frame, a column for each round."""

    name: str
    title: str
    spp: int
    measured: str
    seconds: FloatArray

    @property
    def median(self) -> float:
        """Seconds a frame."""
        return float(np.median(self.seconds))


@dataclass(frozen=True)
class Ratio:
    """How many times as long `mode` takes as `against`: median and quartiles over pairs of the same frame."""

    mode: str
    against: str
    text: str
    median: float
    quartiles: tuple[float, float]
    pairs: int


@dataclass(frozen=True)
class BenchTimes:
    """Times of all modes of one run; `failed`: what became of those that have none."""

    width: int
    height: int
    machine: dict[str, Any]
    modes: tuple[ModeTimes, ...]
    failed: dict[str, str]

    def ratios(self) -> list[Ratio]:
        """The quotients of those modes that were timed."""
        times = {m.name: m.seconds for m in self.modes}
        return [_ratio(a, b, text, times[a], times[b]) for a, b, text in _RATIOS if a in times and b in times]

    def as_dict(self) -> dict[str, Any]:
        """Plain types, for JSON; times in seconds a frame."""
        return {
            "machine": self.machine,
            "width": self.width,
            "height": self.height,
            "readout_s": READOUT_S,
            "exposure_s": BLUR_S,
            "modes": [
                {
                    "mode": m.name, "title": m.title, "seconds": m.median, "frames_per_s": 1 / m.median,
                    "samples_per_s": self._samples(m) / m.median, "spp": m.spp, "measured": m.measured,
                    "runs": m.seconds.size, "quartiles": np.quantile(m.seconds, [0.25, 0.75]).tolist(),
                }
                for m in self.modes
            ],
            "ratios": [
                {
                    "mode": r.mode, "against": r.against, "ratio": r.median, "quartiles": list(r.quartiles),
                    "pairs": r.pairs,
                }
                for r in self.ratios()
            ],
            "failed": self.failed,
        }  # fmt: skip

    def text(self) -> str:
        """A table and the ratios below it."""
        rows = tuple(
            (m.name, m.title, fixed(m.median, 3), f"{1 / m.median:.3g}", f"{self._samples(m) / m.median / 1e6:.3g}",
             str(m.spp), m.measured)
            for m in self.modes
        )  # fmt: skip
        head = ("mode", "what it is", "s a frame", "frames/s", "Msamples/s", "spp", "measured")
        table = Table(head, rows, words=(0, 1, 6)).text()
        lines = [f"{r.text}: {r.median:.2f}x the time, {_spread(r)}" for r in self.ratios()]
        lines += self._computed()
        lines += [f"{name}: {why}" for name, why in self.failed.items()]
        machine = ", ".join(f"{key} {value}" for key, value in self.machine.items())
        size = f"{self.width}x{self.height}, readout {1000 * READOUT_S:g} ms, exposure {1000 * BLUR_S:g} ms"
        return "\n".join([table, "", *lines, f"{size}; {machine}"])

    def _samples(self, mode: ModeTimes) -> int:
        return self.width * self.height * mode.spp

    def _computed(self) -> list[str]:
        """What whole sharp renders would take, which nobody waits for: multiples of the still's time."""
        times = {m.name: m.median for m in self.modes}
        if not {"still", "rs-blur"} <= times.keys():
            return []
        ways = (("a whole still for each row", self.height), (f"{AVERAGED} stills of full quality", AVERAGED))
        return [
            f"computed, not measured: {what}: {count * times['still']:.1f} s a frame, "
            f"{count * times['still'] / times['rs-blur']:.0f}x rolling shutter + blur"
            for what, count in ways
        ]


def _ratio(mode: str, against: str, text: str, a: FloatArray, b: FloatArray) -> Ratio:
    """Round by round where both have as many, else the frames' medians."""
    pairs = (a / b).ravel() if a.shape == b.shape else np.median(a, axis=1) / np.median(b, axis=1)
    low, middle, high = np.quantile(pairs, [0.25, 0.5, 0.75])
    return Ratio(mode, against, text, float(middle), (float(low), float(high)), len(pairs))


def _spread(ratio: Ratio) -> str:
    if ratio.pairs < 4:
        return f"{ratio.pairs} frame{'s' if ratio.pairs > 1 else ''}"
    return f"half of {ratio.pairs} pairs within {ratio.quartiles[0]:.2f} to {ratio.quartiles[1]:.2f}"
