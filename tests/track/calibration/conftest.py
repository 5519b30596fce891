"""What several files of tests calibrate with."""

from __future__ import annotations

import pytest

from rstrack.calibration import run
from rstrack.calibration.pairs import window


@pytest.fixture
def few_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    """A quarter of the pairs of frames, and one coarse level: what all find stands beside the derivatives."""
    monkeypatch.setattr(window, "_APART", (5,))
    monkeypatch.setattr(run, "_COARSE", (1,))
