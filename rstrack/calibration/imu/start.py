"""Where to begin: the IMU's clock by how fast both turn, its axes by which way, gravity by the mean force."""

from __future__ import annotations

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rstrack.calibration.imu.tracked import Track, motion_at
from rstrack.calibration.imu.unit import Unit

_GRID_HZ = 200.0
# The clocks may be this far apart, s.
_FARTHEST_S = 1.0
# Of what turning about one axis alone is told, the axes are not: the second largest part, and the correlation.
_SECOND, _ALIKE = 0.02, 0.6


def begin(
    track: Track, valid: tuple[float, float], stamps: FloatArray, gyro: FloatArray, accel: FloatArray, gravity: float,
    bias_times: FloatArray, middle: float,
) -> Unit:  # fmt: skip
    """A unit to start from, at the depth camera's own place.

    valid: the longest piece (begin, end) of the track, s. stamps (n,), gyro, accel (n, 3). Raises UserError: they do
    not turn alike, or about one axis only.
    """
    t = np.arange(valid[0], valid[1], 1.0 / _GRID_HZ)
    motion = motion_at(track, t)
    turning = _smooth(np.linalg.norm(motion.rate, axis=1))
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
    rate = motion.rate - motion.rate.mean(axis=0)
    U, sizes, Vt = np.linalg.svd((seen - seen.mean(axis=0)).T @ rate)
    if sizes[1] < _SECOND * sizes[0]:
        raise UserError("IMU: the camera turns about one axis only, which tells no axes: record turns about all three")
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    bias = (seen - motion.rate @ R.T).mean(axis=0)
    force = np.column_stack([np.interp(t - offset, stamps, accel[:, i]) for i in range(3)])
    felt = np.einsum("nij,nj->ni", motion.R, force @ R) - motion.acceleration
    g = -felt.mean(axis=0)
    if not np.linalg.norm(g) > 0.2 * gravity:
        raise UserError("IMU: no gravity in the accelerometer's readings: give the raw ones")
    biases = np.zeros((len(bias_times), 6))
    biases[:, :3] = bias
    g *= gravity / np.linalg.norm(g)
    return Unit(R, np.zeros(3), offset, 0.0, np.zeros(3), g, bias_times, biases, middle)


def _smooth(values: FloatArray) -> FloatArray:
    return np.convolve(values, np.full(5, 0.2), "same")


def _correlation(a: FloatArray, b: FloatArray) -> float:
    a, b = a - a.mean(), b - b.mean()
    scale = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / scale if scale > 0.0 else 0.0
