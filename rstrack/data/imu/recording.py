"""An IMU's recording in a folder: found, read, checked, and brought to the images' clock.

imu.csv (EuRoC's columns), mav0/imu0/data.csv, imu0/data.csv, or TUM's accelerometer.txt. What is known of the IMU: the
file given, else imu.yaml or sensor.yaml beside the samples, else a sequence.yaml.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rstrack.data.imu.description import (
    EXAMPLE,
    PHONE,
    ImuDescription,
    ImuNoise,
    of_sequence,
    read_imu_yaml,
    read_sensor_yaml,
)
from rstrack.data.imu.samples import Layout, RecordedImu, check_times, check_units, read_samples, saturated


@dataclass(frozen=True)
class ImuRecording:
    """n samples of one IMU fixed to the depth camera, in the order of time.

    t (n,): s, on the clock of the images' stamps as far as it is known. gyro (n, 3): angular rate, rad/s; None where
    there is no gyroscope. accel (n, 3): specific force a − g, m/s²: at rest it reads −g. Both in the IMU's frame, at
    its own place. T_imu_depth (4, 4): p_imu from p_depth. gravity: its strength, m/s²; its direction in the tracker's
    world is not known beforehand.
    """

    t: FloatArray
    gyro: FloatArray | None
    accel: FloatArray
    noise: ImuNoise
    T_imu_depth: FloatArray
    rate_hz: float
    gravity: float = 9.80665


_PLACES: tuple[tuple[str, Layout], ...] = (
    ("imu.csv", "euroc"), ("mav0/imu0/data.csv", "euroc"), ("imu0/data.csv", "euroc"), ("accelerometer.txt", "tum"),
)  # fmt: skip
IMU_YAML = "imu.yaml"
# The Kinect's accelerometer in TUM's files has y up where images have y down, and z as they have; x then, for a
# right-handed frame, is to the left.
_T_KINECT = np.diag([-1.0, -1.0, 1.0, 1.0])
# Stated and counted rates that are as near as this are one.
_SAME_RATE = 0.02


@dataclass(frozen=True)
class ReadImu:
    """A recording of an IMU, and what was assumed or is odd about it, a line each."""

    recording: ImuRecording
    notes: tuple[str, ...]


@dataclass(frozen=True)
class ImuFiles:
    """Where an IMU's samples are, and what describes it. given: of --imu. meta: of a sequence.yaml.

    Stamps t of the samples become t + offset_s + drift (t - middle), `middle` being that of the images.
    """

    samples: Path
    layout: Layout
    given: Path | None = None
    meta: dict[str, Any] | None = None

    def description(self) -> ImuDescription:
        """What is known of the IMU. Raises UserError."""
        if self.given is not None:
            return read_imu_yaml(self.given)
        beside = self.samples.with_name(IMU_YAML)
        if beside.is_file():
            return read_imu_yaml(beside)
        if (sensor := self.samples.with_name("sensor.yaml")).is_file():
            return read_sensor_yaml(sensor)
        if self.meta is not None and (known := of_sequence(self.samples.with_name("sequence.yaml"), self.meta)):
            return known
        return ImuDescription("nothing")

    def read(
        self, stamps: FloatArray, middle: float, T_color_depth: FloatArray, T_imu_depth: FloatArray | None = None
    ) -> ReadImu:
        """Samples on the images' clock. stamps (n,): the images', s; middle: where the clock's offset holds, s.

        T_color_depth (4, 4): of the cameras. T_imu_depth (4, 4): to be taken where it is not stated. Raises UserError,
        one line: what is wrong with which file, and the likely cure.
        """
        samples, known = read_samples(self.samples, self.layout), self.description()
        notes = list(check_times(samples, stamps, known.offset_s))
        samples = replace(samples, gyro=_undone(samples.gyro, known.gyro_matrix),
                          accel=samples.accel @ _inverse(known.accel_matrix).T)  # fmt: skip
        check_units(samples, known.gravity)
        T = known.extrinsics(T_color_depth)
        if T is None and self.layout == "tum":
            T = _T_KINECT
            notes.append("accelerometer.txt: axes taken as a Kinect's, at the camera: imu.yaml may say T_imu_depth")
        T = T_imu_depth if T is None else T
        if T is None:
            raise UserError(
                f"{self.samples}: nothing states where the IMU sits: write {self.samples.with_name(IMU_YAML)} (or give "
                f"--imu FILE) with '{EXAMPLE}', or find it: rstrack calibrate --free imu"
            )
        noise = known.noise
        if noise is None:
            noise = PHONE
            notes.append(f"{self.samples.name}: its noise is not stated: taken as a phone's (imu.yaml may say it)")
        for name, values, limit in (("gyroscope", samples.gyro, noise.gyro_range),
                                    ("accelerometer", samples.accel, noise.accel_range)):  # fmt: skip
            if values is not None and (count := saturated(values, limit)):
                notes.append(f"{self.samples.name}: the {name} is at its range in {count} samples")
        rate, note = _rate(samples, known)
        t = samples.t + known.offset_s + known.drift * (samples.t - middle)
        recording = ImuRecording(t, samples.gyro, samples.accel, noise, T, rate, known.gravity)
        return ReadImu(recording, (*notes, *note))


def find_imu(root: Path, given: Path | None = None, meta: dict[str, Any] | None = None) -> ImuFiles | None:
    """The IMU's files in a folder, None without any.

    given: what describes it, of --imu. meta: a sequence.yaml's content. Raises UserError: described, but not there.
    """
    found = next(((root / name, layout) for name, layout in _PLACES if (root / name).is_file()), None)
    if found is not None:
        return ImuFiles(*found, given, meta)
    if given is not None:
        raise UserError(
            f"{given}: describes an IMU, but {root} has no samples (none of {', '.join(n for n, _ in _PLACES)})"
        )
    return None


def _rate(samples: RecordedImu, known: ImuDescription) -> tuple[float, tuple[str, ...]]:
    """Samples a second, and what there is to say where the description has another number."""
    steps = np.diff(samples.t)
    counted = float(np.rint(steps / np.median(steps)).sum() / (samples.t[-1] - samples.t[0]))
    if known.rate_hz is None:
        return counted, ()
    if abs(counted / known.rate_hz - 1.0) <= _SAME_RATE:
        return known.rate_hz, ()
    return counted, (
        f"{samples.path.name}: {counted:.4g} samples a second, not {known.rate_hz:g} as {known.source} states",
    )


def _inverse(matrix: FloatArray | None) -> FloatArray:
    return np.eye(3) if matrix is None else np.asarray(np.linalg.inv(matrix))


def _undone(values: FloatArray | None, matrix: FloatArray | None) -> FloatArray | None:
    return None if values is None else values @ _inverse(matrix).T
