"""Calibrate a recording's IMU against its depth camera: from a track of the recording, and the samples.

found = calibrate_imu(open_dataset(Path("recording")), track_of_run(Path("runs/recording")))
Path("imu.yaml").write_text(found.imu_file())
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError
from rsgen.geometry.spline import Spline
from rstrack.calibration.imu.normal import Data
from rstrack.calibration.imu.result import ImuCalibration
from rstrack.calibration.imu.solve import solve
from rstrack.calibration.imu.start import begin
from rstrack.calibration.imu.tracked import Track
from rstrack.data.dataset import Dataset
from rstrack.data.estimate import read_estimate
from rstrack.options import Options
from rstrack.tracking.first_look.rough_track import rough_track

# Seconds that must have been followed; at both ends nothing is taken, since the clock moves.
_LEAST_S, _MARGIN_S = 5.0, 0.06
# Biases are linear between values so many seconds apart.
_BIAS_S = 5.0
# The corrections' knots are as near each other as this many samples.
_SAMPLES_A_KNOT = 1.6
_MOST_PARTS = 8


@dataclass(frozen=True)
class Followed:
    """A track: T_world_depth(t), and the times (begin, end) in s within which it means something."""

    spline: Spline
    valid: tuple[tuple[float, float], ...]


def track_of_run(folder: Path) -> Followed:
    """Of what 'rstrack track' wrote. Raises UserError: it has no spline."""
    estimate = read_estimate(folder)
    if estimate.spline is None:
        raise UserError(f"{folder}: has no spline: track it with a spline method, for example rs-pg")
    valid = estimate.info.get("spline_valid") or [[estimate.spline.t_begin, estimate.spline.t_end]]
    return Followed(estimate.spline, tuple((float(a), float(b)) for a, b in valid))


def track_of(dataset: Dataset, frames: slice, options: Options, progress: Progress) -> Followed:
    """By tracking a dataset's frames with depth and colour. Raises UserError: nothing was followed."""
    chosen = range(len(dataset))[frames]
    how = replace(options, method="rs-pg")
    tracker = rough_track(dataset, chosen, how, lambda done: progress("tracking", done, ""))
    if tracker.spline is None or not tracker.spline_valid:
        raise UserError(f"{dataset.root}: these frames give no track: choose --frames with more to see")
    return Followed(tracker.spline, tuple(tracker.spline_valid))


def calibrate_imu(dataset: Dataset, followed: Followed, progress: Progress = no_progress) -> ImuCalibration:
    """Place, clock, biases and gyroscope's scale of a dataset's IMU, by the longest piece of a track.

    Raises UserError, one line: no IMU, no gyroscope, too short a track, too little motion.
    """
    if dataset.imu_files is None:
        raise UserError(f"{dataset.root}: has no IMU: no imu.csv, mav0/imu0/data.csv or accelerometer.txt")
    said = dataset.imu_files.description()
    read = dataset.imu_files.read(dataset.stamps, dataset.middle, dataset.rig.T_color_depth, np.eye(4))
    imu = read.recording
    if imu.gyro is None:
        raise UserError(f"{dataset.root}: an accelerometer alone tells no clock and no axes: a gyroscope is needed")
    first, last = max(followed.valid, key=lambda piece: piece[1] - piece[0])
    first, last = max(first, followed.spline.t_begin), min(last, followed.spline.t_end)
    if last - first < _LEAST_S:
        raise UserError(
            f"{dataset.root}: {max(last - first, 0.0):.1f} s are followed in a row: {_LEAST_S:g} are needed, 20 good"
        )
    bias_times = np.linspace(first, last, max(2, round((last - first) / _BIAS_S) + 1))
    parts = math.floor(followed.spline.dt * imu.rate_hz / _SAMPLES_A_KNOT)
    track = Track(followed.spline, min(max(parts, 1), _MOST_PARTS))
    progress("calibrating", 0.0, "where to begin")
    unit = begin(track, (first, last), imu.t, imu.gyro, imu.accel, imu.gravity, bias_times, dataset.middle)
    taken = unit.times(imu.t)
    inside = (taken > first + _MARGIN_S) & (taken < last - _MARGIN_S)
    frame_times = dataset.stamps + 0.5 * dataset.rig.depth_shutter.readout_s
    frame_times = frame_times[(frame_times > first) & (frame_times < last)]
    noise = imu.noise
    data = Data(
        track, imu.t[inside], imu.gyro[inside], imu.accel[inside], _counts(imu.gyro[inside], noise.gyro_range),
        _counts(imu.accel[inside], noise.accel_range), frame_times, noise, imu.rate_hz,
    )  # fmt: skip
    solution = solve(data, unit, lambda n: progress("calibrating", min(0.95, n / 10), f"step {n}"))
    progress("calibrating", 1.0, "done")
    return ImuCalibration(solution, said, noise, int(inside.sum()), last - first, read.notes)


def _counts(values: FloatArray, limit: float | None) -> np.ndarray:
    """Which readings (n, 3) are not at the unit's range."""
    return np.abs(values) < (np.inf if limit is None else 0.999 * limit)
