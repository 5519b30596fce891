"""What a real IMU does beside noise: warms up, comes early or late, loses samples, and has a clock of its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from pydantic import BaseModel, ValidationError
from synthetic import make_config, make_sequence, make_spline
from test_sensors_imu import config, hand_held

from rsgen.check.verify import verify_sequence
from rsgen.cli.main import main
from rsgen.config.config import Config, load_config
from rsgen.config.faults import FaultsConfig, ImuFaults, StreamFaults
from rsgen.config.presets import _IMU_FAULTS, _IMU_PRESETS
from rsgen.config.sections import ImuConfig
from rsgen.geometry import se3
from rsgen.sensors.imu import exact_imu, imu_csv, simulate_imu
from rsgen.sensors.reports import deliver
from rstrack.data.dataset import open_dataset

SPLINE = hand_held(20.0)
BEGIN, END = SPLINE.t_begin, SPLINE.t_end
CLOCK = {"clock_offset_s": 0.0125, "clock_drift_ppm": 80.0}


def with_imu(imu: ImuConfig, **faults: float) -> Config:
    """`synthetic`'s config with an IMU and its faults."""
    return make_config().model_copy(update={"imu": imu, "faults": FaultsConfig(imu=ImuFaults(**faults))})


def test_a_config_that_says_nothing_of_it_stays_what_it_was() -> None:
    before = {
        "rate_hz", "T_imu_depth", "gravity", "gyroscope_noise_density", "gyroscope_random_walk",
        "accelerometer_noise_density", "accelerometer_random_walk", "gyroscope_bias", "accelerometer_bias",
        "gyroscope_matrix", "accelerometer_matrix", "gyroscope_range", "accelerometer_range",
    }  # fmt: skip
    assert set(ImuConfig().content()) == before and not ImuConfig().has_truth(None)
    samples = simulate_imu(SPLINE, ImuConfig(), BEGIN, END, 0)
    np.testing.assert_array_equal(samples.stamps, samples.t)


@pytest.mark.parametrize("name", sorted(_IMU_PRESETS))
def test_a_preset_fills_in_what_is_not_said_and_reads_back(name: str) -> None:
    plain, bent = ImuConfig(preset=name), ImuConfig.model_validate({"preset": name, "rate_hz": 333.0})
    assert plain.rate_hz == 200.0 and bent.rate_hz == 333.0
    assert (
        plain.gyroscope_noise_density == bent.gyroscope_noise_density == _IMU_PRESETS[name]["gyroscope_noise_density"]
    )
    assert plain.gyroscope_range is not None and plain.has_truth(None)
    assert ImuConfig.model_validate(yaml.safe_load(yaml.safe_dump(plain.content()))) == plain
    np.testing.assert_allclose(plain.T_depth_imu() @ np.array(plain.T_imu_depth), np.eye(4), atol=1e-12)
    one, again, other = (simulate_imu(SPLINE, plain, BEGIN, BEGIN + 3.0, seed) for seed in (0, 0, 1))
    assert imu_csv(one) == imu_csv(again) != imu_csv(other)


def test_biases_warm_up_along_an_exponential() -> None:
    tau, size = 4.0, {"gyroscope_warmup": 0.01, "accelerometer_warmup": 0.2}
    samples = simulate_imu(SPLINE, config(warmup_s=tau, **size), BEGIN, END, 5)
    for bias, scale in ((samples.gyro_bias, 0.01), (samples.accel_bias, 0.2)):
        end = bias[-1] / -np.expm1(-(samples.t[-1] - BEGIN) / tau)
        np.testing.assert_allclose(bias, np.outer(1.0 - np.exp(-(samples.t - BEGIN) / tau), end), atol=1e-12)
        assert 0.0 < np.abs(end).max() < 5.0 * scale
    sizes = [
        simulate_imu(SPLINE, config(warmup_s=tau, **size), BEGIN, BEGIN + 20.0, seed).gyro_bias[-1]
        for seed in range(40)
    ]
    rms = float(np.sqrt(np.mean(np.square(sizes)))) / -np.expm1(-20.0 / tau)
    assert 0.01 * (1 - 5 / np.sqrt(240)) < rms < 0.01 * (1 + 5 / np.sqrt(240))
    # And they are in the readings.
    gyro, accel = exact_imu(SPLINE, np.linalg.inv(config().T_depth_imu()), config().gravity, samples.t)
    np.testing.assert_allclose(samples.gyro - gyro, samples.gyro_bias, atol=1e-12)
    np.testing.assert_allclose(samples.accel - accel, samples.accel_bias, atol=1e-11)


def test_jittered_samples_are_exact_at_their_own_times() -> None:
    samples = simulate_imu(SPLINE, config(), BEGIN, END, 1, ImuFaults(jitter_s=4e-4))
    late = samples.t - (BEGIN + np.arange(len(samples.t)) / 200.0)
    assert 3.5e-4 < late[1:-1].std() < 4.2e-4 and np.abs(late).max() <= 1e-3 + 1e-9  # cut off at 2.5 σ
    assert (np.diff(samples.t) > 0).all() and samples.t[0] >= BEGIN and samples.t[-1] <= END
    gyro, accel = exact_imu(SPLINE, np.linalg.inv(config().T_depth_imu()), config().gravity, samples.t)
    np.testing.assert_allclose(samples.gyro, gyro, atol=1e-14)
    np.testing.assert_allclose(samples.accel, accel, atol=1e-12)
    np.testing.assert_array_equal(samples.stamps, samples.t)


@pytest.mark.parametrize("run", [1.0, 6.0])
def test_the_part_that_is_lost_and_how_many_in_a_row(run: float) -> None:
    faults = ImuFaults(dropped=0.1, dropped_run=run)
    whole = simulate_imu(SPLINE, config(rate_hz=2000.0), BEGIN, END, 2)
    samples = simulate_imu(SPLINE, config(rate_hz=2000.0), BEGIN, END, 2, faults)
    index = np.searchsorted(whole.t, samples.t)
    np.testing.assert_array_equal(whole.t[index], samples.t)
    np.testing.assert_array_equal(whole.gyro[index], samples.gyro)  # what is left is as it was
    lost, count = 1.0 - len(samples.t) / len(whole.t), len(whole.t)
    assert abs(lost - 0.1) < 5.0 * np.sqrt(0.1 * 0.9 * 2.0 * run / count)
    gaps = np.diff(index)
    lengths = gaps[gaps > 1] - 1
    mean = run / (1.0 - 0.1) if run > 1 else 1.0 / 0.9  # runs that meet are one
    assert abs(lengths.mean() - mean) < 5.0 * lengths.std() / np.sqrt(len(lengths)) + 0.2
    shorter = simulate_imu(SPLINE, config(rate_hz=2000.0), BEGIN, BEGIN + 5.0, 2, faults)
    np.testing.assert_array_equal(samples.t[: len(shorter.t) - 1], shorter.t[:-1])


def test_a_clock_of_its_own_shows_in_stamps_alone() -> None:
    right = simulate_imu(SPLINE, config(), BEGIN, END, 0)
    wrong = simulate_imu(SPLINE, config(), BEGIN, END, 0, ImuFaults(**CLOCK))
    np.testing.assert_array_equal(wrong.t, right.t)
    np.testing.assert_array_equal(wrong.gyro, right.gyro)
    np.testing.assert_allclose(wrong.stamps - wrong.t, 0.0125 + 80e-6 * (wrong.t - BEGIN), atol=1e-9)
    erring = simulate_imu(SPLINE, config(), BEGIN, END, 0, ImuFaults(stamp_error_s=3e-4))
    assert 2.7e-4 < (erring.stamps - erring.t).std() < 3.3e-4 and (np.diff(erring.stamps) > 0).all()
    assert f"\n{round(wrong.stamps[7] * 1e9)}," in imu_csv(wrong)


def test_the_sequence_keeps_the_truth_and_the_tracker_reads_it(tmp_path: Path) -> None:
    imu = ImuConfig(preset="phone")
    root = make_sequence(tmp_path / "seq", with_imu(imu, dropped=0.02, **CLOCK), frames=4)
    truth, rows = (np.loadtxt(root / name, delimiter=",") for name in ("truth/imu.csv", "imu.csv"))
    np.testing.assert_array_equal(truth[:, 1], rows[:, 0])
    own, true = open_dataset(root).imu, open_dataset(root, imu_file=root / "truth/imu.yaml").imu
    assert own is not None and true is not None
    np.testing.assert_allclose(own.t, truth[:, 1] * 1e-9, atol=1e-12)  # as the unit says
    np.testing.assert_allclose(true.t, truth[:, 0] * 1e-9, atol=2e-9)  # as it is
    np.testing.assert_allclose(true.T_imu_depth, np.array(imu.T_imu_depth), atol=1e-12)
    assert true.noise == own.noise and (true.rate_hz, true.gravity) == (own.rate_hz, own.gravity)
    gyro, _ = exact_imu(make_spline(), np.array(imu.T_imu_depth), imu.gravity, truth[:, 0] * 1e-9)
    sigma = imu.gyroscope_noise_density * np.sqrt(imu.rate_hz)
    assert np.abs(rows[:, 1:4] - gyro - truth[:, 2:5]).std() < 1.3 * sigma
    checked = verify_sequence(root, pairs=1)
    (found,) = (check for check in checked.checks if check.name == "imu")
    assert found.ok
    text = (root / "truth/imu.csv").read_text()
    (root / "truth/imu.csv").write_text(text.replace("\n", "\n ", 1) if "-" not in text else text.replace("-", "", 1))
    (found,) = (check for check in verify_sequence(root, pairs=1).checks if check.name == "imu")
    assert not found.ok and "truth/imu.csv" in found.detail


def test_exports_take_the_units_stamps(tmp_path: Path) -> None:
    root = make_sequence(tmp_path / "seq", with_imu(config(), **CLOCK), frames=2)
    assert main(["export", "euroc", str(root)]) == 0 and main(["export", "kalibr", str(root)]) == 0
    stamps = np.loadtxt(root / "imu.csv", delimiter=",")[:, 0]
    euroc = np.loadtxt(root / "mav0/imu0/data.csv", delimiter=",")[:, 0]
    assert len(np.unique(np.round((euroc - stamps) / 1e9))) == 1
    truth = np.loadtxt(root / "mav0/state_groundtruth_estimate0/data.csv", delimiter=",")[:, 0]
    assert abs((euroc - truth).mean() * 1e-9 - 0.0125) < 1e-3  # of true times
    chain = yaml.safe_load((root / "kalibr/camchain.yaml").read_text())
    assert chain["cam1"]["timeshift_cam_imu"] == pytest.approx(0.0125, abs=1e-9)


@pytest.mark.parametrize(
    ("section", "wrong"),
    [
        (ImuConfig, {"preset": "watch"}),
        (ImuConfig, {"warmup_s": 0.0}),
        (ImuFaults, {"dropped": 1.0}),
        (ImuFaults, {"dropped_run": 0.5}),
        (ImuFaults, {"jitter_s": -1e-3}),
    ],
)
def test_absurd_settings_are_refused(section: type[BaseModel], wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        section.model_validate(wrong)


def test_blackouts_lose_all_images_of_their_time_and_nothing_else() -> None:
    stamps = np.arange(90) / 30.0
    faults = FaultsConfig(color=StreamFaults(blackouts=((0.5, 0.5), (2.0, 0.25))), depth=StreamFaults())
    delivery = deliver(stamps, faults.color, 0, "color")
    dark = ((stamps >= 0.5) & (stamps < 1.0)) | ((stamps >= 2.0) & (stamps < 2.25))
    np.testing.assert_array_equal(delivery.is_delivered, ~dark)
    np.testing.assert_allclose(delivery.listed, stamps, atol=1e-9)
    content = make_config().model_copy(update={"faults": faults}).content()
    assert "blackouts" in content["color"]["driver"] and "blackouts" not in content["depth"]["driver"]


@pytest.mark.parametrize("name", ["imu_fast", "imu_walls"])
def test_shipped_configs_have_a_phones_imu(name: str) -> None:
    shipped = load_config(Path(__file__).parents[3] / f"configs/{name}.yaml")
    imu, faults = shipped.imu, shipped.injected.imu
    assert imu is not None and imu.preset == "phone"
    assert faults is not None and faults.model_dump(exclude_defaults=True) == _IMU_FAULTS["phone"]
    assert not np.allclose(se3.log(np.array(imu.T_imu_depth)), 0.0)
