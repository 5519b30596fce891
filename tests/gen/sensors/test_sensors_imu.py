"""The simulated IMU: exact values against finite differences and an independent integrator, noise by its statistics.

Statistical bounds are five standard deviations of the estimate: a right simulation fails one in two million.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.integrate import cumulative_simpson, solve_ivp
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from rsgen.config.sections import ImuConfig
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.sensors.imu import IMU_CSV_HEADER, ImuSamples, exact_imu, nanoseconds, simulate_imu, write_imu_csv

# A lever arm of 15 cm and a turned sensor.
T_IMU_DEPTH = se3.exp(np.array([0.12, -0.05, 0.07, 0.4, -1.1, 0.6]))
GRAVITY = np.array([0.0, -9.80665, 0.0])
SILENT = {
    "gyroscope_noise_density": 0.0,
    "gyroscope_random_walk": 0.0,
    "accelerometer_noise_density": 0.0,
    "accelerometer_random_walk": 0.0,
}


def config(**fields: object) -> ImuConfig:
    """Without noise, unless asked for."""
    return ImuConfig.model_validate(SILENT | {"T_imu_depth": T_IMU_DEPTH.tolist()} | fields)


def hand_held(seconds: float = 10.0) -> Spline:
    """T_world_depth: a hand's wandering over metres and radians, with a tremor of 5 Hz."""
    dt = 0.05
    t = dt * (np.arange(math.ceil(seconds / dt) + 4) - 1.0)
    position = [0.8 * np.sin(0.7 * t), 0.3 * np.cos(1.1 * t), 0.5 * np.sin(0.4 * t + 1) + 0.003 * np.sin(31 * t)]
    turn = [0.4 * np.sin(0.9 * t), 1.4 * np.sin(0.5 * t + 0.3) + 0.01 * np.sin(29 * t), 0.5 * np.cos(1.3 * t)]
    return Spline(se3.exp(np.stack([*position, *turn], axis=-1)), 0.0, dt)


def resting(seconds: float) -> Spline:
    """T_world_depth = identity."""
    return Spline(np.broadcast_to(np.eye(4), (5, 4, 4)), 0.0, seconds / 2)


def imu_pose(spline: Spline, t: np.ndarray) -> np.ndarray:
    return spline.pose(t) @ np.linalg.inv(T_IMU_DEPTH)


def integrate(samples: ImuSamples, R: np.ndarray, v: np.ndarray, p: np.ndarray) -> tuple[Rotation, np.ndarray]:
    """Strapdown integration with SciPy: rotation (as a quaternion) by an adaptive solver, then two quadratures."""
    rate, force = CubicSpline(samples.t, samples.gyro), CubicSpline(samples.t, samples.accel)

    def quaternion_rate(t: float, q: np.ndarray) -> np.ndarray:
        x, y, z = rate(t)
        return 0.5 * np.array([[0, z, -y, x], [-z, 0, x, y], [y, -x, 0, z], [-x, -y, -z, 0]]) @ q

    end = (samples.t[0], samples.t[-1])
    q = solve_ivp(quaternion_rate, end, R, "DOP853", samples.t, rtol=1e-9, atol=1e-11, max_step=0.05).y.T
    rotations = Rotation.from_quat(q)
    acceleration = rotations.apply(force(samples.t)) + GRAVITY
    velocity = v + cumulative_simpson(acceleration, x=samples.t, axis=0, initial=0)
    return rotations, p + cumulative_simpson(velocity, x=samples.t, axis=0, initial=0)


def test_ten_seconds_integrated_return_to_the_spline() -> None:
    spline = hand_held()
    samples = simulate_imu(spline, config(rate_hz=1000), 0.0, 10.0, seed=1)
    assert len(samples.t) == 10001
    start = imu_pose(spline, np.array([0.0, 1e-4, 2e-4, 3e-4, 4e-4]))[:, :3, 3]
    v0 = np.array([-25, 48, -36, 16, -3]) @ start / 12 / 1e-4
    R0 = Rotation.from_matrix(imu_pose(spline, np.zeros(1))[0, :3, :3]).as_quat()
    rotations, positions = integrate(samples, R0, v0, start[0])
    truth = imu_pose(spline, samples.t)
    off = np.linalg.norm(positions - truth[:, :3, 3], axis=1).max()
    turned = np.degrees((rotations.inv() * Rotation.from_matrix(truth[:, :3, :3])).magnitude().max())
    assert off < 1e-3 and turned < 0.01
    # The motion is worth integrating.
    assert np.ptp(truth[:, :3, 3], axis=0).max() > 1.0 and np.abs(samples.gyro).max() > 1.0


def test_values_are_finite_differences_of_the_poses() -> None:
    spline, h = hand_held(), 1e-3
    # Away from the knots, where the third derivative jumps.
    t = 0.025 + 0.05 * np.arange(3, 190)
    poses = {k: imu_pose(spline, t + k * h) for k in (-2, -1, 0, 1, 2)}
    p = {k: T[:, :3, 3] for k, T in poses.items()}
    R = {k: Rotation.from_matrix(T[:, :3, :3]) for k, T in poses.items()}
    turn = {k: (R[-k].inv() * R[k]).as_rotvec() / (2 * k * h) for k in (1, 2)}
    omega = (4 * turn[1] - turn[2]) / 3
    a = (-p[-2] + 16 * p[-1] - 30 * p[0] + 16 * p[1] - p[2]) / (12 * h * h)
    gyro, force = exact_imu(spline, T_IMU_DEPTH, GRAVITY, t)
    np.testing.assert_allclose(gyro, omega, atol=1e-6)
    np.testing.assert_allclose(force, R[0].inv().apply(a - GRAVITY), atol=1e-6)


def test_at_rest_it_reads_minus_gravity() -> None:
    samples = simulate_imu(resting(2.0), config(), 0.0, 1.0, seed=0)
    np.testing.assert_allclose(samples.gyro, 0, atol=1e-12)
    up = T_IMU_DEPTH[:3, :3] @ [0, 9.80665, 0]
    np.testing.assert_allclose(samples.accel, np.broadcast_to(up, samples.accel.shape), atol=1e-12)


def test_a_lever_arm_feels_the_turn() -> None:
    # Turning about y at 2 rad/s, a sensor 0.3 m along x is drawn to the axis with ω² r.
    spline = Spline(se3.exp(np.outer(np.arange(9) * 0.1, [0, 0, 0, 0, 2.0, 0])), 0.0, 0.1)
    T_imu_body = np.eye(4)
    T_imu_body[0, 3] = -0.3
    gyro, force = exact_imu(spline, T_imu_body, (0, 0, 0), np.array([0.2, 0.33]))
    np.testing.assert_allclose(gyro, [[0, 2, 0]] * 2, atol=1e-12)
    np.testing.assert_allclose(force, [[-1.2, 0, 0]] * 2, atol=1e-12)


def sensors(samples: ImuSamples) -> dict[str, np.ndarray]:
    return {"gyroscope": samples.gyro, "accelerometer": samples.accel}


@pytest.mark.parametrize("name", ["gyroscope", "accelerometer"])
def test_white_noise_has_its_density(name: str) -> None:
    density, rate = 0.013, 400.0
    noisy = config(rate_hz=rate, gravity=(0, 0, 0), **{f"{name}_noise_density": density})
    samples = simulate_imu(resting(250.0), noisy, 0.0, 250.0, seed=5)
    noise = sensors(samples).pop(name)
    n = noise.size
    assert abs(noise.std() / (density * math.sqrt(rate)) - 1) < 5 / math.sqrt(2 * n)
    assert abs((noise[1:] * noise[:-1]).mean() / noise.var()) < 5 / math.sqrt(n)
    assert abs((noise[:, 0] * noise[:, 1]).mean() / noise.var()) < 5 / math.sqrt(len(noise))
    other = sensors(samples)["accelerometer" if name == "gyroscope" else "gyroscope"]
    assert np.abs(other).max() < 1e-9


def allan_deviation(values: np.ndarray, rate: float, tau: float) -> float:
    """Non-overlapping Allan deviation (IEEE Std 952) of columns (n, 3) at averaging time tau, pooled over columns."""
    m = round(tau * rate)
    means = values[: len(values) // m * m].reshape(-1, m, 3).mean(axis=1)
    return math.sqrt(0.5 * np.mean(np.diff(means, axis=0) ** 2))


@pytest.mark.parametrize("rate", [50.0, 200.0])
def test_allan_deviation_is_that_of_the_densities(rate: float) -> None:
    # Kalibr reads the white noise off at σ/√τ and the random walk off at σ √(τ/3), whatever the rate.
    sigma, walk = 2e-3, 4e-3
    still = {"rate_hz": rate, "gravity": (0, 0, 0)}
    white = simulate_imu(resting(1000.0), config(**still, gyroscope_noise_density=sigma), 0.0, 1000.0, seed=2)
    drift = simulate_imu(resting(1000.0), config(**still, accelerometer_random_walk=walk), 0.0, 1000.0, seed=2)
    for tau in (0.5, 2.0):
        # A mean of squares of n correlated differences: at most √3 wider than of independent ones.
        bound = 5 * math.sqrt(3 / (2 * 3 * 1000 / tau))
        assert abs(allan_deviation(white.gyro, rate, tau) / (sigma / math.sqrt(tau)) - 1) < bound
        assert abs(allan_deviation(drift.accel, rate, tau) / (walk * math.sqrt(tau / 3)) - 1) < bound
    np.testing.assert_array_equal(drift.accel, drift.accel_bias)


def test_a_bias_starts_where_it_is_told_and_spreads_with_the_root_of_time() -> None:
    walk, seconds, start = 0.05, 4.0, (0.1, -0.2, 0.3)
    drifting = config(rate_hz=20, gyroscope_random_walk=walk, gyroscope_bias=start)
    ends = []
    for seed in range(300):
        samples = simulate_imu(resting(seconds), drifting, 0.0, seconds, seed)
        np.testing.assert_array_equal(samples.gyro_bias[0], start)
        ends.append(samples.gyro_bias[-1] - start)
    spread = np.array(ends)
    assert abs(spread.std() / (walk * math.sqrt(seconds)) - 1) < 5 / math.sqrt(2 * spread.size)
    assert abs(spread.mean()) < 5 * spread.std() / math.sqrt(spread.size)


def test_errors_add_up_in_order() -> None:
    spline = hand_held(1.0)
    M = ((1.02, 0.0, 0.0), (0.01, 0.97, 0.0), (-0.02, 0.005, 1.0))
    bias = np.array([0.5, 0.0, -1.0])
    plain = simulate_imu(spline, config(), 0.0, 1.0, seed=3)
    bent = simulate_imu(
        spline, config(gyroscope_matrix=M, accelerometer_matrix=M, accelerometer_bias=bias.tolist()), 0.0, 1.0, seed=3
    )
    np.testing.assert_allclose(bent.gyro, np.einsum("ij,nj->ni", M, plain.gyro), atol=1e-12)
    np.testing.assert_allclose(bent.accel, np.einsum("ij,nj->ni", M, plain.accel) + bias, atol=1e-12)
    clipped = simulate_imu(
        spline,
        config(accelerometer_matrix=M, accelerometer_bias=bias.tolist(), accelerometer_range=5),
        0.0,
        1.0,
        seed=3,
    )
    np.testing.assert_allclose(clipped.accel, np.clip(bent.accel, -5, 5), atol=1e-12)
    assert (np.abs(bent.accel) > 5).any()


def test_a_longer_recording_begins_like_a_shorter_one_and_seeds_differ() -> None:
    spline, noisy = hand_held(4.0), ImuConfig()
    short, long = (simulate_imu(spline, noisy, 0.0, end, seed=7) for end in (1.0, 4.0))
    for name in ("t", "gyro", "accel", "gyro_bias", "accel_bias"):
        np.testing.assert_array_equal(getattr(short, name), getattr(long, name)[: len(short.t)])
    other = simulate_imu(spline, noisy, 0.0, 1.0, seed=8)
    assert not np.isclose(other.gyro, short.gyro, atol=1e-12).any()
    white = short.gyro - short.gyro_bias - exact_imu(spline, np.eye(4), noisy.gravity, short.t)[0]
    walk = np.diff(short.gyro_bias, axis=0)
    assert abs(np.corrcoef(white[1:].ravel(), walk.ravel())[0, 1]) < 5 / math.sqrt(walk.size)


@pytest.mark.parametrize("begin", [0.0, -0.0151234567891, 0.3333333333333])
def test_samples_lie_on_whole_nanoseconds_within_the_span(begin: float) -> None:
    spline = Spline(np.broadcast_to(np.eye(4), (24, 4, 4)), begin, 0.05)
    samples = simulate_imu(spline, config(rate_hz=300), spline.t_begin, spline.t_end, seed=0)
    assert spline.t_begin <= samples.t[0] < spline.t_begin + 2e-9
    assert spline.t_end - 1 / 300 - 2e-9 < samples.t[-1] <= spline.t_end
    np.testing.assert_allclose(np.diff(samples.t), 1 / 300, atol=1.1e-9)
    assert [float(f"{t:.9f}") for t in samples.t[:-1]] == samples.t[:-1].tolist()


def test_csv_reads_back(tmp_path: Path) -> None:
    samples = simulate_imu(hand_held(1.0), ImuConfig(), 0.0, 1.0, seed=1)
    write_imu_csv(tmp_path / "imu.csv", samples, epoch_s=1_000_000_000)
    lines = (tmp_path / "imu.csv").read_text().splitlines()
    assert lines[0] == IMU_CSV_HEADER and len(lines) == 202
    assert lines[2].split(",")[0] == "1000000000005000000"
    table = np.loadtxt(tmp_path / "imu.csv", delimiter=",")
    np.testing.assert_allclose(table[:, 1:], np.column_stack([samples.gyro, samples.accel]), rtol=1e-11, atol=1e-12)
    with pytest.raises(UserError, match=r"cannot be written"):
        write_imu_csv(tmp_path / "nowhere" / "imu.csv", samples)


def test_nanoseconds_are_exact() -> None:
    assert nanoseconds([0.033333333, -0.015, 999999.999999999]) == [33333333, -15000000, 999999999999999]
    assert nanoseconds([0.1], 1_700_000_000) == [1_700_000_000_100_000_000]


@pytest.mark.parametrize(
    "wrong",
    [
        {"rate_hz": 0},
        {"rate_hz": float("nan")},
        {"gyroscope_noise_density": -1e-3},
        {"accelerometer_random_walk": float("inf")},
        {"gravity": (0, float("nan"), 0)},
        {"gyroscope_range": 0},
        {"T_imu_depth": np.diag([1.0, 1.0, -1.0, 1.0]).tolist()},
        {"T_imu_depth": np.diag([1.01, 1.0, 1.0, 1.0]).tolist()},
        {"T_imu_depth": np.vstack([T_IMU_DEPTH[:3], [1, 0, 0, 1]]).tolist()},
        {"T_imu_depth": np.full((4, 4), 1e308).tolist()},
        {"noise": 1},
    ],
)
def test_absurd_settings_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        ImuConfig.model_validate(wrong)


@pytest.mark.parametrize(
    "call",
    [
        lambda spline: simulate_imu(spline, ImuConfig(), 0.0, 1.2, 0),
        lambda spline: simulate_imu(spline, ImuConfig(), 0.5, 0.4, 0),
        lambda spline: simulate_imu(spline, ImuConfig(), 0.0, float("nan"), 0),
        lambda spline: simulate_imu(replace(spline, dt=1e6), ImuConfig(), 0.0, 1e6, 0),
    ],
)
def test_times_that_do_not_fit_are_one_line(call: Callable[[Spline], object]) -> None:
    with pytest.raises(UserError) as error:
        call(hand_held(1.0))
    assert "\n" not in str(error.value)
