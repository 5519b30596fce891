"""A small evaluation of methods: two synthetic sequences, its config, its plan and `rstrack bench`."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import synthetic
import yaml

from rsgen.console.command_line import Commands, Parser, run_program
from rsgen.geometry import se3
from rsgen.sequence.format import pose_rows
from rstrack.bench.experiments.methods import Plan, Results, load_methods, make_plan
from rstrack.bench.record import CellRecord
from rstrack.bench.runner import RECORD, Outcome, run_cells
from rstrack.bench.task import Sources
from rstrack.cli.benchmark import bench

FRAMES = 31
NAMES = ("robot_t1", "lr_kt2")
SPEEDS = (0.3, 0.25)
VARIANTS = ("gs-g", "gs-g-fuse", "rs-g", "rs-g-no-fuse")


def parser() -> Parser:
    commands = Commands("rstrack", "test")
    commands.add(bench, "")
    return commands.parser


def main(words: str) -> int:
    return run_program("rstrack", parser, shlex.split(words), "nothing was written")


def make_data(folder: Path) -> None:
    """data/ with two sequences, and bench.yaml."""
    config = synthetic.make_config(112, 84)
    for name, speed in zip(NAMES, SPEEDS, strict=True):
        writer = synthetic.open_writer(folder / "data" / name, config, FRAMES, synthetic.make_spline(speed))
        synthetic.write_frames(writer)
        synthetic.write_scene(folder / "data" / name)
        writer.finish()
    groups = zip(NAMES, ("hand-held", "living room"), strict=True)
    sequences = {name: {"group": group, "config": f"{name}.yaml"} for name, group in groups}
    quick = {"sequences": ["lr_kt2"], "methods": ["rs-g"], "frames": 12}
    text = yaml.safe_dump({"sequences": sequences, "methods": ["gs-g", "rs-g"], "quick": quick}, sort_keys=False)
    (folder / "bench.yaml").write_text(text)


def plan(**how: Any) -> Plan:
    """Of the working directory."""
    return make_plan(load_methods(Path("bench.yaml")), Path("data"), **how)


def run(made: Plan, *more: Any) -> Outcome:
    """Run into bench/ of the working directory."""
    return run_cells(made.benchmark, Path("bench"), Sources(Path("data").resolve()), *more)


def results(made: Plan) -> Results:
    """Run, as `rstrack bench` sees it."""
    records = tuple(run(made).records.values())
    return Results(sequences=made.sequences, methods=made.methods, records=records)


def record_file(sequence: str, method: str) -> Path:
    """In the working directory."""
    return Path("bench/cells/track", sequence, method, RECORD)


def made_up_record(
    case: str, method: str, error: str | None = None, measure: str = "track", **figures: Any
) -> CellRecord:
    """One that was never run."""
    about = {"group": "", "case": {}}
    return CellRecord(
        f"{measure}/{case}/{method}", "k", about, (0,), () if error else (figures,), not error, error,
        version="1.2.3", machine={"cpu": "abacus", "cores": 2, "system": "Linux"},
    )  # fmt: skip


def write_tum(path: Path, sequence: str, kept: Sequence[int] | range = range(FRAMES), error_m: float = 0.001) -> None:
    """A tracker's TUM file: the truth in another world with noise, of some frames."""
    path.parent.mkdir(exist_ok=True)
    stamps = np.asarray(list(kept)) / synthetic.RATE_HZ
    spline = synthetic.make_spline(SPEEDS[NAMES.index(sequence)])
    xi = error_m * np.random.default_rng(5).normal(size=(len(stamps), 6))
    T = se3.orthonormalise(se3.exp(np.array([1.0, 2, 3, 0.3, 0.2, 0.1])) @ spline.pose(stamps) @ se3.exp(xi))
    rows = np.column_stack([stamps, pose_rows(T)])
    path.write_text("".join(" ".join(f"{value:.9f}" for value in row) + "\n" for row in rows))
