"""An IMU against a tracked camera: derivatives by differences, what a made recording gives, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tum_recording import make_tum
from util import random_spline, swung

from rsgen.config.faults import ImuFaults
from rsgen.config.sections import ImuConfig
from rsgen.errors import UserError
from rsgen.geometry import se3, so3
from rsgen.geometry.spline import Spline
from rsgen.sensors.imu import exact_imu, imu_csv, simulate_imu
from rstrack.calibration.imu import ImuCalibration, begin, calibrate_imu
from rstrack.calibration.imu_model import (
    DRIFT,
    LEVER,
    OFFSET,
    ROTATION,
    SCALE,
    CorrectedTrack,
    ImuPrediction,
    ImuUnknowns,
    hats,
)
from rstrack.calibration.imu_solve import _alike
from rstrack.calibration.start import TrackedSpline
from rstrack.cli.main import main
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.inertial.factor import BodyMotion

SCALES = np.array([1.01, 0.995, 1.004])
CONFIG = ImuConfig.model_validate({"preset": "phone", "gyroscope_matrix": np.diag(SCALES).tolist()})
FAULTS = ImuFaults(jitter_s=5e-5, clock_offset_s=0.0125, clock_drift_ppm=80.0, dropped=0.01)
SECONDS = 12.0
TRUE = swung(SECONDS)
SAMPLES = simulate_imu(TRUE, CONFIG, 0.0, SECONDS, 1, FAULTS)


def unknowns_of(spline: Spline, rng: np.random.Generator) -> ImuUnknowns:
    T = se3.exp(0.5 * rng.normal(size=6))
    return ImuUnknowns(
        T[:3, :3], 0.1 * rng.normal(size=3), 0.003, 1e-3, 0.02 * rng.normal(size=3), np.array([0.3, -9.7, 1.0]),
        np.linspace(spline.t_begin, spline.t_end, 3), 0.1 * rng.normal(size=(3, 6)), spline.t_begin + 0.2,
    )  # fmt: skip


@pytest.mark.parametrize("parts", [1, 3])
def test_derivatives_are_those_of_differences(parts: int) -> None:
    rng, spline = np.random.default_rng(parts), random_spline(3, points=10, angle=0.3)
    track = CorrectedTrack(spline, parts)
    imu, x = unknowns_of(spline, rng), np.zeros((track.count, 6))
    stamps = np.linspace(spline.t_begin + 0.02, spline.t_end - 0.02, 23)

    def read(imu: ImuUnknowns, x: np.ndarray) -> np.ndarray:
        return ImuPrediction(track, imu, x, stamps).readings

    at = ImuPrediction(track, imu, x, stamps)
    for i in range(imu.size):
        step = np.zeros(imu.size)
        step[i] = 1e-6 if i == OFFSET else 1e-5
        found = (read(imu.moved(step), x) - read(imu.moved(-step), x)) / (2 * step[i])
        # The clock is the gyroscope's to tell.
        told = slice(None, 3 if i in (OFFSET, DRIFT) else None)
        close = 1e-5 * np.abs(found[:, told]).max() + 1e-9
        np.testing.assert_allclose(at.by_imu[:, told, i], found[:, told], atol=close)
    assert not at.by_imu[:, 3:, [OFFSET, DRIFT]].any()
    by_x = at.corrections.spread(at.by_corrections, track.count).toarray().reshape(len(stamps), 6, -1)
    for k in range(0, track.count, 3):
        for c in range(6):
            step = np.zeros_like(x)
            step[k, c] = 1e-6
            found = (read(imu, step) - read(imu, -step)) / 2e-6
            for part in (slice(3), slice(3, 6)):
                close = 1e-5 * np.abs(found[:, part]).max() + 1e-9
                np.testing.assert_allclose(by_x[:, part, 6 * k + c], found[:, part], atol=close)


def test_readings_are_those_of_the_generator() -> None:
    spline = random_spline(5, points=12, angle=0.3)
    imu = replace(unknowns_of(spline, np.random.default_rng(1)), offset_s=0.0, drift=0.0)
    t, track = np.linspace(spline.t_begin, spline.t_end, 50), CorrectedTrack(spline)
    gyro, accel = exact_imu(spline, imu.T_imu_depth, imu.gravity, t)
    bias = hats(imu.bias_times, t) @ imu.biases
    found = ImuPrediction(track, imu, np.zeros((track.count, 6)), t).readings
    np.testing.assert_allclose(found[:, :3], (1.0 + imu.scale) * gyro + bias[:, :3], atol=1e-10)
    np.testing.assert_allclose(found[:, 3:], accel + bias[:, 3:], atol=1e-9)


def test_a_corrected_motion_is_that_of_the_corrected_poses() -> None:
    """Finite differences of R exp(φ), p + δ."""
    spline, rng = random_spline(7, points=9, angle=0.3), np.random.default_rng(0)
    track = CorrectedTrack(spline, 2)
    x, h = 1e-4 * rng.normal(size=(track.count, 6)), 1e-4
    t = spline.t_begin + 0.0125 + 0.025 * np.arange(11)  # amid the knots, where all is smooth

    def poses(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        T, value = spline.pose(t), track.corrections(t).values(x)[0]
        return T[:, :3, :3] @ so3.exp(value[:, :3]), T[:, :3, 3] + value[:, 3:]

    def motion(t: np.ndarray) -> BodyMotion:
        return track.motion(t, track.corrections(t), x)

    (early, p0), (now, _), (late, p2) = (poses(t + k * h) for k in (-1, 0, 1))
    at, (before, after) = motion(t), (motion(t + k * h).twist for k in (-1, 1))
    np.testing.assert_allclose(at.rotation, now, atol=1e-12)
    v = ((p2 - p0)[:, None] @ now)[:, 0] / (2 * h)
    turns = so3.log(np.swapaxes(early, 1, 2) @ late) / (2 * h)
    np.testing.assert_allclose(at.twist, np.concatenate([v, turns], axis=1), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(at.rate, (after - before) / (2 * h), rtol=1e-3, atol=2e-3)


def tracked(noise: float, seed: int = 0, dt: float = 0.025) -> TrackedSpline:
    """The true motion with knots of its own, which do not meet the true ones, and errors as a tracker's."""
    knots = np.arange(0.3 * dt, SECONDS, dt)
    points = TRUE.pose(np.clip(knots, TRUE.t_begin, TRUE.t_end))
    fitted = points.copy()
    for _ in range(4):  # control points whose spline passes through the poses
        spline = Spline(fitted, knots[1], dt)
        inside = slice(1, len(knots) - 2)
        error = se3.log(se3.inverse(spline.pose(knots[inside])) @ points[inside])
        fitted[inside] = fitted[inside] @ se3.exp(error)
        fitted = se3.orthonormalise(fitted)
    shaken = fitted @ se3.exp(noise * np.random.default_rng(seed).normal(size=(len(fitted), 6)))
    spline = Spline(shaken, knots[1], dt)
    return TrackedSpline(spline, ((spline.t_begin, spline.t_end),))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Frames for 10 s, of which the stamps alone count here, with the samples beside."""
    root = make_tum(tmp_path_factory.mktemp("imu") / "mine")
    (root / "imu.csv").write_text(imu_csv(SAMPLES))
    noise = {name: getattr(CONFIG, name) for name in ImuConfig.model_fields if name.endswith(("density", "walk"))}
    (root / "imu.yaml").write_text("\n".join(f"{name}: {value}" for name, value in noise.items()))
    return replace(open_dataset(root), stamps=np.arange(1.0, 11.0, 1 / 30))


@pytest.fixture(scope="module")
def found(dataset: Dataset) -> ImuCalibration:
    return calibrate_imu(dataset, tracked(1e-4))


def test_place_clock_and_scale_are_found_within_their_errors(found: ImuCalibration, dataset: Dataset) -> None:
    T_true, sigmas = np.array(CONFIG.T_imu_depth), found.sigmas
    turn = so3.log(found.T_imu_depth[:3, :3] @ T_true[:3, :3].T)
    assert np.linalg.norm(turn) < np.radians(0.05) and (np.abs(turn) < 5.0 * sigmas[ROTATION]).all()
    shift = found.T_imu_depth[:3, 3] - T_true[:3, 3]
    assert np.linalg.norm(shift) < 1e-3 and (np.abs(shift) < 5.0 * found.translation_sigma).all()
    middle = dataset.middle
    offset = (middle - 0.0125) / (1 + 80e-6) - middle  # the stamp `middle` was taken then; its clock begins at 0
    assert abs(found.offset_s - offset) < min(1e-4, 5.0 * sigmas[OFFSET])
    assert abs(found.drift + 80e-6) < 5.0 * sigmas[DRIFT] < 1e-4
    assert (np.abs(np.diag(found.gyro_matrix) - SCALES) < 5.0 * sigmas[SCALE]).all() and sigmas[SCALE].max() < 1e-3
    assert not found.undetermined.any() and (sigmas[LEVER] > 1e-5).all()
    imu = found.solution.imu
    at = np.searchsorted(SAMPLES.t, imu.bias_times[1:-1])
    assert np.abs(imu.biases[1:-1, :3] - SAMPLES.gyro_bias[at]).max() < 5e-4
    assert np.abs(imu.biases[1:-1, 3:] - SAMPLES.accel_bias[at]).max() < 1e-2


def test_what_was_written_brings_the_samples_to_the_images_clock(found: ImuCalibration, dataset: Dataset) -> None:
    assert dataset.imu_files is not None
    file = dataset.root / "found.yaml"
    file.write_text(found.imu_file())
    right = replace(dataset, imu_files=replace(dataset.imu_files, given=file))
    imu = right.imu
    assert imu is not None and imu.gyro is not None
    np.testing.assert_allclose(imu.t, SAMPLES.t, atol=1.5e-4)
    np.testing.assert_allclose(imu.T_imu_depth, found.T_imu_depth, atol=1e-8)
    np.testing.assert_allclose(imu.gyro * (1.0 + found.solution.imu.scale), SAMPLES.gyro, atol=1e-6)
    # What is found from there on is told on top of that: the file of the whole is the same.
    assert right.imu_files is not None and right.imu_files.description().offset_s == pytest.approx(found.offset_s)
    rest = replace(found, stated=right.imu_files.description())
    assert rest.offset_s == pytest.approx(2 * found.offset_s, abs=1e-5)
    np.testing.assert_allclose(rest.gyro_matrix, found.gyro_matrix @ found.gyro_matrix, atol=1e-6)
    assert "±" in found.text() and found.as_dict()["undetermined"] == []


def test_a_track_that_errs_more_tells_less(found: ImuCalibration, dataset: Dataset) -> None:
    worse = calibrate_imu(dataset, tracked(4e-4))
    assert (worse.sigmas[:OFFSET] > 1.3 * found.sigmas[:OFFSET]).all()
    assert worse.solution.sizes.poses[0] > 2.0 * found.solution.sizes.poses[0]


def test_what_tells_nothing_is_one_line(dataset: Dataset, tmp_path: Path) -> None:
    track = tracked(0.0)
    with pytest.raises(UserError, match="followed in a row"):
        calibrate_imu(dataset, TrackedSpline(track.spline, ((1.0, 4.0),)))
    with pytest.raises(UserError, match="has no IMU"):
        calibrate_imu(replace(dataset, imu_files=None), track)
    other = simulate_imu(swung(40.0), CONFIG, 27.0, 27.0 + SECONDS, 0, FAULTS)
    root = make_tum(tmp_path / "other")
    (root / "imu.csv").write_text(imu_csv(replace(other, stamps=SAMPLES.t[0] + other.t - other.t[0])))
    with pytest.raises(UserError, match="does not turn as the track does"):
        calibrate_imu(replace(open_dataset(root), stamps=dataset.stamps), track)
    (root / "imu.csv").unlink()
    lines = [f"{t:.6f} " + " ".join(f"{x:.6f}" for x in row) for t, row in zip(SAMPLES.t, SAMPLES.accel, strict=True)]
    (root / "accelerometer.txt").write_text("\n".join(lines))
    with pytest.raises(UserError, match="accelerometer alone"):
        calibrate_imu(replace(open_dataset(root), stamps=dataset.stamps), track)


def test_turning_about_one_axis_tells_no_axes() -> None:
    t = np.arange(200) * 0.05
    twist = np.zeros((len(t), 6))
    twist[:, 4] = np.sin(2.0 * t)
    spline = Spline(se3.exp(twist), 0.0, 0.05)
    samples = simulate_imu(spline, CONFIG, 0.0, spline.t_end, 0, FAULTS)
    given = samples.stamps, samples.gyro, samples.accel, 9.80665, np.array([0.0, 9.0]), 4.0
    with pytest.raises(UserError, match="one axis only"):
        begin(spline, (0.0, 9.0), *given)


def test_the_command(dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    where = str(dataset.root)
    assert main(["calibrate", where, "--free", "imu,readout"]) == 2
    assert "stands alone" in capsys.readouterr().err
    assert main(["calibrate", where, "--run", "nowhere"]) == 2
    assert "--free imu" in capsys.readouterr().err
    assert main(["calibrate", where, "--free", "imu", "--run", str(tmp_path / "nowhere")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_errors_that_are_alike_count_for_more() -> None:
    """An autoregression of φ has in sums (1 + φ) / (1 − φ) times the variance of white noise."""
    rng = np.random.default_rng(0)
    white = rng.normal(size=(20000, 6))
    assert _alike(white) == pytest.approx(1.0, abs=0.05)
    regressed = np.zeros_like(white)
    for k in range(1, len(white)):
        regressed[k] = 0.5 * regressed[k - 1] + white[k]
    assert _alike(regressed) == pytest.approx(np.sqrt(3.0), rel=0.05)
