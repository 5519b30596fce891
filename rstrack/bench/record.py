"""What a cell of a benchmark came to, on which machine and by which version: records, JSON on disk, one or many a file.

records = read_records(Path("benchmarks/results/gate.json"))
print(records["track/demo/rs-pg"].figures["ate_mm"])
"""

from __future__ import annotations

import json
import math
import os
import platform
import resource
import subprocess
import sys
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rsgen.files import atomic_write, read_text
from rstrack.bench.cells import OTHERS
from rstrack.data.estimate import plain
from rstrack.options import METHODS

Figures = dict[str, float | None]
"""Of one run, flat; units are in the names (ate_mm, median_ms, psnr_db, lost); None: could not be had."""

_DIGITS = 6
_ORDER = ("rs-pg", "rs-g", "rs-p", "rs-pgi", "rs-gi", "gs-pg", "gs-g", "gs-p", "baseline")
# A track with poses for fewer of the frames says little of its error: it counts as lost.
_LEAST_COVERAGE = 0.5


@dataclass(frozen=True)
class CellRecord:
    """One cell's outcome.

    cell: MEASURE/CASE/METHOD. key: what the runs depend on. seeds, runs: one run of figures for each seed that is done;
    complete: all of them are. settings: case, method and measure as they were defined. machine: CPU, cores, load before
    the first run. error: why there is nothing; skipped: whether that is no fault (a recording or a package is absent).
    scatter: by figure, what chance is measured to do to one run of this cell: a standard deviation (of logarithms,
    where `rstrack.bench.figures` compares in these) and its degrees of freedom; set when the records are accepted.
    """

    cell: str
    key: str
    settings: dict[str, Any]
    seeds: tuple[int, ...] = ()
    runs: tuple[Figures, ...] = ()
    complete: bool = False
    error: str | None = None
    skipped: bool = False
    seconds: float = 0.0
    version: str = ""
    commit: str | None = None
    date: str = ""
    machine: dict[str, Any] = field(default_factory=dict)
    scatter: dict[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def measure(self) -> str:
        """What was measured: the first part of the cell's name."""
        return self.cell.split("/")[0]

    @property
    def case(self) -> str:
        """On what: the second part."""
        return self.cell.split("/")[1]

    @property
    def method(self) -> str:
        """With what: the last part."""
        return self.cell.split("/")[2]

    @property
    def program(self) -> str:
        """The method or peer that ran, by its own name."""
        return str(self._part("method").get("method") or self.method)

    @property
    def options(self) -> dict[str, Any]:
        """Of our method, those that are not at their defaults."""
        return dict(self._part("method").get("options", {}))

    @property
    def is_others(self) -> bool:
        """Whether it measures other people's tracker: a peer, a command, or results in a folder."""
        entry = self._part("method")
        return bool(entry.get("command") or entry.get("results")) or self.program in OTHERS

    @property
    def sequence(self) -> str:
        """The sequence that the case is a part of."""
        return str(self._part("case").get("sequence", self.case))

    @property
    def group(self) -> str:
        """Cases that are averaged together; empty: none."""
        return str(self.settings.get("group") or "")

    @property
    def is_change(self) -> bool:
        """Whether something was done to a sequence: its case is named SEQUENCE-CHANGE, or of the group `changes`."""
        return self.group == "changes" or self.case.startswith(f"{self.sequence}-")

    @property
    def folder(self) -> Path:
        """Of its run, relative to that of the results."""
        return Path("cells", self.cell)

    @property
    def figures(self) -> dict[str, float]:
        """The mean of every figure over the runs that have it."""
        names = dict.fromkeys(name for run in self.runs for name in run)
        values = {name: self.values(name) for name in names}
        return {name: math.fsum(found) / len(found) for name, found in values.items() if found}

    def values(self, name: str) -> list[float]:
        """A figure of all runs that have it."""
        return [value for run in self.runs if (value := run.get(name)) is not None]

    def total(self, name: str) -> float:
        """A count's sum over the runs."""
        return math.fsum(self.values(name))

    @property
    def is_done(self) -> bool:
        """Whether there are figures."""
        return self.error is None and bool(self.runs)

    @property
    def is_good(self) -> bool:
        """Whether it has run and kept the track."""
        return self.error is None and counts(self.figures)

    @property
    def truth_offset_s(self) -> float | None:
        """The offset of the truth's clock that the errors are for, s; None for clocks as they are."""
        offset_ms = self.figures.get("truth_offset_ms")
        return None if offset_ms is None else 1e-3 * offset_ms

    def _part(self, name: str) -> dict[str, Any]:
        """What the settings have of case or method."""
        found = self.settings.get(name)
        return found if isinstance(found, dict) else {}


def counts(figures: Mapping[str, float | None]) -> bool:
    """Whether a run's errors mean something: at least half of the frames have a pose."""
    frames, lost = figures.get("frames") or 0.0, figures.get("lost") or 0.0
    return figures.get("ate_mm") is not None and lost <= (1.0 - _LEAST_COVERAGE) * frames


def figure(record: CellRecord | None, name: str) -> float | None:
    """A figure of a record; None where it failed, the track is lost or lacks it."""
    return record.figures.get(name) if record is not None and record.is_good else None


def frame_times(ms: FloatArray) -> Figures:
    """What frames took (n,), ms: median, mean and tails."""
    tails = {f"p{part}_ms": float(np.percentile(ms, part)) for part in (95, 99)}
    return {"median_ms": float(np.median(ms)), "mean_ms": float(ms.mean()), **tails}


def methods_in_order(records: Iterable[CellRecord]) -> list[str]:
    """Names of methods: ours first, variants after what they are variants of, then other people's."""

    def rank(record: CellRecord) -> tuple[bool, int, bool, str]:
        known = OTHERS if record.is_others else (*_ORDER, *METHODS)
        place = known.index(record.program) if record.program in known else len(known)
        return record.is_others, place, record.method != record.program, record.method

    return list(dict.fromkeys(record.method for record in sorted(records, key=rank)))


def write_records(path: Path, records: Iterable[CellRecord]) -> None:
    """All records into one file, a line a cell, in the order of their names. Raises UserError."""
    lines = [json.dumps(_short(record)) for record in sorted(records, key=lambda record: record.cell)]
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic_write(path, ("[\n" + ",\n".join(lines) + "\n]\n").encode())


def read_records(path: Path) -> dict[str, CellRecord]:
    """The records of a file by their cells' names. Raises UserError: it is missing, or is not one of these files."""
    try:
        return {data["cell"]: _record(data) for data in json.loads(read_text(path))}
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise UserError(f"{path}: is no file of benchmark records ({error}): write it with --accept") from None


def write_record(path: Path, record: CellRecord) -> None:
    """One record. Raises UserError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic_write(path, (json.dumps(_short(record), indent=1) + "\n").encode())


def read_record(path: Path) -> CellRecord | None:
    """One record; None if there is none that can be read."""
    try:
        return _record(json.loads(read_text(path)))
    except (UserError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return None


def _record(data: Mapping[str, Any]) -> CellRecord:
    scatter = {name: (float(sd), float(dof)) for name, (sd, dof) in data.get("scatter", {}).items()}
    return CellRecord(**{**data, "seeds": tuple(data["seeds"]), "runs": tuple(data["runs"]), "scatter": scatter})


def _short(record: CellRecord) -> dict[str, Any]:
    """Plain data, figures to six digits: more is not measured."""

    def short(value: float | None) -> float | None:
        if value is None or not math.isfinite(value):
            return None
        rounded = float(f"{value:.{_DIGITS}g}")
        return int(rounded) if rounded.is_integer() and abs(rounded) < 1e15 else rounded

    runs = [{name: short(value) for name, value in run.items()} for run in record.runs]
    data: dict[str, Any] = plain(asdict(record) | {"runs": runs})
    return data


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
