"""What an inertial measurement unit on the camera would read: exact values from the spline, then its errors.

Specific force and angular rate in the IMU's frame, at the IMU's place (lever arm included):
    gyro = M_g ω + b_g + n_g,      accel = M_a (a − g) + b_a + n_a,      both clipped to the sensor's range.
Noise as Kalibr and the EuRoC sets state it, by continuous-time densities (Kalibr's wiki, "IMU Noise Model"): white
noise of density σ sampled at rate f has the standard deviation σ √f, a bias that diffuses with density σ_b takes steps
of standard deviation σ_b / √f. While the IMU warms up a bias drifts by A (1 − exp(−t/τ)) beside that.
Samples may come late or early, be lost, and bear the stamps of a clock of their own; values are those of true times.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rsgen.array_types import FloatArray
from rsgen.config.faults import ImuFaults
from rsgen.config.sections import ImuConfig, Vector3
from rsgen.errors import UserError
from rsgen.files import atomic_write
from rsgen.geometry import se3
from rsgen.geometry.so3 import cross
from rsgen.geometry.spline import Spline
from rsgen.sequence.format import round_stamps

_MAX_SAMPLES = 10_000_000
# Samples evaluated at once: intermediate 6x6 matrices then stay small.
_BLOCK = 4096
# Marks the IMU's random numbers among all that derive from a sequence's seed. Never zero: NumPy's SeedSequence takes
# [a, b] and [a, b, 0] for the same.
_STREAM = 0x494D55
_GYRO_NOISE, _GYRO_BIAS, _ACCEL_NOISE, _ACCEL_BIAS, _WARMUP, _JITTER, _LOST, _RUNS, _STAMPS = range(1, 10)
# Part of a period that jitter, and the stamps' errors, may reach: stamps then rise still.
_MOST_LATE = 0.2

IMU_CSV_HEADER = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
"""First line of EuRoC's imu0/data.csv."""


@dataclass(frozen=True)
class ImuSamples:
    """n samples: t (n,) s; gyro (n, 3) rad/s and accel (n, 3) m/s² in the IMU's frame; the biases (n, 3) within them.

    A resting accelerometer reads −g: the specific force. t: when they were taken; stamps (n,): by the IMU's clock, s.
    """

    t: FloatArray
    gyro: FloatArray
    accel: FloatArray
    gyro_bias: FloatArray
    accel_bias: FloatArray
    stamps: FloatArray


def exact_imu(
    spline: Spline, T_imu_body: npt.ArrayLike, gravity: npt.ArrayLike, t: npt.ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Angular rate ω (n, 3) in rad/s and specific force Rᵀ(a − g) (n, 3) in m/s², in the IMU's frame, without errors.

    spline: T_world_body(t). T_imu_body (4, 4): body to IMU coordinates, lever arm included. gravity (3,): m/s² in the
    world. t (n,): s. Raises UserError for times outside the spline. docs/method.md: a = R(v̇ + ω × v), with the
    twist and its derivative taken to the IMU by the constant adjoint of T_imu_body.
    """
    t, gravity = np.asarray(t, dtype=np.float64), np.asarray(gravity, dtype=np.float64)
    T_imu_body = np.asarray(T_imu_body, dtype=np.float64)
    to_imu = se3.adjoint(T_imu_body).T
    gyro, force = np.empty((len(t), 3)), np.empty((len(t), 3))
    for first in range(0, len(t), _BLOCK):
        part = slice(first, first + _BLOCK)
        T_world_body, twist = spline.pose_and_velocity(t[part])
        twist, change = twist @ to_imu, spline.acceleration(t[part]) @ to_imu
        v, omega = twist[:, :3], twist[:, 3:]
        g_imu = gravity @ T_world_body[:, :3, :3] @ T_imu_body[:3, :3].T
        gyro[part], force[part] = omega, change[:, :3] + cross(omega, v) - g_imu
    return gyro, force


def sample_clock(config: ImuConfig, t_begin: float, t_end: float) -> tuple[float, int]:
    """Time of the first sample, s, and the number of samples between two times in seconds.

    Raises UserError if there is none, or an absurd number of them.
    """
    start = math.ceil(t_begin * 1e9 - 1e-3) / 1e9
    if not math.isfinite(t_end - start) or t_end < start:
        raise UserError(f"imu: no sample fits between {t_begin!r} and {t_end!r} s: use a longer trajectory")
    steps = (t_end - start) * config.rate_hz
    if steps > _MAX_SAMPLES:
        raise UserError(f"imu: {steps:.0f} samples at rate_hz {config.rate_hz:g} are too many: lower rate_hz")
    return start, math.floor(steps + 1e-6) + 1


def simulate_imu(
    spline: Spline, config: ImuConfig, t_begin: float, t_end: float, seed: int, faults: ImuFaults | None = None
) -> ImuSamples:
    """What the IMU reads from `t_begin` to `t_end` seconds, both within the spline T_world_depth(t).

    Sample k is at t_begin + k / rate, to the nanosecond, but for jitter. Random numbers depend on `seed` and k alone,
    so that a longer recording begins with the samples of a shorter one. Raises UserError for times outside the spline
    and absurd counts.
    """
    faults = faults or ImuFaults()
    start, count = sample_clock(config, t_begin, t_end)
    t = start + np.arange(count) / config.rate_hz
    if faults.jitter_s:
        t = np.maximum(t + _bounded(count, faults.jitter_s, config.rate_hz, _generator(seed, _JITTER)), start)
    t = round_stamps(t)
    t = np.minimum(t, t_end)  # the last one may have been rounded up
    gyro, force = exact_imu(spline, se3.inverse(config.T_depth_imu()), config.gravity, t)
    gyro_bias = _random_walk(
        len(t), config.gyroscope_bias, config.gyroscope_random_walk, config.rate_hz, _generator(seed, _GYRO_BIAS)
    )
    accel_bias = _random_walk(
        len(t), config.accelerometer_bias, config.accelerometer_random_walk, config.rate_hz,
        _generator(seed, _ACCEL_BIAS),
    )  # fmt: skip
    if config.gyroscope_warmup or config.accelerometer_warmup:
        warmed = -np.expm1((start - t) / config.warmup_s)[:, None]
        sizes = _generator(seed, _WARMUP).standard_normal((2, 3))
        gyro_bias = gyro_bias + config.gyroscope_warmup * sizes[0] * warmed
        accel_bias = accel_bias + config.accelerometer_warmup * sizes[1] * warmed
    gyro_noise = _white(len(t), config.gyroscope_noise_density, config.rate_hz, _generator(seed, _GYRO_NOISE))
    accel_noise = _white(len(t), config.accelerometer_noise_density, config.rate_hz, _generator(seed, _ACCEL_NOISE))
    gyro = _clip(gyro @ np.array(config.gyroscope_matrix).T + gyro_bias + gyro_noise, config.gyroscope_range)
    accel = _clip(
        force @ np.array(config.accelerometer_matrix).T + accel_bias + accel_noise, config.accelerometer_range
    )
    stamps = _stamped(t, start, config.rate_hz, faults, seed)
    kept = _arriving(count, faults, seed)
    return ImuSamples(t[kept], gyro[kept], accel[kept], gyro_bias[kept], accel_bias[kept], stamps[kept])


def write_imu_csv(path: Path, samples: ImuSamples, epoch_s: int = 0) -> None:
    """Write `imu_csv`. The file is there whole or not at all. Raises UserError if it cannot be written."""
    atomic_write(path, imu_csv(samples, epoch_s).encode())


def imu_csv(samples: ImuSamples, epoch_s: int = 0) -> str:
    """Samples as the text of EuRoC's imu0/data.csv: whole nanoseconds, rad/s, m/s². `epoch_s` is added to all times."""
    values = np.column_stack([samples.gyro, samples.accel])
    return _csv(IMU_CSV_HEADER, nanoseconds(samples.stamps, epoch_s), values=values)


def _csv(header: str, *times: list[int], values: FloatArray) -> str:
    """Lines of times, ns, n each, and values (n, k)."""
    rows = zip(*times, values.tolist(), strict=True)
    lines = (",".join([*map(str, stamps), *(f"{value:.12g}" for value in row)]) for *stamps, row in rows)
    return "\n".join([header, *lines, ""])


def nanoseconds(t: npt.ArrayLike, epoch_s: int = 0) -> list[int]:
    """Times (n,) in seconds as whole nanoseconds since `epoch_s` seconds earlier; exact, in integers."""
    return [epoch_s * 1_000_000_000 + int(ns) for ns in np.rint(np.asarray(t, dtype=np.float64) * 1e9).astype(np.int64)]


def _generator(seed: int, process: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence([seed, process, _STREAM]))


def _white(count: int, density: float, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    return density * math.sqrt(rate_hz) * rng.standard_normal((count, 3))


def _random_walk(count: int, start: Vector3, density: float, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    steps = density / math.sqrt(rate_hz) * rng.standard_normal((count - 1, 3))
    return np.asarray(np.array(start) + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)]))


def _bounded(count: int, sigma: float, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Normal errors of times (count,) in s, cut off where samples could change places."""
    most = _MOST_LATE / rate_hz
    return np.asarray(np.clip(sigma * rng.standard_normal(count), -most, most))


def _stamped(t: FloatArray, start: float, rate_hz: float, faults: ImuFaults, seed: int) -> FloatArray:
    """Times t (n,) by the IMU's own clock, s; t itself where that is the images' clock."""
    if not (faults.clock_offset_s or faults.clock_drift_ppm or faults.stamp_error_s):
        return t
    error = _bounded(len(t), faults.stamp_error_s, rate_hz, _generator(seed, _STAMPS))
    return round_stamps(t + faults.clock_offset_s + 1e-6 * faults.clock_drift_ppm * (t - start) + error)


def _arriving(count: int, faults: ImuFaults, seed: int) -> npt.NDArray[np.bool_]:
    """Which samples (count,) arrive: losses begin anywhere and last for geometrically many."""
    kept = np.ones(count, bool)
    if faults.dropped:
        begins = _generator(seed, _LOST).random(count) < -math.log1p(-faults.dropped) / faults.dropped_run
        runs = _generator(seed, _RUNS).geometric(1.0 / faults.dropped_run, count)
        first = np.flatnonzero(begins)
        changes = np.zeros(count + 1, np.int64)
        np.add.at(changes, first, 1)
        np.add.at(changes, np.minimum(first + runs[first], count), -1)
        kept = np.cumsum(changes)[:count] == 0
        kept[0] = True
    return kept


def _clip(values: FloatArray, limit: float | None) -> FloatArray:
    return values if limit is None else np.clip(values, -limit, limit)


IMU_TRUTH_CSV, IMU_TRUTH_YAML = "truth/imu.csv", "truth/imu.yaml"
IMU_TRUTH_HEADER = (
    "#taken [ns],timestamp [ns],b_w_x [rad s^-1],b_w_y [rad s^-1],b_w_z [rad s^-1],"
    "b_a_x [m s^-2],b_a_y [m s^-2],b_a_z [m s^-2]"
)
"""First line of truth/imu.csv: when each sample of imu.csv was taken, its stamp, and the biases in it."""

_SAME = (
    "accelerometer_noise_density", "accelerometer_random_walk", "gyroscope_noise_density", "gyroscope_random_walk",
    "accelerometer_range", "gyroscope_range",
)  # fmt: skip
_MATRICES = "gyroscope_matrix", "accelerometer_matrix"


def imu_truth_csv(samples: ImuSamples) -> str:
    """Text of truth/imu.csv."""
    biases = np.column_stack([samples.gyro_bias, samples.accel_bias])
    return _csv(IMU_TRUTH_HEADER, nanoseconds(samples.t), nanoseconds(samples.stamps), values=biases)


def imu_truth_yaml(
    config: ImuConfig, faults: ImuFaults | None, start: float, middle: float, T_image_depth: FloatArray
) -> dict[str, Any]:
    """Content of truth/imu.yaml.

    start: true time of the first sample, s, at which faults.clock_offset_s holds. middle: the stamp of the middle depth
    image, s, at which that file's offset does. T_image_depth (4, 4): the depth images' camera, of registered ones.
    """
    faults = faults or ImuFaults()
    drift = 1e-6 * faults.clock_drift_ppm
    taken = start + (middle - faults.clock_offset_s - start) / (1.0 + drift)  # what is stamped `middle`
    T_imu_depth = se3.inverse(config.T_depth_imu()) @ se3.inverse(T_image_depth)
    return {
        **{name: value for name in _SAME if (value := getattr(config, name)) is not None},
        "update_rate": config.rate_hz,
        "T_imu_depth": [[float(x) + 0.0 for x in row] for row in T_imu_depth],
        "offset_s": taken - middle,
        "drift_ppm": -1e6 * drift / (1.0 + drift) + 0.0,
        **{name: [list(row) for row in getattr(config, name)] for name in _MATRICES},
    } | ({"gravity": float(np.linalg.norm(config.gravity))} if any(config.gravity) else {})
