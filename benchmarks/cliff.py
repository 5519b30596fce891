"""The cliff test in docs/results.md: whether the track falls off where a camera file is a little wrong."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass

from rsgen.console.tables import Entry, Table, significant
from rstrack.bench.record import Record
from rstrack.bench.tables.cells import figure, group_of, methods_in_order, sequence_of
from rstrack.bench.tables.shown import Records, of_measure

FAMILY = "cliff"
"""The family's name in the definitions, and so the group of its cells."""
_LEAST_TRACKED = 0.99
_MEDIANS, _MORE_MM = 2.5, 5.0
_TOLD = """\
{methods} with one thing of the camera file a little wrong, begun at several frames: the least share of frames with a
pose, how many cells have less than 99 %, their median ATE, and how many are far off: more than 2.5 medians + 5 mm, or
most frames lost."""


@dataclass(frozen=True)
class Fall:
    """Of one sequence's cells: the least share of frames tracked; how many tracked less than 99 %; their median ATE in
    mm, None where all are lost; how many have an ATE far above that, or none.
    """

    sequence: str
    cells: int
    least: float
    untracked: int
    median_mm: float | None
    off: int


def fall_of(sequence: str, cells: Sequence[Record]) -> Fall:
    """What the cells of one sequence say, one at least."""
    shares = [(cell.total("frames") - cell.total("lost")) / cell.total("frames") for cell in cells]
    ates = [ate for cell in cells if (ate := figure(cell, "ate_mm")) is not None]
    median = statistics.median(ates) if ates else None
    limit = -math.inf if median is None else _MEDIANS * median + _MORE_MM
    off = len(cells) - sum(ate <= limit for ate in ates)
    return Fall(sequence, len(cells), min(shares), sum(share < _LEAST_TRACKED for share in shares), median, off)


def cliff(records: Records) -> list[str]:
    """The section: a row for each sequence, the worst first; nothing where no cell of the family has run."""
    cells = [record for record in of_measure(records, "track") if group_of(record) == FAMILY]
    if not cells:
        return []
    names = dict.fromkeys(sequence_of(cell) for cell in cells)
    falls = [fall_of(name, [cell for cell in cells if sequence_of(cell) == name]) for name in names]
    falls.sort(key=lambda fall: (fall.least, -fall.off / fall.cells))
    rows: list[tuple[Entry | str, ...]] = []
    for fall in falls:
        texts = (f"{fall.cells}", f"{100.0 * fall.least:.1f}", f"{fall.untracked}", significant(fall.median_mm))
        rows.append((fall.sequence, *map(Entry, texts), Entry(f"{fall.off}")))
    head = ("sequence", "cells", "tracked at worst, %", "cells below 99 %", "median ATE, mm", "cells far off")
    told = _TOLD.format(methods=", ".join(f"`{method}`" for method in methods_in_order(cells)))
    return ["## The cliff test", "", told, "", Table(head, tuple(rows)).markdown(), ""]
