"""How far a run is, what run.json holds of it, and the few lines that it ends with."""

from __future__ import annotations

import dataclasses
import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from rsgen.array_types import FloatArray
from rstrack.data.dataset import Dataset
from rstrack.data.estimate import Estimate
from rstrack.data.rig import Frame
from rstrack.data.timing import Timing
from rstrack.options import Options
from rstrack.tracking.any_tracker import AnyTracker
from rstrack.tracking.frame_report import FrameReport
from rstrack.tracking.runs.done import Done
from rstrack.tracking.runs.segments import Segments

if TYPE_CHECKING:
    from rstrack.tracking.loop_closing import Closing
    from rstrack.tracking.runs.checkpoint import Checkpoint

End = Literal["done", "interrupted", "broke down"]
# Reads a frame by its number; None where its depth cannot be read, and what is wrong with its images.
Load = Callable[[int], tuple[Frame | None, tuple[str, ...]]]

# Observability (see FrameReport) below which a motion is held by the prior rather than by depth.
_WEAK = 5e-4


@dataclass(frozen=True)
class Noise:
    """Noise added to the frames; see `rstrack.data.image_files.with_noise`."""

    sigma_depth: float = 0.0
    sigma_intensity: float = 0.0
    seed: int = 0


@dataclass
class Run:
    """A run before its first frame, or where it was stopped. dataset: with what a first look has found of its colours.

    load: reads frames, with noise added. segments: of a camera that is lost. checkpoint: None where none can be made.
    """

    dataset: Dataset
    chosen: range
    noise: Noise
    tracker: AnyTracker
    load: Load
    segments: Segments
    checkpoint: Checkpoint | None
    done: Done


def run_info(run: Run, closing: Closing | None, times: dict[str, float]) -> dict[str, Any]:
    """What run.json holds, but for how the run ended."""
    done, tracker, found = run.done, run.tracker, run.tracker.uncorrected
    reports = run.segments.reports(tracker.reports, run.segments.joined(Estimate(*found.trajectory)))
    spread = 1.0 if closing is None or closing.closed is None else closing.closed.spread
    info = settings(run.dataset, run.chosen, tracker.options, run.noise) | {
        "keyframes": tracker.keyframes,
        "checkpoint_error": (run.checkpoint.problem if run.checkpoint is not None else "") or None,
        "unreadable": [{"frame": k, "error": problem} for k, problem in done.unreadable],
        "lost": sum(report.lost for report in reports),
        "cut": sum(report.is_cut for report in reports),
        "segments": run.segments.info(),
        "loops": None if closing is None else closing.info(),
        "spline_valid": tracker.spline_valid,
        "timings": timings(done) | times | ({} if closing is None else {"loops_s": closing.seconds}),
        "frames": diagnostics(run.dataset, done.fed, reports, spread),
    }
    if run.dataset.timing is not None:
        info["clocks"] = run.dataset.timing.as_dict()
    if found.color_late[1] > 0.0:
        info["color_late"] = dict(zip(("seconds", "sigma_s"), found.color_late, strict=True))
    if found.inertia is not None:
        info["imu"] = found.inertia.as_dict()
    return info


def settings(dataset: Dataset, chosen: range, options: Options, noise: Noise) -> dict[str, Any]:
    """What a run was made with: method, options, noise, versions, machine, and which frames of what."""
    from rsgen.device.arrays import engine

    read = dataset.read_imu if options.inertial else None
    assumed = [*dataset.notes, *(() if read is None else read.notes)]
    notes: dict[str, Any] = {"notes": assumed} if assumed else {}
    if read is not None and dataset.imu_files is not None and dataset.imu_files.given is not None:
        notes["imu_file"] = str(dataset.imu_files.given.resolve())
    versions = {name: version(name) for name in ("numpy", "scipy", "numba", "drjit")}
    return {
        "method": options.method,
        "options": dataclasses.asdict(options),
        "noise": dataclasses.asdict(noise),
        "versions": {"rstrack": version("rolling-shutter-rgbd"), **versions},
        "backend": engine(options.backend).backend,
        "machine": {"cpu_count": os.cpu_count()},
        "dataset": {
            "name": dataset.name, "path": str(dataset.root.resolve()),
            "frames": [chosen.start, chosen.stop], "frames_in_all": len(dataset),
            "color_falloff": dataset.rig.color_falloff,
            "depth_pattern": dataset.depth_error.pattern, "camera": dataset.cameras, **notes,
        },
    }  # fmt: skip


def timings(done: Done) -> dict[str, Any]:
    """Of the tracker alone; the first frames compile kernels. wait_ms: that it waited for a frame's images, mean."""
    ms, waits_ms = 1e3 * np.array(done.seconds), 1e3 * np.array(done.waited)
    return {
        "median_ms": float(np.median(ms)),
        "mean_ms": float(ms.mean()),
        "p95_ms": float(np.percentile(ms, 95)),
        "frame_ms": np.round(ms, 3),
        "wait_ms": float(waits_ms.mean()),
        "p99_wait_ms": float(np.percentile(waits_ms, 99)),
    }


def diagnostics(
    dataset: Dataset, used: Sequence[int], reports: Sequence[FrameReport], spread: float = 1.0
) -> list[dict[str, Any]]:
    """One dict a frame for the plots: `FrameReport`, with inliers as parts of the run's largest number too.

    listed_stamp: as the recording has it, where it was tracked at another one. Of covariances the upper triangle,
    for errors `spread` times as large as the frames alone say.
    """
    frames = [dataclasses.asdict(report) for report in reports]
    for k, frame in zip(used, frames, strict=True):
        frame |= {name: _upper(frame[name], spread) for name in ("covariance", "drift_world")}
        frame["common"] = None if frame["common"] is None else np.float32(frame["common"])
        frame["stamp"] = float(dataset.stamps[k])
        if dataset.timing is not None:
            frame["listed_stamp"] = float(dataset.timing.depth.listed[k])
    for stream in ("depth", "color"):
        counts = [frame[f"inliers_{stream}"] for frame in frames]
        most = max(counts)
        for frame, count in zip(frames, counts, strict=True):
            # Not aligned to anything, as the first frame: no inliers to speak of.
            frame[f"inliers_{stream}"] = count / most if most and frame["evaluations"] else None
            frame[f"pixels_{stream}"] = count
    return frames


def _upper(covariance: FloatArray | None, spread: float) -> FloatArray | None:
    """The upper triangle (21,) of a covariance (6, 6), row by row."""
    return None if covariance is None else spread**2 * covariance[np.triu_indices(6)]


@dataclass(frozen=True)
class Result:
    """What a run came to.

    online: the track before loops were closed, None where none were. end: why it stopped; `error` says where the
    tracker broke down. lost: number of frames. unreadable: what was wrong with each image that was left out; where that
    was a depth image, its frame was. timing: of recordings, how stamps came about. loops, imu, segments: a line each.
    """

    estimate: Estimate
    online: Estimate | None
    end: End
    error: str
    lost: int
    unreadable: tuple[str, ...] = ()
    timing: Timing | None = None
    loops: str = ""
    imu: str = ""
    segments: str = ""

    def text(self) -> str:
        """A summary of a few lines."""
        info, times = self.estimate.info, self.estimate.info["timings"]
        done, asked = len(info["frames"]), info["dataset"]["frames"][1] - info["dataset"]["frames"][0]
        part = f"{done} frames" if done == asked else f"{done} of {asked} frames"
        lost = f"{self.lost} lost" if self.lost else "none lost"
        rate = done / times["total_s"]
        lines = [
            f"{info['method']} on {info['dataset']['name']}: {part}, {keyframes_text(info['keyframes'])}, {lost}",
            f"{times['total_s']:.1f} s, {rate:.1f} frames/s on {info['backend']}; a frame takes "
            f"{times['median_ms']:.1f} ms (median), {times['mean_ms']:.1f} (mean), {times['p95_ms']:.1f} (95 %)",
        ]
        lines += [why] if (why := _faults_text(info["frames"])) else []
        lines += [line for line in (self.segments, self.loops, self.imu) if line]
        weak = sum(not f["lost"] and 0.0 < f["observability"] < _WEAK for f in info["frames"])
        if weak and info["method"] in ("rs-g", "gs-g", "baseline"):
            lines.append(f"in {weak} of {done} frames the geometry hardly fixes all six degrees of freedom (a wall?)")
        if self.unreadable:
            images = "1 image" if len(self.unreadable) == 1 else f"{len(self.unreadable)} images"
            lines.append(f"left out: {images} that cannot be read, first {self.unreadable[0]}")
        if info.get("checkpoint_error"):
            lines.append(f"cannot be resumed: {info['checkpoint_error']}")
        lines += [f"assumed: {note}" for note in info["dataset"].get("notes", ())]
        lines += [] if self.timing is None else self.timing.lines()
        if late := info.get("color_late"):
            seconds, sigma_s = (1e3 * late[name] for name in ("seconds", "sigma_s"))
            lines.append(f"colour: found to be {seconds:+.1f} ± {sigma_s:.1f} ms later than that while tracking")
        return "\n".join(lines)


def _faults_text(frames: Sequence[dict[str, Any]]) -> str:
    """Why frames were lost, most frequent reason first."""
    faults = Counter(f["fault"] for f in frames if f["lost"])
    return "lost because: " + "; ".join(f"{why} ({count})" for why, count in faults.most_common()) if faults else ""


def keyframes_text(count: int) -> str:
    """So many keyframes, in words."""
    return f"{count} keyframe" + ("" if count == 1 else "s")
