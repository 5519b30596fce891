"""The commands that estimate: `rstrack track`, `calibrate` and `refine`."""

from __future__ import annotations

import sys
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import partial
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rsgen.console.command_line import Alone, Frames, Json, Quiet
from rsgen.device.backend import Backend
from rsgen.errors import UserError
from rstrack.cli.options import CameraFile, DeviceName, ImuFile, NoiseDepth, NoiseIntensity, Seed, SequenceFolder
from rstrack.cli.results import RunSequence
from rstrack.options import Options

if TYPE_CHECKING:
    from rstrack.data.dataset import Dataset
    from rstrack.view import Viewer

TRACK_STATUS = (
    "exit status: 0 done, 1 frames were lost or cannot be read, 2 wrong input, 130 interrupted (what there is has been "
    "written)"
)


def track(
    sequence: SequenceFolder,
    tracker: Options,
    *,
    camera: CameraFile = None,
    imu: ImuFile = None,
    out: Annotated[Path, "folder for the run, made if need be", "DIR"],
    frames: Frames = None,
    noise_depth: NoiseDepth = 0.0,
    noise_intensity: NoiseIntensity = 0.0,
    seed: Seed = 0,
    calibrate: Annotated[
        bool, "first find lenses, readouts, clocks and extrinsics, as 'rstrack calibrate' does, and track with them"
    ] = False,
    device: DeviceName = None,
    gravity: Annotated[
        bool, "write the trajectory in a world whose z axis points up, as an IMU measures it (rs-pgi, rs-gi)"
    ] = False,
    resume: Annotated[
        bool, "go on with a run of the same settings in DIR that was stopped or killed, to the same bits"
    ] = False,
    view: Annotated[
        Path | None, "watch it in rerun's window: images, residuals, path, keyframes, map; or keep that in FILE.rrd",
        "FILE.rrd", Alone(Path()),
    ] = None,
    quiet: Quiet = False,
) -> int:  # fmt: skip
    """Track a sequence: writes trajectory.txt, spline.npz and run.json; with --calibrate camera.yaml and
    calibration.json too.
    """
    from rsgen.console.progress import ProgressDisplay
    from rsgen.files import atomic_write
    from rstrack.calibration.devices import device_named
    from rstrack.calibration.record import CALIBRATION, camera_file_of, write_record
    from rstrack.calibration.run import calibrate as run_calibration
    from rstrack.data.dataset import open_dataset
    from rstrack.data.rig import UNDISTORTED
    from rstrack.metrics.association import truth_of
    from rstrack.metrics.run_evaluate import add_errors, error_note
    from rstrack.tracking.runs import run
    from rstrack.tracking.runs.record import Noise

    if device is not None and not calibrate:
        raise UserError(f"--device {device}: is for --calibrate, which is not given")
    if resume and calibrate:
        raise UserError("--resume --calibrate: 'rstrack calibrate --out camera.yaml' first, and track with --camera")
    tracker = replace(tracker, loops=tracker.loops or "end")
    known = None if device is None else device_named(device)
    noise, chosen = Noise(noise_depth, noise_intensity, seed), frames or slice(None)
    dataset = open_dataset(sequence, camera, imu)
    with ProgressDisplay(quiet) as progress:
        found = None
        if calibrate:
            found = run_calibration(dataset, None, chosen, tracker, progress, known)
            if not found.solution.finished:
                raise KeyboardInterrupt
            dataset = found.calibrated()
        truth = truth_of(dataset)
        if truth is not None:
            truth = replace(truth, frame_stamps=dataset.stamps[chosen])
        note = partial(error_note, truth)
        with _viewed(view, dataset) as viewer:
            watch = None if viewer is None else viewer.see
            result = run.track(dataset, tracker, out, chosen, noise, progress, resume, watch, gravity, note)
            if viewer is not None:
                viewer.corrected(result.estimate.T_world_depth)
        progress("evaluating", 0.0, "")
        errors = add_errors(out, truth, result.estimate, result.online)
        progress("evaluating", 1.0, "")
    (out / CALIBRATION).unlink(missing_ok=True)  # of an earlier run in this folder
    if found is not None:
        atomic_write(out / "camera.yaml", camera_file_of(found).encode())
        write_record(found, out / CALIBRATION)
        print(found.text())
    print("\n".join(text for text in (result.text(), errors) if text))
    if found is None and dataset.rig.sigma.k1 >= UNDISTORTED["k1"]:
        print(
            "the camera file has no distortion, which hardly any camera is without: --calibrate finds lens, clocks and "
            "readouts first"
        )
    print(f"{out}: written (rstrack evaluate {sequence} {out}, rstrack report {out})")
    sys.stdout.flush()
    if result.end == "interrupted":
        print("rstrack: interrupted; the frames before are in the run folder", file=sys.stderr)
        return 130
    if result.end == "broke down":
        print(f"rstrack: {result.error}; the frames before it are in {out}", file=sys.stderr)
        return 1
    return 1 if result.lost or result.unreadable else 0


def _viewed(view: Path | None, dataset: Dataset) -> AbstractContextManager[Viewer | None]:
    if view is None:
        return nullcontext()
    from rstrack.view import open_view

    return open_view(None if view == Path() else view, dataset.rig, dataset.name)


CALIBRATE_STATUS = (
    "exit status: 0 done, 1 not converged, or the recording does not determine some values, 2 wrong input, "
    "130 interrupted"
)


def calibrate(
    sequence: Annotated[
        tuple[Path, ...], "rsgen sequence, TUM RGB-D, ICL-NUIM or 7-Scenes folder; several: recordings of one camera"
    ],
    *,
    camera: CameraFile = None,
    free: Annotated[
        str | None,
        "what to estimate, of readout, offset, extrinsics, depth, intrinsics (default: the first three; where depth is "
        "registered to colour, intrinsics in place of extrinsics); or imu alone: place, clock, biases and scale of an "
        "IMU",
        "NAMES",
    ] = None,
    device: DeviceName = None,
    imu: ImuFile = None,
    run: Annotated[
        Path | None, "with --free imu: a run of this recording, whose spline is taken; otherwise it is tracked", "RUN"
    ] = None,
    frames: Frames = None,
    backend: Annotated[Backend, "where kernels run"] = "auto",
    noise_depth: NoiseDepth = 0.0,
    noise_intensity: NoiseIntensity = 0.0,
    seed: Seed = 0,
    out: Annotated[Path | None, "camera file to write, for rstrack track --camera", "FILE"] = None,
    report: Annotated[Path | None, "HTML page of the calibration to write", "FILE"] = None,
    json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Find a recording's cameras from its images alone: lenses, readouts, clocks, extrinsics, with standard errors."""
    from rsgen.console.progress import ProgressDisplay
    from rsgen.files import atomic_write
    from rstrack.calibration.devices import device_named
    from rstrack.calibration.record import camera_file_of, content_of, record_of
    from rstrack.calibration.run import calibrate as calibrate_cameras
    from rstrack.calibration.several import check_alike, together
    from rstrack.data.dataset import open_dataset
    from rstrack.report.calibration import calibration_page
    from rstrack.report.page import write_page

    known = None if device is None else device_named(device)
    groups = None if free is None else tuple(name.strip() for name in free.split(",") if name.strip())
    datasets = [open_dataset(path, camera).noisy(noise_depth, noise_intensity, seed) for path in sequence]
    dataset, first = datasets[0], sequence[0]
    if len(datasets) > 1 and (report is not None or json or groups == ("imu",)):
        raise UserError("--report, --json and --free imu: are of one recording: give one")
    check_alike(datasets)
    if groups is not None and "imu" in groups:
        if groups != ("imu",) or device is not None or report is not None:
            raise UserError(
                "--free imu: stands alone, without other names, --device and --report: calibrate the cameras first, "
                "and give what was found as --camera"
            )
        if imu is not None:
            dataset = dataset.with_imu_file(imu)
        return _imu(first, dataset, run, frames or slice(None), Options(backend=backend), out, json, quiet)
    if run is not None or imu is not None:
        raise UserError("--run and --imu: are for --free imu")
    with ProgressDisplay(quiet) as progress:
        each = []
        for one in datasets:
            each.append(
                calibrate_cameras(one, groups, frames or slice(None), Options(backend=backend), progress, known)
            )
            if not each[-1].solution.finished:
                break
        found = together(each) if len(each) > 1 and each[-1].solution.finished else each[-1]
    if out is not None:
        atomic_write(out, camera_file_of(found).encode())
    print(dumps(content_of(found), indent=2) if json else found.text())
    if out is not None and not json:
        print(f"{out}: written (rstrack track {first} --camera {out} --out RUN)")
    if report is not None:
        write_page(calibration_page(record_of(found)), report)
        if not json:
            print(f"{report}: written, open it in a browser")
    sys.stdout.flush()
    if not found.solution.finished:
        print("rstrack: interrupted; this is the best so far", file=sys.stderr)
        return 130
    return 1 if found.undetermined.any() or not found.solution.is_settled else 0


def _imu(
    sequence: Path, dataset: Dataset, run: Path | None, frames: slice, options: Options, out: Path | None, json: bool,
    quiet: bool,
) -> int:  # fmt: skip
    from rsgen.console.progress import ProgressDisplay
    from rsgen.files import atomic_write
    from rstrack.calibration.imu import calibrate_imu, track_of, track_of_run

    if dataset.imu_files is not None:
        dataset.imu_files.description()  # complain before minutes of tracking
    with ProgressDisplay(quiet) as progress:
        followed = track_of(dataset, frames, options, progress) if run is None else track_of_run(run)
        found = calibrate_imu(dataset, followed, progress)
    if out is not None:
        atomic_write(out, found.imu_file().encode())
    print(dumps(found.as_dict(), indent=2) if json else found.text())
    if out is not None and not json:
        print(f"{out}: written (rstrack track {sequence} --imu {out} --out RUN)")
    return 1 if found.undetermined.any() else 0


def refine(
    run: Annotated[Path, "folder that 'rstrack track' wrote, of a method with a spline"],
    *,
    sequence: RunSequence = None,
    camera: CameraFile = None,
    imu: ImuFile = None,
    out: Annotated[Path, "folder for the refined run, made if need be", "DIR"],
    rounds: Annotated[int, "passes at most; fewer where nothing moves any more", "N"] = 3,
    quiet: Quiet = False,
) -> int:
    """Align every frame of a run to all keyframes that see it, at once, beside its IMU: writes a run folder with the
    refined spline."""
    from rsgen.console.progress import ProgressDisplay
    from rstrack.tracking.runs.refining import refine_run

    with ProgressDisplay(quiet) as progress:
        result = refine_run(run, out, sequence, camera, rounds, progress, imu)
    print(result.text())
    print(f"{out}: written")
    return 0
