"""What a measure is given: one run of a cell, its sequence at hand.

def measure(task: Task, progress: Progress) -> Figures: ...

Measures are functions of a module, named 'package.module:function' where they are registered, so that a worker finds
them: `MEASURES` here, and those that benchmarks/ adds.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from rsgen.console.progress import Progress
from rsgen.errors import UserError, first_problem
from rstrack.bench.cells import Cell
from rstrack.bench.changes import changed
from rstrack.bench.definitions import Model
from rstrack.bench.record import Figures
from rstrack.bench.sequences import Sources
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.data.image_files import NoisyImages
from rstrack.options import Options
from rstrack.tracking.runs.record import Noise

Measure = Callable[["Task", Progress], Figures]
MEASURES: dict[str, str] = {
    "track": "rstrack.bench.measures.track:track_cell",
    "blur": "rstrack.bench.measures.blur:blur_cell",
    "speed": "rstrack.bench.measures.speed:speed_cell",
}


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
        if not (n.sigma_depth or n.sigma_intensity):
            return self.dataset
        images = NoisyImages(self.dataset.images, n.sigma_depth, n.sigma_intensity, n.seed)
        return dataclasses.replace(self.dataset, images=images)

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
    try:
        return model.model_validate(dict(task.settings))
    except ValidationError as error:
        raise UserError(f"{task.cell.name}: settings: {first_problem(error)}") from None
