"""Tables with what has to be said about them, as files: text, Markdown and CSV."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rsgen.console.tables import Table, csv_text
from rsgen.files import atomic_write
from rstrack.bench.record import Record


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


def provenance(records: Iterable[Record]) -> str:
    """Version, commit, dates, machine, how many cells."""
    made = list(records)

    def each(values: Iterable[str | None]) -> str:
        return ", ".join(dict.fromkeys(value for value in values if value)) or "?"

    dates = sorted({record.date[:10] for record in made if record.date})
    machines = each(f"{r.machine.get('cpu', '?')}, {r.machine.get('cores', '?')} cores" for r in made if r.machine)
    load = max((float(record.machine.get("load") or 0.0) for record in made), default=0.0)
    return (
        f"version {each(r.version for r in made)}, commit {each(r.commit for r in made)}, "
        f"{' to '.join(dict.fromkeys((dates[0], dates[-1]))) if dates else '?'}; {machines}, load before at most "
        f"{load:.3g}; {len(made)} cells."
    )


def failures(records: Iterable[Record]) -> list[str]:
    """A line for each error, with the cells that have it: what was skipped or has failed, and why."""
    missing: dict[str, list[str]] = defaultdict(list)
    for record in records:
        if record.error is not None:
            missing[f"{'Skipped' if record.skipped else 'Failed'} ({record.error})"].append(record.cell)
    return [f"{why}: {', '.join(cells)}." for why, cells in missing.items()]
