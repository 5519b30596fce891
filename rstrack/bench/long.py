"""Whether a frame costs the same however many there have been: a sequence fed over and over.

print(long_run(dataset, Options(method="rs-g"), frames=100_000).text())
"""

from __future__ import annotations

import resource
import sys
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rsgen.console.progress import Progress, no_progress
from rsgen.console.tables import Table, fixed
from rsgen.errors import UserError
from rstrack.data.dataset import Dataset
from rstrack.data.rig import Frame
from rstrack.options import Options
from rstrack.tracking.any_tracker import make_tracker

# Frames of a block, and the block (the second) that the last one is compared with: the first compiles kernels.
BLOCK = 1000
_COMPARED = 1


@dataclass(frozen=True)
class Block:
    """So many frames: median and mean milliseconds a frame, lost ones; keyframes and peak memory (bytes) by then."""

    median_ms: float
    mean_ms: float
    lost: int
    keyframes: int
    peak_bytes: int


@dataclass(frozen=True)
class LongRun:
    """Blocks of `BLOCK` frames in a row."""

    name: str
    method: str
    loop: int
    blocks: tuple[Block, ...]

    @property
    def ratio(self) -> float:
        """Median time of a frame in the last block over that in the second."""
        return self.blocks[-1].median_ms / self.blocks[_COMPARED].median_ms

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        head = {"dataset": self.name, "method": self.method, "loop_frames": self.loop, "block_frames": BLOCK}
        return head | {"ratio": self.ratio, "blocks": [vars(block) for block in self.blocks]}

    def text(self) -> str:
        """A table of ten blocks at most."""
        chosen = sorted({*np.linspace(0, len(self.blocks) - 1, 9).round().astype(int).tolist(), _COMPARED})
        rows = tuple(
            (f"{BLOCK * k} to {BLOCK * (k + 1) - 1}", fixed(b.median_ms, 2), fixed(b.mean_ms, 2), str(b.lost),
             str(b.keyframes), fixed(b.peak_bytes / 1e6, 0))
            for k in chosen for b in (self.blocks[k],)
        )  # fmt: skip
        head = "frames", "median, ms", "mean, ms", "lost", "keyframes so far", "peak memory, MB"
        last = f"the last {BLOCK} take {self.ratio:.2f} times what frames {BLOCK} to {2 * BLOCK - 1} took (median)"
        return "\n".join([
            f"{self.name}, {self.method}: {BLOCK * len(self.blocks)} frames, {self.loop} over and over",
            "", Table(head, rows).text(), "", last,
        ])  # fmt: skip


def long_run(
    dataset: Dataset, options: Options, frames: int, loop: int = 90, progress: Progress = no_progress
) -> LongRun:
    """Feed the first `loop` frames of a dataset over and over, until there have been `frames`.

    Where they begin anew the camera jumps back, and is found again at a keyframe. Raises UserError: fewer than two
    blocks, or an image that cannot be read.
    """
    if frames < 2 * BLOCK:
        raise UserError(f"--frames {frames}: give {2 * BLOCK} or more: the last {BLOCK} are compared with the second")
    images = list(dataset.frames(0, loop))
    period = float(np.median(np.diff(dataset.stamps)))
    again_s = images[-1].depth.stamp - images[0].depth.stamp + period
    tracker = make_tracker(dataset.rig, options, interval_s=period)
    blocks: list[Block] = []
    ms: list[float] = []
    for n in range(frames // BLOCK * BLOCK):
        frame = _later(images[n % len(images)], n // len(images) * again_s)
        begin = time.perf_counter()
        tracker.feed(frame)
        ms.append(1e3 * (time.perf_counter() - begin))
        if len(ms) == BLOCK:
            lost = sum(each.lost for each in tracker.reports[-BLOCK:])
            blocks.append(Block(float(np.median(ms)), float(np.mean(ms)), lost, tracker.keyframes, _peak_bytes()))
            progress("tracking", (n + 1) / frames, f"{blocks[-1].median_ms:.1f} ms a frame, {lost} lost")
            ms.clear()
    return LongRun(dataset.name, options.method, len(images), tuple(blocks))


def _later(frame: Frame, seconds: float) -> Frame:
    """The same images so much later."""
    depth = replace(frame.depth, stamp=frame.depth.stamp + seconds)
    return Frame(depth, tuple(replace(color, stamp=color.stamp + seconds) for color in frame.colors))


def _peak_bytes() -> int:
    """Of main memory, by this process so far."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return int(peak if sys.platform == "darwin" else 1024 * peak)
