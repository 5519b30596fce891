"""What is measured of the renderer for a task: in a process of its own, which alone loads Mitsuba."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from rsgen.console.progress import Progress
from rsgen.errors import UserError, first_problem
from rstrack.bench.record import Figures
from rstrack.bench.task import Task

Settings = TypeVar("Settings", bound=BaseModel)
_ROOT = Path(__file__).parents[2]


def settings_of(task: Task, model: type[Settings]) -> Settings:
    """The cell's settings. Raises UserError naming the wrong one."""
    try:
        return model.model_validate(task.settings)
    except ValidationError as error:
        raise UserError(f"{task.cell.name}: settings: {first_problem(error)}") from None


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
            [sys.executable, "-m", "benchmarks.rendering.worker", json.dumps(job)],
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
        said = log.read().strip().splitlines()
        raise UserError(f"the renderer's process ended: {said[-1] if said else 'no message'}")
