"""Records as tables: which records, their texts, averages over groups, and the files that are written of them."""

from __future__ import annotations

import dataclasses
import math
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from rsgen.console.tables import NOTHING, Entry, Table, best_marked, csv_text, significant
from rsgen.files import atomic_write
from rstrack.bench.figures import heading, paper_average
from rstrack.bench.record import (
    CellRecord,
    Figures,
    methods_in_order,
)

Records = Mapping[str, CellRecord]
ERRORS = ("ate_mm", "drift_mm_s", "drift_deg_s")
"""Shown together, in this order: mm · mm/s · deg/s."""
_DOT = " · "
_NUMBERED = re.compile(r"(\D+)(\d*)")
_SIDE_BY_SIDE, _MOST_COLUMNS = 12, 10
# Commits of records that are named one by one.
_LISTED = 3


@dataclass(frozen=True)
class Average:
    """Of one method over the cases of a group that it has figures of: `cases` of `of`. Counts are sums of all runs."""

    figures: dict[str, float]
    cases: int
    of: int
    lost: int
    silent: int | None
    peak_mb: float | None

    @property
    def mark(self) -> str:
        """† for lost frames, and how many cases there are figures of where it is not all."""
        few = f" ({self.cases} of {self.of})" if 0 < self.cases < self.of else ""
        return ("†" if self.lost else "") + few


def of_measure(records: Records, measure: str) -> list[CellRecord]:
    """Finished ones, by their names, numbers in these in their order."""
    found = [record for record in records.values() if record.measure == measure and record.is_done]
    return sorted(found, key=lambda record: [(text, int(n or -1)) for text, n in _NUMBERED.findall(record.cell)])


def of_group(records: Records, group: str, changes: bool = False) -> list[CellRecord]:
    """Tracks of a group of sequences, as they are."""
    tracks = of_measure(records, "track")
    return [record for record in tracks if record.group == group and (changes or not record.is_change)]


def cases_of(records: Iterable[CellRecord]) -> list[str]:
    """Their cases."""
    return list(dict.fromkeys(record.case for record in records))


def averages(records: Sequence[CellRecord]) -> dict[str, Average]:
    """Of each method, over the cases whose track it kept."""
    found, of = {}, len(cases_of(records))
    for method in methods_in_order(records):
        mine = [record for record in records if record.method == method]
        good = [record for record in mine if record.is_good]
        means = CellRecord("", "", {}, runs=tuple({**record.figures} for record in good)).figures
        lost, silent = (round(math.fsum(record.total(name) for record in mine)) for name in ("lost", "silent"))
        peak = max((value for record in mine for value in record.values("peak_mb")), default=None)
        found[method] = Average(
            means, len(good), of, lost, silent if any(record.values("silent") for record in mine) else None, peak
        )
    return found


def triple(figures: Mapping[str, float], mark: str = "") -> str:
    """'mm · mm/s · deg/s', a dash where there is nothing at all."""
    values = [significant(figures.get(name)) for name in ERRORS]
    return NOTHING if set(values) == {NOTHING} else _DOT.join(values) + mark


def cell_triple(record: CellRecord | None) -> str:
    """Of one cell: † where frames were lost, 'lost' where most were."""
    if record is None or not record.is_done:
        return NOTHING
    return triple(record.figures, "†" if record.total("lost") else "") if record.is_good else "lost"


def paper_triple(sequences: Sequence[str], method: str) -> str:
    """The paper's averages, empty where it has none."""
    theirs = paper_average(sequences, method)
    return triple(theirs) if theirs else ""


def sequences_of(records: Iterable[CellRecord]) -> list[str]:
    """Of some cells, each once."""
    return list(dict.fromkeys(record.sequence for record in records))


def cell_text(record: CellRecord | None, name: str) -> str:
    """A figure of one cell: † where frames were lost, 'lost' where most were."""
    if record is None or not record.is_done:
        return NOTHING if record is None or record.error is None else "failed"
    value = record.figures.get(name)
    if not record.is_good and record.total("lost"):
        return "lost"
    if value is None:
        return NOTHING
    return significant(value) + ("†" if record.total("lost") else "")


def pivot(
    head: str, rows: Sequence[str], columns: Sequence[str], entry: Callable[[str, str], Entry],
    value: Callable[[str, str], float | None] | None = None, title: str = "", *,
    name: Callable[[str], Entry | str] = str, ideal: float = 0.0, by_row: bool = False,
) -> Table:  # fmt: skip
    """A table of entries by the names of rows and columns. name: what stands at the beginning of a row.

    value: of an entry; that nearest to the ideal is marked as the best of its column, or of its row.
    """
    entries = [[entry(row, column) for column in columns] for row in rows]
    if value is not None:
        values = [[value(row, column) for column in columns] for row in rows]
        if by_row:
            entries = [best_marked(*pair, ideal) for pair in zip(entries, values, strict=True)]
        else:
            of_columns = zip(zip(*entries, strict=True), zip(*values, strict=True), strict=True)
            columns_marked = [best_marked(*pair, ideal) for pair in of_columns]
            entries = [list(row) for row in zip(*columns_marked, strict=True)]
    lines: list[tuple[Entry | str, ...]] = [(name(row), *of) for row, of in zip(rows, entries, strict=True)]
    return Table((head, *columns), tuple(lines), title)


def by_sequence(records: Sequence[CellRecord]) -> Table:
    """ATE: a row for each method, a column for each case."""
    found = {(r.method, r.case): r for r in records}

    def ate_mm(method: str, case: str) -> float | None:
        cell = found.get((method, case))
        return None if cell is None else cell.figures.get("ate_mm")

    def entry(method: str, case: str) -> Entry:
        return Entry(cell_text(found.get((method, case)), "ate_mm"))

    return pivot("method", methods_in_order(records), cases_of(records), entry, ate_mm)


def by_case(records: Sequence[CellRecord], triples: bool = False) -> Table:
    """A row for each case, a column for each method; side by side where there is one method alone."""
    found = {(r.method, r.case): r for r in records}

    def entry(case: str, method: str) -> Entry:
        cell = found.get((method, case))
        return Entry(cell_triple(cell) if triples else cell_text(cell, "ate_mm"))

    table = pivot("case", cases_of(records), methods_in_order(records), entry)
    if len(table.head) > 2 or len(table.rows) < _SIDE_BY_SIDE:
        return table
    half = -(-len(table.rows) // 2)
    beside: list[tuple[Entry | str, ...]] = [(f"`{case}`", *cells) for case, *cells in table.rows[half:]]
    both: tuple[tuple[Entry | str, ...], ...] = tuple(
        (*left, *right) for left, right in zip(table.rows[:half], [*beside, ("", "")], strict=False)
    )
    return Table((*table.head, *table.head), both, words=(0, 2))


def measured_table(records: Sequence[CellRecord], patterns: Sequence[str], title: str = "") -> Table:
    """A row for each cell, a column for each figure that matches one of the patterns; 'x*+': the sum of those."""
    names = list(dict.fromkeys(name for record in records for name in record.figures if name != "peak_mb"))
    columns: dict[str, list[str]] = {}
    for pattern in patterns:
        matching = [name for name in names if fnmatchcase(name, pattern.removesuffix("+"))]
        if pattern.endswith("+") and matching:
            columns[pattern.removesuffix("+").rstrip("*_").replace("_", " ")] = matching
        else:
            columns |= {heading(name): [name] for name in matching}
    columns = columns or {heading(name): [name] for name in names[:_MOST_COLUMNS]}
    are_many = len({record.method for record in records}) > 1
    rows: list[tuple[Entry | str, ...]] = []
    for record in records:
        figures = record.figures
        values = [[figures[name] for name in of if name in figures] for of in columns.values()]
        entries = [Entry(plainly(math.fsum(v)) if v else NOTHING) for v in values]
        rows.append((f"{record.case} {record.method}" if are_many else record.case, *entries))
    first = "case" if are_many or not records else f"case ({records[0].method})"
    return Table((first, *columns), tuple(rows), title)


def joined(records: Sequence[CellRecord]) -> list[CellRecord]:
    """Cells of several measures on the same case and method as one."""
    found: dict[tuple[str, str], CellRecord] = {}
    for record in records:
        first = found.get((record.case, record.method), dataclasses.replace(record, runs=()))
        both: Figures = {**first.figures, **record.figures}
        found[record.case, record.method] = dataclasses.replace(first, seeds=(0,), runs=(both,))
    return list(found.values())


def plainly(value: float) -> str:
    """Whole numbers as they are, others to three digits."""
    return f"{value:.0f}" if value == round(value) else significant(value)


def is_default(record: CellRecord) -> bool:
    """Whether a method of ours is its own name's, or a peer."""
    return record.is_others or (record.method == record.program and not record.options)


def closes_loops(record: CellRecord) -> bool:
    """Whether it is one of ours as `rstrack track` has it by default: loops closed at the end, all else as ever."""
    return not record.is_others and record.options == {"loops": "end"}


def tables_text(tables: Sequence[Table], notes: Sequence[str]) -> str:
    """For the terminal: titles above their tables, notes below all of them."""
    return "\n\n".join([*(f"{table.title}\n{table.text()}" for table in tables), "\n".join(notes)])


def tables_markdown(tables: Sequence[Table], notes: Sequence[str]) -> str:
    """The same, the best in bold."""
    parts = [f"**{table.title[:1].upper()}{table.title[1:]}**\n\n{table.markdown()}" for table in tables]
    return "\n\n".join([*parts, "\n".join(f"- {note}" for note in notes)]) + "\n"


def write_tables(
    out: Path, tables: Sequence[Table], notes: Sequence[str], rows: Sequence[Mapping[str, Any]], name: str = "results"
) -> str:
    """Write NAME.txt, NAME.md and NAME.csv, which has the rows, into `out`; returns the text.

    Raises UserError.
    """
    text = tables_text(tables, notes)
    out.mkdir(parents=True, exist_ok=True)
    atomic_write(out / f"{name}.txt", (text + "\n").encode())
    atomic_write(out / f"{name}.md", tables_markdown(tables, notes).encode())
    atomic_write(out / f"{name}.csv", csv_text(rows).encode())
    return text


def provenance(records: Iterable[CellRecord]) -> str:
    """Versions, commits (of many the oldest and the newest), dates, machines, how many cells."""
    made = sorted(records, key=lambda record: record.date)

    def each(values: Iterable[str | None]) -> str:
        return ", ".join(dict.fromkeys(value for value in values if value)) or "?"

    commits = list(dict.fromkeys(record.commit for record in made if record.commit))
    if len(commits) > _LISTED:
        commits = [f"{commits[0]} to {commits[-1]} ({len(commits)} commits: each record names its own)"]
    dates = sorted({record.date[:10] for record in made if record.date})
    machines = each(f"{r.machine.get('cpu', '?')}, {r.machine.get('cores', '?')} cores" for r in made if r.machine)
    load = max((float(record.machine.get("load") or 0.0) for record in made), default=0.0)
    return (
        f"version {each(r.version for r in made)}, commit {each(commits)}, "
        f"{' to '.join(dict.fromkeys((dates[0], dates[-1]))) if dates else '?'}; {machines}, load before at most "
        f"{load:.3g}; {len(made)} cells."
    )


def failures(records: Iterable[CellRecord]) -> list[str]:
    """A line for each error, with the cells that have it: what was skipped or has failed, and why."""
    missing: dict[str, list[str]] = defaultdict(list)
    for record in records:
        if record.error is not None:
            missing[f"{'Skipped' if record.skipped else 'Failed'} ({record.error})"].append(record.cell)
    return [f"{why}: {', '.join(cells)}." for why, cells in missing.items()]
