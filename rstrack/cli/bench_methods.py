"""The command `rstrack bench`: the whole evaluation."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from rsgen.console.command_line import Commands, parse_frames
from rsgen.console.scheduler import SCHEDULER_HELP, open_workers
from rsgen.errors import UserError
from rstrack.cli.options import add_options, options_of

_STATUS = "exit status: 0 done, 1 a track was lost or failed, 2 wrong input, 130 interrupted (the same command resumes)"


def add_evaluation(commands: Commands) -> None:
    """Add it to the parser."""
    bench = commands.add(
        "bench", _bench, "every method on every sequence against the truth, the paper's figures beside: tables, plots",
        f"--data out --out out/bench --sequence robot_t1 robot_r1 --method baseline rs-pg\n{_STATUS}",
    )  # fmt: skip
    bench.formatter_class = argparse.RawDescriptionHelpFormatter
    bench.add_argument(
        "config", type=Path, nargs="?", default=Path("configs/evaluation.yaml"),
        help="YAML file with the sequences and methods (default: configs/evaluation.yaml)",
    )  # fmt: skip
    bench.add_argument(
        "--data", type=Path, default=Path("out"), metavar="DIR", help="folder of the sequences' folders (default: out)"
    )
    bench.add_argument(
        "--out", type=Path, metavar="DIR",
        help="for runs, tables, plots; finished cells there are kept (default: out/bench, or out/bench_quick)",
    )  # fmt: skip
    bench.add_argument("--quick", action="store_true", help="the config's short version")
    bench.add_argument("--frames", metavar="A:B", help="only frames A to B-1 of each sequence (default: all)")
    bench.add_argument(
        "--sequence", dest="sequences", nargs="+", action="extend", default=[], metavar="NAME", help="only these"
    )
    bench.add_argument(
        "--method", dest="methods", nargs="+", action="extend", default=[], metavar="NAME", help="only these"
    )
    bench.add_argument("--peers", action="store_true", help="Open3D's odometry too")
    bench.add_argument(
        "--add", action="append", default=[], metavar="NAME=DIR",
        help="a tracker of your own: DIR holds SEQUENCE.txt (TUM), or SEQUENCE/ (a run folder), for each sequence",
    )  # fmt: skip
    bench.add_argument(
        "--meshes", action=argparse.BooleanOptionalAction,
        help="pictures of maps made with the trajectories, one a sequence (default: yes, but with --quick no)",
    )  # fmt: skip
    bench.add_argument("--scheduler", metavar="ADDRESS|local[:N]", help=SCHEDULER_HELP)
    bench.add_argument("--quiet", action="store_true", help="no progress")
    add_options(bench, leave_out=("method",))


def _bench(options: argparse.Namespace) -> int:
    from rsgen.console.progress import ProgressDisplay
    from rstrack.bench.methods.config import choose, load_bench_config
    from rstrack.bench.methods.grid import run_plan
    from rstrack.bench.methods.mesh_pictures import SHOWN, draw_meshes
    from rstrack.bench.methods.plan import make_plan
    from rstrack.bench.methods.plots import draw_plots
    from rstrack.bench.methods.tables import write_results

    frames = None if options.frames is None else parse_frames(options.frames)
    choice = choose(
        load_bench_config(options.config), quick=options.quick, frames=frames, sequences=options.sequences,
        methods=options.methods, peers=options.peers,
    )  # fmt: skip
    out = options.out or Path("out/bench_quick" if options.quick else "out/bench")
    with_meshes = not options.quick if options.meshes is None else options.meshes
    if options.meshes and not set(SHOWN) & set(choice.methods):
        raise UserError(f"--meshes: is for {', '.join(SHOWN)}: add one of them to --method")
    plan = make_plan(choice, options.data, out, options_of(options), dict(map(_added, options.add)))
    with ProgressDisplay(options.quiet) as progress:
        with open_workers(options.scheduler) as workers:
            results = run_plan(plan, workers, progress)
        text = write_results(results, out)
        interrupted = results.interrupted
        warnings: list[str] = []
        try:
            if not interrupted:
                draw_plots(results, out, progress)
                if with_meshes:
                    draw_meshes(results, out, progress=progress, warn=warnings.append)
        except KeyboardInterrupt:
            interrupted = True
    print(text)
    sys.stdout.flush()
    for warning in warnings:
        print(f"rstrack: {warning}", file=sys.stderr)
    if interrupted:
        print(f"rstrack: interrupted; {out} holds what is finished, and the same command goes on", file=sys.stderr)
        return 130
    print(f"\n{out}: results.txt, .md, .csv, .json, plots/* and cells/SEQUENCE/METHOD written")
    return 0 if all(cell.counts for cell in results.cells) else 1


def _added(text: str) -> tuple[str, Path]:
    name, equals, folder = text.partition("=")
    if not (equals and folder and name.replace("-", "").replace("_", "").replace(".", "").isalnum()):
        raise UserError(f"--add {text}: expected NAME=DIR, for example --add orbslam=results/orbslam")
    return name, Path(folder)
