"""The blur stress test: one motion at several exposures and speeds, what tracks it, and its records read again.

result = read_stress(Path("runs/stress"))

Exposures differ in nothing but their blur: the colour camera's clock is shifted by half the exposure, so that every
row's mid-exposure, and with it its pose, its depth image and the sharp truth stay the same.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError, validated
from rsgen.files import atomic_write, encode_yaml, read_text, read_yaml
from rsgen.geometry.spline import Spline
from rsgen.sequence.format import pose_rows
from rstrack.bench.cells import Benchmark, CaseEntry, Cell, MethodEntry, SequenceEntry
from rstrack.bench.experiments.methods import given_options
from rstrack.bench.measures.blur import weights_key
from rstrack.bench.record import CellRecord
from rstrack.bench.tables import failures
from rstrack.bench.task import Sources
from rstrack.options import Options

STRESS = "stress.json"
PATHS = {"true": "true path", "estimated": "estimated path"}
"""What frames are registered along, by its name in figures."""
# Exposure whose keyframe is shown.
_SHOWN_S = 0.020
_STORED = TypeAdapter(tuple[CellRecord, ...])
# Samples of the sped-up path per knot: the fit through them, in phase, gives the spline back.
_SAMPLES_PER_KNOT = 8
# Of the blur weight in the photometric term, as the paper has it for colour.
_SIGMA_PX = 1.0


@dataclass(frozen=True)
class StressOptions:
    """exposures_s: at speed 1. speeds: other speeds, at `speed_exposure_s`. sigmas_px: of equation (13).

    frames: only the first so many at speed 1, None: all (a faster sequence has so many fewer). width: of the images in
    px, None: the config's.
    """

    exposures_s: tuple[float, ...] = (0.0, 0.005, 0.010, 0.020, 0.030)
    speeds: tuple[float, ...] = (2.0, 4.0)
    speed_exposure_s: float = 0.020
    sigmas_px: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0)
    frames: int | None = None
    width: int | None = None
    tracker: Options = field(default_factory=Options)

    def __post_init__(self) -> None:
        given = (*self.exposures_s, self.speed_exposure_s)
        if not self.exposures_s or not all(0.0 <= t <= 1.0 for t in given):
            raise UserError(f"stress: exposures {given} must lie between 0 and 1 s, and be one at least")
        for name in ("speeds", "sigmas_px"):
            if not all(0.01 <= value <= 100.0 for value in getattr(self, name)):
                raise UserError(f"stress: {name} {getattr(self, name)} must lie between 0.01 and 100")
        if self.frames is not None and self.frames < 2:
            raise UserError(f"stress: frames {self.frames} must be 2 or more")
        if self.width is not None and not 32 <= self.width <= 16384:
            raise UserError(f"stress: width {self.width} must lie between 32 and 16384")

    @property
    def cases(self) -> tuple[tuple[float, float], ...]:
        """Speed and exposure (s) of all sequences."""
        first = [(1.0, t) for t in sorted(set(self.exposures_s))]
        return (*first, *((s, self.speed_exposure_s) for s in sorted({*self.speeds} - {1.0})))


def case_name(speed: float, exposure_s: float) -> str:
    """What a sequence is called."""
    return f"exposure_{1e3 * exposure_s:g}ms" + ("" if speed == 1.0 else f"_speed_{speed:g}x")


def stress_benchmark(
    config: Path, sources: Sources, options: StressOptions, progress: Progress = no_progress
) -> Benchmark:
    """All cells. The first sequence is rendered now where there are other speeds, which take its path.

    Of each sequence the measure `blur` is taken, which tracks it too, and where there is blur the measure `track` with
    the colour lines' poses at the end of exposure, and with blur weights. Raises UserError: a config or a render that
    does not do.
    """
    text = read_yaml(config)
    clock = _clock(config, text)
    cells: list[Cell] = []
    slow: Path | None = None
    for speed, exposure in options.cases:
        name = case_name(speed, exposure)
        if slow is None and speed != 1.0:
            slow = sources.folder(cells[0].sequence, cells[0].case_entry.sequence, progress)
        made = config if speed == 1.0 or slow is None else _sped_up(config, text, speed, slow)
        frames = None if options.frames is None else f"0:{max(2, round(options.frames / speed))}"
        fields: dict[str, Any] = {"color.exposure_s": exposure, "color.offset_s": round(clock + 0.5 * exposure, 9)}
        fields["truth.global_shutter"] = ["middle"]
        sequence = SequenceEntry(config=made, set=fields, width=options.width, frames=frames, group="stress")
        cells += _cells(config.stem, name, speed, exposure, sequence, options)
    return Benchmark(tuple(cells))


def _cells(
    stem: str, name: str, speed: float, exposure_s: float, sequence: SequenceEntry, options: StressOptions
) -> list[Cell]:
    method, given = options.tracker.method, given_options(options.tracker)
    about = {"sequence": name, "motion": stem, "speed": speed, "exposure_s": exposure_s}

    def cell(measure: str, variant: str, case: str = "", change: str = "", also: str = "", **option: Any) -> Cell:
        entry = CaseEntry(sequence=f"{stem}-{name}", changes=({change: {}},) if change else ())
        settings = about | {"variant": variant} | ({"sigmas_px": options.sigmas_px} if measure == "blur" else {})
        how = MethodEntry(method=method, options=given | option)
        return Cell(measure, name + case, method + also, (0,), entry, sequence, how, settings)

    cells = [cell("blur", "mid-exposure")]
    if exposure_s > 0.0:
        cells.append(cell("track", "end of exposure", "_told_sharp", "color_told_sharp"))
        cells.append(cell("track", "mid-exposure, blur weight", also="-blur_weight", blur_sigma_px=_SIGMA_PX))
    return cells


def _clock(config: Path, text: dict[str, Any]) -> float:
    """Seconds after the start at which line 0 of the depth camera, and of the colour camera too, is mid-exposure."""
    depth = text.get("depth") or {}
    try:
        return float(depth.get("offset_s", 0.0)) - 0.5 * float(depth.get("exposure_s", 0.0))
    except (AttributeError, TypeError, ValueError):
        raise UserError(f"{config}: depth.offset_s and depth.exposure_s must be numbers of seconds") from None


def _sped_up(config: Path, text: dict[str, Any], speed: float, slow: Path) -> Path:
    """A config with the path of sequence `slow` at another speed: the same spline with its knots closer together."""
    spline = Spline.load(slow / "spline.npz")
    fast = Spline(spline.control_points, spline.t0 / speed, spline.dt / speed)
    steps = round((fast.t_end - fast.t_begin) / fast.dt) * _SAMPLES_PER_KNOT
    t = np.linspace(fast.t_begin, fast.t_end, steps + 1)
    rows = pose_rows(fast.pose(t))
    path = slow.with_name(f"{slow.name}-speed_{speed:g}x.txt")
    lines = [f"{a - t[0]:.12f} " + " ".join(f"{v:.12f}" for v in row) for a, row in zip(t, rows, strict=True)]
    atomic_write(path, ("\n".join(["# stamp tx ty tz qx qy qz qw", *lines]) + "\n").encode())
    changed = {key: value for key, value in text.items() if key not in ("motion", "trajectory")}
    changed["trajectory"] = {"file": str(path.resolve()), "format": "tum", "knot_spacing_s": fast.dt}
    scene = dict(text.get("scene") or {})
    if "file" in scene:
        scene["file"] = str((config.parent / scene["file"]).resolve())
    made = path.with_suffix(".yaml")
    atomic_write(made, encode_yaml(changed | {"scene": scene}))
    return made


@dataclass(frozen=True)
class StressCell:
    """A cell. case: its sequence. variant: which photometric term. sigmas_px: of the weights (None: constant ones)."""

    case: str
    speed: float
    exposure_s: float
    variant: str
    sigmas_px: tuple[float | None, ...]
    figures: dict[str, float]
    record: CellRecord

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
    cells: tuple[StressCell, ...]

    @property
    def failed(self) -> list[str]:
        """A line for each error."""
        return failures(cell.record for cell in self.cells)

    @property
    def pictured(self) -> StressCell | None:
        """The cell whose keyframe is shown, of which `panels` has the pictures."""
        found = [cell for cell in self.fused("true") if cell.speed == 1.0]
        return min(found, key=lambda cell: abs(cell.exposure_s - _SHOWN_S), default=None)

    @property
    def panels(self) -> Path | None:
        """Folder of the pictures of one keyframe, relative to the test's."""
        return None if self.pictured is None else self.pictured.record.folder / "panels"

    def fused(self, poses: str) -> list[StressCell]:
        """The cells that have keyframes fused along a path."""
        return [cell for cell in self.cells if cell.figures.get(f"keyframes_{poses}")]

    @property
    def sigmas_px(self) -> list[float | None]:
        """All weights, the constant ones first."""
        found = {sigma for cell in self.cells for sigma in cell.sigmas_px}
        return sorted(found, key=lambda sigma: -1.0 if sigma is None else sigma)


def stress_result(records: Iterable[CellRecord]) -> StressResult:
    """The records as a result. Raises KeyError, TypeError or ValueError: they are not of a stress test."""
    motion, cells = "", []
    for r in records:
        about: dict[str, Any] = r.settings["settings"]
        sigmas = (None, *map(float, about["sigmas_px"])) if r.measure == "blur" else ()
        motion, at = str(about["motion"]), (str(about["sequence"]), float(about["speed"]), float(about["exposure_s"]))
        cells.append(StressCell(*at, str(about["variant"]), sigmas, r.figures, r))
    cells.sort(key=lambda cell: (cell.speed != 1.0, cell.speed, cell.exposure_s, cell.record.cell))
    return StressResult(motion, tuple(cells))


def read_stress(out: Path) -> StressResult:
    """What `write_stress` has written into `out`. Raises UserError naming the first wrong field."""
    path, again = Path(out) / STRESS, ": run 'rstrack bench stress' again"
    records = validated(_STORED.validate_json, read_text(path), path, cure=again)
    try:
        result = stress_result(records)
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"{path}: is no stress test's ({error!r}){again}") from None
    if not result.cells:
        raise UserError(f"{path}: holds no records{again}")
    return result
