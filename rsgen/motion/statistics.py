"""How far and how fast cameras move: columns of the paper's Table 1, accelerations; what `rsgen motion fit` says."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rsgen.array_types import FloatArray
from rsgen.console.tables import Table, fixed
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.motion.fit import FitResult, fit_spline
from rsgen.sequence.trajectory import Trajectory, TrajectoryFormat, read_trajectory

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
    vectors = velocity[:, :3], velocity[:, 3:], spline.world_acceleration(times)
    return np.stack([np.linalg.norm(v, axis=1) for v in vectors])


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


@dataclass(frozen=True)
class FitSummary:
    """A trajectory, its spline and the motion between its first and last stamp."""

    name: str
    trajectory: Trajectory
    fit: FitResult
    statistics: MotionStatistics

    def as_dict(self) -> dict[str, Any]:
        """It as plain numbers for JSON; units are in the names."""
        fit, stamps = self.fit, self.trajectory.stamps
        trans, rot = fit.residual_trans_m, fit.residual_rot_rad
        worst_trans, worst_rot = int(trans.argmax()), int(rot.argmax())
        return {
            "file": self.name,
            "poses": len(stamps),
            "first_stamp_s": float(stamps[0]),
            "last_stamp_s": float(stamps[-1]),
            "knot_spacing_s": fit.spline.dt,
            "control_points": len(fit.spline.control_points),
            "iterations": fit.iterations,
            "downweighted_poses": int((fit.weights < 1.0).sum()),
            "residual": {
                "rms_mm": fit.rms_trans_m * 1e3,
                "median_mm": float(np.median(trans)) * 1e3,
                "max_mm": float(trans[worst_trans]) * 1e3,
                "max_mm_pose": worst_trans,
                "max_mm_stamp_s": float(stamps[worst_trans]),
                "rms_deg": math.degrees(fit.rms_rot_rad),
                "median_deg": math.degrees(float(np.median(rot))),
                "max_deg": math.degrees(float(rot[worst_rot])),
                "max_deg_pose": worst_rot,
                "max_deg_stamp_s": float(stamps[worst_rot]),
            },
            "motion": dataclasses.asdict(self.statistics),
        }

    def text(self) -> str:
        """It as plain text with tables."""
        data = self.as_dict()
        residual, motion = data["residual"], self.statistics
        rate = (data["poses"] - 1) / (data["last_stamp_s"] - data["first_stamp_s"])
        residuals = tuple(
            (
                label,
                *(fixed(residual[f"{kind}_{unit}"], digits) for kind in ("rms", "median", "max")),
                str(residual[f"max_{unit}_pose"]),
                fixed(residual[f"max_{unit}_stamp_s"], 3),
            )
            for label, unit, digits in (("position, mm", "mm", 3), ("rotation, degrees", "deg", 4))
        )
        speeds = (
            ("translation, m/s", fixed(motion.mean_speed_m_s, 3), fixed(motion.max_speed_m_s, 3)),
            ("rotation, degrees/s", fixed(motion.mean_rotation_deg_s, 2), fixed(motion.max_rotation_deg_s, 2)),
            ("acceleration, m/s²", fixed(motion.mean_acceleration_m_s2, 2), fixed(motion.max_acceleration_m_s2, 2)),
        )
        lines = (
            f"{data['file']}: {data['poses']} poses, {motion.duration_s:.2f} s, {rate:.1f} a second",
            f"cubic B-spline on SE(3): knots {data['knot_spacing_s']:g} s apart, {data['control_points']} control "
            f"points, {data['iterations']} iterations, {data['downweighted_poses']} poses downweighted",
            "",
            Table(("residuals", "RMS", "median", "max", "worst pose", "at s"), residuals).text(),
            "",
            Table(("motion of the spline", "mean", "max"), speeds).text(),
            "",
            f"length {motion.length_m:.3f} m",
        )
        return "\n".join(lines)


def summarise_fit(
    path: str | Path,
    dt: float = 0.05,
    smoothing: float = 0.0,
    format: TrajectoryFormat = "auto",
    icl_start: npt.ArrayLike | None = None,
) -> FitSummary:
    """Read and fit a trajectory file; parameters and errors as in `read_trajectory` and `fit_spline`."""
    trajectory = read_trajectory(path, format=format, icl_start=icl_start)
    fit = fit_spline(trajectory, dt=dt, smoothing=smoothing)
    statistics = motion_statistics(fit.spline, float(trajectory.stamps[0]), float(trajectory.stamps[-1]))
    return FitSummary(Path(path).name, trajectory, fit, statistics)


def plot_fit(fitted: FitSummary, out: str | Path) -> None:
    """Draw residuals, positions, speeds and acceleration over time into a png, pdf or svg file.

    Raises UserError if the file's type is another or it cannot be written.
    """
    from matplotlib.figure import Figure  # half a second to import, and only this function needs it

    from rsgen.figures import save

    figure = Figure(figsize=(12.0, 8.5), layout="constrained")
    axes = figure.subplots(3, 2, sharex=True)
    _draw_residuals(axes[0], fitted)
    _draw_motion(axes[1:], fitted)
    for axis in axes.flat:
        axis.grid(True, color="0.9", linewidth=0.6)
        axis.spines[["top", "right"]].set_visible(False)
        axis.margins(x=0.0)
    for axis in axes[-1]:
        axis.set_xlabel("time, s")
    data = fitted.as_dict()
    figure.suptitle(
        f"{data['file']}: spline with knots {data['knot_spacing_s'] * 1e3:g} ms apart, "
        f"RMS {data['residual']['rms_mm']:.2f} mm and {data['residual']['rms_deg']:.3f}°",
        fontsize=13,
    )
    save(figure, Path(out))


# Above the axes, where no curve can run into it.
_LEGEND: Any = dict(
    loc="lower right", bbox_to_anchor=(1.0, 0.98), frameon=False, ncols=3, fontsize=9, borderaxespad=0.2
)
_BLUE, _ORANGE, _GREEN, _RED, _GREY = "#2a6fbb", "#d9822b", "#3a9d5d", "#c0392b", "0.45"


def _draw_residuals(axes: Any, fitted: FitSummary) -> None:
    stamps, fit = fitted.trajectory.stamps, fitted.fit
    limited = fit.weights < 1.0
    for axis, values, label in (
        (axes[0], fit.residual_trans_m * 1e3, "position residual, mm"),
        (axes[1], np.degrees(fit.residual_rot_rad), "rotation residual, degrees"),
    ):
        rms = float(np.sqrt(np.mean(values**2)))
        axis.vlines(stamps, 0.0, values, color=_BLUE, linewidth=0.7)
        axis.plot(stamps[limited], values[limited], "o", color=_RED, markersize=3.5, label="downweighted")
        axis.axhline(rms, color=_GREY, linewidth=1.0, linestyle="--", label=f"RMS {rms:.3g}")
        axis.set_title(label, loc="left", fontsize=10)
        axis.set_ylim(bottom=0.0)
        handles, labels = axis.get_legend_handles_labels()
        start = 0 if limited.any() else 1
        axis.legend(handles[start:], labels[start:], **_LEGEND)


def _draw_motion(axes: Any, fitted: FitSummary) -> None:
    stamps, spline = fitted.trajectory.stamps, fitted.fit.spline
    # Eight samples a knot show every wiggle; a picture has no use for more than 200,000.
    count = int(min(math.ceil((stamps[-1] - stamps[0]) / spline.dt * 8) + 1, 200_000))
    times = np.linspace(stamps[0], stamps[-1], count)
    positions, velocity = spline.pose(times)[:, :3, 3], spline.velocity(times)
    for k, color in enumerate((_RED, _GREEN, _BLUE)):
        axes[0, 0].plot(stamps, fitted.trajectory.positions[:, k], ".", color=color, markersize=2.5, alpha=0.35)
        axes[0, 0].plot(times, positions[:, k], color=color, linewidth=1.1, label="xyz"[k])
    axes[0, 0].set_title("position in the world, m", loc="left", fontsize=10)
    axes[0, 0].legend(**_LEGEND)
    for axis, values, color, label in (
        (axes[0, 1], np.linalg.norm(velocity[:, :3], axis=1), _BLUE, "speed, m/s"),
        (axes[1, 0], np.degrees(np.linalg.norm(velocity[:, 3:], axis=1)), _ORANGE, "rotation, degrees/s"),
        (axes[1, 1], np.linalg.norm(spline.world_acceleration(times), axis=1), _GREEN, "acceleration, m/s²"),
    ):
        axis.plot(times, values, color=color, linewidth=0.8)
        axis.axhline(values.mean(), color=_GREY, linewidth=1.0, linestyle="--", label=f"mean {values.mean():.3g}")
        axis.set_title(label, loc="left", fontsize=10)
        axis.set_ylim(bottom=0.0)
        axis.legend(**_LEGEND)
