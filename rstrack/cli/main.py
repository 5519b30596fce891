"""The `rstrack` command: every function here and beside is a command, its parameters are the command's arguments."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import cache
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from rsgen.console.command_line import Alone, Commands, Frames, Json, Parser, Quiet, run_program
from rsgen.errors import UserError
from rstrack.cli.benchmark import STATUS as BENCH_STATUS
from rstrack.cli.benchmark import bench
from rstrack.cli.calibrate import STATUS as CALIBRATE_STATUS
from rstrack.cli.calibrate import calibrate
from rstrack.cli.importing import import_
from rstrack.cli.mapping import keyframes, map_, map_eval
from rstrack.cli.options import (
    CameraFile,
    DeviceName,
    ImuFile,
    NoiseDepth,
    NoiseIntensity,
    Run,
    Seed,
    SequenceFolder,
    TruthExtrinsics,
    TruthNoise,
    TruthOffset,
)
from rstrack.cli.refine import refine
from rstrack.cli.report import report
from rstrack.options import Options

if TYPE_CHECKING:
    from rstrack.data.dataset import Dataset
    from rstrack.view.viewer import Viewer

_DESCRIPTION = """\
rstrack estimates the continuous-time trajectory of a rolling-shutter RGB-D camera: every line has its own pose.

  rstrack import mine.bag mine                         a folder of a ROS bag, or of what other recorders write
  rstrack info out/demo                                what would be tracked
  rstrack track out/demo --out runs/demo               track it; the trajectory is in runs/demo
  rstrack calibrate out/demo --out camera.yaml         readouts, clocks and extrinsics out of the recording itself
  rstrack refine runs/demo --out runs/refined          every frame against all that saw the same: slow, and the best
  rstrack evaluate out/demo runs/demo                  errors against the ground truth
  rstrack export runs/demo covariance --out demo.cov   poses with their covariances, for smfeval
  rstrack plot out/demo runs/demo --out demo.png       path and errors as a picture
  rstrack report runs/demo                             all of it as one HTML page
  rstrack map out/demo runs/demo --out mesh.ply        the surfaces that it saw, as a coloured mesh
  rstrack bench --quick                                every method on some sequences, beside the paper's figures

A sequence is a folder that 'rsgen render' wrote, or a TUM RGB-D, ICL-NUIM or 7-Scenes folder; the first two of those
need their cameras in a camera.yaml, calibration.yaml or camchain.yaml inside, or in the file that --camera names.
"""
_STATUS = (
    "exit status: 0 done, 1 frames were lost or cannot be read, 2 wrong input, 130 interrupted (what there is has been "
    "written)"
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status: 0 done, 1 frames lost, 2 wrong input, 130 interrupted."""
    return run_program("rstrack", _parser, arguments, "nothing was written")


class _Version(argparse.Action):
    """Prints the version: reading the package's metadata takes time that other commands need not spend."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any, **__: Any) -> None:
        from importlib.metadata import version

        print(f"rstrack {version('rolling-shutter-rgbd')}")
        parser.exit()


@cache  # of some hundred options: whoever calls `main` often would wait for it each time
def _parser() -> Parser:
    commands = Commands("rstrack", _DESCRIPTION)
    commands.parser.add_argument(
        "--version", action=_Version, nargs=0, default=argparse.SUPPRESS, help="print the version and exit"
    )
    add = commands.add
    add(track, "out/lr_kt2 --method rs-pg --out runs/lr_kt2 --frames 0:300 --noise-depth 1.2e-3", _STATUS)
    add(calibrate, "recording --out camera.yaml", CALIBRATE_STATUS)
    add(refine, "runs/table1 --out runs/table1-refined")
    add(evaluate, "out/lr_kt2 runs/lr_kt2 --json")
    add(plot, "out/lr_kt2 runs/lr_kt2 --out lr_kt2.png")
    add(export, "runs/lr_kt2 covariance --out lr_kt2.cov")
    add(info, "out/lr_kt2")
    add(import_, "mine.bag mine --color /camera/color/image_raw --device realsense-d435")
    add(report, "runs/lr_kt2 --sequence out/lr_kt2")
    add(map_, "out/lr_kt2 runs/lr_kt2 --out lr_kt2.ply --every 5")
    add(map_eval, "lr_kt2.ply out/lr_kt2/scene.ply")
    add(keyframes, "out/table1 runs/table1 --out keyframes")
    add(bench, "--data out --out out/bench --sequence robot_t1 robot_r1 --method baseline rs-pg", BENCH_STATUS)
    return commands.parser


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
        bool, "write the trajectory in a world whose z axis points up, as an IMU tells (rs-pgi, rs-gi)"
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
    from rstrack.calibration.findings.record import CALIBRATION, write_record
    from rstrack.calibration.run import calibrate as run_calibration
    from rstrack.calibration.unknowns.devices import device_named
    from rstrack.data.calibration_sigma import UNDISTORTED_K1
    from rstrack.data.dataset import open_dataset
    from rstrack.tracking.runs import run

    if device is not None and not calibrate:
        raise UserError(f"--device {device}: is for --calibrate, which is not given")
    if resume and calibrate:
        raise UserError("--resume --calibrate: 'rstrack calibrate --out camera.yaml' first, and track with --camera")
    tracker = replace(tracker, loops=tracker.loops or "end")
    known = None if device is None else device_named(device)
    noise = run.Noise(noise_depth, noise_intensity, seed)
    dataset = open_dataset(sequence, camera, imu)
    with ProgressDisplay(quiet) as progress:
        found = None
        if calibrate:
            found = run_calibration(dataset, None, frames or slice(None), tracker, progress, known)
            if not found.solution.finished:
                raise KeyboardInterrupt
            dataset = found.calibrated()
        with _viewed(view, dataset) as viewer:
            watch = None if viewer is None else viewer.see
            result = run.track(dataset, tracker, out, frames or slice(None), noise, progress, resume, watch, gravity)
            if viewer is not None:
                viewer.corrected(result.estimate.T_world_depth)
    (out / CALIBRATION).unlink(missing_ok=True)  # of an earlier run in this folder
    if found is not None:
        atomic_write(out / "camera.yaml", found.camera_file().encode())
        write_record(found, out / CALIBRATION)
        print(found.text())
    print(result.text())
    if found is None and dataset.rig.sigma.k1 >= UNDISTORTED_K1:
        print(
            "the camera file has no distortion, which hardly any camera is without: --calibrate finds lens, clocks and "
            "readouts first"
        )
    print(f"{out}: written (rstrack evaluate {sequence} {out}, rstrack plot ...)")
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
    from rstrack.view.viewer import open_view

    return open_view(None if view == Path() else view, dataset.rig, dataset.name)


def evaluate(
    sequence: Annotated[Path, "rsgen sequence, TUM RGB-D, ICL-NUIM or 7-Scenes folder; or a TUM file of true poses"],
    run: Run,
    *,
    camera: CameraFile = None,
    truth_offset: TruthOffset = None,
    truth_extrinsics: TruthExtrinsics = None,
    truth_noise: TruthNoise = None,
    against: Annotated[
        Path | None,
        "another run of the sequence: ends with one line that compares the two, for example of gs-pg",
        "RUN",
    ] = None,
    json: Json = False,
) -> int:
    """Errors of a run against the ground truth: ATE, drift per second, lines' poses, and whether the run's covariances
    are as large."""
    from rstrack.metrics.evaluate import compared
    from rstrack.metrics.run_evaluate import run_evaluate

    how = camera, truth_offset, truth_extrinsics, truth_noise
    ours = run_evaluate(sequence, run, *how)
    theirs = None if against is None else run_evaluate(sequence, against, *how)
    if json:
        print(dumps(ours.as_dict() | ({"against": theirs.as_dict()} if theirs else {}), indent=2))
    else:
        print(ours.text())
        if against is not None and theirs is not None:
            print(f"\n{compared(run, ours.chosen, against, theirs.chosen)}")
    return 0


def plot(
    sequence: SequenceFolder,
    run: Run,
    *,
    camera: CameraFile = None,
    truth_offset: TruthOffset = None,
    out: Annotated[Path, "png, pdf or svg file to write", "FILE"],
) -> int:
    """Picture of a run: path, errors over time, inliers."""
    from rstrack.charts.runs import run_plot

    run_plot(sequence, run, out, camera, truth_offset)
    print(f"{out}: written")
    return 0


def export(
    run: Annotated[Path, "folder that 'rstrack track' wrote"],
    what: Annotated[
        Literal["covariance"],
        "covariance: TUM lines with the pose's covariance against the first frame, in the depth camera's frame, as "
        "smfeval reads them",
        "covariance",
    ],
    *,
    out: Annotated[Path, "file to write", "FILE"],
) -> int:
    """Write what a run knows of itself for other tools."""
    from rstrack.metrics.covariance_file import write_covariances

    print(f"{out}: {write_covariances(run, out)} poses written")
    return 0


def info(sequence: SequenceFolder, *, camera: CameraFile = None, imu: ImuFile = None) -> int:
    """Say what would be tracked: cameras, shutters, frames, an IMU, truth."""
    from rstrack.cli.info import describe
    from rstrack.data.dataset import open_dataset

    print(describe(open_dataset(sequence, camera, imu)))
    return 0
