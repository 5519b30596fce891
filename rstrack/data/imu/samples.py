"""Samples of an IMU as text (EuRoC's columns, TUM's accelerometer.txt), and what is wrong with them.

Checked by magnitude: physical units, rate, gaps, and times that are not the images'. Units, by what a hand or a robot
does to a camera: the median of the specific force's norm is near g or a few times it, and the direction of gravity in
the IMU's frame turns as the gyroscope states: d/dt f = -ω x f + what the motion adds. That shows a gyroscope in
degrees, whose ω is 57 times too large. Where gravity keeps its direction, the mere size of the rate does.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from rsgen.array_types import FloatArray, IntArray
from rsgen.errors import UserError
from rsgen.files import read_text

Layout = Literal["euroc", "tum"]
_COLUMNS: dict[Layout, tuple[int, str]] = {
    "euroc": (7, "'timestamp [ns],gyro x,y,z [rad/s],accelerometer x,y,z [m/s²]'"),
    "tum": (4, "'timestamp [s] ax ay az [m/s²]'"),
}
_UNITS: dict[Layout, float] = {"euroc": 1e-9, "tum": 1.0}
_FEWEST = 10
_SHOWN = 60


@dataclass(frozen=True)
class RecordedImu:
    """n samples as they stand in a file: t (n,) s, gyro (n, 3) or None, accel (n, 3). numbers (n,): their lines.

    stamp_unit_s: seconds of one of the file's stamps.
    """

    path: Path
    t: FloatArray
    gyro: FloatArray | None
    accel: FloatArray
    numbers: IntArray
    stamp_unit_s: float

    def where(self, k: int) -> str:
        """File and line of sample k."""
        return f"{self.path} line {self.numbers[k]}"


def read_samples(path: Path, layout: Layout) -> RecordedImu:
    """All samples, which are finite and come in the order of time.

    Lines that begin with '#' are comments, and a first one of letters. Raises UserError, one line, naming the line.
    """
    count, wanted = _COLUMNS[layout]
    lines = read_text(path).removeprefix("\ufeff").splitlines()
    numbers = [k for k, line in enumerate(lines, 1) if line.strip() and not line.lstrip().startswith("#")]
    if numbers and lines[numbers[0] - 1].lstrip()[:1].isalpha():  # a head without a '#'
        numbers = numbers[1:]
    if len(numbers) < _FEWEST:
        raise UserError(f"{path}: {len(numbers)} samples are too few for an IMU: expected lines of {wanted}")
    table = _table(path, [lines[k - 1] for k in numbers], numbers, layout)
    if table.shape[1] != count:
        raise UserError(f"{path} line {numbers[0]}: {table.shape[1]} numbers, expected {count}: {wanted}")
    bad = np.flatnonzero(~np.isfinite(table).all(axis=1))
    if len(bad):
        k = int(bad[0])
        raise UserError(
            f"{path} line {numbers[k]}: holds what is no finite number ({lines[numbers[k] - 1][:_SHOWN]!r}; "
            f"{len(bad)} such lines in all): remove them"
        )
    unit = _UNITS[layout]
    t = table[:, 0] / round(1.0 / unit)  # a division is rounded once; 1e-9 is no float
    gyro = table[:, 1:4] if layout == "euroc" else None
    samples = RecordedImu(path, t, gyro, table[:, -3:], np.array(numbers), unit)
    _check_order(samples)
    return samples


def _table(path: Path, lines: list[str], numbers: list[int], layout: Layout) -> FloatArray:
    """Numbers (n, columns). Raises UserError naming the first line that has none, or more than others."""
    try:
        return np.loadtxt(lines, delimiter="," if layout == "euroc" else None, ndmin=2, comments=None)
    except (ValueError, OverflowError, IndexError):
        pass
    count, wanted = _COLUMNS[layout]
    for number, line in zip(numbers, lines, strict=True):
        if (row := _row(line, layout)) is None or row != count:
            raise UserError(f"{path} line {number}: expected {count} numbers, {wanted}, found {line[:_SHOWN]!r}")
    raise UserError(f"{path}: expected lines of {count} numbers, {wanted}")


def _row(line: str, layout: Layout) -> int | None:
    """How many numbers a line has, None where something in it is no number."""
    fields = line.split(",") if layout == "euroc" else line.split()
    try:
        return len([float(field) for field in fields])
    except ValueError:
        return None


def _check_order(samples: RecordedImu) -> None:
    step = np.diff(samples.t)
    wrong = np.flatnonzero(step <= 0.0) + 1
    if not len(wrong):
        return
    k = int(wrong[0])
    if step[k - 1] == 0.0:
        raise UserError(
            f"{samples.where(k)}: repeats the stamp of line {samples.numbers[k - 1]} ({len(wrong)} stamps do not come "
            "after the one before): remove one of the two"
        )
    raise UserError(
        f"{samples.where(k)}: its stamp is {-step[k - 1]:.6g} s before that of line {samples.numbers[k - 1]} "
        f"({len(wrong)} stamps do not come after the one before): sort the file by time"
    )


LOWEST_HZ, LOW_HZ = 25.0, 90.0
"""Rates below which an IMU adds nothing to a camera of 30 Hz, and below which a note is given."""
# Steps longer than so many median ones are gaps.
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
# The turning must be this much clearer than chance.
_SURE = 6.0


def check_units(samples: RecordedImu, gravity: float) -> None:
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
            f"states): multiply by {unit:.6g}"
        )
    if rms > _WILD_RAD_S:
        raise UserError(
            f"{samples.path}: gyroscope's rate is {rms:.3g} rad/s in the mean, {np.degrees(rms):.0f} deg/s: is it in "
            f"deg/s? Multiply by {np.pi / 180:.6g}"
        )


def check_times(samples: RecordedImu, stamps: FloatArray, offset_s: float) -> tuple[str, ...]:
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


def _apart(samples: RecordedImu, first: float, last: float, offset_s: float) -> str:
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


def _turning_unit(samples: RecordedImu, gyro: FloatArray) -> tuple[str, float] | None:
    """The gyroscope's unit, by name and in rad/s, if gravity's turning shows that it is not rad/s."""
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
