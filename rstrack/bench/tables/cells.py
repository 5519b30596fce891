"""What a record's name and settings say of its cell: whose tracker, which sequence, which group."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from rstrack.bench.definitions import OTHERS
from rstrack.bench.record import Record
from rstrack.options import METHODS

_ORDER = ("rs-pg", "rs-g", "rs-p", "rs-pgi", "rs-gi", "gs-pg", "gs-g", "gs-p", "baseline")
# A track with poses for fewer of the frames says little of its error: it counts as lost.
_LEAST_COVERAGE = 0.5


def is_others(record: Record) -> bool:
    """Whether it measures other people's tracker: a peer, a command, or results in a folder."""
    entry = _section(record, "method")
    return bool(entry.get("command") or entry.get("results")) or program_of(record) in OTHERS


def program_of(record: Record) -> str:
    """The method or peer that ran, by its own name."""
    return str(_section(record, "method").get("method") or record.method)


def options_of(record: Record) -> dict[str, Any]:
    """Of our method, those that are not at their defaults."""
    return dict(_section(record, "method").get("options", {}))


def sequence_of(record: Record) -> str:
    """The sequence that the case is a piece of."""
    return str(_section(record, "case").get("sequence", record.case))


def group_of(record: Record) -> str:
    """Cases that are averaged together; empty: none."""
    return str(record.settings.get("group") or "")


def is_change(record: Record) -> bool:
    """Whether something was done to a sequence: its case is named SEQUENCE-CHANGE, or of the group `changes`."""
    return group_of(record) == "changes" or record.case.startswith(f"{sequence_of(record)}-")


def is_done(record: Record | None) -> bool:
    """Whether there are figures."""
    return record is not None and record.error is None and bool(record.runs)


def counts(figures: Mapping[str, float | None]) -> bool:
    """Whether a run's errors mean something: at least half of the frames have a pose."""
    frames, lost = figures.get("frames") or 0.0, figures.get("lost") or 0.0
    return figures.get("ate_mm") is not None and lost <= (1.0 - _LEAST_COVERAGE) * frames


def is_good(record: Record) -> bool:
    """Whether it has run and kept the track."""
    return record.error is None and counts(record.figures)


def figure(record: Record | None, name: str) -> float | None:
    """A figure of a record; None where it failed, the track is lost or lacks it."""
    return record.figures.get(name) if record is not None and is_good(record) else None


def folder_of(record: Record) -> Path:
    """Of its run, relative to that of the results."""
    return Path("cells", record.cell)


def truth_offset_s(record: Record) -> float | None:
    """The offset of the truth's clock that the errors are for, s; None for clocks as they are."""
    offset_ms = record.figures.get("truth_offset_ms")
    return None if offset_ms is None else 1e-3 * offset_ms


def methods_in_order(records: Iterable[Record]) -> list[str]:
    """Names of methods: ours first, variants after what they are variants of, then other people's."""

    def rank(record: Record) -> tuple[bool, int, bool, str]:
        known = OTHERS if is_others(record) else (*_ORDER, *METHODS)
        program = program_of(record)
        place = known.index(program) if program in known else len(known)
        return is_others(record), place, record.method != program, record.method

    return list(dict.fromkeys(record.method for record in sorted(records, key=rank)))


def _section(record: Record, name: str) -> dict[str, Any]:
    found = record.settings.get(name)
    return found if isinstance(found, dict) else {}
