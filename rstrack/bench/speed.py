"""How long a frame takes, and where the time goes; the same frames through other people's trackers.

print(time_methods(dataset, [Options(method="rs-g")], frames=150, peers=["open3d-hybrid"]).text())
"""

from __future__ import annotations

import os
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rsgen.console.progress import Progress, no_progress
from rsgen.console.tables import Table, fixed
from rsgen.errors import UserError
from rsgen.geometry.camera import Camera
from rstrack.data.dataset import Dataset
from rstrack.data.registered import Registrar, registered_image
from rstrack.data.rig import Frame
from rstrack.options import PEERS, Options
from rstrack.peers.open3d import PeerTracker
from rstrack.tracking.any_tracker import AnyTracker, make_tracker

# Frames at the start that are not counted: the first of them compile kernels.
_WARM_UP = 20


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


@dataclass(frozen=True)
class MethodTimes:
    """Of one method: the tracker's milliseconds for each counted frame, and the mean of each part of them.

    read_ms: mean time to read and decode a frame's images, which `rstrack track` does meanwhile in another thread; a
    peer's, with registering them, which drivers do for its users.
    """

    method: str
    frame_ms: tuple[float, ...]
    read_ms: float
    parts_ms: dict[str, float]
    keyframes: int
    lost: int

    @property
    def median_ms(self) -> float:
        """Over the frames."""
        return float(np.median(self.frame_ms))

    @property
    def mean_ms(self) -> float:
        """Over the frames."""
        return float(np.mean(self.frame_ms))


@dataclass(frozen=True)
class SpeedResult:
    """Times of some methods, peers last, on the same frames."""

    name: str
    camera: Camera
    counted: tuple[int, int]
    backend: str
    cpu_count: int
    methods: tuple[MethodTimes, ...]

    @property
    def ratios(self) -> dict[str, dict[str, float]]:
        """For each peer the median times of all methods over its own."""
        return {
            peer.method: {m.method: m.median_ms / peer.median_ms for m in self.methods}
            for peer in self.methods
            if peer.method in PEERS
        }

    def as_dict(self) -> dict[str, Any]:
        """For JSON; milliseconds a frame."""
        methods = {
            m.method: {
                "median_ms": m.median_ms, "mean_ms": m.mean_ms, "p95_ms": float(np.percentile(m.frame_ms, 95)),
                "read_ms": m.read_ms, "parts_ms": m.parts_ms, "keyframes": m.keyframes, "lost": m.lost,
            }
            for m in self.methods
        }  # fmt: skip
        size = [self.camera.width, self.camera.height]
        machine = {"backend": self.backend, "cpu_count": self.cpu_count}
        head = {"dataset": self.name, "depth_size": size, "frames": list(self.counted), **machine}
        return head | {"methods": methods, "ratios": self.ratios}

    def text(self) -> str:
        """A table, one column a method."""
        first, last = self.counted
        width, height = self.camera.width, self.camera.height
        rows: list[tuple[str, list[float]]] = [
            ("median", [m.median_ms for m in self.methods]),
            ("mean", [m.mean_ms for m in self.methods]),
        ]
        rows += [(f"times {peer}", list(ratios.values())) for peer, ratios in self.ratios.items()]
        names = sorted({part for m in self.methods for part in m.parts_ms}, key=lambda name: (name == "other", name))
        rows += [(f"  {name}", [m.parts_ms.get(name, 0.0) for m in self.methods]) for name in names]
        rows.append(("reading, decoding", [m.read_ms for m in self.methods]))
        texts = tuple((label, *(fixed(value, 2) for value in values)) for label, values in rows)
        lines = [
            f"{self.name}: depth {width}x{height}, frames {first} to {last - 1}, {self.backend}, {self.cpu_count} CPUs",
            Table(("ms a frame", *(m.method for m in self.methods)), texts).text(),
        ]
        lines += [f"note: {m.method} lost the track on {m.lost} of the frames" for m in self.methods if m.lost]
        return "\n".join([*lines, "Reading overlaps with tracking in 'rstrack track'; here it does not."])


def time_methods(
    dataset: Dataset,
    options: Sequence[Options],
    frames: int,
    progress: Progress = no_progress,
    peers: Sequence[str] = (),
) -> SpeedResult:
    """Track the first `frames` frames with each of the options and peers; the first 20, at most half, do not count.

    Raises UserError: fewer than two frames, an image that cannot be read, a tracker that breaks down, a peer that is
    unknown or not installed.
    """
    frames = min(frames, len(dataset))
    if frames < 2:
        raise UserError(f"{dataset.root}: speed needs at least 2 frames")
    warm_up = min(_WARM_UP, frames // 2)
    from rsgen.device.arrays import engine

    backend = engine(options[0].backend).backend
    registrar = Registrar(dataset.rig)
    # All of them before anything is timed: what is missing is said at once.
    others = {name: PeerTracker(name, registrar.camera) for name in peers}
    methods = [_time(dataset, o, frames, warm_up, progress) for o in options]
    methods += [_time_peer(dataset, name, t, registrar, frames, warm_up, progress) for name, t in others.items()]
    cpu_count = os.cpu_count() or 1
    return SpeedResult(dataset.name, dataset.rig.depth_camera, (warm_up, frames), backend, cpu_count, tuple(methods))


def _time(dataset: Dataset, options: Options, frames: int, warm_up: int, progress: Progress) -> MethodTimes:
    watch, reading = Stopwatch(), Stopwatch()
    interval_s = dataset.interval_s(range(frames))
    tracker = make_tracker(
        dataset.rig, options, watch.timed, interval_s=interval_s, imu=dataset.imu if options.inertial else None
    )
    frame_ms: list[float] = []
    for k in range(frames):
        if k == warm_up:
            watch.seconds.clear()
            reading.seconds.clear()
        with reading.timed("read"):
            frame = dataset.frame(k, color=options.photometric)
        begin = time.perf_counter()
        _feed(tracker, frame, k, options)
        frame_ms.append(1e3 * (time.perf_counter() - begin))
        progress(options.method, (k + 1) / frames, f"{frame_ms[-1]:.0f} ms")
    counted = frame_ms[warm_up:]
    parts = {name: 1e3 * seconds / len(counted) for name, seconds in watch.seconds.items()}
    parts["other"] = float(np.mean(counted)) - sum(parts.values())
    lost = sum(report.lost for report in tracker.reports[warm_up:])
    read_ms = 1e3 * reading.seconds["read"] / len(counted)
    return MethodTimes(options.method, tuple(counted), read_ms, parts, tracker.keyframes, lost)


def _time_peer(
    dataset: Dataset,
    name: str,
    tracker: PeerTracker,
    registrar: Registrar,
    frames: int,
    warm_up: int,
    progress: Progress,
) -> MethodTimes:
    ms = np.empty((frames, 2))  # reading, tracking
    for k in range(frames):
        begin = time.perf_counter()
        image = registered_image(dataset, registrar, k)
        read = time.perf_counter()
        tracker.feed(float(dataset.stamps[k]), image)
        ms[k] = 1e3 * (read - begin), 1e3 * (time.perf_counter() - read)
        progress(name, (k + 1) / frames, f"{ms[k, 1]:.0f} ms")
    read_ms, mean_ms = ms[warm_up:].mean(axis=0).tolist()
    lost = sum(report.lost for report in tracker.reports[warm_up:])
    return MethodTimes(
        name, tuple(ms[warm_up:, 1].tolist()), read_ms, {"Open3D's odometry": mean_ms}, tracker.keyframes, lost
    )


def _feed(tracker: AnyTracker, frame: Frame, k: int, options: Options) -> None:
    try:
        tracker.feed(frame)
    except np.linalg.LinAlgError as error:
        raise UserError(f"{options.method} broke down at frame {k} ({error}): there is nothing to time") from None
