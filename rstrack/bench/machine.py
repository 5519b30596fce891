"""What figures are taken on, and by which version: the machine, its load, its memory, the commit."""

from __future__ import annotations

import os
import platform
import resource
import subprocess
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any


def machine() -> dict[str, Any]:
    """What figures are taken on, and how busy it is (load: average of the last minute)."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {
        "cpu": models[0] if models else platform.processor() or platform.machine(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "load": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "system": platform.system(),
        "python": platform.python_version(),
    }


def stamped(record: Mapping[str, Any]) -> dict[str, Any]:
    """Version, commit, date and machine, now."""
    return dict(record) | {
        "version": package_version(), "commit": commit(), "date": f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}",
        "machine": machine(),
    }  # fmt: skip


def package_version() -> str:
    """Of this project."""
    return version("rolling-shutter-rgbd")


def versions_behind(version: str) -> int:
    """Minor versions by which another one of this project is older; many where the major one is another."""
    then, now = (tuple(int(part) for part in text.split(".")[:2]) for text in (version, package_version()))
    return now[1] - then[1] if then[0] == now[0] else 999


@cache
def commit() -> str | None:
    """Of the checkout that this code is in, with a + where files have changed since; None outside of one."""
    here = Path(__file__).parent
    try:
        described = subprocess.run(
            ["git", "describe", "--always", "--abbrev=12", "--dirty=+", "--exclude=*"],
            cwd=here, capture_output=True, text=True, check=False, timeout=10,
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired):
        return None
    return described.stdout.strip() or None


def reset_peak() -> None:
    """Begin anew, where the system can (Linux); elsewhere the peak stays that of the process's life."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return


def peak_mb() -> float:
    """Most main memory at a time since then, MB."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(float(line.split()[1]) * 1024e-6 for line in lines if line.startswith("VmHWM"))
    except (OSError, StopIteration):
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak * (1e-6 if sys.platform == "darwin" else 1024e-6)
