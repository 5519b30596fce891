"""The measure `light`: the light of a sequence's scene baked anew, and how right it is against path tracing."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from benchmarks.rendering.run import rendered, settings_of
from rsgen.console.progress import Progress
from rstrack.bench.record import Figures
from rstrack.bench.task import Task


class LightSettings(BaseModel):
    """As of `rsgen check-light`."""

    model_config = ConfigDict(extra="forbid")
    views: int = Field(default=5, ge=1, description="views, evenly spread over the trajectory")
    spp: int = Field(default=4096, ge=1, description="samples per pixel of the path-traced reference")
    width: int = Field(default=160, ge=8, description="of the views, px")


def light_cell(task: Task, progress: Progress) -> Figures:
    """Bake the light of the sequence's config, whose method is `rsgen`; no cache is read or written.

    psnr_db: mean over views, noise taken out; psnr_least_db: of the worst; surely_least_db: what that is at least, two
    standard errors. bias_pct: by how much brighter baked pictures are. bake_s, bake_mb: time and most memory.
    estimate_db, estimate_least_db: what a bake says of itself. Keeps light.png. Raises UserError, and Absent.
    """
    settings = settings_of(task, LightSettings).model_dump()
    task.out.mkdir(parents=True, exist_ok=True)
    return rendered(task, "light", settings | {"seed": task.seed, "picture": str(task.out / "light.png")}, progress)
