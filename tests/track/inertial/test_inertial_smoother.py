"""Biases and gravity beside a spline: against SciPy's least squares, against dense algebra, and over many seeds."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares, minimize
from scipy.spatial.transform import Rotation

from rsgen.array_types import FloatArray
from rsgen.config.sections import ImuConfig
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.sensors.imu import exact_imu, simulate_imu
from rstrack.alignment.normal_equations import Quadratic
from rstrack.alignment.priors import pose_constraint
from rstrack.alignment.spline_state import SplineState
from rstrack.data.imu.description import ImuNoise
from rstrack.data.imu.recording import ImuRecording
from rstrack.inertial.band import ImuReadings
from rstrack.inertial.estimate import SIZE, TURN, TURNED, ImuEstimate, is_contradicted, text
from rstrack.inertial.estimate import STRENGTH as STRENGTH_SIGMA
from rstrack.inertial.factor import ImuResiduals
from rstrack.inertial.inertia import Inertia
from rstrack.inertial.smoother import ReusedPrior, Smoother

GRAVITY = np.array([2.0, -8.6, 4.262])
STRENGTH = float(np.linalg.norm(GRAVITY))
BIAS = np.array([0.01, -0.008, 0.006, 0.1, -0.07, 0.05])
DT, POSE_SIGMA = 0.025, np.repeat([3e-4, 3e-4], 3)


def hand_held(seconds: float, seed: int) -> Spline:
    """Sways of some centimetres and degrees, up to 2 Hz."""
    rng = np.random.default_rng(seed)
    t = DT * (np.arange(int(seconds / DT) + 4) - 1)
    frequency, phase = rng.uniform(0.2, 2.0, (6, 4)), rng.uniform(0.0, 6.3, (6, 4))
    size = np.repeat([0.03, 0.1], 3)[:, None] / (1.0 + frequency)
    twists = (size[..., None] * np.sin(2 * np.pi * frequency[..., None] * t + phase[..., None])).sum(axis=1).T
    return Spline(se3.exp(twists), -DT, DT)


def recording(spline: Spline, seed: int, walk: float = 1.0, turn: FloatArray | None = None) -> ImuRecording:
    """turn (3,): rad, in its axes, by which the unit is turned from where its T_imu_depth has it."""
    config = ImuConfig(
        gravity=tuple(GRAVITY), T_imu_depth=tuple(map(tuple, se3.exp([0.01, 0.02, -0.01, 0.1, 0.2, 1.5]).tolist())),
        gyroscope_noise_density=7e-5, gyroscope_random_walk=walk * 1e-5, accelerometer_noise_density=1e-3,
        accelerometer_random_walk=walk * 1e-4, gyroscope_bias=tuple(BIAS[:3]), accelerometer_bias=tuple(BIAS[3:]),
    )  # fmt: skip
    read = simulate_imu(spline, config, spline.t_begin, spline.t_end, seed)
    noise = ImuNoise(7e-5, max(walk, 1e-3) * 1e-5, 1e-3, max(walk, 1e-3) * 1e-4)
    T_imu_depth = turned(se3.inverse(config.T_depth_imu()), np.zeros(3) if turn is None else -turn)
    return ImuRecording(read.t, read.gyro, read.accel, noise, T_imu_depth, 200.0, STRENGTH)


def turned(T_imu_depth: FloatArray, turn: FloatArray) -> FloatArray:
    """T_imu_depth of a unit that is turned in its place, rad in its axes."""
    T = T_imu_depth.copy()
    T[:3] = Rotation.from_rotvec(turn).as_matrix() @ T_imu_depth[:3]
    return T


def seen_poses(spline: Spline, rng: np.random.Generator, every: float = 1 / 30) -> list[tuple[float, FloatArray]]:
    times = np.arange(spline.t_begin + 0.01, spline.t_end, every)
    errors = POSE_SIGMA * rng.standard_normal((len(times), 6))
    return list(zip(times.tolist(), se3.exp(errors) @ spline.pose(times), strict=True))


def test_a_small_problem_is_solved_as_by_scipy() -> None:
    truth = hand_held(0.05, 1)
    imu, poses = recording(truth, 2), seen_poses(truth, np.random.default_rng(3), 0.01)
    times, T_seen = np.array([t for t, _ in poses]), np.array([T for _, T in poses])
    samples, sigma = ImuReadings.of(imu), np.array([2e-3, 0.03])
    start = ImuEstimate.initial(GRAVITY + np.array([0.5, -0.3, 0.4]))
    first = Spline(se3.exp(np.random.default_rng(4).normal(0.0, 2e-3, (len(truth.control_points), 6)))
                   @ truth.control_points, truth.t0, truth.dt)  # fmt: skip
    count = len(first.control_points)

    def cost(x: FloatArray) -> FloatArray:
        moved = Spline(se3.exp(x[:-SIZE].reshape(-1, 6)) @ first.control_points, first.t0, first.dt)
        estimate = start.mean + x[-SIZE:]
        gyro, force = exact_imu(moved, turned(imu.T_imu_depth, estimate[9:]), estimate[6:9], samples.t)
        r = np.concatenate([gyro, force], axis=1) + estimate[:6] - samples.values
        seen = se3.log(moved.pose(times) @ se3.inverse(T_seen)) / POSE_SIGMA
        known = (estimate - start.mean) * np.sqrt(np.diag(start.information))
        return np.concatenate([(r / np.repeat(sigma, 3)).ravel(), seen.ravel(), known])

    expected = least_squares(cost, np.zeros(6 * count + SIZE), x_scale="jac", method="trf", xtol=1e-14, ftol=1e-14)
    state, estimate = SplineState(first), start.mean.copy()
    for _ in range(5):
        smoother = Smoother.start(start)
        smoother.around(estimate)
        smoother.reach(state, 0, count)
        for t, T in poses:
            smoother.add(pose_constraint(state.spline, t, T, POSE_SIGMA)[0])
        joint = ImuResiduals.of(state.spline, samples, imu.T_imu_depth, estimate).summed(sigma)
        assert joint is not None
        smoother.add(joint)
        step = -np.linalg.solve(smoother.H, smoother.g)
        np.testing.assert_allclose(smoother.marginal().mean, estimate + step[-SIZE:], atol=1e-8)
        state.apply(0, step[:-SIZE].reshape(-1, 6))
        estimate = estimate + step[-SIZE:]
    best = Spline(se3.exp(expected.x[:-SIZE].reshape(-1, 6)) @ first.control_points, first.t0, first.dt)
    np.testing.assert_allclose(estimate, start.mean + expected.x[-SIZE:], atol=1e-5)
    t = np.linspace(best.t_begin, best.t_end, 20)
    np.testing.assert_allclose(state.spline.pose(t), best.pose(t), atol=1e-7)


def filled(seed: int = 0) -> Smoother:
    rng = np.random.default_rng(seed)
    smoother = Smoother.start(ImuEstimate.initial(GRAVITY))
    smoother.reach(SplineState.still(0.0, DT, np.eye(4), 6), 0, 6)
    size = 36 + SIZE
    root = rng.normal(0.0, 1.0, (2 * size, size))
    smoother.H, smoother.g = smoother.H + root.T @ root, rng.normal(0.0, 1.0, size)
    return smoother


def test_marginalising_leaves_the_rest_as_it_was() -> None:
    smoother = filled()
    covariance, mean = np.linalg.inv(smoother.H), -np.linalg.solve(smoother.H, smoother.g)
    for first in (2, 3, 5):
        smoother.marginalise(first)
        rest = slice(6 * first, None)
        np.testing.assert_allclose(np.linalg.inv(smoother.H), covariance[rest, rest], atol=1e-9)
        np.testing.assert_allclose(-np.linalg.solve(smoother.H, smoother.g), mean[rest], atol=1e-9)
    assert smoother.first == 5 and smoother.last == 6


def test_walks_and_shifts_add_to_covariances_and_leave_means() -> None:
    smoother = filled(1)
    before, mean = np.linalg.inv(smoother.H), -np.linalg.solve(smoother.H, smoother.g)
    variance = np.array([0.1, 0.2, 0.3, 0.0, 0.0, 0.4, 0.0, 0.0, 0.0, 0.0, 0.5, 0.0])
    smoother.diffuse(variance)
    root = np.random.default_rng(2).normal(0.0, 0.1, (6, 6))
    smoother.shift(root @ root.T)
    ways = np.concatenate([np.tile(np.eye(6), (6, 1)), np.zeros((SIZE, 6))])
    for i, axis in enumerate(np.eye(3)):
        ways[42:45, 3 + i] = np.cross(axis, smoother.estimate[6:9])
    expected = before + np.diag(np.concatenate([np.zeros(36), variance])) + ways @ root @ root.T @ ways.T
    np.testing.assert_allclose(np.linalg.inv(smoother.H), expected, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(-np.linalg.solve(smoother.H, smoother.g), mean, atol=1e-8)


def test_a_shift_less_than_nothing_takes_nothing_away() -> None:
    """On imu_fast differences of keyframes' covariances had negative eigenvalues, then the biases' variances."""
    smoother, twin = filled(4), filled(4)
    axes = np.linalg.qr(np.random.default_rng(5).normal(size=(6, 6)))[0]
    smoother.shift((axes * [1e-3, 2e-3, 0.0, -1e-3, -0.5, 4e-3]) @ axes.T)
    twin.shift((axes * [1e-3, 2e-3, 0.0, 0.0, 0.0, 4e-3]) @ axes.T)
    assert np.linalg.eigvalsh(smoother.H)[0] > 0.0
    np.testing.assert_allclose(smoother.H, twin.H, rtol=1e-9, atol=1e-9)


def test_without_biases_and_gravity_the_rest_is_as_if_these_were_best() -> None:
    """Against SciPy's minimum over all of the estimate, gravity's strength a measurement, at several places."""
    smoother = filled(6)
    model, gained = smoother.without_imu(STRENGTH)
    u = np.concatenate([np.zeros(6), smoother.estimate[6:9] / STRENGTH, np.zeros(3)])

    def cost(x: FloatArray) -> float:
        off = (u @ (smoother.estimate + x[-SIZE:]) - STRENGTH) / STRENGTH_SIGMA
        return float(0.5 * x @ smoother.H @ x + smoother.g @ x + 0.5 * off**2)

    assert (model.first, model.last) == (0, 6)
    for seed in range(4):
        step = np.random.default_rng(seed).normal(0.0, 0.3 * (seed > 0), 36)
        best = minimize(lambda rest, step=step: cost(np.concatenate([step, rest])), np.zeros(SIZE), tol=1e-12).fun
        told = float(model.g @ step + 0.5 * step @ model.H @ step) - gained
        np.testing.assert_allclose(told, best, rtol=1e-6, atol=1e-6)


def test_being_around_another_state_costs_what_the_quadratic_says() -> None:
    state = SplineState.still(0.0, DT, np.eye(4), 6)
    smoother, step = filled(7), np.random.default_rng(8).normal(0.0, 1e-2, (6, 6))
    full = np.concatenate([step.ravel(), np.zeros(SIZE)])
    expected = float(0.5 * full @ smoother.H @ full + smoother.g @ full)
    state.apply(0, step)
    twin = smoother.copy()
    assert twin.reach(state, 0, 8) == pytest.approx(expected, rel=1e-12)
    np.testing.assert_allclose(twin.g[:36], (smoother.g + smoother.H @ full)[:36], rtol=1e-12)
    assert len(smoother.g) == 36 + SIZE and len(twin.g) == 48 + SIZE


def learnt(
    truth: Spline, seed: int, end: float = np.inf, *, every: float = 1 / 30, turn: FloatArray | None = None,
    wall: float = np.inf,
) -> Inertia:  # fmt: skip
    """An IMU beside poses with noise until a time, s, as the tracker would give it them; a way along x is open from the
    time `wall` on."""
    inertia, state = Inertia(recording(truth, seed, turn=turn)), SplineState(truth)
    for t, T in seen_poses(truth, np.random.default_rng(seed), every):
        if t < end:
            sigma = POSE_SIGMA * [1.0 if t < wall else 1e3, 1.0, 1.0, 1.0, 1.0, 1.0]
            model, _ = pose_constraint(state.spline, t, T, sigma)
            inertia.learn(state, 0, [model], t + 0.015 if t + 0.015 < truth.t_end else t)
    return inertia


def test_biases_gravity_and_turn_are_found_to_what_their_sigmas_say() -> None:
    """Of 50 seeds: within 3 σ in 95 % and more, and the σ as large as the errors are."""
    scores = []
    for seed in range(50):
        turn = np.random.default_rng(100 + seed).normal(0.0, TURNED, 3)
        inertia = learnt(hand_held(0.8, seed), seed, every=0.1, turn=turn)
        off = inertia.estimate.mean - np.concatenate([BIAS, GRAVITY, turn])
        scores.append(off / inertia.estimate.sigmas)
    assert (np.abs(scores) < 3.0).mean() > 0.98
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(scores)[:, :3])), 1.0, atol=0.2)
    assert 0.3 < np.sqrt(np.mean(np.square(scores)[:, 3:9])) < 1.2  # the prior of biases is wider than these are
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(scores)[:, TURN])), 1.0, atol=0.2)


def test_a_place_that_readings_contradict_is_said() -> None:
    """0.3° of turn are found, and said to be; without any nothing is."""
    turn = np.radians([0.2, -0.2, 0.1])
    off, right = (learnt(hand_held(2.0, 3), 3, turn=given) for given in (turn, None))
    assert is_contradicted(off.estimate) and not is_contradicted(right.estimate)
    assert np.linalg.norm(off.estimate.mean[TURN] - turn) < np.radians(0.1)
    said, plain = (text(inertia.as_dict(), 0.0, 0) for inertia in (off, right))
    degrees = np.degrees(np.linalg.norm(off.estimate.mean[TURN]))
    assert f"turned by {degrees:.2f}°" in said and "rstrack calibrate SEQ --free imu" in said and "turned" not in plain


def test_a_second_look_knows_gravity_and_says_when() -> None:
    truth = hand_held(5.0, 3)
    inertia = learnt(truth, 3, every=0.1)
    angle = np.degrees(np.arccos(min(1.0, inertia.estimate.direction @ GRAVITY / STRENGTH)))
    assert angle < 0.2 and inertia.estimate.direction_deg < 0.3
    assert 0.1 < inertia.usable_s < 1.0 < inertia.determined_s < 4.5 < truth.t_end
    # The spline can follow all that there is: readings scatter by their noise.
    np.testing.assert_allclose(inertia.sigma, [7e-5 * 200**0.5, 1e-3 * 200**0.5], rtol=0.5)


def ahead_of(inertia: Inertia, state: SplineState) -> tuple[ReusedPrior, FloatArray]:
    """What is known ahead, and what of the control points after its first its minimum adds (k, 6)."""
    known = inertia.ahead(state)
    model, _ = known(state.spline)
    return known, -np.linalg.solve(model.H, model.g).reshape(-1, 6)


def test_what_is_ahead_has_the_derivatives_of_its_cost() -> None:
    truth = hand_held(0.6, 5)
    inertia = learnt(truth, 5, 0.5)
    for seed in range(3):
        state = SplineState(truth)
        known = inertia.ahead(state)
        model, cost = known(state.spline)
        step = np.random.default_rng(seed).normal(0.0, 1e-4, (model.last - model.first, 6))
        moved, ends = SplineState(truth), []
        for side in (1.0, -2.0):
            moved.apply(model.first, side * step)
            ends.append(inertia.ahead(moved)(moved.spline)[1])
        flat = step.ravel()
        slope, bend = ends[0] - ends[1], ends[0] + ends[1] - 2.0 * cost
        np.testing.assert_allclose(slope, 2.0 * float(model.g @ flat), rtol=2e-2, atol=1e-3 * abs(bend))
        np.testing.assert_allclose(bend, float(flat @ model.H @ flat), rtol=1e-3)


def test_what_is_ahead_leads_on_from_where_images_end() -> None:
    """The newest control points, moved away, come back to where the readings have them: no image has seen these."""
    for seed in range(4):
        truth = hand_held(0.7, seed)
        inertia, state = learnt(truth, seed, 0.6), SplineState(truth)
        last = state.segment(0.6) + 4
        state.apply(last, np.tile(np.repeat([0.01, 0.02], 3), (state.end - last, 1)))
        for _ in range(4):
            known, step = ahead_of(inertia, state)
            state.apply(known.first, step)
        t = np.linspace(0.5, 0.67, 30)
        off = se3.log(state.spline.pose(t) @ se3.inverse(truth.pose(t)))
        model, _ = known(state.spline)
        told = np.sqrt(np.diag(np.linalg.inv(model.H))).reshape(-1, 6)[: last - model.first].max(axis=0)
        assert (np.abs(off).max(axis=0) < 3.0 * told).all() and (told < np.repeat([1e-3, 6e-4], 3)).all()


def test_what_is_held_is_of_a_usable_imu_of_this_segment_where_images_leave_no_way_open() -> None:
    truth = hand_held(0.6, 5)
    assert learnt(truth, 5, 0.04).held(0) is None and learnt(truth, 5, 0.5, wall=0.45).held(0) is None
    inertia = learnt(truth, 5, 0.5, wall=0.51)
    held = inertia.held(0)
    assert held is not None and held > 10 and inertia.held(held + 1) is None
    inertia.begin_segment()
    assert inertia.held(0) is None


def test_another_world_has_its_own_gravity_and_the_same_biases() -> None:
    inertia = learnt(hand_held(1.2, 3), 3)
    own, before = [*range(6), *range(9, 12)], inertia.estimate
    inertia.begin_world()
    np.testing.assert_allclose(inertia.estimate.sigmas[own], before.sigmas[own], rtol=1e-9)
    np.testing.assert_array_equal(inertia.estimate.mean[own], before.mean[own])
    assert not inertia.is_usable and inertia.estimate.direction_deg > 45.0


def test_what_comes_before_the_first_control_point_is_taken_for_fixed() -> None:
    smoother = Smoother.start(ImuEstimate.initial(GRAVITY))
    smoother.reach(SplineState.still(0.0, DT, np.eye(4), 8), 3, 6)
    model = Quadratic(1, np.arange(1.0, 24 * 24 + 1).reshape(24, 24), np.arange(24.0))
    smoother.add(model)
    np.testing.assert_array_equal(smoother.g[:12], model.g[12:])
    np.testing.assert_allclose(smoother.H[:12, :12] - 1e-4 * np.eye(12), model.H[12:, 12:])
    assert smoother.g[12:] == pytest.approx(0.0)
