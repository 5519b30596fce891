"""The measures `lens` and `crossed`: what they tell wrong, and whose camera they track with."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import synthetic
from bench_task import make_task

from benchmarks.measures import calibration as lens
from benchmarks.measures.calibration import crossed_cell, lens_cell
from rsgen.console.progress import no_progress
from rsgen.errors import UserError
from rstrack.bench.task import Task
from rstrack.calibration.parameters import COUNT
from rstrack.calibration.run import parameters_of
from rstrack.data.dataset import Dataset

CAMERA = "color: {width: 32, height: 24, intrinsics: [24, 24, 15.5, 11.5], readout_s: 0.02}\n"


def found(told: Dataset) -> Any:
    """A calibration that leaves cameras as they are, sure to a unit of each."""
    solution = SimpleNamespace(finished=True, covariance=np.eye(COUNT))
    return SimpleNamespace(
        values=parameters_of(told), sigmas=np.ones(COUNT), solution=solution, seconds=3.0, calibrated=lambda: told,
    )  # fmt: skip


def made(tmp_path: Path, name: str, **more: Any) -> Path:
    stream = {"readout_s": 0.02, "intrinsics": [24.0, 24.0, 15.5, 11.5]}
    config = synthetic.make_config(width=32, height=24, color=stream, depth=stream | more)
    writer = synthetic.open_writer(
        tmp_path / name, config.model_copy(update={"T_color_depth": tuple(map(tuple, np.eye(4).tolist()))}), 6
    )
    synthetic.write_frames(writer)
    writer.finish()
    return tmp_path / name


def test_a_lens_that_nobody_finds_is_as_wrong_as_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Dataset] = []

    def calibrate(told: Dataset, **_: Any) -> Any:
        seen.append(told)
        return found(told)

    monkeypatch.setattr(lens, "calibrate", calibrate)
    figures = lens_cell(make_task(made(tmp_path, "seq"), "rs-pg", settings={"starts": 3}), no_progress)
    assert figures["before_px"] == figures["after_px"] and figures["after_px_max"] > 0.5
    assert figures["within_2_sigma_pct"] == 100.0 and figures["told"] == 36 and figures["calibration_s"] == 3.0
    lenses = {told.rig.color_camera for told in seen}
    assert len(lenses) == 3 and all(told.rig.is_registered and not told.rig.sigma.is_exact for told in seen)
    assert all(told.rig.depth_shutter.readout_s == 0.0 for told in seen)
    apart = make_task(made(tmp_path, "other", intrinsics=[23.0, 23.0, 15.5, 11.5]), "rs-pg")
    with pytest.raises(UserError, match="not registered"):
        lens_cell(apart, no_progress)


def test_a_recording_is_tracked_with_the_camera_that_another_gave(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, other = made(tmp_path, "seq"), made(tmp_path, "other")
    file = tmp_path / "camera.yaml"
    file.write_text(CAMERA)
    tracked: list[Task] = []

    def track_cell(task: Task, _: Any) -> Any:
        tracked.append(task)
        return {"ate_mm": 1.0}

    def calibrate(told: Dataset, **_: Any) -> Any:
        assert told.root == other and told.rig.color_camera.fx == 24.0
        return found(replace(told))

    monkeypatch.setattr(lens, "camera_file_of", lambda _: CAMERA.replace("24, 24,", "25, 25,"))
    monkeypatch.setattr(lens, "track_cell", track_cell)
    monkeypatch.setattr(lens, "calibrate", calibrate)
    task = make_task(root, "rs-pg", settings={"calibrated_on": "other"}, camera=file)
    assert crossed_cell(task, no_progress) == {"ate_mm": 1.0, "calibration_s": 3.0}
    assert tracked[0].root == root and tracked[0].dataset.rig.color_camera.fx == 25.0
