"""Length and mean speeds of motions as a text table, beside the figures of the paper's recorded sequences."""

from __future__ import annotations

from collections.abc import Sequence

from rsgen.console.tables import Table
from rsgen.motion.statistics import MotionStatistics

TABLE_1: dict[str, tuple[float, float, float]] = {
    "robot_t1": (7.678, 0.356, 15.807),
    "robot_t2": (7.671, 0.359, 13.782),
    "robot_r1": (2.592, 0.123, 62.172),
    "robot_r2": (3.203, 0.153, 66.847),
    "table1": (11.494, 0.423, 23.223),
    "table2": (5.273, 0.153, 38.582),
}
"""Kerl, Stückler, Cremers, ICCV 2015, Table 1: length m, mean translational m/s, mean rotational deg/s."""

_HEAD = ("sequence", "time s", "length m", "mean m/s", "mean deg/s", "max m/s", "max deg/s", "mean m/s²", "max m/s²")
_HEAD_PAPER = ("Table 1: m", "m/s", "deg/s")


def stats_table(motions: Sequence[tuple[str, MotionStatistics]]) -> str:
    """Lines of aligned columns for named motions; the paper's six get its figures and our deviation in %."""
    head = _HEAD + (_HEAD_PAPER if any(name in TABLE_1 for name, _ in motions) else ())
    return Table(head, tuple(_row(name, stats)[: len(head)] for name, stats in motions)).text()


def _row(name: str, stats: MotionStatistics) -> tuple[str, ...]:
    ours = stats.length_m, stats.mean_speed_m_s, stats.mean_rotation_deg_s
    paper = TABLE_1.get(name)
    beside = (
        ("", "", "")
        if paper is None
        else tuple(
            f"{theirs:.3f} ({100.0 * (mine / theirs - 1.0):+.2f} %)" for mine, theirs in zip(ours, paper, strict=True)
        )
    )
    return (
        name, f"{stats.duration_s:.2f}", *(f"{value:.3f}" for value in ours), f"{stats.max_speed_m_s:.3f}",
        f"{stats.max_rotation_deg_s:.1f}", f"{stats.mean_acceleration_m_s2:.2f}",
        f"{stats.max_acceleration_m_s2:.2f}", *beside,
    )  # fmt: skip
