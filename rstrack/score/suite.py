"""What is scored: the sequences of a suite, and what trackers left of them in folders, ours and the peers by request.

suite = read_suite(Path("suite"), only=("small",))
outcome = run_methods(suite, ("rs-pg", "kiss-icp"), Path("out/runs"))
methods = find_methods([Path("results"), Path("runs/demo"), Path("out/runs")], ("demo", "table1"))

Results are METHOD/SEQUENCE.txt, run folders, and the folder of a benchmark.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress, no_progress
from rsgen.console.scheduler import open_workers
from rsgen.errors import UserError, validated
from rsgen.files import read_text, read_yaml
from rsgen.geometry import se3
from rstrack.bench.cells import OTHERS, Benchmark, CaseEntry, Cell, MethodEntry, SequenceEntry, StrictModel
from rstrack.bench.experiments.methods import chosen_methods
from rstrack.bench.runner import Outcome, run_cells
from rstrack.bench.task import Sources
from rstrack.data.estimate import INFO, TRAJECTORY, Estimate, read_info

SUITE = "suite.yaml"
# Any of them makes a folder a sequence.
_SEQUENCE_FILES = ("sequence.yaml", "associations.txt", "rgb.txt", "depth.txt")
_PEERS = "peers"
METHOD = "method.yaml"
# Rows of a SQUARE file whose poses have a Gaussian: stamp, pose, and the lower triangle of the 6x6 covariance.
_COLUMNS = 1 + 7 + 21
_CONVENTIONS = {"TANGENT_CONVENTION": "right_perturbation", "TANGENT_ORDER": "translation_rotation"}


class SuiteEntry(BaseModel):
    """A sequence: its folder's name, and what it is counted among. group: of sequences that differ in one thing."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    name: str = Field(pattern=r"^[A-Za-z0-9_-][A-Za-z0-9_.-]*$")
    tier: str = "all"
    role: str = ""
    group: str = ""


class _SuiteFile(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)

    name: str = ""
    version: str | float = ""
    entries: tuple[SuiteEntry, ...] = Field(min_length=1)


@dataclass(frozen=True)
class Suite:
    """root: the folder that holds a folder of each entry's name."""

    root: Path
    name: str
    version: str
    entries: tuple[SuiteEntry, ...]

    @property
    def tiers(self) -> tuple[str, ...]:
        """Their names, in the order of the entries."""
        return tuple(dict.fromkeys(entry.tier for entry in self.entries))

    def tier(self, name: str) -> tuple[SuiteEntry, ...]:
        """The entries of a tier."""
        return tuple(entry for entry in self.entries if entry.tier == name)


def read_suite(root: Path, only: tuple[str, ...] = ()) -> Suite:
    """The entries of suite.yaml in a folder, without one all folders in it that look like sequences.

    only: patterns (* and ?), of which the name, tier, role or group of an entry has to match one. Raises UserError, one
    line: no such folder, nothing in it, an entry is wrong or there twice, nothing matches.
    """
    root = Path(root)
    if not root.is_dir():
        raise UserError(f"{root}: no such folder: give one that holds folders of sequences")
    if (file := root / SUITE).is_file():
        found = validated(_SuiteFile.model_validate, read_yaml(file), file)
    else:
        folders = sorted(p.name for p in root.iterdir() if any((p / name).is_file() for name in _SEQUENCE_FILES))
        if not folders:
            raise UserError(f"{root}: holds neither {SUITE} nor folders of sequences: give the folder above them")
        found = _SuiteFile(entries=tuple(SuiteEntry(name=name) for name in folders))
    names = [entry.name for entry in found.entries]
    if len(set(names)) < len(names):
        raise UserError(f"{file}: '{next(name for name in names if names.count(name) > 1)}' is there twice")
    entries = tuple(e for e in found.entries if not only or _matches(e, only))
    if not entries:
        raise UserError(f"--only {' '.join(only)}: no sequence of {root} has such a name, tier, role or group")
    return Suite(root, found.name or root.resolve().name, str(found.version), entries)


def _matches(entry: SuiteEntry, patterns: tuple[str, ...]) -> bool:
    words = (entry.name, entry.tier, entry.role, entry.group)
    return any(fnmatchcase(word, pattern) for word in words for pattern in patterns)


def run_methods(
    suite: Suite, methods: Sequence[str], out: Path, scheduler: str | None = None, progress: Progress = no_progress
) -> Outcome:
    """Track every sequence that is there; what `out` holds already is kept. Records say what failed.

    methods: names of ours and of peers; 'peers': all of these. A cell that fails, or whose package is absent, leaves no
    run. Raises UserError: a name that there is not, a folder that cannot be written.
    """
    named = [name for name in methods if name != _PEERS]
    chosen = chosen_methods(named, OTHERS if _PEERS in methods else ())
    cells = tuple(
        Cell("track", entry.name, method, (0,), CaseEntry(sequence=entry.name), path, MethodEntry(), {})
        for entry in suite.entries
        if (suite.root / entry.name).is_dir()
        for path in [SequenceEntry(path=Path(entry.name), group=entry.tier)]
        for method in chosen
    )
    sources = Sources(data=suite.root.resolve(), scheduler=scheduler)
    with open_workers(scheduler) as workers:
        return run_cells(Benchmark(cells), out, sources, workers, progress)


class About(StrictModel):
    """A method.yaml: what a method is, and what its files hold."""

    name: str = Field(default="", description="shown in place of the folder's name")
    url: Annotated[str, Field(pattern=r"^(https?://\S+)?$")] = ""
    note: str = Field(default="", description="version, settings, machine: what a reader has to know")
    camera: Literal["depth", "color"] = Field(default="depth", description="whose poses the trajectories hold")
    alignment: Literal["se3", "sim3"] = Field(default="se3", description="sim3: scale is fitted, as for one camera")
    ms_per_frame: float | None = Field(default=None, gt=0.0, description="time, where no SEQUENCE.times says more")


@dataclass(frozen=True)
class Result:
    """A method's files of one sequence. path: a TUM file or a run folder; covariances, times: None without."""

    path: Path
    covariances: Path | None = None
    times: Path | None = None


@dataclass(frozen=True)
class MethodResults:
    """key: the folder's name. results: by sequence. unknown: files for no sequence of the suite."""

    key: str
    about: About = field(default_factory=About)
    results: dict[str, Result] = field(default_factory=dict)
    unknown: tuple[Path, ...] = ()

    @property
    def name(self) -> str:
        """As it is shown."""
        return self.about.name or self.key


def find_methods(folders: Sequence[Path], sequences: Sequence[str]) -> tuple[MethodResults, ...]:
    """All methods in some folders, by their keys; sequences: names in the suite.

    A folder is that of a method (SEQUENCE.txt, or run folders SEQUENCE/), one of several methods' folders, a run folder
    of `rstrack track`, or that of `rstrack bench`. A run's method and sequence are those of its run.json where no
    folder's name says. Raises UserError, one line: nothing is there, a method.yaml is wrong, two results of one method
    for one sequence.
    """
    found: dict[str, MethodResults] = {}
    for folder in folders:
        if not folder.is_dir():
            raise UserError(f"{folder}: no such folder: give one with METHOD/SEQUENCE.txt, or a run of 'rstrack track'")
        before = sum(len(method.results) for method in found.values())
        for key, sequence, result in _results(folder, sequences):
            method = found.get(key) or MethodResults(key, _about(result.path.parent))
            if sequence not in sequences:
                found[key] = replace(method, unknown=(*method.unknown, result.path))
                continue
            if sequence in method.results:
                other = method.results[sequence].path
                raise UserError(f"{result.path}: is a second result of {key} for {sequence}, beside {other}: give one")
            found[key] = replace(method, results=method.results | {sequence: result})
        if sum(len(method.results) for method in found.values()) == before:
            raise UserError(
                f"{folder}: holds no results of {', '.join(sequences[:3])}{', ...' if sequences[3:] else ''}: "
                "put trajectories at METHOD/SEQUENCE.txt (TUM) in it"
            )
    return tuple(found.values())


def read_times(path: Path) -> FloatArray:
    """Milliseconds (n,) a frame: the last number of each line. Raises UserError naming the line."""
    values = []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        if words := line.partition("#")[0].replace(",", " ").split():
            try:
                values.append(float(words[-1]))
            except ValueError:
                values.append(np.nan)
            if not 0.0 <= values[-1] < np.inf:
                raise UserError(f"{path}: line {number}: expected the ms that a frame took, got '{words[-1]}'")
    if not values:
        raise UserError(f"{path}: holds no times: one number a line, the ms that each frame took")
    return np.array(values)


def read_covariances(path: Path) -> tuple[Estimate, FloatArray]:
    """Poses and their covariances (n, 6, 6) against the first, [m; rad], T_world_cam exp(ξ), as smfeval reads them.

    TUM lines followed by the lower triangle, row by row, as `rstrack export RUN covariance` writes. Raises UserError:
    another number of columns, a header that states another convention, no covariance.
    """
    lines = read_text(path).splitlines()
    for line in lines:
        word, _, value = line.removeprefix("#%").partition(" ")
        if line.startswith("#%") and value.strip() != _CONVENTIONS.get(word, value.strip()):
            raise UserError(f"{path}: {word} {value.strip()}: only {_CONVENTIONS[word]} is read")
    rows = [line.split() for line in lines if line.strip() and not line.startswith("#")]
    try:
        table = np.array(rows, np.float64)
    except ValueError:
        table = np.empty((0, 0))
    if table.ndim != 2 or table.shape[1] != _COLUMNS:
        raise UserError(f"{path}: expected {_COLUMNS} numbers a line: stamp, pose, lower triangle of the covariance")
    lower = np.zeros((len(table), 6, 6))
    lower[:, *np.tril_indices(6)] = table[:, 8:]
    covariance = lower + np.swapaxes(np.tril(lower, -1), 1, 2)
    if not np.isfinite(covariance).all() or (np.linalg.eigvalsh(covariance[1:])[:, 0] <= 0.0).any():
        raise UserError(f"{path}: a covariance after the first line's is not positive definite")
    try:
        return Estimate(table[:, 0], se3.from_quat_trans(table[:, 4:8], table[:, 1:4])), covariance
    except UserError as error:
        raise UserError(f"{path}: {error}") from None


# ---------------------------------------------------------------------------------------------------------------------


def _results(folder: Path, sequences: Sequence[str]) -> Iterator[tuple[str, str, Result]]:
    """Method, sequence and files of all that a folder holds; no sequence: of a method's folder that holds nothing."""
    if (cells := folder / "cells/track").is_dir():
        for run in sorted(path.parent for path in cells.glob(f"*/*/{TRAJECTORY}")):
            yield run.name, run.parent.name, Result(run)
    elif (folder / TRAJECTORY).is_file():
        yield _run(folder, sequences)
    elif (
        (folder / METHOD).is_file()
        or any(file.stem in sequences for file in folder.glob("*.txt"))
        or any(folder.glob(f"*/{TRAJECTORY}"))
    ):
        yield from _method(folder, sequences)
    else:
        for inner in sorted(path for path in folder.glob("[!.]*") if path.is_dir()):
            yield from list(_method(inner, sequences)) or [(inner.name, "", Result(inner))]


def _method(folder: Path, sequences: Sequence[str]) -> Iterator[tuple[str, str, Result]]:
    for file in sorted(folder.glob("*.txt")):
        beside = (path if path.is_file() else None for path in (file.with_suffix(".cov"), file.with_suffix(".times")))
        yield folder.resolve().name, file.stem, Result(file, *beside)
    for run in sorted(path.parent for path in folder.glob(f"*/{TRAJECTORY}")):
        yield _run(run, sequences)


def _run(run: Path, sequences: Sequence[str]) -> tuple[str, str, Result]:
    """A run folder: named by run.json, unless its own folder is a sequence's in that of a described method."""
    run = run.resolve()
    info = read_info(run / INFO) if (run / INFO).is_file() else {}
    dataset = info.get("dataset")
    recorded: dict[str, Any] = dataset if isinstance(dataset, dict) else {}
    names = (run.name, Path(str(recorded.get("path", ""))).name, str(recorded.get("name", run.name)))
    sequence = next((name for name in names if name in sequences), names[-1])
    is_described = (run.parent / METHOD).is_file() or "method" not in info
    return run.parent.name if is_described else str(info["method"]), sequence, Result(run)


def _about(folder: Path) -> About:
    file = folder / METHOD
    return validated(About.model_validate, read_yaml(file), file) if file.is_file() else About()
