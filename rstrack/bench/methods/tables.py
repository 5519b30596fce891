"""The tables of `rstrack bench`: text, Markdown, CSV and JSON, with the paper's figures beside ours."""

from __future__ import annotations

import csv
import io
import json
import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rsgen.files import atomic_write
from rstrack.bench.methods import paper
from rstrack.bench.methods.grid import Cell, Results
from rstrack.data.estimate import plain
from rstrack.options import METHODS

BASELINE = "baseline"

# Characters: all tables are aligned alike.
_LABEL = 26


@dataclass(frozen=True)
class Quantity:
    """A column of the results. name: in files, with its unit; metric: in `Metrics`; the rest is for reading."""

    name: str
    metric: str
    title: str
    unit: str
    scale: float
    paper_digits: int


QUANTITIES = (
    Quantity("ate_m", "ate_rmse_m", "ATE", "mm", 1e3, 1),
    Quantity("rpe_m_s", "rpe_trans_rmse_m_per_s", "drift", "mm/s", 1e3, 1),
    Quantity("rpe_deg_s", "rpe_rot_rmse_deg_per_s", "drift", "deg/s", 1.0, 3),
)
"""RMSE all of them; drift is the relative pose error over one second."""


@dataclass(frozen=True)
class Average:
    """Of one method over the sequences of a group; None where it lacks one of them.

    better_pct: how much smaller than the baseline's, in per cent; None without a baseline.
    """

    group: str
    method: str
    sequences: tuple[str, ...]
    values: dict[str, float | None]
    better_pct: dict[str, float | None]


def averaged_sequences(results: Results, group: str) -> tuple[str, ...]:
    """The sequences of a group on which every one of our methods kept the track: those that averages are over.

    Other trackers are averaged over the same ones, or not at all, so that they cannot change ours.
    """
    ours = [method for method in results.methods if method in METHODS] or list(results.methods)
    names = [sequence.name for sequence in results.sequences if sequence.group == group]
    return tuple(name for name in names if all(_counts(results.cell(name, method)) for method in ours))


def averages(results: Results) -> list[Average]:
    """All groups' averages of all methods."""
    found = []
    for group in results.groups:
        names = averaged_sequences(results, group)
        values = {
            method: {q.name: _mean([_figure(results, name, method, q) for name in names]) for q in QUANTITIES}
            for method in results.methods
        }
        for method in results.methods:
            base = values.get(BASELINE, {})
            better = {q.name: better_pct(values[method][q.name], base.get(q.name)) for q in QUANTITIES}
            found.append(Average(group, method, names, values[method], better))
    return found


def better_pct(value: float | None, baseline: float | None) -> float | None:
    """How much smaller the value is, per cent of the baseline's; negative if it is larger."""
    return None if value is None or not baseline else 100.0 * (1.0 - value / baseline)


def write_results(results: Results, out: Path) -> str:
    """Write results.json, results.csv, results.md and results.txt into `out`; returns the text. Raises UserError."""
    text = results_text(results)
    out.mkdir(parents=True, exist_ok=True)
    atomic_write(out / "results.csv", results_csv(results).encode())
    atomic_write(out / "results.md", results_markdown(results).encode())
    atomic_write(out / "results.txt", (text + "\n").encode())
    atomic_write(out / "results.json", (json.dumps(results_dict(results, out), indent=1) + "\n").encode())
    return text


def results_dict(results: Results, out: Path) -> dict[str, Any]:
    """For results.json: metres, m/s, deg/s; `run` is relative to `out`."""
    names = [sequence.name for sequence in results.sequences]
    data = {
        "machine": results.machine,
        "version": results.version,
        "sequences": [
            {"name": s.name, "group": s.group, "path": str(s.path), "frames": s.frames} for s in results.sequences
        ],
        "methods": list(results.methods),
        "cells": [
            {"sequence": c.sequence, "method": c.method, "run": f"cells/{c.sequence}/{c.method}"}
            | {q.name: c.figure(q.metric) for q in QUANTITIES}
            | {"frames": c.frames, "lost": c.lost, "seconds": c.seconds, "error": c.error}
            for c in results.cells
        ],
        "averages": [
            {"group": a.group, "method": a.method, "sequences": a.sequences, **a.values, "better_pct": a.better_pct}
            for a in averages(results)
        ],
        "paper": [
            {"sequence": name, "method": method} | {q.name: getattr(figures, q.name) for q in QUANTITIES}
            for (name, method), figures in paper.FIGURES.items()
            if name in names and method in results.methods
        ],
    }
    plain_data: dict[str, Any] = plain(data)
    return plain_data


def results_csv(results: Results) -> str:
    """One line a cell, then one an average; better_*_pct: how much smaller than the baseline's, per cent."""
    names = [q.name for q in QUANTITIES]
    head = ["group", "sequence", "method", *names, *(f"better_{name}_pct" for name in names)]
    head += ["frames", "lost", "seconds", "error", *(f"paper_{name}" for name in names)]
    stream = io.StringIO()
    write = csv.writer(stream, lineterminator="\n").writerow
    write(head)
    groups = {sequence.name: sequence.group for sequence in results.sequences}
    for cell in results.cells:
        values = [cell.figure(q.metric) for q in QUANTITIES]
        base = [_figure(results, cell.sequence, BASELINE, q) for q in QUANTITIES]
        better = [better_pct(value, b) for value, b in zip(values, base, strict=True)]
        figures = paper.FIGURES.get((cell.sequence, cell.method))
        rest = [cell.frames, cell.lost, cell.seconds, cell.error]
        write([groups[cell.sequence], cell.sequence, cell.method, *values, *better, *rest, *_of_paper(figures)])
    for a in averages(results):
        rest = ["", "", "", ""]
        figures = paper.average(a.sequences, a.method)
        write([a.group, "average", a.method, *a.values.values(), *a.better_pct.values(), *rest, *_of_paper(figures)])
    return stream.getvalue()


def results_text(results: Results) -> str:
    """Tables for the terminal: a table for each group and quantity, the paper's line under ours."""
    blocks = []
    for group in results.groups:
        for quantity in QUANTITIES:
            header, rows = _table(results, group, quantity)
            lines = [[f"{group}, {quantity.title}, {quantity.unit}", *header]]
            for row in rows:
                lines.append([row.method, *row.ours])
                if any(row.paper):
                    lines.append([f"  paper: {paper.NAMES[row.method]}", *row.paper])
            widths = [max(_LABEL, *(len(line[0]) for line in lines))]
            widths += [max(9, *(len(line[k]) for line in lines)) + 1 for k in range(1, len(lines[0]))]
            blocks.append("\n".join(_aligned(line, widths) for line in lines))
    return "\n\n".join([*blocks, "\n".join(notes(results))])


def results_markdown(results: Results) -> str:
    """The same tables, ours (the paper's in brackets), the best of ours in bold."""
    parts = []
    for group in results.groups:
        for quantity in QUANTITIES:
            header, rows = _table(results, group, quantity, mark_best=lambda text: f"**{text}**")
            lines = [["method", *header], ["---", *("---:" for _ in header)]]
            for row in rows:
                both = [f"{a} ({b})" if b else a for a, b in zip(row.ours, row.paper, strict=True)]
                lines.append([f"`{row.method}`", *both])
            table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
            parts.append(f"**{group[0].upper()}{group[1:]}: {quantity.title}, {quantity.unit}**\n\n{table}")
    listed = "\n".join(f"- {note}" for note in notes(results))
    return "\n\n".join([*parts, listed]) + "\n"


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
        if len(names) < sum(sequence.group == group for sequence in results.sequences):
            over = f"only over {', '.join(names)}: the others lack" if names else "none: each sequence lacks"
            lines.append(f"average of {group}: {over} figures of one of our methods at least")
    if any((s.name, method) in paper.FIGURES for s in results.sequences for method in results.methods):
        lines.append(
            "lines 'paper:', or figures in brackets: Kerl, Stückler, Cremers, ICCV 2015, Tables 2 and 3, on their own "
            "recordings and renderings of such motions; rooms and images differ: compare the orders, not the digits"
        )
    lines.append("all figures are RMSE; drift is over one second; 'better by' compares averages with the baseline's")
    m = results.machine
    lines.append(f"version {results.version}; {m.get('cpu')}, {m.get('cpu_count')} CPUs, {m.get('system')}")
    return lines


# ---------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Row:
    """Of a table, one text a column; the paper's are empty where it has none."""

    method: str
    ours: list[str]
    paper: list[str]


def _table(
    results: Results, group: str, quantity: Quantity, mark_best: Callable[[str], str] = str
) -> tuple[list[str], list[_Row]]:
    """Titles of the columns, and the rows, of one group and quantity."""
    names = [sequence.name for sequence in results.sequences if sequence.group == group]
    mean = {a.method: a for a in averages(results) if a.group == group}
    over = averaged_sequences(results, group)
    with_baseline = BASELINE in results.methods and len(results.methods) > 1
    numbers = {
        method: [*(_figure(results, name, method, quantity) for name in names), mean[method].values[quantity.name]]
        for method in results.methods
    }
    best = [min((v for v in column if v is not None), default=None) for column in zip(*numbers.values(), strict=True)]
    base = paper.average(over, BASELINE)
    rows = []
    for method in results.methods:
        cells = [results.cell(name, method) for name in names]
        words = [_word(cell, value, quantity) for cell, value in zip(cells, numbers[method], strict=False)]
        words.append(_digits(numbers[method][-1], quantity))
        for k, value in enumerate(numbers[method]):
            if value is not None and value == best[k] and len(numbers) > 1:
                words[k] = mark_best(words[k])
        figures = [*(paper.FIGURES.get((name, method)) for name in names), paper.average(over, method)]
        theirs = [_paper_digits(f, quantity) for f in figures]
        if with_baseline:
            is_baseline = method == BASELINE
            words.append("" if is_baseline else _percent(mean[method].better_pct[quantity.name]))
            known = not is_baseline and figures[-1] is not None and base is not None
            theirs.append(
                _percent(better_pct(getattr(figures[-1], quantity.name), getattr(base, quantity.name))) if known else ""
            )
        rows.append(_Row(method, words, theirs))
    return [*names, "average", *(["better by"] if with_baseline else [])], rows


def _word(cell: Cell | None, value: float | None, quantity: Quantity) -> str:
    if cell is None:
        return "-"
    if not cell.counts:
        return "lost" if cell.error is None else "failed"
    return _digits(value, quantity) + ("†" if cell.lost else "")


def _digits(value: float | None, quantity: Quantity) -> str:
    """Three of them, without an exponent."""
    if value is None:
        return "-"
    shown = quantity.scale * value
    decimals = 2 - math.floor(math.log10(shown)) if shown > 0.0 else 0
    return f"{shown:.{min(max(decimals, 0), 6)}f}"


def _paper_digits(figures: paper.Figures | None, quantity: Quantity) -> str:
    if figures is None:
        return ""
    return f"{quantity.scale * getattr(figures, quantity.name):.{quantity.paper_digits}f}"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f} %"


def _aligned(line: Sequence[str], widths: Sequence[int]) -> str:
    cells = [text.rjust(width) for text, width in zip(line[1:], widths[1:], strict=True)]
    return (line[0].ljust(widths[0]) + " " + " ".join(cells)).rstrip()


def _counts(cell: Cell | None) -> bool:
    return cell is not None and cell.counts


def _figure(results: Results, sequence: str, method: str, quantity: Quantity) -> float | None:
    cell = results.cell(sequence, method)
    return None if cell is None else cell.figure(quantity.metric)


def _mean(values: Sequence[float | None]) -> float | None:
    there = [value for value in values if value is not None]
    return sum(there) / len(there) if there and len(there) == len(values) else None


def _of_paper(figures: paper.Figures | None) -> list[float | None]:
    return [None if figures is None else getattr(figures, q.name) for q in QUANTITIES]
