"""The commands that measure the tracker itself: bench-speed, bench-convergence, bench-bootstrap."""

from __future__ import annotations

import argparse
import json

from rsgen.console.command_line import Commands, count
from rstrack.cli.options import add_options, add_sequence, options_of
from rstrack.options import METHODS, PEERS


def add_benchmarks(commands: Commands) -> None:
    """Add them to the parser."""
    bench = commands.add(
        "bench-speed", _bench_speed, "time the tracker: milliseconds a frame, and where they go",
        "out/lr_kt2 --frames 150 --method rs-pg",
    )  # fmt: skip
    add_sequence(bench)
    bench.add_argument(
        "--frames", type=count, default=150, metavar="N",
        help="track the first N frames; the first 20 (at most half) warm up and are not counted (default: 150)",
    )  # fmt: skip
    bench.add_argument("--json", action="store_true", help="print machine-readable figures")
    bench.add_argument(
        "--method", action="append", choices=METHODS, dest="methods",
        help="method to time; may be given several times (default: rs-g and rs-pg)",
    )  # fmt: skip
    bench.add_argument(
        "--peer", action="append", choices=PEERS, dest="peers", default=[],
        help="time Open3D's odometry on the same frames; may be given several times",
    )  # fmt: skip
    add_options(bench, leave_out=("method",))

    bench = commands.add(
        "bench-convergence", _bench_convergence, "align single frames to a keyframe from poses ever farther off",
        "out/lr_kt2 --pairs 50 --method rs-pg",
    )  # fmt: skip
    add_sequence(bench)
    bench.add_argument("--pairs", type=count, default=50, metavar="N", help="keyframes with a frame (default: 50)")
    _add_benchmark(bench)

    bench = commands.add(
        "bench-bootstrap", _bench_bootstrap, "start the tracker at random frames: how many starts fail, and how good "
        "the others are", "out/lr_kt2 --starts 50 --frames 20",
    )  # fmt: skip
    add_sequence(bench)
    bench.add_argument("--starts", type=count, default=50, metavar="N", help="how many (default: 50)")
    bench.add_argument("--frames", type=count, default=20, metavar="N", help="frames of each (default: 20)")
    _add_benchmark(bench)


def _add_benchmark(command: argparse.ArgumentParser) -> None:
    command.add_argument("--seed", type=int, default=0, help="of the random choices (default: 0)")
    command.add_argument("--json", action="store_true", help="print machine-readable figures")
    add_options(command)


def _bench_speed(options: argparse.Namespace) -> int:
    from rsgen.console.progress import ProgressDisplay
    from rstrack.bench.speed import time_methods
    from rstrack.data.dataset import open_dataset

    chosen = [options_of(options, method=method) for method in options.methods or ("rs-g", "rs-pg")]
    dataset = open_dataset(options.sequence, options.camera)
    with ProgressDisplay(quiet=options.json) as progress:
        report = time_methods(dataset, chosen, options.frames, progress, options.peers)
    print(json.dumps(report.as_dict(), indent=2) if options.json else report.text())
    return 0


def _bench_convergence(options: argparse.Namespace) -> int:
    from rsgen.console.progress import ProgressDisplay
    from rsgen.device.arrays import engine
    from rstrack.data.dataset import open_dataset

    chosen = options_of(options)
    dataset = open_dataset(options.sequence, options.camera)
    # Before the tracker imports Dr.Jit, which then would choose a libLLVM itself.
    engine(chosen.backend)
    from rstrack.bench.convergence import convergence

    with ProgressDisplay(quiet=options.json) as progress:
        report = convergence(dataset, chosen, options.pairs, options.seed, progress)
    print(json.dumps(report.as_dict(), indent=2) if options.json else report.text())
    return 0


def _bench_bootstrap(options: argparse.Namespace) -> int:
    from rsgen.console.progress import ProgressDisplay
    from rstrack.bench.bootstrap import bootstraps
    from rstrack.data.dataset import open_dataset

    chosen = options_of(options)
    dataset = open_dataset(options.sequence, options.camera)
    with ProgressDisplay(quiet=options.json) as progress:
        report = bootstraps(dataset, chosen, options.starts, options.frames, options.seed, progress)
    print(json.dumps(report.as_dict(), indent=2) if options.json else report.text())
    return 0
