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
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError
from rsgen.files import write_error
from rstrack.data.dataset import Dataset
from rstrack.data.estimate import Estimate, write_estimate
from rstrack.data.image_files import prefetched, with_noise
from rstrack.data.rig import Frame
from rstrack.inertial import estimate as inertial_estimate
from rstrack.options import Options
from rstrack.tracking.any_tracker import AnyTracker, make_tracker
from rstrack.tracking.first_look import looked_at
from rstrack.tracking.frame_report import FrameReport
from rstrack.tracking.loop_closing import Closing, close_loops
from rstrack.tracking.loop_tracker import LoopTracker
from rstrack.tracking.runs.checkpoint import checkpoint_of
from rstrack.tracking.runs.done import Done
from rstrack.tracking.runs.record import End, Noise, Result, Run, keyframes_text, run_info
from rstrack.tracking.runs.segments import segments_beside
from rstrack.tracking.spline_tracker import Tracker

# Called with each frame that was fed: its number among these, the frame, what became of it, and the tracker.
Watch = Callable[[int, Frame, FrameReport, AnyTracker], None]
# A few words on stamps (n,) and poses T_world_depth (n, 4, 4) so far, for the progress line.
Note = Callable[[FloatArray, FloatArray], str]

# Frames after which the note is made anew, at least, and the factor by which they have grown by then: it takes as long
# as there are frames.
_NOTE_EVERY, _NOTE_GROWTH = 30, 1.05
# What there is to say before the first frame has been tracked.
_FIRST_FRAMES = "loading kernels; a machine's first run compiles them, up to a minute"
# Files that mark a folder as a data set, which a run folder's spline.npz must not overwrite.
_DATASET_FILES = ("sequence.yaml", "rgb.txt", "depth.txt", "associations.txt", "groundtruth.txt")


def track(
    dataset: Dataset, options: Options, out: Path, frames: slice = slice(None), noise: Noise | None = None,
    progress: Progress = no_progress, resume: bool = False, watch: Watch | None = None, gravity: bool = False,
    note: Note | None = None,
) -> Result:  # fmt: skip
    """Track frames of a dataset and write the run folder `out`: `write_estimate` says what is in it.

    Images that cannot be read are left out, and their frame with them if they are depth images. Where the run stops
    early, because of an interrupt, what there is gets written. Long runs write checkpoints: with `resume` such a run
    goes on from there, to the same bits as one that was never stopped (spline trackers without a model). gravity: write
    what an IMU has up as +z. Raises UserError: no such frames, `out` cannot be written or is a dataset, no frame was
    tracked, a run of other settings is to be resumed, no IMU where one is needed.
    """
    begin = time.perf_counter()
    chosen = _chosen(dataset, frames)
    dataset = looked_at(dataset, chosen, options, progress)
    run = prepare(dataset, chosen, options, out, noise or Noise(), resume, gravity)
    start_s = time.perf_counter() - begin
    end, error = feed(run, progress, watch, note)
    result = finish(run, end, error, start_s, gravity, progress)
    progress("writing", 0.0, str(out))
    write(run, result, out)
    progress("writing", 1.0, str(out))
    return result


# -- prepare ----------------------------------------------------------------------------------------------------------


def prepare(
    dataset: Dataset, chosen: range, options: Options, out: Path, noise: Noise, resume: bool, gravity: bool
) -> Run:  # fmt: skip
    """A tracker for the dataset's chosen frames, and the folder `out`: checked before minutes of work, not after."""
    if options.inertial and dataset.imu is None:
        without = options.method.removesuffix("i")
        raise UserError(f"{dataset.root}: has no IMU, which --method {options.method} needs: take {without}")
    if gravity and not options.inertial:
        raise UserError(f"--gravity: method {options.method} does not tell where down is: take rs-pgi or rs-gi")
    done = Done()

    def load(k: int) -> tuple[Frame | None, tuple[str, ...]]:
        frame, problems = dataset.readable_frame(k, color=options.photometric)
        if frame is not None:
            frame = with_noise(frame, k, noise.sigma_depth, noise.sigma_intensity, noise.seed)
        return frame, problems

    def again(index: int) -> Frame:
        frame, problems = load(done.fed[index])
        if frame is None:
            raise UserError(f"{problems[0]}, though it could be read before")
        return frame

    interval_s, imu = dataset.interval_s(chosen), dataset.imu if options.inertial else None
    tracker = make_tracker(dataset.rig, options, load=again, interval_s=interval_s, imu=imu)
    segments = segments_beside(tracker, dataset.rig, options, again, interval_s, imu)
    _make_folder(out)
    checkpoint = checkpoint_of(out, dataset, chosen, tracker, dataclasses.asdict(noise))
    if resume and checkpoint is None:
        raise UserError(f"{out}: --resume is for spline methods, not for the baseline: track anew")
    if checkpoint is not None:
        done = checkpoint.resume() if resume else checkpoint.begin()
    return Run(dataset, chosen, noise, tracker, load, segments, checkpoint, done)


def _chosen(dataset: Dataset, frames: slice) -> range:
    chosen = range(len(dataset))[frames]
    if not len(chosen):
        raise UserError(f"{dataset.root}: has no frame {frames.start}: its frames are 0 to {len(dataset) - 1}")
    return chosen


def _make_folder(out: Path) -> None:
    found = next((name for name in _DATASET_FILES if (out / name).exists()), None)
    if found is not None:
        raise UserError(f"{out}: holds a data set ({found}), which a run would overwrite: choose another --out")
    try:
        out.mkdir(parents=True, exist_ok=True)
        if not os.access(out, os.W_OK):
            raise PermissionError(13, "Permission denied")
    except OSError as error:
        raise write_error(out, error) from None


# -- feed -------------------------------------------------------------------------------------------------------------


def feed(run: Run, progress: Progress, watch: Watch | None, note: Note | None) -> tuple[End, str]:
    """The frames that are not done yet through the tracker; how that ended, and what broke down."""
    done, left = run.done, run.chosen[run.done.count :]
    words, noted_at = "", 0
    begin = time.perf_counter() - done.total_s
    with _stop_flag() as stopped:
        images = prefetched(run.load, left, 2)
        for k in left:
            asked = time.perf_counter()
            frame, problems = next(images)
            done.waited.append(time.perf_counter() - asked)
            done.unreadable += [(k, problem) for problem in problems]
            if k == left[0]:
                progress("tracking", done.count / len(run.chosen), _FIRST_FRAMES)
            if frame is not None and (error := _feed_one(run, k, frame, watch)):
                return "broke down", error
            count = done.count + 1
            if note and (count >= max(noted_at + _NOTE_EVERY, _NOTE_GROWTH * noted_at) or count == len(run.chosen)):
                words, noted_at = note(*run.tracker.trajectory), count
            rate = count / (time.perf_counter() - begin)
            keyframes = keyframes_text(run.tracker.keyframes)
            progress("tracking", count / len(run.chosen), f"{rate:.1f} frames/s, {keyframes}{words}")
            done.count, done.total_s = count, time.perf_counter() - begin
            if stopped.is_set() and count < len(run.chosen):
                return "interrupted", ""
            if run.checkpoint is not None and not run.segments.begun:
                run.checkpoint.save_when_due(done)
    return "done", ""


def _feed_one(run: Run, k: int, frame: Frame, watch: Watch | None) -> str:
    """Frame k through the tracker, and through that of the segment which the camera is in; what broke down."""
    start = time.perf_counter()
    try:
        report = run.tracker.feed(frame)
        run.segments.feed(frame, run.tracker.reports)
    except (UserError, np.linalg.LinAlgError) as problem:
        return f"the tracker broke down at frame {k}: {problem}"
    run.done.seconds.append(time.perf_counter() - start)
    run.done.fed.append(k)
    if watch is not None:
        try:
            watch(len(run.done.fed) - 1, frame, report, run.tracker)
        except UserError as problem:  # what was tracked gets written all the same
            return f"--view broke down at frame {k}: {problem}"
    return ""


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


# -- finish -----------------------------------------------------------------------------------------------------------


def finish(run: Run, end: End, error: str, start_s: float, gravity: bool, progress: Progress) -> Result:
    """Close loops, and bring the poses together: corrected, upright, with segments'. start_s: as in run.json."""
    begin, tracker = time.perf_counter(), run.tracker
    run.segments.end(tracker.reports)
    if not run.done.fed:
        unreadable = f"{run.done.unreadable[0][1]}; no other frame of the {len(run.chosen)} can be read either"
        raise UserError(error or unreadable)
    closing, end = _closed(run, end, progress)
    if run.checkpoint is not None and end == "interrupted" and not run.segments.begun:
        run.checkpoint.save(run.done)
    times = {"total_s": run.done.total_s + time.perf_counter() - begin, "start_s": start_s}
    info = run_info(run, closing, times) | {"end": end, "error": error or None}
    found = tracker.uncorrected
    down = np.array(info["imu"]["gravity"]) if gravity and found.inertia is not None else None
    if down is not None:
        info["imu"]["gravity"] = [0.0, 0.0, -float(np.linalg.norm(down))]

    def placed(estimate: Estimate) -> Estimate:
        return run.segments.joined(estimate if down is None else _upright(estimate, down))

    raw = Estimate(*found.trajectory, found.spline, info)
    online, corrected = placed(raw), None
    if closing is not None and closing.moves is not None and raw.spline is not None:
        poses = closing.moves.poses(raw.spline, raw.stamps, raw.T_world_depth)
        corrected = placed(Estimate(raw.stamps, poses, closing.moves.spline(raw.spline), info))
    return Result(
        corrected or online, online if corrected else None, end, error, info["lost"],
        unreadable=tuple(problem for _, problem in run.done.unreadable),
        timing=run.dataset.timing,
        loops="" if closing is None else closing.text(_furthest(online, corrected)),
        imu=_imu_text(run, info),
        segments=run.segments.text(),
    )  # fmt: skip


def _imu_text(run: Run, info: dict[str, Any]) -> str:
    if "imu" not in info:
        return ""
    bridged = sum(report.bridged for report in run.tracker.reports)
    return inertial_estimate.text(info["imu"], run.dataset.stamps[run.chosen[0]], bridged)


def _closed(run: Run, end: End, progress: Progress) -> tuple[Closing | None, End]:
    """What became of loops, where they were asked for; how the run ends after it."""
    tracker = run.tracker
    try:
        if isinstance(tracker, LoopTracker):
            return tracker.finished(progress) if end == "done" else tracker.closing, end
        if end == "done" and isinstance(tracker, Tracker) and tracker.options.loops == "end":
            return close_loops(tracker, run.segments.load, progress), end
    except KeyboardInterrupt:
        return tracker.closing if isinstance(tracker, LoopTracker) else None, "interrupted"
    return None, end


def _upright(estimate: Estimate, down: FloatArray) -> Estimate:
    """With z up, in whose world gravity was `down` (3,)."""
    T_upright_world = inertial_estimate.upright(down)
    spline = None if estimate.spline is None else inertial_estimate.turned(T_upright_world, estimate.spline)
    return Estimate(estimate.stamps, T_upright_world @ estimate.T_world_depth, spline, estimate.info)


def _furthest(online: Estimate, corrected: Estimate | None) -> float:
    """How far (m) a pose was moved at most."""
    if corrected is None:
        return 0.0
    moved = np.linalg.norm((corrected.T_world_depth - online.T_world_depth)[:, :3, 3], axis=1)
    return float(moved.max(initial=0.0))


# -- write ------------------------------------------------------------------------------------------------------------


def write(run: Run, result: Result, out: Path) -> None:
    """The run folder `out`. Raises UserError."""
    estimate = result.estimate
    write_estimate(out, estimate.stamps, estimate.T_world_depth, estimate.spline, estimate.info, result.online)
    run.segments.write(out)
    run.tracker.uncorrected.left_out.write(out, run.done.fed)
    if run.checkpoint is not None and result.end != "interrupted":
        run.checkpoint.remove()
