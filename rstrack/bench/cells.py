"""The cells of a benchmark: each is one measure of one method on one case, put together from files of definitions.

benchmark = load_benchmark([Path("benchmarks/cases.yaml"), Path("benchmarks/gate.yaml")])
for cell in benchmark.cells:
    print(cell.name)              # track/demo/rs-pg
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.errors import UserError
from rstrack.bench.definitions import (
    OTHERS,
    RENDERER,
    BenchmarkFile,
    CaseEntry,
    CellsEntry,
    FamilyEntry,
    MethodEntry,
    SequenceEntry,
    beside,
    validated,
)
from rstrack.options import METHODS, Options


@dataclass(frozen=True)
class Cell:
    """One measure of one method on one case. methods and cases by name, as in the tables."""

    measure: str
    case: str
    method: str
    seeds: tuple[int, ...]
    case_entry: CaseEntry
    sequence: SequenceEntry
    method_entry: MethodEntry
    settings: Mapping[str, Any]

    @property
    def name(self) -> str:
        """MEASURE/CASE/METHOD."""
        return f"{self.measure}/{self.case}/{self.method}"

    @property
    def group(self) -> str:
        """Cases that are averaged together."""
        return self.sequence.group if self.case_entry.group is None else self.case_entry.group

    @property
    def program(self) -> str:
        """The method or peer that runs: its own name."""
        return self.method_entry.method or self.method

    @property
    def is_ours(self) -> bool:
        """Whether it is one of `rstrack.options.METHODS`."""
        return self.program in METHODS and not self.method_entry.command and self.method_entry.results is None

    @property
    def renders(self) -> bool:
        """Whether the renderer is measured: the sequence itself is not needed."""
        return self.program == RENDERER

    @property
    def options(self) -> Options:
        """Of one of our methods. Raises UserError."""
        try:
            return Options(**({"method": self.program} if self.is_ours else {}) | self.method_entry.options)
        except TypeError as error:
            raise UserError(f"method {self.method}: {error}") from None

    @property
    def frames(self) -> slice:
        """The frames that are tracked."""
        return frames_of(self.case_entry.frames)

    def as_dict(self) -> dict[str, Any]:
        """Everything that defines it, as plain data, without what is left at its default; of files the names alone."""
        entries = {"sequence": self.sequence, "case": self.case_entry, "method": self.method_entry}
        plain: dict[str, dict[str, Any]] = {}
        for name, entry in entries.items():
            fields = entry.model_dump(exclude_defaults=True)
            plain[name] = {field: v.name if isinstance(v, Path) else v for field, v in fields.items()}
        return plain | {"settings": dict(self.settings), "group": self.group}


@dataclass(frozen=True)
class Benchmark:
    """All cells of some definitions, in their order."""

    cells: tuple[Cell, ...]
    every: str = "version"

    def only(self, patterns: Sequence[str]) -> Benchmark:
        """The cells whose names match one of the patterns, all without one. Raises UserError: none does."""
        chosen = [c for c in self.cells if not patterns or any(fnmatchcase(c.name, f"*{p}*") for p in patterns)]
        if not chosen:
            raise UserError(f"--only {' '.join(patterns)}: no cell has such a name: they are MEASURE/CASE/METHOD")
        return Benchmark(tuple(chosen), self.every)


def load_benchmark(paths: Sequence[Path]) -> Benchmark:
    """Read and put together files of definitions, later ones on top. Raises UserError naming file and entry."""
    files = [_load(Path(path)) for path in paths]
    sequences = {name: entry for file in files for name, entry in file.sequences.items()}
    cases = {name: CaseEntry(sequence=name) for name in sequences}
    for file in files:
        cases |= file.cases
        for name, family in file.families.items():
            cases |= _family_cases(name, family, cases)
    methods = {name: MethodEntry() for name in (*METHODS, *OTHERS, RENDERER)}
    methods |= {name: entry for file in files for name, entry in file.methods.items()}
    cells: dict[str, Cell] = {}
    for entry in (entry for file in files for entry in file.cells):
        for cell in _cells(entry, sequences, cases, methods):
            if cell.name in cells:
                raise UserError(f"{paths[-1]}: cell {cell.name} is there twice: give one of them another case's name")
            cells[cell.name] = cell
    return Benchmark(tuple(cells.values()), files[-1].every if files else "version")


def frames_of(text: str | None) -> slice:
    """The slice of 'A:B'."""
    first, _, last = (text or ":").partition(":")
    return slice(int(first) if first else None, int(last) if last else None)


def _load(path: Path) -> BenchmarkFile:
    file = validated(BenchmarkFile, path, "benchmarks/gate.yaml")
    cases = {
        name: entry if entry.camera is None else entry.model_copy(update={"camera": path.parent / entry.camera})
        for name, entry in file.cases.items()
    }
    return file.model_copy(update={"cases": cases, "sequences": beside(file.sequences, path.parent)})


def _family_cases(name: str, family: FamilyEntry, cases: Mapping[str, CaseEntry]) -> dict[str, CaseEntry]:
    found: dict[str, CaseEntry] = {}
    for case, member in family.cases.items():
        if case not in cases:
            raise UserError(f"family {name}: no case or sequence '{case}': define it in this file or one before")
        unknown = [what for what in member.but if what not in family.perturbations]
        if unknown:
            raise UserError(f"family {name}: {case}: no perturbation '{unknown[0]}' that could be another here")
        for what, changes in {**family.perturbations, **member.but}.items():
            if changes is None:
                continue
            for frames in member.frames:
                made = f"{name}-{case}-{what}-from_{frames_of(frames).start or 0}"
                if made in found:
                    raise UserError(f"family {name}: {made} is there twice: begin each part at another frame")
                own = {"frames": frames, "changes": (*cases[case].changes, *changes), "group": name}
                found[made] = cases[case].model_copy(update=own)
    return found


def _cells(
    entry: CellsEntry, sequences: Mapping[str, SequenceEntry], cases: Mapping[str, CaseEntry],
    methods: Mapping[str, MethodEntry],
) -> list[Cell]:  # fmt: skip
    found = []
    for pattern in entry.cases:
        names = [name for name in cases if fnmatchcase(name, pattern)]
        if not names:
            raise UserError(f"cells: no case or sequence '{pattern}'")
        for case in names:
            if cases[case].sequence not in sequences:
                raise UserError(f"case {case}: no sequence '{cases[case].sequence}'")
            for method in entry.methods:
                if method not in methods:
                    raise UserError(f"cells: no method '{method}': define it in methods")
                seeds, sequence = tuple(range(entry.seeds)), sequences[cases[case].sequence]
                found.append(
                    Cell(entry.measure, case, method, seeds, cases[case], sequence, methods[method], entry.settings)
                )
    return found if entry.draw is None else _drawn(found, entry.draw, entry.draw_seed)


def _drawn(cells: Sequence[Cell], count: int, seed: int) -> list[Cell]:
    """So many of the cells, in their order; which ones depends on all their names and the seed alone."""
    if count > len(cells):
        raise UserError(f"cells: draw: {count} of {len(cells)} cells: draw at most as many as there are")
    names = sorted(cell.name for cell in cells)
    kept = {names[k] for k in np.random.default_rng(seed).choice(len(names), count, replace=False)}
    return [cell for cell in cells if cell.name in kept]
