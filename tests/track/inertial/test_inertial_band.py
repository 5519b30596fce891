"""Knots as dense as a motion needs: the closed form against SciPy's least squares, and what is chosen by it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import make_lsq_spline

from rsgen.array_types import FloatArray
from rsgen.config.faults import ImuFaults
from rsgen.config.sections import ImuConfig
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.spline import Spline
from rsgen.sensors.imu import simulate_imu
from rstrack.data.imu.description import ImuNoise
from rstrack.data.imu.recording import ImuRecording
from rstrack.data.rig import Rig
from rstrack.inertial.band import ImuReadings, MotionBand, missed, with_knots
from rstrack.inertial.inertia import Inertia
from rstrack.options import Options
from rstrack.tracking.spline_tracker import Tracker

NOISE = ImuNoise(6.6e-5, 1e-5, 6.9e-4, 1e-4)
FOCAL = 285.0


def swinging(size: FloatArray, hertz: float, seconds: float = 8.0) -> Spline:
    """Along and about the three axes by amplitudes (6,), m and rad, each in a phase of its own."""
    dt = 1 / 400
    t = dt * (np.arange(round(seconds / dt) + 4) - 1)
    return Spline(se3.exp(np.sin(2 * np.pi * hertz * t[:, None] + np.arange(6)) * size), -dt, dt)


def recording(spline: Spline, noise: ImuNoise = NOISE, gravity: float = 9.80665) -> ImuRecording:
    config = ImuConfig(
        gravity=(0.0, -gravity, 0.0), gyroscope_noise_density=noise.gyro_density, gyroscope_random_walk=0.0,
        accelerometer_noise_density=noise.accel_density, accelerometer_random_walk=0.0,
    )  # fmt: skip
    read = simulate_imu(spline, config, spline.t_begin, spline.t_end, 1, ImuFaults(dropped=1e-3, jitter_s=5e-5))
    return ImuRecording(read.t, read.gyro, read.accel, noise, np.eye(4), 200.0, gravity)


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("x", [0.13, 0.3, 0.47, 0.8, 1.3])
def test_what_a_spline_misses_of_a_wave_is_what_least_squares_leaves(degree: int, x: float) -> None:
    knots = np.arange(-degree, 401.0 + degree)
    t = np.linspace(0.0, 400.0, 400 * 40 + 1)
    wave = np.sin(2 * np.pi * x * t + 0.3)
    left = wave - make_lsq_spline(t, wave, knots, degree)(t)
    inner = (t > 10.0) & (t < 390.0)
    assert np.mean(left[inner] ** 2) / 0.5 == pytest.approx(missed(np.array([x]), degree)[0], rel=0.03)


def test_what_is_missed_of_a_swing_follows_from_the_readings() -> None:
    size, hertz = np.repeat([3e-4, 1e-3], 3), 23.0
    band = MotionBand.of(recording(swinging(size, hertz), gravity=0.0))
    rms = size * np.sqrt(3 / 2)
    for dt in (0.0125, 0.025, 0.05):
        share = np.sqrt(missed(np.array([hertz * dt]), 3)[0])
        turn, place = band.missed_motion(dt)
        # Lines between samples that come a little late, and a spectrum of 1 Hz.
        assert turn == pytest.approx(rms[3] * share, rel=0.15) and place == pytest.approx(rms[0] * share, rel=0.15)
    reading = size * (2 * np.pi * hertz) ** np.repeat([2, 1], 3) / np.sqrt(2)
    share = np.sqrt([missed(np.array([hertz * 0.0125]), n)[0] for n in (2, 1)])
    np.testing.assert_allclose(band.scatter(0.0125), reading[[3, 0]] * share, rtol=0.15)
    expected = np.repeat([reading[0], size[3] * (2 * np.pi * hertz) ** 2 / np.sqrt(2)], 3)
    np.testing.assert_allclose(band.accelerations, expected, rtol=0.1)


def test_knots_are_as_dense_as_the_motion_needs() -> None:
    vibrating = np.repeat([3e-4 * 2**0.5, np.radians(0.05) * 2**0.5], 3)
    cases = [
        (np.zeros(6), 1.0, (0.025,)),  # never wider than without a unit
        (np.repeat([0.02, 0.1], 3), 1.0, (0.025,)),  # a hand's sway
        (np.repeat([2e-3, 4e-3], 3), 5.0, (0.025,)),  # and its shake
        (np.repeat([4e-3, 8e-3], 3), 8.0, (1 / 60, 0.0125)),
        (vibrating, 25.0, (0.0125, 1 / 120)),
        (30 * vibrating, 25.0, (0.00625,)),  # the densest that 200 Hz tell
    ]
    for size, hertz, expected in cases:
        read = recording(swinging(size, hertz))
        assert MotionBand.of(read).knots_s(FOCAL, read.rate_hz) in expected
    # As the lens sees it: what is far below a pixel needs no knots.
    few = MotionBand.of(recording(swinging(vibrating, 25.0))).knots_s(FOCAL / 100, 200.0)
    assert few > 0.0125


def test_the_tracker_has_such_knots_unless_told_otherwise() -> None:
    read = recording(swinging(np.repeat([3e-4, 1e-3], 3), 25.0, 3.0))
    rig = Rig(*(Camera(80, 60, 60.0, 60.0, 39.5, 29.5), Shutter(readout_s=0.028)) * 2, np.eye(4))
    chosen = Tracker(rig, Options(method="rs-gi", backend="llvm"), imu=read).options.knot_spacing_s
    assert chosen == MotionBand.of(read).knots_s(60.0, 200.0) < 0.025
    asked = Options(method="rs-gi", knot_spacing_s=0.03)
    assert with_knots(asked, read, 60.0) == asked
    plain = Options(method="rs-g")
    assert with_knots(plain, read, 60.0) == plain
    alone = ImuRecording(read.t, None, read.accel, NOISE, np.eye(4), 200.0)
    assert with_knots(Options(method="rs-gi"), alone, 60.0).knot_spacing_s is None


def test_the_prior_lets_through_what_the_readings_say_of_accelerations() -> None:
    size = np.repeat([1e-3, 5e-3], 3)
    inertia = Inertia(recording(swinging(size, 20.0)))
    rms = size * (2 * np.pi * 20.0) ** 2 / np.sqrt(2)
    np.testing.assert_allclose(inertia.common, np.maximum([5.0] * 3 + [10.0] * 3, 3.0 * rms), rtol=0.1)


def test_single_wild_readings_do_not_count_and_do_not_make_knots_denser() -> None:
    truth = swinging(np.repeat([1e-3, 5e-3], 3), 20.0)
    read = recording(truth)
    assert read.gyro is not None and ImuReadings.of(read).counts.all()
    rng = np.random.default_rng(3)
    at = 5 + 25 * np.arange(60), rng.integers(0, 6, 60)
    values = np.concatenate([read.gyro, read.accel], axis=1)
    values[at] += rng.choice([-1.0, 1.0], 60) * np.where(at[1] < 3, 8.0, 160.0)
    broken = ImuRecording(read.t, values[:, :3], values[:, 3:], NOISE, np.eye(4), 200.0)
    np.testing.assert_array_equal(
        np.argwhere(ImuReadings.of(broken).counts == 0.0), np.argwhere(values != np.hstack([read.gyro, read.accel]))
    )
    np.testing.assert_allclose(MotionBand.of(broken).scatter(0.025), MotionBand.of(read).scatter(0.025), rtol=0.05)
