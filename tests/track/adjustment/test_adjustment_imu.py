"""An IMU in the graph of a whole recording: against SciPy's least squares and finite differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from rsgen.array_types import FloatArray
from rsgen.geometry import se3, so3
from rsgen.geometry.spline import Spline
from rsgen.sensors.imu import exact_imu
from rstrack.adjustment import imu as imu_module
from rstrack.adjustment.graph import Graph, Sighting, State
from rstrack.adjustment.imu import Equations, ImuState, ImuTerm
from rstrack.data.imu.description import ImuNoise
from rstrack.data.imu.recording import ImuRecording
from rstrack.inertial.estimate import STRENGTH, WARMS

T_IMU_DEPTH = se3.exp([0.03, -0.02, 0.05, 0.3, -1.2, 0.7])
GRAVITY = np.array([1.0, -9.0, 3.5])
NOISE = ImuNoise(1e-4, 1e-3, 1e-3, 1e-2)
DT, PER, POINTS, KNOTS = 0.025, 2, 8, 4


def moving(seed: int, count: int = POINTS) -> Spline:
    """A wild motion."""
    rng, points = np.random.default_rng(seed), [np.eye(4)]
    for _ in range(count - 1):
        points.append(points[-1] @ se3.exp(rng.normal(0.0, [0.01] * 3 + [0.05] * 3)))
    return Spline(np.array(points), 0.0, DT)


def unit_on(spline: Spline, told: ImuState, seed: int, gap: tuple[float, float] = (1.0, 1.0)) -> ImuTerm:
    """A unit that reads what the spline says, with noise; but in a gap, s, and one reading that is none."""
    t = np.arange(spline.t_begin + 1e-3, spline.t_end, 0.005)
    t = t[(t < gap[0]) | (t >= gap[1])]
    gyro, accel = exact_imu(spline, told.T_imu_depth, told.gravity, t)
    read = (1.0 + told.scales) * np.concatenate([gyro, accel], axis=1) + bias_at(spline, told, t)
    read += np.random.default_rng(seed).normal(0.0, np.repeat([2e-3, 2e-2], 3), read.shape)
    read[4, 1] = np.nan
    recording = ImuRecording(t, read[:, :3], read[:, 3:], NOISE, T_IMU_DEPTH, 200.0, float(np.linalg.norm(GRAVITY)))
    unit = ImuTerm.of(recording, spline, np.array([[-1.0, 9.0]]))
    assert unit is not None
    return replace(unit, sigma=np.array([2e-3, 2e-2]), per=PER)


def bias_at(spline: Spline, told: ImuState, t: FloatArray) -> FloatArray:
    knots = spline.t_begin + DT * PER * np.arange(len(told.biases))
    return np.stack([np.interp(t, knots, axis) for axis in told.biases.T], axis=1)


def true_state(seed: int, knots: int = KNOTS, walks: float = 5.0) -> ImuState:
    """Biases that walk so many times as far as they should; the unit sits elsewhere than is told, by half a σ or so."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(0.0, walks * (DT * PER) ** 0.5 * np.repeat([1e-3, 1e-2], 3), (knots, 6))
    biases = rng.normal(0.0, np.repeat([0.02, 0.1], 3)) + np.cumsum(steps, axis=0)
    off = rng.normal(0.0, imu_module._PLACE)
    return ImuState(biases, GRAVITY, se3.exp(off) @ T_IMU_DEPTH, rng.normal(0.0, imu_module._SCALE, 6))


def whitened(unit: ImuTerm, spline: Spline, told: ImuState) -> FloatArray:
    """Residuals in σ, from the generator's sensor."""
    gyro, force = exact_imu(spline, told.T_imu_depth, told.gravity, unit.samples.t)
    felt = (1.0 + told.scales) * np.concatenate([gyro, force], axis=1)
    r = felt + bias_at(spline, told, unit.samples.t) - unit.samples.values
    return (r * unit.samples.counts / np.repeat(unit.sigma, 3)).ravel()


def summed(unit: ImuTerm, spline: Spline, told: ImuState) -> tuple[FloatArray, FloatArray]:
    """H and g over control points and the unit's own blocks, the last three of which are nothing's."""
    size = POINTS + len(told)
    H, g = np.zeros((size, 6, size, 6)), np.zeros((size, 6))
    parts: list[Equations] = list(unit.equations(spline, told))
    for sums in parts:
        for numbers, block, gradient in zip(sums.numbers, sums.H, sums.g, strict=True):
            k = len(numbers)
            for a in range(k):
                g[numbers[a]] += gradient.reshape(k, 6)[a]
                for b in range(k):
                    H[numbers[a], :, numbers[b]] += block.reshape(k, 6, k, 6)[a, :, b]
    return H.reshape(6 * size, -1), g.ravel()


def test_sums_are_those_of_finite_differences(monkeypatch: pytest.MonkeyPatch) -> None:
    spline, told = moving(5), true_state(6)
    unit = unit_on(moving(7), true_state(9), 8, (0.03, 0.06))
    step, columns = 1e-6, []
    for i in range(6 * (POINTS + len(told))):
        ends = []
        for side in (-step, step):
            x = np.zeros((POINTS + len(told), 6))
            x.flat[i] = side
            state = State(spline, {}, told).moved(x[:POINTS], np.zeros((0, 6)), x[POINTS:])
            assert state.imu is not None
            ends.append(whitened(unit, state.spline, state.imu))
        columns.append((ends[1] - ends[0]) / (2.0 * step))
    J, r = np.stack(columns, axis=1), whitened(unit, spline, told)
    H, g = summed(unit, spline, told)
    np.testing.assert_allclose(H, J.T @ J, atol=1e-6 * np.abs(H).max())
    np.testing.assert_allclose(g, J.T @ r, atol=1e-6 * np.abs(g).max())
    assert not H[:, -3:].any() and (np.diag(H)[:-3] > 0.0).all()
    # A few at a time are the same.
    monkeypatch.setattr(imu_module, "_AT_ONCE", 7)
    few_H, few_g = summed(unit, spline, told)
    np.testing.assert_allclose(few_H, H, rtol=1e-12, atol=1e-12 * np.abs(H).max())
    np.testing.assert_allclose(few_g, g, rtol=1e-12, atol=1e-12 * np.abs(g).max())


def sightings_of(truth: Spline, rng: np.random.Generator, sigma: float, count: int) -> list[Sighting]:
    """The camera as it was found now and then against keyframe 5, which is at the world's origin."""
    times, information = np.linspace(0.01, truth.t_end - 0.01, count), np.eye(6) / sigma**2
    T = truth.pose(times) @ se3.exp(rng.normal(0.0, sigma, (count, 6)))
    return [Sighting(5, float(t), each, information) for t, each in zip(times, T, strict=True)]


def test_what_is_believed_is_as_far_off_as_it_says() -> None:
    scores, sigmas = [], []
    for seed in range(10):
        truth, told = moving(seed, 24), true_state(seed, 12, 1.0)
        unit = unit_on(truth, told, seed)
        state = State(truth, {5: np.eye(4)}, unit.start(truth))
        sightings = sightings_of(truth, np.random.default_rng(seed), 3e-4, 20)
        graph = Graph(state, (), sightings, keeps_motion=False, imu=unit)
        for _ in range(4):
            state, _ = graph.step(state)
        found = graph.found(state)
        assert found is not None and state.imu is not None
        off = [se3.log(found.state.T_imu_depth @ se3.inverse(told.T_imu_depth)), found.state.scales - told.scales]
        turn = so3.log(told.T_imu_depth[:3, :3] @ unit.recording.T_imu_depth[:3, :3].T)
        estimated = found.estimate.mean - np.concatenate([told.biases[-1], told.gravity, turn])
        scores.append([*(estimated / found.estimate.sigmas), *(np.concatenate(off) / found.sigmas)])
        sigmas.append(unit.learnt(state.spline, state.imu).sigma)
    squares = np.square(scores).mean(axis=0)
    assert 0.6 < squares[:3].mean() < 1.5 and 0.6 < squares[9:].mean() < 1.5
    assert 0.2 < squares[3:9].mean() < 1.5  # the prior of biases is wider than these are
    # The motion is one that the spline can follow: readings scatter by their noise, of which it follows a part.
    np.testing.assert_allclose(np.mean(sigmas, axis=0), [2e-3, 2e-2], rtol=0.1)


def test_readings_count_where_the_track_is_known() -> None:
    truth = moving(1)
    recording = unit_on(truth, true_state(2), 3).recording
    unit = ImuTerm.of(recording, truth, np.array([[-1.0, 0.03], [0.08, 0.1]]))
    assert unit is not None
    t = recording.t
    np.testing.assert_array_equal(unit.samples.t, t[(t < 0.03) | ((t >= 0.08) & (t < 0.1))])
    assert ImuTerm.of(recording, truth, np.array([[5.0, 6.0]])) is None
    # An accelerometer alone is to change nothing, as when tracking.
    assert ImuTerm.of(replace(recording, gyro=None), truth, np.array([[-1.0, 9.0]])) is None


def test_steps_end_where_least_squares_do() -> None:
    truth = moving(1)
    unit = unit_on(truth, true_state(2), 3, (0.05, 0.07))
    rng = np.random.default_rng(4)
    sightings = []
    for t in np.linspace(0.01, truth.t_end - 0.01, 4):
        root = rng.normal(size=(6, 8))
        T = truth.pose(t) @ se3.exp(rng.normal(0.0, 1e-3, 6))
        sightings.append(Sighting(5, float(t), T, 1e5 * root @ root.T))
    begin = Spline(se3.exp(rng.normal(0.0, 2e-3, (POINTS, 6))) @ truth.control_points, 0.0, DT)
    at = State(begin, {5: np.eye(4)}, unit.start(begin))
    assert at.imu is not None and len(at.imu) == KNOTS + 3
    graph = Graph(at, (), sightings, keeps_motion=False, imu=unit)
    found = at
    for _ in range(12):
        found, x = graph.step(found)
    assert np.abs(x[: POINTS + 1]).max() < 1e-9
    assert np.abs(found.spline.control_points - begin.control_points).max() > 1e-3
    parts = np.cumsum([6 * POINTS, 6])

    def moved(x: FloatArray) -> State:
        points, keyframes, others = np.split(x, parts)
        return found.moved(points.reshape(-1, 6), keyframes.reshape(-1, 6), others.reshape(-1, 6))

    def residuals(x: FloatArray) -> FloatArray:
        state = moved(x)
        assert state.imu is not None
        out = [whitened(unit, state.spline, state.imu)]
        for s in sightings:
            T = se3.inverse(state.keyframes[s.keyframe]) @ state.spline.pose(s.t)
            out.append(np.linalg.cholesky(s.information).T @ se3.log(se3.inverse(s.T_ref_cam) @ T))
        omega = state.spline.increments
        sigma = np.repeat(unit.accelerations[None] * DT**2, len(omega) - 1, axis=0)
        sigma[:2] *= 0.1
        sigma[-2:] *= 0.1
        out.append(((omega[1:] - omega[:-1]) / sigma).ravel())
        out.append(1e7 * x[:6])  # the gauge
        seconds = DT * PER
        walk = np.hypot([1e-3 * seconds**0.5, 1e-2 * seconds**0.5], np.array(WARMS) * seconds)
        out.append((np.diff(state.imu.biases, axis=0) / np.repeat(walk, 3)).ravel())
        out.append(state.imu.biases[0] / np.repeat([0.1, 0.6], 3))
        out.append(np.atleast_1d((np.linalg.norm(state.imu.gravity) - np.linalg.norm(GRAVITY)) / STRENGTH))
        out.append(se3.log(state.imu.T_imu_depth @ se3.inverse(T_IMU_DEPTH)) / imu_module._PLACE)
        out.append(state.imu.scales / imu_module._SCALE)
        out.append(x[-3:])  # what says nothing
        return np.concatenate(out)

    size = 6 * (POINTS + 1 + KNOTS + 3)
    best = least_squares(residuals, np.zeros(size), x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12)
    expected = moved(best.x)
    np.testing.assert_allclose(found.spline.control_points, expected.spline.control_points, atol=1e-7)
    assert found.imu is not None and expected.imu is not None
    np.testing.assert_allclose(found.imu.biases, expected.imu.biases, atol=1e-6)
    np.testing.assert_allclose(found.imu.gravity, expected.imu.gravity, atol=1e-5)
    np.testing.assert_allclose(found.imu.T_imu_depth, expected.imu.T_imu_depth, atol=1e-6)
    np.testing.assert_allclose(found.imu.scales, expected.imu.scales, atol=1e-6)
