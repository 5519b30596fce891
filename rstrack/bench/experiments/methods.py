"""Every method on every sequence: the YAML file that lists them, the cells that are asked for, and what these came to.

plan = make_plan(load_methods(Path("configs/evaluation.yaml")), Path("out"), quick=True)
outcome = run_cells(plan.benchmark, Path("out/bench"), Sources(Path("out")))

Methods of ours run with the depth of later frames fused into keyframes and without. The paper fuses with every method,
and so does ours with rolling ones; taken for a global shutter's, rows that are averaged do not fit together, which
helps where images are noisy and harms where they are not. So either may be better.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from pydantic import BaseModel, Field, model_validator

from rsgen.errors import UserError, validated
from rsgen.files import read_text
from rstrack.bench.cells import (
    OTHERS,
    Benchmark,
    CaseEntry,
    Cell,
    MethodEntry,
    Name,
    SequenceEntry,
    StrictModel,
    beside,
    read_definitions,
)
from rstrack.bench.figures import PaperFigures, paper_average
from rstrack.bench.record import CellRecord, figure
from rstrack.bench.tables import (
    ERRORS,
)
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.metrics.association import truth_of
from rstrack.metrics.truth_fit import TruthOffset
from rstrack.options import METHODS, PEERS, Options

MAPPED = ("rs-pg", "gs-pg", "baseline")
"""The methods whose maps are compared: ours, the same without its model of the shutter, and the classical way."""
_FUSE, _NO_FUSE = "-fuse", "-no-fuse"
RESULTS = "results.json"
AVERAGE = "average"
"""The case that averages are records of."""
BASELINE = "baseline"


class Quick(StrictModel):
    """What --quick leaves of it."""

    sequences: tuple[Name, ...] = Field(min_length=1, description="names of sequences")
    methods: tuple[Name, ...] = Field(min_length=1, description="names of methods")
    frames: int = Field(ge=10, description="frames of each sequence, from the first one on")


class MethodsConfig(StrictModel):
    """The whole evaluation. Sequences lie in --data, in folders of their `path`, or of their name if they have none."""

    sequences: dict[Name, SequenceEntry] = Field(min_length=1, description="what is tracked")
    methods: tuple[Name, ...] = Field(min_length=1, description="what tracks it, in the order of the tables")
    quick: Quick | None = Field(default=None, description="a subset that runs in minutes")

    @model_validator(mode="after")
    def _names_are_consistent(self) -> MethodsConfig:
        twice = [name for name, count in Counter(self.methods).items() if count > 1]
        if twice:
            raise ValueError(f"methods: '{twice[0]}' is there twice")
        unknown = [name for name in (self.quick.sequences if self.quick else ()) if name not in self.sequences]
        if unknown:
            raise ValueError(f"quick.sequences: '{unknown[0]}' is not among the sequences")
        return self


@dataclass(frozen=True)
class SequenceInfo:
    """A sequence as it is run; frames: how many of it are used."""

    name: str
    group: str
    path: Path
    frames: int


@dataclass(frozen=True)
class Plan:
    """All cells, sequence by sequence; methods: variants (`variants`), peers and other trackers."""

    benchmark: Benchmark
    sequences: tuple[SequenceInfo, ...]
    methods: tuple[str, ...]


def load_methods(path: Path) -> MethodsConfig:
    """Read and validate a file such as configs/evaluation.yaml. Raises UserError naming the file and the entry."""
    config = read_definitions(MethodsConfig, path, "configs/evaluation.yaml")
    return config.model_copy(update={"sequences": beside(config.sequences, path.parent)})


def make_plan(
    config: MethodsConfig, data: Path, options: Options | None = None, *, quick: bool = False,
    frames: slice | None = None, sequences: Sequence[str] = (), methods: Sequence[str] = (), peers: bool = False,
    added: Mapping[str, Path] | None = None, commands: Mapping[str, str] | None = None,
    truth_offset: TruthOffset | None = None, measure: str = "track",
) -> Plan:  # fmt: skip
    """Look the sequences up in the folder `data` and list the cells; what is given beats what `quick` has.

    sequences, methods: names, none: all of the config; methods may name ours and all peers. peers: all of these too,
    or those that can be timed.
    Each of our methods is run with and without fusion, unless options.fuse chooses or it is not errors that are
    measured. added: results of other trackers by name, each a folder with SEQUENCE.txt (TUM) or SEQUENCE/ (a run
    folder). commands: other trackers by name, see `rstrack.peers.peer`. truth_offset: of the truth's clock. Raises
    UserError, one line: names that there are not; sequences that are missing or not whole, with how to make them.
    """
    options, added, commands = options or Options(), added or {}, commands or {}
    subset = config.quick if quick else None
    if quick and subset is None:
        raise UserError("--quick: the config has no section 'quick'")
    for name in sequences:
        if name not in config.sequences:
            raise UserError(f"--sequence {name}: the config has no such sequence: it has {', '.join(config.sequences)}")
    asked = sequences or (subset.sequences if subset else tuple(config.sequences))
    entries = {name: entry for name, entry in config.sequences.items() if name in asked}
    more = (OTHERS if measure == "track" else PEERS) if peers else ()
    chosen = chosen_methods(methods or (subset.methods if subset else config.methods), more)
    for option, name in (*(("--add", name) for name in added), *(("--peer-command", name) for name in commands)):
        if name in (*chosen, *METHODS, *OTHERS) or (option == "--peer-command" and name in added):
            raise UserError(f"{option} {name}=...: there is a method of that name: choose another name")
    frames = frames or slice(0, subset.frames if subset else None)
    missing = [name for name, entry in entries.items() if not (data / _folder(name, entry)).is_dir()]
    if missing:
        how = "; ".join(_render_command(name, entries[name], data, frames) for name in missing)
        raise UserError(f"{data}: has no {', '.join(missing)}: leave them out with --sequence, or make them: {how}")
    of_each = {name: variants(name, options.fuse) for name in chosen}
    names = [v for found in of_each.values() for v in (found if measure == "track" else found[:1])]
    run = {name: method_entry(name, options) for name in names}
    run |= {name: MethodEntry(results=folder) for name, folder in added.items()}
    run |= {name: MethodEntry(command=command) for name, command in commands.items()}
    infos, cells = [], []
    for name, entry in entries.items():
        dataset = open_dataset(data / _folder(name, entry))
        if truth_of(dataset) is None:
            raise UserError(f"{dataset.root}: has no ground truth to compare with: leave it out with --sequence")
        kept = _kept(dataset, _render_command(name, entry, data, frames), frames)
        infos.append(SequenceInfo(name, entry.group, dataset.root.resolve(), len(kept)))
        part = None if len(kept) == len(dataset) else f"{kept.start}:{kept.stop}"
        case = CaseEntry(sequence=name, frames=part, truth_offset=truth_offset)
        sequence = SequenceEntry(path=_folder(name, entry), group=entry.group)
        cells += [Cell(measure, name, method, (0,), case, sequence, how, {}) for method, how in run.items()]
    return Plan(Benchmark(tuple(cells)), tuple(infos), tuple(run))


def chosen_methods(methods: Sequence[str], more: Sequence[str]) -> list[str]:
    """The methods, each once, and more behind them. Raises UserError for one that there is not."""
    chosen = list(dict.fromkeys(methods))
    for method in chosen:
        if method not in (*METHODS, *OTHERS):
            raise UserError(f"no method '{method}': choose from {', '.join((*METHODS, *OTHERS))}")
    return chosen + [peer for peer in more if peer not in chosen]


def method_entry(name: str, options: Options) -> MethodEntry:
    """The entry of a variant, or of a peer, which has no options."""
    if method_of(name) not in METHODS:
        return MethodEntry()
    return MethodEntry(method=method_of(name), options=given_options(options) | {"fuse": fuses(name)})


def given_options(options: Options) -> dict[str, Any]:
    """Those that are not at their defaults, without the method."""
    defaults = dataclasses.asdict(Options())
    return {k: v for k, v in dataclasses.asdict(options).items() if k != "method" and v != defaults[k]}


# ---------------------------------------------------------------------------------------------------------------------


def _folder(name: str, entry: SequenceEntry) -> Path:
    return entry.path or Path(name)


def _render_command(name: str, entry: SequenceEntry, data: Path, frames: slice) -> str:
    few = "" if frames.stop is None else f" --frames {frames.start or 0}:{frames.stop}"
    return f"rsgen render {entry.config or '...'} --out {data / _folder(name, entry)}{few}"


def _kept(dataset: Dataset, command: str, frames: slice) -> range:
    """The frames that are run. Raises UserError: there are none, or fewer than are wanted have been rendered."""
    if dataset.sequence is not None and (frames.stop is None or frames.stop > len(dataset)):
        there, in_all = min((len(s.paths), s.frames) for s in dataset.sequence.streams.values())
        if there < in_all:
            raise UserError(
                f"{dataset.root}: {there} of {in_all} frames are rendered: finish it with '{command}', leave it out "
                f"with --sequence, or track what there is with --frames 0:{there}"
            )
    return dataset.chosen(frames)


def variants(method: str, fuse: bool | None) -> tuple[str, ...]:
    """Names of what is run of a method, its default setting first; fuse: the only one that is asked for, None: both.

    The default setting has the method's own name: fused where the rolling shutter is modelled, else not. Peers and
    added trackers have one variant.
    """
    if method not in METHODS:
        return (method,)
    names = (method, method + (_NO_FUSE if _is_rolling(method) else _FUSE))
    return tuple(name for name in names if fuse is None or fuses(name) == fuse)


def method_of(name: str) -> str:
    """The method of a variant."""
    return name.removesuffix(_NO_FUSE).removesuffix(_FUSE)


def fuses(name: str) -> bool | None:
    """`Options.fuse` of a variant; None: not one of our methods."""
    if method_of(name) not in METHODS:
        return None
    return not name.endswith(_NO_FUSE) and (name.endswith(_FUSE) or _is_rolling(name))


def row_of(name: str) -> str:
    """The line of the tables that a variant competes for.

    Methods that take the rolling shutter for a global one have one for both settings, the better of which is shown, as
    the paper's may have been. A rolling one without fusion has its own, to tell what the shutter does from what fusion
    does.
    """
    return name if _is_rolling(name) else method_of(name)


def _is_rolling(name: str) -> bool:
    return name.startswith("rs-")


class Results(BaseModel, frozen=True):
    """What there is of a plan, as results.json has it. methods: variants of all methods. records: by cells' order."""

    sequences: tuple[SequenceInfo, ...]
    methods: tuple[str, ...]
    records: tuple[CellRecord, ...]

    @cached_property
    def cells(self) -> dict[tuple[str, str], CellRecord]:
        """The records by case and method."""
        return {(record.case, record.method): record for record in self.records}

    def record(self, sequence: str, method: str) -> CellRecord | None:
        """The record of a cell, None if it was not run."""
        return self.cells.get((sequence, method))

    def figure(self, sequence: str, method: str, name: str) -> float | None:
        """Of a cell; None where it has none."""
        return figure(self.record(sequence, method), name)

    @property
    def groups(self) -> tuple[str, ...]:
        """Names of the groups, in order."""
        return tuple(dict.fromkeys(sequence.group for sequence in self.sequences))

    def names(self, group: str) -> list[str]:
        """The sequences of a group."""
        return [sequence.name for sequence in self.sequences if sequence.group == group]

    def shown(self, group: str) -> dict[str, str]:
        """What the tables of a group show: a variant for each of their lines (`row_of`).

        Of two settings, that which keeps the track on more sequences, and then that of the smaller mean ATE over those
        where both do: one setting for the whole group and all errors, not the luckier one of every cell.
        """
        rows: dict[str, list[str]] = {}
        for name in self.methods:
            rows.setdefault(row_of(name), []).append(name)
        return {row: self._best(self.names(group), names) for row, names in rows.items()}

    def _best(self, sequences: Sequence[str], names: Sequence[str]) -> str:
        ate = {name: [self.figure(sequence, name, "ate_mm") for sequence in sequences] for name in names}
        common = [k for k in range(len(sequences)) if all(ate[name][k] is not None for name in names)]

        def badness(name: str) -> tuple[int, float]:
            return sum(a is None for a in ate[name]), sum(ate[name][k] or 0.0 for k in common)

        return min(names, key=badness)

    def averaged(self, group: str) -> tuple[str, ...]:
        """The sequences that averages are over: those on which every one of our methods that are shown kept the track.

        Other trackers and settings are averaged over the same ones, or not at all, so that they cannot change ours.
        """
        shown = list(self.shown(group).values())
        ours = [name for name in shown if method_of(name) in METHODS] or shown
        rows = {name: [self.record(name, method) for method in ours] for name in self.names(group)}
        return tuple(name for name, row in rows.items() if all(r is not None and r.is_good for r in row))

    def average(self, group: str, method: str) -> CellRecord:
        """A record of means over `averaged`, of the errors that it has on all of these."""
        records = [self.record(name, method) for name in self.averaged(group)]
        names = [name for name in ERRORS if all(figure(record, name) is not None for record in records)]
        runs = tuple({name: figure(record, name) for name in names} for record in records)
        return CellRecord(f"track/{AVERAGE}/{method}", "", {"group": group}, runs=runs, complete=True)

    def of_group(self, group: str) -> dict[tuple[str, str], CellRecord]:
        """Cells of a group and then its averages, by case and method."""
        found = {at: record for at, record in self.cells.items() if at[0] in self.names(group)}
        return found | {(AVERAGE, method): self.average(group, method) for method in self.methods}

    def theirs(self, group: str, case: str, method: str) -> PaperFigures:
        """The paper's figures of the same; empty: none."""
        return paper_average(self.averaged(group) if case == AVERAGE else (case,), row_of(method))


def better_pct(value: float | None, baseline: float | None) -> float | None:
    """How much smaller the value is, per cent of the baseline's; negative if it is larger."""
    return None if value is None or not baseline else 100.0 * (1.0 - value / baseline)


def read_results(path: Path) -> Results:
    """Read and check results.json. Raises UserError naming the first wrong field."""
    return validated(Results.model_validate_json, read_text(path), path, cure=": run 'rstrack bench' again")
