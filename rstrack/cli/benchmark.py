"""The command `rstrack bench`: methods on sequences beside the paper's figures, the readout sweep, the stress test."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rsgen.console.command_line import Frames, Quiet
from rsgen.console.configs import ConfigFile
from rsgen.console.scheduler import Scheduler, open_workers
from rsgen.errors import UserError
from rstrack.cli.options import TruthOffset
from rstrack.options import METHODS, Options

if TYPE_CHECKING:
    from rsgen.console.progress import Progress
    from rstrack.bench.definitions import Benchmark
    from rstrack.bench.runner import Outcome
    from rstrack.bench.sequences import Sources

BENCH_STATUS = (
    "exit status: 0 done, 1 a track was lost or failed, 2 wrong input, 130 interrupted (the same command resumes)"
)


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


@dataclass(frozen=True)
class Narrowed:
    """What a readout sweep or a stress test is narrowed down to; None: what it is by itself."""

    width: Annotated[int | None, "of all images, px: small ones are rendered and tracked sooner", "PX"] = None
    readout: Annotated[tuple[float, ...] | None, "only these readouts, s", "S"] = None
    exposure: Annotated[tuple[float, ...] | None, "only these exposures, s", "S"] = None
    seeds: Annotated[int | None, "runs of each, with other noise every time", "N"] = None


@dataclass(frozen=True)
class Run:
    """Where and how cells are run."""

    out: Path
    scheduler: str | None
    quiet: bool

    def cells(self, benchmark: Benchmark, sources: Sources, progress: Progress) -> Outcome:
        """Run what is not there yet; says first how much is to be rendered. Raises UserError."""
        from rstrack.bench.runner import run_cells

        entries = {c.case_entry.sequence: c.sequence for c in benchmark.cells if c.sequence.config is not None}
        missing = [name for name, entry in entries.items() if not sources.has(entry, name)]
        if missing and not self.quiet:
            print(
                f"rstrack: {len(missing)} of {len(entries)} sequences are to be rendered first, minutes each, and more "
                f"for each scene whose light is not baked yet; kept in {sources.home}, where later runs find them",
                file=sys.stderr,
            )
        with open_workers(self.scheduler) as workers:
            return run_cells(benchmark, self.out, sources, workers, progress)

    def end(self, text: str, written: str, is_good: bool, interrupted: bool) -> int:
        """Print what was found; returns the exit status."""
        print(text)
        sys.stdout.flush()
        if interrupted:
            told = f"rstrack: interrupted; {self.out} holds what is finished, and the same command goes on"
            print(told, file=sys.stderr)
            return 130
        print(f"\n{self.out}: {written} written")
        return 0 if is_good else 1


def bench(
    tracker: Options,
    narrowed: Narrowed,
    config: ConfigFile = Path("evaluation"),
    *,
    data: Annotated[Path, "folder of the sequences' folders", "DIR"] = Path("out"),
    out: Annotated[
        Path | None,
        "for runs, tables, plots; finished cells there are kept (default: out/bench, or out/bench_quick, "
        "out/readout_sweep, out/stress)",
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
    speed: Annotated[bool, "instead of errors, how long a frame takes with each method"] = False,
    scheduler: Scheduler = None,
    quiet: Quiet = False,
) -> int:
    """Every method on every sequence against the truth, the paper's figures beside: tables, plots.

    Each of our methods runs with fused keyframes and without, unless --fuse or --no-fuse says which. Tables show the
    better of the two for baseline and gs-*, and both for rs-*. With the config readout_sweep: one motion after the
    other at every readout; --sequence then names motions. With the config stress: one motion at several exposures and
    speeds, constant against blur-aware weights. These two render what is missing.
    """
    from rsgen.files import read_yaml

    text = read_yaml(config)
    given: dict[str, object] = {
        "--quick": quick, "--peers": peers, "--add": add, "--peer-command": peer_command, "--meshes": meshes,
        "--truth-offset": truth_offset is not None, "--speed": speed,
    }  # fmt: skip
    if "readouts_s" in text:
        _refuse("a readout sweep (its config names the methods, --method chooses)", given, frames)
        run = Run(out or Path("out/readout_sweep"), scheduler, quiet)
        return _sweep(config, run, narrowed, tracker, frames, sequence or (), method or ())
    if "methods" not in text and ({"motion", "trajectory"} & set(text)):
        given |= {"--sequence": sequence, "--readout": narrowed.readout, "--seeds": narrowed.seeds}
        _refuse("a stress test", given, frames)
        run = Run(out or Path("out/stress"), scheduler, quiet)
        return _stress(config, run, narrowed, tracker, frames, method or ())
    if narrowed != Narrowed():
        raise UserError(f"{config}: is no sweep: --width, --readout, --exposure and --seeds are for readout_sweep")
    if speed:
        _refuse("measuring --speed", {name: given[name] for name in ("--add", "--peer-command", "--meshes")}, None)
    from rsgen.console.progress import ProgressDisplay
    from rstrack.bench.methods.config import load_evaluation, make_plan
    from rstrack.bench.methods.mesh_pictures import SHOWN, draw_meshes
    from rstrack.bench.methods.plots import draw_plots
    from rstrack.bench.methods.results import Results
    from rstrack.bench.methods.tables import speed_text, write_results
    from rstrack.bench.record import write_records
    from rstrack.bench.sequences import Sources
    from rstrack.bench.tables.cells import is_good

    run = Run(out or Path("out/bench_quick" if quick else "out/bench"), scheduler, quiet)
    plan = make_plan(
        load_evaluation(config), data, tracker, quick=quick, frames=frames, sequences=sequence or (),
        methods=method or (), peers=peers, added=dict(add or ()), commands=dict(peer_command or ()),
        truth_offset=truth_offset, measure="speed" if speed else "track",
    )  # fmt: skip
    with_meshes = not quick if meshes is None else meshes
    if meshes and not set(SHOWN) & set(plan.methods):
        raise UserError(f"--meshes: is for {', '.join(SHOWN)}: add one of them to --method")
    with ProgressDisplay(quiet) as progress:
        outcome = run.cells(plan.benchmark, Sources(data.resolve(), scheduler=scheduler), progress)
        records = tuple(outcome.records.values())
        interrupted = outcome.interrupted
        if speed:
            said = speed_text(records, plan.sequences)
            write_records(run.out / "speed.json", records)
            return run.end(said, "speed.json", not any(record.error for record in records), interrupted)
        results = Results(sequences=plan.sequences, methods=plan.methods, records=records)
        said = write_results(results, run.out)
        warnings: list[str] = []
        try:
            if not interrupted:
                draw_plots(results, run.out, progress, warnings.append)
                if with_meshes:
                    draw_meshes(results, run.out, progress=progress, warn=warnings.append)
        except KeyboardInterrupt:
            interrupted = True
    for warning in warnings:
        print(f"rstrack: {warning}", file=sys.stderr)
    written = "results.txt, .md, .csv, .json, plots/* and cells/track/SEQUENCE/METHOD"
    return run.end(said, written, all(map(is_good, records)), interrupted)


def _refuse(what: str, given: Mapping[str, object], frames: slice | None) -> None:
    """Raises UserError for an option that what is run does not have."""
    name = next((name for name, value in given.items() if value), None)
    if name is not None:
        raise UserError(f"{name}: is not for {what}")
    if frames is not None and frames.start:
        raise UserError(f"--frames {frames.start}:...: {what} begins with frame 0: --frames 0:{frames.stop or 60}")


def _sweep(
    config: Path, run: Run, narrowed: Narrowed, tracker: Options, frames: slice | None, motions: tuple[str, ...],
    methods: tuple[str, ...],
) -> int:  # fmt: skip
    from rsgen.console.progress import ProgressDisplay
    from rstrack.bench.readout.config import installed, load_sweep_config, narrow, sweep_benchmark
    from rstrack.bench.readout.results import Sweep, draw_sweep, write_sweep
    from rstrack.bench.sequences import Sources
    from rstrack.bench.tables.cells import counts

    chosen = narrow(
        load_sweep_config(config), motions=motions, seeds=narrowed.seeds, methods=methods, readouts_s=narrowed.readout,
        exposures_s=narrowed.exposure, width=narrowed.width, frames=None if frames is None else frames.stop,
    )  # fmt: skip
    here, lacking = installed(chosen.methods)
    with ProgressDisplay(run.quiet) as progress:
        outcome = run.cells(sweep_benchmark(chosen, here, tracker), Sources(scheduler=run.scheduler), progress)
        records = tuple(outcome.records.values())
        sweep = Sweep(chosen, records, lacking, outcome.interrupted)
        text = write_sweep(sweep, run.out)
        if not sweep.interrupted:
            draw_sweep(sweep, run.out / "plots" / "readout.png")
    is_good = all(r.error is None and all(map(counts, r.runs)) for r in records)
    written = "results.txt, .md, .csv, records.json, plots/readout.png and cells/track/CASE/METHOD"
    return run.end(text, written, is_good, sweep.interrupted)


def _stress(
    config: Path, run: Run, narrowed: Narrowed, tracker: Options, frames: slice | None, methods: tuple[str, ...]
) -> int:
    from rsgen.console.progress import ProgressDisplay
    from rstrack.bench.sequences import Sources
    from rstrack.bench.stress.cases import StressOptions, stress_benchmark
    from rstrack.bench.stress.charts import write_stress

    if len(methods) > 1 or not {*methods} <= {*METHODS}:
        raise UserError(f"--method {' '.join(methods)}: the stress test has one method of {', '.join(METHODS)}")
    tracker = Options(**asdict(tracker) | ({"method": methods[0]} if methods else {}))
    options = StressOptions(frames=None if frames is None else frames.stop, width=narrowed.width, tracker=tracker)
    if narrowed.exposure:
        options = replace(options, exposures_s=narrowed.exposure)
    sources = Sources(scheduler=run.scheduler)
    with ProgressDisplay(run.quiet) as progress:
        outcome = run.cells(stress_benchmark(config, sources, options, progress), sources, progress)
        result, text = write_stress(outcome.records.values(), run.out)
    written = "stress.txt, .md, .csv, .json, .png, panels.png and cells/MEASURE/CASE/METHOD"
    return run.end(text, written, not result.failed, outcome.interrupted)
