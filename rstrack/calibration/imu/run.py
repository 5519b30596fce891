"""Calibrate a recording's IMU against its depth camera: from a track of the recording, and the samples.

found = calibrate_imu(open_dataset(Path("recording")), track_of_run(Path("runs/recording")))
Path("imu.yaml").write_text(found.imu_file())
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError
from rsgen.geometry.spline import Spline
from rstrack.calibration.imu.model import CorrectedTrack, ImuUnknowns
from rstrack.calibration.imu.result import ImuCalibration
from rstrack.calibration.imu.solve import ImuData, solve
from rstrack.calibration.start import TrackedSpline, tracked
from rstrack.data.dataset import Dataset
from rstrack.data.estimate import read_estimate
from rstrack.inertial.residuals import SATURATED
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
    noise, readings = imu.noise, np.concatenate([imu.gyro, imu.accel], axis=1)[inside]
    limits = [np.inf if limit is None else SATURATED * limit for limit in (noise.gyro_range, noise.accel_range)]
    data = ImuData(
        CorrectedTrack(followed.spline, min(max(parts, 1), _MOST_PARTS)), imu.t[inside], readings,
        np.abs(readings) < np.repeat(limits, 3), frame_times, noise, imu.rate_hz,
    )  # fmt: skip
    solution = solve(data, begun, lambda n: progress("calibrating", min(0.95, n / 10), f"step {n}"))
    progress("calibrating", 1.0, "done")
    return ImuCalibration(solution, stated, noise, int(inside.sum()), last - first, read.notes)


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
