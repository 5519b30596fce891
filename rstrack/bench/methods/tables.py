"""The tables of `rstrack bench`: text, Markdown and CSV, with the paper's figures beside ours; and those of speed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rsgen.console.tables import Entry, Table, best_marked, fixed, significant
from rstrack.bench.methods.config import SequenceInfo
from rstrack.bench.methods.results import AVERAGE, BASELINE, Line, Results, averages, better_pct, lines, write_json
from rstrack.bench.methods.variants import fuses, row_of
from rstrack.bench.record import Record
from rstrack.bench.tables import paper
from rstrack.bench.tables.cells import counts, is_good, truth_offset_s
from rstrack.bench.tables.figures import heading
from rstrack.bench.tables.files import failures, provenance, tables_text, write_tables
from rstrack.bench.tables.shown import ERRORS, cell_text, measured_table

_SPEED = ("median_ms", "p95_ms", "p99_ms", "read_ms", "peer_ms", "ratio")


def write_results(results: Results, out: Path) -> str:
    """Write results.json, results.csv, results.md and results.txt into `out`; returns the text. Raises UserError."""
    text = write_tables(out, method_tables(results), notes(results), csv_rows(results))
    write_json(results, out)
    return text


def csv_rows(results: Results) -> list[dict[str, Any]]:
    """One a cell and one an average; better_*_pct: how much smaller than the baseline's, per cent."""
    rows: list[dict[str, Any]] = []
    for line in (line for group in results.groups for line in lines(results, group)):
        record = results.record(line.sequence, line.method)
        if record is None and line.sequence != AVERAGE:
            continue
        figures = {} if record is None else record.figures
        row: dict[str, Any] = {"group": line.group, "sequence": line.sequence, "method": line.method}
        row |= {"fuse": fuses(line.method), **line.values}
        row |= {f"better_{name}_pct": value for name, value in line.better_pct.items()}
        row |= {name: int(figures[name]) if name in figures else None for name in ("frames", "lost")}
        row |= {"seconds": figures.get("total_s"), "error": None if record is None else record.error}
        row |= {"truth_offset_ms": figures.get("truth_offset_ms")}
        rows.append(row | {f"paper_{name}": line.theirs.get(name) for name in ERRORS})
    return rows


def results_text(results: Results) -> str:
    """What the terminal shows."""
    return tables_text(method_tables(results), notes(results))


def method_tables(results: Results) -> list[Table]:
    """One for each group and error."""
    return [method_table(results, group, name) for group in results.groups for name in ERRORS]


def method_table(results: Results, group: str, name: str) -> Table:
    """Of one error: a row for each method shown, a column for each sequence of a group; notes: the paper's figures."""
    shown = results.shown(group)
    by = {(line.sequence, line.method): line for line in lines(results, group)}
    columns = {}
    for sequence in (*results.names(group), AVERAGE):
        found = [by[sequence, method] for method in shown.values()]
        entries = [_entry(line, name, results.record(sequence, line.method)) for line in found]
        columns[sequence] = best_marked(entries, [line.values[name] for line in found])
    base = by.get((AVERAGE, shown.get(BASELINE, "")))
    if base is not None and len(shown) > 1:
        mean = [by[AVERAGE, method] for method in shown.values()]
        columns["better by"] = [Entry("") if line is base else _better(line, base, name) for line in mean]
    rows: list[tuple[Entry, ...]] = []
    for k, (row, method) in enumerate(shown.items()):
        of_method = [column[k] for column in columns.values()]
        note = f"paper: {paper.NAMES[row]}" if any(entry.note for entry in of_method) else ""
        rows.append((Entry(method, note=note), *of_method))
    return Table(("method", *columns), tuple(rows), f"{group}, {heading(name)}")


def sequence_table(results: Results, group: str, name: str) -> Table:
    """The same with a row for each sequence and a column for each method."""
    table = method_table(results, group, name)
    methods, *columns = zip(*table.rows, strict=True)
    rows = tuple((head, *column) for head, column in zip(table.head[1:], columns, strict=True))
    return Table(("sequence", *(entry.text for entry in methods)), rows, table.title)


def notes(results: Results) -> list[str]:
    """What has to be said about the figures, one line each: frames, losses, failures, averages, the machine."""
    said = ["frames: " + ", ".join(f"{sequence.name} {sequence.frames}" for sequence in results.sequences)]
    done = [(r, r.figures) for r in results.records if r.error is None]
    some = [f"{_where(r)} {f['lost']:.0f}" for r, f in done if counts(f) and f["lost"]]
    if some:
        said.append("† frames lost: " + ", ".join(some))
    lost = [
        f"{_where(r)} (poses for {f['frames'] - f['lost']:.0f} of {f['frames']:.0f})" for r, f in done if not counts(f)
    ]
    if lost:
        said.append(f"lost (fewer than half of the frames have a pose): {', '.join(lost)}")
    said += failures(results.records)
    if len(results.records) < len(results.sequences) * len(results.methods):
        said.append("not run yet (-): the same command goes on where this one ended")
    for group in results.groups:
        names = results.averaged(group)
        if len(names) < len(results.names(group)):
            over = f"only over {', '.join(names)}: the others lack" if names else "none: each sequence lacks"
            said.append(f"average of {group}: {over} figures of one of our methods at least")
    said += _settings(results)
    said += _clocks(results)
    if any((s.name, row_of(name)) in paper.FIGURES for s in results.sequences for name in results.methods):
        said.append(
            "lines 'paper:', or figures in brackets: Kerl, Stückler, Cremers, ICCV 2015, Tables 2 and 3, on their own "
            "recordings and renderings of such motions; rooms and images differ: compare the orders, not the digits"
        )
    said.append("all figures are RMSE; drift is over one second; 'better by' compares averages with the baseline's")
    return [*said, provenance(results.records)]


def speed_text(records: Sequence[Record], sequences: Sequence[SequenceInfo]) -> str:
    """Milliseconds a frame, of records of the measure `speed`."""
    frames = "frames: " + ", ".join(f"{sequence.name} {sequence.frames}" for sequence in sequences)
    table = measured_table([record for record in records if record.error is None], _SPEED, "ms a frame")
    return tables_text([table], [frames, *failures(records), provenance(records)])


# ---------------------------------------------------------------------------------------------------------------------


def _where(record: Record) -> str:
    return f"{record.method} on {record.case}"


def _entry(line: Line, name: str, record: Record | None) -> Entry:
    """The figure, or what became of the cell; the paper's as its note."""
    value, theirs = line.values[name], line.theirs.get(name)
    if record is None:
        text = significant(value)
    elif record.error is not None:
        text = "failed"
    else:
        text = cell_text(record, name) if is_good(record) else "lost"
    is_worse = value is not None and theirs is not None and value > theirs
    return Entry(text, note="" if theirs is None else significant(theirs), is_worse=is_worse)


def _better(line: Line, base: Line, name: str) -> Entry:
    """How much better than the baseline, and in the paper."""
    theirs = better_pct(line.theirs.get(name), base.theirs.get(name))
    note = "" if not line.theirs or not base.theirs else fixed(theirs, 0) + " %"
    value = line.better_pct[name]
    return Entry(fixed(value, 0) + ("" if value is None else " %"), note=note)


def _settings(results: Results) -> list[str]:
    """Which of two settings is shown, and what the other one comes to, a line for each group."""
    found = []
    for group in results.groups:
        shown = set(results.shown(group).values())
        others = [line for line in averages(results) if line.group == group and line.method not in shown]
        if others:
            listed = ", ".join(f"{line.method} {significant(line.values['ate_mm'])}" for line in others)
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
    said = [f"the truth's clock: {how} (truth_offset_ms in results.csv)"]
    without = ", ".join(_where(r) for r, _ in asked if is_good(r) and truth_offset_s(r) is None)
    if without:
        said.append(f"no offset of the truth's clock was found, errors are those of the clocks as they are: {without}")
    return said
