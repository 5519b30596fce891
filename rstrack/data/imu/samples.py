"""Samples of an IMU as text: EuRoC's columns, and TUM's accelerometer.txt."""

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
class Samples:
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


def read_samples(path: Path, layout: Layout) -> Samples:
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
    samples = Samples(path, t, gyro, table[:, -3:], np.array(numbers), unit)
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


def _check_order(samples: Samples) -> None:
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
