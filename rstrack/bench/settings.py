"""The settings of a measure, checked.

class LongSettings(Settings):
    frames: int = Field(default=10_000, ge=2)

frames = settings_of(task, LongSettings).frames
"""

from __future__ import annotations

from typing import TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from rsgen.errors import UserError, first_problem
from rstrack.bench.task import Task


class Settings(BaseModel):
    """What a measure may be told, with defaults; it refuses everything else."""

    model_config = ConfigDict(extra="forbid", frozen=True)


S = TypeVar("S", bound=Settings)


def settings_of(task: Task, model: type[S]) -> S:
    """The task's settings as the measure has them. Raises UserError naming cell and setting."""
    try:
        return model.model_validate(dict(task.settings))
    except ValidationError as error:
        raise UserError(f"{task.cell.name}: settings: {first_problem(error)}") from None
