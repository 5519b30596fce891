"""The measure `speed`: how long a frame takes, and where the time goes; a peer of others on the same frames.

settings: {peer: open3d-icp}     # the two take turns, so that what slows the machine down slows both
"""

from __future__ import annotations

import re
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pydantic import Field

from rsgen.console.progress import Progress
from rsgen.errors import UserError
from rstrack.bench.cells import StrictModel
from rstrack.bench.record import Figures, frame_times
from rstrack.bench.task import Absent, Task, settings_of
from rstrack.data.dataset import registered_image
from rstrack.data.registration import Registrar
from rstrack.options import PEERS, Peer
from rstrack.peers.open3d import PeerTracker
from rstrack.tracking.any_tracker import AnyTracker, make_tracker

# Frames at the start that are not counted, at most half: the first of them compile kernels.
_WARM_UP = 20
# Frames of a turn. Threads of a tracker wait busily for a while after their work, and so disturb the other's first.
_TURN = 10


class SpeedSettings(StrictModel):
    """What else is timed."""

    peer: Peer | None = Field(default=None, description="Open3D's odometry, in turns with the cell's method")


@dataclass
class Stopwatch:
    """Adds up the seconds spent in watched parts, each without those within it. For one thread."""

    clock: Callable[[], float] = time.perf_counter
    seconds: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    _inner: list[float] = field(default_factory=lambda: [0.0])

    @contextmanager
    def timed(self, label: str) -> Iterator[None]:
        """Count the block's time under a label."""
        begin = self.clock()
        self._inner.append(0.0)
        try:
            yield
        finally:
            elapsed = self.clock() - begin
            self.seconds[label] += elapsed - self._inner.pop()
            self._inner[-1] += elapsed


def speed_cell(task: Task, progress: Progress) -> Figures:
    """Time one of our methods, or Open3D's odometry, over the case; the first 20 frames, at most half, do not count.

    All times are of one frame. read_ms: mean time to read and decode its images, which `rstrack track` does meanwhile
    in another thread; a peer's, with registering them, which drivers do for its users. part_*_ms: means, together
    mean_ms. peer_ms is the peer's median, ratio the method's median over it; so are ratio_mean and the others.

    Raises UserError: fewer than two frames, an image that cannot be read, a tracker that breaks down, a method that
    cannot be timed; Absent: Open3D is not installed.
    """
    settings = settings_of(task, SpeedSettings)
    frames = task.frames
    if len(frames) < 2:
        raise UserError(f"{task.dataset.root}: speed needs at least 2 frames")
    warm_up = min(_WARM_UP, len(frames) // 2)
    # The peer first: a missing one is reported at once.
    timed = [] if settings.peer is None else [_peer(task, settings.peer)]
    timed.insert(0, _method(task))
    for first in range(0, len(frames), _TURN):
        for each in timed:
            for n in range(first, min(first + _TURN, len(frames))):
                if n == warm_up:
                    each.watch.seconds.clear()
                each.time(frames[n])
        progress("timing", min(first + _TURN, len(frames)) / len(frames), f"{timed[0].ms[-1][1]:.0f} ms")
    found = timed[0].figures(warm_up)
    if len(timed) > 1:
        theirs = timed[1].figures(warm_up)
        found |= {"peer_ms": theirs["median_ms"]}
        found |= {f"peer_{name}": value for name, value in theirs.items() if name not in ("frames", "median_ms")}
        for name, ratio in (("median", "ratio"), *((name, f"ratio_{name}") for name in ("mean", "p95", "p99"))):
            ours, other = found[f"{name}_ms"], theirs[f"{name}_ms"]
            assert ours is not None and other is not None
            found[ratio] = ours / other
    return found


# ---------------------------------------------------------------------------------------------------------------------


@dataclass
class _Timed:
    """A tracker that is timed. read: a frame's images; feed: takes them. ms: reading and tracking, of all frames."""

    tracker: AnyTracker | PeerTracker
    read: Callable[[int], Any]
    feed: Callable[[int, Any], Any]
    watch: Stopwatch = field(default_factory=Stopwatch)
    ms: list[tuple[float, float]] = field(default_factory=list)

    def time(self, k: int) -> None:
        """Read and track frame k. Raises UserError."""
        begin = time.perf_counter()
        images = self.read(k)
        read = time.perf_counter()
        try:
            self.feed(k, images)
        except np.linalg.LinAlgError as error:
            raise UserError(f"the tracker broke down at frame {k} ({error}): there is nothing to time") from None
        self.ms.append((1e3 * (read - begin), 1e3 * (time.perf_counter() - read)))

    def figures(self, warm_up: int) -> Figures:
        """Of the frames after the first `warm_up`."""
        read, ms = np.array(self.ms[warm_up:]).T
        mean = float(ms.mean())
        parts = {_plain(name): 1e3 * seconds / len(ms) for name, seconds in self.watch.seconds.items()}
        if parts:
            parts["other"] = mean - sum(parts.values())
        return {
            "frames": len(ms), **frame_times(ms), "max_ms": float(ms.max()), "read_ms": float(read.mean()),
            **{f"part_{name}_ms": parts[name] for name in sorted(parts)},
            "keyframes": self.tracker.keyframes, "lost": sum(report.lost for report in self.tracker.reports[warm_up:]),
        }  # fmt: skip


def _method(task: Task) -> _Timed:
    cell, dataset = task.cell, task.noisy
    if not cell.is_ours:
        if cell.program not in PEERS or cell.method_entry.command or cell.method_entry.results is not None:
            raise UserError(f"{cell.method}: speed times our methods and {', '.join(PEERS)}")
        return _peer(task, cell.program)
    options, watch = task.options, Stopwatch()
    tracker = make_tracker(
        dataset.rig, options, watch.timed, interval_s=dataset.interval_s(task.frames),
        imu=dataset.imu if options.inertial else None,
    )  # fmt: skip
    return _Timed(
        tracker, lambda k: dataset.frame(k, color=options.photometric), lambda _, frame: tracker.feed(frame), watch
    )


def _peer(task: Task, name: str) -> _Timed:
    dataset = task.noisy
    registrar = Registrar(dataset.rig)
    try:
        tracker = PeerTracker(name, registrar.camera)
    except UserError as error:
        raise Absent(str(error)) from None
    return _Timed(
        tracker, lambda k: registered_image(dataset, registrar, k),
        lambda k, image: tracker.feed(float(dataset.stamps[k]), image),
    )  # fmt: skip


def _plain(label: str) -> str:
    """'linear algebra: solve' as a part of a figure's name."""
    return re.sub(r"[^a-z0-9]+", "_", label.lower()).strip("_")
