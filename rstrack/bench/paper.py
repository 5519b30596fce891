"""The figures of Kerl, Stückler, Cremers (ICCV 2015), Tables 2 and 3, by the names of our sequences and methods."""

from __future__ import annotations

import statistics
from collections.abc import Sequence

NAMES: dict[str, str] = {
    "baseline": "Baseline",
    "gs-g": "Spline GS G",
    "rs-g": "Spline RS G",
    "gs-pg": "Spline GS P+G",
    "rs-pg": "Spline RS P+G",
}
"""What the paper calls our methods, in the order of its columns."""


Figures = dict[str, float]
"""RMSE of one method on one sequence, named as in records: drift_mm_s and drift_deg_s over a second (RPE), ate_mm."""

# A line is a sequence; its columns are the methods in the order of NAMES, each "m/s deg/s m".
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


def _parse(table: str) -> dict[tuple[str, str], Figures]:
    figures = {}
    for line in table.splitlines():
        sequence, *numbers = line.split()
        values = [float(number) for number in numbers]
        for k, method in enumerate(NAMES):
            m_s, deg_s, m = values[3 * k : 3 * k + 3]
            figures[sequence, method] = {"drift_mm_s": 1e3 * m_s, "drift_deg_s": deg_s, "ate_mm": 1e3 * m}
    return figures


FIGURES: dict[tuple[str, str], Figures] = _parse(_TABLES_2_AND_3)
"""By sequence and method. The hand-held ones are recordings, of other rooms than our renderings of such motions."""


def average(sequences: Sequence[str], method: str) -> Figures:
    """Mean over sequences; empty if there are none, or the paper lacks one of them."""
    found = [FIGURES.get((sequence, method), {}) for sequence in sequences]
    if not found or not all(found):
        return {}
    return {name: statistics.fmean(figures[name] for figures in found) for name in found[0]}
