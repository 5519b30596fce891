"""Tables: for people as text, Markdown or a part of the HTML page, for programs as CSV.

print(Table(("sequence", "ATE, mm"), (("lr_kt2", fixed(0.131, 2)),)).text())
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

NOTHING = "-"
"""Stands where there is no number."""


@dataclass(frozen=True)
class Entry:
    """A table's entry. mark: follows the text. note: small print to it. is_worse: than what the note says.

    link: an address that the text leads to.
    """

    text: str
    mark: str = ""
    note: str = ""
    is_best: bool = False
    is_worse: bool = False
    link: str = ""

    def __str__(self) -> str:
        return self.text + self.mark


@dataclass(frozen=True)
class Table:
    """head: the columns' headings with units, the first above the rows' names; rows: as long as the head.

    words: columns that are aligned to the left; the others hold numbers.
    """

    head: tuple[str, ...]
    rows: tuple[tuple[Entry | str, ...], ...]
    title: str = ""
    words: tuple[int, ...] = (0,)

    def text(self) -> str:
        """Aligned columns, notes in a line below their row; without the title."""
        lines: list[Sequence[str]] = [self.head]
        for row in self.rows:
            lines.append([str(entry) for entry in row])
            notes = [_note(entry) for entry in row]
            if any(notes):
                lines.append([f"  {notes[0]}", *notes[1:]])
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        return "\n".join(
            "  ".join(
                text.ljust(width) if k in self.words else text.rjust(width)
                for k, (text, width) in enumerate(zip(line, widths, strict=True))
            ).rstrip()
            for line in lines
        )

    def markdown(self) -> str:
        """Without the title: rows' names as code, the best in bold, notes of numbers in brackets."""
        lines = [self.head, tuple("---" if k in self.words else "---:" for k in range(len(self.head)))]
        for name, *entries in self.rows:
            lines.append((f"`{name}`", *map(_markdown, entries)))
        return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def fixed(value: float | None, digits: int, scale: float = 1.0, sign: str = "") -> str:
    """A number with so many digits after the point; a dash for None and what is not finite. sign: '+': always one."""
    return NOTHING if value is None or not math.isfinite(value) else f"{value * scale:{sign}.{digits}f}"


def significant(value: float | None, digits: int = 3, scale: float = 1.0) -> str:
    """A number with so many significant digits, at most six after the point, without an exponent; a dash for None."""
    if value is None or not math.isfinite(value):
        return NOTHING
    shown = abs(scale * value)
    decimals = digits - 1 - math.floor(math.log10(shown)) if shown > 0.0 else 0
    return f"{scale * value:.{min(max(decimals, 0), 6)}f}"


def best_marked(entries: Sequence[Entry], values: Sequence[float | None], ideal: float = 0.0) -> list[Entry]:
    """The entries, those marked as best that read as the one whose value is nearest to the ideal, unless all do.

    values: theirs, None for those that do not compete. ideal: may be infinite.
    """
    known = [(v, e.text) for v, e in zip(values, entries, strict=True) if v is not None and math.isfinite(v)]
    if len({text for _, text in known}) < 2:
        return list(entries)
    best = min(known, key=lambda item: -item[0] if ideal == math.inf else abs(item[0] - ideal))[1]
    competing = (v is not None and e.text == best for v, e in zip(values, entries, strict=True))
    return [replace(e, is_best=is_best) for e, is_best in zip(entries, competing, strict=True)]


def csv_text(records: Sequence[Mapping[str, Any]]) -> str:
    """A line for each record under the keys of the first; None is empty."""
    stream = io.StringIO()
    if records:
        writer = csv.DictWriter(stream, fieldnames=list(records[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(records)
    return stream.getvalue()


def _note(entry: Entry | str) -> str:
    return entry.note if isinstance(entry, Entry) else ""


def _markdown(entry: Entry | str) -> str:
    text = f"**{entry}**" if isinstance(entry, Entry) and entry.is_best else str(entry)
    return text + (f" ({_note(entry)})" if _note(entry) else "")
