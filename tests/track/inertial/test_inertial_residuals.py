"""IMU residuals on the spline: values against the generator's, derivatives against finite differences, sums."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from util import numeric_jacobian

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.sensors.imu import exact_imu
from rstrack.data.imu.description import ImuNoise
from rstrack.data.imu.recording import ImuRecording
from rstrack.inertial.band import ImuReadings
from rstrack.inertial.estimate import SIZE, ImuEstimate
from rstrack.inertial.factor import ImuFactor, ImuResiduals, motion

T_IMU_DEPTH = se3.exp([0.03, -0.02, 0.05, 0.3, -1.2, 0.7])
GRAVITY = np.array([1.0, -9.0, 3.5])
BIAS = np.array([0.01, -0.02, 0.03, 0.1, 0.2, -0.3])
TURN = np.array([0.2, -0.1, 0.15])


def random_motion(seed: int = 0, count: int = 9, first: int = 0) -> Spline:
    rng = np.random.default_rng(seed)
    points = [np.eye(4)]
    for _ in range(count - 1):
        points.append(points[-1] @ se3.exp(rng.normal(0.0, [0.1] * 3 + [0.3] * 3)))
    return Spline(np.array(points), -0.1, 0.05, first)


def recording(spline: Spline, t: FloatArray, noise: ImuNoise | None = None) -> ImuRecording:
    """Of a unit that is turned by TURN where T_IMU_DEPTH has it, about itself."""
    T = T_IMU_DEPTH.copy()
    T[:3] = Rotation.from_rotvec(TURN).as_matrix() @ T[:3]
    gyro, accel = exact_imu(spline, T, GRAVITY, t)
    noise = noise or ImuNoise(1e-4, 1e-5, 1e-3, 1e-4)
    return ImuRecording(t, gyro + BIAS[:3], accel + BIAS[3:], noise, T_IMU_DEPTH, 200.0)


def test_motion_is_the_splines() -> None:
    spline = random_motion(first=5)
    t = np.linspace(spline.t_begin, spline.t_end, 23)
    at = motion(spline, t)
    np.testing.assert_allclose(at.twist, spline.velocity(t), atol=1e-12)
    np.testing.assert_allclose(at.rate, spline.acceleration(t), atol=1e-10)
    np.testing.assert_allclose(at.rotation, spline.pose(t)[:, :3, :3], atol=1e-14)


def test_derivatives_of_the_factor_are_finite_differences() -> None:
    """By the control points, T_imu_depth's left increment, gravity, and of the gyroscope by time."""
    spline, n = random_motion(3), len(random_motion(3).control_points)
    t = spline.t_begin + 0.05 * np.repeat(np.arange(5), 3) + np.tile([0.005, 0.025, 0.045], 5)

    def factor(x: FloatArray) -> ImuFactor:
        points, place, gravity, late = np.split(x, [6 * n, 6 * n + 6, 6 * n + 9])
        there = Spline(se3.exp(points.reshape(n, 6)) @ spline.control_points, spline.t0, spline.dt)
        return ImuFactor(motion(there, t + late), se3.exp(place) @ T_IMU_DEPTH, GRAVITY + gravity)

    numeric = numeric_jacobian(lambda x: factor(x).readings, 6 * n + 10, 1e-4)
    at = factor(np.zeros(6 * n + 10))
    by_points = np.zeros((len(t), 6, 6 * n))
    for k, first in enumerate(at.motion.first):
        by_points[k, :, 6 * first : 6 * first + 24] = at.by_motion[k]
    J = np.concatenate([by_points, at.by_translation, at.by_rotation, at.by_gravity], axis=2)
    # Rates go with 1/dt, accelerations with 1/dt²: 20 and 400.
    np.testing.assert_allclose(J[:, :3], numeric[:, :3, :-1], atol=1e-7)
    np.testing.assert_allclose(J[:, 3:], numeric[:, 3:, :-1], atol=1e-5)
    np.testing.assert_allclose(at.gyro_by_time, numeric[:, :3, -1], atol=1e-5)
    assert np.abs(at.by_motion[:, 3:]).max() > 100.0


def test_residuals_vanish_at_the_truth_and_have_the_derivatives_by_an_estimate() -> None:
    spline, estimate = random_motion(), np.concatenate([BIAS, GRAVITY, TURN])
    readings = ImuReadings.of(recording(spline, np.linspace(spline.t_begin, spline.t_end, 40)))

    def residuals(x: FloatArray) -> ImuResiduals:
        return ImuResiduals.of(spline, readings, T_IMU_DEPTH, estimate + x)

    at = residuals(np.zeros(SIZE))
    assert np.abs(at.r).max() < 1e-11
    np.testing.assert_allclose(at.J[:, :, 24:], numeric_jacobian(lambda x: residuals(x).r, SIZE), atol=1e-7)


def test_sums_are_the_dense_least_squares() -> None:
    spline = random_motion(3)
    samples = ImuReadings.of(recording(random_motion(4), np.linspace(spline.t_begin + 0.06, spline.t_end, 50)))
    estimate, sigma = ImuEstimate.initial(GRAVITY), np.array([0.01, 0.2])
    rows = ImuResiduals.of(spline, samples, T_IMU_DEPTH, estimate.mean)
    joint = rows.summed(sigma)
    assert joint is not None and joint.first == 1 and joint.count == len(spline.control_points) - 1
    r, J, first = rows.r, rows.J, rows.first
    change = np.random.default_rng(5).normal(0.0, 0.1, SIZE) * (np.arange(SIZE) < 9)
    expected = ImuResiduals.of(spline, samples, T_IMU_DEPTH, estimate.mean + change).r
    np.testing.assert_allclose(rows.after(change), expected, atol=1e-9)
    dense = np.zeros((len(r), 6, 6 * joint.count + SIZE))
    for k, at in enumerate(first - 1):
        dense[k, :, 6 * at : 6 * at + 24], dense[k, :, -SIZE:] = J[k, :, :24], J[k, :, 24:]
    scaled = (dense / np.repeat(sigma, 3)[:, None]).reshape(-1, dense.shape[2])
    target = (r / np.repeat(sigma, 3)).ravel()
    np.testing.assert_allclose(joint.H, scaled.T @ scaled, rtol=1e-9, atol=1e-6 * np.abs(joint.H).max())
    np.testing.assert_allclose(joint.g, scaled.T @ target, rtol=1e-9, atol=1e-9 * np.abs(joint.g).max())
    assert joint.cost == pytest.approx(0.5 * float(target @ target))


def test_belief_is_eliminated_as_if_it_were_solved_for() -> None:
    spline = random_motion(3)
    samples = ImuReadings.of(recording(random_motion(4), np.linspace(spline.t_begin, spline.t_end, 50)))
    rng, estimate = np.random.default_rng(0), ImuEstimate.initial(GRAVITY)
    at = estimate.mean + rng.normal(0.0, 0.1, SIZE)
    joint = ImuResiduals.of(spline, samples, T_IMU_DEPTH, at).summed(np.array([0.01, 0.2]))
    assert joint is not None
    model, cost, nine = joint.without_imu(estimate, at)
    H, g, known = joint.H, joint.g, estimate.information
    c, z, off = slice(0, -SIZE), slice(-SIZE, None), at - estimate.mean
    for step in (rng.normal(0.0, 1e-3, len(model.g)), np.zeros(len(model.g))):
        best = -np.linalg.solve(H[z, z] + known, g[z] + known @ off + H[z, c] @ step)
        whole = np.concatenate([step, best])
        expected = joint.cost + g @ whole + 0.5 * whole @ H @ whole + 0.5 * (best + off) @ known @ (best + off)
        assert cost + model.g @ step + 0.5 * step @ model.H @ step == pytest.approx(expected, rel=1e-9)
    np.testing.assert_allclose(nine, at + best, rtol=1e-9)


def test_saturated_and_missing_readings_do_not_count() -> None:
    t = np.array([0.0, 0.1])
    noise = ImuNoise(1e-4, 1e-5, 1e-3, 1e-4, gyro_range=4.0, accel_range=20.0)
    gyro = np.array([[4.0, 3.9, -4.0], [np.nan, 0.0, 0.0]])
    accel = np.array([[0.0, -20.0, 19.0], [np.inf, 0.0, 0.0]])
    samples = ImuReadings.of(ImuRecording(t, gyro, accel, noise, np.eye(4), 10.0))
    np.testing.assert_array_equal(samples.counts, [[0, 1, 0, 1, 0, 1], [0, 1, 1, 0, 1, 1]])
    assert np.isfinite(samples.values).all()
    without = ImuReadings.of(ImuRecording(t, None, accel[:1].repeat(2, 0), noise, np.eye(4), 10.0))
    assert not without.counts[:, :3].any() and without.counts[:, 3:].any()


def test_gravity_of_a_known_strength_is_on_its_sphere() -> None:
    start = ImuEstimate.initial(np.array([0.0, -9.0, 0.0]))
    more = np.repeat([0.0, 0.0, 4.0, 0.0], 3)
    told = ImuEstimate(np.concatenate([BIAS, [3.0, -9.0, 4.0], TURN]), start.information + np.diag(more))
    found = told.of_strength(9.80665)
    assert np.linalg.norm(found.mean[6:9]) == pytest.approx(9.80665, abs=2e-3)
    # All directions were known alike: the nearest point of the sphere is the best.
    np.testing.assert_allclose(found.direction, told.direction, atol=1e-6)


def test_rows_are_moved_as_if_they_were_linearised_anew() -> None:
    """To second order: steps half as long are off by a quarter."""
    spline = random_motion(3)
    imu = recording(spline, np.linspace(spline.t_begin, spline.t_end, 40))
    estimate = np.concatenate([BIAS, GRAVITY, TURN])
    rows = ImuResiduals.of(spline, ImuReadings.of(imu), T_IMU_DEPTH, estimate)
    step = np.random.default_rng(4).normal(0.0, 1e-3, (len(spline.control_points), 6))
    off = []
    for part in (1.0, 0.5):
        T = se3.exp(part * step) @ spline.control_points
        expected = ImuResiduals.of(Spline(T, spline.t0, spline.dt), rows.samples, T_IMU_DEPTH, estimate)
        off.append(np.abs(rows.moved(0, part * step).r - expected.r).max())
    assert 0.0 < off[1] < 0.27 * off[0] < 0.05 * np.abs(expected.r - rows.r).max()
    early = rows.until(float(imu.t[7]))
    assert len(early.samples) == len(early.r) == 7
    np.testing.assert_array_equal(early.r, rows.r[:7])
