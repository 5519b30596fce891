"""What the blur stress test found, read from its records: rows of scores, and their text.

result = read_stress(Path("runs/stress"))
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from rsgen.console.tables import Table, fixed
from rsgen.errors import UserError, first_problem
from rsgen.files import read_text
from rstrack.bench.measures.blur import POSES, weights_key
from rstrack.bench.record import Record

STRESS = "stress.json"
# Exposure whose keyframe is shown.
_SHOWN_S = 0.020
_SCORES = ("psnr_db", "psnr_db_least", "ssim", "gradient")
_STORED = TypeAdapter(tuple[Record, ...])


@dataclass(frozen=True)
class ColorScore:
    """Means over a sequence's keyframes, poses 'true' or 'estimated', for one σ (None: constant weights).

    gradient: gradient energy over that of the sharp truth. psnr_db_least: of the worst keyframe.
    """

    case: str
    speed: float
    exposure_s: float
    poses: str
    sigma_px: float | None
    psnr_db: float | None
    psnr_db_least: float | None
    ssim: float | None
    gradient: float | None
    keyframes: int


@dataclass(frozen=True)
class DepthScore:
    """RMSE over a sequence's keyframes: one frame's depth, and the fused keyframes'."""

    case: str
    poses: str
    single_mm: float | None
    fused_mm: float | None
    pixels: float | None


@dataclass(frozen=True)
class TrackScore:
    """Tracking errors of a sequence. variant: which photometric term. lost: frames, None if it could not be run."""

    case: str
    speed: float
    exposure_s: float
    variant: str
    ate_mm: float | None
    drift_mm_s: float | None
    lost: int | None


@dataclass(frozen=True)
class StressResult:
    """Everything that was measured. panels: folder of the pictures of one keyframe, and its sequence; relative."""

    motion: str
    color: tuple[ColorScore, ...]
    depth: tuple[DepthScore, ...]
    tracking: tuple[TrackScore, ...]
    panels: Path | None
    panels_case: str
    failed: tuple[str, ...]


def stress_result(records: Iterable[Record]) -> StressResult:
    """The scores in records. Raises KeyError, TypeError or ValueError: they are not of a stress test."""
    color: list[ColorScore] = []
    depth: list[DepthScore] = []
    tracking: list[TrackScore] = []
    failed: list[str] = []
    motion, shown = "", None
    for r in sorted(records, key=_place):
        about, f = r.settings["settings"], r.figures
        case, motion = str(about["sequence"]), str(about["motion"])
        speed, exposure = float(about["speed"]), float(about["exposure_s"])
        failed += [] if r.error is None else [f"{r.cell}: {r.error}"]
        lost = int(f["lost"]) if "lost" in f else None
        at = case, speed, exposure
        tracking.append(TrackScore(*at, str(about["variant"]), f.get("ate_mm"), f.get("drift_mm_s"), lost))
        if r.measure != "blur":
            continue
        if speed == 1.0 and "keyframes_true" in f and (shown is None or abs(exposure - _SHOWN_S) <= shown[0]):
            shown = abs(exposure - _SHOWN_S), r
        for poses in POSES:
            for sigma in (None, *map(float, about["sigmas_px"])):
                key = f"{poses}_{weights_key(sigma)}"
                psnr, least, likeness, gradient = (f.get(f"{name}_{key}") for name in _SCORES)
                count = int(f.get(f"keyframes_{poses}", 0))
                if count:
                    color.append(ColorScore(*at, poses, sigma, psnr, least, likeness, gradient, count))
            if f"fused_mm_{poses}" in f:
                figures = (f.get(f"{name}_{poses}") for name in ("single_mm", "fused_mm", "pixels"))
                depth.append(DepthScore(case, poses, *figures))
    panels = None if shown is None else Path("cells", shown[1].cell, "panels")
    of_case = "" if shown is None else str(shown[1].settings["settings"]["sequence"])
    return StressResult(motion, tuple(color), tuple(depth), tuple(tracking), panels, of_case, tuple(failed))


def _place(record: Record) -> tuple[bool, float, float, str]:
    about = record.settings["settings"]
    return float(about["speed"]) != 1.0, float(about["speed"]), float(about["exposure_s"]), record.cell


def read_stress(out: Path) -> StressResult:
    """What `write_stress` has written into `out`. Raises UserError naming the first wrong field."""
    path = Path(out) / STRESS
    try:
        result = stress_result(_STORED.validate_json(read_text(path)))
    except ValidationError as error:
        raise UserError(f"{path}: {first_problem(error)}: run 'rstrack bench stress' again") from None
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"{path}: is no stress test's ({error!r}): run 'rstrack bench stress' again") from None
    if not result.tracking:
        raise UserError(f"{path}: holds no records: run 'rstrack bench stress' again")
    return result


def stress_text(result: StressResult) -> str:
    """Tables with units."""
    head = ("sequence", "poses", "weights", "PSNR dB", "gain dB", "worst dB", "SSIM", "gradient", "keyframes")
    color = tuple(
        (row.case, row.poses, weights_name(row.sigma_px), fixed(row.psnr_db, 2),
         fixed(gain_db(result.color, row), 2, sign="+"), fixed(row.psnr_db_least, 2), fixed(row.ssim, 4),
         fixed(row.gradient, 3), str(row.keyframes))
        for row in result.color
    )  # fmt: skip
    depth = tuple(
        (d.case, d.poses, *(fixed(value, 2) for value in (d.single_mm, d.fused_mm, ratio(d)))) for d in result.depth
    )
    tracking = tuple(
        (t.case, t.variant, fixed(t.ate_mm, 2), fixed(t.drift_mm_s, 2), fixed(t.lost, 0)) for t in result.tracking
    )
    tables = (
        Table(head, color, "fused colour against the sharp view (means over keyframes)", words=(0, 1, 2)),
        Table(("sequence", "poses", "one frame mm", "fused mm", "ratio"), depth,
              "depth of keyframes, RMSE against the noise-free depth", words=(0, 1)),
        Table(("sequence", "photometric term", "ATE mm", "drift mm/s", "lost"), tracking, "tracking", words=(0, 1)),
    )  # fmt: skip
    colors, *others = (f"{table.title}\n{table.text()}" for table in tables)
    about = "gradient: energy over that of the sharp view; gain: over constant weights"
    failed = [f"failed: {line}" for line in result.failed]
    return "\n\n".join((f"blur stress test of {result.motion}", f"{colors}\n{about}", *others, *failed))


def ratio(row: DepthScore) -> float | None:
    """Fused over single depth error."""
    return row.fused_mm / row.single_mm if row.single_mm and row.fused_mm is not None else None


def gains_db(result: StressResult, sigma_px: float = 1.0, poses: str = "true") -> dict[str, float]:
    """PSNR of blur-aware over that of constant weights in dB, by sequence."""
    rows = [row for row in result.color if (row.sigma_px, row.poses) == (sigma_px, poses)]
    return {row.case: gain for row in rows if (gain := gain_db(result.color, row)) is not None}


def gain_db(rows: Sequence[ColorScore], row: ColorScore) -> float | None:
    """PSNR of `row` over that of constant weights, among `rows`, in dB; None if it is of constant weights itself."""
    same = (r for r in rows if r.sigma_px is None and (r.case, r.poses) == (row.case, row.poses))
    base = next(same, None)
    if row.sigma_px is None or base is None or row.psnr_db is None or base.psnr_db is None:
        return None
    return row.psnr_db - base.psnr_db


def weights_name(sigma_px: float | None) -> str:
    """What the weights of a σ are called; None: constant ones."""
    return "constant" if sigma_px is None else f"σ {sigma_px:g} px"
