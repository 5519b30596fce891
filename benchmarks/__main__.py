"""`./run.sh bench TIER`: run a tier's cells, compare them with committed records, and keep them."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np

from benchmarks.compare import compare
from benchmarks.inference import tolerances
from benchmarks.size import CELL as SIZE
from benchmarks.size import size_record
from rsgen.console.command_line import Commands, Parser, Quiet, run_program
from rsgen.console.progress import Progress
from rsgen.console.scheduler import Scheduler, open_workers
from rstrack.bench.cells import Cell
from rstrack.bench.record import CellRecord, read_records, write_record, write_records

HERE = Path(__file__).parent
RESULTS = HERE / "results"
TIERS = ("smoke", "gate", "full")
# Its repetitions run alone, each in a process of its own, before, amid and after all else, which shares the cores: in
# a row they would have the machine's state in common, and scatter less than what another day's scatter by.
SPEED = "speed"

_DESCRIPTION = """\
Measures the project and compares the figures with those of the last time.

  ./run.sh bench smoke                                        check that every measure runs; minutes, part of the tests
  ./run.sh bench gate --data DIR                              run before every change is accepted; at most 25 minutes
  ./run.sh bench gate --against benchmarks/results/gate.json  compare; exit status 1 if a figure is worse beyond chance
  ./run.sh bench gate --accept                                store the records as the committed ones
  ./run.sh bench full --only 'track/table1/*'                 run everything, or a part; hours, resumable
"""
_STATUS = "exit status: 0 done, 1 something is worse or failed, 2 wrong input, 130 interrupted (run it again to go on)"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    return run_program("bench", _parser, arguments, "the same command goes on where it was")


def _parser() -> Parser:
    commands = Commands("bench", _DESCRIPTION)
    for function in (smoke, gate, full):
        commands.add(function, "--only 'track/*'", _STATUS)
    return commands.parser


@dataclass(frozen=True)
class Choice:
    """What of a tier is run, where, and what is done with the records."""

    only: Annotated[
        tuple[str, ...] | None, "run only cells whose names (MEASURE/CASE/METHOD) match; * is allowed", "GLOB"
    ] = None
    data: Annotated[Path | None, "folder of recordings; cells whose recording is missing are skipped", "DIR"] = None
    cache: Annotated[Path | None, "folder for rendered sequences (default: in ~/.cache)", "DIR"] = None
    out: Annotated[Path | None, "folder for finished cells (default: out/bench/TIER)", "DIR"] = None
    against: Annotated[Path | None, "records to compare with", "FILE"] = None
    accept: Annotated[bool, "store the records as benchmarks/results/TIER.json; say why in the commit"] = False


def smoke(choice: Choice, *, scheduler: Scheduler = None, quiet: Quiet = False) -> int:
    """Check that every measure runs: minutes."""
    return run_tier("smoke", choice, scheduler, quiet)


def gate(choice: Choice, *, scheduler: Scheduler = None, quiet: Quiet = False) -> int:
    """Run what guards every change: at most 25 minutes on two cores."""
    return run_tier("gate", choice, scheduler or "local", quiet)


def full(choice: Choice, *, scheduler: Scheduler = None, quiet: Quiet = False) -> int:
    """Run everything at full size: hours."""
    return run_tier("full", choice, scheduler, quiet)


def run_tier(tier: str, choice: Choice, scheduler: str | None, quiet: bool) -> int:
    """Run, compare, keep; returns the exit status. Raises UserError."""
    from benchmarks.measures import MEASURES
    from rsgen.console.progress import ProgressDisplay
    from rstrack.bench.cells import load_benchmark
    from rstrack.bench.runner import RECORD, Outcome, run_cells
    from rstrack.bench.task import Sources

    benchmark = load_benchmark([HERE / "cases.yaml", HERE / f"{tier}.yaml"]).only(choice.only or ())
    before = None if choice.against is None else read_records(choice.against)
    sources = Sources(None if choice.data is None else choice.data.resolve(), choice.cache, scheduler)

    def done(record: CellRecord) -> None:
        if record.error is not None and not quiet:
            print(f"bench: {record.cell}: {'skipped' if record.skipped else 'FAILED'}: {record.error}", file=sys.stderr)

    out = choice.out or Path("out/bench") / tier
    if benchmark.every == "third version":
        # Hours of others' work: what is committed and still good need not be run again.
        for name, record in known(tier).items():
            if not (out / "cells" / name / RECORD).exists():
                write_record(out / "cells" / name / RECORD, record)
    expected_s = {name: record.seconds for name, record in known(tier).items()}
    with ProgressDisplay(quiet) as progress:
        outcome, planned = Outcome({}), parts(benchmark.cells, scheduler, expected_s)
        ends = np.cumsum([0.0, *(sum(expected_s.get(cell.name, 1.0) for cell in cells) for cells, _ in planned)])
        ends /= ends[-1]
        for n, (cells, where) in enumerate(planned):
            with open_workers(where) as workers:
                part = run_cells(
                    replace(benchmark, cells=cells), out, sources, workers, _within(progress, *ends[n : n + 2]),
                    MEASURES, done, expected_s,
                )  # fmt: skip
            outcome = Outcome(outcome.records | part.records, part.interrupted)
            if part.interrupted:
                break
    records = {cell.name: outcome.records[cell.name] for cell in benchmark.cells if cell.name in outcome.records}
    if tier == "gate" and not choice.only:
        records[SIZE] = size_record(HERE.parent)
    failed = [record.cell for record in records.values() if record.error is not None and not record.skipped]
    skipped = sum(record.skipped for record in records.values())
    print(f"{tier}: {len(outcome.records)} of {len(benchmark.cells)} cells, {skipped} skipped, {len(failed)} failed")
    if before is not None and not outcome.interrupted:
        chosen = {cell.name for cell in benchmark.cells}
        comparison = compare({name: r for name, r in before.items() if name in chosen or not choice.only}, records)
        print(comparison.text())
        if comparison.worse:
            failed.append("worse")
    if choice.accept:
        print(accept(tier, records, is_part=bool(choice.only)))
    if outcome.interrupted:
        print(f"bench: interrupted; {out} holds what is finished, and the same command goes on", file=sys.stderr)
        return 130
    return 1 if failed else 0


def parts(
    cells: Sequence[Cell], scheduler: str | None, expected_s: Mapping[str, float]
) -> list[tuple[tuple[Cell, ...], str | None]]:
    """Cells that run together, and where: the first repetition of all that is timed, some others, the second, …"""
    timed = [cell for cell in cells if cell.measure == SPEED]
    rest = [cell for cell in cells if cell.measure != SPEED]
    repetitions = max((len(cell.seeds) for cell in timed), default=0)
    between = max(1, repetitions - 1)
    ends = np.cumsum([expected_s.get(cell.name, 1.0) for cell in rest])
    part_of = np.minimum(ends / max(ends[-1:].sum(), 1e-9) * between, between - 1).astype(int)
    out: list[tuple[tuple[Cell, ...], str | None]] = []
    for n in range(max(between, repetitions)):
        if timed:
            out.append((tuple(replace(cell, seeds=cell.seeds[: n + 1]) for cell in timed), scheduler and "local:1"))
        if some := tuple(cell for cell, part in zip(rest, part_of, strict=True) if part == n):
            out.append((some, scheduler))
    return out


def _within(progress: Progress, begin: float, end: float) -> Progress:
    """Shows cells of a part as a piece of all."""

    def show(stage: str, fraction: float, note: str) -> None:
        progress(stage, begin + (end - begin) * fraction if stage == "cells" else fraction, note)

    return show


def known(tier: str) -> dict[str, CellRecord]:
    """The tier's committed records."""
    target = RESULTS / f"{tier}.json"
    return read_records(target) if target.is_file() else {}


def accept(tier: str, records: Mapping[str, CellRecord], is_part: bool) -> str:
    """Write the records as the committed ones; a part of a tier replaces its own. Returns what to say."""
    target, kept = RESULTS / f"{tier}.json", known(tier) if is_part else {}
    good = {name: record for name, record in records.items() if record.error is None}
    write_records(target, tolerances(kept | good).values())
    return f"{target}: {len(good)} records written"


if __name__ == "__main__":
    sys.exit(main())
