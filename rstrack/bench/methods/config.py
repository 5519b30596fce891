"""What `rstrack bench` is to run: its YAML file, and which sequences, methods and frames of it are asked for.

config = load_bench_config(Path("configs/evaluation.yaml"))
choice = choose(config, quick=True)
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from rsgen.errors import UserError, first_problem
from rsgen.files import read_yaml
from rstrack.options import CLOUD_PEERS, METHODS, PEERS, SLAM_PEERS

# Names of sequences and methods are folders too.
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-][A-Za-z0-9_.-]*$")]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class SequenceEntry(_Section):
    """One sequence."""

    name: Name = Field(description="its folder within --data")
    group: str = Field(min_length=1, description="sequences that are averaged together")
    config: Path = Field(description="what 'rsgen render' makes it from, relative to this file")


class QuickEntry(_Section):
    """What --quick leaves of it."""

    sequences: tuple[Name, ...] = Field(min_length=1, description="names of sequences")
    methods: tuple[Name, ...] = Field(min_length=1, description="names of methods")
    frames: int = Field(ge=10, description="frames of each sequence, from the first one on")


class BenchConfig(_Section):
    """The whole evaluation."""

    sequences: tuple[SequenceEntry, ...] = Field(min_length=1, description="what is tracked")
    methods: tuple[Name, ...] = Field(min_length=1, description="what tracks it, in the order of the tables")
    quick: QuickEntry | None = Field(default=None, description="a subset that runs in minutes")

    @model_validator(mode="after")
    def _names_are_consistent(self) -> BenchConfig:
        names = [entry.name for entry in self.sequences]
        for what, given in (("sequences", names), ("methods", self.methods)):
            twice = [name for name, count in Counter(given).items() if count > 1]
            if twice:
                raise ValueError(f"{what}: '{twice[0]}' is there twice")
        unknown = [name for name in (self.quick.sequences if self.quick else ()) if name not in names]
        if unknown:
            raise ValueError(f"quick.sequences: '{unknown[0]}' is not among the sequences")
        return self


@dataclass(frozen=True)
class Choice:
    """What is run: sequences and methods in the order of the tables; frames [first, last), None: to the end."""

    sequences: tuple[SequenceEntry, ...]
    methods: tuple[str, ...]
    first: int = 0
    last: int | None = None


def load_bench_config(path: Path) -> BenchConfig:
    """Read and validate a file such as configs/evaluation.yaml; its paths come out relative to the working directory.

    Raises UserError naming the file and the entry.
    """
    path = Path(path)
    try:
        config = BenchConfig.model_validate(read_yaml(path))
    except ValidationError as error:
        raise UserError(f"{path}: {first_problem(error)} (configs/evaluation.yaml is an example)") from None
    here = tuple(entry.model_copy(update={"config": path.parent / entry.config}) for entry in config.sequences)
    return config.model_copy(update={"sequences": here})


def choose(
    config: BenchConfig,
    *,
    quick: bool = False,
    frames: slice | None = None,
    sequences: Sequence[str] = (),
    methods: Sequence[str] = (),
    peers: bool = False,
) -> Choice:
    """Narrow the evaluation down; what is given beats what `quick` says.

    sequences, methods: names, none: all of the config; methods may name any of `rstrack.options.METHODS`, PEERS,
    CLOUD_PEERS and SLAM_PEERS. peers: add all of the latter three. Raises UserError for names that there are not.
    """
    subset = config.quick if quick else None
    if quick and subset is None:
        raise UserError("--quick: the config has no section 'quick'")
    names = sequences or (subset.sequences if subset else [entry.name for entry in config.sequences])
    known = [entry.name for entry in config.sequences]
    for name in names:
        if name not in known:
            raise UserError(f"--sequence {name}: the config has no such sequence: it has {', '.join(known)}")
    chosen = list(dict.fromkeys(methods or (subset.methods if subset else config.methods)))
    others = (*PEERS, *CLOUD_PEERS, *SLAM_PEERS)
    for method in chosen:
        if method not in (*METHODS, *others):
            raise UserError(f"no method '{method}': choose from {', '.join((*METHODS, *others))}")
    chosen += [peer for peer in others if peers and peer not in chosen]
    if frames is None:
        frames = slice(0, subset.frames if subset else None)
    entries = tuple(entry for entry in config.sequences if entry.name in names)
    return Choice(entries, tuple(chosen), frames.start or 0, frames.stop)
