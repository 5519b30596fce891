"""Maps of `rstrack bench`: what each method's trajectory makes of a room, side by side from above.

draw_meshes(results, Path("out/bench"))
"""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError
from rsgen.files import atomic_write, read_text, write_error
from rstrack.bench.methods.config import SequenceInfo
from rstrack.bench.methods.results import Results
from rstrack.bench.methods.variants import method_of
from rstrack.bench.record import Record, read_record
from rstrack.bench.runner import RECORD
from rstrack.bench.tables.cells import figure, folder_of, is_good
from rstrack.mapping.map import run_map
from rstrack.options import MapOptions

SHOWN = ("rs-pg", "gs-pg", "baseline")
"""The methods whose maps are compared: ours, the same without its model of the shutter, and the usual way."""

MESH = "mesh.ply"
# Beside a mesh: what it was made from.
_MADE_FROM = "mesh.json"

# Enough to cover what a whole sequence saw; more frames cost time and change little.
_FRAMES = 80
_PANEL_PX = (720, 540)


@dataclass(frozen=True)
class MeshPicture:
    """A sequence's picture. panel_px: width and height of each mesh's part.

    methods, labels: of the parts from left to right; the labels stand above them.
    """

    path: Path
    panel_px: tuple[int, int]
    methods: tuple[str, ...]
    labels: tuple[str, ...]


def _say(text: str) -> None:
    print(f"rstrack: {text}", file=sys.stderr)


def draw_meshes(
    results: Results, out: Path, methods: Sequence[str] = SHOWN, progress: Progress = no_progress,
    warn: Callable[[str], None] = _say,
) -> list[Path]:  # fmt: skip
    """Write mesh.ply into the cells' folders, plots/meshes_SEQUENCE.jpg into `out`; returns the pictures.

    out: the folder with the results' cells. methods: those of them that kept the track are shown, in this order, each
    with the setting that the tables show. Meshes of the same cells, and pictures of the same meshes, are kept. What
    fails is left out and said to `warn` in one line. Raises KeyboardInterrupt; the same call goes on after that.
    """
    rows = [(sequence, _records(results, sequence, methods)) for sequence in results.sequences]
    rows = [(sequence, records) for sequence, records in rows if records]
    steps, done, pictures = sum(len(records) + 1 for _, records in rows), 0, []
    for sequence, records in rows:
        made: list[dict[str, Any]] = []
        for record in records:
            report = partial(_report, progress, done, steps, f"{record.case} {record.method}")
            try:
                mesh = make_mesh(sequence, record, out, report)
                made.append({"cell": record.cell, "method": record.method, "label": _label(record), "mesh": mesh})
            except UserError as error:
                warn(f"no mesh of {record.method} on {record.case}: {error}")
            done += 1
        progress("meshes", done / steps, f"{sequence.name}, drawing")
        try:
            if made:
                pictures.append(_draw(sequence.name, made, out))
        except UserError as error:
            warn(f"no picture of the meshes of {sequence.name}: {error}")
        done += 1
        progress("meshes", done / steps, f"{sequence.name} done")
    return pictures


def make_mesh(
    sequence: SequenceInfo, record: Record, out: Path, progress: Callable[[float, str], None] = lambda *_: None
) -> dict[str, Any]:
    """Write a cell's mesh.ply, in the truth's world, unless it is there; returns what it was made from.

    progress: called with the fraction done and a note. Raises UserError: a frame or the run cannot be read, or the mesh
    not be written.
    """
    folder = out / folder_of(record)
    every = max(1, round(sequence.frames / _FRAMES))
    # Where there is no spline a map takes the shutter for a global one anyway.
    options = MapOptions(shutter="gs" if method_of(record.method).startswith("gs-") else None, every=every)
    made: dict[str, Any] = {"key": record.key, "options": dataclasses.asdict(options)}
    if (folder / MESH).is_file() and _read(folder / _MADE_FROM) == made:
        return made
    _remove(folder / _MADE_FROM)  # first: a mesh of another cell must not be taken for this one's after an interrupt
    run_map(
        sequence.path, folder, folder / MESH, options,
        progress=lambda stage, fraction, note: progress(0.9 * fraction if stage == "integrating" else 0.9, stage),
    )  # fmt: skip
    atomic_write(folder / _MADE_FROM, _json(made))
    return made


def read_picture(out: Path, sequence: str) -> MeshPicture | None:
    """What there is of a sequence; None if there is no picture, or only one of cells that have been run again since."""
    path = _picture_path(out, sequence)
    pictured = _read(path.with_suffix(".json"))
    try:
        width, height = pictured["panel_px"]
        parts = pictured["meshes"]
        records = [read_record(out / "cells" / p["cell"] / RECORD) for p in parts]
        pairs = zip(records, parts, strict=True)
        current = all(record is not None and record.key == part["mesh"]["key"] for record, part in pairs)
        methods, labels = tuple(str(p["method"]) for p in parts), tuple(str(p["label"]) for p in parts)
        found = MeshPicture(path, (int(width), int(height)), methods, labels)
    except (KeyError, TypeError, ValueError):
        return None
    return found if methods and current and path.is_file() else None


# ---------------------------------------------------------------------------------------------------------------------


def _report(progress: Progress, done: int, steps: int, name: str, fraction: float, note: str) -> None:
    progress("meshes", (done + fraction) / steps, f"{name}, {note}")


def _records(results: Results, sequence: SequenceInfo, methods: Sequence[str]) -> list[Record]:
    shown = results.shown(sequence.group)
    found = [results.record(sequence.name, shown[method]) for method in methods if method in shown]
    return [record for record in found if record is not None and is_good(record)]


def _label(record: Record) -> str:
    ate_mm = figure(record, "ate_mm")
    return record.method if ate_mm is None else f"{record.method}, ATE {ate_mm:.3g} mm"


def _picture_path(out: Path, sequence: str) -> Path:
    return out / "plots" / f"meshes_{sequence}.jpg"


def _draw(sequence: str, parts: list[dict[str, Any]], out: Path) -> Path:
    """The picture of a sequence's meshes, drawn unless it is there. Raises UserError."""
    path = _picture_path(out, sequence)
    about = path.with_suffix(".json")
    pictured: dict[str, Any] = {"panel_px": list(_PANEL_PX), "meshes": parts}
    if path.is_file() and _read(about) == pictured:
        return path
    _remove(about)
    # Mitsuba draws, which the tracker's process never loads.
    command = [sys.executable, "-m", "rsgen", "picture", "--quiet", f"--out={path.resolve()}"]
    command += [f"--width={_PANEL_PX[0]}", f"--height={_PANEL_PX[1]}"]
    command += [f"--label={part['label']}" for part in parts]
    command += [str((out / "cells" / part["cell"] / MESH).resolve()) for part in parts]
    done = subprocess.run(command, capture_output=True, text=True, errors="replace")
    if done.returncode != 0:
        said = done.stderr.strip().splitlines() or [f"exit status {done.returncode}"]
        raise UserError(f"rsgen picture: {said[-1].removeprefix('rsgen: ')}")
    atomic_write(about, _json(pictured))
    return path


def _read(path: Path) -> dict[str, Any]:
    """A JSON object, empty if there is none."""
    try:
        data = json.loads(read_text(path))
    except (UserError, ValueError, RecursionError):
        return {}
    return data if isinstance(data, dict) else {}


def _json(record: dict[str, Any]) -> bytes:
    return (json.dumps(record, indent=1) + "\n").encode()


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise write_error(path, error) from None
