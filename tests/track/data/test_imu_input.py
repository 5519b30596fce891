"""An IMU's files as a dataset gives them: layouts, units, clocks, places, and one line for whatever is wrong."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from synthetic import make_config, make_sequence
from tum_recording import STAMPS, make_tum
from util import swung

from rsgen.config.sections import ImuConfig
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.sensors.imu import ImuSamples, imu_csv, simulate_imu
from rstrack.cli.main import main
from rstrack.data.dataset import open_dataset
from rstrack.data.imu.description import PHONE, of_sequence
from rstrack.data.imu.samples import RecordedImu, check_units

T_IMU_DEPTH = se3.exp(np.array([0.02, -0.01, 0.03, 0.3, -0.2, 1.0]))
CONFIG = ImuConfig(
    T_imu_depth=T_IMU_DEPTH.tolist(), accelerometer_bias=(0.1, -0.2, 0.05), gyroscope_bias=(0.01, 0.02, -0.01)
)
EPOCH_S = 1305031100
YAML = {"T_imu_depth": T_IMU_DEPTH.tolist()}


SAMPLES = simulate_imu(swung(), CONFIG, 0.0, 12.0, seed=3)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A TUM folder with the samples at its images' time, and what is known of them."""
    root = make_tum(tmp_path / "mine")
    (root / "imu.csv").write_text(imu_csv(SAMPLES, EPOCH_S))
    (root / "imu.yaml").write_text(yaml.safe_dump(YAML))
    return root


def sequence(root: Path, imu: ImuConfig) -> Path:
    """A sequence of two frames with an IMU."""
    return make_sequence(root, make_config().model_copy(update={"imu": imu}), frames=2)


def rows(root: Path) -> tuple[str, np.ndarray]:
    head, *lines = (root / "imu.csv").read_text().splitlines()
    return head, np.array([line.split(",") for line in lines], dtype=object)


def change(root: Path, edit: Callable[[np.ndarray], np.ndarray | None]) -> None:
    """Edits the table of texts (n, 7) of imu.csv."""
    head, table = rows(root)
    found = edit(table)
    table = table if found is None else found
    (root / "imu.csv").write_text("\n".join([head, *(",".join(map(str, row)) for row in table), ""]))


def times(columns: slice, factor: float) -> Callable[[np.ndarray], None]:
    def edit(table: np.ndarray) -> None:
        table[:, columns] = table[:, columns].astype(float) * factor

    return edit


def problem(root: Path, imu_file: Path | None = None) -> str:
    with pytest.raises(UserError) as caught:
        _ = open_dataset(root, imu_file=imu_file).imu
    text = str(caught.value)
    assert "\n" not in text and str(root) in text
    return text


# --- what is read ----------------------------------------------------------------------------------------------------


def test_a_sequence_tells_its_imu_but_not_its_errors(tmp_path: Path) -> None:
    section = {"rate_hz": 400.0, "gyroscope_range": 4.0, "gravity": (0.0, 0.0, -9.7)}
    root = sequence(tmp_path / "seq", CONFIG.model_copy(update=section))
    imu = open_dataset(root).imu
    assert imu is not None and imu.gyro is not None
    assert (imu.rate_hz, imu.gravity) == (400.0, pytest.approx(9.7))
    np.testing.assert_allclose(imu.T_imu_depth, T_IMU_DEPTH, atol=1e-12)
    noise = imu.noise
    assert (noise.gyro_density, noise.gyro_walk, noise.accel_density, noise.accel_walk) == (
        CONFIG.gyroscope_noise_density, CONFIG.gyroscope_random_walk, CONFIG.accelerometer_noise_density,
        CONFIG.accelerometer_random_walk,
    )  # fmt: skip
    assert (noise.gyro_range, noise.accel_range) == (4.0, None)
    written = np.loadtxt(root / "imu.csv", delimiter=",")
    np.testing.assert_allclose(imu.t, written[:, 0] * 1e-9, atol=1e-12)
    np.testing.assert_array_equal(np.hstack([imu.gyro, imu.accel]), written[:, 1:])


def test_of_registered_depth_the_place_is_that_of_the_images() -> None:
    config = make_config().model_copy(update={"imu": CONFIG})
    meta = {"config": config.content(), "T_color_depth": [list(row) for row in config.T_color_depth]}
    for registered in (False, True):
        said = of_sequence(Path("sequence.yaml"), meta | {"streams": {"depth": {"registered": registered}}})
        assert said is not None and said.T_imu_depth is not None
        T = said.T_imu_depth @ np.array(config.T_color_depth) if registered else said.T_imu_depth
        np.testing.assert_allclose(T, T_IMU_DEPTH, atol=1e-9)


def test_nothing_is_read_before_it_is_asked_for(folder: Path) -> None:
    (folder / "imu.csv").write_text("nonsense")
    dataset = open_dataset(folder)
    assert len(dataset) == len(STAMPS)
    problem(folder)
    (folder / "imu.csv").unlink()
    assert open_dataset(folder).imu is None


def test_a_folder_with_an_imu_yaml(folder: Path) -> None:
    read = open_dataset(folder).read_imu
    assert read is not None and read.recording.gyro is not None
    imu = read.recording
    np.testing.assert_allclose(imu.T_imu_depth, T_IMU_DEPTH, atol=1e-12)
    np.testing.assert_allclose(imu.gyro, SAMPLES.gyro, atol=1e-9)
    np.testing.assert_allclose(imu.t - EPOCH_S, SAMPLES.t, atol=3e-7)  # what a double holds of such times
    assert imu.noise == PHONE and imu.rate_hz == pytest.approx(200.0)
    assert len(read.notes) == 1 and "phone" in read.notes[0]


def test_kalibrs_files(folder: Path, tmp_path: Path) -> None:
    """Its input has densities; its results everything below imu0; extrinsics by way of the colour camera."""
    T_color_depth = se3.exp(np.array([-0.025, 0.001, 0.0, 0.01, 0.0, 0.02]))
    camera = yaml.safe_load((folder / "camera.yaml").read_text())
    (folder / "camera.yaml").write_text(yaml.safe_dump(
        camera | {"depth": camera["color"], "T_color_depth": T_color_depth.tolist()}
    ))  # fmt: skip
    T_cam_imu = T_color_depth @ se3.inverse(T_IMU_DEPTH)
    said = {
        "accelerometer_noise_density": 0.006, "accelerometer_random_walk": 0.0002, "gyroscope_noise_density": 0.0004,
        "gyroscope_random_walk": 4e-6, "rostopic": "/imu0", "update_rate": 200.0,
    }  # fmt: skip
    results = {"imu0": said | {"T_i_b": np.eye(4).tolist(), "model": "calibrated", "time_offset": 0.0}}
    results["imu0"]["T_cam_imu"] = T_cam_imu.tolist()
    for content in (said | {"T_cam_imu": T_cam_imu.tolist()}, results):
        file = tmp_path / "kalibr.yaml"
        file.write_text(yaml.safe_dump(content))
        imu = open_dataset(folder, imu_file=file).imu
        assert imu is not None
        np.testing.assert_allclose(imu.T_imu_depth, T_IMU_DEPTH, atol=1e-6)
        assert (imu.noise.gyro_density, imu.noise.accel_walk) == (0.0004, 0.0002)


def test_rsgens_own_export_for_kalibr_is_read(tmp_path: Path) -> None:
    from rsgen.formats.export.kalibr import export_kalibr
    from rsgen.sequence.reader import read_sequence

    root = sequence(tmp_path / "seq", CONFIG)
    export_kalibr(read_sequence(root), tmp_path / "kalibr")
    chain = yaml.safe_load((tmp_path / "kalibr/camchain.yaml").read_text())
    said = yaml.safe_load((tmp_path / "kalibr/imu.yaml").read_text()) | {"T_cam_imu": chain["cam0"]["T_cam_imu"]}
    (tmp_path / "imu.yaml").write_text(yaml.safe_dump(said))
    given, own = open_dataset(root, imu_file=tmp_path / "imu.yaml").imu, open_dataset(root).imu
    assert given is not None and own is not None
    np.testing.assert_allclose(given.T_imu_depth, own.T_imu_depth, atol=1e-9)
    assert given.noise == own.noise


def test_clock_scale_and_misalignment_are_undone(folder: Path) -> None:
    M = np.array([[1.02, 0.01, 0.0], [0.0, 0.97, 0.02], [0.0, 0.0, 1.01]])
    said = {"offset_s": 0.25, "drift_ppm": 100.0, "gyroscope_matrix": M.tolist(), "accelerometer_matrix": M.T.tolist()}
    (folder / "imu.yaml").write_text(yaml.safe_dump(YAML | said))
    dataset = open_dataset(folder)
    imu = dataset.imu
    assert imu is not None and imu.gyro is not None
    np.testing.assert_allclose(imu.gyro @ M.T, SAMPLES.gyro, atol=1e-9)
    np.testing.assert_allclose(imu.accel @ M, SAMPLES.accel, atol=1e-9)
    listed = SAMPLES.t + EPOCH_S
    np.testing.assert_allclose(imu.t - listed, 0.25 + 1e-4 * (listed - dataset.middle), atol=1e-6)


def test_euroc_folder_beside_the_listings(folder: Path) -> None:
    T_body = {"imu0": se3.exp(np.array([0.1, 0.0, 0.2, 0.3, 0.0, 1.0])), "depth0": se3.exp(np.ones(6) * 0.1)}
    for name, T in T_body.items():
        (folder / "mav0" / name).mkdir(parents=True)
        content = {"T_BS": {"cols": 4, "rows": 4, "data": T.ravel().tolist()}, "rate_hz": 200}
        if name == "imu0":
            content |= {"gyroscope_noise_density": 1e-4, "gyroscope_random_walk": 1e-5,
                        "accelerometer_noise_density": 2e-3, "accelerometer_random_walk": 3e-3}  # fmt: skip
        text = yaml.safe_dump(content)
        (folder / "mav0" / name / "sensor.yaml").write_text(f"%YAML:1.0\n---\n{text}" if name == "imu0" else text)
    (folder / "imu.csv").rename(folder / "mav0/imu0/data.csv")
    imu = open_dataset(folder).imu
    assert imu is not None
    np.testing.assert_allclose(imu.T_imu_depth, se3.inverse(T_body["imu0"]) @ T_body["depth0"], atol=1e-9)
    assert imu.noise.accel_walk == 3e-3


def test_tums_accelerometer_alone(folder: Path) -> None:
    (folder / "imu.csv").unlink()
    (folder / "imu.yaml").unlink()
    table = np.column_stack([SAMPLES.t + EPOCH_S, SAMPLES.accel])
    lines = [f"{row[0]:.6f} " + " ".join(f"{x:.6f}" for x in row[1:]) for row in table]
    (folder / "accelerometer.txt").write_text("\n".join(["# accelerometer data", "# timestamp ax ay az", *lines]))
    read = open_dataset(folder).read_imu
    assert read is not None and read.recording.gyro is None
    np.testing.assert_allclose(read.recording.accel, SAMPLES.accel, atol=1e-6)
    # fr1_desk begins with -0.084 7.244 -6.658: a camera that looks down onto a desk. Up is then -y of its images.
    up = read.recording.T_imu_depth[:3, :3].T @ np.array([-0.084, 7.244, -6.658])
    assert up[1] < 0.0 and up[2] < 0.0
    assert any("Kinect" in note for note in read.notes)


# --- what is odd, and said -------------------------------------------------------------------------------------------


def test_gaps_are_counted_not_refused(folder: Path) -> None:
    change(folder, lambda table: np.delete(table, [*range(700, 720), 900], axis=0))
    read = open_dataset(folder).read_imu
    assert read is not None and len(read.recording.t) == len(SAMPLES.t) - 21
    (note,) = (note for note in read.notes if "missing" in note)
    assert "21 samples" in note and "2 gaps" in note and "0.105 s" in note


def test_what_is_not_covered_and_saturated_is_said(folder: Path) -> None:
    begin = round((STAMPS[1] - EPOCH_S) * 200.0)
    change(folder, lambda table: table[begin:])
    (folder / "imu.yaml").write_text(yaml.safe_dump(YAML | {"gyroscope_range": 0.8, "update_rate": 100.0}))
    read = open_dataset(folder).read_imu
    assert read is not None
    notes = "; ".join(read.notes)
    assert "covers 66 %" in notes and "at its range" in notes and "not 100 as imu.yaml states" in notes
    assert read.recording.rate_hz == pytest.approx(200.0)


# --- what is wrong ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (times(slice(1, 4), 180.0 / np.pi), ["gyroscope", "deg/s", "0.0174533"]),
        (times(slice(4, 7), 1 / 9.80665), ["accelerometer in g", "multiply by 9.80665"]),
        (times(slice(4, 7), 1e3 / 9.80665), ["accelerometer in mg"]),
        (times(slice(4, 7), 30.0), ["accelerometer's median"]),
        (times(slice(1, 4), 0.0), ["gyroscope is 0 throughout"]),
        (lambda table: table[::-1], ["sort the file by time"]),
        (lambda table: np.insert(table, 7, table[6], axis=0), ["line 9", "repeats the stamp of line 8"]),
        (lambda table: table[::10], ["samples a second", "100 Hz or more"]),
        (lambda table: table[:5], ["too few"]),
        (lambda table: table[:, :6], ["6 numbers, expected 7"]),
    ],
)
def test_wrong_samples_are_named_with_their_cure(
    folder: Path, edit: Callable[[np.ndarray], np.ndarray | None], words: list[str]
) -> None:
    change(folder, edit)
    text = problem(folder)
    assert all(word in text for word in words), text


def test_readings_without_gravity_are_told_from_those_with(folder: Path) -> None:
    def edit(table: np.ndarray) -> None:
        table[:, 4:] = np.random.default_rng(0).normal(0.0, 1.0, (len(table), 3))

    change(folder, edit)
    assert "gravity was taken out" in problem(folder)


@pytest.mark.parametrize(("word", "line"), [("nan", 12), ("1e999", 12), ("one", 12), ("", 12)])
def test_what_is_no_number_is_found_by_its_line(folder: Path, word: str, line: int) -> None:
    def edit(table: np.ndarray) -> None:
        table[line - 2, 3] = word

    change(folder, edit)
    assert f"imu.csv line {line}" in problem(folder)


@pytest.mark.parametrize(("factor", "unit"), [(1e-9, "s"), (1e-6, "ms"), (1e-3, "µs")])
def test_stamps_in_other_units(folder: Path, factor: float, unit: str) -> None:
    def edit(table: np.ndarray) -> None:
        table[:, 0] = [f"{int(ns) * factor:.9f}" for ns in table[:, 0]]

    change(folder, edit)
    text = problem(folder)
    assert f"stamps in {unit}, not in ns" in text and f"multiply them by {1 / factor:g}" in text


def test_samples_of_another_time_say_which_offset_would_do(folder: Path) -> None:
    (folder / "imu.csv").write_text(imu_csv(SAMPLES, EPOCH_S + 1000))
    text = problem(folder)
    assert "another clock" in text
    offset = float(text.partition("offset_s: ")[2].split()[0])
    (folder / "imu.yaml").write_text(yaml.safe_dump(YAML | {"offset_s": offset}))
    assert open_dataset(folder).imu is not None


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ({}, ["T_imu_depth", "--free imu"]),
        ({"T_imu_depth": [[2, 0, 0, 0]] * 4}, ["T_imu_depth", "rigid"]),
        ({"T_imu_depth": 7}, ["T_imu_depth", "rigid"]),
        (YAML | {"T_imu_deph": 1}, ["T_imu_deph", "no such entry"]),
        (YAML | {"gyroscope_noise_density": 1e-4}, ["accelerometer_noise_density", "all four"]),
        (YAML | {"gyroscope_noise_density": -1}, ["gyroscope_noise_density"]),
        (YAML | {"model": "scale-misalignment"}, ["scale-misalignment", "gyroscope_matrix"]),
        (YAML | {"gyroscope_matrix": [[0, 0, 0]] * 3}, ["gyroscope_matrix"]),
    ],
)
def test_a_wrong_imu_yaml(folder: Path, said: dict[str, object], words: list[str]) -> None:
    (folder / "imu.yaml").write_text(yaml.safe_dump(said) if said else "{update_rate: 200}")
    text = problem(folder)
    assert all(word in text for word in words), text


def test_a_description_without_samples_and_a_named_file_are_faults_at_once(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"nowhere\.yaml: cannot be read"):
        open_dataset(folder, imu_file=tmp_path / "nowhere.yaml")
    (folder / "imu.csv").unlink()
    with pytest.raises(UserError, match="has no samples"):
        open_dataset(folder, imu_file=folder / "imu.yaml")


def test_info_says_it_in_a_line(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(folder)]) == 0
    assert "gyroscope and accelerometer, 2401 samples at 200 Hz" in capsys.readouterr().out
    change(folder, times(slice(1, 4), 180.0 / np.pi))
    assert main(["info", str(folder)]) == 0
    assert "not to be used" in capsys.readouterr().out
    assert main(["info", str(folder), "--imu", str(folder / "imu.yaml")]) == 2
    assert "deg/s" in capsys.readouterr().err
    (folder / "imu.csv").write_bytes(b"\xff\xfe\0garbage")
    assert main(["track", str(folder), "--imu", str(folder / "imu.yaml"), "--out", str(folder / "run")]) == 2
    assert capsys.readouterr().err.count("\n") == 1 and not (folder / "run").exists()


def test_units_are_right_for_every_shipped_motion_and_a_bad_sensor() -> None:
    """No false alarm where biases and noise are many times what units have."""
    for seed in range(6):
        bad = CONFIG.model_copy(update={"gyroscope_noise_density": 5e-3, "accelerometer_noise_density": 2e-2,
                                        "gyroscope_bias": (0.2, -0.1, 0.1)})  # fmt: skip
        samples: ImuSamples = simulate_imu(swung(4.0 + seed), bad, 0.0, 4.0 + seed, seed)
        for factor in (1.0, 180.0 / np.pi):
            table = RecordedImu(
                Path("x"), samples.t, factor * samples.gyro, samples.accel, np.arange(len(samples.t)), 1e-9
            )
            if factor == 1.0:
                check_units(table, 9.80665)
            else:
                with pytest.raises(UserError, match="deg/s"):
                    check_units(table, 9.80665)
