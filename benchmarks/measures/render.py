"""The measure `render`: seconds that a colour frame takes, in the generator's modes and by other ways."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from benchmarks.rendering.run import rendered, settings_of
from rsgen.console.progress import Progress
from rstrack.bench.record import Figures
from rstrack.bench.sequences import Absent
from rstrack.bench.task import Task

Mode = Literal["still", "rs-blur", "path", "rows", "averaged", "blender-still", "blender"]


class RenderSettings(BaseModel):
    """What is timed; modes of Blender need the package bpy and take long."""

    model_config = ConfigDict(extra="forbid")
    modes: tuple[Mode, ...] = Field(default=("still", "rs-blur", "path", "rows", "averaged"), min_length=1)
    frames: int = Field(default=5, ge=1, description="timed frames, each in all modes")
    spp: int = Field(default=64, ge=1, description="samples per pixel")


def render_cell(task: Task, progress: Progress) -> Figures:
    """Time the modes on the sequence's config, whose method is `rsgen`, with 28 ms of readout and 20 ms of blur.

    Figures: see `benchmarks.rendering.modes.figures_of`; those of a mode that failed are missing. Raises UserError, and
    Absent.
    """
    settings = settings_of(task, RenderSettings)
    if {"blender", "blender-still"} & set(settings.modes) and find_spec("bpy") is None:
        raise Absent("Blender's Python module bpy is not installed: pip install 'bpy==4.2.*' (Python 3.11)")
    return rendered(task, "render", settings.model_dump(), progress)
