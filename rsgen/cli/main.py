"""The `rsgen` command: thin wrappers that parse arguments, call one function each and print."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from rsgen.cli.pictures import add_pictures
from rsgen.console.command_line import Commands, Parser, count, parse_frames, run_program
from rsgen.console.scheduler import SCHEDULER_HELP, open_workers

if TYPE_CHECKING:
    from rsgen.config.config import Config

EXPORTS = ("kalibr", "euroc", "registered", "video", "rerun")
BENCH_MODES = ("still", "rs-blur", "path", "rows", "averaged")
_BLENDER_MODES = ("blender-still", "blender")  # asked for by name: they need bpy and take long
_EXPORT_HELP = (
    "kalibr: camchain.yaml with line_delay, imu.yaml; euroc: mav0/ (ASL); registered: TUM folder with depth warped "
    "into the colour camera, its rows' times lost; video: global beside rolling shutter (.mp4); rerun: .rrd recording"
)
_DESCRIPTION = """\
rsgen makes rolling-shutter RGB-D benchmark sequences with exact continuous-time ground truth.

  rsgen render configs/demo.yaml            a short sequence in out/demo
  rsgen verify out/demo                     read it back and check it against itself
  rsgen compare out/demo --frame 20         what the rolling shutter did to frame 20
  rsgen fit my_trajectory.txt               how well a spline represents a recorded trajectory
  rsgen motion stats configs/table1.yaml    how far and how fast a config's camera moves
  rsgen export euroc out/demo               for the tools of others: EuRoC, Kalibr, registered TUM, video, rerun
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status: 0 done, 1 a check failed, 2 wrong input, 130 interrupted."""
    return run_program("rsgen", _parser, arguments, "the same command resumes")


def _parser() -> Parser:
    commands = Commands("rsgen", _DESCRIPTION)
    add = commands.add

    render = add(
        "render", _render, "render a sequence from a config; run again to resume",
        "configs/demo.yaml --out out/trial --frames 0:10 --color.spp 64 --depth.readout_s 0",
    )  # fmt: skip
    render.add_argument("config", type=Path, help="YAML file, see configs/")
    render.add_argument("--out", type=Path, metavar="DIR", help="folder of the sequence (default: out/NAME)")
    render.add_argument("--frames", metavar="A:B", help="only frames A to B-1 (default: all)")
    render.add_argument("--scheduler", metavar="ADDRESS|local[:N]", help=SCHEDULER_HELP)
    render.add_argument("--quiet", action="store_true", help="no progress")

    fit = add(
        "fit", _fit, "fit a spline to a trajectory: residuals and motion statistics",
        "my_trajectory.txt --dt 0.04 --plot fit.png",
    )  # fmt: skip
    fit.add_argument("file", type=Path, help="TUM, ICL-NUIM (.freiburg) or EuRoC trajectory")
    fit.add_argument("--dt", type=float, default=0.05, help="knot spacing, s (default: 0.05)")
    fit.add_argument("--smoothing", type=float, default=0.0, help="weight of the acceleration penalty (default: 0)")
    fit.add_argument("--format", choices=("auto", "tum", "icl", "euroc"), default="auto", help="file format")
    fit.add_argument("--plot", type=Path, metavar="PNG", help="write residuals, speeds and accelerations as a picture")
    fit.add_argument("--json", action="store_true", help="print machine-readable figures")

    motion = add(
        "motion", _motion, "stats: length, mean speeds and accelerations of the configs' motions, beside the paper's",
        "stats configs/robot_t1.yaml configs/table1.yaml",
    )  # fmt: skip
    motion.add_argument("what", choices=("stats",), help="stats: print a table, a line a config")
    motion.add_argument("configs", type=Path, nargs="+", metavar="config", help="YAML files")

    info = add("info", _info, "say what a sequence folder holds", "out/demo")
    info.add_argument("sequence", type=Path, help="folder that 'rsgen render' wrote")

    verify = add(
        "verify", _verify, "read a sequence back and check it: files, stamps, rows' poses, reprojection",
        "out/demo --pairs 50",
    )  # fmt: skip
    verify.add_argument("sequence", type=Path, help="folder that 'rsgen render' wrote")
    verify.add_argument("--pairs", type=count, default=20, help="neighbouring frames to reproject (default: 20)")
    verify.add_argument(
        "--raycast", type=count, default=0, metavar="N", help="cast N frames again with another ray caster (embreex)"
    )

    add_pictures(commands)

    export = add(
        "export", _export, "write a sequence in the layout of other tools",
        "euroc out/table1",
    )  # fmt: skip
    export.add_argument("to", choices=EXPORTS, metavar="|".join(EXPORTS), help=_EXPORT_HELP)
    export.add_argument("sequence", type=Path, help="folder that 'rsgen render' wrote")
    export.add_argument("--out", type=Path, metavar="PATH", help="where to (default: within the sequence's folder)")
    export.add_argument("--copy", action="store_true", help="euroc, registered: copy images instead of linking them")
    export.add_argument("--scene", type=Path, help="video: scene file, if it has moved since the sequence was rendered")
    export.add_argument("--quiet", action="store_true", help="no progress")

    light = add(
        "check-light", _check_light, "baked light against path tracing: PSNR of views along the config's trajectory",
        "configs/demo.yaml --spp 1024 --out light.png",
    )  # fmt: skip
    light.add_argument("config", type=Path, help="YAML file, see configs/")
    light.add_argument("--views", type=count, default=5, help="views, evenly spread in time (default: 5)")
    light.add_argument(
        "--spp", type=count, default=4096, help="samples per pixel of the path-traced reference (default: 4096)"
    )
    light.add_argument("--width", type=count, default=160, help="width of the views, px (default: 160)")
    light.add_argument("--out", type=Path, metavar="PNG", help="picture of both and eight times their difference")

    bench = add(
        "bench", _bench, "what a frame costs in each mode, and the ratios: blur, baked light, other ways to render it",
        "configs/demo.yaml --spp 16 --mode still --mode rs-blur",
    )  # fmt: skip
    bench.add_argument("config", type=Path, help="YAML file, see configs/")
    bench.add_argument("--frames", type=count, default=5, help="timed frames, each in all modes (default: 5)")
    bench.add_argument("--spp", type=count, default=64, help="samples per pixel (default: 64)")
    bench.add_argument(
        "--mode", action="append", dest="modes", choices=(*BENCH_MODES, *_BLENDER_MODES, "all"), metavar="MODE",
        help=f"{', '.join(BENCH_MODES)} (the default), {', '.join(_BLENDER_MODES)} (need bpy), all; may be repeated",
    )  # fmt: skip
    bench.add_argument("--json", action="store_true", help="print machine-readable figures")
    for command in (render, light, bench):
        command.usage = "%(prog)s [options] [--SECTION.FIELD VALUE ...] config"
        _add_overrides(command)
    return commands.parser


def _add_overrides(command: argparse.ArgumentParser) -> None:
    """One option for every field of the config, `--section.field VALUE`; the last one given counts."""
    from rsgen.config.config import describe_fields

    fields = command.add_argument_group("fields of the config, which these override (values are YAML)")
    for name, default, text in describe_fields():
        fields.add_argument(
            f"--{name}", dest="overrides", action="append", default=[], metavar="VALUE",
            type=partial(_pair, name), help=f"{text} (default: {default})".replace("%", "%%"),
        )  # fmt: skip


def _pair(name: str, value: str) -> tuple[str, str]:
    return name, value


def _config(options: argparse.Namespace) -> Config:
    from rsgen.config.config import load_config

    return load_config(options.config, dict(options.overrides))


def _render(options: argparse.Namespace) -> int:
    from rsgen.console.progress import ProgressDisplay
    from rsgen.produce.generate import render_sequence

    config = _config(options)
    frames = parse_frames(options.frames)
    out = options.out or Path("out") / config.name
    with ProgressDisplay(options.quiet) as progress, open_workers(options.scheduler) as workers:
        render_sequence(config, out, frames, progress, workers if options.scheduler else None)
    print(f"{out}: written (rsgen info {out}, rsgen verify {out})")
    return 0


def _fit(options: argparse.Namespace) -> int:
    from rsgen.motion.fit_report import make_fit_report, plot_fit, report_dict, report_text

    report = make_fit_report(options.file, options.dt, options.smoothing, options.format)
    if options.plot is not None:
        plot_fit(report, options.plot)
    print(json.dumps(report_dict(report), indent=2) if options.json else report_text(report))
    return 0


def _motion(options: argparse.Namespace) -> int:
    from rsgen.config.config import load_config
    from rsgen.motion.statistics import motion_statistics
    from rsgen.motion.table import stats_table
    from rsgen.produce.generate import load_motion

    rows = []
    for file in options.configs:
        config = load_config(file)
        motion = load_motion(config)
        rows.append((config.name, motion_statistics(motion.spline, motion.first_stamp, motion.last_stamp)))
    print(stats_table(rows))
    return 0


def _export(options: argparse.Namespace) -> int:
    from rsgen.console.progress import ProgressDisplay
    from rsgen.export.all import export

    with ProgressDisplay(options.quiet) as progress:
        done = export(options.to, options.sequence, options.out, options.copy, options.scene, progress)
    print(done)
    return 0


def _info(options: argparse.Namespace) -> int:
    from rsgen.sequence.reader import sequence_info

    print(sequence_info(options.sequence))
    return 0


def _verify(options: argparse.Namespace) -> int:
    from rsgen.check.verify import verify_sequence

    report = verify_sequence(options.sequence, pairs=options.pairs, raycast=options.raycast)
    print(report.text())
    return 0 if report.ok else 1


def _check_light(options: argparse.Namespace) -> int:
    from rsgen.check.light import check_light
    from rsgen.console.progress import ProgressDisplay

    config = _config(options)
    with ProgressDisplay() as progress:
        report, ok = check_light(config, options.views, options.spp, options.width, options.out, progress)
    print(report)
    return 0 if ok else 1


def _bench(options: argparse.Namespace) -> int:
    from rsgen.bench.modes import time_modes
    from rsgen.console.progress import ProgressDisplay

    modes = options.modes or BENCH_MODES
    modes = (*BENCH_MODES, *_BLENDER_MODES) if "all" in modes else modes
    config = _config(options)
    with ProgressDisplay() as progress:
        report = time_modes(config, options.frames, options.spp, modes, progress)
    print(json.dumps(report.as_dict(), indent=2) if options.json else report.text())
    return 0


if __name__ == "__main__":
    sys.exit(main())
