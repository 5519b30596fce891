"""What several files of tests track."""

from __future__ import annotations

from pathlib import Path

import pytest
from loop_room import NOISE, OPTIONS, make_dataset
from shaken_recording import FRAMES, recording, shaking

from rstrack.data.dataset import Dataset
from rstrack.metrics.association import truth_of
from rstrack.metrics.run_evaluate import add_errors
from rstrack.tracking.runs.run import track


@pytest.fixture(scope="session")
def shaken(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """A second of a camera that is shaken before a corner of a room."""
    return recording(tmp_path_factory.mktemp("shaken") / "seq", shaking(), frames=FRAMES)


@pytest.fixture(scope="session")
def to_and_fro(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """A second of a camera that comes back to where it was, twice."""
    return make_dataset(tmp_path_factory.mktemp("loops") / "seq")


@pytest.fixture(scope="session")
def closed_at_end(to_and_fro: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of it whose loops were closed at its end."""
    out = tmp_path_factory.mktemp("loops-run") / "run"
    result = track(to_and_fro, OPTIONS, out, noise=NOISE)
    assert result.lost == 0 and "closed" in result.loops
    assert add_errors(out, truth_of(to_and_fro), result.estimate, result.online).startswith("ATE before loops")
    return out
