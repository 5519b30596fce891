"""The `rstrack` command. Functions here and beside are its commands, their parameters the commands' arguments."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

from rsgen.console.command_line import Commands, Parser, Quiet, run_program
from rstrack.cli.benchmark import BENCH_STATUS, SCORE_STATUS, bench, score
from rstrack.cli.options import CameraFile, ImuFile, SequenceFolder
from rstrack.cli.results import evaluate, export, map_, report
from rstrack.cli.tracking import CALIBRATE_STATUS, TRACK_STATUS, calibrate, refine, track

_DESCRIPTION = """\
rstrack estimates the continuous-time trajectory of a rolling-shutter RGB-D camera: every row has its own pose.

  rstrack import mine.bag mine                         a ROS bag or another recording becomes a folder to track
  rstrack info out/demo                                what a folder holds: cameras, frames, truth
  rstrack track out/demo --out runs/demo               track it; the trajectory is in runs/demo
  rstrack calibrate out/demo --out camera.yaml         readouts, clocks and extrinsics out of the recording itself
  rstrack refine runs/demo --out runs/refined          every frame against all that overlap it: slow, accurate
  rstrack evaluate out/demo runs/demo                  errors against the ground truth
  rstrack report runs/demo                             tables, plots and the path as one HTML page, or a picture
  rstrack map out/demo runs/demo --out mesh.ply        the observed surfaces as a coloured mesh
  rstrack evaluate out/demo mesh.ply                   its distance from the scene
  rstrack export runs/demo covariance --out demo.cov   for other tools: poses with their covariances, keyframes
  rstrack bench --quick                                every method on some sequences, beside the paper's figures
  rstrack score suite results --out board              anybody's trajectories of a suite: errors, a leaderboard

A sequence is a folder that 'rsgen render' wrote, or a TUM RGB-D, ICL-NUIM or 7-Scenes folder; the first two of those
need their cameras in a camera.yaml, calibration.yaml or camchain.yaml inside, or in the file that --camera names.
"""
# What became of commands that were.
_MOVED = {
    "plot": "report RUN --sequence SEQ --out FILE.png",
    "map-eval": "evaluate SEQ MESH",
    "keyframes": "export RUN keyframes --sequence SEQ --out DIR",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status: 0 done, 1 frames lost, 2 wrong input, 130 interrupted."""
    return run_program("rstrack", _parser, arguments, "nothing was written", _MOVED)


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
    add(import_, "mine.bag mine --color /camera/color/image_raw --device realsense-d435")
    add(info, "out/lr_kt2")
    add(calibrate, "recording --out camera.yaml", note=CALIBRATE_STATUS)
    add(track, "out/lr_kt2 --method rs-pg --out runs/lr_kt2 --frames 0:300 --noise-depth 1.2e-3", note=TRACK_STATUS)
    add(refine, "runs/table1 --out runs/table1-refined")
    add(evaluate, "out/lr_kt2 runs/lr_kt2 --json", "out/lr_kt2 lr_kt2.ply", "truth.txt estimate.txt")
    add(report, "runs/lr_kt2 --sequence out/lr_kt2", "runs/lr_kt2 --out lr_kt2.png")
    add(map_, "out/lr_kt2 runs/lr_kt2 --out lr_kt2.ply --every 5")
    add(export, "runs/lr_kt2 covariance --out lr_kt2.cov", "runs/table1 keyframes --out keyframes")
    add(bench, "--data out --out out/bench --sequence robot_t1 robot_r1 --method baseline rs-pg", note=BENCH_STATUS)
    add(score, "suite results runs/demo --out board", "suite results --out board --only small", note=SCORE_STATUS)
    return commands.parser


def import_(
    file: Annotated[
        Path,
        "ROS 1 or 2 bag, MCAP, RealSense .bag or .db3, ScanNet .sens, Record3D .r3d, Stray Scanner's or EuRoC's folder",
    ],
    out: Annotated[Path, "folder to write, which 'rstrack track' reads"],
    *,
    color: Annotated[str | None, "topic of the colour images (default: found by types and names)", "TOPIC"] = None,
    depth: Annotated[
        str | None, "topic of the depth images (default: found; the sensor's own before registered)", "TOPIC"
    ] = None,
    color_info: Annotated[str | None, "topic of colour's camera_info (default: the one beside it)", "TOPIC"] = None,
    depth_info: Annotated[str | None, "topic of depth's camera_info (default: the one beside it)", "TOPIC"] = None,
    device: Annotated[
        str | None,
        "camera whose published readouts to write where the recording has none, for example realsense-d435; any other "
        "word lists them",
        "NAME",
    ] = None,
    confidence: Annotated[Literal["0", "1", "2"], "least confidence of ARKit's depth that is kept", "0|1|2"] = "1",
    force: Annotated[bool, "replace a folder that was imported before"] = False,
    quiet: Quiet = False,
) -> int:
    """Turn a recording of another format into a folder that can be tracked: images, stamps, cameras, truth, IMU."""
    from rsgen.console.progress import ProgressDisplay
    from rstrack.calibration.devices import device_named
    from rstrack.formats import open_recording
    from rstrack.formats.folder import check_place, write_folder
    from rstrack.formats.recording import ReadOptions

    known = None if device is None else device_named(device)
    check_place(out, force)
    recording = open_recording(file, ReadOptions(color, depth, color_info, depth_info, int(confidence)))
    readout_s = (None, None) if known is None else (known.color.readout_s, known.depth.readout_s)
    with ProgressDisplay(quiet) as progress:
        written = write_folder(recording, out, file=file.name, readout_s=readout_s, force=force, progress=progress)
    print(written.text())
    if written.unknown:
        named = f" --device {device}" if device else ""
        print(
            f"nothing states the readout of {' and '.join(written.unknown)}: "
            f"rstrack calibrate {out} --out {out / 'camera.yaml'}{named}"
        )
    print(f"{out}: ready (rstrack track {out} --out RUN)")
    return 0


def info(sequence: SequenceFolder, *, camera: CameraFile = None, imu: ImuFile = None) -> int:
    """Describe a folder that can be tracked: cameras, shutters, frames, IMU, truth."""
    from rstrack.cli.info import describe
    from rstrack.data.dataset import open_dataset

    print(describe(open_dataset(sequence, camera, imu)))
    return 0
