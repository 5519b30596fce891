"""What a measure is given: one run of a cell, and its sequence, which is rendered once into a cache or lies in --data.

def measure(task: Task, progress: Progress) -> Figures: ...

Measures are functions of a module, named 'package.module:function' where they are registered, so that a worker finds
them: `MEASURES` here, and those that benchmarks/ adds.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any

from rsgen.console.configs import config_file, scaled
from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError, validated
from rsgen.files import atomic_write, read_bytes, read_text, read_yaml
from rsgen.sequence.reader import read_sequence
from rstrack.bench.cells import Cell, Model, SequenceEntry
from rstrack.bench.changes import changed
from rstrack.bench.record import Figures
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.options import Options
from rstrack.tracking.runs.record import Noise

Render = Callable[[Sequence[str]], None]
Measure = Callable[["Task", Progress], Figures]
MEASURES: dict[str, str] = {
    "track": "rstrack.bench.measures.track:track_cell",
    "blur": "rstrack.bench.measures.blur:blur_cell",
    "speed": "rstrack.bench.measures.speed:speed_cell",
}


class Absent(UserError):
    """A recording or a package that is not at hand: the cell is skipped, which is no fault."""


@dataclass(frozen=True)
class Sources:
    """Where recordings lie (data) and rendered sequences are kept (cache); scheduler: of rsgen's, renders.

    render: runs `rsgen` with arguments, None: in a process of its own.
    """

    data: Path | None = None
    cache: Path | None = None
    scheduler: str | None = None
    render: Render | None = None

    @property
    def home(self) -> Path:
        """Where rendered sequences are kept: several gigabytes."""
        default = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rolling-shutter-rgbd"
        return (self.cache or default) / "sequences"

    def folder(self, entry: SequenceEntry, name: str, progress: Progress = no_progress) -> Path:
        """The folder of a sequence, rendered now if it is not there whole. Raises UserError, and Absent."""
        if entry.path is not None:
            return self._recording(entry.path)
        words = self.words(entry)
        recipe = self.recipe(entry)
        folder = self.home / f"{name}-{hashlib.sha256(recipe.encode()).hexdigest()[:8]}"
        note = folder.with_name(folder.name + ".json")
        if not (note.is_file() and read_text(note) == recipe and _can_be_read(folder)):
            progress("rendering", 0.0, name)
            run = self.render or run_rsgen
            run([*words, "--out", str(folder), *([] if self.scheduler is None else ["--scheduler", self.scheduler])])
            atomic_write(note, recipe.encode())
        return folder

    def found(self, entry: SequenceEntry, name: str) -> Path | None:
        """The folder of a sequence that is there whole, else None: nothing is rendered."""
        try:
            return dataclasses.replace(self, render=_not_now).folder(entry, name)
        except UserError:
            return None

    def words(self, entry: SequenceEntry) -> list[str]:
        """What `rsgen` is called with, but for --out. Raises UserError, and Absent."""
        assert entry.config is not None
        path = config_file(str(entry.config))
        overrides = dict(entry.set)
        if entry.width is not None:
            overrides = scaled(path, read_yaml(path), entry.width) | overrides
        overrides |= {field: str(self._recording(Path(file))) for field, file in entry.data.items()}
        few = [] if entry.frames is None else ["--frames", entry.frames]
        words = [word for name, value in overrides.items() for word in (f"--{name}", json.dumps(value))]
        return ["render", str(path), "--quiet", *few, *words]

    def recipe(self, entry: SequenceEntry) -> str:
        """What a sequence is made with: its entry, and the content of the files it names, wherever these lie.

        Raises UserError, and Absent.
        """
        path = config_file(str(entry.config))
        files = [path, *(self._recording(Path(file)) for file in entry.data.values())]
        config = read_yaml(path)
        given = config.get("trajectory") or {}
        if "trajectory.file" not in {**entry.set, **entry.data} and given.get("file"):
            files.append(path.parent / str(given["file"]))
        scene = path.parent / str((config.get("scene") or {}).get("file", ""))
        # A room of ours is made by scripts beside it, and is not there before.
        files += sorted(scene.parent.glob("*.py")) or [scene]
        hashes = {file.name: hashlib.sha256(read_bytes(file)).hexdigest() for file in files if file.is_file()}
        stated = entry.model_dump(mode="json", exclude_defaults=True, exclude={"group"}) | {"config": path.name}
        return json.dumps({"sequence": stated, "files": hashes}, indent=1, sort_keys=True) + "\n"

    def _recording(self, path: Path) -> Path:
        if self.data is None:
            raise Absent(f"{path}: is a recording: --data DIR names the folder that it lies in")
        if not (self.data / path).exists():
            raise Absent(f"{self.data / path}: is not there")
        return (self.data / path).resolve()


def run_rsgen(words: Sequence[str]) -> None:
    """Run `rsgen` with these arguments in a process of its own. Raises UserError if it fails."""
    # The tracker's process must not load the renderer.
    done = subprocess.run(
        [sys.executable, "-m", "rsgen", *words], capture_output=True, text=True, errors="replace", check=False
    )
    if done.returncode:
        lines = (done.stderr.strip() or done.stdout.strip() or f"exit status {done.returncode}").splitlines()
        raise UserError(f"rsgen {' '.join(words[:2])} failed: {lines[-1].removeprefix('rsgen: ')}")


def _not_now(_: object) -> None:
    raise UserError("the sequence is to be rendered")


def _can_be_read(folder: Path) -> bool:
    """Whether every image that its listings name is there: how many those are, its cameras say, which drop some."""
    try:
        read_sequence(folder)
    except UserError:
        return False
    return True


@dataclass(frozen=True)
class Task:
    """One run of a cell. sources: of its sequence. out: a folder for what is kept beside the record."""

    cell: Cell
    seed: int
    sources: Sources
    out: Path

    @cached_property
    def root(self) -> Path:
        """The sequence's folder, rendered now if it is not there. Raises UserError, and Absent."""
        return self.sources.folder(self.cell.sequence, self.cell.case_entry.sequence)

    @property
    def options(self) -> Options:
        """Of our method."""
        return self.cell.options

    @property
    def settings(self) -> Mapping[str, Any]:
        """Of the measure, as the definitions have them."""
        return self.cell.settings

    @property
    def noise(self) -> Noise:
        """What is added to the images of this run."""
        noise = self.cell.case_entry.noise
        return Noise(noise.depth, noise.intensity, self.seed)

    @cached_property
    def dataset(self) -> Dataset:
        """The sequence as the case changes it, all frames (`frames` are the case's), without the case's noise."""
        dataset = open_dataset(self.root, self.cell.case_entry.camera)
        for change in self.cell.case_entry.changes:
            for name, arguments in change.items():
                dataset = changed(dataset, name, self.seed, arguments)
        return dataset

    @property
    def noisy(self) -> Dataset:
        """The same with the noise in its images, for those that do not add it themselves."""
        n = self.noise
        return self.dataset.noisy(n.sigma_depth, n.sigma_intensity, n.seed)

    @property
    def frames(self) -> range:
        """Those of the dataset that are the case's."""
        return range(len(self.dataset))[self.cell.frames]


def measure_named(where: str) -> Measure:
    """The function 'package.module:function'."""
    module, _, function = where.partition(":")
    found: Measure = getattr(import_module(module), function)
    return found


def settings_of(task: Task, model: type[Model]) -> Model:
    """The task's settings as the measure has them. Raises UserError naming cell and setting."""
    return validated(model.model_validate, dict(task.settings), f"{task.cell.name}: settings")
