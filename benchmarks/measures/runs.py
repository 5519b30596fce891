"""Measures of whole runs.

`long`: whether a frame costs the same however many there have been, a case fed over and over. `refined`: what `rstrack
refine` makes of a run.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field

from rsgen.console.progress import Progress
from rsgen.errors import UserError
from rstrack.bench.cells import StrictModel
from rstrack.bench.measures.track import accuracy, estimated
from rstrack.bench.record import Figures, peak_mb
from rstrack.bench.task import Task, settings_of
from rstrack.data.rig import Frame
from rstrack.tracking.any_tracker import make_tracker
from rstrack.tracking.runs.refining import refine_run

BLOCK = 1000
"""Frames of a block. The last block is compared with the second: the first compiles kernels."""


class LongSettings(StrictModel):
    """frames: how many. loop: the case's first so many, over and over."""

    frames: int = Field(default=10_000, ge=1)
    loop: int = Field(default=90, ge=2)


@dataclass(frozen=True)
class FrameBlock:
    """So many frames: median and mean milliseconds a frame, lost ones; keyframes and peak memory (MB) by then."""

    median_ms: float
    mean_ms: float
    lost: int
    keyframes: int
    peak_mb: float


def long_cell(task: Task, progress: Progress) -> Figures:
    """Feed the first `loop` frames of the case over and over, until there have been `frames`.

    Where they begin anew the camera jumps back, and is found again at a keyframe. Raises UserError: fewer than two
    blocks, or an image that cannot be read.
    """
    settings, dataset = settings_of(task, LongSettings), task.noisy
    if settings.frames < 2 * BLOCK:
        raise UserError(f"frames: {settings.frames}: give {2 * BLOCK} or more: the last {BLOCK} are compared")
    chosen = task.frames[: settings.loop]
    images = list(dataset.frames(chosen.start, chosen.stop))
    period = float(np.median(np.diff(dataset.stamps)))
    again_s = images[-1].depth.stamp - images[0].depth.stamp + period
    tracker = make_tracker(dataset.rig, task.options, interval_s=period)
    blocks: list[FrameBlock] = []
    ms: list[float] = []
    for n in range(settings.frames // BLOCK * BLOCK):
        frame = _later(images[n % len(images)], n // len(images) * again_s)
        begin = time.perf_counter()
        tracker.feed(frame)
        ms.append(1e3 * (time.perf_counter() - begin))
        if len(ms) == BLOCK:
            lost = sum(each.lost for each in tracker.reports[-BLOCK:])
            blocks.append(FrameBlock(float(np.median(ms)), float(np.mean(ms)), lost, tracker.keyframes, peak_mb()))
            progress("tracking", (n + 1) / settings.frames, f"{blocks[-1].median_ms:.1f} ms a frame, {lost} lost")
            ms.clear()
    return figures_of(blocks)


def figures_of(blocks: Sequence[FrameBlock]) -> Figures:
    """Of the first block, the second and the last; ratio: median of the last over that of the second."""
    first, second, last = blocks[0], blocks[1], blocks[-1]
    return {
        "ratio": last.median_ms / second.median_ms,
        "frames": BLOCK * len(blocks),
        **{
            f"{name}_{which}_ms": getattr(block, f"{name}_ms")
            for which, block in (("first", first), ("second", second), ("last", last))
            for name in ("median", "mean")
        },
        "median_worst_ms": max(block.median_ms for block in blocks[1:]),
        "lost": sum(block.lost for block in blocks),
        "lost_last": last.lost,
        "keyframes": last.keyframes,
        "peak_second_mb": second.peak_mb,
        "peak_mb": last.peak_mb,
        "growth_mb": last.peak_mb - second.peak_mb,
    }


def _later(frame: Frame, seconds: float) -> Frame:
    """The same images so much later."""
    depth = replace(frame.depth, stamp=frame.depth.stamp + seconds)
    return Frame(depth, tuple(replace(color, stamp=color.stamp + seconds) for color in frame.colors))


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
