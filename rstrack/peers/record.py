"""What run.json holds of a peer's run, by the names of `rstrack.tracking.runs.run.track`."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

import numpy as np

from rstrack.data.dataset import Dataset


def run_info(
    name: str, versions: Mapping[str, str], backend: str, dataset: Dataset, chosen: range, total_s: float,
    seconds: Sequence[float],
) -> dict[str, Any]:  # fmt: skip
    """Of frames `chosen` of a dataset, which took `seconds` each; keyframes, lost and frames are the peer's own."""
    ms = 1e3 * np.array(seconds)
    return {
        "method": name,
        "versions": {"rstrack": version("rolling-shutter-rgbd"), **versions},
        "backend": backend,
        "machine": {"cpu_count": os.cpu_count()},
        "dataset": {"name": dataset.name, "frames": [chosen.start, chosen.stop], "frames_in_all": len(dataset)},
        "end": "done",
        "error": None,
        "timings": {
            "total_s": total_s,
            "median_ms": float(np.median(ms)),
            "mean_ms": float(ms.mean()),
            "p95_ms": float(np.percentile(ms, 95)),
            "frame_ms": np.round(ms, 3),
        },
    }
