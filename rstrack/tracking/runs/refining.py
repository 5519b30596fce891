"""`rstrack refine`: a run's spline refined over the whole recording, into a run folder of its own.

result = refine_run(Path("runs/table1"), Path("runs/table1-refined"))
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from scipy.special import chdtri

from rsgen.console.progress import Progress, no_progress
from rsgen.device.arrays import engine
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.spline import Spline
from rstrack.data.dataset import Dataset
from rstrack.data.estimate import INFO, Estimate, write_estimate
from rstrack.data.image_files import prefetched, with_noise
from rstrack.data.rig import Frame
from rstrack.inertial import estimate as inertial_estimate
from rstrack.metrics.association import truth_of
from rstrack.metrics.consistency import HORIZONS_S, covariances, motion_covariance, motion_errors, step_nees
from rstrack.metrics.evaluate import pairs_apart
from rstrack.metrics.run_evaluate import RunEvaluation, evaluated, load_run
from rstrack.options import Options
from rstrack.tracking.runs.record import Noise

if TYPE_CHECKING:
    from rstrack.adjustment.imu import ImuTerm
    from rstrack.adjustment.refine import Refiner, Round, TypicalScales
    from rstrack.images.device_frame import DeviceFrame

Kind = TypeVar("Kind", Options, Noise)

# Scales to begin with where a run does not tell any: depth at one metre (m), intensity.
_USUAL_DEPTH, _USUAL_INTENSITY = 2e-3, 0.015
_NOT_LOOKED_AT = (
    "the IMU was not looked at (it has no gyroscope, or no samples of these frames): where images tell little, over "
    "gaps and at bare walls, keep the run"
)
# Chance of a motion that counts as ruled out.
_RULED_OUT = 0.01
# Rounding of times.
_SLACK_S = 1e-6
# Distance (m) that things are taken to have had in the run: the first round is told better.
_TYPICAL_M = 1.5


@dataclass(frozen=True)
class Refined:
    """estimate: refined. rounds: what each did. before, after: errors, None without a truth. imu: a line on it, if the
    run used one. kept: why the run is given back as it was, if so."""

    estimate: Estimate
    rounds: list[dict[str, Any]]
    before: RunEvaluation | None
    after: RunEvaluation | None
    seconds: float
    imu: str = ""
    kept: str = ""

    def text(self) -> str:
        """A summary of a few lines."""
        moved, lines = ", ".join(f"{1e3 * r['moved_m']:.3f}" for r in self.rounds), []
        if self.rounds:
            last = self.rounds[-1]
            lines.append(
                f"{len(self.rounds)} rounds in {self.seconds:.0f} s: {last['keyframes']} keyframes, {last['pairs']} "
                f"pairs of a frame and a keyframe; poses moved by up to {moved} mm"
            )
        lines += [line for line in (self.imu, self.kept) if line]
        if self.before is not None and self.after is not None:
            lines += [f"ATE before {1e3 * self.before.metrics.ate_rmse_m:.3f} mm", "", self.after.text()]
        return "\n".join(lines)


def refine_run(
    run: Path, out: Path, sequence: Path | None = None, camera_file: Path | None = None, rounds: int = 3,
    progress: Progress = no_progress, imu_file: Path | None = None,
) -> Refined:  # fmt: skip
    """Refine the run of a spline tracker and write the result, a run folder: `out`, which may not be `run` itself.

    sequence, camera_file: as in `load_run`. rounds: at most. imu_file: what describes the IMU of a run that used one;
    without it as the run had it. Raises UserError.
    """
    if out.resolve() == run.resolve():
        raise UserError(f"{out}: is the run itself: choose another --out, so that both remain")
    if rounds < 1:
        raise UserError(f"--rounds {rounds}: at least one round is needed")
    begin = time.perf_counter()
    tracked = load_run(run, sequence, camera_file)
    dataset, estimate = tracked.dataset, tracked.estimate
    if dataset is None:
        raise UserError(f"{run}: {tracked.notes[0][0].lower()}{tracked.notes[0][1:]}")
    if estimate.spline is None:
        raise UserError(f"{run}: has no spline, so there is nothing to refine: track with one of the rs or gs methods")
    options = _settings(estimate.info, run, "options", Options).decided(dataset.rig.depth_shutter)
    noise = _settings(estimate.info, run, "noise", Noise)
    if imu_file is not None and not options.inertial:
        raise UserError(f"--imu {imu_file}: {run} is of {options.method}, which uses no IMU: track with one that does")
    dataset = dataset if imu_file is None else dataset.with_imu_file(imu_file)
    refiner = _refiner(dataset, estimate, options, noise, run)
    spline, kept = estimate.spline, outweighed(estimate)
    done: list[Round] = []
    if not kept:
        try:
            spline, done = refiner.refined(estimate.spline, rounds, progress)
        except np.linalg.LinAlgError as error:
            raise UserError(f"{run}: cannot be refined: {error}") from None
        kept = contradiction(estimate, spline)
    if kept:
        spline = estimate.spline
    moved = spline.pose(estimate.stamps) @ se3.inverse(estimate.spline.pose(estimate.stamps))
    told = [asdict(r) for r in done]
    seconds = time.perf_counter() - begin
    info = estimate.info | {"refined": {"of": str(run.resolve()), "rounds": told, "seconds": seconds, "kept": kept}}
    if isinstance(recorded := info.get("dataset"), dict):
        info["dataset"] = recorded | {"camera": dataset.cameras}
    poses = estimate.T_world_depth if kept else se3.orthonormalise(moved @ estimate.T_world_depth)
    imu = _NOT_LOOKED_AT if options.inertial else ""
    if refiner.imu is not None and refiner.found is not None and not kept:
        imu_estimate = inertial_estimate.estimate_dict(refiner.found.estimate, refiner.imu.sigma)
        info["imu"] = (estimate.info.get("imu") or {}) | imu_estimate | refiner.found.as_dict()
        imu = f"{inertial_estimate.refined_text(imu_estimate)}, {refiner.found.text(refiner.imu.recording.T_imu_depth)}"
    result = Estimate(estimate.stamps, poses, spline, info, estimate.moving)
    truth = truth_of(dataset)
    before, after = (evaluated(truth, each) for each in (estimate, result))
    info["metrics"] = None if after is None else after.metrics.as_dict()
    info["truth_offset"] = None if after is None else after.truth_offset
    write_estimate(out, result.stamps, result.T_world_depth, spline, info, estimate)
    result.moving.write(out, range(len(dataset)))
    return Refined(result, told, before, after, seconds, imu, kept)


def outweighed(estimate: Estimate) -> str:
    """Why refining a run is of no use: over a second its camera file may be further off than its noise; else empty.

    Refining averages noise. What all images have wrong alike it does not take away, but may bend the track by it.
    """
    T, known = estimate.T_world_depth, covariances(estimate)
    i, j = pairs_apart(estimate.stamps, HORIZONS_S[1])
    both = motion_covariance(T, known, i, j)
    noise = motion_covariance(T, replace(known, common=np.zeros_like(known.common)), i, j)
    finite = np.isfinite(both).all(axis=(1, 2))
    if not finite.any():
        return ""
    camera_mm, noise_mm = (
        1e3 * float(np.sqrt(np.median(np.trace(C[finite][:, :3, :3], axis1=1, axis2=2)))) for C in (both - noise, noise)
    )
    if camera_mm <= noise_mm:
        return ""
    return (
        f"given back as it was: errors of the camera file may move it by {camera_mm:.1f} mm over a second, noise, all "
        f"that refining averages, by {noise_mm:.1f} mm: find the camera (rstrack calibrate) and track again with it"
    )


def contradiction(estimate: Estimate, spline: Spline) -> str:
    """Why a run's refined spline is not to be had: most of its motions are ones that the run rules out; else empty.

    A wrong camera bends a track until all of it fits, and its own cost cannot tell; the run's covariances, which know
    that the camera may be wrong, can.
    """
    stamps, T = estimate.stamps, estimate.T_world_depth
    assert estimate.spline is not None
    refined = spline.pose(stamps) @ se3.inverse(estimate.spline.pose(stamps)) @ T
    for seconds in HORIZONS_S[:2]:
        i, j = pairs_apart(stamps, seconds)
        C = motion_covariance(T, covariances(estimate), i, j)
        known = np.isfinite(C).all(axis=(1, 2))
        if not known.any():
            continue
        off = 6.0 * step_nees(motion_errors(T, refined, i[known], j[known]), C[known])
        if np.median(off) > chdtri(6, _RULED_OUT):
            return (
                f"given back as it was: most motions over {seconds:g} s became ones that the run rules out (99 %): is "
                "the camera file right? (rstrack calibrate)"
            )
    return ""


# ---------------------------------------------------------------------------------------------------------------------


def _settings(info: dict[str, Any], run: Path, name: str, kind: type[Kind]) -> Kind:
    """Options or noise as the run had them."""
    had = info.get(name)
    if not isinstance(had, dict):
        raise UserError(f"{run / INFO}: does not say with what {name} it was tracked: track again")
    known = {item.name for item in fields(kind)}
    try:
        return kind(**{key: value for key, value in had.items() if key in known})
    except (TypeError, UserError) as error:
        raise UserError(f"{run / INFO}: {name}: {error}") from None


def _refiner(dataset: Dataset, estimate: Estimate, options: Options, noise: Noise, run: Path) -> Refiner:
    engine(options.backend)
    # After the engine: it chooses the libLLVM that Dr.Jit loads.
    from rstrack.adjustment.refine import Refiner
    from rstrack.alignment.linearise import Terms
    from rstrack.images.device_frame import DeviceRig, frame_without
    from rstrack.keyframes.maker import KeyframeMaker

    device = DeviceRig(dataset.rig, options)
    color_s = _span_s(dataset.rig.color_camera, dataset.rig.color_shutter)

    def load(numbers: Sequence[int]) -> Iterator[DeviceFrame]:
        def read(k: int) -> Frame:
            frame, problems = dataset.readable_frame(k, color=options.photometric)
            if frame is None:
                raise UserError(f"{problems[0]}, though it could be read before")
            colors = tuple(c for c in frame.colors if _is_covered(estimate, c.stamp, color_s))
            return with_noise(replace(frame, colors=colors), k, noise.sigma_depth, noise.sigma_intensity, noise.seed)

        for k, frame in zip(numbers, prefetched(read, numbers, 2), strict=True):
            uploaded, mask = device.upload(k, frame), estimate.moving.grid(k)
            yield uploaded if mask is None else frame_without(device.e, uploaded, mask, estimate.moving.stride)

    numbers = _known_frames(dataset, estimate)
    if len(numbers) < 2:
        raise UserError(f"{run}: its spline knows no two frames of {dataset.root}: is it that recording's?")
    times = np.asarray(dataset.stamps)[numbers] + 0.5 * dataset.rig.depth_shutter.readout_s
    terms, maker = Terms.of(device, options), KeyframeMaker.of(device)
    begin = float(estimate.stamps[0])
    unit = _unit(dataset, estimate, options)
    return Refiner(terms, maker, options, numbers, times, begin, load, _usual(estimate.info), unit)


def _unit(dataset: Dataset, estimate: Estimate, options: Options) -> ImuTerm | None:
    """The IMU of a run that used one, as far as its spline is known. None without a gyroscope: as when tracking, an
    accelerometer alone is to change nothing."""
    from rstrack.adjustment.imu import ImuTerm

    if not options.inertial or estimate.spline is None:
        return None
    if dataset.imu is None:
        raise UserError(f"{dataset.root}: has no IMU, which method {options.method} of the run needs")
    valid = estimate.info.get("spline_valid") or [[estimate.spline.t_begin, estimate.spline.t_end]]
    return ImuTerm.of(dataset.imu, estimate.spline, np.array(valid, np.float64).reshape(-1, 2))


def _known_frames(dataset: Dataset, estimate: Estimate) -> list[int]:
    """Frames that were tracked, of whose depth all lines are where the spline is known."""
    tracked = {round(float(stamp), 6) for stamp in estimate.stamps}
    depth_s = _span_s(dataset.rig.depth_camera, dataset.rig.depth_shutter)
    return [
        k for k, stamp in enumerate(dataset.stamps)
        if round(float(stamp), 6) in tracked and _is_covered(estimate, float(stamp), depth_s)
    ]  # fmt: skip


def _span_s(camera: Camera, shutter: Shutter) -> float:
    """Seconds from the first line to the last."""
    return (shutter.line_count(camera) - 1) * shutter.line_delay(camera)


def _is_covered(estimate: Estimate, stamp: float, span_s: float) -> bool:
    """Whether the spline is known for all lines of an image; of the last frame's colours it often is not."""
    first, last = stamp + _SLACK_S, stamp + span_s - _SLACK_S
    return bool(estimate.spline_covers([first, 0.5 * (first + last), last]).all())


def _usual(info: dict[str, Any]) -> TypicalScales:
    """Scales of residuals as the run had them, of depth as if it were at one metre."""
    from rstrack.adjustment.refine import TypicalScales

    frames = [f for f in info.get("frames", ()) if isinstance(f, dict)]
    of = {
        name: [f[name] for f in frames if isinstance(f.get(name), float)]
        for name in ("sigma_depth_m", "sigma_intensity")
    }
    return TypicalScales(
        float(np.median(of["sigma_depth_m"])) / _TYPICAL_M**2 if of["sigma_depth_m"] else _USUAL_DEPTH,
        float(np.median(of["sigma_intensity"])) if of["sigma_intensity"] else _USUAL_INTENSITY,
    )
