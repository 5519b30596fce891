"""How far a run is, and what run.json says of it: its settings, its times, and a line for every frame."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rstrack.data.dataset import Dataset
from rstrack.options import Options
from rstrack.tracking.frame_report import FrameReport


@dataclass(frozen=True)
class Noise:
    """Noise added to the frames; see `rstrack.data.image_files.with_noise`."""

    sigma_depth: float = 0.0
    sigma_intensity: float = 0.0
    seed: int = 0


@dataclass
class Done:
    """How far a run is: frames that have been looked at, seconds that it took, and what became of the frames."""

    count: int = 0
    total_s: float = 0.0
    seconds: list[float] = field(default_factory=list)
    fed: list[int] = field(default_factory=list)
    unreadable: list[tuple[int, str]] = field(default_factory=list)


def settings(dataset: Dataset, chosen: range, options: Options, noise: Noise) -> dict[str, Any]:
    """What a run was made with: method, options, noise, versions, machine, and which frames of what."""
    from rsgen.device.arrays import engine

    read = dataset.read_imu if options.inertial else None
    assumed = [*dataset.notes, *(() if read is None else read.notes)]
    notes: dict[str, Any] = {"notes": assumed} if assumed else {}
    if read is not None and dataset.imu_files is not None and dataset.imu_files.given is not None:
        notes["imu_file"] = str(dataset.imu_files.given.resolve())
    versions = {name: version(name) for name in ("numpy", "scipy", "drjit")}
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
            "color_falloff": dataset.rig.color_falloff, "camera": dataset.cameras, **notes,
        },
    }  # fmt: skip


def timings(total_s: float, seconds: Sequence[float]) -> dict[str, Any]:
    """Of the tracker alone, but for the total; the first frames compile kernels."""
    ms = 1e3 * np.array(seconds)
    return {
        "total_s": total_s,
        "median_ms": float(np.median(ms)),
        "mean_ms": float(ms.mean()),
        "p95_ms": float(np.percentile(ms, 95)),
        "frame_ms": np.round(ms, 3),
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
