"""The measures `light` and `render`, of the renderer: in a process of its own, which alone loads Mitsuba.

light: the light of a sequence's scene baked anew, and how right it is against path tracing. render: seconds that a
colour frame takes, in the generator's modes and by other ways.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from rsgen.console.progress import Progress
from rsgen.errors import UserError
from rstrack.bench.cells import StrictModel
from rstrack.bench.record import Figures
from rstrack.bench.task import Task, settings_of

_ROOT = Path(__file__).parents[2]
ModeName = Literal["still", "rs-blur", "path", "rows", "averaged"]


def rendered(task: Task, what: str, settings: Mapping[str, Any], progress: Progress) -> Figures:
    """The figures of `what` (light, render) that the worker measures of the config of the task's sequence.

    Raises UserError: another method than `rsgen`, a recording, a config that is wrong, a worker that breaks down; and
    Absent.
    """
    cell = task.cell
    if not cell.renders:
        raise UserError(f"{cell.name}: {what} is measured of the renderer: its method is rsgen")
    if cell.sequence.config is None:
        raise UserError(f"{cell.name}: {what} is measured of a sequence with a config, not of a recording")
    _, config, _, *words = task.sources.words(cell.sequence)
    fields = {name.removeprefix("--"): value for name, value in zip(words[::2], words[1::2], strict=True)}
    fields.pop("frames", None)
    job = {"what": what, "config": config, "fields": fields, "settings": settings}
    path = os.pathsep.join([str(_ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    with (
        tempfile.TemporaryFile("w+") as log,
        subprocess.Popen(
            [sys.executable, "-m", "benchmarks.measures.render_worker", json.dumps(job)],
            stdout=subprocess.PIPE, stderr=log, text=True, env=os.environ | {"PYTHONPATH": path},
        ) as process,
    ):  # fmt: skip
        assert process.stdout is not None
        try:
            for line in process.stdout:
                answer = json.loads(line)
                if isinstance(answer, list):
                    progress(*answer)
                    continue
                if "error" in answer:
                    raise UserError(answer["error"])
                figures: Figures = answer["figures"]
                return figures
        finally:
            process.kill()
        log.seek(0)
        lines = log.read().strip().splitlines()
        raise UserError(f"the renderer's process ended: {lines[-1] if lines else 'no message'}")


class LightSettings(StrictModel):
    """As of `rsgen verify --light`."""

    views: int = Field(default=5, ge=1, description="views, evenly spread over the trajectory")
    spp: int = Field(default=4096, ge=1, description="samples per pixel of the path-traced reference")
    width: int = Field(default=160, ge=8, description="of the views, px")


def light_cell(task: Task, progress: Progress) -> Figures:
    """Bake the light of the sequence's config, whose method is `rsgen`; no cache is read or written.

    psnr_db: mean over views, noise taken out; psnr_least_db: of the worst; surely_least_db: what that is at least, two
    standard errors. bias_pct: by how much brighter baked pictures are. bake_s, bake_mb: time and most memory.
    estimate_db, estimate_least_db: what a bake estimates of itself. Keeps light.png. Raises UserError, and Absent.
    """
    settings = settings_of(task, LightSettings).model_dump()
    task.out.mkdir(parents=True, exist_ok=True)
    return rendered(task, "light", settings | {"seed": task.seed, "picture": str(task.out / "light.png")}, progress)


class RenderSettings(StrictModel):
    """What is timed."""

    modes: tuple[ModeName, ...] = Field(default=("still", "rs-blur", "path", "rows", "averaged"), min_length=1)
    frames: int = Field(default=5, ge=1, description="timed frames, each in all modes")
    spp: int = Field(default=64, ge=1, description="samples per pixel")


def render_cell(task: Task, progress: Progress) -> Figures:
    """Time the modes on the sequence's config, whose method is `rsgen`, with 28 ms of readout and 20 ms of blur.

    Figures: see `benchmarks.measures.render_worker.figures_of`; those of a mode that failed are missing. Raises
    UserError, and Absent.
    """
    settings = settings_of(task, RenderSettings)
    return rendered(task, "render", settings.model_dump(), progress)
