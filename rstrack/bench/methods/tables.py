"""The tables of `rstrack bench`: text, Markdown and CSV, with the paper's figures beside ours; and those of speed."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rsgen.console.tables import NOTHING, Entry, Table, best_marked, csv_text, fixed, significant
from rsgen.files import atomic_write
from rstrack.bench.methods.config import SequenceInfo
from rstrack.bench.methods.results import (
    BASELINE,
    QUANTITIES,
    Quantity,
    Results,
    averaged_sequences,
    averages,
    better_pct,
    counts,
    figure,
    is_good,
    truth_offset_s,
    write_json,
)
from rstrack.bench.methods.variants import fuses, row_of
from rstrack.bench.record import Record
from rstrack.bench.tables import paper


def write_results(results: Results, out: Path) -> str:
    """Write results.json, results.csv, results.md and results.txt into `out`; returns the text. Raises UserError."""
    text = results_text(results)
    out.mkdir(parents=True, exist_ok=True)
    atomic_write(out / "results.csv", results_csv(results).encode())
    atomic_write(out / "results.md", results_markdown(results).encode())
    atomic_write(out / "results.txt", (text + "\n").encode())
    write_json(results, out)
    return text


def results_csv(results: Results) -> str:
    """One line a cell, then one an average; better_*_pct: how much smaller than the baseline's, per cent."""
    groups = {sequence.name: sequence.group for sequence in results.sequences}
    rows: list[dict[str, Any]] = []
    for r in results.records:
        group, figures = groups[r.case], r.figures
        baseline = results.record(r.case, results.shown(group).get(BASELINE, ""))
        values = {q.name: figure(r, q.name) for q in QUANTITIES}
        better = {name: better_pct(value, figure(baseline, name)) for name, value in values.items()}
        about: dict[str, Any] = {name: int(figures[name]) for name in ("frames", "lost") if name in figures}
        about |= {"seconds": figures.get("total_s"), "truth_offset_ms": figures.get("truth_offset_ms")}
        theirs = paper.FIGURES.get((r.case, row_of(r.method)))
        rows.append(_csv_row(group, r.case, r.method, values, better, about | {"error": r.error}, theirs))
    for a in averages(results):
        rows.append(_csv_row(a.group, "average", a.method, a.values, a.better_pct, {}, a.theirs))
    return csv_text(rows)


def results_text(results: Results) -> str:
    """Tables for the terminal: a table for each group and quantity, the paper's line under ours."""
    tables = [method_table(results, group, quantity) for group in results.groups for quantity in QUANTITIES]
    blocks = [replace(table, head=(table.title, *table.head[1:])).text() for table in tables]
    return "\n\n".join([*blocks, "\n".join(notes(results))])


def results_markdown(results: Results) -> str:
    """The same tables, ours (the paper's in brackets), the best of ours in bold."""
    tables = [method_table(results, group, quantity) for group in results.groups for quantity in QUANTITIES]
    parts = [f"**{table.title[0].upper()}{table.title[1:]}**\n\n{table.markdown()}" for table in tables]
    listed = "\n".join(f"- {note}" for note in notes(results))
    return "\n\n".join([*parts, listed]) + "\n"


def method_table(results: Results, group: str, quantity: Quantity) -> Table:
    """A row for each method shown, a column for each sequence of a group; notes: the paper's figures."""
    columns = _columns(results, group, quantity)
    rows: list[tuple[Entry, ...]] = []
    for k, (row, name) in enumerate(results.shown(group).items()):
        entries = [column[k] for column in columns.values()]
        with_paper = any(entry.note for entry in entries)
        rows.append((Entry(name, note=f"paper: {paper.NAMES[row]}" if with_paper else ""), *entries))
    return Table(("method", *columns), tuple(rows), _title(group, quantity))


def sequence_table(results: Results, group: str, quantity: Quantity) -> Table:
    """The same with a row for each sequence and a column for each method."""
    columns = _columns(results, group, quantity)
    rows: tuple[tuple[Entry | str, ...], ...] = tuple((name, *entries) for name, entries in columns.items())
    return Table(("sequence", *results.shown(group).values()), rows, _title(group, quantity))


def notes(results: Results) -> list[str]:
    """What has to be said about the figures, one line each: frames, losses, failures, averages, the machine."""
    lines = ["frames: " + ", ".join(f"{sequence.name} {sequence.frames}" for sequence in results.sequences)]
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
        names = averaged_sequences(results, group)
        if len(names) < len(results.names(group)):
            over = f"only over {', '.join(names)}: the others lack" if names else "none: each sequence lacks"
            lines.append(f"average of {group}: {over} figures of one of our methods at least")
    lines += _settings(results)
    lines += _clocks(results)
    if any((s.name, row_of(name)) in paper.FIGURES for s in results.sequences for name in results.methods):
        lines.append(
            "lines 'paper:', or figures in brackets: Kerl, Stückler, Cremers, ICCV 2015, Tables 2 and 3, on their own "
            "recordings and renderings of such motions; rooms and images differ: compare the orders, not the digits"
        )
    lines.append("all figures are RMSE; drift is over one second; 'better by' compares averages with the baseline's")
    return [*lines, *made_on(results.records)]


def failures(records: Sequence[Record]) -> list[str]:
    """A line for each error, with the cells that have it."""
    failed: dict[str, list[str]] = defaultdict(list)
    for record in records:
        if record.error is not None:
            failed[record.error].append(_where(record))
    return [f"failed: {', '.join(cells)}: {error}" for error, cells in failed.items()]


def made_on(records: Sequence[Record]) -> list[str]:
    """A line about version and machine; of the first record."""
    machine = [(r.version, r.machine) for r in records][:1]
    return [f"version {v}; {m.get('cpu')}, {m.get('cores')} CPUs, {m.get('system')}" for v, m in machine]


_SPEED = (
    ("median", "median_ms"), ("95 %", "p95_ms"), ("99 %", "p99_ms"), ("reading", "read_ms"), ("peer", "peer_ms"),
    ("times peer", "ratio"),
)  # fmt: skip


def speed_text(records: Sequence[Record], sequences: Sequence[SequenceInfo]) -> str:
    """Milliseconds a frame, a table for each sequence, of records of the measure `speed`."""
    blocks = []
    for sequence in sequences:
        found = {r.method: r.figures for r in records if r.case == sequence.name and r.error is None}
        columns = [(title, name) for title, name in _SPEED if any(name in figures for figures in found.values())]
        rows = [(method, *(fixed(figures.get(name), 2) for _, name in columns)) for method, figures in found.items()]
        head = (f"{sequence.name}, {sequence.frames} frames: ms a frame", *(title for title, _ in columns))
        blocks.append(Table(head, tuple(rows)).text())
    return "\n\n".join([*blocks, "\n".join([*failures(records), *made_on(records)])])


# ---------------------------------------------------------------------------------------------------------------------


def _where(record: Record) -> str:
    return f"{record.method} on {record.case}"


def _csv_row(
    group: str, sequence: str, method: str, values: dict[str, float | None], better: dict[str, float | None],
    about: dict[str, Any], theirs: paper.Figures | None,
) -> dict[str, Any]:  # fmt: skip
    row: dict[str, Any] = {"group": group, "sequence": sequence, "method": method, "fuse": fuses(method), **values}
    row |= {f"better_{name}_pct": value for name, value in better.items()}
    row |= {name: about.get(name) for name in ("frames", "lost", "seconds", "error", "truth_offset_ms")}
    return row | {f"paper_{q.name}": None if theirs is None else getattr(theirs, q.name) for q in QUANTITIES}


def _settings(results: Results) -> list[str]:
    """Which of two settings is shown, and what the other one comes to, a line for each group."""
    lines, ate = [], QUANTITIES[0]
    by = {(a.group, a.method): a.values[ate.name] for a in averages(results)}
    for group in results.groups:
        shown = set(results.shown(group).values())
        others = [name for name in results.methods if name not in shown]
        if others:
            listed = ", ".join(f"{name} {significant(by[group, name], 3)}" for name in others)
            lines.append(
                f"{group}: methods that take the rolling shutter for a global one are shown with or without fused "
                f"keyframes, whichever is better (average {ate.title}, {ate.unit}; the other one: {listed})"
            )
    return lines


def _clocks(results: Results) -> list[str]:
    """What was asked for of the truth's clock, and where no offset was found."""
    asked = [(r, offset) for r in results.records if (offset := r.settings["case"].get("truth_offset")) is not None]
    if not asked:
        return []
    offset = asked[0][1]
    how = "the offset of least drift, for each cell" if offset == "auto" else f"looked up {offset:g} s after the stamps"
    lines = [f"the truth's clock: {how} (truth_offset_ms in results.csv)"]
    without = ", ".join(_where(r) for r, _ in asked if is_good(r) and truth_offset_s(r) is None)
    if without:
        lines.append(f"no offset of the truth's clock was found, errors are those of the clocks as they are: {without}")
    return lines


def _title(group: str, quantity: Quantity) -> str:
    return f"{group}, {quantity.title}, {quantity.unit}"


def _columns(results: Results, group: str, quantity: Quantity) -> dict[str, list[Entry]]:
    """By heading, sequences first, an entry for each method; its note is the paper's figure."""
    columns = {}
    shown = results.shown(group)
    for name in results.names(group):
        records = [results.record(name, variant) for variant in shown.values()]
        values = [figure(record, quantity.name) for record in records]
        theirs = [paper.FIGURES.get((name, row)) for row in shown]
        entries = _entries(quantity, values, theirs)
        entries = [_marked(entry, record) for entry, record in zip(entries, records, strict=True)]
        columns[name] = best_marked(entries, values)
    by_name = {a.method: a for a in averages(results) if a.group == group}
    mean = [by_name[variant] for variant in shown.values()]
    values = [a.values[quantity.name] for a in mean]
    columns["average"] = best_marked(_entries(quantity, values, [a.theirs for a in mean]), values)
    if BASELINE in shown and len(shown) > 1:
        base = paper.average(averaged_sequences(results, group), BASELINE)
        columns["better by"] = [
            Entry("")
            if a.method == shown[BASELINE]
            else Entry(_percent(a.better_pct[quantity.name]), note=_better_in_paper(a.theirs, base, quantity))
            for a in mean
        ]
    return columns


def _entries(quantity: Quantity, values: Sequence[float | None], theirs: Sequence[paper.Figures | None]) -> list[Entry]:
    entries = []
    for value, figures in zip(values, theirs, strict=True):
        of_paper = None if figures is None else getattr(figures, quantity.name)
        note = "" if figures is None else fixed(of_paper, quantity.paper_digits)
        is_worse = value is not None and of_paper is not None and value > of_paper
        entries.append(Entry(significant(value, 3), note=note, is_worse=is_worse))
    return entries


def _marked(entry: Entry, record: Record | None) -> Entry:
    """With what became of the cell."""
    if record is None:
        return entry
    if not is_good(record):
        return replace(entry, text="lost" if record.error is None else "failed")
    return replace(entry, mark="†" if record.figures["lost"] else "")


def _better_in_paper(figures: paper.Figures | None, base: paper.Figures | None, quantity: Quantity) -> str:
    if figures is None or base is None:
        return ""
    return _percent(better_pct(getattr(figures, quantity.name), getattr(base, quantity.name)))


def _percent(value: float | None) -> str:
    return NOTHING if value is None else f"{value:.0f} %"
