"""What the blur stress test found, as text, CSV, JSON, curves, and the four panels of the paper's Figure 2.

write_tables(report, Path("runs/stress"))
report = read_stress(Path("runs/stress"))
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from rsgen.errors import UserError, first_problem
from rsgen.files import atomic_write, encode_png, read_png, read_text
from rstrack.bench.stress.run import ColorScore, DepthScore, Panels, StressResult, TrackScore
from rstrack.data.estimate import plain

STRESS = "stress.json"

# Names of the files in panels/, in the order of the paper's Figure 2.
_PANELS = ("registered", "weights", "constant", "blur_aware", "sharp_view")
_COLORS = ("#2a6fbb", "#d9822b", "#3a8f4d", "#8e44ad", "#c0392b")


def write_tables(report: StressResult, out: Path) -> list[Path]:
    """Write stress.txt, stress.json, stress_color.csv, _depth.csv, _tracking.csv, stress.png, panels.png and the
    panels themselves in panels/; returns the files. Raises UserError if that cannot be done."""
    data = plain(report.as_dict())
    data["panels"] = None if report.panels is None else _about(report.panels)
    files = {
        "stress.txt": stress_text(report) + "\n",
        STRESS: json.dumps(data, indent=1, allow_nan=False) + "\n",
        **{f"stress_{name}.csv": _csv(data[name]) for name in ("color", "depth", "tracking")},
    }
    for name, text in files.items():
        atomic_write(out / name, text.encode())
    written = [out / name for name in files]
    written.append(_plot(report, out / "stress.png"))
    return written + ([] if report.panels is None else _write_panels(report.panels, out))


def read_stress(out: Path) -> StressResult:
    """What `write_tables` has written into `out`, without the panels. Raises UserError naming the first wrong field."""
    stored = _read(Path(out) / STRESS)
    return StressResult(
        stored.config,
        tuple(ColorScore(**row.model_dump()) for row in stored.color),
        tuple(DepthScore(**row.model_dump()) for row in stored.depth),
        tuple(TrackScore(**row.model_dump()) for row in stored.tracking),
        None,
    )


def read_panels(out: Path) -> Panels | None:
    """The panels in `out`, weights to 1/255 of the largest; None if the test had none. Raises UserError."""
    about, folder = _read(Path(out) / STRESS).panels, Path(out) / "panels"
    if about is None:
        if folder.is_dir():
            raise UserError(f"{folder}: {STRESS} does not say what is in it: run 'rstrack stress' again")
        return None
    size = (about.height, about.width, 3)
    images = {name: read_png(folder / f"{name}.png", size, np.uint8) for name in _PANELS}
    images["weights"] = images["weights"][..., 0] * np.float32(about.white / 255.0)
    return Panels(about.case, about.keyframe, *images.values())


def stress_text(report: StressResult) -> str:
    """Tables with units."""
    lines = [f"blur stress test of {report.config}", "", "fused colour against the sharp view (means over keyframes)"]
    head = ("sequence", "poses", "weights", "PSNR dB", "gain dB", "worst dB", "SSIM", "gradient", "keyframes")
    rows: list[tuple[str, ...]] = []
    for row in report.color:
        gain = gain_db(report.color, row)
        rows.append(
            (row.case, row.poses, _weights(row.sigma_px), f"{row.psnr_db:.2f}",
             "" if gain is None else f"{gain:+.2f}", f"{row.psnr_db_least:.2f}",
             f"{row.ssim:.4f}", f"{row.gradient:.3f}", str(row.keyframes))
        )  # fmt: skip
    lines += _table(head, rows)
    lines += ["gradient: energy over that of the sharp view; gain: over constant weights", ""]
    lines += ["depth of keyframes, RMSE against the noise-free depth"]
    rows = [
        (d.case, d.poses, f"{1e3 * d.single_m:.2f}", f"{1e3 * d.fused_m:.2f}", f"{d.fused_m / d.single_m:.2f}")
        for d in report.depth
    ]
    lines += [*_table(("sequence", "poses", "one frame mm", "fused mm", "ratio"), rows), "", "tracking"]
    rows = [(t.case, t.variant, _mm(t.ate_m), _mm(t.drift_m_per_s), str(t.lost)) for t in report.tracking]
    return "\n".join(lines + _table(("sequence", "photometric term", "ATE mm", "drift mm/s", "lost"), rows))


def gains_db(report: StressResult, sigma_px: float = 1.0, poses: str = "true") -> dict[str, float]:
    """PSNR of blur-aware over that of constant weights in dB, by sequence."""
    rows = [row for row in report.color if (row.sigma_px, row.poses) == (sigma_px, poses)]
    return {row.case: gain for row in rows if (gain := gain_db(report.color, row)) is not None}


def gain_db(rows: Sequence[ColorScore], row: ColorScore) -> float | None:
    """PSNR of `row` over that of constant weights, among `rows`, in dB; None if it is of constant weights itself."""
    same = (r for r in rows if r.sigma_px is None and (r.case, r.poses) == (row.case, row.poses))
    base = next(same, None)
    return None if row.sigma_px is None or base is None else row.psnr_db - base.psnr_db


def shade(weights: npt.NDArray[np.floating[Any]]) -> tuple[npt.NDArray[np.uint8], float]:
    """Weights (h, w) as a grey picture (h, w, 3), and the weight that is white in it: the largest."""
    white = max(float(weights.max()), 1e-6)
    return np.repeat(np.rint(255.0 / white * weights).astype(np.uint8)[..., None], 3, axis=-1), white


def _weights(sigma_px: float | None) -> str:
    return "constant" if sigma_px is None else f"sigma {sigma_px:g} px"


def _mm(value: float | None) -> str:
    return "-" if value is None else f"{1e3 * value:.2f}"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(len(row[i]) for row in [head, *rows]) for i in range(len(head))]
    return [
        "  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip() for row in [head, *rows]
    ]


def _csv(rows: Sequence[dict[str, Any]]) -> str:
    stream = io.StringIO()
    if rows:
        writer = csv.DictWriter(stream, fieldnames=list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return stream.getvalue()


def _plot(report: StressResult, path: Path) -> Path:
    """PSNR and gradient energy by exposure, PSNR by speed, tracking error by exposure."""
    from matplotlib.figure import Figure  # half a second to import, and only drawing needs it

    from rsgen.figures import save

    figure = Figure(figsize=(12.5, 7.6), layout="constrained")
    axes = figure.subplots(2, 2)
    slow = [row for row in report.color if row.speed == 1.0 and row.poses == "true"]
    by_speed = _by_speed(report)
    panels = (
        (axes[0, 0], slow, "exposure_ms", "psnr_db", "PSNR, dB", "exposure, ms"),
        (axes[0, 1], slow, "exposure_ms", "gradient", "gradient energy / sharp view's", "exposure, ms"),
        (axes[1, 0], by_speed, "speed", "psnr_db", "PSNR, dB", "speed, times"),
    )
    for axis, rows, along, value, label, below in panels:
        for n, sigma in enumerate(dict.fromkeys(row.sigma_px for row in rows)):
            mine = [row for row in rows if row.sigma_px == sigma]
            x = [1e3 * row.exposure_s if along == "exposure_ms" else row.speed for row in mine]
            color = "0.3" if sigma is None else _COLORS[(n - 1) % len(_COLORS)]
            style = "--" if sigma is None else "-"
            axis.plot(x, [getattr(row, value) for row in mine], f"o{style}", color=color, label=_weights(sigma), ms=4)
        axis.set_xlabel(below)
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
    axes[0, 0].legend(frameon=False, fontsize=9)
    for n, variant in enumerate(dict.fromkeys(row.variant for row in report.tracking)):
        found = [t for t in report.tracking if t.variant == variant and t.speed == 1.0 and t.ate_m is not None]
        x, y = [1e3 * t.exposure_s for t in found], [1e3 * (t.ate_m or 0.0) for t in found]
        axes[1, 1].plot(x, y, "o-", color=_COLORS[n % len(_COLORS)], label=variant, ms=4)
    axes[1, 1].set_xlabel("exposure, ms")
    axes[1, 1].set_ylabel("ATE, mm")
    axes[1, 1].grid(alpha=0.3)
    if axes[1, 1].lines:
        axes[1, 1].legend(frameon=False, fontsize=9)
    figure.suptitle(f"{report.config}: fused colour along the true path, and tracking")
    save(figure, path)
    return path


def _by_speed(report: StressResult) -> list[ColorScore]:
    """Scores of all speeds at the exposure that the fast sequences have."""
    fast = {row.exposure_s for row in report.color if row.speed != 1.0}
    rows = [row for row in report.color if row.exposure_s in fast and row.poses == "true"]
    return sorted(rows, key=lambda row: row.speed)


def _write_panels(panels: Panels, out: Path) -> list[Path]:
    from rsgen.figures import save_grid

    picture, white = shade(panels.weights)
    shown = (panels.blurred, picture, panels.constant, panels.aware, panels.truth)
    images = dict(zip(_PANELS, shown, strict=True))
    folder = out / "panels"
    folder.mkdir(parents=True, exist_ok=True)
    written = [folder / f"{name}.png" for name in images]
    for path, image in zip(written, images.values(), strict=True):
        atomic_write(path, encode_png(np.ascontiguousarray(image)))
    titles = (
        "registered blurred input",
        f"weights (white: {white:.2g})",
        "constant weights",
        "blur-aware weights",
        "sharp view (truth)",
    )
    save_grid([[image / 255.0 for image in images.values()]], titles, out / "panels.png")
    return [*written, out / "panels.png"]


# -- reading ----------------------------------------------------------------------------------------------------------

# What JSON cannot hold (NaN, infinity) was written as null.
_Score = Annotated[float, BeforeValidator(lambda value: math.nan if value is None else value)]
_Measure = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]


class _Stored(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class _ColorRow(_Stored):
    case: str
    speed: _Measure
    exposure_s: _Measure
    poses: Literal["true", "estimated"]
    sigma_px: _Measure | None
    psnr_db: _Score
    psnr_db_least: _Score
    ssim: _Score
    gradient: _Score
    keyframes: int = Field(ge=1)


class _DepthRow(_Stored):
    case: str
    poses: Literal["true", "estimated"]
    single_m: _Score
    fused_m: _Score
    pixels: int = Field(ge=0)


class _TrackRow(_Stored):
    case: str
    speed: _Measure
    exposure_s: _Measure
    variant: str
    ate_m: _Measure | None
    drift_m_per_s: _Measure | None
    lost: int = Field(ge=0)


class _AboutPanels(_Stored):
    """white: the weight that is white in weights.png."""

    case: str
    keyframe: int = Field(ge=0)
    width: int = Field(ge=1)
    height: int = Field(ge=1)
    white: _Measure


class _StoredStress(_Stored):
    config: str
    color: tuple[_ColorRow, ...] = Field(min_length=1)
    depth: tuple[_DepthRow, ...]
    tracking: tuple[_TrackRow, ...] = Field(min_length=1)
    panels: _AboutPanels | None = None


def _about(panels: Panels) -> dict[str, Any]:
    height, width = panels.weights.shape
    white = shade(panels.weights)[1]
    return {"case": panels.case, "keyframe": panels.index, "width": width, "height": height, "white": white}


def _read(path: Path) -> _StoredStress:
    try:
        return _StoredStress.model_validate_json(read_text(path))
    except ValidationError as error:
        raise UserError(f"{path}: {first_problem(error)}: run 'rstrack stress' again") from None
