"""The commands that measure: `rstrack bench` (methods, the readout sweep, the stress test) and `rstrack score`."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rsgen.console.command_line import Frames, Quiet, refuse_options
from rsgen.console.configs import config_file
from rsgen.console.scheduler import Scheduler
from rsgen.errors import UserError
from rstrack.cli.options import TruthOffset
from rstrack.options import METHODS, Options

if TYPE_CHECKING:
    from rstrack.bench.runner import Experiment


BENCH_STATUS = (
    "exit status: 0 done, 1 a track was lost or failed, 2 wrong input, 130 interrupted (the same command resumes)"
)

SCORE_STATUS = "exit status: 0 done, 1 something is lost, missing or failed, 2 wrong input, 130 interrupted"


def _added(text: str) -> tuple[str, Path]:
    name, folder = _named(text)
    if not (name and folder):
        raise UserError(f"--add {text}: expected NAME=DIR, for example --add orbslam=results/orbslam")
    return name, Path(folder)


def _command(text: str) -> tuple[str, str]:
    from rstrack.peers.peer import PLACES, words_of

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


@dataclass(frozen=True)
class Narrowed:
    """Limits of a readout sweep or a stress test; None: as its config has it."""

    width: Annotated[int | None, "width of all images, px; small images are rendered and tracked faster", "PX"] = None
    readout: Annotated[tuple[float, ...] | None, "run only these readout times, s", "S"] = None
    exposure: Annotated[tuple[float, ...] | None, "run only these exposure times, s", "S"] = None
    seeds: Annotated[int | None, "number of runs of each cell, each with different noise", "N"] = None


def bench(
    tracker: Options,
    narrowed: Narrowed,
    config: Annotated[Path, "evaluation, readout_sweep, stress, or a YAML file like these", config_file] = Path(
        "evaluation"
    ),
    *,
    data: Annotated[Path, "folder that holds the sequences", "DIR"] = Path("out"),
    out: Annotated[
        Path | None,
        "folder for runs, tables and plots; finished cells in it are reused (default: out/bench, out/bench_quick, "
        "out/readout_sweep or out/stress)",
        "DIR",
    ] = None,
    quick: Annotated[bool, "run the short version that the config defines"] = False,
    frames: Frames = None,
    sequence: Annotated[tuple[str, ...] | None, "run only these sequences", "NAME"] = None,
    method: Annotated[tuple[str, ...] | None, "run only these methods", "NAME"] = None,
    peers: Annotated[bool, "also run Open3D's odometry, KISS-ICP, small_gicp and ORB-SLAM3"] = False,
    add: Annotated[
        list[tuple[str, Path]] | None,
        "add results of another tracker: DIR holds SEQUENCE.txt (TUM) or SEQUENCE/ (a run folder) for each sequence",
        "NAME=DIR",
        _added,
    ] = None,
    peer_command: Annotated[
        list[tuple[str, str]] | None,
        "run another tracker on each sequence: mine='mytracker {sequence} {out}' reads the folder {sequence} and "
        "writes the TUM file {out}",
        "NAME=COMMAND",
        _command,
    ] = None,
    truth_offset: TruthOffset = None,
    meshes: Annotated[
        bool | None, "draw a picture of the maps of each sequence (default: yes, with --quick no)"
    ] = None,
    speed: Annotated[bool, "measure the time of a frame with each method instead of errors"] = False,
    scheduler: Scheduler = None,
    quiet: Quiet = False,
) -> int:
    """Run tracking methods on sequences and compare them with the truth and with the paper; writes tables and plots.

    The config says what is run. 'evaluation' (default) runs every method on every sequence of the paper. Each of our
    methods runs with fused keyframes and without, unless --fuse or --no-fuse chooses; the tables show the better one
    for baseline and gs-*, and both for rs-*. 'readout_sweep' measures the error against the readout time; --sequence
    names its motions. 'stress' runs one motion at several exposures and speeds, with constant and with blur-aware
    weights. The last two render missing sequences. Finished cells are stored: the same command resumes.
    """
    from rsgen.files import read_yaml
    from rstrack.bench.runner import run_experiment
    from rstrack.bench.task import Sources

    text = read_yaml(config)
    given: dict[str, object] = {
        "--quick": quick, "--peers": peers, "--add": add, "--peer-command": peer_command, "--meshes": meshes,
        "--truth-offset": truth_offset is not None, "--speed": speed,
    }  # fmt: skip
    experiment: Experiment
    sources = Sources(scheduler=scheduler)
    if "readouts_s" in text:
        _refuse("a readout sweep (its config names the methods, --method chooses)", given, frames)
        experiment = _readout(config, narrowed, tracker, frames, sequence or (), method or ())
        folder = "out/readout_sweep"
    elif "methods" not in text and ({"motion", "trajectory"} & set(text)):
        given |= {"--sequence": sequence, "--readout": narrowed.readout, "--seeds": narrowed.seeds}
        _refuse("a stress test", given, frames)
        experiment = _stress(config, narrowed, tracker, frames, method or ())
        folder = "out/stress"
    else:
        if narrowed != Narrowed():
            raise UserError(f"{config}: is no sweep: --width, --readout, --exposure and --seeds are for readout_sweep")
        if speed:
            _refuse("measuring --speed", {name: given[name] for name in ("--add", "--peer-command", "--meshes")}, None)
        from rstrack.bench.experiments.method_tables import MethodsExperiment, SpeedExperiment
        from rstrack.bench.experiments.methods import MAPPED, load_methods, make_plan

        plan = make_plan(
            load_methods(config), data, tracker, quick=quick, frames=frames, sequences=sequence or (),
            methods=method or (), peers=peers, added=dict(add or ()), commands=dict(peer_command or ()),
            truth_offset=truth_offset, measure="speed" if speed else "track",
        )  # fmt: skip
        if meshes and not set(MAPPED) & set(plan.methods):
            raise UserError(f"--meshes: is for {', '.join(MAPPED)}: add one of them to --method")
        with_meshes = not quick if meshes is None else meshes
        experiment = SpeedExperiment(plan) if speed else MethodsExperiment(plan, with_meshes)
        sources = replace(sources, data=data.resolve())
        folder = "out/bench_quick" if quick else "out/bench"
    return run_experiment(experiment, out or Path(folder), sources, quiet)


def _refuse(what: str, given: Mapping[str, object], frames: slice | None) -> None:
    """Raises UserError for an option that what is run does not have."""
    refuse_options(what, given)
    if frames is not None and frames.start:
        raise UserError(f"--frames {frames.start}:...: {what} begins with frame 0: --frames 0:{frames.stop or 60}")


def _readout(
    config: Path, narrowed: Narrowed, tracker: Options, frames: slice | None, motions: tuple[str, ...],
    methods: tuple[str, ...],
) -> Experiment:  # fmt: skip
    from rstrack.bench.experiments.readout import ReadoutExperiment, load_sweep, narrow

    chosen = narrow(
        load_sweep(config), motions=motions, seeds=narrowed.seeds, methods=methods, readouts_s=narrowed.readout,
        exposures_s=narrowed.exposure, width=narrowed.width, frames=None if frames is None else frames.stop,
    )  # fmt: skip
    return ReadoutExperiment(chosen, tracker)


def _stress(
    config: Path, narrowed: Narrowed, tracker: Options, frames: slice | None, methods: tuple[str, ...]
) -> Experiment:
    from rstrack.bench.experiments.stress import StressOptions
    from rstrack.bench.experiments.stress_results import StressExperiment

    if len(methods) > 1 or not {*methods} <= {*METHODS}:
        raise UserError(f"--method {' '.join(methods)}: the stress test has one method of {', '.join(METHODS)}")
    tracker = Options(**asdict(tracker) | ({"method": methods[0]} if methods else {}))
    options = StressOptions(frames=None if frames is None else frames.stop, width=narrowed.width, tracker=tracker)
    return StressExperiment(config, replace(options, exposures_s=narrowed.exposure) if narrowed.exposure else options)


def score(
    suite: Annotated[
        Path, "folder that holds SEQUENCE/ folders; its suite.yaml, if any, states their tiers and groups"
    ],
    results: Annotated[
        tuple[Path, ...],
        "folders with METHOD/SEQUENCE.txt (TUM), such a METHOD, run folders of 'rstrack track', or the folder of "
        "'rstrack bench'",
    ] = (),
    *,
    out: Annotated[Path, "folder for scores.json and the page index.html, made if need be", "DIR"],
    only: Annotated[
        tuple[str, ...] | None, "only sequences whose name, tier, role or group is this; * and ? allowed", "NAME"
    ] = None,
    run: Annotated[
        tuple[str, ...] | None,
        "also track the suite with these methods or peers, for example rs-pg gs-pg kiss-icp; 'peers' is all peers. "
        "Runs are kept in DIR/runs, and the same command resumes",
        "METHOD",
    ] = None,
    scheduler: Scheduler = None,
    quiet: Quiet = False,
) -> int:
    """Score trajectories of any tracker on a suite of sequences: writes scores.json and a leaderboard. Beside
    METHOD/SEQUENCE.txt may lie SEQUENCE.cov (covariances as smfeval reads them) and SEQUENCE.times (ms a frame), and
    METHOD/method.yaml with name, url, note, camera (depth or color: whose poses these are), alignment (se3 or sim3)
    and ms_per_frame.
    """
    from rsgen.console.progress import ProgressDisplay
    from rsgen.files import atomic_write, make_folder
    from rstrack.report.leaderboard import leaderboard, summary
    from rstrack.report.page import write_page
    from rstrack.score.scores import score_suite
    from rstrack.score.suite import find_methods, read_suite

    chosen = read_suite(suite, only or ())
    names = [entry.name for entry in chosen.entries]
    if not (results or run):
        raise UserError("no results to score: name folders with METHOD/SEQUENCE.txt, or methods to --run")
    given = find_methods(results, names)  # complain before hours of tracking
    with ProgressDisplay(quiet) as progress:
        if run:
            from rstrack.score.suite import run_methods

            outcome = run_methods(chosen, run, out / "runs", scheduler, progress)
            for record in outcome.records.values():
                if record.error is not None:
                    print(f"not tracked: {record.method}, {record.case}: {record.error}", file=sys.stderr)
            if outcome.interrupted:
                print(f"rstrack: interrupted; the same command goes on with {out / 'runs'}", file=sys.stderr)
                return 130
            given = find_methods((*results, out / "runs"), names)
        scores = score_suite(chosen, given, progress)
        make_folder(out)
        atomic_write(out / "scores.json", scores.json_text().encode())
        page = write_page(leaderboard(scores), out / "index.html")
    print(summary(scores))
    for line in scores.gaps:
        print(f"not scored: {line}", file=sys.stderr)
    print(f"\n{page}: written, open it in a browser; all figures are in {out / 'scores.json'}")
    return 1 if scores.gaps else 0
