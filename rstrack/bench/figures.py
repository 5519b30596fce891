"""What the figures of records are: title, unit, which way is better, and on what scale they are compared.

figure = figure_of("ate_mm")
print(figure.title, figure.unit, figure.better)         # ATE mm less

This table is the one place for that. A name that it does not have is shown, and never judged.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache
from typing import Literal

Better = Literal["less", "more", "nominal", "unjudged"]
Scale = Literal["log", "linear", "count"]
_IN_NAMES = {"%": "pct", "dB": "db", "MB": "mb", "Msamples/s": "msamples_s"}


@dataclass(frozen=True)
class FigureInfo:
    """pattern: of names, * allowed. better: which way, or near `nominal`. scale: of its scatter and its differences.

    outright: the first one is worse, whatever chance does, where there was none. is_time: of the machine as well.
    """

    pattern: str
    title: str
    unit: str
    better: Better
    scale: Scale
    nominal: float = 0.0
    outright: bool = False
    is_time: bool = False

    @property
    def is_judged(self) -> bool:
        """Whether it can get worse."""
        return self.better != "unjudged"

    def on_scale(self, value: float) -> float | None:
        """The value as it is compared; None: it has no logarithm."""
        if self.scale != "log":
            return value
        return math.log(value) if value > 0.0 else None

    def badness(self, values: Sequence[float]) -> float:
        """How bad the mean of some values, of this scale, is: more is worse."""
        mean = math.fsum(values) / len(values)
        if self.better == "nominal":
            return abs(mean - (math.log(self.nominal) if self.scale == "log" else self.nominal))
        return -mean if self.better == "more" else mean


FIGURES: tuple[FigureInfo, ...] = (
    # The measure `track`.
    FigureInfo("ate_mm", "ATE", "mm", "less", "log"),
    FigureInfo("ate_max_mm", "largest error", "mm", "less", "log"),
    FigureInfo("drift_mm_s", "drift", "mm/s", "less", "log"),
    FigureInfo("drift_deg_s", "drift", "deg/s", "less", "log"),
    FigureInfo("line_mm", "error of a line", "mm", "less", "log"),
    FigureInfo("line_deg", "error of a line", "deg", "less", "log"),
    FigureInfo("nees", "NEES/6", "", "nominal", "log", nominal=1.0),
    FigureInfo("nees_01", "NEES/6 over 0.1 s", "", "nominal", "log", nominal=1.0),
    FigureInfo("nees_5", "NEES/6 over 5 s", "", "nominal", "log", nominal=1.0),
    FigureInfo("nees_first", "NEES/6 from the first pose", "", "nominal", "log", nominal=1.0),
    FigureInfo("tracked_pct", "tracked", "%", "more", "linear"),
    FigureInfo("coverage_50", "within 50 %", "", "nominal", "linear", nominal=0.5),
    FigureInfo("coverage_90", "within 90 %", "", "nominal", "linear", nominal=0.9),
    FigureInfo("coverage_99", "within 99 %", "", "nominal", "linear", nominal=0.99),
    FigureInfo("silent", "silently wrong", "frames", "less", "count", outright=True),
    FigureInfo("lost", "lost", "frames", "less", "count"),
    FigureInfo("frames", "frames", "", "unjudged", "count"),
    FigureInfo("keyframes", "keyframes", "", "unjudged", "count"),
    FigureInfo("truth_offset_ms", "truth's clock", "ms", "unjudged", "linear"),
    # `faults`, one run a fault.
    FigureInfo("silent_fault", "silently wrong", "faults", "less", "count", outright=True),
    FigureInfo("found_in_5", "found in 5 frames", "faults", "more", "count"),
    FigureInfo("place_known", "place known", "faults", "unjudged", "count"),
    FigureInfo("worst_mm", "worst", "mm", "less", "log"),
    FigureInfo("worst_deg", "worst", "deg", "less", "log"),
    FigureInfo("kind", "kind", "", "unjudged", "count"),
    # `loops`: a false one ruins a map.
    FigureInfo("false*", "false", "loops", "less", "count", outright=True),
    FigureInfo("accepted", "look-alikes taken for one", "pairs", "less", "count", outright=True),
    FigureInfo("median_mrad", "median", "mrad", "less", "log"),
    # `lens`: how wrong the stated lens was, and how wrong the found one is.
    FigureInfo("before_px", "wrong by", "px", "unjudged", "log"),
    FigureInfo("after_px*", "left", "px", "less", "log"),
    # Times of the machine, and ratios of times of one run, of which a machine's speed falls out. What else runs on it
    # for some minutes does not: repetitions in a row share that, and do not show how means and tails scatter.
    FigureInfo("ratio", "ratio", "", "less", "log"),
    FigureInfo("ratio_*", "", "", "unjudged", "log"),
    FigureInfo("*_ratio", "", "", "less", "log"),
    FigureInfo("*_msamples_s", "", "Msamples/s", "unjudged", "log"),
    FigureInfo("median_ms", "median", "ms", "unjudged", "log", is_time=True),
    FigureInfo("mean_ms", "mean", "ms", "unjudged", "log", is_time=True),
    FigureInfo("p95_ms", "95 %", "ms", "unjudged", "log", is_time=True),
    FigureInfo("p99_ms", "99 %", "ms", "unjudged", "log", is_time=True),
    FigureInfo("*_ms", "", "ms", "unjudged", "log", is_time=True),
    FigureInfo("*_deg_s", "", "deg/s", "less", "log"),
    FigureInfo("*_mm_s", "", "mm/s", "less", "log"),
    FigureInfo("*_s", "", "s", "unjudged", "log", is_time=True),
    # Memory: what a process ran before moves its peak; what a long run adds is judged.
    FigureInfo("peak_mb", "peak memory", "MB", "unjudged", "log"),
    FigureInfo("growth_mb", "growth", "MB", "less", "linear"),
    FigureInfo("*_mb", "memory", "MB", "unjudged", "log"),
    # Light: decibels are logarithms already, and a bias has a sign.
    FigureInfo("psnr_db", "PSNR", "dB", "more", "linear"),
    FigureInfo("psnr_least_db", "least PSNR", "dB", "more", "linear"),
    FigureInfo("surely_least_db", "surely, least", "dB", "more", "linear"),
    FigureInfo("*_db", "", "dB", "more", "linear"),
    FigureInfo("bias_pct", "bias", "%", "nominal", "linear"),
    # Shares of what was tried.
    FigureInfo("converged_pct*", "converged", "%", "more", "linear"),
    FigureInfo("found_pct*", "found", "%", "more", "linear"),
    FigureInfo("lost_pct*", "lost", "%", "less", "linear"),
    FigureInfo("wrong_pct*", "wrong", "%", "less", "linear"),
    FigureInfo("within_2_sigma_pct*", "within 2 σ", "%", "nominal", "linear", nominal=95.45),
    FigureInfo("rms_over_sigma*", "RMS over σ", "", "nominal", "log", nominal=1.0),
    # Numbers of trials.
    FigureInfo("wrong*", "wrong", "", "less", "count", outright=True),
    FigureInfo("failed", "failed", "starts", "less", "count"),
    FigureInfo("broken", "broken down", "starts", "less", "count"),
    FigureInfo("over_*_mm", "", "starts", "less", "count"),
    FigureInfo("not_converged_*", "", "", "less", "count"),
    FigureInfo("refused_*", "", "", "unjudged", "count"),
    FigureInfo("lost_last", "lost of the last", "frames", "less", "count"),
    # Of the product itself.
    FigureInfo("lines*", "lines", "", "unjudged", "count"),
    FigureInfo("modules*", "modules", "", "unjudged", "count"),
    FigureInfo("constants*", "constants", "", "unjudged", "count"),
    # All other errors, at multiples of a distance too (median_error_mm_2x).
    FigureInfo("*_mm", "", "mm", "less", "log"),
    FigureInfo("*_deg", "", "deg", "less", "log"),
    FigureInfo("*_mm_*x", "", "mm", "less", "log"),
    FigureInfo("*_deg_*x", "", "deg", "less", "log"),
    FigureInfo("*_ms_*x", "", "ms", "less", "log"),
)


@cache
def figure_of(name: str) -> FigureInfo:
    """The entry that a name matches first; one without unit that is not judged, where there is none."""
    return next(
        (figure for figure in FIGURES if fnmatchcase(name, figure.pattern)),
        FigureInfo(name, "", "", "unjudged", "linear"),
    )


def heading(name: str) -> str:
    """A table's heading: title and unit."""
    figure = figure_of(name)
    words = figure.title
    if figure.pattern != name or not words:
        # The unit in the name, wherever it stands.
        in_name = _IN_NAMES.get(figure.unit, figure.unit.replace("/", "_"))
        words = f"_{name}_".replace(f"_{in_name}_", "_", 1) if in_name else name
        words = words.strip("_").replace("_", " ")
    return f"{words}, {figure.unit}" if figure.unit else words
