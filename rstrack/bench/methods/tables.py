"""The tables of `rstrack bench`: text, Markdown, CSV and JSON, with the paper's figures beside ours."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rsgen.console.tables import NOTHING, Entry, Table, best_marked, csv_text, fixed, significant
from rsgen.files import atomic_write
from rstrack.bench.methods import paper
from rstrack.bench.methods.results import (
    BASELINE,
    QUANTITIES,
    RESULTS,
    Cell,
    Quantity,
    Results,
    averaged_sequences,
    averages,
    better_pct,
    results_dict,
)
from rstrack.bench.methods.variants import fuses, row_of


def write_results(results: Results, out: Path) -> str:
    """Write results.json, results.csv, results.md and results.txt into `out`; returns the text. Raises UserError."""
    text = results_text(results)
    out.mkdir(parents=True, exist_ok=True)
    atomic_write(out / "results.csv", results_csv(results).encode())
    atomic_write(out / "results.md", results_markdown(results).encode())
    atomic_write(out / "results.txt", (text + "\n").encode())
    atomic_write(out / RESULTS, (json.dumps(results_dict(results), indent=1) + "\n").encode())
    return text


def results_csv(results: Results) -> str:
    """One line a cell, then one an average; better_*_pct: how much smaller than the baseline's, per cent."""
    groups = {sequence.name: sequence.group for sequence in results.sequences}
    records: list[dict[str, Any]] = []
    for c in results.cells:
        values = {q.name: c.figure(q.metric) for q in QUANTITIES}
        baseline = results.shown(groups[c.sequence]).get(BASELINE, "")
        base = {q.name: results.figure(c.sequence, baseline, q) for q in QUANTITIES}
        records.append(
            {"group": groups[c.sequence], "sequence": c.sequence, "method": c.method, "fuse": fuses(c.method), **values}
            | {f"better_{name}_pct": better_pct(value, base[name]) for name, value in values.items()}
            | {"frames": c.frames, "lost": c.lost, "seconds": c.seconds, "error": c.error}
            | {"truth_offset_s": c.truth_offset_s}
            | _of_paper(paper.FIGURES.get((c.sequence, row_of(c.method))))
        )
    for a in averages(results):
        records.append(
            {"group": a.group, "sequence": "average", "method": a.method, "fuse": fuses(a.method), **a.values}
            | {f"better_{name}_pct": value for name, value in a.better_pct.items()}
            | dict.fromkeys(("frames", "lost", "seconds", "error", "truth_offset_s"))
            | _of_paper(paper.average(a.sequences, row_of(a.method)))
        )
    return csv_text(records)


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
    some = [c for c in results.cells if c.counts and c.lost]
    if some:
        lines.append("† frames lost: " + ", ".join(f"{c.method} on {c.sequence} {c.lost}" for c in some))
    lost = [c for c in results.cells if not c.counts and c.error is None]
    if lost:
        listed = ", ".join(f"{c.method} on {c.sequence} (poses for {c.frames - c.lost} of {c.frames})" for c in lost)
        lines.append(f"lost (fewer than half of the frames have a pose): {listed}")
    failed: dict[str, list[str]] = defaultdict(list)
    for c in results.cells:
        if c.error is not None:
            failed[c.error].append(f"{c.method} on {c.sequence}")
    lines += [f"failed: {', '.join(cells)}: {error}" for error, cells in failed.items()]
    if len(results.cells) < len(results.sequences) * len(results.methods):
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
    m = results.machine
    lines.append(f"version {results.version}; {m.get('cpu')}, {m.get('cpu_count')} CPUs, {m.get('system')}")
    return lines


# ---------------------------------------------------------------------------------------------------------------------


def _settings(results: Results) -> list[str]:
    """Which of two settings is shown, and what the other one comes to, a line for each group."""
    lines, ate = [], QUANTITIES[0]
    by = {(a.group, a.method): a.values[ate.name] for a in averages(results)}
    for group in results.groups:
        shown = set(results.shown(group).values())
        others = [name for name in results.methods if name not in shown]
        if others:
            listed = ", ".join(f"{name} {significant(by[group, name], 3, ate.scale)}" for name in others)
            lines.append(
                f"{group}: methods that take the rolling shutter for a global one are shown with or without fused "
                f"keyframes, whichever is better (average {ate.title}, {ate.unit}; the other one: {listed})"
            )
    return lines


def _clocks(results: Results) -> list[str]:
    """What was asked for of the truth's clock, and where no offset was found."""
    asked = [c for c in results.cells if c.truth_offset is not None]
    if not asked:
        return []
    offset = asked[0].truth_offset
    how = "the offset of least drift, for each cell" if offset == "auto" else f"looked up {offset:g} s after the stamps"
    lines = [f"the truth's clock: {how} (truth_offset_s in results.csv)"]
    without = ", ".join(f"{c.method} on {c.sequence}" for c in asked if c.counts and c.truth_offset_s is None)
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
        cells = [results.cell(name, variant) for variant in shown.values()]
        values = [results.figure(name, variant, quantity) for variant in shown.values()]
        theirs = [paper.FIGURES.get((name, row)) for row in shown]
        entries = _entries(quantity, values, theirs)
        entries = [_marked(entry, cell) for entry, cell in zip(entries, cells, strict=True)]
        columns[name] = best_marked(entries, values)
    by_name = {a.method: a for a in averages(results) if a.group == group}
    mean = [by_name[variant] for variant in shown.values()]
    values = [a.values[quantity.name] for a in mean]
    theirs = [paper.average(a.sequences, row) for a, row in zip(mean, shown, strict=True)]
    columns["average"] = best_marked(_entries(quantity, values, theirs), values)
    if BASELINE in shown and len(shown) > 1:
        base = paper.average(averaged_sequences(results, group), BASELINE)
        columns["better by"] = [
            Entry("")
            if a.method == shown[BASELINE]
            else Entry(_percent(a.better_pct[quantity.name]), note=_better_in_paper(figures, base, quantity))
            for a, figures in zip(mean, theirs, strict=True)
        ]
    return columns


def _entries(quantity: Quantity, values: Sequence[float | None], theirs: Sequence[paper.Figures | None]) -> list[Entry]:
    entries = []
    for value, figures in zip(values, theirs, strict=True):
        of_paper = None if figures is None else getattr(figures, quantity.name)
        note = "" if figures is None else fixed(of_paper, quantity.paper_digits, quantity.scale)
        is_worse = value is not None and of_paper is not None and value > of_paper
        entries.append(Entry(significant(value, 3, quantity.scale), note=note, is_worse=is_worse))
    return entries


def _marked(entry: Entry, cell: Cell | None) -> Entry:
    """With what became of the cell."""
    if cell is not None and not cell.counts:
        return replace(entry, text="lost" if cell.error is None else "failed")
    return replace(entry, mark="†" if cell is not None and cell.lost else "")


def _better_in_paper(figures: paper.Figures | None, base: paper.Figures | None, quantity: Quantity) -> str:
    if figures is None or base is None:
        return ""
    return _percent(better_pct(getattr(figures, quantity.name), getattr(base, quantity.name)))


def _percent(value: float | None) -> str:
    return NOTHING if value is None else f"{value:.0f} %"


def _of_paper(figures: paper.Figures | None) -> dict[str, Any]:
    return {f"paper_{q.name}": None if figures is None else getattr(figures, q.name) for q in QUANTITIES}
