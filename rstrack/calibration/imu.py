"""Calibrate a recording's IMU against its depth camera: from a track of the recording, and the samples.

found = calibrate_imu(open_dataset(Path("recording")), track_of_run(Path("runs/recording")))
Path("imu.yaml").write_text(found.imu_file())
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.array_types import BoolArray, FloatArray
from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError
from rsgen.geometry import so3
from rsgen.geometry.so3 import hat
from rsgen.geometry.spline import Spline
from rstrack.calibration.imu_model import COUNT, DRIFT, LEVER, OFFSET, ROTATION, SCALE, CorrectedTrack, ImuUnknowns
from rstrack.calibration.imu_solve import ImuData, ImuSolution, solve
from rstrack.calibration.start import TrackedSpline, tracked
from rstrack.data.dataset import Dataset
from rstrack.data.estimate import read_estimate
from rstrack.data.imu.description import ImuDescription, ImuNoise, imu_yaml
from rstrack.inertial.band import reading_sigmas, within_range
from rstrack.options import Options

# Seconds that must have been followed; at both ends nothing is taken, since the clock moves.
_LEAST_S, _MARGIN_S = 5.0, 0.06
# Biases are linear between values so many seconds apart.
_BIAS_S = 5.0
# The corrections' knots are as near each other as this many samples.
_SAMPLES_A_KNOT = 1.6
_MOST_PARTS = 8
# Where it begins: both clocks may be this far apart, s, looked for on so fine a grid.
_GRID_HZ, _FARTHEST_S = 200.0, 1.0
# Turning about one axis alone does not determine the axes: least part of the second largest; and least correlation.
_SECOND, _ALIKE = 0.02, 0.6
# σ above which a value is of no use: rad, m, s, s/s, parts, rad.
USEFUL = np.array([*np.radians((0.3,) * 3), *(0.01,) * 3, 1e-3, 5e-5, *(0.01,) * 3, *np.radians((0.3,) * 2)])
_GROUPS = (("rotation", ROTATION), ("translation", LEVER), ("clock offset", OFFSET), ("clock drift", DRIFT),
           ("gyroscope scale", SCALE))  # fmt: skip


@dataclass(frozen=True)
class ImuCalibration:
    """A solution, and what it was found from. stated: what stood in the IMU's file; samples, seconds: what was used."""

    solution: ImuSolution
    stated: ImuDescription
    noise: ImuNoise
    samples: int
    seconds: float
    notes: tuple[str, ...] = ()

    @property
    def T_imu_depth(self) -> FloatArray:
        """(4, 4): p_imu from p_depth."""
        return self.solution.imu.T_imu_depth

    @property
    def sigmas(self) -> FloatArray:
        """σ (13,) in the order of `rstrack.calibration.imu_model.NAMES`."""
        return np.sqrt(np.diag(self.solution.covariance)[:COUNT])

    @property
    def translation_sigma(self) -> FloatArray:
        """σ (3,) of T_imu_depth's translation, m: of −R l."""
        imu = self.solution.imu
        J = np.hstack([hat(imu.R @ imu.lever), -imu.R])
        return np.sqrt(np.diag(J @ self.solution.covariance[:6, :6] @ J.T))

    @property
    def undetermined(self) -> BoolArray:
        """Which (13,) the recording does not determine."""
        return np.asarray(self.sigmas > USEFUL)

    @property
    def offset_s(self) -> float:
        """Seconds to be added to the stamps as they stand in the file, in the images' middle."""
        imu = self.solution.imu
        return self.stated.offset_s + imu.offset_s + imu.drift * self.stated.offset_s

    @property
    def drift(self) -> float:
        """By which that grows, s/s."""
        imu = self.solution.imu
        return self.stated.drift + imu.drift + self.stated.drift * imu.drift

    @property
    def gyro_matrix(self) -> FloatArray:
        """(3, 3): takes the true rate to the measured one."""
        before = np.eye(3) if self.stated.gyro_matrix is None else self.stated.gyro_matrix
        return before @ np.diag(1.0 + self.solution.imu.scale)

    def text(self) -> str:
        """For the screen, with twice the standard errors."""
        imu, s = self.solution.imu, self.sigmas
        turn, shift = np.degrees(so3.log(imu.R)), 1e3 * self.T_imu_depth[:3, 3]
        biases, bias_s = self._biases()
        rows = [
            ("", f"{self.samples} samples over {self.seconds:.1f} s"),
            ("rotation", f"{_three(turn, 2 * np.degrees(s[ROTATION]), 3)} degrees, T_imu_depth's as a vector"),
            ("translation", f"{_three(shift, 2e3 * self.translation_sigma, 2)} mm, T_imu_depth's"),
            ("offset", f"{1e3 * self.offset_s:+.4f} ± {2e3 * s[OFFSET]:.4f} ms to be added to the IMU's stamps"),
            ("drift", f"{1e6 * self.drift:+.1f} ± {2e6 * s[DRIFT]:.1f} ppm"),
            ("scale", f"{_three(100 * np.diag(self.gyro_matrix) - 100, 200 * s[SCALE], 3)} % of the gyroscope"),
        ]
        for name, part, unit_name, k in (
            ("gyroscope", slice(0, 3), "rad/s", 5),
            ("accelerometer", slice(3, 6), "m/s²", 4),
        ):
            for when, at in (("first", 0), ("last", -1)):
                rows.append(
                    ("bias", f"{_three(biases[at, part], 2 * bias_s[at, part], k)} {unit_name}, {name}, {when}")
                )
        rows += [("undetermined", ", ".join(self._undetermined_names()))] if self.undetermined.any() else []
        return "\n".join([*(f"{a:<13} {b}" for a, b in rows), *self.notes])

    def as_dict(self) -> dict[str, Any]:
        """Plain types, σ beside every value."""
        imu, s, sizes = self.solution.imu, self.sigmas, self.solution.sizes
        biases, bias_s = self._biases()
        return {
            "T_imu_depth": self.T_imu_depth.tolist(),
            "rotation_sigma_rad": s[ROTATION].tolist(),
            "translation_sigma_m": self.translation_sigma.tolist(),
            "offset_s": self.offset_s,
            "offset_sigma_s": float(s[OFFSET]),
            "drift_ppm": 1e6 * self.drift,
            "drift_sigma_ppm": 1e6 * float(s[DRIFT]),
            "gyroscope_matrix": self.gyro_matrix.tolist(),
            "gyroscope_scale_sigma": s[SCALE].tolist(),
            "gravity_in_track": imu.gravity.tolist(),
            "bias_times_s": imu.bias_times.tolist(),
            "gyroscope_bias": biases[:, :3].tolist(),
            "gyroscope_bias_sigma": bias_s[:, :3].tolist(),
            "accelerometer_bias": biases[:, 3:].tolist(),
            "accelerometer_bias_sigma": bias_s[:, 3:].tolist(),
            "undetermined": self._undetermined_names(),
            "errors": {"gyroscope_rad_s": float(sizes.gyro), "accelerometer_m_s2": float(sizes.accel),
                       "track_rotation_rad": sizes.poses[0], "track_position_m": sizes.poses[1]},
            "samples": self.samples,
            "seconds": self.seconds,
        }  # fmt: skip

    def imu_file(self) -> str:
        """Content of an imu.yaml, for `rstrack track --imu`."""
        lines = [
            "# Written by rstrack calibrate --free imu; σ in comments.",
            imu_yaml(self.T_imu_depth, self.noise).rstrip(),
            f"offset_s: {self.offset_s:.9f}  # ± {self.sigmas[OFFSET]:.2g}",
            f"drift_ppm: {1e6 * self.drift:.4f}  # ± {1e6 * self.sigmas[DRIFT]:.2g}",
        ]
        stated = self.stated
        for name, matrix in (("gyroscope_matrix", self.gyro_matrix), ("accelerometer_matrix", stated.accel_matrix)):
            if matrix is not None:
                rows = ", ".join(f"[{', '.join(f'{x:.7g}' for x in row)}]" for row in matrix)
                lines.append(f"{name}: [{rows}]")
        return "\n".join([*lines, f"gravity: {stated.gravity:.7g}", ""])

    def _biases(self) -> tuple[FloatArray, FloatArray]:
        imu = self.solution.imu
        return imu.biases, np.sqrt(np.diag(self.solution.covariance)[COUNT:]).reshape(imu.biases.shape)

    def _undetermined_names(self) -> list[str]:
        return [name for name, part in _GROUPS if np.any(self.undetermined[part])]


def track_of_run(folder: Path) -> TrackedSpline:
    """Of what 'rstrack track' wrote. Raises UserError: it has no spline."""
    estimate = read_estimate(folder)
    if estimate.spline is None:
        raise UserError(f"{folder}: has no spline: track it with a spline method, for example rs-pg")
    valid = estimate.info.get("spline_valid") or [[estimate.spline.t_begin, estimate.spline.t_end]]
    return TrackedSpline(estimate.spline, tuple((float(a), float(b)) for a, b in valid))


def track_of(dataset: Dataset, frames: slice, options: Options, progress: Progress) -> TrackedSpline:
    """By tracking a dataset's frames with depth and colour. Raises UserError: nothing was followed."""
    found = tracked(dataset, range(len(dataset))[frames], replace(options, method="rs-pg"), progress)
    if found is None:
        raise UserError(f"{dataset.root}: these frames give no track: choose --frames with more to see")
    return found


def calibrate_imu(dataset: Dataset, followed: TrackedSpline, progress: Progress = no_progress) -> ImuCalibration:
    """Place, clock, biases and gyroscope's scale of a dataset's IMU, by the longest segment of a track.

    Raises UserError, one line: no IMU, no gyroscope, too short a track, too little motion.
    """
    if dataset.imu_files is None:
        raise UserError(f"{dataset.root}: has no IMU: no imu.csv, mav0/imu0/data.csv or accelerometer.txt")
    stated = dataset.imu_files.description()
    read = dataset.imu_files.read(dataset.stamps, dataset.middle, dataset.rig.T_color_depth, np.eye(4))
    imu = read.recording
    if imu.gyro is None:
        raise UserError(f"{dataset.root}: an accelerometer alone has no clock and no axes: a gyroscope is needed")
    first, last = max(followed.valid, key=lambda part: part[1] - part[0])
    first, last = max(first, followed.spline.t_begin), min(last, followed.spline.t_end)
    if last - first < _LEAST_S:
        raise UserError(
            f"{dataset.root}: {max(last - first, 0.0):.1f} s are followed in a row: {_LEAST_S:g} are needed, 20 good"
        )
    bias_times = np.linspace(first, last, max(2, round((last - first) / _BIAS_S) + 1))
    parts = math.floor(followed.spline.dt * imu.rate_hz / _SAMPLES_A_KNOT)
    progress("calibrating", 0.0, "where to begin")
    begun = begin(followed.spline, (first, last), imu.t, imu.gyro, imu.accel, imu.gravity, bias_times, dataset.middle)
    taken = begun.times(imu.t)
    inside = (taken > first + _MARGIN_S) & (taken < last - _MARGIN_S)
    frame_times = dataset.stamps + 0.5 * dataset.rig.depth_shutter.readout_s
    frame_times = frame_times[(frame_times > first) & (frame_times < last)]
    readings = np.concatenate([imu.gyro, imu.accel], axis=1)[inside]
    data = ImuData(
        CorrectedTrack(followed.spline, min(max(parts, 1), _MOST_PARTS)), imu.t[inside], readings,
        within_range(readings, imu.noise), frame_times, imu.noise, reading_sigmas(imu),
    )  # fmt: skip
    solution = solve(data, begun, lambda n: progress("calibrating", min(0.95, n / 10), f"step {n}"))
    progress("calibrating", 1.0, "done")
    return ImuCalibration(solution, stated, imu.noise, int(inside.sum()), last - first, read.notes)


def begin(
    track: Spline, valid: tuple[float, float], stamps: FloatArray, gyro: FloatArray, accel: FloatArray, gravity: float,
    bias_times: FloatArray, middle: float,
) -> ImuUnknowns:  # fmt: skip
    """An IMU to start from, at the depth camera's own place: its clock by how fast both turn, its axes by which way,
    gravity by the mean force.

    valid: the longest segment (begin, end) of the track, s. stamps (n,), gyro, accel (n, 3). Raises UserError: they do
    not turn alike, or about one axis only.
    """
    t = np.arange(valid[0], valid[1], 1.0 / _GRID_HZ)
    turns = track.velocity(t)[:, 3:]
    turning = _smooth(np.linalg.norm(turns, axis=1))
    shifts = np.arange(-_FARTHEST_S, _FARTHEST_S + 1e-9, 1.0 / _GRID_HZ)
    norm = _smooth(np.linalg.norm(gyro, axis=1))
    alike = np.array([_correlation(turning, np.interp(t - shift, stamps, norm)) for shift in shifts])
    best = int(np.argmax(alike))
    if alike[best] < _ALIKE:
        raise UserError(
            f"IMU: it does not turn as the track does (correlation {alike[best]:.2f} at the best offset within "
            f"{_FARTHEST_S:g} s): is it of this recording, and does the camera turn in it?"
        )
    offset = float(shifts[best])
    seen = np.column_stack([np.interp(t - offset, stamps, gyro[:, i]) for i in range(3)])
    U, sizes, Vt = np.linalg.svd((seen - seen.mean(axis=0)).T @ (turns - turns.mean(axis=0)))
    if sizes[1] < _SECOND * sizes[0]:
        raise UserError(
            "IMU: the camera turns about one axis only, which does not determine its axes: record turns about all three"
        )
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    bias = (seen - turns @ R.T).mean(axis=0)
    force = np.column_stack([np.interp(t - offset, stamps, accel[:, i]) for i in range(3)])
    felt = np.einsum("nij,nj->ni", track.pose(t)[:, :3, :3], force @ R) - track.world_acceleration(t)
    g = -felt.mean(axis=0)
    if not np.linalg.norm(g) > 0.2 * gravity:
        raise UserError("IMU: no gravity in the accelerometer's readings: give the raw ones")
    biases = np.zeros((len(bias_times), 6))
    biases[:, :3] = bias
    g *= gravity / np.linalg.norm(g)
    return ImuUnknowns(R, np.zeros(3), offset, 0.0, np.zeros(3), g, bias_times, biases, middle)


def _smooth(values: FloatArray) -> FloatArray:
    return np.convolve(values, np.full(5, 0.2), "same")


def _correlation(a: FloatArray, b: FloatArray) -> float:
    a, b = a - a.mean(), b - b.mean()
    scale = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / scale if scale > 0.0 else 0.0


def _three(values: FloatArray, errors: FloatArray, digits: int) -> str:
    return ", ".join(f"{v:+.{digits}f} ± {e:.{digits}f}" for v, e in zip(values, errors, strict=True))
