"""Clocks behind stamps, on stamps made by a known clock: jitter, drift, drops, repeats, changes of rate, pauses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rstrack.data.clock import RunningClock, StampClock, drift_ppm, straightened
from rstrack.data.timing import stream_timing

DATA = Path(__file__).resolve().parents[4] / "shared" / "data"
needs_rpy = pytest.mark.skipif(not (DATA / "tum_fr1_rpy").is_dir(), reason="../shared/data/tum_fr1_rpy is not here")
EPOCH = 1305031229.0


def true_times(n: int, period: float = 1 / 30, ppm_per_minute: float = 0.0) -> np.ndarray:
    t = period * np.arange(n)
    return EPOCH + t + 0.5e-6 * ppm_per_minute / 60.0 * t**2


def used(stamps: np.ndarray) -> np.ndarray:
    """Those that images are tracked at, unless the user states otherwise."""
    return stream_timing("depth", stamps, "auto", 0.0).used


def without_mean(error: np.ndarray) -> np.ndarray:
    """The mean delay is kept: what counts is what varies."""
    return np.asarray(error - error.mean())


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10**6), period=st.floats(0.008, 0.1), n=st.integers(100, 600), grid=st.booleans(),
    drops=st.floats(0.0, 0.2),
)  # fmt: skip
def test_jitter_and_drops_of_any_steady_clock(seed: int, period: float, n: int, grid: bool, drops: float) -> None:
    rng = np.random.default_rng(seed)
    jitter = 0.12 * period
    true = true_times(n, period)
    late = np.ceil(true / jitter) * jitter if grid else true + rng.uniform(0.0, jitter, n)
    kept = rng.random(n) >= drops
    kept[[0, -1]] = True
    clock, even = straightened(late[kept])
    assert clock.verdict == "jittered" and clock.repeated == 0
    assert clock.dropped == np.count_nonzero(~kept)
    assert clock.period_s == pytest.approx(period, rel=4.0 * 0.3 * jitter / period / n**1.5 * 3.5 + 2e-4 * grid)
    assert np.abs(without_mean(even - true[kept])).max() < (0.3 if grid else 0.15) * jitter
    assert np.abs(without_mean(even - true[kept])).max() < np.abs(without_mean(late - true)[kept]).max()
    assert abs(np.median(late[kept] - even)) < 1e-6, "the mean delay stays"
    assert (np.diff(even) > 0).all()


def test_late_bursts_do_not_bend_the_line_and_both_kinds_of_jitter_are_met() -> None:
    rng = np.random.default_rng(3)
    true = true_times(300)
    late = true + rng.uniform(0.0, 1e-3, 300)
    late[40:120] += rng.uniform(0.0, 6e-3, 80)  # the computer was busy for a while
    assert without_mean(used(late) - true).std() < 0.1e-3
    around = true + rng.normal(0.0, 2e-3, 300)
    # A line through n stamps: σ √(1/12) of the slope's error over its ends.
    assert without_mean(used(around) - true).std() < 3.0 * 2e-3 / np.sqrt(300)


def test_outliers_repeats_and_bunches() -> None:
    rng = np.random.default_rng(4)
    true = true_times(300)
    stamps = true + rng.uniform(-1e-3, 1e-3, 300)
    stamps[50] += 14e-3  # late by less than half a period
    stamps[100:103] = stamps[103] - np.array([3e-3, 2e-3, 1e-3])  # held up, then delivered at once
    clock, even = straightened(stamps)
    assert (clock.dropped, clock.repeated, clock.verdict) == (0, 0, "jittered")
    assert clock.jitter_max_s > 0.09 and np.abs(without_mean(even - true)).max() < 0.3e-3
    twice = np.sort(np.concatenate([stamps[:40], stamps[[20, 30]] + 1e-3]))
    clock, even = straightened(np.concatenate([twice, stamps[60:]]))
    assert (clock.dropped, clock.repeated) == (20, 2)
    assert (np.diff(even) > 0).all()
    assert straightened(np.sort(np.concatenate([stamps[:40], stamps[[20]]])))[0].repeated == 1


def test_a_clock_that_warms_up_is_followed() -> None:
    rng = np.random.default_rng(5)
    true = true_times(54000, ppm_per_minute=1.0)  # half an hour
    stamps = true + rng.uniform(0.0, 4e-3, len(true))
    line = np.polyval(np.polyfit(np.arange(54000), true - EPOCH, 1), np.arange(54000)) + EPOCH
    assert np.abs(line - true).max() > 3e-3, "a line would be wrong"
    assert np.abs(without_mean(used(stamps) - true)).max() < 0.3e-3


def test_what_is_regular_stays_bit_for_bit() -> None:
    rng = np.random.default_rng(6)
    for stamps in (np.round(true_times(200), 4), true_times(200), np.arange(1.0, 300.0) / 30.0):
        assert straightened(stamps)[0].verdict == "regular"
        np.testing.assert_array_equal(used(stamps), stamps)
    for few in (np.empty(0), np.array([1.0]), true_times(19) + rng.normal(0.0, 1e-3, 19)):
        assert straightened(few)[0].verdict == "too short"
        np.testing.assert_array_equal(used(few), few)


@pytest.mark.parametrize("kind", ["uniform", "wander", "two rates", "exposure"])
def test_what_has_no_steady_clock_stays_raw(kind: str) -> None:
    rng = np.random.default_rng(7)
    steps = {
        "uniform": rng.uniform(0.02, 0.06, 400),
        "wander": (1 / 30) * (1.0 + 0.1 * np.sin(np.arange(400) / 40.0)),
        "two rates": np.repeat([1 / 30, 1 / 25], 200),
        "exposure": np.repeat(rng.uniform(0.033, 0.066, 20), 20),
    }[kind]
    stamps = EPOCH + np.cumsum(steps)
    assert straightened(stamps)[0].verdict == "irregular"
    np.testing.assert_array_equal(used(stamps), stamps)


def test_half_the_rate_for_a_while_and_a_pause() -> None:
    rng = np.random.default_rng(8)
    true = np.concatenate([true_times(200), true_times(200)[-1] + np.arange(1, 201) / 15.0])
    clock, even = straightened(true + rng.uniform(0.0, 3e-3, 400))
    assert (clock.verdict, clock.dropped) == ("jittered", 200)
    assert clock.period_s == pytest.approx(1 / 30, rel=1e-4) and np.abs(without_mean(even - true)).max() < 0.5e-3
    # A camera that was stopped starts with another phase: each side has a line of its own.
    true = np.concatenate([true_times(200), true_times(200) + 20.0 + 0.49 / 30])
    clock, even = straightened(true + rng.uniform(0.0, 3e-3, 400))
    assert (clock.verdict, clock.dropped) == ("jittered", 0)
    assert np.abs(without_mean(even - true)).max() < 0.5e-3


def test_drift_against_another_clock() -> None:
    def clock(period: float) -> StampClock:
        return straightened(true_times(300, period))[0]

    depth = clock(1 / 30)
    assert drift_ppm(clock((1 / 30) / (1 + 990e-6)), depth) == pytest.approx(990, abs=0.1)
    assert drift_ppm(clock((1 / 15) * (1 + 50e-6)), depth) == pytest.approx(-50, abs=0.1)
    assert drift_ppm(clock(1 / 60), depth) == pytest.approx(0, abs=0.1)
    assert drift_ppm(clock(1 / 45), depth) is None
    assert drift_ppm(straightened([1.0])[0], depth) is None
    # A few stamps have a period, but tell no rate.
    assert drift_ppm(straightened(true_times(9, (1 / 30) / (1 + 990e-6)))[0], depth) is None


@pytest.mark.parametrize("seed", range(3))
def test_the_running_clock_straightens_causally(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = true_times(1500)
    true = true[(rng.random(1500) > 0.05) | (np.arange(1500) < 20)]
    stamps = true + rng.uniform(-2e-3, 2e-3, len(true))
    stamps[700] += 12e-3
    clock = RunningClock()
    even = np.array([clock.feed(float(stamp)) for stamp in stamps])
    assert (np.diff(even) > 0).all()
    settled = without_mean((even - true)[300:])
    assert settled.std() < 0.2e-3 and np.abs(settled).max() < 0.8e-3, (settled.std(), np.abs(settled).max())
    again = RunningClock()
    np.testing.assert_array_equal([again.feed(float(stamp)) for stamp in stamps[:400]], even[:400])


def test_the_running_clock_starts_anew_after_a_pause_and_at_another_rate() -> None:
    rng = np.random.default_rng(9)
    true = np.concatenate([true_times(300), EPOCH + 60.0 + np.arange(300) / 30, EPOCH + 70.0 + np.arange(1, 300) / 20])
    stamps = true + rng.uniform(-1e-3, 1e-3, len(true))
    clock = RunningClock()
    error = np.array([clock.feed(float(stamp)) for stamp in stamps]) - true
    for part in (slice(100, 300), slice(400, 600), slice(700, 899)):
        assert np.abs(error[part]).max() < 0.8e-3


@needs_rpy
def test_the_clocks_of_a_kinect() -> None:
    """Periods over all of the recording: 33.336 and 33.369 ms (SOURCE.md); here is its first quarter."""
    clocks = {}
    for name, period in (("rgb", 33.336e-3), ("depth", 33.369e-3)):
        lines = (DATA / f"tum_fr1_rpy/{name}.txt").read_text().splitlines()
        stamps = np.array([float(line.split()[0]) for line in lines if not line.startswith("#")])
        clock, even = straightened(stamps)
        clocks[name] = clock
        assert (clock.verdict, clock.dropped, clock.repeated) == ("jittered", 0, 0)
        assert clock.period_s == pytest.approx(period, abs=4e-6) and 1.5e-3 < clock.jitter_rms_s < 2.5e-3
        assert np.ptp(np.diff(even)) < 1e-6
    drift = drift_ppm(clocks["rgb"], clocks["depth"])
    assert drift is not None and 800.0 < drift < 1200.0
