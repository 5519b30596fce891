"""The suite, a folder of sequences that trajectories are scored on; and running our methods and peers on it.

suite = read_suite(Path("suite"), only=("small",))
outcome = run_methods(suite, ("rs-pg", "kiss-icp"), Path("out/runs"))
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from rsgen.console.progress import Progress, no_progress
from rsgen.console.scheduler import open_workers
from rsgen.errors import UserError, validated
from rsgen.files import read_yaml
from rstrack.bench.cells import OTHERS, Benchmark, CaseEntry, Cell, MethodEntry, SequenceEntry
from rstrack.bench.experiments.methods import chosen_methods
from rstrack.bench.runner import Outcome, run_cells
from rstrack.bench.task import Sources

SUITE = "suite.yaml"
# Any of them makes a folder a sequence.
_SEQUENCE_FILES = ("sequence.yaml", "associations.txt", "rgb.txt", "depth.txt")


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


_PEERS = "peers"


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
