"""The tables of every method on every sequence, with the paper's figures beside ours; and the experiment itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rsgen.console.progress import Progress
from rsgen.console.tables import NOTHING, Entry, Table, significant
from rsgen.files import atomic_write
from rstrack.bench.cells import Benchmark
from rstrack.bench.experiments.methods import (
    AVERAGE,
    BASELINE,
    RESULTS,
    Plan,
    Results,
    SequenceInfo,
    better_pct,
    fuses,
    row_of,
)
from rstrack.bench.figures import PAPER_FIGURES, PAPER_NAMES, heading
from rstrack.bench.record import CellRecord, counts, figure, write_records
from rstrack.bench.runner import Outcome, Written
from rstrack.bench.tables import (
    ERRORS,
    cell_text,
    failures,
    measured_table,
    pivot,
    provenance,
    tables_text,
    write_tables,
)
from rstrack.bench.task import Sources

_BETTER = "better by"
_SPEED = ("median_ms", "p95_ms", "p99_ms", "read_ms", "peer_ms", "ratio")


def write_results(results: Results, out: Path) -> str:
    """Write results.json, results.csv, results.md and results.txt into `out`; returns the text. Raises UserError."""
    text = write_tables(out, method_tables(results), notes(results), csv_rows(results))
    atomic_write(out / RESULTS, (results.model_dump_json(indent=1) + "\n").encode())
    return text


def csv_rows(results: Results) -> list[dict[str, Any]]:
    """One a cell and one an average; better_*_pct: how much smaller than the baseline's, per cent."""
    rows = []
    for group in results.groups:
        found, base = results.of_group(group), results.shown(group).get(BASELINE, "")
        for (case, method), record in found.items():
            figures, theirs = record.figures, results.theirs(group, case, method)
            values = {name: figure(record, name) for name in ERRORS}
            better = {name: better_pct(values[name], figure(found.get((case, base)), name)) for name in ERRORS}
            row: dict[str, Any] = {"group": group, "sequence": case, "method": method, "fuse": fuses(method), **values}
            row |= {f"better_{name}_pct": value for name, value in better.items()}
            row |= {name: int(figures[name]) if name in figures else None for name in ("frames", "lost")}
            row |= {"seconds": figures.get("total_s"), "error": record.error}
            row |= {"truth_offset_ms": figures.get("truth_offset_ms")}
            rows.append(row | {f"paper_{name}": theirs.get(name) for name in ERRORS})
    return rows


def method_tables(results: Results) -> list[Table]:
    """One for each group and error."""
    return [method_table(results, group, name) for group in results.groups for name in ERRORS]


def method_table(results: Results, group: str, name: str) -> Table:
    """Of one error: a row for each method shown, a column for each sequence of a group; notes: the paper's figures."""
    shown, found = results.shown(group), results.of_group(group)

    def value(row: str, case: str) -> float | None:
        return None if case == _BETTER else figure(found.get((case, shown[row])), name)

    def entry(row: str, case: str) -> Entry:
        if case == _BETTER:
            return better(row)
        record, theirs = found.get((case, shown[row])), results.theirs(group, case, row).get(name)
        is_worse = theirs is not None and (value(row, case) or 0.0) > theirs
        text = cell_text(record, name)
        if record is not None and record.error is None and value(row, case) is None:
            text = NOTHING if case == AVERAGE or record.is_good else "lost"
        return Entry(text, note="" if theirs is None else significant(theirs), is_worse=is_worse)

    def better(row: str) -> Entry:
        theirs = better_pct(*(results.theirs(group, AVERAGE, of).get(name) for of in (row, BASELINE)))
        mine = better_pct(value(row, AVERAGE), value(BASELINE, AVERAGE))
        texts = [NOTHING if pct is None else f"{pct:.0f} %" for pct in (mine, theirs)]
        return Entry("") if row == BASELINE else Entry(texts[0], note="" if theirs is None else texts[1])

    def head(row: str) -> Entry:
        is_papers = any(results.theirs(group, at, row) for at in cases)
        return Entry(shown[row], note=f"paper: {PAPER_NAMES[row]}" if is_papers else "")

    cases = [*results.names(group), AVERAGE]
    beside = [_BETTER] if BASELINE in shown and len(shown) > 1 else []
    title = f"{group}, {heading(name)}"
    return pivot("method", list(shown), [*cases, *beside], entry, value, title, name=head)


def sequence_table(results: Results, group: str, name: str) -> Table:
    """The same with a row for each sequence and a column for each method."""
    table = method_table(results, group, name)
    methods, *columns = zip(*table.rows, strict=True)
    rows = tuple((head, *column) for head, column in zip(table.head[1:], columns, strict=True))
    return Table(("sequence", *map(str, methods)), rows, table.title)


def notes(results: Results) -> list[str]:
    """What a reader has to know about the figures, one line each: frames, losses, failures, averages, the machine."""
    lines = [_frames(results.sequences)]
    done = [(r, r.figures) for r in results.records if r.error is None]
    some = [f"{_where(r)} {f['lost']:.0f}" for r, f in done if counts(f) and f["lost"]]
    if some:
        lines.append("† frames lost: " + ", ".join(some))
    lost = [
        f"{_where(r)} (poses for {f['frames'] - f['lost']:.0f} of {f['frames']:.0f})" for r, f in done if not counts(f)
    ]
    if lost:
        lines.append(f"lost (fewer than half of the frames have a pose): {', '.join(lost)}")
    lines += failures(results.records)
    if len(results.records) < len(results.sequences) * len(results.methods):
        lines.append("not run yet (-): the same command goes on where this one ended")
    for group in results.groups:
        names = results.averaged(group)
        if len(names) < len(results.names(group)):
            over = f"only over {', '.join(names)}: the others lack" if names else "none: each sequence lacks"
            lines.append(f"average of {group}: {over} figures of one of our methods at least")
    lines += _settings(results)
    lines += _clocks(results)
    if any((s.name, row_of(name)) in PAPER_FIGURES for s in results.sequences for name in results.methods):
        lines.append(
            "lines 'paper:', or figures in brackets: Kerl, Stückler, Cremers, ICCV 2015, Tables 2 and 3, on their own "
            "recordings and renderings of such motions; rooms and images differ: compare the orders, not the digits"
        )
    lines.append("all figures are RMSE; drift is over one second; 'better by' compares averages with the baseline's")
    return [*lines, provenance(results.records)]


@dataclass(frozen=True)
class MethodsExperiment:
    """Every method on every sequence. with_meshes: maps are made with the trajectories, and drawn."""

    plan: Plan
    with_meshes: bool = False

    def benchmark(self, sources: Sources, progress: Progress) -> Benchmark:
        """The plan's cells."""
        return self.plan.benchmark

    def results(self, outcome: Outcome) -> Results:
        """What has been run of the plan."""
        records = tuple(outcome.records.values())
        return Results(sequences=self.plan.sequences, methods=self.plan.methods, records=records)

    def write(self, outcome: Outcome, out: Path) -> Written:
        """See `Experiment`."""
        text = write_results(self.results(outcome), out)
        files = "results.txt, .md, .csv, .json, plots/* and cells/track/SEQUENCE/METHOD"
        return Written(text, files, all(record.is_good for record in outcome.records.values()))

    def draw(self, outcome: Outcome, out: Path, progress: Progress, warn: Callable[[str], None]) -> None:
        """See `Experiment`."""
        from rstrack.bench.experiments.pictures import draw_meshes, draw_plots

        draw_plots(self.results(outcome), out, progress, warn)
        if self.with_meshes:
            draw_meshes(self.results(outcome), out, progress=progress, warn=warn)


class SpeedExperiment(MethodsExperiment):
    """How long a frame takes with each of them: to the terminal, and speed.json."""

    def write(self, outcome: Outcome, out: Path) -> Written:
        """See `Experiment`."""
        records = self.results(outcome).records
        write_records(out / "speed.json", records)
        table = measured_table([record for record in records if record.error is None], _SPEED, "ms a frame")
        text = tables_text([table], [_frames(self.plan.sequences), *failures(records), provenance(records)])
        return Written(text, "speed.json", not any(record.error for record in records))

    def draw(self, outcome: Outcome, out: Path, progress: Progress, warn: Callable[[str], None]) -> None:
        """Nothing."""


# ---------------------------------------------------------------------------------------------------------------------


def _frames(sequences: Sequence[SequenceInfo]) -> str:
    return "frames: " + ", ".join(f"{sequence.name} {sequence.frames}" for sequence in sequences)


def _where(record: CellRecord) -> str:
    return f"{record.method} on {record.case}"


def _settings(results: Results) -> list[str]:
    """Which of two settings is shown, and what the other one comes to, a line for each group."""
    found = []
    for group in results.groups:
        shown = set(results.shown(group).values())
        others = [name for name in results.methods if name not in shown]
        if others:
            ate = {name: results.average(group, name).figures.get("ate_mm") for name in others}
            listed = ", ".join(f"{name} {significant(value)}" for name, value in ate.items())
            found.append(
                f"{group}: methods that take the rolling shutter for a global one are shown with or without fused "
                f"keyframes, whichever is better (average {heading('ate_mm')}; the other one: {listed})"
            )
    return found


def _clocks(results: Results) -> list[str]:
    """What was asked for of the truth's clock, and where no offset was found."""
    asked = [(r, offset) for r in results.records if (offset := r.settings["case"].get("truth_offset")) is not None]
    if not asked:
        return []
    offset = asked[0][1]
    how = "the offset of least drift, for each cell" if offset == "auto" else f"looked up {offset:g} s after the stamps"
    lines = [f"the truth's clock: {how} (truth_offset_ms in results.csv)"]
    without = ", ".join(_where(r) for r, _ in asked if r.is_good and r.truth_offset_s is None)
    if without:
        lines.append(f"no offset of the truth's clock was found, errors are those of the clocks as they are: {without}")
    return lines
