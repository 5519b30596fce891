"""The command `rstrack bench`: the whole evaluation, or the readout sweep."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from rsgen.console.command_line import Frames, Quiet
from rsgen.console.configs import ConfigFile
from rsgen.console.scheduler import Scheduler, open_workers
from rsgen.errors import UserError
from rstrack.bench.readout.config import is_sweep
from rstrack.cli.bench_sweep import SweepChoice, bench_sweep, refuse_for_sweep
from rstrack.cli.options import TruthOffset
from rstrack.options import Options

STATUS = "exit status: 0 done, 1 a track was lost or failed, 2 wrong input, 130 interrupted (the same command resumes)"


def _added(text: str) -> tuple[str, Path]:
    name, folder = _named(text)
    if not (name and folder):
        raise UserError(f"--add {text}: expected NAME=DIR, for example --add orbslam=results/orbslam")
    return name, Path(folder)


def _command(text: str) -> tuple[str, str]:
    from rstrack.peers.command import PLACES, words_of

    name, command = _named(text)
    if not name:
        raise UserError(f"--peer-command {text}: expected NAME=COMMAND, for example mine='mine {' '.join(PLACES)}'")
    words_of(command)
    return name, command


def _named(text: str) -> tuple[str, str]:
    """NAME and what follows its '='; nothing where that is no name for a folder."""
    name, equals, rest = text.partition("=")
    is_name = name.replace("-", "").replace("_", "").replace(".", "").isalnum()
    return (name, rest) if equals and is_name else ("", "")


def bench(
    tracker: Options,
    sweep: SweepChoice,
    config: ConfigFile = Path("evaluation"),
    *,
    data: Annotated[Path, "folder of the sequences' folders", "DIR"] = Path("out"),
    out: Annotated[
        Path | None,
        "for runs, tables, plots; finished cells there are kept (default: out/bench, or out/bench_quick)",
        "DIR",
    ] = None,
    quick: Annotated[bool, "the config's short version"] = False,
    frames: Frames = None,
    sequence: Annotated[tuple[str, ...] | None, "only these", "NAME"] = None,
    method: Annotated[tuple[str, ...] | None, "only these", "NAME"] = None,
    peers: Annotated[bool, "Open3D's odometry, KISS-ICP, small_gicp and ORB-SLAM3 too"] = False,
    add: Annotated[
        list[tuple[str, Path]] | None,
        "a tracker of your own: DIR holds SEQUENCE.txt (TUM), or SEQUENCE/ (a run folder), for each sequence",
        "NAME=DIR",
        _added,
    ] = None,
    peer_command: Annotated[
        list[tuple[str, str]] | None,
        "a tracker of your own, run on each sequence: mine='mytracker {sequence} {out}' reads the folder {sequence} "
        "and writes the TUM file {out}",
        "NAME=COMMAND",
        _command,
    ] = None,
    truth_offset: TruthOffset = None,
    meshes: Annotated[
        bool | None, "pictures of maps made with the trajectories, one a sequence (default: yes, but with --quick no)"
    ] = None,
    scheduler: Scheduler = None,
    quiet: Quiet = False,
) -> int:
    """Every method on every sequence against the truth, the paper's figures beside: tables, plots.

    Each of our methods runs with fused keyframes and without, unless --fuse or --no-fuse says which. Tables show the
    better of the two for baseline and gs-*, and both for rs-*. With the config readout_sweep: one motion after the
    other at every readout, rendered first where need be; --sequence then names motions.
    """
    if is_sweep(config):
        refused = {
            "--quick": quick, "--peers": peers, "--add": add, "--peer-command": peer_command, "--meshes": meshes,
            "--truth-offset": truth_offset is not None,
        }  # fmt: skip
        refuse_for_sweep([name for name, given in refused.items() if given], frames)
        last = None if frames is None else frames.stop
        return bench_sweep(
            config,
            sweep,
            tracker,
            out or Path("out/readout_sweep"),
            last,
            sequence or (),
            method or (),
            scheduler,
            quiet,
        )
    if sweep != SweepChoice():
        raise UserError(f"{config}: is no sweep: --width, --readout, --exposure and --seeds are for readout_sweep")
    from rsgen.console.progress import ProgressDisplay
    from rstrack.bench.methods.config import choose, load_bench_config
    from rstrack.bench.methods.grid import run_plan
    from rstrack.bench.methods.mesh_pictures import SHOWN, draw_meshes
    from rstrack.bench.methods.plan import make_plan
    from rstrack.bench.methods.plots import draw_plots
    from rstrack.bench.methods.tables import write_results

    choice = choose(
        load_bench_config(config), quick=quick, frames=frames, sequences=sequence or (),
        methods=method or (), peers=peers,
    )  # fmt: skip
    out = out or Path("out/bench_quick" if quick else "out/bench")
    with_meshes = not quick if meshes is None else meshes
    if meshes and not set(SHOWN) & set(choice.methods):
        raise UserError(f"--meshes: is for {', '.join(SHOWN)}: add one of them to --method")
    plan = make_plan(choice, data, out, tracker, dict(add or ()), truth_offset, dict(peer_command or ()))
    with ProgressDisplay(quiet) as progress:
        with open_workers(scheduler) as workers:
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
