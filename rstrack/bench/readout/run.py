"""The readout sweep, from its config to all its cells: render what is missing, track with everything, gather errors.

result = run_sweep(load_sweep_config(Path("configs/readout_sweep.yaml")), Path("out/readout_sweep"))
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rsgen.console.progress import Progress, no_progress
from rsgen.console.scheduler import Workers
from rsgen.errors import UserError
from rstrack.bench.methods.grid import run_plan
from rstrack.bench.methods.plan import Job, Plan, SequenceInfo, keyed, sequence_digest
from rstrack.bench.methods.results import Cell
from rstrack.bench.methods.variants import folder_of, variants
from rstrack.bench.readout.cases import Case, render_cases
from rstrack.bench.readout.config import SweepConfig, installed
from rstrack.bench.stress.cases import Render, run_rsgen
from rstrack.data.dataset import open_dataset
from rstrack.metrics.association import truth_of
from rstrack.options import Options
from rstrack.tracking.runs.record import Noise


@dataclass(frozen=True)
class SweepResult:
    """cells: by case and method, a cell a seed, those missing of which an interrupt left none. lacking: methods left
    out, not being installed. frames: of each case."""

    config: SweepConfig
    methods: tuple[str, ...]
    lacking: tuple[str, ...]
    cells: dict[tuple[Case, str], tuple[Cell, ...]]
    frames: dict[Case, int]
    machine: dict[str, Any]
    version: str
    interrupted: bool = False


def run_sweep(
    config: SweepConfig, out: Path, options: Options | None = None, workers: Workers | None = None,
    progress: Progress = no_progress, say: Callable[[str], None] = print, scheduler: str | None = None,
    render: Render | None = None,
) -> SweepResult:  # fmt: skip
    """Render, track and evaluate all that `out` does not hold yet; each cell there is written whole or not at all.

    Each of our methods runs in its usual setting, unless options.fuse says which. workers: track, scheduler: of
    rsgen's, renders. render: runs `rsgen` with arguments (default: in a process of its own). Ctrl-C while tracking
    ends it early with what is finished. Raises UserError: nothing is installed to track with, a config, a render, a
    folder.
    """
    options = options or Options()
    methods, lacking = installed(config.methods)
    if not methods:
        raise UserError(f"the sweep: none of {', '.join(lacking)} is installed: pip install '.[peers]'")
    folders = render_cases(config, out, render or run_rsgen, progress, say, scheduler)
    plan, names = sweep_plan(config, folders, methods, options, out)
    results = run_plan(plan, workers, progress)
    cells: dict[tuple[Case, str], list[Cell]] = {}
    for cell in results.cells:
        cells.setdefault((names[cell.sequence], cell.method), []).append(cell)
    frames = {names[info.name]: info.frames for info in plan.sequences}
    gathered = {key: tuple(found) for key, found in cells.items()}
    about = results.machine, results.version, results.interrupted
    return SweepResult(config, plan.methods, lacking, gathered, frames, *about)


def sweep_plan(
    config: SweepConfig, folders: dict[Case, Path], methods: tuple[str, ...], options: Options, out: Path
) -> tuple[Plan, dict[str, Case]]:
    """The cells, and the case of each of their sequences, which are a case with a seed. Raises UserError."""
    sequences: list[SequenceInfo] = []
    jobs: list[Job] = []
    names: dict[str, Case] = {}
    chosen = tuple(variants(method, options.fuse)[0] for method in methods)
    for case, folder in folders.items():
        dataset = open_dataset(folder)
        if truth_of(dataset) is None:
            raise UserError(f"{folder}: has no ground truth to compare with: delete it and run the sweep again")
        last, digest = min(config.frames or len(dataset), len(dataset)), sequence_digest(folder)
        for seed in range(config.noise.seeds):
            info = SequenceInfo(f"{case.name}_seed_{seed}", case.motion, folder.resolve(), last)
            sequences.append(info)
            names[info.name] = case
            noise = Noise(config.noise.depth, config.noise.intensity, seed)
            for method in chosen:
                cell_out = (out / "cells" / info.name / folder_of(method)).resolve()
                job = Job(info.name, method, info.path, 0, last, options, None, cell_out, "", noise=noise)
                jobs.append(keyed(job, digest))
    return Plan(tuple(sequences), chosen, tuple(jobs), out), names
