"""The pictures of `rstrack bench`: bars of the ATE, of each sequence the paths and the errors over time, and maps.

A map is what a method's trajectory makes of a room, seen from above; those of several methods are side by side.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError
from rsgen.files import atomic_write, write_error
from rstrack.bench.experiments.methods import MAPPED, Results, SequenceInfo, method_of
from rstrack.bench.figures import PAPER_FIGURES
from rstrack.bench.record import CellRecord, figure, read_record
from rstrack.bench.runner import RECORD
from rstrack.bench.task import run_rsgen
from rstrack.charts.chart import Bars, Chart, method_colors, numbers
from rstrack.charts.runs import compared_errors, path_chart
from rstrack.charts.to_file import write_charts
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.data.estimate import read_info
from rstrack.mapping.map import run_map
from rstrack.metrics.run_evaluate import Tracked, load_run
from rstrack.options import MapOptions

MESH = "mesh.ply"
# Beside a mesh: what it was made from.
_MADE_FROM = "mesh.json"
# Enough to cover what a whole sequence saw; more frames cost time and change little.
_FRAMES = 80
_PANEL_PX = (720, 540)


def draw_plots(results: Results, out: Path, progress: Progress, warn: Callable[[str], None]) -> list[Path]:
    """Write plots/ate.png and plots/SEQUENCE.png into `out`; returns what was written.

    Runs that cannot be read are left out, a line each to `warn`. Raises UserError.
    """
    count = 1 + len(results.sequences)
    written = [out / "plots" / "ate.png"]
    write_charts([ate_chart(results)], written[0])
    for k, sequence in enumerate(results.sequences, 1):
        progress("plots", k / count, sequence.name)
        path = out / "plots" / f"{sequence.name}.png"
        if draw_sequence(results, sequence, out, path, warn):
            written.append(path)
    progress("plots", 1.0, f"{len(written)} pictures")
    return written


def ate_chart(results: Results) -> Chart:
    """The ATE of every cell as a bar on a logarithmic scale, the paper's as a mark on it."""
    names, bars = [s.name for s in results.sequences], []
    shown = [results.shown(s.group) for s in results.sequences]
    rows = list(dict.fromkeys(row for variants in shown for row in variants))
    colors = method_colors(rows)
    for row in rows:
        ours = [results.figure(name, variants[row], "ate_mm") for name, variants in zip(names, shown, strict=True)]
        theirs = numbers([PAPER_FIGURES.get((name, row), {}).get("ate_mm") for name in names])
        bars.append(Bars(row, colors[row], numbers(ours), theirs))
    note = "Logarithmic. Marks on the bars: the paper's figures for that method, in its own rooms."
    if any(row != name for variants in shown for row, name in variants.items()):
        note += " Without a model of the shutter: with or without fused keyframes, whichever is better in the group."
    return Chart("ATE (RMSE) by sequence and method", "mm", bars=tuple(bars), groups=tuple(names), is_log=True,
                 note=note)  # fmt: skip


def draw_sequence(
    results: Results, sequence: SequenceInfo, out: Path, path: Path, warn: Callable[[str], None]
) -> bool:  # fmt: skip
    """Paths from above and errors over time of what the tables show of one sequence; False if there is none to draw."""
    runs = shown_runs(results, sequence, out, open_dataset(sequence.path), warn)
    runs = {method: run for method, run in runs.items() if run.found is not None}
    if runs:
        write_charts([path_chart(runs), compared_errors(runs)], path, sequence.name)
    return bool(runs)


def shown_runs(
    results: Results, sequence: SequenceInfo, out: Path, dataset: Dataset, warn: Callable[[str], None]
) -> dict[str, Tracked]:  # fmt: skip
    """The runs of a sequence that the tables show, by name, in the order of the tables."""
    runs = {}
    for method in results.shown(sequence.group).values():
        record = results.record(sequence.name, method)
        if record is not None and record.error is None:
            try:
                offset_s = record.truth_offset_s
                runs[method] = load_run(out / record.folder, dataset=dataset, truth_offset=offset_s)
            except UserError as error:
                warn(f"No plots of {method} on {sequence.name}: {error}.")
    return runs


@dataclass(frozen=True)
class MeshPicture:
    """A sequence's picture. panel_px: width and height of each mesh's part.

    methods, labels: of the parts from left to right; the labels stand above them.
    """

    path: Path
    panel_px: tuple[int, int]
    methods: tuple[str, ...]
    labels: tuple[str, ...]


def draw_meshes(
    results: Results, out: Path, methods: Sequence[str] = MAPPED, *, progress: Progress = no_progress,
    warn: Callable[[str], None],
) -> list[Path]:  # fmt: skip
    """Write mesh.ply into the cells' folders, plots/meshes_SEQUENCE.jpg into `out`; returns the pictures.

    out: the folder with the results' cells. methods: those of them that kept the track are shown, in this order, each
    with the setting that the tables show. Meshes of the same cells, and pictures of the same meshes, are kept. What
    fails is left out, with one line to `warn`. Raises KeyboardInterrupt; the same call goes on after that.
    """
    rows = [(sequence, _records(results, sequence, methods)) for sequence in results.sequences]
    rows = [(sequence, records) for sequence, records in rows if records]
    steps, done, pictures = sum(len(records) + 1 for _, records in rows), 0, []
    for sequence, records in rows:
        made: list[dict[str, Any]] = []
        for record in records:
            about = f"{record.case} {record.method}"
            try:
                mesh = make_mesh(sequence, record, out, _part_of(progress, done, steps, about))
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
    sequence: SequenceInfo, record: CellRecord, out: Path, progress: Callable[[float, str], None] = lambda *_: None
) -> dict[str, Any]:
    """Write a cell's mesh.ply, in the truth's world, unless it is there; returns what it was made from.

    progress: called with the fraction done and a note. Raises UserError: a frame or the run cannot be read, or the mesh
    not be written.
    """
    folder = out / record.folder
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


def _part_of(progress: Progress, done: int, steps: int, name: str) -> Callable[[float, str], None]:
    """Shows one step's fraction and note as those of all steps."""
    return lambda fraction, note: progress("meshes", (done + fraction) / steps, f"{name}, {note}")


def _records(results: Results, sequence: SequenceInfo, methods: Sequence[str]) -> list[CellRecord]:
    shown = results.shown(sequence.group)
    found = [results.record(sequence.name, shown[method]) for method in methods if method in shown]
    return [record for record in found if record is not None and record.is_good]


def _label(record: CellRecord) -> str:
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
    words = ["preview", "--quiet", f"--out={path.resolve()}", f"--width={_PANEL_PX[0]}", f"--height={_PANEL_PX[1]}"]
    words += [f"--label={part['label']}" for part in parts]
    run_rsgen([*words, *(str((out / "cells" / part["cell"] / MESH).resolve()) for part in parts)])
    atomic_write(about, _json(pictured))
    return path


def _read(path: Path) -> dict[str, Any]:
    """A JSON object, empty if there is none."""
    try:
        return read_info(path)
    except UserError:
        return {}


def _json(record: dict[str, Any]) -> bytes:
    return (json.dumps(record, indent=1) + "\n").encode()


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise write_error(path, error) from None
