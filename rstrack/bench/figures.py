"""What the figures of records are (title, unit, which way is better, on what scale they are compared), and the paper's.

figure = figure_of("ate_mm")
print(figure.title, figure.unit, figure.better)         # ATE mm less

FIGURES is the one place for that. A name that it does not have is shown, and never judged.
"""

from __future__ import annotations

import math
import statistics
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


PAPER_NAMES: dict[str, str] = {
    "baseline": "Baseline",
    "gs-g": "Spline GS G",
    "rs-g": "Spline RS G",
    "gs-pg": "Spline GS P+G",
    "rs-pg": "Spline RS P+G",
}
"""What the paper calls our methods, in the order of its columns."""


PaperFigures = dict[str, float]
"""RMSE of one method on one sequence, named as in records: drift_mm_s and drift_deg_s over a second (RPE), ate_mm."""

# A line is a sequence; its columns are the methods in the order of PAPER_NAMES, each "m/s deg/s m".
_TABLES_2_AND_3 = """\
robot_t1  .0149  .7761 .0129   .0168  .8098 .0169   .0116  .5389 .0129   .0133  .9368 .0133   .0085  .4857 .0092
robot_t2  .0102  .6679 .0116   .0104  .6649 .0161   .0100  .4962 .0082   .0108  .7730 .0287   .0089  .4961 .0145
robot_r1  .0180 2.1351 .0170   .0177 2.1407 .0148   .0173 1.1222 .0145   .0160 2.1507 .0135   .0156 1.1624 .0137
robot_r2  .0112 2.3313 .0099   .0108 2.2961 .0105   .0110 1.1619 .0108   .0114 2.0803 .0092   .0105 1.1911 .0083
table1    .0827 2.2656 .2521   .0362 1.4801 .0842   .0158  .9305 .0379   .0371 1.4749 .0909   .0160  .9297 .0110
table2    .1160 4.2465 .4675   .0117 1.6441 .0127   .0132  .5973 .0111   .0103 1.5749 .0144   .0126  .5464 .0112
lr_kt0    .0162 2.9869 .1129   .0804  .2673 .3980   .0268  .1059 .1088   .0075  .2394 .0259   .0056  .1170 .0186
lr_kt1    .1569 30.7227 .2651  .0047  .1700 .0111   .0029  .0625 .0108   .0064  .1709 .0092   .0024  .0590 .0054
lr_kt2    .0054  .2744 .0209   .0068  .2973 .0173   .0044  .0723 .0109   .0068  .2128 .0082   .0031  .0655 .0079
lr_kt3    .7420 35.6279 1.2669 .0075  .9161 .0607   .0068  .9427 .0676   .0164  .1900 .0498   .0100  .2482 .0210
"""


def _paper_figures(table: str) -> dict[tuple[str, str], PaperFigures]:
    figures = {}
    for line in table.splitlines():
        sequence, *numbers = line.split()
        values = [float(number) for number in numbers]
        for k, method in enumerate(PAPER_NAMES):
            m_s, deg_s, m = values[3 * k : 3 * k + 3]
            figures[sequence, method] = {"drift_mm_s": 1e3 * m_s, "drift_deg_s": deg_s, "ate_mm": 1e3 * m}
    return figures


PAPER_FIGURES: dict[tuple[str, str], PaperFigures] = _paper_figures(_TABLES_2_AND_3)
"""Of Kerl, Stückler, Cremers (ICCV 2015), Tables 2 and 3, by the names of our sequences and methods.

The hand-held ones are recordings, of other rooms than our renderings of such motions.
"""


def paper_average(sequences: Sequence[str], method: str) -> PaperFigures:
    """Mean over sequences; empty if there are none, or the paper lacks one of them."""
    found = [PAPER_FIGURES.get((sequence, method), {}) for sequence in sequences]
    if not found or not all(found):
        return {}
    return {name: statistics.fmean(figures[name] for figures in found) for name in found[0]}
