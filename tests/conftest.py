"""Where several processes test at once, each has its share of the cores; and a fixture that many files share."""

from __future__ import annotations

import gc
import os
import shutil
from pathlib import Path

import pytest


def pytest_configure() -> None:
    """Dr.Jit's threads wait for work busily: two processes with all cores each are half as fast as with half each."""
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    if workers > 1:
        from rsgen.device.backend import select

        select()
        import drjit

        drjit.set_thread_count(max(1, len(os.sched_getaffinity(0)) // workers))


def pytest_collection_finish() -> None:
    """What all modules and tests have made stays: the collector need not look at it again and again."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def place(original: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy, to change, of the folder that the test's own file has made as `original`, as the working directory."""
    shutil.copytree(original, tmp_path / "w")
    monkeypatch.chdir(tmp_path / "w")
    return tmp_path / "w"
