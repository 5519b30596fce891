"""The `rstrack` command: thin wrappers that parse arguments, call one function each and print."""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args, get_type_hints

from rsgen.command_line import Commands, Parser, count, parse_frames, run_program
from rsgen.errors import UserError
from rstrack.options import METHODS, Options

_DESCRIPTION = """\
rstrack estimates the continuous-time trajectory of a rolling-shutter RGB-D camera: every line has its own pose.

  rstrack info out/demo                                what would be tracked
  rstrack track out/demo --out runs/demo               track it; the trajectory is in runs/demo
  rstrack evaluate out/demo runs/demo                  errors against the ground truth
  rstrack plot out/demo runs/demo --out demo.png       path and errors as a picture

A sequence is a folder that 'rsgen render' wrote, or a TUM RGB-D or ICL-NUIM folder; those need their cameras in a
camera.yaml or calibration.yaml inside, or in the file that --camera names.
"""
_STATUS = "exit status: 0 done, 1 frames were lost, 2 wrong input, 130 interrupted (what there is has been written)"

HELP = {
    "method": "rs models the rolling shutter, gs takes it for a global one; p photometric, g geometric error; baseline "
    "has one pose a frame",
    "knot_spacing_s": "time between control points of the spline, s",
    "knot_phase": "the first knot lies this part of the spacing before the first line",
    "backend": "where kernels run",
    "keyframe_overlap": "new keyframe once less than this part of the first points is seen",
    "keyframe_distance": "new keyframe after this distance, m",
    "keyframe_angle_deg": "new keyframe after this rotation, degrees",
    "keyframe_strategy": "the last frame that has converged, or the newest, rolling until it has",
    "fuse": "average the depth of later frames into the keyframe",
    "bootstrap_frames": "frames that are aligned jointly at the start",
    "max_depth": "depth beyond this counts as missing, m",
    "blur_sigma_px": "colour that motion blurs counts less, by exp(-length / this squared), px; 0: all alike",
}
"""What the fields of Options mean, on the command line."""


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
    _add_sequence(track)
    track.add_argument("--out", type=Path, required=True, metavar="RUN", help="folder to write")
    track.add_argument("--frames", metavar="A:B", help="only frames A to B-1 (default: all)")
    track.add_argument(
        "--noise-depth", type=_number, default=0.0, metavar="S",
        help="add noise of standard deviation S z^2 to depth z in m; a Kinect has 1.2e-3 (default: 0)",
    )  # fmt: skip
    track.add_argument(
        "--noise-intensity", type=_number, default=0.0, metavar="S",
        help="add noise of standard deviation S to intensities in [0, 1], for example 0.01 (default: 0)",
    )  # fmt: skip
    track.add_argument("--seed", type=int, default=0, help="of the noise (default: 0)")
    track.add_argument("--quiet", action="store_true", help="no progress")
    _add_options(track)

    evaluate = commands.add(
        "evaluate", _evaluate, "errors of a run against the ground truth: ATE, drift per second, lines' poses",
        "out/lr_kt2 runs/lr_kt2 --json",
    )  # fmt: skip
    _add_sequence(evaluate)
    _add_run(evaluate)
    evaluate.add_argument("--json", action="store_true", help="print machine-readable figures")

    plot = commands.add(
        "plot", _plot, "picture of a run: path, errors over time, inliers", "out/lr_kt2 runs/lr_kt2 --out lr_kt2.png"
    )
    _add_sequence(plot)
    _add_run(plot)
    plot.add_argument("--out", type=Path, required=True, metavar="FILE", help="png, pdf or svg file to write")

    info = commands.add("info", _info, "say what would be tracked: cameras, shutters, frames, truth", "out/lr_kt2")
    _add_sequence(info)

    bench = commands.add(
        "bench-speed", _bench_speed, "time the tracker: milliseconds a frame, and where they go",
        "out/lr_kt2 --frames 150 --method rs-pg",
    )  # fmt: skip
    _add_sequence(bench)
    bench.add_argument(
        "--frames", type=count, default=150, metavar="N",
        help="track the first N frames; the first 20 (at most half) warm up and are not counted (default: 150)",
    )  # fmt: skip
    bench.add_argument("--json", action="store_true", help="print machine-readable figures")
    bench.add_argument(
        "--method", action="append", choices=METHODS, dest="methods",
        help="method to time; may be given several times (default: rs-g and rs-pg)",
    )  # fmt: skip
    _add_options(bench, leave_out=("method",))

    bench = commands.add(
        "bench-convergence", _bench_convergence, "align single frames to a keyframe from poses ever farther off",
        "out/lr_kt2 --pairs 50 --method rs-pg",
    )  # fmt: skip
    _add_sequence(bench)
    bench.add_argument("--pairs", type=count, default=50, metavar="N", help="keyframes with a frame (default: 50)")
    _add_benchmark(bench)

    bench = commands.add(
        "bench-bootstrap", _bench_bootstrap, "start the tracker at random frames: how many starts fail, and how good "
        "the others are", "out/lr_kt2 --starts 50 --frames 20",
    )  # fmt: skip
    _add_sequence(bench)
    bench.add_argument("--starts", type=count, default=50, metavar="N", help="how many (default: 50)")
    bench.add_argument("--frames", type=count, default=20, metavar="N", help="frames of each (default: 20)")
    _add_benchmark(bench)
    return commands.parser


def _add_sequence(command: argparse.ArgumentParser) -> None:
    command.add_argument("sequence", type=Path, help="rsgen sequence, TUM RGB-D or ICL-NUIM folder")
    command.add_argument(
        "--camera", type=Path, metavar="FILE", help="cameras of a TUM or ICL-NUIM folder (default: one inside it)"
    )


def _add_run(command: argparse.ArgumentParser) -> None:
    command.add_argument("run_path", type=Path, metavar="run", help="folder that 'rstrack track' wrote, or a TUM file")


def _add_options(command: argparse.ArgumentParser, leave_out: Sequence[str] = ()) -> None:
    """One option for every field of `Options`."""
    group = command.add_argument_group("the tracker")
    hints = get_type_hints(Options)
    for field in dataclasses.fields(Options):
        if field.name in leave_out:
            continue
        flag, kind = f"--{field.name.replace('_', '-')}", hints[field.name]
        text = f"{HELP.get(field.name, '')} (default: {field.default})"
        how: dict[str, Any] = {"dest": field.name, "default": field.default}
        if kind is bool:
            text = f"{HELP.get(field.name, '')} (default: {'yes' if field.default else 'no'})"
            group.add_argument(flag, action=argparse.BooleanOptionalAction, help=text, **how)
        elif get_args(kind):
            group.add_argument(flag, choices=get_args(kind), help=text, **how)
        else:
            group.add_argument(flag, type={int: count, float: _number}[kind], metavar="X", help=text, **how)


def _add_benchmark(command: argparse.ArgumentParser) -> None:
    command.add_argument("--seed", type=int, default=0, help="of the random choices (default: 0)")
    command.add_argument("--json", action="store_true", help="print machine-readable figures")
    _add_options(command)


def _number(text: str) -> float:
    """A finite number."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise argparse.ArgumentTypeError(f"expected a finite number, got '{text}'")
    return number


def _options(options: argparse.Namespace, **changed: Any) -> Options:
    given = vars(options)
    return Options(**{f.name: given[f.name] for f in dataclasses.fields(Options) if f.name in given} | changed)


def _track(options: argparse.Namespace) -> int:
    from rsgen.progress import ProgressDisplay
    from rstrack.dataset import open_dataset
    from rstrack.run import Noise, track

    tracker_options, frames = _options(options), parse_frames(options.frames)
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
    from rstrack.evaluate import metrics_text, run_evaluate

    metrics = run_evaluate(options.sequence, options.run_path, options.camera)
    print(json.dumps(metrics.as_dict(), indent=2) if options.json else metrics_text(metrics))
    return 0


def _plot(options: argparse.Namespace) -> int:
    from rstrack.plots import run_plot

    run_plot(options.sequence, options.run_path, options.out, options.camera)
    print(f"{options.out}: written")
    return 0


def _info(options: argparse.Namespace) -> int:
    from rstrack.dataset import open_dataset
    from rstrack.describe import describe

    print(describe(open_dataset(options.sequence, options.camera)))
    return 0


def _bench_speed(options: argparse.Namespace) -> int:
    from rsgen.progress import ProgressDisplay
    from rstrack.benchmark import time_methods
    from rstrack.dataset import open_dataset

    chosen = [_options(options, method=method) for method in options.methods or ("rs-g", "rs-pg")]
    dataset = open_dataset(options.sequence, options.camera)
    with ProgressDisplay(quiet=options.json) as progress:
        report = time_methods(dataset, chosen, options.frames, progress)
    print(json.dumps(report.as_dict(), indent=2) if options.json else report.text())
    return 0


def _bench_convergence(options: argparse.Namespace) -> int:
    from rsgen.progress import ProgressDisplay
    from rstrack.dataset import open_dataset
    from rstrack.engine import engine

    chosen = _options(options)
    dataset = open_dataset(options.sequence, options.camera)
    # Before the tracker imports Dr.Jit, which then would choose a libLLVM itself.
    engine(chosen.backend)
    from rstrack.convergence import convergence

    with ProgressDisplay(quiet=options.json) as progress:
        report = convergence(dataset, chosen, options.pairs, options.seed, progress)
    print(json.dumps(report.as_dict(), indent=2) if options.json else report.text())
    return 0


def _bench_bootstrap(options: argparse.Namespace) -> int:
    from rsgen.progress import ProgressDisplay
    from rstrack.dataset import open_dataset
    from rstrack.robustness import bootstraps

    chosen = _options(options)
    dataset = open_dataset(options.sequence, options.camera)
    with ProgressDisplay(quiet=options.json) as progress:
        report = bootstraps(dataset, chosen, options.starts, options.frames, options.seed, progress)
    print(json.dumps(report.as_dict(), indent=2) if options.json else report.text())
    return 0


if __name__ == "__main__":
    sys.exit(main())
