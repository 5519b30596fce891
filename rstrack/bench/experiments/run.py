"""What `rstrack bench` does with any experiment: its cells are run, and what they came to is written and drawn."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from rsgen.console.progress import Progress, ProgressDisplay
from rsgen.console.scheduler import open_workers
from rstrack.bench.cells import Benchmark
from rstrack.bench.runner import Outcome, run_cells
from rstrack.bench.sequences import Sources


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
