"""One tracking run: a dataset's frames through a tracker into a run folder.

result = track(open_dataset(Path("out/lr_kt2")), Options(method="rs-pg"), Path("runs/lr_kt2"))
print(result.text())
"""

from __future__ import annotations

import dataclasses
import os
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError
from rsgen.files import write_error
from rsgen.geometry.spline import Spline
from rstrack.data.dataset import Dataset
from rstrack.data.estimate import Estimate, write_estimate
from rstrack.data.noise import with_noise
from rstrack.data.prefetch import prefetched
from rstrack.data.rig import Frame, Rig
from rstrack.data.timing import Timing
from rstrack.metrics.association import Truth, compare, truth_of
from rstrack.metrics.evaluate import Metrics
from rstrack.metrics.run_evaluate import Evaluation, evaluate_clocks
from rstrack.options import Options

if TYPE_CHECKING:
    from rstrack.images.device_frame import Timer
    from rstrack.tracking.frame_report import FrameReport


End = Literal["done", "interrupted", "broke down"]

# Frames after which the error so far is shown anew, at least, and the factor by which they have grown by then: it takes
# as long as there are frames.
_TRUTH_EVERY, _TRUTH_GROWTH = 30, 1.05
# Observability (see FrameReport) below which a motion is held by the prior rather than by depth.
_WEAK = 5e-4
# Files that mark a folder as a data set, which a run folder's spline.npz must not overwrite.
_DATASET_FILES = ("sequence.yaml", "rgb.txt", "depth.txt", "associations.txt", "groundtruth.txt")


class AnyTracker(Protocol):
    """What all trackers have in common. reports: of all frames so far; options: with all that depends on the rig."""

    reports: list[FrameReport]
    options: Options

    @property
    def keyframes(self) -> int:
        """How many there have been."""

    @property
    def spline(self) -> Spline | None:
        """T_world_depth(t) so far, None where there is none."""

    @property
    def spline_valid(self) -> Sequence[tuple[float, float]]:
        """Times (begin, end) in s within which the spline is an estimate."""

    @property
    def trajectory(self) -> tuple[FloatArray, FloatArray]:
        """Stamps (n,) in s of the frames that were not lost and T_world_depth (n, 4, 4) there."""

    def feed(self, frame: Frame) -> FrameReport:
        """Track one frame."""


@dataclass(frozen=True)
class Noise:
    """Noise added to the frames; see `rstrack.data.noise.with_noise`."""

    sigma_depth: float = 0.0
    sigma_intensity: float = 0.0
    seed: int = 0


@dataclass(frozen=True)
class Result:
    """What a run came to.

    end: why it stopped; `error` says where the tracker broke down. evaluation: None without a truth, or with too few
    poses. lost: number of frames. unreadable: what was wrong with each image that was left out; where that was a depth
    image, its frame was. timing: of recordings, how stamps came about.
    """

    estimate: Estimate
    evaluation: Evaluation | None
    end: End
    error: str
    lost: int
    unreadable: tuple[str, ...] = ()
    timing: Timing | None = None

    @property
    def metrics(self) -> Metrics | None:
        """Errors with the truth's clock as it is."""
        return None if self.evaluation is None else self.evaluation.metrics

    def text(self) -> str:
        """A summary of a few lines, with the metrics if there is a truth."""
        info, times = self.estimate.info, self.estimate.info["timings"]
        done, asked = len(info["frames"]), info["dataset"]["frames"][1] - info["dataset"]["frames"][0]
        part = f"{done} frames" if done == asked else f"{done} of {asked} frames"
        lost = f"{self.lost} lost" if self.lost else "none lost"
        rate = done / times["total_s"]
        lines = [
            f"{info['method']} on {info['dataset']['name']}: {part}, {_keyframes(info['keyframes'])}, {lost}",
            f"{times['total_s']:.1f} s, {rate:.1f} frames/s on {info['backend']}; a frame takes "
            f"{times['median_ms']:.1f} ms (median), {times['mean_ms']:.1f} (mean), {times['p95_ms']:.1f} (95 %)",
        ]
        weak = sum(not f["lost"] and 0.0 < f["observability"] < _WEAK for f in info["frames"])
        if weak and info["method"] in ("rs-g", "gs-g", "baseline"):
            lines.append(f"in {weak} of {done} frames the geometry hardly fixes all six degrees of freedom (a wall?)")
        if self.unreadable:
            images = "1 image" if len(self.unreadable) == 1 else f"{len(self.unreadable)} images"
            lines.append(f"left out: {images} that cannot be read, first {self.unreadable[0]}")
        if info.get("checkpoint_error"):
            lines.append(f"cannot be resumed: {info['checkpoint_error']}")
        lines += [f"assumed: {note}" for note in info["dataset"].get("notes", ())]
        lines += [] if self.timing is None else self.timing.lines()
        return "\n".join(lines + ([] if self.evaluation is None else ["", self.evaluation.text()]))


def make_tracker(rig: Rig, options: Options, timer: Timer | None = None) -> AnyTracker:
    """The tracker of options.method; `timer` watches the parts of its work.

    Raises UserError if its backend cannot work on this machine.
    """
    from rsgen.device.arrays import engine

    # Before anything else imports Dr.Jit, which then would choose a libLLVM itself.
    engine(options.backend)
    from rstrack.images.device_frame import untimed

    timer = timer or untimed
    if options.method == "baseline":
        from rstrack.tracking.pose_tracker import BaselineTracker

        return BaselineTracker(rig, options, timer)
    from rstrack.tracking.spline_tracker import Tracker

    return Tracker(rig, options, timer)


def track(
    dataset: Dataset,
    options: Options,
    out: Path,
    frames: slice = slice(None),
    noise: Noise | None = None,
    progress: Progress = no_progress,
    resume: bool = False,
) -> Result:
    """Track frames of a dataset and write the run folder `out`: `write_estimate` says what is in it.

    Images that cannot be read are left out, and their frame with them if they are depth images. Where the run stops
    early, because of an interrupt, what there is gets written. Long runs write down where they are now and then: with
    `resume` such a run goes on from there, to the same bits as one that was never stopped (spline trackers without a
    model). Raises UserError: no such frames, `out` cannot be written or is a dataset, no frame was tracked, a run of
    other settings is to be resumed.
    """
    chosen = _chosen(dataset, frames)
    dataset = _with_color_timed(dataset, chosen, options, progress)
    truth = truth_of(dataset)
    if truth is not None:
        truth = dataclasses.replace(truth, frame_stamps=dataset.stamps[chosen])
    tracker = make_tracker(dataset.rig, options)
    from rstrack.tracking.checkpoint import Done, checkpoint_of  # which imports Dr.Jit

    _make_folder(out)
    noise = noise or Noise()

    def load(k: int) -> tuple[Frame | None, tuple[str, ...]]:
        frame, problems = dataset.readable_frame(k, color=options.photometric)
        if frame is not None:
            frame = with_noise(frame, k, noise.sigma_depth, noise.sigma_intensity, noise.seed)
        return frame, problems

    checkpoint = checkpoint_of(out, dataset, chosen, tracker, dataclasses.asdict(noise))
    done = Done()
    if checkpoint is not None:
        done = checkpoint.resume() if resume else checkpoint.begin()
    elif resume:
        raise UserError(f"{out}: --resume is for spline methods without --reference model: track anew")
    seconds, fed, unreadable = done.seconds, done.fed, done.unreadable
    end: End = "done"
    error, note, told_at = "", "", 0
    begin = time.perf_counter() - done.total_s
    with _stop_flag() as stopped:
        images = prefetched(load, chosen[done.count :], 2)
        for count, k in enumerate(chosen[done.count :], done.count + 1):
            frame, problems = next(images)
            unreadable += [(k, problem) for problem in problems]
            if frame is not None:
                start = time.perf_counter()
                try:
                    tracker.feed(frame)
                except (UserError, np.linalg.LinAlgError) as problem:
                    end, error = "broke down", f"the tracker broke down at frame {k}: {problem}"
                    break
                seconds.append(time.perf_counter() - start)
                fed.append(k)
            if count >= max(told_at + _TRUTH_EVERY, _TRUTH_GROWTH * told_at) or count == len(chosen):
                note, told_at = _error_note(truth, tracker.trajectory), count
            rate = count / (time.perf_counter() - begin)
            progress("tracking", count / len(chosen), f"{rate:.1f} frames/s, {_keyframes(tracker.keyframes)}{note}")
            done.count, done.total_s = count, time.perf_counter() - begin
            if stopped.is_set() and count < len(chosen):
                end = "interrupted"
                break
            if checkpoint is not None:
                checkpoint.save_when_due(done)
        del images  # ends its thread
    if checkpoint is not None and end == "interrupted":
        checkpoint.save(done)
    if not seconds:
        raise UserError(error or f"{unreadable[0][1]}; no other frame of the {len(chosen)} can be read either")
    timings = _timings(time.perf_counter() - begin, seconds)
    info = _settings(dataset, chosen, tracker.options, noise) | {
        "end": end,
        "error": error or None,
        "keyframes": tracker.keyframes,
        "checkpoint_error": (checkpoint.problem if checkpoint is not None else "") or None,
        "unreadable": [{"frame": k, "error": problem} for k, problem in unreadable],
        "lost": sum(report.lost for report in tracker.reports),
        "spline_valid": tracker.spline_valid,
        "timings": timings,
        "frames": _diagnostics(dataset, fed, tracker.reports),
    }
    if dataset.timing is not None:
        info["clocks"] = dataset.timing.as_dict()
    estimate = Estimate(*tracker.trajectory, tracker.spline, info)
    evaluation = _evaluation(truth, estimate)
    info["metrics"] = None if evaluation is None else evaluation.metrics.as_dict()
    info["truth_offset"] = None if evaluation is None else evaluation.truth_offset
    write_estimate(out, estimate.stamps, estimate.T_world_depth, estimate.spline, info)
    if checkpoint is not None and end != "interrupted":
        checkpoint.remove()
    left_out = tuple(problem for _, problem in unreadable)
    return Result(estimate, evaluation, end, error, info["lost"], left_out, dataset.timing)


# ---------------------------------------------------------------------------------------------------------------------


def _chosen(dataset: Dataset, frames: slice) -> range:
    chosen = range(len(dataset))[frames]
    if not len(chosen):
        raise UserError(f"{dataset.root}: has no frame {frames.start}: its frames are 0 to {len(dataset) - 1}")
    return chosen


def _with_color_timed(dataset: Dataset, chosen: range, options: Options, progress: Progress) -> Dataset:
    """The dataset with its colour stamps' offset found, where it is not known, may not be 0 and matters."""
    if dataset.timing is None or not dataset.timing.wants_color_offset or not options.photometric:
        return dataset
    from rstrack.tracking.color_offset import estimate_color_offset

    found = estimate_color_offset(dataset, chosen, options, progress)
    return dataset.with_color_offset(found.offset_s, found.text())


def _make_folder(out: Path) -> None:
    """Complain about the folder before minutes of work, not after."""
    found = next((name for name in _DATASET_FILES if (out / name).exists()), None)
    if found is not None:
        raise UserError(f"{out}: holds a data set ({found}), which a run would overwrite: choose another --out")
    try:
        out.mkdir(parents=True, exist_ok=True)
        if not os.access(out, os.W_OK):
            raise PermissionError(13, "Permission denied")
    except OSError as error:
        raise write_error(out, error) from None


@contextmanager
def _stop_flag() -> Iterator[threading.Event]:
    """Ctrl-C sets the flag instead of breaking off in the middle of a frame; a second one breaks off."""
    flag = threading.Event()
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or before is signal.SIG_IGN:
        yield flag  # signals are the main thread's business; started in the background, Ctrl-C is meant for others
        return

    def ask_to_stop(*_: Any) -> None:
        flag.set()
        signal.signal(signal.SIGINT, before)

    signal.signal(signal.SIGINT, ask_to_stop)
    try:
        yield flag
    finally:
        signal.signal(signal.SIGINT, before)


def _keyframes(count: int) -> str:
    return f"{count} keyframe" + ("" if count == 1 else "s")


def _error_note(truth: Truth | None, poses: tuple[FloatArray, FloatArray]) -> str:
    if truth is None:
        return ""
    try:
        errors = compare(truth, Estimate(*poses)).position_errors_m
    except UserError:
        return ""  # fewer than three poses
    return f", ATE {1e3 * np.sqrt(np.mean(errors**2)):.2f} mm"


def _evaluation(truth: Truth | None, estimate: Estimate) -> Evaluation | None:
    """None also where fewer than three poses have a true counterpart."""
    try:
        return None if truth is None else evaluate_clocks(truth, estimate)
    except UserError:
        return None


def _settings(dataset: Dataset, chosen: range, options: Options, noise: Noise) -> dict[str, Any]:
    from rsgen.device.arrays import engine

    notes = {"notes": list(dataset.notes)} if dataset.notes else {}
    versions = {name: version(name) for name in ("numpy", "scipy", "drjit")}
    return {
        "method": options.method,
        "options": dataclasses.asdict(options),
        "noise": dataclasses.asdict(noise),
        "versions": {"rstrack": version("rolling-shutter-rgbd"), **versions},
        "backend": engine(options.backend).backend,
        "machine": {"cpu_count": os.cpu_count()},
        "dataset": {
            "name": dataset.name, "path": str(dataset.root.resolve()),
            "frames": [chosen.start, chosen.stop], "frames_in_all": len(dataset), **notes,
        },
    }  # fmt: skip


def _timings(total_s: float, seconds: Sequence[float]) -> dict[str, Any]:
    """Of the tracker alone, but for the total; the first frames compile kernels."""
    ms = 1e3 * np.array(seconds)
    return {
        "total_s": total_s,
        "median_ms": float(np.median(ms)),
        "mean_ms": float(ms.mean()),
        "p95_ms": float(np.percentile(ms, 95)),
        "frame_ms": np.round(ms, 3),
    }


def _diagnostics(dataset: Dataset, used: Sequence[int], reports: Sequence[FrameReport]) -> list[dict[str, Any]]:
    """One dict a frame for the plots: `FrameReport`, with inliers as parts of the run's largest number too.

    listed_stamp: as the recording has it, where it was tracked at another one. Of covariances the upper triangle.
    """
    frames = [dataclasses.asdict(report) for report in reports]
    for k, frame in zip(used, frames, strict=True):
        frame |= {name: _upper(frame[name]) for name in ("covariance", "drift")}
        frame["stamp"] = float(dataset.stamps[k])
        if dataset.timing is not None:
            frame["listed_stamp"] = float(dataset.timing.depth.listed[k])
    for stream in ("depth", "color"):
        counts = [frame[f"inliers_{stream}"] for frame in frames]
        most = max(counts)
        for frame, count in zip(frames, counts, strict=True):
            # Not aligned to anything, as the first frame: no inliers to speak of.
            frame[f"inliers_{stream}"] = count / most if most and frame["evaluations"] else None
            frame[f"pixels_{stream}"] = count
    return frames


def _upper(covariance: FloatArray | None) -> FloatArray | None:
    """The upper triangle (21,) of a covariance (6, 6), row by row."""
    return None if covariance is None else covariance[np.triu_indices(6)]
