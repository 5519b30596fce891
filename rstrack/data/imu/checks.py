"""What is wrong with an IMU's samples, told by their magnitudes: units, rate, gaps, and times that are not the images'.

Units, by what a hand or a robot does to a camera: the median of the specific force's norm is near g or a few times it,
and the direction of gravity in the IMU's frame turns as the gyroscope says: d/dt f = -ω x f + what the motion adds.
That tells a gyroscope in degrees, whose ω is 57 times too large; where gravity keeps its direction, the mere size of
the rate does.
"""

from __future__ import annotations

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rstrack.data.imu.samples import Samples

LOWEST_HZ, LOW_HZ = 25.0, 90.0
"""Rates below which an IMU says nothing that a camera of 30 Hz does not, and below which that is said."""
# Steps longer than so many usual ones are gaps.
_GAP = 1.75
# Part of g within which the median specific force lies (2.4 where fast, and shaken); of the factor between units.
_NEAR_G, _NEAR_UNIT = (0.6, 10.0), (0.75, 1.3)
_ACCEL_UNITS = (("g", 9.80665), ("mg", 9.80665e-3), ("cm/s²", 1e-2), ("mm/s²", 1e-3))
_GYRO_UNITS = (("deg/s", np.pi / 180.0), ("mdeg/s", np.pi / 180e3), ("mrad/s", 1e-3))
_STAMP_UNITS = (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6), ("ns", 1e-9))
# Rate (RMS, rad/s) that no camera which is to be tracked keeps up: 460 deg/s; hands reach a tenth, a fast one a third.
_WILD_RAD_S = 8.0
# Seconds over which gravity's turning is compared, and how far the fit may be from the unit.
_TURN_S, _LIKE = 0.2, (0.6, 1.5)
# The turning must be told this much better than by chance.
_SURE = 6.0


def check_units(samples: Samples, gravity: float) -> None:
    """Raises UserError where the accelerometer or the gyroscope has another unit than m/s² and rad/s.

    gravity: m/s²; where there is none, only absurd rates show.
    """
    norm = float(np.median(np.linalg.norm(samples.accel, axis=1)))
    low, high = (gravity * factor for factor in _NEAR_G)
    if gravity > 1.0 and not low <= norm <= high:
        for name, unit in _ACCEL_UNITS:
            if _NEAR_UNIT[0] < norm * unit / gravity < _NEAR_UNIT[1]:
                raise UserError(
                    f"{samples.path}: accelerometer in {name} (its median is {norm:.3g}), not in m/s²: "
                    f"multiply by {unit:g}"
                )
        cure = "gravity was taken out? give the raw readings" if norm < low else "give m/s²"
        raise UserError(
            f"{samples.path}: accelerometer's median is {norm:.3g} m/s², where gravity alone is {gravity:.3g}: {cure}"
        )
    if samples.gyro is None:
        return
    if not samples.gyro.any():
        raise UserError(f"{samples.path}: the gyroscope is 0 throughout: give accelerometer.txt alone, or its readings")
    rms = float(np.sqrt((samples.gyro**2).sum(axis=1).mean()))
    if gravity > 1.0 and (other := _turning_unit(samples, samples.gyro)) is not None:
        name, unit = other
        raise UserError(
            f"{samples.path}: gyroscope in {name}, not in rad/s (gravity turns {1 / unit:.0f} times less than it "
            "says): "
            f"multiply by {unit:.6g}"
        )
    if rms > _WILD_RAD_S:
        raise UserError(
            f"{samples.path}: gyroscope's rate is {rms:.3g} rad/s in the mean, {np.degrees(rms):.0f} deg/s: is it in "
            f"deg/s? Multiply by {np.pi / 180:.6g}"
        )


def check_times(samples: Samples, stamps: FloatArray, offset_s: float) -> tuple[str, ...]:
    """What there is to say of gaps, rate and reach, a line each. stamps (n,): the images', s; offset_s is added to t.

    Raises UserError: no sample at the images' times, or too low a rate.
    """
    t, first, last = samples.t + offset_s, float(stamps[0]), float(stamps[-1])
    if t[-1] < first or t[0] > last:
        raise UserError(_apart(samples, first, last, offset_s))
    notes = []
    period = float(np.median(np.diff(t)))
    rate = 1.0 / period
    if rate < LOWEST_HZ:
        raise UserError(
            f"{samples.path}: {rate:.3g} samples a second are too few to follow a motion: record it at 100 Hz or more"
        )
    if rate < LOW_HZ:
        notes.append(f"{samples.path.name}: {rate:.3g} samples a second: 100 and more follow a hand")
    steps = np.diff(t)
    gaps = steps > _GAP * period
    if gaps.any():
        missing, k = int(np.rint(steps[gaps] / period - 1.0).sum()), int(np.argmax(steps))
        notes.append(
            f"{samples.path.name}: {missing} samples are missing in {int(gaps.sum())} gaps, the longest "
            f"{steps[k]:.3g} s at {t[k]:.3f} s"
        )
    covered = (min(last, t[-1]) - max(first, t[0])) / max(last - first, 1e-9)
    if last > first and covered < 0.98:
        notes.append(
            f"{samples.path.name}: covers {100 * covered:.0f} % of the images' time ({t[0]:.3f} to {t[-1]:.3f} s of "
            f"{first:.3f} to {last:.3f} s)"
        )
    return tuple(notes)


def saturated(values: FloatArray, limit: float | None) -> int:
    """Samples (n, 3) of which an axis is at its range."""
    return 0 if limit is None else int((np.abs(values) >= 0.999 * limit).any(axis=1).sum())


def _apart(samples: Samples, first: float, last: float, offset_s: float) -> str:
    """Why no sample lies at the images' times."""
    stored = samples.t / samples.stamp_unit_s
    expected = dict((unit, name) for name, unit in _STAMP_UNITS)[samples.stamp_unit_s]
    for name, unit in _STAMP_UNITS:
        span = stored[[0, -1]] * unit
        near = 0.2 * (last - first) + 1.0
        if (
            unit != samples.stamp_unit_s
            and span[0] <= last + near
            and span[1] >= first - near
            and span[1] - span[0] > 0.05
        ):
            factor = unit / samples.stamp_unit_s
            return f"{samples.path}: stamps in {name}, not in {expected}: multiply them by {factor:g}"
    t = samples.t + offset_s
    return (
        f"{samples.path}: samples from {t[0]:.3f} to {t[-1]:.3f} s, images from {first:.3f} to {last:.3f} s: another "
        f"recording, or another clock: offset_s: {0.5 * (first + last - t[0] - t[-1]):.3f} in imu.yaml centres them"
    )


def _turning_unit(samples: Samples, gyro: FloatArray) -> tuple[str, float] | None:
    """The gyroscope's unit, by name and in rad/s, if gravity's turning says that it is not rad/s."""
    t, f = samples.t, samples.accel
    step = np.clip(np.diff(t), 0.0, 0.1)
    turned = np.cross(gyro, f)
    path = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * step[:, None] * (turned[1:] + turned[:-1]), axis=0)])
    summed = np.concatenate([np.zeros((1, 3)), np.cumsum(f, axis=0)])
    window = max(2, round(_TURN_S / max(float(np.median(np.diff(t))), 1e-4)))
    ends = np.arange(0, len(t) - window, window)
    if len(ends) < 8:
        return None
    # Means over windows: the shake of a hand goes, gravity stays; of what gravity should have turned likewise.
    mean_f = (summed[ends + window] - summed[ends]) / window
    mean_path = np.add.reduceat(path, ends)[: len(ends)]
    counts = np.diff(np.append(ends, len(path)))[:, None]
    expected, found = -np.diff(mean_path / counts, axis=0)[:-1], np.diff(mean_f, axis=0)[:-1]
    energy = float((expected**2).sum())
    if energy == 0.0:
        return None
    scale = float((expected * found).sum()) / energy
    rest = found - scale * expected
    sigma = float(np.sqrt((rest**2).sum() / max(1, rest.size - 1) / energy))
    for name, unit in _GYRO_UNITS:
        if _LIKE[0] < scale / unit < _LIKE[1] and scale > _SURE * sigma:
            return name, unit
    return None
