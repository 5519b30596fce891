"""How far and how fast cameras move: the columns of the paper's Table 1, accelerations, and a table of both."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.console.tables import Table
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.sequence.trajectory import Trajectory

_SAMPLES_PER_KNOT = 20
_CHUNK = 200_000


@dataclass(frozen=True)
class MotionStatistics:
    """Means are over time, not over samples; accelerations are of the body's origin in the world, gravity excluded."""

    duration_s: float
    length_m: float
    mean_speed_m_s: float
    max_speed_m_s: float
    mean_rotation_deg_s: float
    max_rotation_deg_s: float
    mean_acceleration_m_s2: float
    max_acceleration_m_s2: float


def motion_statistics(
    motion: Spline | Trajectory, begin: float | None = None, end: float | None = None
) -> MotionStatistics:
    """Statistics of a motion between two times (seconds; default all of it).

    A Spline is evaluated analytically at 20 midpoints a knot, so that the length is the arc's. A Trajectory is taken
    from pose to pose: chords, noise included, so that it comes out longer and jerkier than its spline.
    Raises UserError if nothing lies between begin and end.
    """
    if isinstance(motion, Spline):
        return _of_spline(motion, motion.t_begin if begin is None else begin, motion.t_end if end is None else end)
    return _of_poses(motion, -math.inf if begin is None else begin, math.inf if end is None else end)


def _of_spline(spline: Spline, begin: float, end: float) -> MotionStatistics:
    if not end > begin:
        raise UserError(f"no motion between {begin:g} and {end:g} s: the end must come after the begin")
    count = max(1, math.ceil((end - begin) / spline.dt * _SAMPLES_PER_KNOT))
    times = begin + (np.arange(count) + 0.5) * ((end - begin) / count)
    parts = np.split(times, range(_CHUNK, count, _CHUNK))  # long recordings would need gigabytes at once
    speed, rotation, acceleration = np.concatenate([_norms(spline, part) for part in parts], axis=1)
    steps = np.full(count, (end - begin) / count)
    return _summary(steps, speed, rotation, steps, acceleration)


def _norms(spline: Spline, times: FloatArray) -> FloatArray:
    """(3, n): speed m/s, rotation rad/s, acceleration m/s²."""
    velocity = spline.velocity(times)
    return np.stack(
        [
            np.linalg.norm(velocity[:, :3], axis=1),
            np.linalg.norm(velocity[:, 3:], axis=1),
            np.linalg.norm(spline.world_acceleration(times), axis=1),
        ]
    )


def _of_poses(trajectory: Trajectory, begin: float, end: float) -> MotionStatistics:
    inside = (trajectory.stamps >= begin) & (trajectory.stamps <= end)
    if inside.sum() < 3:
        raise UserError(f"fewer than three poses between {begin:g} and {end:g} s: widen the interval")
    stamps, poses = trajectory.stamps[inside], trajectory.T_world_cam[inside]
    steps = np.diff(stamps)
    velocity = np.diff(poses[:, :3, 3], axis=0) / steps[:, None]
    angle = np.linalg.norm(se3.log(se3.inverse(poses[:-1]) @ poses[1:])[:, 3:], axis=1)
    spans = 0.5 * (steps[1:] + steps[:-1])
    acceleration = np.linalg.norm(np.diff(velocity, axis=0), axis=1) / spans
    return _summary(steps, np.linalg.norm(velocity, axis=1), angle / steps, spans, acceleration)


def _summary(
    steps: FloatArray, speed: FloatArray, rotation: FloatArray, spans: FloatArray, acceleration: FloatArray
) -> MotionStatistics:
    duration = float(steps.sum())
    length = float(speed @ steps)
    return MotionStatistics(
        duration_s=duration,
        length_m=length,
        mean_speed_m_s=length / duration,
        max_speed_m_s=float(speed.max()),
        mean_rotation_deg_s=math.degrees(float(rotation @ steps) / duration),
        max_rotation_deg_s=math.degrees(float(rotation.max())),
        mean_acceleration_m_s2=float(acceleration @ spans / spans.sum()),
        max_acceleration_m_s2=float(acceleration.max()),
    )


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
