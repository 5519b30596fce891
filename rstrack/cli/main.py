"""The `rstrack` command: thin wrappers that parse arguments, call one function each and print."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rsgen.console.command_line import Commands, Parser, parse_frames, run_program
from rsgen.errors import UserError
from rstrack.cli.bench import add_benchmarks
from rstrack.cli.bench_methods import add_evaluation
from rstrack.cli.mapping import add_mapping
from rstrack.cli.options import add_options, add_run, add_sequence, number, options_of
from rstrack.cli.report import add_report

_DESCRIPTION = """\
rstrack estimates the continuous-time trajectory of a rolling-shutter RGB-D camera: every line has its own pose.

  rstrack info out/demo                                what would be tracked
  rstrack track out/demo --out runs/demo               track it; the trajectory is in runs/demo
  rstrack evaluate out/demo runs/demo                  errors against the ground truth
  rstrack plot out/demo runs/demo --out demo.png       path and errors as a picture
  rstrack report runs/demo                             all of it as one HTML page
  rstrack map out/demo runs/demo --out mesh.ply        the surfaces that it saw, as a coloured mesh
  rstrack bench --quick                                every method on some sequences, beside the paper's figures

A sequence is a folder that 'rsgen render' wrote, or a TUM RGB-D or ICL-NUIM folder; those need their cameras in a
camera.yaml or calibration.yaml inside, or in the file that --camera names.
"""
_STATUS = "exit status: 0 done, 1 frames were lost, 2 wrong input, 130 interrupted (what there is has been written)"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status: 0 done, 1 frames lost, 2 wrong input, 130 interrupted."""
    return run_program("rstrack", _parser, arguments, "nothing was written")


class _Version(argparse.Action):
    """Prints the version: reading the package's metadata takes time that other commands need not spend."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any, **__: Any) -> None:
        from importlib.metadata import version

        print(f"rstrack {version('rolling-shutter-rgbd')}")
        parser.exit()


def _parser() -> Parser:
    commands = Commands("rstrack", _DESCRIPTION)
    commands.parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")

    track = commands.add(
        "track", _track, "track a sequence: writes trajectory.txt, spline.npz and run.json",
        f"out/lr_kt2 --method rs-pg --out runs/lr_kt2 --frames 0:300 --noise-depth 1.2e-3\n{_STATUS}",
    )  # fmt: skip
    track.formatter_class = argparse.RawDescriptionHelpFormatter
    add_sequence(track)
    track.add_argument("--out", type=Path, required=True, metavar="RUN", help="folder to write")
    track.add_argument("--frames", metavar="A:B", help="only frames A to B-1 (default: all)")
    track.add_argument(
        "--noise-depth", type=number, default=0.0, metavar="S",
        help="add noise of standard deviation S z^2 to depth z in m; a Kinect has 1.2e-3 (default: 0)",
    )  # fmt: skip
    track.add_argument(
        "--noise-intensity", type=number, default=0.0, metavar="S",
        help="add noise of standard deviation S to intensities in [0, 1], for example 0.01 (default: 0)",
    )  # fmt: skip
    track.add_argument("--seed", type=int, default=0, help="of the noise (default: 0)")
    track.add_argument("--quiet", action="store_true", help="no progress")
    add_options(track)

    evaluate = commands.add(
        "evaluate", _evaluate, "errors of a run against the ground truth: ATE, drift per second, lines' poses",
        "out/lr_kt2 runs/lr_kt2 --json",
    )  # fmt: skip
    add_sequence(evaluate)
    add_run(evaluate)
    evaluate.add_argument("--json", action="store_true", help="print machine-readable figures")

    plot = commands.add(
        "plot", _plot, "picture of a run: path, errors over time, inliers", "out/lr_kt2 runs/lr_kt2 --out lr_kt2.png"
    )
    add_sequence(plot)
    add_run(plot)
    plot.add_argument("--out", type=Path, required=True, metavar="FILE", help="png, pdf or svg file to write")

    info = commands.add("info", _info, "say what would be tracked: cameras, shutters, frames, truth", "out/lr_kt2")
    add_sequence(info)

    add_report(commands)
    add_mapping(commands)
    add_evaluation(commands)
    add_benchmarks(commands)
    return commands.parser


def _track(options: argparse.Namespace) -> int:
    from rsgen.console.progress import ProgressDisplay
    from rstrack.data.dataset import open_dataset
    from rstrack.tracking.run import Noise, track

    tracker_options, frames = options_of(options), parse_frames(options.frames)
    noise = Noise(options.noise_depth, options.noise_intensity, options.seed)
    dataset = open_dataset(options.sequence, options.camera)
    with ProgressDisplay(options.quiet) as progress:
        result = track(dataset, tracker_options, options.out, frames, noise, progress)
    print(result.text())
    print(f"{options.out}: written (rstrack evaluate {options.sequence} {options.out}, rstrack plot ...)")
    sys.stdout.flush()
    if result.end == "interrupted":
        print("rstrack: interrupted; the frames before are in the run folder", file=sys.stderr)
        return 130
    if result.end == "unreadable":
        raise UserError(f"{result.error}; the frames before it are in {options.out}")
    if result.end == "broke down":
        print(f"rstrack: {result.error}; the frames before it are in {options.out}", file=sys.stderr)
        return 1
    return 1 if result.lost else 0


def _evaluate(options: argparse.Namespace) -> int:
    from rstrack.metrics.evaluate import metrics_text, run_evaluate

    metrics = run_evaluate(options.sequence, options.run_path, options.camera)
    print(json.dumps(metrics.as_dict(), indent=2) if options.json else metrics_text(metrics))
    return 0


def _plot(options: argparse.Namespace) -> int:
    from rstrack.charts.runs import run_plot

    run_plot(options.sequence, options.run_path, options.out, options.camera)
    print(f"{options.out}: written")
    return 0


def _info(options: argparse.Namespace) -> int:
    from rstrack.cli.info import describe
    from rstrack.data.dataset import open_dataset

    print(describe(open_dataset(options.sequence, options.camera)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
