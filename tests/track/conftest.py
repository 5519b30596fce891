"""What several files of tests track."""

from __future__ import annotations

import pytest
from shaken_recording import FRAMES, recording, shaking

from rstrack.calibration import run as calibration_run
from rstrack.data.dataset import Dataset


@pytest.fixture(scope="session")
def shaken(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """A second of a camera that is shaken before a corner of a room."""
    return recording(tmp_path_factory.mktemp("shaken") / "seq", shaking(), frames=FRAMES)


@pytest.fixture
def in_one_phase(monkeypatch: pytest.MonkeyPatch) -> None:
    """With these knots only, in three quarters of the time: for what is found either way."""
    monkeypatch.setattr(calibration_run, "_at_other_knots", lambda *given: given[3])
