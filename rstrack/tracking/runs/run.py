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
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError
from rsgen.files import write_error
from rstrack.data.dataset import Dataset
from rstrack.data.estimate import Estimate, write_estimate
from rstrack.data.image_files import prefetched, with_noise
from rstrack.data.rig import Frame
from rstrack.inertial import record as imu_record
from rstrack.metrics.association import Truth, compare, truth_of
from rstrack.metrics.run_evaluate import RunEvaluation, evaluated
from rstrack.options import Options
from rstrack.tracking.any_tracker import AnyTracker, make_tracker
from rstrack.tracking.first_look.looked_at import looked_at
from rstrack.tracking.runs.record import Done, Noise, diagnostics, settings, timings
from rstrack.tracking.runs.result import End, Result, keyframes_text
from rstrack.tracking.runs.segments import Segments, segments_beside

if TYPE_CHECKING:
    from rstrack.tracking.frame_report import FrameReport
    from rstrack.tracking.loop_closing import Closing
    from rstrack.tracking.runs.checkpoint import Checkpoint

Load = Callable[[int], tuple[Frame | None, tuple[str, ...]]]
# Told of each frame that was fed: its number among these, the frame, what became of it, and the tracker.
Watch = Callable[[int, Frame, "FrameReport", AnyTracker], None]

# Frames after which the error so far is shown anew, at least, and the factor by which they have grown by then: it takes
# as long as there are frames.
_TRUTH_EVERY, _TRUTH_GROWTH = 30, 1.05
# Files that mark a folder as a data set, which a run folder's spline.npz must not overwrite.
_DATASET_FILES = ("sequence.yaml", "rgb.txt", "depth.txt", "associations.txt", "groundtruth.txt")


def track(
    dataset: Dataset,
    options: Options,
    out: Path,
    frames: slice = slice(None),
    noise: Noise | None = None,
    progress: Progress = no_progress,
    resume: bool = False,
    watch: Watch | None = None,
    gravity: bool = False,
) -> Result:
    """Track frames of a dataset and write the run folder `out`: `write_estimate` says what is in it.

    Images that cannot be read are left out, and their frame with them if they are depth images. Where the run stops
    early, because of an interrupt, what there is gets written. Long runs write down where they are now and then: with
    `resume` such a run goes on from there, to the same bits as one that was never stopped (spline trackers without a
    model). watch: looks on. gravity: write what an IMU has up as +z. Raises UserError: no such frames, `out` cannot be
    written or is a dataset, no frame was tracked, a run of other settings is to be resumed, no IMU where one is needed.
    """
    asked = time.perf_counter()
    chosen = _chosen(dataset, frames)
    dataset = looked_at(dataset, chosen, options, progress)
    truth = truth_of(dataset)
    if truth is not None:
        truth = dataclasses.replace(truth, frame_stamps=dataset.stamps[chosen])
    noise = noise or Noise()
    load = _loader(dataset, options, noise)
    done = Done()

    def again(index: int) -> Frame:
        return _readable(load(done.fed[index]))

    # Methods without one do not care whether it can be read.
    imu = dataset.imu if options.inertial else None
    if options.inertial and imu is None:
        without = options.method.removesuffix("i")
        raise UserError(f"{dataset.root}: has no IMU, which --method {options.method} needs: take {without}")
    if gravity and not options.inertial:
        raise UserError(f"--gravity: method {options.method} does not tell where down is: take rs-pgi or rs-gi")
    tracker = make_tracker(dataset.rig, options, load=again, interval_s=dataset.interval_s(chosen), imu=imu)
    from rstrack.tracking.loop_tracker import LoopTracker
    from rstrack.tracking.runs.checkpoint import checkpoint_of
    from rstrack.tracking.spline_tracker import Tracker  # these import Dr.Jit

    _make_folder(out)
    checkpoint = checkpoint_of(out, dataset, chosen, tracker, dataclasses.asdict(noise))
    if checkpoint is not None:
        done = checkpoint.resume() if resume else checkpoint.begin()
    elif resume:
        raise UserError(f"{out}: --resume is for spline methods, not for the baseline: track anew")
    begin = time.perf_counter() - done.total_s
    start_s = time.perf_counter() - asked
    segments = segments_beside(tracker, dataset.rig, options, again, dataset.interval_s(chosen), imu)
    end, error = _feed(tracker, segments, load, chosen, done, checkpoint, truth, progress, watch)
    segments.end(tracker.reports)
    if not done.fed:
        raise UserError(error or f"{done.unreadable[0][1]}; no other frame of the {len(chosen)} can be read either")
    closing, end = _closed(tracker, again, end, progress)
    if checkpoint is not None and end == "interrupted" and not segments.found:
        checkpoint.save(done)
    found = tracker.uncorrected if isinstance(tracker, LoopTracker) else tracker
    reports = segments.told(tracker.reports, segments.joined(Estimate(*found.trajectory)))
    info = settings(dataset, chosen, tracker.options, noise) | {
        "end": end,
        "error": error or None,
        "keyframes": tracker.keyframes,
        "checkpoint_error": (checkpoint.problem if checkpoint is not None else "") or None,
        "unreadable": [{"frame": k, "error": problem} for k, problem in done.unreadable],
        "lost": sum(report.lost for report in reports),
        "segments": segments.info(),
        "loops": None if closing is None else closing.info(),
        "spline_valid": tracker.spline_valid,
        "timings": timings(time.perf_counter() - begin, done.seconds) | {"start_s": start_s},
        "frames": diagnostics(dataset, done.fed, reports, _spread(closing)),
    }
    if closing is not None:
        info["timings"]["loops_s"] = closing.seconds
    if dataset.timing is not None:
        info["clocks"] = dataset.timing.as_dict()
    online = Estimate(*found.trajectory, found.spline, info)
    estimate = online if closing is None else _corrected(online, closing)
    unit = ""
    if isinstance(found, Tracker) and (late := found.covariances.color_late)[1] > 0.0:
        info["color_late"] = dict(zip(("seconds", "sigma_s"), late, strict=True))
    if isinstance(found, Tracker) and found.inertia is not None:
        info["imu"] = imu_record.record(found.inertia)
        unit = imu_record.text(info["imu"], dataset.stamps[chosen[0]], sum(r.bridged for r in tracker.reports))
        if gravity:
            online, estimate = _both(_upright, online, estimate)
            info["imu"]["gravity"] = [0.0, 0.0, -float(np.linalg.norm(info["imu"]["gravity"]))]
    online, estimate = _both(segments.joined, online, estimate)
    evaluation, before = evaluated(truth, estimate), None
    info["metrics"] = None if evaluation is None else evaluation.metrics.as_dict()
    info["truth_offset"] = None if evaluation is None else evaluation.truth_offset
    if estimate is not online:
        before = evaluated(truth, online)
        info["metrics_online"] = None if before is None else before.metrics.as_dict()
    write_estimate(
        out, estimate.stamps, estimate.T_world_depth, estimate.spline, info, None if estimate is online else online
    )
    segments.write(out)
    if isinstance(found, Tracker):
        found.left_out.write(out, done.fed)
    if checkpoint is not None and end != "interrupted":
        checkpoint.remove()
    left_out = tuple(problem for _, problem in done.unreadable)
    loops = "" if closing is None else _loops_text(closing, online, estimate, before)
    return Result(
        estimate, evaluation, end, error, info["lost"], left_out, dataset.timing, loops, unit, segments.text()
    )  # fmt: skip


# ---------------------------------------------------------------------------------------------------------------------


def _loader(dataset: Dataset, options: Options, noise: Noise) -> Load:
    """Reads a frame by its number, with noise added; None where its depth cannot be read, and what is wrong with it."""

    def load(k: int) -> tuple[Frame | None, tuple[str, ...]]:
        frame, problems = dataset.readable_frame(k, color=options.photometric)
        if frame is not None:
            frame = with_noise(frame, k, noise.sigma_depth, noise.sigma_intensity, noise.seed)
        return frame, problems

    return load


def _feed(
    tracker: AnyTracker, segments: Segments, load: Load, chosen: range, done: Done, checkpoint: Checkpoint | None,
    truth: Truth | None, progress: Progress, watch: Watch | None,
) -> tuple[End, str]:  # fmt: skip
    """The frames that are not done yet through the tracker, told in `done`; how that ended, and what broke down."""
    note, told_at = "", 0
    begin = time.perf_counter() - done.total_s
    with _stop_flag() as stopped:
        images = prefetched(load, chosen[done.count :], 2)
        for count, k in enumerate(chosen[done.count :], done.count + 1):
            frame, problems = next(images)
            done.unreadable += [(k, problem) for problem in problems]
            if frame is not None:
                start = time.perf_counter()
                try:
                    report = tracker.feed(frame)
                    segments.feed(frame, tracker.reports)
                except (UserError, np.linalg.LinAlgError) as problem:
                    return "broke down", f"the tracker broke down at frame {k}: {problem}"
                done.seconds.append(time.perf_counter() - start)
                done.fed.append(k)
                if watch is not None:
                    try:
                        watch(len(done.fed) - 1, frame, report, tracker)
                    except UserError as problem:  # what was tracked gets written all the same
                        return "broke down", f"--view broke down at frame {k}: {problem}"
            if count >= max(told_at + _TRUTH_EVERY, _TRUTH_GROWTH * told_at) or count == len(chosen):
                note, told_at = _error_note(truth, tracker.trajectory), count
            rate = count / (time.perf_counter() - begin)
            progress("tracking", count / len(chosen), f"{rate:.1f} frames/s, {keyframes_text(tracker.keyframes)}{note}")
            done.count, done.total_s = count, time.perf_counter() - begin
            if stopped.is_set() and count < len(chosen):
                return "interrupted", ""
            if checkpoint is not None and not segments.is_open and not segments.found:
                checkpoint.save_when_due(done)
    return "done", ""


def _readable(loaded: tuple[Frame | None, tuple[str, ...]]) -> Frame:
    """A frame that has been tracked, read once more."""
    frame, problems = loaded
    if frame is None:
        raise UserError(f"{problems[0]}, though it could be read before")
    return frame


def _closed(
    tracker: AnyTracker, load: Callable[[int], Frame], end: End, progress: Progress
) -> tuple[Closing | None, End]:  # fmt: skip
    """What became of loops, where they were asked for; how the run ends after it."""
    from rstrack.tracking.loop_closing import close_loops
    from rstrack.tracking.loop_tracker import LoopTracker
    from rstrack.tracking.spline_tracker import Tracker

    try:
        if isinstance(tracker, LoopTracker):
            return tracker.finished(progress) if end == "done" else tracker.closing, end
        if end == "done" and isinstance(tracker, Tracker) and tracker.options.loops == "end":
            return close_loops(tracker, load, progress), end
    except KeyboardInterrupt:
        return tracker.closing if isinstance(tracker, LoopTracker) else None, "interrupted"
    return None, end


def _spread(closing: Closing | None) -> float:
    """By what the track's own errors were found to be larger than it thought."""
    return 1.0 if closing is None or closing.closed is None else closing.closed.spread


def _corrected(online: Estimate, closing: Closing) -> Estimate:
    if closing.moves is None or online.spline is None:
        return online
    poses = closing.moves.poses(online.spline, online.stamps, online.T_world_depth)
    return Estimate(online.stamps, poses, closing.moves.spline(online.spline), online.info)


def _both(
    change: Callable[[Estimate], Estimate], online: Estimate, estimate: Estimate
) -> tuple[Estimate, Estimate]:  # fmt: skip
    """Both changed; the second may be the first."""
    changed = change(online)
    return changed, changed if estimate is online else change(estimate)


def _upright(estimate: Estimate) -> Estimate:
    """With z up, as its IMU has it."""
    T_upright_world = imu_record.upright(np.array(estimate.info["imu"]["gravity"]))
    spline = None if estimate.spline is None else imu_record.turned(T_upright_world, estimate.spline)
    return Estimate(estimate.stamps, T_upright_world @ estimate.T_world_depth, spline, estimate.info)


def _loops_text(closing: Closing, online: Estimate, estimate: Estimate, before: RunEvaluation | None) -> str:
    moved = np.linalg.norm((estimate.T_world_depth - online.T_world_depth)[:, :3, 3], axis=1)
    was = "" if before is None else f", ATE before {1e3 * before.metrics.ate_rmse_m:.3f} mm"
    return closing.text(float(moved.max(initial=0.0))) + was


def _chosen(dataset: Dataset, frames: slice) -> range:
    chosen = range(len(dataset))[frames]
    if not len(chosen):
        raise UserError(f"{dataset.root}: has no frame {frames.start}: its frames are 0 to {len(dataset) - 1}")
    return chosen


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


def _error_note(truth: Truth | None, poses: tuple[FloatArray, FloatArray]) -> str:
    if truth is None:
        return ""
    try:
        errors = compare(truth, Estimate(*poses)).position_errors_m
    except UserError:
        return ""  # fewer than three poses
    return f", ATE {1e3 * np.sqrt(np.mean(errors**2)):.2f} mm"
