"""The sequences of the readout sweep: each motion at every readout and exposure, rendered by `rsgen render` once."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from rsgen.console.progress import Progress
from rsgen.errors import UserError
from rsgen.files import atomic_write, read_bytes, read_text, read_yaml
from rsgen.sequence.reader import read_sequence
from rstrack.bench.readout.config import MotionEntry, SweepConfig
from rstrack.bench.stress.cases import Render

STREAMS = ("color", "depth")
# Colour samples that two slow cores render in a second, 320x240 and sharp: for the first guess only.
_SAMPLES_PER_S = 2.5e6


@dataclass(frozen=True)
class Case:
    """A motion seen by one shutter; width: px, 0 for that of its config."""

    motion: str
    readout_s: float
    exposure_s: float
    width: int = 0

    @property
    def name(self) -> str:
        """Its folder."""
        size = f"_{self.width}px" if self.width else ""
        return f"{self.motion}{size}_readout_{1e3 * self.readout_s:g}ms_exposure_{1e3 * self.exposure_s:g}ms"


def cases_of(config: SweepConfig) -> tuple[Case, ...]:
    """All of a sweep's, motion by motion."""
    axes = product(config.motions, config.exposures_s, config.readouts_s)
    return tuple(Case(entry.name, readout, exposure, config.width or 0) for entry, exposure, readout in axes)


def render_words(config: SweepConfig, case: Case, folder: Path) -> list[str]:
    """What `rsgen` is called with for a case. Raises UserError: its config cannot be read, or says no size."""
    entry = next(entry for entry in config.motions if entry.name == case.motion)
    overrides = case_overrides(entry.config, read_yaml(entry.config), case) | config.overrides | entry.overrides
    few = [] if config.frames is None else ["--frames", f"0:{config.frames}"]
    words = [word for name, value in overrides.items() for word in (f"--{name}", json.dumps(value))]
    return ["render", str(entry.config), "--quiet", "--out", str(folder), *few, *words]


def case_overrides(path: Path, text: Mapping[str, Any], case: Case) -> dict[str, Any]:
    """Fields of the config `text` (of the file `path`) that make it the case's.

    Colour's and depth's offsets count for the mid-exposure of their first line: at each exposure lines are taken at
    the same times, and images differ in their blur alone.
    """
    overrides: dict[str, Any] = {}
    for stream in STREAMS:
        section = text.get(stream) or {}
        try:
            if case.width:
                overrides |= {f"{stream}.{name}": value for name, value in _scaled(section, case.width).items()}
            offset = float(section.get("offset_s", 0.0))
        except (KeyError, TypeError, ValueError, AttributeError):
            needed = "width, height, intrinsics [fx, fy, cx, cy] and offset_s must be numbers to be scaled by the sweep"
            raise UserError(f"{path}: {stream}: {needed}") from None
        overrides |= {
            f"{stream}.readout_s": case.readout_s,
            f"{stream}.exposure_s": case.exposure_s,
            f"{stream}.offset_s": round(offset + 0.5 * case.exposure_s, 9),
        }
    return overrides


def _scaled(section: Mapping[str, Any], width: int) -> dict[str, Any]:
    """The same view in fewer or more pixels; their centres are at whole numbers."""
    columns, rows = int(section["width"]), int(section["height"])
    height = max(1, round(rows * width / columns))
    x, y = width / columns, height / rows
    fx, fy, cx, cy = (float(value) for value in section["intrinsics"])
    centre = (cx + 0.5) * x - 0.5, (cy + 0.5) * y - 0.5
    return {"width": width, "height": height, "intrinsics": [round(v, 9) for v in (fx * x, fy * y, *centre)]}


def render_cases(
    config: SweepConfig, out: Path, render: Render, progress: Progress, say: Callable[[str], None],
    scheduler: str | None = None,
) -> dict[Case, Path]:  # fmt: skip
    """Folder of each case's sequence, rendered where it is not there yet. Raises UserError.

    A folder is taken for the case's if it was rendered by the same words from the same files, and is whole. say: told
    what there is to render, and about how long it will take. scheduler: of rsgen's.
    """
    folders = {case: out / "sequences" / case.name for case in cases_of(config)}
    todo = {}
    for case, folder in folders.items():
        words = render_words(config, case, folder)
        recipe = _recipe(config, case, words)
        if not (_kept(folder) == recipe and _is_whole(folder, config.frames)):
            todo[case] = words, recipe
    if todo:
        say(_estimate(config, list(todo)))
    begin = time.perf_counter()
    for n, (case, (words, recipe)) in enumerate(todo.items()):
        left = f", {(len(todo) - n) * (time.perf_counter() - begin) / n / 60:.0f} min left" if n else ""
        progress("rendering", n / len(todo), f"{case.name}{left}")
        render([*words, *([] if scheduler is None else ["--scheduler", scheduler])])
        atomic_write(_recipe_file(folders[case]), recipe.encode())
    return folders


def _recipe_file(folder: Path) -> Path:
    return folder.parent / f"{folder.name}.json"


def _kept(folder: Path) -> str | None:
    return read_text(_recipe_file(folder)) if _recipe_file(folder).is_file() else None


def _recipe(config: SweepConfig, case: Case, words: Sequence[str]) -> str:
    """What a sequence was made with: words and content of the files they name, as JSON."""
    entry = next(entry for entry in config.motions if entry.name == case.motion)
    return json.dumps({"words": list(words), "files": _file_hashes(entry)}, indent=1) + "\n"


def _file_hashes(entry: MotionEntry) -> dict[str, str]:
    """Of the config and its trajectory. What is in the scene's, `rsgen render` looks after when it runs."""
    trajectory = (read_yaml(entry.config).get("trajectory") or {}).get("file")
    trajectory = entry.overrides.get("trajectory.file", trajectory and entry.config.parent / str(trajectory))
    files = [entry.config, *([Path(trajectory)] if trajectory else [])]
    return {path.name: hashlib.sha256(read_bytes(path)).hexdigest() for path in files if path.is_file()}


def _is_whole(folder: Path, frames: int | None) -> bool:
    try:
        sequence = read_sequence(folder)
    except UserError:
        return False
    return all(len(s.paths) >= min(frames or s.frames, s.frames) for s in sequence.streams.values())


def _estimate(config: SweepConfig, todo: Sequence[Case]) -> str:
    """A line about what there is to render."""
    samples, spp = 0, int(config.overrides.get("color.spp", 16))
    for case in todo:
        entry = next(entry for entry in config.motions if entry.name == case.motion)
        color = case_overrides(entry.config, read_yaml(entry.config), case)
        size = color.get("color.width", 640) * color.get("color.height", 480)
        samples += (config.frames or 300) * size * spp
    minutes = samples / _SAMPLES_PER_S / 60.0
    frames = f"{config.frames} frames" if config.frames else "all frames"
    return (
        f"{len(todo)} sequences of {frames} are to be rendered first: about {max(1.0, minutes):.0f} min on two slow "
        "cores, and some minutes more for each scene whose light is not baked yet; later runs find them"
    )
