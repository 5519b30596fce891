"""What the blur stress test found, as text, CSV, JSON, curves, and the four panels of the paper's Figure 2.

write_stress(result, Path("runs/stress"))
result = read_stress(Path("runs/stress"))
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, Field, ValidationError

from rsgen.console.tables import Table, csv_text, fixed
from rsgen.errors import UserError, first_problem
from rsgen.files import atomic_write, encode_png, read_png, read_text
from rstrack.bench.stress.charts import color_charts, gain_db, tracking_chart, weights_name
from rstrack.bench.stress.run import STORED, ColorScore, DepthScore, Measure, Panels, StressResult, TrackScore
from rstrack.charts.to_file import write_charts
from rstrack.data.estimate import plain

STRESS = "stress.json"

# Names of the files in panels/, in the order of the paper's Figure 2.
_PANELS = ("registered", "weights", "constant", "blur_aware", "sharp_view")


def write_stress(result: StressResult, out: Path) -> list[Path]:
    """Write stress.txt, stress.json, stress_color.csv, _depth.csv, _tracking.csv, stress.png, panels.png and the
    panels themselves in panels/; returns the files. Raises UserError if that cannot be done."""
    data = plain(result.as_dict())
    data["panels"] = None if result.panels is None else _about(result.panels)
    files = {
        "stress.txt": stress_text(result) + "\n",
        STRESS: json.dumps(data, indent=1, allow_nan=False) + "\n",
        **{f"stress_{name}.csv": csv_text(data[name]) for name in ("color", "depth", "tracking")},
    }
    for name, text in files.items():
        atomic_write(out / name, text.encode())
    written = [out / name for name in files]
    title = f"{result.config}: fused colour along the true path, and tracking"
    write_charts([*color_charts(result, "true"), tracking_chart(result)], out / "stress.png", title)
    written.append(out / "stress.png")
    return written + ([] if result.panels is None else _write_panels(result.panels, out))


def read_stress(out: Path) -> StressResult:
    """What `write_stress` has written into `out`, without the panels. Raises UserError naming the first wrong field."""
    stored = _read(Path(out) / STRESS)
    return StressResult(stored.config, stored.color, stored.depth, stored.tracking, None)


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
        (d.case, d.poses, *(fixed(v, 2, 1e3) for v in (d.single_m, d.fused_m)), fixed(d.fused_m / d.single_m, 2))
        for d in result.depth
    )
    tracking = tuple(
        (t.case, t.variant, fixed(t.ate_m, 2, 1e3), fixed(t.drift_m_per_s, 2, 1e3), str(t.lost))
        for t in result.tracking
    )
    tables = (
        Table(head, color, "fused colour against the sharp view (means over keyframes)", words=(0, 1, 2)),
        Table(("sequence", "poses", "one frame mm", "fused mm", "ratio"), depth,
              "depth of keyframes, RMSE against the noise-free depth", words=(0, 1)),
        Table(("sequence", "photometric term", "ATE mm", "drift mm/s", "lost"), tracking, "tracking", words=(0, 1)),
    )  # fmt: skip
    colors, *others = (f"{table.title}\n{table.text()}" for table in tables)
    about = "gradient: energy over that of the sharp view; gain: over constant weights"
    return "\n\n".join((f"blur stress test of {result.config}", f"{colors}\n{about}", *others))


def shade(weights: npt.NDArray[np.floating[Any]]) -> tuple[npt.NDArray[np.uint8], float]:
    """Weights (h, w) as a grey picture (h, w, 3), and the weight that is white in it: the largest."""
    white = max(float(weights.max()), 1e-6)
    return np.repeat(np.rint(255.0 / white * weights).astype(np.uint8)[..., None], 3, axis=-1), white


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


class _AboutPanels(BaseModel):
    """white: the weight that is white in weights.png."""

    model_config = STORED

    case: str
    keyframe: int = Field(ge=0)
    width: int = Field(ge=1)
    height: int = Field(ge=1)
    white: Measure


class _Stored(BaseModel):
    model_config = STORED

    config: str
    color: tuple[ColorScore, ...] = Field(min_length=1)
    depth: tuple[DepthScore, ...]
    tracking: tuple[TrackScore, ...] = Field(min_length=1)
    panels: _AboutPanels | None = None


def _about(panels: Panels) -> dict[str, Any]:
    height, width = panels.weights.shape
    white = shade(panels.weights)[1]
    return {"case": panels.case, "keyframe": panels.index, "width": width, "height": height, "white": white}


def _read(path: Path) -> _Stored:
    try:
        return _Stored.model_validate_json(read_text(path))
    except ValidationError as error:
        raise UserError(f"{path}: {first_problem(error)}: run 'rstrack stress' again") from None
