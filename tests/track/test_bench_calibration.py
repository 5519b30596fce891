"""`rstrack bench-calibration`: wrong cameras, and what is made of the trials."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import synthetic

from rsgen.config.config import Config
from rsgen.errors import UserError
from rstrack.bench.calibration import FACTORS, UNIT_M, CalibrationTrials, Trial, calibrations, told_wrong
from rstrack.calibration.run import parameters_of
from rstrack.calibration.unknowns.parameters import DRIFT, EXTRINSICS, POSES
from rstrack.cli.main import main
from rstrack.data.dataset import Dataset, open_dataset

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
    off = parameters_of(told_wrong(tiny, truth, 2.0, UNIT)).since(truth)
    np.testing.assert_allclose(off[:3], [0.02, -0.02, 0.03], atol=1e-12)  # readouts by 2 x 50 %, one of them to 0
    assert off[DRIFT] == 0.0
    np.testing.assert_allclose(off[EXTRINSICS], [2 * UNIT_M, 0, 0, 0, 0, np.radians(1.0)], atol=1e-9)
    further = parameters_of(told_wrong(tiny, truth, 4.0, UNIT))
    assert (further.depth_readout_s, further.color_readout_s) == pytest.approx((0.06, 0.0))
    same = told_wrong(tiny, truth, 0.0, UNIT)
    np.testing.assert_array_equal(same.color_stamps, tiny.color_stamps)


def trial(factor: float, error: float, sigma: float, **more: object) -> Trial:
    return Trial(factor, 0, np.full(POSES, error), np.full(POSES, sigma), **({"converged": True} | more))  # type: ignore[arg-type]


def test_what_becomes_of_trials_is_counted() -> None:
    nothing = np.full(POSES, np.nan)
    trials = (
        trial(1.0, 1e-4, 1e-4), trial(1.0, -3e-4, 1e-4), trial(1.0, 5e-4, 1e-4), trial(1.0, 9.0, 1.0, converged=False),
        Trial(4.0, 0, nothing, nothing, refused="frames only"),
    )  # fmt: skip
    found = CalibrationTrials("room", 90, trials)
    near, far = found.basin()
    assert [near[k] for k in ("starts", "found", "not_converged", "refused", "wrong")] == [4, 2, 1, 0, 1]
    assert [far[k] for k in ("starts", "found", "not_converged", "refused", "wrong")] == [1, 0, 0, 1, 0]
    assert near["median_errors"]["color.offset_s"] == pytest.approx(2e-4)
    cover = found.coverage()["T_color_depth.x"]
    assert cover == pytest.approx({"within": 1 / 3, "rms": np.sqrt((1 + 9 + 25) / 3), "trials": 3})
    assert "color.drift" not in found.coverage()
    text = found.text()
    assert "2 of 4" in text and "readouts 50 %, 15 ms, 5 mm, 0.5 deg" in text and "33 %" in text
    assert json.loads(json.dumps(found.as_dict()))["trials"][2]["wrong"] is True


def test_bad_numbers_and_short_recordings(tiny: Dataset, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UserError, match="1 or more starts"):
        calibrations(tiny, starts=0)
    with pytest.raises(UserError, match="0 or more"):
        calibrations(tiny, factors=(-1.0,))
    found = calibrations(tiny, starts=1, factors=FACTORS[:2])
    assert [t.converged for t in found.trials] == [False, False]
    assert all("too few" in t.refused for t in found.trials)
    assert main(["bench-calibration", str(tiny.root), "--starts", "1", "--factors", "1"]) == 0
    assert "0 of 1" in capsys.readouterr().out


def test_declared_cameras_are_not_the_truth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stream = {"readout_s": 0.02}
    settings = synthetic.make_config(width=32, height=24, color=stream, depth=stream).model_dump()
    config = Config.model_validate(settings | {"declared": {"color": {"readout_s": 0.0}}})
    root, given = synthetic.make_sequence(tmp_path / "seq", config, 4), []

    def record(dataset: Dataset, *_: object) -> CalibrationTrials:
        given.append(parameters_of(dataset).color_readout_s)
        return CalibrationTrials("seq", 4, ())

    monkeypatch.setattr("rstrack.bench.calibration.calibrations", record)
    assert main(["bench-calibration", str(root)]) == 0
    assert parameters_of(open_dataset(root)).color_readout_s == 0.0 and given == [0.02]
