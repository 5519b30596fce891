"""What `rstrack bench` leaves in results.json, read back and checked.

results = read_results(Path("runs/bench/results.json"))
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from rsgen.errors import UserError, first_problem
from rsgen.files import read_text

RESULTS = "results.json"


class _Model(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class SequenceEntry(_Model):
    """A sequence of the benchmark. path: where it was, absolute."""

    name: str
    group: str
    path: str
    frames: int


class Figures(_Model):
    """Three RMSEs of a method on a sequence, None where they cannot be had: m, m/s, degrees/s."""

    sequence: str
    method: str
    ate_m: float | None = None
    rpe_m_s: float | None = None
    rpe_deg_s: float | None = None


class CellEntry(Figures):
    """One run of the benchmark. run: its folder, relative to the results. error: why it has no figures."""

    run: str
    frames: int
    lost: int
    seconds: float | None = None
    error: str | None = None


class AverageEntry(_Model):
    """Means of a method over `sequences` of a group. better_pct: how much smaller than the baseline's, per cent."""

    group: str
    method: str
    sequences: tuple[str, ...]
    ate_m: float | None = None
    rpe_m_s: float | None = None
    rpe_deg_s: float | None = None
    better_pct: dict[str, float | None] = {}


class Results(_Model):
    """results.json as `rstrack bench` writes it."""

    machine: Any = None
    version: str = ""
    sequences: tuple[SequenceEntry, ...]
    methods: tuple[str, ...]
    cells: tuple[CellEntry, ...]
    averages: tuple[AverageEntry, ...] = ()
    paper: tuple[Figures, ...] = ()

    def average(self, group: str, method: str) -> AverageEntry:
        """A method's averages over a group; without figures where the file has none."""
        for entry in self.averages:
            if (entry.group, entry.method) == (group, method):
                return entry
        return AverageEntry(group=group, method=method, sequences=())

    def paper_average(self, sequences: Sequence[str], method: str, name: str) -> float | None:
        """Mean of the paper's figures `name` over sequences; None if there are none, or the paper lacks one."""
        found = [getattr(f, name) for f in self.paper if f.method == method and f.sequence in sequences]
        if not found or len(found) < len(sequences) or None in found:
            return None
        return float(sum(found) / len(found))


def read_results(path: Path) -> Results:
    """Read and check results.json. Raises UserError naming the first wrong field."""
    try:
        return Results.model_validate_json(read_text(path))
    except ValidationError as error:
        raise UserError(f"{path}: {first_problem(error)}: run 'rstrack bench' again") from None
