"""What ``rsgen fit FILE`` shows: residuals of the spline fit and motion statistics, as text, dict and picture."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rsgen.console.tables import Table, fixed
from rsgen.motion.fit import FitResult, fit_spline
from rsgen.motion.statistics import MotionStatistics, motion_statistics
from rsgen.sequence.trajectory import Trajectory, TrajectoryFormat, read_trajectory


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
