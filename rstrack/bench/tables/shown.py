"""Records as the tables show them: triples of errors, averages over groups, methods' rows."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

from rsgen.console.tables import NOTHING, Entry, Table, best_marked, significant
from rstrack.bench.record import Figures, Record
from rstrack.bench.tables import paper
from rstrack.bench.tables.cells import (
    group_of,
    is_change,
    is_done,
    is_good,
    is_others,
    methods_in_order,
    options_of,
    program_of,
    sequence_of,
)
from rstrack.bench.tables.figures import heading

Records = Mapping[str, Record]
ERRORS = ("ate_mm", "drift_mm_s", "drift_deg_s")
"""Shown together, in this order: mm · mm/s · deg/s."""
_DOT = " · "
_NUMBERED = re.compile(r"(\D+)(\d*)")
_SIDE_BY_SIDE, _MOST_COLUMNS = 12, 10


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


def of_measure(records: Records, measure: str) -> list[Record]:
    """Finished ones, by their names, numbers in these in their order."""
    found = [record for record in records.values() if record.measure == measure and is_done(record)]
    return sorted(found, key=lambda record: [(text, int(n or -1)) for text, n in _NUMBERED.findall(record.cell)])


def of_group(records: Records, group: str, changes: bool = False) -> list[Record]:
    """Tracks of a group of sequences, as they are."""
    tracks = of_measure(records, "track")
    return [record for record in tracks if group_of(record) == group and (changes or not is_change(record))]


def cases_of(records: Iterable[Record]) -> list[str]:
    """Their cases."""
    return list(dict.fromkeys(record.case for record in records))


def averages(records: Sequence[Record]) -> dict[str, Average]:
    """Of each method, over the cases whose track it kept."""
    found, of = {}, len(cases_of(records))
    for method in methods_in_order(records):
        mine = [record for record in records if record.method == method]
        good = [record for record in mine if is_good(record)]
        means = Record("", "", {}, runs=tuple({**record.figures} for record in good)).figures
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


def cell_triple(record: Record | None) -> str:
    """Of one cell: † where frames were lost, 'lost' where most were."""
    if record is None or not is_done(record):
        return NOTHING
    return triple(record.figures, "†" if record.total("lost") else "") if is_good(record) else "lost"


def paper_triple(sequences: Sequence[str], method: str) -> str:
    """The paper's averages, empty where it has none."""
    theirs = paper.average(sequences, method)
    return triple(theirs) if theirs else ""


def sequences_of(records: Iterable[Record]) -> list[str]:
    """Of some cells, each once."""
    return list(dict.fromkeys(sequence_of(record) for record in records))


def cell_text(record: Record | None, name: str) -> str:
    """A figure of one cell: † where frames were lost, 'lost' where most were."""
    if record is None or not is_done(record):
        return NOTHING if record is None or record.error is None else "failed"
    value = record.figures.get(name)
    if not is_good(record) and record.total("lost"):
        return "lost"
    if value is None:
        return NOTHING
    return significant(value) + ("†" if record.total("lost") else "")


def pivot(
    head: str, rows: Sequence[str], columns: Sequence[str], entry: Callable[[str, str], Entry],
    value: Callable[[str, str], float | None] | None = None, title: str = "",
) -> Table:  # fmt: skip
    """A table of entries by the names of rows and columns. value: of an entry, the least of a column being the best."""
    found = []
    for column in columns:
        entries = [entry(row, column) for row in rows]
        found.append(entries if value is None else best_marked(entries, [value(row, column) for row in rows]))
    lines: list[tuple[Entry | str, ...]] = [(row, *(entries[k] for entries in found)) for k, row in enumerate(rows)]
    return Table((head, *columns), tuple(lines), title)


def by_sequence(records: Sequence[Record]) -> Table:
    """ATE: a row for each method, a column for each case."""
    found = {(r.method, r.case): r for r in records}

    def ate_mm(method: str, case: str) -> float | None:
        cell = found.get((method, case))
        return None if cell is None else cell.figures.get("ate_mm")

    def entry(method: str, case: str) -> Entry:
        return Entry(cell_text(found.get((method, case)), "ate_mm"))

    return pivot("method", methods_in_order(records), cases_of(records), entry, ate_mm)


def by_case(records: Sequence[Record], triples: bool = False) -> Table:
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


def measured_table(records: Sequence[Record], patterns: Sequence[str], title: str = "") -> Table:
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


def joined(records: Sequence[Record]) -> list[Record]:
    """Cells of several measures on the same case and method as one."""
    found: dict[tuple[str, str], Record] = {}
    for record in records:
        first = found.get((record.case, record.method), dataclasses.replace(record, runs=()))
        both: Figures = {**first.figures, **record.figures}
        found[record.case, record.method] = dataclasses.replace(first, seeds=(0,), runs=(both,))
    return list(found.values())


def plainly(value: float) -> str:
    """Whole numbers as they are, others to three digits."""
    return f"{value:.0f}" if value == round(value) else significant(value)


def is_default(record: Record) -> bool:
    """Whether a method of ours is its own name's, or a peer."""
    return is_others(record) or (record.method == program_of(record) and not options_of(record))


def closes_loops(record: Record) -> bool:
    """Whether it is one of ours as `rstrack track` has it by default: loops closed at the end, all else as ever."""
    return not is_others(record) and options_of(record) == {"loops": "end"}
