"""The measure `calibration`: wrong cameras, and what is made of the trials."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import synthetic
from bench_task import make_task

from benchmarks.measures import calibration
from benchmarks.measures.calibration import (
    UNIT_M,
    CalibrationTrial,
    calibration_cell,
    figures_of,
    stated_wrong,
    true_dataset,
)
from rsgen.config.config import Config
from rsgen.console.progress import no_progress
from rsgen.errors import UserError
from rstrack.calibration.parameters import COUNT, DRIFT, EXTRINSICS, POSES
from rstrack.calibration.run import parameters_of
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.data.image_files import NoisyImages

UNIT = [1.0, -1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    root = tmp_path_factory.mktemp("bench_calibration") / "seq"
    stream = {"readout_s": 0.02}
    writer = synthetic.open_writer(root, synthetic.make_config(width=32, height=24, color=stream, depth=stream), 6)
    synthetic.write_frames(writer)
    writer.finish()
    return open_dataset(root)


def test_a_wrong_camera_is_off_by_that_much_in_all_values_at_once(tiny: Dataset) -> None:
    truth = parameters_of(tiny)
    off = parameters_of(stated_wrong(tiny, truth, 2.0, UNIT)).since(truth)
    np.testing.assert_allclose(off[:3], [0.02, -0.02, 0.03], atol=1e-12)  # readouts by 2 x 50 %, one of them to 0
    assert off[DRIFT] == 0.0
    np.testing.assert_allclose(off[EXTRINSICS], [2 * UNIT_M, 0, 0, 0, 0, np.radians(1.0)], atol=1e-9)
    further = parameters_of(stated_wrong(tiny, truth, 4.0, UNIT))
    assert (further.depth_readout_s, further.color_readout_s) == pytest.approx((0.06, 0.0))
    same = stated_wrong(tiny, truth, 0.0, UNIT)
    np.testing.assert_array_equal(same.color_stamps, tiny.color_stamps)


def trial(factor: float, error: float, sigma: float, **more: Any) -> CalibrationTrial:
    return CalibrationTrial(factor, np.full(POSES, error), np.full(POSES, sigma), **({"converged": True} | more))


def test_what_becomes_of_trials_is_counted() -> None:
    nothing = np.full(POSES, np.nan)
    found = figures_of([
        trial(1.0, 1e-4, 1e-4, seconds=2.0), trial(1.0, -3e-4, 1e-4), trial(1.0, 5e-4, 1e-4),
        trial(1.0, 9.0, 1.0, converged=False, seconds=2.0),
        CalibrationTrial(4.0, nothing, nothing, refused="frames only"),
    ])  # fmt: skip
    names = "found_pct", "not_converged", "refused", "wrong_unnoticed"
    assert [found[f"{name}_1x"] for name in names] == [50.0, 1, 0, 1]
    assert [found[f"{name}_4x"] for name in names] == [0.0, 0, 1, 0]
    assert found["median_color_clock_ms_1x"] == pytest.approx(0.2)
    assert found["median_rz_deg_1x"] == pytest.approx(np.degrees(2e-4)) and found["median_x_mm_4x"] is None
    for name in ("", "_x"):
        assert found[f"within_2_sigma_pct{name}"] == pytest.approx(100 / 3)
        assert found[f"rms_over_sigma{name}"] == pytest.approx(np.sqrt((1 + 9 + 25) / 3))
    assert found["told_x"] == 3 and found["told"] == 27 and "told_color_drift" not in found
    assert found["calibration_s"] == 1.0


def test_bad_settings_and_short_recordings(tiny: Dataset) -> None:
    for settings, match in (
        ({"starts": 0}, "starts"), ({"factors": [-1.0]}, "0 or more"), ({"factors": []}, "factors"),
        ({"start": 1}, "measure/seq/rs-pg: settings: start: Extra"),
    ):  # fmt: skip
        with pytest.raises(UserError, match=match):
            calibration_cell(make_task(tiny.root, "rs-pg", settings=settings), no_progress)
    found = calibration_cell(make_task(tiny.root, "rs-pg", settings={"starts": 2, "factors": [0, 1]}), no_progress)
    assert found["refused_0x"] == found["refused_1x"] == 2 and found["found_pct_0x"] == 0.0
    assert found["within_2_sigma_pct"] is None and found["told"] == 0 and found["calibration_s"] is None


def test_each_start_has_its_own_noise_and_errors_are_those_of_what_is_found(
    tiny: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a calibration that leaves cameras as they are, errors are what they are told wrong by."""
    noises = []

    def calibrate(told: Dataset, **_: Any) -> Any:
        assert isinstance(told.images, NoisyImages)
        noises.append(told.images.seed)
        solution = SimpleNamespace(finished=True, is_settled=True)
        return SimpleNamespace(values=parameters_of(told), sigmas=np.ones(COUNT), solution=solution, seconds=3.0)

    monkeypatch.setattr(calibration, "calibrate", calibrate)
    settings = {"starts": 2, "factors": [1.0]}
    task = make_task(tiny.root, "rs-pg", settings=settings, seed=3, noise={"depth": 1e-3})
    found = calibration_cell(task, no_progress)
    assert noises == [6, 7] and found["found_pct_1x"] == 100.0 and found["calibration_s"] == 3.0
    assert found["median_depth_readout_ms_1x"] == pytest.approx(10.0)
    assert found["median_color_clock_ms_1x"] == pytest.approx(15.0)


def test_declared_cameras_are_not_the_truth(tmp_path: Path) -> None:
    stream = {"readout_s": 0.02}
    settings = synthetic.make_config(width=32, height=24, color=stream, depth=stream).model_dump()
    config = Config.model_validate(settings | {"faults": {"declared": {"color": {"readout_s": 0.0}}}})
    root = synthetic.make_sequence(tmp_path / "seq", config, 4)
    task = make_task(root, "rs-pg")
    assert parameters_of(task.dataset).color_readout_s == 0.0
    assert parameters_of(true_dataset(task)).color_readout_s == 0.02
