"""What a benchmark runs: YAML files of sequences, cases, methods and cells, and the cells that these make together.

benchmark = load_benchmark([Path("benchmarks/cases.yaml"), Path("benchmarks/gate.yaml")])
for cell in benchmark.cells:
    print(cell.name)              # track/demo/rs-pg

A *sequence* is rendered from a config, or lies in a folder. A *case* is a part of one, with what is done to it. A
*method* is one of ours with options, a peer, a command, or a folder of results. A *cell* measures a method on a case,
for one seed or several. A sequence's name is a case too, and so is a method's or peer's own name a method. A *family*
makes many cases of a few: parts of each, with one thing after another done to them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, NonNegativeFloat, model_validator

from rsgen.errors import UserError, validated
from rsgen.files import read_yaml
from rstrack.metrics.truth_fit import TruthExtrinsics, TruthOffset
from rstrack.options import CLOUD_PEERS, METHODS, PEERS, SLAM_PEERS, Options

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-][A-Za-z0-9_.-]*$")]
Pattern = Annotated[str, Field(pattern=r"^[A-Za-z0-9_*?-][A-Za-z0-9_.*?-]*$")]
Frames = Annotated[str, Field(pattern=r"^\d*:\d*$")]
Changes = tuple[dict[str, dict[str, Any]], ...]
OTHERS: tuple[str, ...] = (*PEERS, *CLOUD_PEERS, *SLAM_PEERS)
RENDERER = "rsgen"
"""The method of cells that measure the renderer, on the config of a sequence: nothing tracks."""


class StrictModel(BaseModel):
    """Of a file or of settings: nothing but what it declares."""

    model_config = ConfigDict(extra="forbid", frozen=True)


Model = TypeVar("Model", bound=StrictModel)


class SequenceEntry(StrictModel):
    """One sequence: `config`, or `path`."""

    config: Path | None = Field(
        default=None, description="what 'rsgen render' makes it from: a name, or a file beside this one"
    )
    set: dict[str, Any] = Field(default={}, description="fields of the config that are to be others")
    data: dict[str, str] = Field(default={}, description="fields of the config that name files of --data")
    width: int | None = Field(default=None, ge=32, le=16384, description="of all images, lenses in proportion, px")
    frames: Frames | None = Field(default=None, description="A:B, which are rendered; default: all")
    path: Path | None = Field(default=None, description="folder of a recording, relative to --data")
    group: str = Field(default="", description="sequences that are averaged together")

    @model_validator(mode="after")
    def _one_source(self) -> SequenceEntry:
        if (self.config is None) == (self.path is None):
            raise ValueError("give either config, to be rendered, or path, of a folder that is there")
        return self


class NoiseEntry(StrictModel):
    """What is added to images when they are read, see `rstrack.data.image_files.with_noise`; from the run's seed."""

    depth: float = Field(default=0.0, ge=0.0, description="sigma of depth z is this times z squared, 1/m")
    intensity: float = Field(default=0.0, ge=0.0, description="sigma of grey values in [0, 1]")


class CaseEntry(StrictModel):
    """A part of a sequence, and what is done to it."""

    sequence: Name = Field(description="of `sequences`")
    frames: Frames | None = Field(default=None, description="A:B, which are tracked; default: all")
    changes: Changes = Field(default=(), description="of `rstrack.bench.changes`")
    noise: NoiseEntry = Field(default=NoiseEntry(), description="added to the images")
    camera: Path | None = Field(default=None, description="camera file to use, relative to this file")
    truth_offset: TruthOffset | None = Field(default=None, description="of the truth's clock: seconds, or auto")
    truth_extrinsics: TruthExtrinsics | None = Field(
        default=None, description="auto: NEES and coverage with those of the truth fitted; all other errors without"
    )
    truth_noise: tuple[NonNegativeFloat, NonNegativeFloat] | None = Field(
        default=None,
        description="sigma of the truth's own motions of one second, mm and degrees, for NEES and coverage",
    )
    group: str | None = Field(default=None, description="cases that are averaged together; default: the sequence's")


class MemberEntry(StrictModel):
    """A case that a family takes parts of."""

    frames: tuple[Frames, ...] = Field(min_length=1, description="A:B of each part")
    but: dict[Name, Changes | None] = Field(default={}, description="perturbations that are others here; null: none")


class FamilyEntry(StrictModel):
    """Every perturbation of every part of some cases: cases FAMILY-CASE-PERTURBATION-from_A, one group."""

    cases: dict[Name, MemberEntry] = Field(min_length=1, description="cases or sequences, of this file or those before")
    perturbations: dict[Name, Changes] = Field(min_length=1, description="changes that are made after the case's own")


class MethodEntry(StrictModel):
    """What tracks: one of ours with options, a peer, a command, or a folder with results."""

    method: Name | None = Field(default=None, description="of ours, of the peers, or rsgen; default: the entry's name")
    options: dict[str, Any] = Field(default={}, description="of `rstrack.options.Options`")
    command: str = Field(default="", description="another tracker, as 'rstrack bench --peer-command' has it")
    results: Path | None = Field(default=None, description="folder with CASE.txt (TUM) or CASE/ (a run) of another")


class CellsEntry(StrictModel):
    """Cells: every method on every case."""

    cases: tuple[Pattern, ...] = Field(min_length=1, description="names, * and ? allowed")
    methods: tuple[Name, ...] = Field(min_length=1, description="names")
    measure: Name = Field(default="track", description="what is measured")
    seeds: int = Field(default=1, ge=1, le=10_000, description="runs, with seeds 0, 1, ...")
    settings: dict[str, Any] = Field(default={}, description="of the measure")
    draw: int | None = Field(default=None, ge=1, description="so many of these cells, drawn by chance; default: all")
    draw_seed: int = Field(default=0, ge=0, description="of that chance")


class BenchmarkFile(StrictModel):
    """A file of definitions; several are put together."""

    sequences: dict[Name, SequenceEntry] = {}
    cases: dict[Name, CaseEntry] = {}
    families: dict[Name, FamilyEntry] = {}
    methods: dict[Name, MethodEntry] = {}
    cells: tuple[CellsEntry, ...] = ()
    every: Literal["code", "version", "third version"] = Field(
        default="version",
        description="finished cells are run again when the code changes, or the version, or by three minor versions",
    )


def read_definitions(model: type[Model], path: Path, example: str) -> Model:
    """A YAML file as a model. Raises UserError naming the file and the entry."""
    return validated(model.model_validate, read_yaml(path), path, cure=f" ({example} is an example)")


def beside(sequences: Mapping[str, SequenceEntry], folder: Path) -> dict[str, SequenceEntry]:
    """The sequences of a file in `folder`, with the configs that are files found from there."""
    return {
        name: entry.model_copy(update={"config": folder / entry.config})
        if entry.config is not None and entry.config.suffix
        else entry
        for name, entry in sequences.items()
    }


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
    file = read_definitions(BenchmarkFile, path, "benchmarks/gate.yaml")
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
