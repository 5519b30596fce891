"""What a record's name and settings say of its cell: whose tracker, which sequence, which group."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rstrack.bench.definitions import OTHERS
from rstrack.bench.record import Record
from rstrack.options import METHODS

_ORDER = ("rs-pg", "rs-g", "rs-p", "rs-pgi", "rs-gi", "gs-pg", "gs-g", "gs-p", "baseline")


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
