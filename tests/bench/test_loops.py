"""The measure `loops`: true loops are told from false ones, and another room from the same one."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
from bench_task import make_task
from loop_room import make_dataset

import rstrack.bench.task
from benchmarks.measures.loops import loops_cell
from rsgen.console.progress import no_progress
from rsgen.errors import UserError
from rsgen.geometry.camera import Camera
from rstrack.bench.task import Absent, Task
from rstrack.data.dataset import Dataset

OPTIONS = {"keyframe_distance": 0.04, "bootstrap_frames": 3, "backend": "llvm"}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return make_dataset(tmp_path_factory.mktemp("loops") / "seq")


def task_of(dataset: Dataset, method: str = "rs-pg", frames: str | None = None, **settings: Any) -> Task:
    return make_task(dataset.root, method, OPTIONS, settings, frames=frames)


@pytest.fixture(autouse=True)
def opened(dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> dict[str, Dataset]:
    """What folders hold; by a lens that is known to be even: looking for that takes longer than a track."""
    datasets = {"seq": dataset, "other": dataset}
    (dataset.root.parent / "other").mkdir(exist_ok=True)
    monkeypatch.setattr(rstrack.bench.task, "open_dataset", lambda root, _: datasets[root.name])
    return datasets


def test_true_loops_are_told_from_false_ones(dataset: Dataset) -> None:
    found = loops_cell(task_of(dataset, alike=8), no_progress)
    assert found["loops"] > 3 and found["false"] == 0 and found["median_mm"] <= found["worst_mm"] < 5.0
    assert found["alike"] == 8 and found["accepted"] == 0 and found["keyframes"] > 3 and found["search_s"] > 0


@pytest.mark.nightly
def test_look_alikes_of_another_recording(dataset: Dataset) -> None:
    """In a mirror the room is another one; the room itself is the same place, though it is called another's."""
    accepted = []
    for other in ("mirrored", {"path": "other"}):
        found = loops_cell(task_of(dataset, frames="0:20", alike=5, other=other), no_progress)
        assert found["alike"] == 5
        accepted.append(found["accepted"])
    assert accepted[0] == 0 and accepted[1] >= 4


def test_what_cannot_be_compared_is_named(dataset: Dataset, opened: dict[str, Dataset]) -> None:
    def refused(match: str, error: type[UserError] = UserError, **settings: Any) -> None:
        with pytest.raises(error, match=match):
            loops_cell(task_of(dataset, **settings), no_progress)

    refused("nowhere: is not there", Absent, other={"path": "nowhere"})
    refused("settings: other", other="upside down")
    refused("baseline has no spline", method="baseline")
    rig = dataclasses.replace(dataset.rig, depth_camera=Camera(80, 60, 50.0, 50.0, 39.5, 29.5))
    opened["other"] = dataclasses.replace(dataset, rig=rig)
    refused("cameras are not those", other={"path": "other"})
    opened["seq"] = dataclasses.replace(dataset, truth=None)
    refused("no true spline")
