"""Runs the cells of a benchmark that are not there yet, one record each; and whole experiments, with what they came to.

records = run_cells(load_benchmark([Path("benchmarks/gate.yaml")]), Path("out/bench/gate"), Sources())
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

from rsgen.console.progress import Progress, ProgressDisplay, no_progress
from rsgen.console.scheduler import Workers, open_workers
from rsgen.device.backend import select
from rsgen.errors import UserError
from rstrack.bench.cells import Benchmark, Cell
from rstrack.bench.record import (
    CellRecord,
    package_version,
    peak_mb,
    read_record,
    reset_peak,
    stamped,
    versions_behind,
    write_record,
)
from rstrack.bench.task import MEASURES, Absent, Sources, Task, measure_named
from rstrack.data.estimate import TRAJECTORY

log = logging.getLogger("rstrack")

RECORD = "record.json"
OLDEST = 2
"""Minor versions that what takes hours may be behind."""
# Parts of both packages that show things, or read and write for other programs: figures do not depend on them.
_SHOWING = ("bench", "charts", "cli", "formats", "pack", "pictures", "report", "view")
# What describes a sequence, rsgen's or TUM's; the images themselves are not read for the key.
_DESCRIPTIONS = (
    "sequence.yaml", "rgb.txt", "depth.txt", "associations.txt", "groundtruth.txt", "camera.yaml", "calibration.yaml"
)  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """Records by their cells' names, of those that are done; interrupted: some are missing."""

    records: dict[str, CellRecord]
    interrupted: bool = False


@dataclass(frozen=True)
class Job:
    """One cell to run; plain enough to be sent to another process that sees the same files.

    code: what the code was that its figures depend on; empty: any of the last `OLDEST` minor versions'.
    """

    cell: Cell
    out: Path
    sources: Sources
    measure: str
    code: str


def run_cells(
    benchmark: Benchmark, out: Path, sources: Sources, workers: Workers | None = None, progress: Progress = no_progress,
    measures: Mapping[str, str] | None = None, done: Callable[[CellRecord], None] | None = None,
    expected_s: Mapping[str, float] | None = None,
) -> Outcome:  # fmt: skip
    """Run what `out` does not hold yet, in this process or by `workers`; Ctrl-C ends it with what is finished.

    measures: where more of them are found (`rstrack.bench.task`). done: called with each record. expected_s: what cells
    took before, by name, for the time that is left. Raises UserError: a measure that there is not, a folder that cannot
    be written or is not shared with the workers.
    """
    known = MEASURES | dict(measures or {})
    unknown = [cell.measure for cell in benchmark.cells if cell.measure not in known]
    if unknown:
        raise UserError(f"no measure '{unknown[0]}': choose {', '.join(known)}")
    known_by = {"version": package_version(), "third version": ""}
    jobs = [
        Job(
            cell, (out / "cells" / cell.name).resolve(), sources, where,
            code_digest(where) if benchmark.every == "code" else known_by[benchmark.every],
        )
        for cell in benchmark.cells
        for where in [known[cell.measure]]
    ]  # fmt: skip
    records: dict[str, CellRecord] = {}
    known_s = dict(expected_s or {})
    median_s = sorted(known_s.values())[len(known_s) // 2] if known_s else 1.0
    weight = {job.cell.name: known_s.get(job.cell.name, median_s) for job in jobs}
    running: dict[str, float] = {}
    todo = []
    for job in jobs:
        there = _stored(job, _key(job))
        if there is not None and there.complete:
            records[job.cell.name] = there
        else:
            todo.append(job)

    to_do_s = sum(weight[job.cell.name] for job in todo)
    finished_s = 0.0

    def show(note: str) -> None:
        under_way_s = sum(weight.get(name, 0.0) * fraction for name, fraction in tuple(running.items()))
        progress("cells", min(1.0, (finished_s + under_way_s) / max(to_do_s, 1e-9)), note)

    def report(name: str, fraction: float, note: str) -> None:
        # A run's stages begin at 0 each: a cell does not go back for that.
        running[name] = max(fraction, running.get(name, 0.0))
        show(f"{name} {note}")

    try:
        if workers is not None and type(workers) is not Workers:  # elsewhere
            _render(todo, progress)
        for k, record in (workers or Workers()).apply(run_cell, todo, report):
            records[record.cell] = record
            running.pop(record.cell, None)
            if record.error is None and read_record(todo[k].out / RECORD) is None:
                raise UserError(f"{todo[k].out}: a worker has written it, but not here: choose an --out that all share")
            if done is not None:
                done(record)
            finished_s += weight[record.cell]
            show(f"{record.cell} done")
    except KeyboardInterrupt:
        return Outcome(_ordered(jobs, records), interrupted=True)
    return Outcome(_ordered(jobs, records))


def run_cell(job: Job, progress: Progress = no_progress) -> CellRecord:
    """Run the seeds of a cell that its record does not hold yet; the record is written after each.

    What is missing or cannot be read is the record's error: such a cell is tried again the next time. Raises
    KeyboardInterrupt, and UserError if the folder cannot be written.
    """
    cell, file = job.cell, job.out / RECORD
    key = _key(job)
    record = _stored(job, key)
    if record is None:
        record = CellRecord(**stamped({"cell": cell.name, "key": key, "settings": cell.as_dict()}))
    if record.complete:
        return record
    try:
        if not cell.renders:
            select()  # a libLLVM that works, before a measure imports Dr.Jit
        measure = measure_named(job.measure)
        root = None if cell.renders else job.sources.folder(cell.sequence, cell.case_entry.sequence, progress)
        # Once more: a sequence that was not there when the key was made is now.
        record = dataclasses.replace(record, key=_key(job, root))
        for n, seed in enumerate(cell.seeds):
            if seed in record.seeds:
                continue

            def tell(stage: str, fraction: float, note: str, n: int = n) -> None:
                progress(cell.name, (n + fraction) / len(cell.seeds), f"{stage} {note}")

            reset_peak()
            begin = time.perf_counter()
            figures = measure(Task(cell, seed, job.sources, job.out), tell)
            figures = figures | {"peak_mb": figures.get("peak_mb") or peak_mb()}
            record = dataclasses.replace(
                record, seeds=(*record.seeds, seed), runs=(*record.runs, figures),
                seconds=record.seconds + time.perf_counter() - begin,
            )  # fmt: skip
            record = dataclasses.replace(record, complete=len(record.seeds) == len(cell.seeds))
            write_record(file, record)
    except Absent as reason:
        return dataclasses.replace(record, error=str(reason), skipped=True)
    except UserError as error:
        return dataclasses.replace(record, error=str(error))
    except Exception as error:  # one cell that breaks down must not end hours of others
        log.exception("%s", cell.name)
        return dataclasses.replace(record, error=f"broke down: {type(error).__name__}: {error}")
    return record


@cache
def code_digest(measure: str) -> str:
    """Of the source that figures of a measure ('package.module:function') depend on: the product's, and its own."""
    own = find_spec(measure.partition(":")[0])
    files = [] if own is None or own.origin is None else [Path(own.origin)]
    for package in ("rsgen", "rstrack"):
        spec = find_spec(package)
        root = Path((spec and spec.origin) or "").parent
        parts = {path: path.relative_to(root).parts[0].removesuffix(".py") for path in sorted(root.rglob("*.py"))}
        files += [path for path, part in parts.items() if part not in _SHOWING]
    digest = hashlib.sha256()
    for path in files:
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()


# ---------------------------------------------------------------------------------------------------------------------


def _key(job: Job, root: Path | None = None) -> str:
    """What the cell's runs depend on."""
    cell = job.cell
    depends: list[Any] = [cell.name, cell.as_dict(), job.code, _made_of(job, root)]
    if cell.case_entry.camera is not None:
        depends.append(_file_digest(cell.case_entry.camera))
    if cell.method_entry.results is not None:
        from rstrack.bench.measures.track import results_path

        depends.append(_file_digest(results_path(cell)))
    return hashlib.sha256(json.dumps(depends, sort_keys=True, default=str).encode()).hexdigest()


def _stored(job: Job, key: str) -> CellRecord | None:
    """What there is of the seeds that are asked for; None: nothing, or of other inputs."""
    there = read_record(job.out / RECORD)
    if there is None or there.error is not None or there.key != key:
        return None
    if not job.code and not 0 <= versions_behind(there.version) <= OLDEST:
        return None
    runs = {seed: run for seed, run in zip(there.seeds, there.runs, strict=True) if seed in job.cell.seeds}
    complete = len(runs) == len(job.cell.seeds)
    return dataclasses.replace(there, seeds=tuple(runs), runs=tuple(runs.values()), complete=complete)


def _render(jobs: list[Job], progress: Progress) -> None:
    """Render what is missing, before workers begin: two of them would render a sequence into the same folder."""
    for job in {job.cell.case_entry.sequence: job for job in jobs if not job.cell.renders}.values():
        with suppress(UserError):  # its cells say so
            job.sources.folder(job.cell.sequence, job.cell.case_entry.sequence, progress)


def _made_of(job: Job, root: Path | None) -> str:
    """Of the sequence in `root`: empty where it is still to be rendered. Of the renderer's cells: what it renders."""
    entry, name = job.cell.sequence, job.cell.case_entry.sequence
    if job.cell.renders:
        try:
            return job.sources.recipe(entry)
        except UserError:
            return ""
    folder = root or job.sources.found(entry, name)
    if folder is None:
        return ""
    described = [name for name in _DESCRIPTIONS if (folder / name).is_file()]
    return ",".join(f"{name} {_file_digest(folder / name)}" for name in described)


def _file_digest(path: Path) -> str | None:
    file = path / TRAJECTORY if path.is_dir() else path
    try:
        return hashlib.sha256(file.read_bytes()).hexdigest()
    except OSError:
        return None


def _ordered(jobs: list[Job], records: Mapping[str, CellRecord]) -> dict[str, CellRecord]:
    return {job.cell.name: records[job.cell.name] for job in jobs if job.cell.name in records}


@dataclass(frozen=True)
class Written:
    """text: for the terminal. files: which were written, in words. is_good: nothing was lost or failed."""

    text: str
    files: str
    is_good: bool


class Experiment(Protocol):
    """A list of cells, and what is made of their records."""

    def benchmark(self, sources: Sources, progress: Progress) -> Benchmark:
        """The cells. Raises UserError."""

    def write(self, outcome: Outcome, out: Path) -> Written:
        """Write tables and records into `out`. Raises UserError."""

    def draw(self, outcome: Outcome, out: Path, progress: Progress, warn: Callable[[str], None]) -> None:
        """Draw the pictures of finished cells into `out`; one line to `warn` where one fails. Raises UserError."""


def run_experiment(experiment: Experiment, out: Path, sources: Sources, quiet: bool) -> int:
    """Run the cells that `out` does not hold, write, draw and print; returns the exit status. Raises UserError."""
    warnings: list[str] = []
    with ProgressDisplay(quiet) as progress:
        benchmark = experiment.benchmark(sources, progress)
        if not quiet:
            _announce(benchmark, sources)
        with open_workers(sources.scheduler) as workers:
            outcome = run_cells(benchmark, out, sources, workers, progress)
        written, interrupted = experiment.write(outcome, out), outcome.interrupted
        try:
            if not interrupted:
                experiment.draw(outcome, out, progress, warnings.append)
        except KeyboardInterrupt:
            interrupted = True
    for warning in warnings:
        print(f"rstrack: {warning}", file=sys.stderr)
    print(written.text, flush=True)
    if interrupted:
        print(f"rstrack: interrupted; {out} holds what is finished, and the same command goes on", file=sys.stderr)
        return 130
    print(f"\n{out}: {written.files} written")
    return 0 if written.is_good else 1


def _announce(benchmark: Benchmark, sources: Sources) -> None:
    """Say how much is to be rendered before anything is tracked."""
    entries = {c.case_entry.sequence: c.sequence for c in benchmark.cells if c.sequence.config is not None}
    missing = [name for name, entry in entries.items() if sources.found(entry, name) is None]
    if missing:
        print(
            f"rstrack: {len(missing)} of {len(entries)} sequences are to be rendered first, minutes each, and more "
            f"for each scene whose light is not baked yet; kept in {sources.home}, where later runs find them",
            file=sys.stderr,
        )
