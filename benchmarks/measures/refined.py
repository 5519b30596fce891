"""The measure `refined`: what `rstrack refine` makes of a run."""

from __future__ import annotations

from rsgen.console.progress import Progress
from rstrack.bench.measures.track import accuracy, estimated
from rstrack.bench.record import Figures
from rstrack.bench.task import Task
from rstrack.tracking.runs.refining import refine_run


def refined_cell(task: Task, progress: Progress) -> Figures:
    """The figures of `track` after refining; errors over those before; given_back: 1 where the run is kept as it was.

    The run is opened again from its folder, as users do: of a case's changes those of cameras and noise are in it.
    Raises UserError: what `track` or `refine` does not do.
    """
    before = accuracy(task, estimated(task, progress)[0])
    found = refine_run(task.out, task.out / "refined", progress=progress)
    after = accuracy(task, found.estimate)
    ratios: Figures = {
        f"{name}_ratio": new / old
        for name in ("ate_mm", "drift_mm_s", "drift_deg_s")
        if (old := before.get(name)) and (new := after.get(name)) is not None
    }
    return after | ratios | {"given_back": bool(found.kept), "refine_s": found.seconds}
