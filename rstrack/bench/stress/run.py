"""The blur stress test: one motion at several exposures and speeds; what blur-aware weights are worth on each.

result = run_stress(Path("configs/stress.yaml"), Path("runs/stress"), StressOptions())

Sequences are rendered by `rsgen render` into OUT/sequences/ and tracked into OUT/runs/; what is there is not made
again.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, ConfigDict, Field
from pydantic.dataclasses import dataclass as pydantic_dataclass

from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.spline import Spline
from rstrack.bench.stress.cases import Case, Render, StressOptions, render_cases, run_rsgen
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.data.estimate import INFO, Estimate, read_estimate
from rstrack.mapping.fused_keyframes import FusedKeyframe, Sigma, depth_errors, fused_keyframes
from rstrack.metrics.images import gradient_energy, psnr_db, ssim
from rstrack.options import Options
from rstrack.tracking.runs.run import track

# Seconds within which a keyframe and the sharp truth are of the same instant.
_SAME_INSTANT_S = 1e-4
_TRUTH = "global_middle"
# Of the blur weight in the photometric term, as the paper has it for colour.
_SIGMA_PX = 1.0


STORED = ConfigDict(extra="forbid", strict=True)
"""Scores are checked when they are read again; see `rstrack.bench.stress.tables`."""
Measure = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
# What JSON cannot hold (NaN, infinity) was written as null.
_Score = Annotated[float, BeforeValidator(lambda value: math.nan if value is None else value)]
_Poses = Literal["true", "estimated"]


@pydantic_dataclass(frozen=True, config=STORED)
class ColorScore:
    """Means over a case's keyframes, poses 'true' or 'estimated', for one σ (None: constant weights).

    gradient: gradient energy over that of the sharp truth. psnr_db_least: of the worst keyframe.
    """

    case: str
    speed: Measure
    exposure_s: Measure
    poses: _Poses
    sigma_px: Measure | None
    psnr_db: _Score
    psnr_db_least: _Score
    ssim: _Score
    gradient: _Score
    keyframes: int = Field(ge=1)


@pydantic_dataclass(frozen=True, config=STORED)
class DepthScore:
    """RMSE in m over a case's keyframes: one frame's depth, and the fused keyframes'."""

    case: str
    poses: _Poses
    single_m: _Score
    fused_m: _Score
    pixels: int = Field(ge=0)


@pydantic_dataclass(frozen=True, config=STORED)
class TrackScore:
    """Tracking errors of a case. variant: which photometric term."""

    case: str
    speed: Measure
    exposure_s: Measure
    variant: str
    ate_m: Measure | None
    drift_m_per_s: Measure | None
    lost: int = Field(ge=0)


@dataclass(frozen=True)
class Panels:
    """The paper's Figure 2 for one keyframe: images (h, w, 3) and weights (h, w)."""

    case: str
    index: int
    blurred: Any
    weights: Any
    constant: Any
    aware: Any
    truth: Any


@dataclass(frozen=True)
class StressResult:
    """Everything that was measured."""

    config: str
    color: tuple[ColorScore, ...]
    depth: tuple[DepthScore, ...]
    tracking: tuple[TrackScore, ...]
    panels: Panels | None

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON, units in the names; without the images."""
        tables = {name: [dataclasses.asdict(row) for row in getattr(self, name)] for name in _TABLES}
        return {"config": self.config, **tables}


_TABLES = ("color", "depth", "tracking")


def run_stress(
    config: Path, out: Path, options: StressOptions, progress: Progress = no_progress, render: Render | None = None
) -> StressResult:
    """Render, track, fuse and score all cases. Raises UserError: a config, a render or a folder that does not do.

    render: runs `rsgen` with arguments (default: in a process of its own).
    """
    sequences = render_cases(config, out, options, progress, render or run_rsgen)
    color: list[ColorScore] = []
    depth: list[DepthScore] = []
    tracking: list[TrackScore] = []
    panels: Panels | None = None
    sharp: dict[float, Dataset] = {}
    for n, case in enumerate(options.cases):
        progress("stress", n / len(options.cases), case.name)
        dataset = open_dataset(sequences[case])
        truth = sharp.setdefault(case.speed, dataset)
        check_comparable(truth)
        found, estimate = _track_variants(dataset, case, out / "runs", options)
        tracking += found
        for poses, spline, covers in _splines(dataset, estimate):
            keyframes = list(
                fused_keyframes(dataset, spline, (None, *options.sigmas_px), options.tracker, None, covers)
            )
            color += _color_scores(case, poses, keyframes, truth)
            depth += _depth_score(case, poses, keyframes, dataset, options.tracker)
            if poses == "true" and case.speed == 1.0 and math.isclose(case.exposure_s, options.speed_exposure_s):
                panels = _panels(case, keyframes, truth, options)
    return StressResult(Path(config).name, tuple(color), tuple(depth), tuple(tracking), panels)


def check_comparable(dataset: Dataset) -> None:
    """Raises UserError unless a frame's global-shutter truth is the view of the keyframe that it makes."""
    rig, root = dataset.rig, dataset.root
    if dataset.sequence is None or _TRUTH not in dataset.sequence.truth_images:
        raise UserError(f"{root}: has no truth/{_TRUTH}: delete the folder and run stress again")
    if rig.depth_camera != rig.color_camera or rig.depth_camera.model != "pinhole":
        raise UserError(f"{root}: stress compares colour from the depth camera's view: give both the same pinhole")
    if not np.allclose(rig.T_color_depth, np.eye(4), atol=1e-9):
        raise UserError(f"{root}: stress compares colour from the depth camera's view: leave T_color_depth out")
    if rig.depth_shutter.readout_s != rig.color_shutter.readout_s:
        raise UserError(f"{root}: stress needs the same readout_s for colour and depth")


# -- tracking ---------------------------------------------------------------------------------------------------------


def _variants(dataset: Dataset, options: Options) -> list[tuple[str, Dataset, Options]]:
    """What is tracked: as configured, with the colour lines' poses at the end of exposure, with blur weights."""
    color = dataset.rig.color_shutter
    variants = [("mid-exposure", dataset, options)]
    if color.exposure_s > 0.0:
        rig = replace(dataset.rig, color_shutter=Shutter(color.readout_s, 0.0, color.scan))
        variants.append(("end of exposure", replace(dataset, rig=rig), options))
        variants.append(("mid-exposure, blur weight", dataset, replace(options, blur_sigma_px=_SIGMA_PX)))
    return variants


def _track_variants(
    dataset: Dataset, case: Case, folder: Path, options: StressOptions
) -> tuple[list[TrackScore], Estimate | None]:
    """Scores of all variants, and the estimate of the first; None if it got lost for good."""
    scores, first = [], None
    for n, (variant, seen, chosen) in enumerate(_variants(dataset, options.tracker)):
        estimate = _tracked(seen, chosen, folder / f"{case.name}_{variant.replace(', ', '_').replace(' ', '-')}")
        metrics = (estimate.info.get("metrics") if estimate else None) or {}
        lost = int(estimate.info["lost"]) if estimate else len(dataset)
        ate, drift = metrics.get("ate_rmse_m"), metrics.get("rpe_trans_rmse_m_per_s")
        scores.append(TrackScore(case.name, case.speed, case.exposure_s, variant, ate, drift, lost))
        first = estimate if n == 0 else first
    return scores, first


def _tracked(dataset: Dataset, options: Options, folder: Path) -> Estimate | None:
    """The run in `folder`, if it was made with these options of as many frames; else a new one."""
    if (folder / INFO).exists():
        kept = read_estimate(folder)
        same = kept.info.get("options") == dataclasses.asdict(options)
        if same and (kept.info.get("dataset") or {}).get("frames") == [0, len(dataset)]:
            return kept
    try:
        result = track(dataset, options, folder)
    except UserError:
        return None
    return result.estimate if len(result.estimate.stamps) > 2 else None


def _splines(dataset: Dataset, estimate: Estimate | None) -> list[tuple[_Poses, Spline, Callable[[float], bool]]]:
    assert dataset.truth is not None
    spline = dataset.truth
    known: list[tuple[_Poses, Spline, Callable[[float], bool]]] = [
        ("true", spline, lambda t: spline.t_begin <= t <= spline.t_end)
    ]
    if estimate is not None and estimate.spline is not None:
        known.append(("estimated", estimate.spline, lambda t: bool(estimate.spline_covers(t))))
    return known


# -- scores -----------------------------------------------------------------------------------------------------------


def _sharp_view(truth: Dataset, done: FusedKeyframe) -> Any:
    """The sharp image (h, w, 3) from the keyframe's pose. Raises UserError."""
    assert truth.sequence is not None
    rig = truth.rig
    stamps = truth.color_stamps - 0.5 * rig.color_shutter.exposure_s
    wanted = done.reference.stamp - 0.5 * rig.depth_shutter.exposure_s
    k = int(np.argmin(np.abs(stamps - wanted)))
    if abs(stamps[k] - wanted) > _SAME_INSTANT_S:
        raise UserError(
            f"{truth.root}: no colour image of the time {wanted:.4f} s, of which there is a depth image: give both "
            "streams the same rate_hz, and render all frames"
        )
    return truth.sequence.truth(_TRUTH, k)


def _color_scores(case: Case, poses: _Poses, keyframes: Sequence[FusedKeyframe], truth: Dataset) -> list[ColorScore]:
    sums: dict[Sigma, list[tuple[float, float, float]]] = {}
    for done in keyframes:
        sharp = _sharp_view(truth, done)
        known = np.logical_and.reduce([weight > 0 for _, weight in done.colors.values()])
        energy = gradient_energy(sharp, known)
        for sigma, (image, _) in done.colors.items():
            ratio = gradient_energy(image, known) / energy
            sums.setdefault(sigma, []).append((psnr_db(image, sharp, known), ssim(image, sharp, known), ratio))
    scores = []
    for sigma, values in sums.items():
        table = np.array(values)
        psnr, likeness, ratio = table.mean(axis=0)
        scores.append(
            ColorScore(
                case.name, case.speed, case.exposure_s, poses, sigma, float(psnr), float(table[:, 0].min()),
                float(likeness), float(ratio), len(values),
            )
        )  # fmt: skip
    return scores


def _depth_score(
    case: Case, poses: _Poses, keyframes: Sequence[FusedKeyframe], dataset: Dataset, options: Options
) -> list[DepthScore]:
    """Over keyframes of more than one frame: there is nothing fused in the others."""
    errors = [depth_errors(dataset, done, options) for done in keyframes if done.frames > 1]
    if not errors:
        return []
    single, fused, pixels = np.array(errors).T
    rms = [float(np.sqrt(np.average(values**2, weights=pixels))) for values in (single, fused)]
    return [DepthScore(case.name, poses, rms[0], rms[1], int(pixels.sum()))]


def _panels(case: Case, keyframes: Sequence[FusedKeyframe], truth: Dataset, options: StressOptions) -> Panels | None:
    """Of the keyframe where blur-aware weights are worth most."""
    sigma = min(options.sigmas_px, key=lambda s: abs(s - 1.0), default=None)
    if sigma is None or not keyframes:
        return None

    def gain(done: FusedKeyframe) -> float:
        sharp, known = _sharp_view(truth, done), done.colors[None][1] > 0
        return psnr_db(done.colors[sigma][0], sharp, known) - psnr_db(done.colors[None][0], sharp, known)

    best = max(keyframes, key=gain)
    blurred, weights = best.most_blurred
    images = best.colors[None][0], best.colors[sigma][0], _sharp_view(truth, best)
    return Panels(case.name, best.index, blurred, weights, *images)
