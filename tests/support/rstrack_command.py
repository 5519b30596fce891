"""The `rstrack` command in the working directory, and a short sequence for it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import synthetic

from rstrack.cli.main import main

FRAMES = 14
SPEED = 0.3  # of `synthetic`: 0.27 m/s and 0.3 rad/s


def make_seq(root: Path) -> None:
    """Fourteen frames of 160x120 and their truth."""
    writer = synthetic.open_writer(root, synthetic.make_config(160, 120), FRAMES, synthetic.make_spline(SPEED))
    synthetic.write_frames(writer)
    synthetic.write_scene(root)
    writer.finish()


def run(capfd: pytest.CaptureFixture[str], words: str) -> tuple[int, str, str]:
    capfd.readouterr()
    status = main(words.split())
    out, error = capfd.readouterr()
    assert "Traceback" not in error
    return status, out, error


def refused(capfd: pytest.CaptureFixture[str], words: str, *parts: str) -> str:
    """Run a command line that has to fail: status 2, nothing on stdout, one line that names the culprit."""
    status, out, error = run(capfd, words)
    assert status == 2 and out == ""
    assert error.startswith("rstrack: ") and error.count("\n") == 1, error
    for part in parts:
        assert part in error, error
    return error


def read_info(folder: str) -> dict[str, Any]:
    info: dict[str, Any] = json.loads(Path(folder, "run.json").read_text())
    return info
