"""A run of a measure on a folder, without definitions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rstrack.bench.cells import CaseEntry, Cell, MethodEntry, SequenceEntry
from rstrack.bench.task import Sources, Task


def make_task(
    root: Path, method: str = "rs-g", options: dict[str, Any] | None = None, settings: dict[str, Any] | None = None,
    seed: int = 0, **case: Any,
) -> Task:  # fmt: skip
    """case: of `CaseEntry`."""
    entry = CaseEntry(sequence="seq", **case)
    sequence = SequenceEntry(path=Path(root.name))
    cell = Cell("measure", "seq", method, (seed,), entry, sequence, MethodEntry(options=options or {}), settings or {})
    return Task(cell, seed, Sources(root.parent), root.parent / "out")
