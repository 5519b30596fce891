"""Two sections of docs/results.md that judge: where ours is not the best, and the cliff test.

Ours is not the best in every case and error in which a peer, or the paper, beats `rs-pg`. The cliff test shows whether
the track falls off where a camera file is a little wrong.
"""

from __future__ import annotations

import math
import statistics
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from rsgen.console.tables import Entry, Table, significant
from rstrack.bench.figures import PAPER_FIGURES
from rstrack.bench.record import CellRecord, figure, methods_in_order
from rstrack.bench.tables import ERRORS, Records, of_measure

OURS = "rs-pg"
FAMILY = "cliff"
"""The family's name in the definitions, and so the group of its cells."""
_LEAST_TRACKED = 0.99
_MEDIANS, _MORE_MM = 2.5, 5.0
_ABOUT = """\
{methods} with one thing of the camera file a little wrong, begun at several frames: the least share of frames with a
pose, how many cells have less than 99 %, their median ATE, and how many are far off: more than 2.5 medians + 5 mm, or
most frames lost."""


@dataclass(frozen=True)
class Beaten:
    """On one case, in one error: ours, None where it has none at all, and the best of the others. lost: its frames."""

    case: str
    figure: str
    ours: float | None
    theirs: float
    who: str
    lost: int = 0

    def text(self) -> str:
        """'ours > theirs (who)'."""
        lost = f", {self.lost} frames lost" if self.lost else ""
        ours = "lost" if self.ours is None else significant(self.ours)
        return f"{ours} > {significant(self.theirs)} ({self.who}{lost})"


def beaten(full: Records) -> list[Beaten]:
    """All of them, in the order of the cases. The paper's best method counts, on its own recording of that name."""
    tracks = of_measure(full, "track")
    out = []
    for ours in (record for record in tracks if record.method == OURS):
        peers = [record for record in tracks if record.case == ours.case and record.is_others]
        for name in ERRORS:
            found = [*_of_peers(peers, name), *_of_paper(ours, name)]
            own = ours.figures.get(name)
            best = min(found, key=lambda item: item[0], default=None)
            if best is not None and (own is None or best[0] < own):
                out.append(Beaten(ours.case, name, own, *best))
    return out


def compared(full: Records) -> int:
    """Cases of `rs-pg` that there is a peer or the paper for."""
    tracks = of_measure(full, "track")
    others = {record.case for record in tracks if record.is_others}
    return sum(r.method == OURS and (r.case in others or bool(_of_paper(r, "ate_mm"))) for r in tracks)


def slower(full: Records) -> list[CellRecord]:
    """Cells of the measure `speed` of our methods that take longer than the peer beside them."""
    timed = [record for record in of_measure(full, "speed") if not record.is_others]
    return [record for record in timed if record.figures.get("ratio", 0.0) > 1.0]


def beaten_table(found: Sequence[Beaten]) -> Table:
    """A row for each case."""
    cases = list(dict.fromkeys(each.case for each in found))
    texts = {(each.case, each.figure): each.text() for each in found}
    rows: list[tuple[Entry | str, ...]] = [(case, *(texts.get((case, name), "") for name in ERRORS)) for case in cases]
    return Table(("`rs-pg` > the best of the others", "ATE, mm", "mm/s", "deg/s"), tuple(rows))


def sentences(full: Records) -> str:
    """One to three sentences, with the figures; empty where nothing was measured beside others."""
    found, cases = beaten(full), compared(full)
    if not cases:
        return ""
    parts = []
    if not found:
        parts.append(f"In the {cases} cases that others were measured on, or the paper, `rs-pg` has the least errors.")
    else:
        by = ", ".join(f"{who} {count}" for who, count in Counter(each.who for each in found).most_common())
        known = [each for each in found if each.ours is not None]
        parts.append(
            f"**Where ours is not the best:** others beat `rs-pg` in {len(found)} of {3 * cases} errors (ATE, mm/s and "
            f"deg/s of {cases} cases): {by}."
        )
        if known:
            worst = max(known, key=lambda each: (each.ours or 0.0) / each.theirs)
            unit = {"ate_mm": "mm of ATE", "drift_mm_s": "mm/s", "drift_deg_s": "deg/s"}[worst.figure]
            parts.append(
                f"Furthest behind it is on {worst.case}: {significant(worst.ours)} {unit}, {worst.who} "
                f"{significant(worst.theirs)}."
            )
    slow, timed = slower(full), [r for r in of_measure(full, "speed") if "ratio" in r.figures]
    if slow:
        most = max(slow, key=lambda record: record.figures["ratio"])
        parts.append(
            f"In {len(slow)} of {len(timed)} timings a frame takes longer than {peer_of(most)}'s, up to "
            f"{most.figures['ratio']:.2f} times as long ({most.method} on {most.case})."
        )
    return " ".join(parts)


def peer_of(record: CellRecord) -> str:
    """Whose times a cell of `speed` has beside its own."""
    settings = record.settings.get("settings") or {}
    return str(settings.get("peer", "the peer"))


def _of_peers(peers: Sequence[CellRecord], name: str) -> list[tuple[float, str, int]]:
    return [(r.figures[name], r.method, round(r.total("lost"))) for r in peers if name in r.figures]


def _of_paper(ours: CellRecord, name: str) -> list[tuple[float, str, int]]:
    if ours.case != ours.sequence:  # its figures are of whole sequences
        return []
    return [(figures[name], "the paper", 0) for (case, _), figures in PAPER_FIGURES.items() if case == ours.case]


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


def fall_of(sequence: str, cells: Sequence[CellRecord]) -> Fall:
    """What the cells of one sequence say, one at least."""
    shares = [(cell.total("frames") - cell.total("lost")) / cell.total("frames") for cell in cells]
    ates = [ate for cell in cells if (ate := figure(cell, "ate_mm")) is not None]
    median = statistics.median(ates) if ates else None
    limit = -math.inf if median is None else _MEDIANS * median + _MORE_MM
    off = len(cells) - sum(ate <= limit for ate in ates)
    return Fall(sequence, len(cells), min(shares), sum(share < _LEAST_TRACKED for share in shares), median, off)


def cliff(records: Records) -> list[str]:
    """The section: a row for each sequence, the worst first; nothing where no cell of the family has run."""
    cells = [record for record in of_measure(records, "track") if record.group == FAMILY]
    if not cells:
        return []
    names = dict.fromkeys(cell.sequence for cell in cells)
    falls = [fall_of(name, [cell for cell in cells if cell.sequence == name]) for name in names]
    falls.sort(key=lambda fall: (fall.least, -fall.off / fall.cells))
    rows: list[tuple[Entry | str, ...]] = []
    for fall in falls:
        texts = (f"{fall.cells}", f"{100.0 * fall.least:.1f}", f"{fall.untracked}", significant(fall.median_mm))
        rows.append((fall.sequence, *map(Entry, texts), Entry(f"{fall.off}")))
    head = ("sequence", "cells", "tracked at worst, %", "cells below 99 %", "median ATE, mm", "cells far off")
    about = _ABOUT.format(methods=", ".join(f"`{method}`" for method in methods_in_order(cells)))
    return ["## The cliff test", "", about, "", Table(head, tuple(rows)).markdown(), ""]
