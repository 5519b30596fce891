"""What the blur stress test found, read from its records, and its tables.

result = read_stress(Path("runs/stress"))
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from rsgen.console.tables import Entry, Table, best_marked, fixed
from rsgen.errors import UserError, first_problem
from rsgen.files import read_text
from rstrack.bench.measures.blur import weights_key
from rstrack.bench.record import Record
from rstrack.bench.tables.files import failures, provenance

STRESS = "stress.json"
PATHS = {"true": "true path", "estimated": "estimated path"}
"""What frames are registered along, by its name in figures."""
# Exposure whose keyframe is shown.
_SHOWN_S = 0.020
# What a score is, its digits after the point, and the value that none is better than.
_SCORES = (
    ("psnr_db", "PSNR, dB: mean over the keyframes; small print: gain over constant weights", 2, math.inf),
    ("psnr_db_least", "PSNR of the worst keyframe, dB", 2, math.inf),
    ("ssim", "Structural similarity (SSIM)", 4, 1.0),
    ("gradient", "Gradient energy over that of the sharp view", 3, 1.0),
)
_STORED = TypeAdapter(tuple[Record, ...])


@dataclass(frozen=True)
class Tested:
    """A cell. case: its sequence. variant: which photometric term. sigmas_px: of the weights (None: constant ones)."""

    case: str
    speed: float
    exposure_s: float
    variant: str
    sigmas_px: tuple[float | None, ...]
    figures: dict[str, float]
    record: Record

    @property
    def label(self) -> str:
        """What its sequence is called on a page."""
        return f"{1e3 * self.exposure_s:g} ms" + ("" if self.speed == 1.0 else f", {self.speed:g}× speed")

    def score(self, name: str, poses: str, sigma_px: float | None) -> float | None:
        """Of the colour fused along a path with some weights: 'psnr_db', 'psnr_db_least', 'ssim', 'gradient'."""
        return self.figures.get(f"{name}_{poses}_{weights_key(sigma_px)}")

    def gain_db(self, poses: str, sigma_px: float | None) -> float | None:
        """PSNR over that of constant weights, in dB; None if it is of constant weights itself."""
        value, base = (self.score("psnr_db", poses, sigma) for sigma in (sigma_px, None))
        return None if sigma_px is None or value is None or base is None else value - base


@dataclass(frozen=True)
class StressResult:
    """Everything that was measured, by speed and exposure, the motion's own speed first."""

    motion: str
    cells: tuple[Tested, ...]

    @property
    def failed(self) -> list[str]:
        """A line for each error."""
        return failures(cell.record for cell in self.cells)

    @property
    def pictured(self) -> Tested | None:
        """The cell whose keyframe is shown, of which `panels` has the pictures."""
        found = [cell for cell in self.fused("true") if cell.speed == 1.0]
        return min(found, key=lambda cell: abs(cell.exposure_s - _SHOWN_S), default=None)

    @property
    def panels(self) -> Path | None:
        """Folder of the pictures of one keyframe, relative to the test's."""
        return None if self.pictured is None else Path("cells", self.pictured.record.cell, "panels")

    def fused(self, poses: str) -> list[Tested]:
        """The cells that have keyframes fused along a path."""
        return [cell for cell in self.cells if cell.figures.get(f"keyframes_{poses}")]

    @property
    def sigmas_px(self) -> list[float | None]:
        """All weights, the constant ones first."""
        found = {sigma for cell in self.cells for sigma in cell.sigmas_px}
        return sorted(found, key=lambda sigma: -1.0 if sigma is None else sigma)


def stress_result(records: Iterable[Record]) -> StressResult:
    """The records as a result. Raises KeyError, TypeError or ValueError: they are not of a stress test."""
    motion, cells = "", []
    for r in records:
        about: dict[str, Any] = r.settings["settings"]
        sigmas = (None, *map(float, about["sigmas_px"])) if r.measure == "blur" else ()
        motion, at = str(about["motion"]), (str(about["sequence"]), float(about["speed"]), float(about["exposure_s"]))
        cells.append(Tested(*at, str(about["variant"]), sigmas, r.figures, r))
    cells.sort(key=lambda cell: (cell.speed != 1.0, cell.speed, cell.exposure_s, cell.record.cell))
    return StressResult(motion, tuple(cells))


def read_stress(out: Path) -> StressResult:
    """What `write_stress` has written into `out`. Raises UserError naming the first wrong field."""
    path = Path(out) / STRESS
    try:
        result = stress_result(_STORED.validate_json(read_text(path)))
    except ValidationError as error:
        raise UserError(f"{path}: {first_problem(error)}: run 'rstrack bench stress' again") from None
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"{path}: is no stress test's ({error!r}): run 'rstrack bench stress' again") from None
    if not result.cells:
        raise UserError(f"{path}: holds no records: run 'rstrack bench stress' again")
    return result


def stress_tables(result: StressResult) -> list[Table]:
    """All of them."""
    color = [table for poses in PATHS for table in color_tables(result, poses)]
    return [*color, *depth_tables(result), tracking_table(result)]


def stress_notes(result: StressResult) -> list[str]:
    """What has to be said about them, one line each."""
    about = f"blur stress test of {result.motion}: colour against the sharp view, means over keyframes"
    return [about, *result.failed, provenance(cell.record for cell in result.cells)]


def color_tables(result: StressResult, poses: str) -> list[Table]:
    """The fused colour's scores: a row for each sequence, a column for each σ; none without keyframes."""
    tables, sigmas, cells = [], result.sigmas_px, result.fused(poses)
    for name, title, digits, ideal in _SCORES if cells else ():
        rows: list[tuple[Entry | str, ...]] = []
        for cell in cells:
            values = [cell.score(name, poses, sigma) for sigma in sigmas]
            gains = [cell.gain_db(poses, sigma) if name == "psnr_db" else None for sigma in sigmas]
            notes = ["" if gain is None else fixed(gain, 2, sign="+") for gain in gains]
            count = f"{cell.figures[f'keyframes_{poses}']:.0f} keyframe"
            heading = Entry(cell.label, note=count + "s" * (count != "1 keyframe") if name == "psnr_db" else "")
            rows.append((heading, *_row(values, notes, digits, ideal)))
        tables.append(Table(("sequence", *map(weights_name, sigmas)), tuple(rows), f"{title}; {PATHS[poses]}"))
    return tables


def depth_tables(result: StressResult) -> list[Table]:
    """Depth errors of one frame and of the fused ones, a table for each path that has some."""
    tables = []
    for poses, name in PATHS.items():
        rows = []
        for cell in result.cells:
            single, fused = (cell.figures.get(f"{what}_mm_{poses}") for what in ("single", "fused"))
            if fused is not None:
                ratio = fused / single if single else None
                rows.append((cell.label, fixed(single, 2), fixed(fused, 2), fixed(ratio, 2)))
        if rows:
            head = ("sequence", "one frame, mm", "fused, mm", "ratio")
            tables.append(Table(head, tuple(rows), f"Depth against the noise-free depth, RMSE, {name}"))
    return tables


def tracking_table(result: StressResult) -> Table:
    """The tracker's errors: a row for each sequence, a column for each photometric term."""
    found = {(cell.label, cell.variant): cell.figures for cell in result.cells}
    variants = list(dict.fromkeys(cell.variant for cell in result.cells))
    rows: list[tuple[Entry | str, ...]] = []
    for label in dict.fromkeys(cell.label for cell in result.cells):
        runs = [found.get((label, variant), {}) for variant in variants]
        notes = []
        for run in runs:
            drift = [f"{fixed(run['drift_mm_s'], 2)} mm/s"] if "drift_mm_s" in run else []
            notes.append(", ".join(drift + ([f"{run['lost']:.0f} lost"] if run.get("lost") else [])))
        rows.append((label, *_row([run.get("ate_mm") for run in runs], notes, 2, 0.0)))
    title = "Position error (ATE, RMSE), mm; small print: drift a second, lost frames"
    return Table(("sequence", *variants), tuple(rows), title)


def csv_rows(result: StressResult) -> list[dict[str, Any]]:
    """One a cell, with all its figures."""
    names = dict.fromkeys(name for cell in result.cells for name in cell.figures)
    return [
        {"sequence": c.case, "speed": c.speed, "exposure_s": c.exposure_s, "variant": c.variant}
        | {name: c.figures.get(name) for name in names} | {"error": c.record.error}
        for c in result.cells
    ]  # fmt: skip


def weights_name(sigma_px: float | None) -> str:
    """What the weights of a σ are called; None: constant ones."""
    return "constant" if sigma_px is None else f"σ {sigma_px:g} px"


def _row(values: Sequence[float | None], notes: Sequence[str], digits: int, ideal: float) -> list[Entry]:
    entries = [Entry(fixed(v, digits), note=note) for v, note in zip(values, notes, strict=True)]
    return best_marked(entries, values, ideal)
