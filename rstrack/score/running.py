"""Our methods and the peers on a suite, by the benchmark's runner: run folders that `results.find_methods` finds.

outcome = run_methods(suite, ("rs-pg", "kiss-icp"), Path("out/runs"))
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rsgen.console.progress import Progress, no_progress
from rsgen.console.scheduler import open_workers
from rstrack.bench.cells import Benchmark, Cell
from rstrack.bench.definitions import OTHERS, CaseEntry, MethodEntry, SequenceEntry
from rstrack.bench.experiments.methods import chosen_methods
from rstrack.bench.runner import Outcome, run_cells
from rstrack.bench.sequences import Sources
from rstrack.score.suite import Suite

_PEERS = "peers"


def run_methods(
    suite: Suite, methods: Sequence[str], out: Path, scheduler: str | None = None, progress: Progress = no_progress
) -> Outcome:
    """Track every sequence that is there; what `out` holds already is kept. Records say what failed.

    methods: names of ours and of peers; 'peers': all of these. A cell that fails, or whose package is absent, leaves no
    run. Raises UserError: a name that there is not, a folder that cannot be written.
    """
    named = [name for name in methods if name != _PEERS]
    chosen = chosen_methods(named, OTHERS if _PEERS in methods else ())
    cells = tuple(
        Cell("track", entry.name, method, (0,), CaseEntry(sequence=entry.name), path, MethodEntry(), {})
        for entry in suite.entries
        if (suite.root / entry.name).is_dir()
        for path in [SequenceEntry(path=Path(entry.name), group=entry.tier)]
        for method in chosen
    )
    sources = Sources(data=suite.root.resolve(), scheduler=scheduler)
    with open_workers(scheduler) as workers:
        return run_cells(Benchmark(cells), out, sources, workers, progress)
