"""What a benchmark runs, as YAML: sequences, cases made of them, methods, and the cells that they make together.

A *sequence* is rendered from a config, or lies in a folder. A *case* is a part of one, with what is done to it. A
*method* is one of ours with options, a peer, a command, or a folder of results. A *cell* measures a method on a case,
for one seed or several. A sequence's name is a case too, and so is a method's or peer's own name a method. A *family*
makes many cases of a few: parts of each, with one thing after another done to them.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, NonNegativeFloat, ValidationError, model_validator

from rsgen.errors import UserError, first_problem
from rsgen.files import read_yaml
from rstrack.metrics.clock import TruthOffset
from rstrack.metrics.extrinsics import TruthExtrinsics
from rstrack.options import CLOUD_PEERS, PEERS, SLAM_PEERS

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


def validated(model: type[Model], path: Path, example: str) -> Model:
    """A YAML file as a model. Raises UserError naming the file and the entry."""
    try:
        return model.model_validate(read_yaml(path))
    except ValidationError as error:
        raise UserError(f"{path}: {first_problem(error)} ({example} is an example)") from None


def beside(sequences: Mapping[str, SequenceEntry], folder: Path) -> dict[str, SequenceEntry]:
    """The sequences of a file in `folder`, with the configs that are files found from there."""
    return {
        name: entry.model_copy(update={"config": folder / entry.config})
        if entry.config is not None and entry.config.suffix
        else entry
        for name, entry in sequences.items()
    }
