"""What a table was made with, and what a file already has of it."""

from __future__ import annotations

import dataclasses
import json
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rsgen.errors import UserError
from rstrack.data.dataset import Dataset
from rstrack.data.estimate import plain
from rstrack.metrics.association import truth_of
from rstrack.options import Options


def settings_of(dataset: Dataset, options: Options, frames: slice, seed: int) -> tuple[dict[str, Any], range]:
    """Everything that results depend on, as plain data, and the frames that were chosen.

    Raises UserError: no truth, no such frames, a seed below 0.
    """
    if seed < 0:
        raise UserError(f"sensitivity: seed = {seed} must be 0 or more")
    if truth_of(dataset) is None:
        raise UserError(f"{dataset.root}: has no ground truth to compare with: add a groundtruth.txt")
    chosen = range(len(dataset))[frames]
    if not chosen:
        raise UserError(f"{dataset.root}: has no frame {frames.start}: its frames are 0 to {len(dataset) - 1}")
    settings: dict[str, Any] = plain(
        {
            "dataset": dataset.name,
            "path": dataset.root.resolve(),
            "frames": [chosen.start, chosen.stop],
            "options": dataclasses.asdict(options),
            "seed": seed,
            "version": version("rolling-shutter-rgbd"),
        }
    )
    return settings, chosen


def kept_results(path: Path | None, settings: dict[str, Any], name: str) -> list[dict[str, Any]]:
    """Results in a file's list `name`, none if they were made with other settings or there is no file.

    Raises UserError: it is not one of ours.
    """
    if path is None or not path.exists():
        return []
    try:
        data = json.loads(path.read_text())
        results: list[dict[str, Any]] = [dict(result) for result in data[name]]
        return results if data["settings"] == settings else []
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        raise UserError(f"{path}: is no table of 'rstrack sensitivity': remove it or choose another --out") from None
