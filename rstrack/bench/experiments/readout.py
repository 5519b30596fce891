"""The readout sweep, what each tracker's error comes to as the shutter gets slower: its YAML file, cells and results.

config = narrow(load_sweep(Path("configs/readout_sweep.yaml")), width=320, readouts_s=(0.0, 0.028))
outcome = run_cells(sweep_benchmark(config, config.methods), Path("out/readout_sweep"), Sources())
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, field_validator, model_validator

from rsgen.console.progress import Progress
from rsgen.console.tables import NOTHING, Entry, Table, fixed, significant
from rsgen.errors import UserError, how_to_install, validated
from rsgen.files import read_yaml
from rstrack.bench.cells import (
    OTHERS,
    Benchmark,
    CaseEntry,
    Cell,
    Name,
    NoiseEntry,
    SequenceEntry,
    StrictModel,
    read_definitions,
)
from rstrack.bench.experiments.methods import method_entry, variants
from rstrack.bench.figures import heading
from rstrack.bench.measures.track import package_of
from rstrack.bench.record import CellRecord, counts, write_records
from rstrack.bench.runner import Outcome, Written
from rstrack.bench.tables import ERRORS, failures, pivot, provenance, write_tables
from rstrack.bench.task import Sources
from rstrack.charts.chart import Chart, Curve, method_colors, numbers
from rstrack.charts.to_file import write_charts
from rstrack.options import METHODS, Options

Seconds = Annotated[float, Field(ge=0.0, le=1.0)]
STREAMS = ("color", "depth")
CONFIDENCE = 0.95
_Methods = dict[str, dict[float, CellRecord]]
_DASHED = "Dashed: the shutter is taken for a global one, or for a lidar's sweep."


class MotionEntry(StrictModel):
    """One motion."""

    name: Name = Field(description="of its panel, and the beginning of its folders' names")
    config: Path = Field(description="what 'rsgen render' makes it from, relative to this file")
    overrides: dict[str, Any] = Field(default={}, description="fields of the config that are to be others")


class SweepNoise(NoiseEntry):
    """What is added to images when they are read, and how many times."""

    seeds: int = Field(default=3, ge=1, le=1000, description="how many times, each with other noise")


class SweepConfig(StrictModel):
    """The whole sweep: every readout with every exposure, motion and seed, for every method."""

    motions: tuple[MotionEntry, ...] = Field(min_length=1, description="what is rendered")
    overrides: dict[str, Any] = Field(default={}, description="fields of all their configs")
    readouts_s: tuple[Seconds, ...] = Field(min_length=1, description="of both cameras, s")
    exposures_s: tuple[Seconds, ...] = Field(default=(0.0,), min_length=1, description="of both cameras, s")
    noise: SweepNoise = Field(default=SweepNoise(), description="of the images")
    methods: tuple[Name, ...] = Field(min_length=1, description="what tracks them, in the order of the tables")
    width: int | None = Field(default=None, ge=32, le=16384, description="of all images, px; default: their configs'")
    frames: int | None = Field(default=None, ge=10, description="of each sequence; default: all")

    @field_validator("overrides")
    @classmethod
    def _leaves_the_axes_alone(cls, given: dict[str, Any]) -> dict[str, Any]:
        for name in given:
            if name.rpartition(".")[2] in ("readout_s", "exposure_s"):
                raise ValueError(f"'{name}' is what the sweep varies: name its values in {name.rpartition('.')[2]}")
        return given

    @model_validator(mode="after")
    def _nothing_twice(self) -> SweepConfig:
        listed: dict[str, list[Any]] = {"motions": [entry.name for entry in self.motions]}
        listed |= {name: list(getattr(self, name)) for name in ("readouts_s", "exposures_s", "methods")}
        for what, given in listed.items():
            twice = [value for value, count in Counter(given).items() if count > 1]
            if twice:
                raise ValueError(f"{what}: '{twice[0]}' is there twice")
        unknown = [name for name in self.methods if name not in (*METHODS, *OTHERS)]
        if unknown:
            raise ValueError(f"methods: no method '{unknown[0]}': choose from {', '.join((*METHODS, *OTHERS))}")
        return self


def load_sweep(path: Path) -> SweepConfig:
    """Read and validate; paths come out relative to the working directory. Raises UserError naming file and entry."""
    config = read_definitions(SweepConfig, path, "configs/readout_sweep.yaml")
    here = tuple(entry.model_copy(update={"config": path.parent / entry.config}) for entry in config.motions)
    return config.model_copy(update={"motions": here})


def narrow(
    config: SweepConfig, *, motions: Sequence[str] = (), seeds: int | None = None, **given: Any
) -> SweepConfig:  # fmt: skip
    """The sweep with what is given in place of what its file has: motions by name, seeds, and fields by theirs.

    Raises UserError: a value or name that is none.
    """
    names = [entry.name for entry in config.motions]
    for name in motions:
        if name not in names:
            raise UserError(f"--sequence {name}: the sweep has no such motion: it has {', '.join(names)}")
    chosen = config.model_dump() | {
        "motions": [entry.model_dump() for entry in config.motions if not motions or entry.name in motions],
        "noise": config.noise.model_dump() | ({} if seeds is None else {"seeds": seeds}),
    }
    chosen |= {name: value for name, value in given.items() if value}
    return validated(SweepConfig.model_validate, chosen, "the sweep")


def installed(methods: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The methods that can run here, and those whose packages are not installed. Raises UserError: none can."""
    lacking = tuple(name for name in methods if name not in METHODS and find_spec(package_of(name)) is None)
    if len(lacking) == len(methods):
        raise UserError(f"the sweep: none of {', '.join(lacking)} is installed: {how_to_install('peers', 'orbslam3')}")
    return tuple(name for name in methods if name not in lacking), lacking


def sweep_benchmark(config: SweepConfig, methods: Sequence[str], options: Options | None = None) -> Benchmark:
    """The cells, motion by motion; our methods in their default setting, unless options.fuse chooses.

    Raises UserError: a motion's config cannot be read, or does not say what the sweep changes.
    """
    options = options or Options()
    names = [variants(method, options.fuse)[0] for method in methods]
    frames = None if config.frames is None else f"0:{config.frames}"
    noise = NoiseEntry(depth=config.noise.depth, intensity=config.noise.intensity)
    cells = []
    for motion, exposure, readout in product(config.motions, config.exposures_s, config.readouts_s):
        fields = shutter_fields(motion.config, readout, exposure) | config.overrides | motion.overrides
        sequence = SequenceEntry(
            config=motion.config, set=fields, width=config.width, frames=frames, group=motion.name
        )  # fmt: skip
        size = f"_{config.width}px" if config.width else ""
        name = f"{motion.name}{size}_readout_{1e3 * readout:g}ms_exposure_{1e3 * exposure:g}ms"
        case, seeds = CaseEntry(sequence=name, noise=noise), tuple(range(config.noise.seeds))
        cells += [
            Cell("track", name, method, seeds, case, sequence, method_entry(method, options), {}) for method in names
        ]
    return Benchmark(tuple(cells))


def shutter_fields(path: Path, readout_s: float, exposure_s: float) -> dict[str, Any]:
    """Fields of a config that give both cameras a readout and an exposure.

    Colour's and depth's offsets count for the mid-exposure of their first line: at each exposure lines are taken at
    the same times, and images differ in their blur alone. Raises UserError: the config's offsets are no numbers.
    """
    given, fields = read_yaml(path), dict[str, Any]()
    for stream in STREAMS:
        try:
            offset = float((given.get(stream) or {}).get("offset_s", 0.0))
        except (TypeError, ValueError, AttributeError):
            raise UserError(f"{path}: {stream}: offset_s must be a number of seconds") from None
        fields |= {f"{stream}.readout_s": readout_s, f"{stream}.exposure_s": exposure_s}
        fields[f"{stream}.offset_s"] = round(offset + 0.5 * exposure_s, 9)
    return fields


@dataclass(frozen=True)
class Sweep:
    """What has been run. records: in the cells' order, those missing of which an interrupt left none. lacking: methods
    left out, not being installed."""

    config: SweepConfig
    records: tuple[CellRecord, ...]
    lacking: tuple[str, ...] = ()
    interrupted: bool = False

    @property
    def methods(self) -> tuple[str, ...]:
        """In the order of the tables."""
        return tuple(dict.fromkeys(record.method for record in self.records))


@dataclass(frozen=True)
class ReadoutExperiment:
    """The sweep with those of its methods that are installed; options: of ours."""

    config: SweepConfig
    options: Options

    def benchmark(self, sources: Sources, progress: Progress) -> Benchmark:
        """See `sweep_benchmark`."""
        return sweep_benchmark(self.config, installed(self.config.methods)[0], self.options)

    def sweep(self, outcome: Outcome) -> Sweep:
        """What has been run of it."""
        lacking = installed(self.config.methods)[1]
        return Sweep(self.config, tuple(outcome.records.values()), lacking, outcome.interrupted)

    def write(self, outcome: Outcome, out: Path) -> Written:
        """See `Experiment`."""
        sweep = self.sweep(outcome)
        is_good = all(r.error is None and all(map(counts, r.runs)) for r in sweep.records)
        files = "results.txt, .md, .csv, records.json, plots/readout.png and cells/track/CASE/METHOD"
        return Written(write_sweep(sweep, out), files, is_good)

    def draw(self, outcome: Outcome, out: Path, progress: Progress, warn: Callable[[str], None]) -> None:
        """A panel for each motion and exposure."""
        charts, path = sweep_charts(self.sweep(outcome)), out / "plots" / "readout.png"
        write_charts(charts, path, "", columns=len(self.config.motions), one_legend=True)


def log_interval(values: Sequence[float]) -> tuple[float | None, float | None, float | None]:
    """Geometric mean of positive values and its two-sided interval of CONFIDENCE by Student's t, in logarithms.

    None where there are no values; the interval is None too where there is but one.
    """
    from scipy.special import stdtrit

    logs = np.log(np.array([value for value in values if value > 0.0]))
    if not logs.size:
        return None, None, None
    mean = float(logs.mean())
    if logs.size == 1:
        return math.exp(mean), None, None
    half = float(stdtrit(logs.size - 1, 0.5 + 0.5 * CONFIDENCE) * logs.std(ddof=1) / math.sqrt(logs.size))
    return math.exp(mean), math.exp(mean - half), math.exp(mean + half)


def errors(record: CellRecord, name: str = "ate_mm") -> list[float]:
    """Of the seeds on which it kept the track."""
    return [value for run in record.runs if counts(run) and (value := run.get(name)) is not None]


def growth(means: Sequence[float | None]) -> float | None:
    """Largest over smallest of a method's means, one a readout; None if it was lost at one, or has but one."""
    known = [mean for mean in means if mean is not None]
    return max(known) / min(known) if len(known) == len(means) > 1 else None


def write_sweep(sweep: Sweep, out: Path) -> str:
    """Write records.json, results.csv, .md and .txt into `out`; returns the text. Raises UserError."""
    write_records(out / "records.json", sweep.records)
    return write_tables(out, sweep_tables(sweep), sweep_notes(sweep), _rows(sweep))


def sweep_tables(sweep: Sweep) -> list[Table]:
    """A table for each motion and exposure: a row for each method, a column for each readout, and the growth.

    Entries are geometric means, for errors are compared by their ratios.
    """
    readouts, tables = {f"{1e3 * readout:g} ms": readout for readout in sorted(sweep.config.readouts_s)}, []
    for (motion, exposure), methods in _panels(sweep).items():

        def entry(method: str, column: str, methods: _Methods = methods) -> Entry:
            if column in readouts:
                return _entry(sweep, methods[method].get(readouts[column]))
            line = [methods[method].get(readout) for readout in readouts.values()]
            factor = growth([None if r is None else log_interval(errors(r))[0] for r in line])
            return Entry("" if len(line) < 2 else fixed(factor, 2))

        title = f"{motion}, exposure {1e3 * exposure:g} ms: {heading('ate_mm')}, by readout"
        tables.append(pivot("method", list(methods), (*readouts, "most / least"), entry, title=title))
    return tables


def sweep_notes(sweep: Sweep) -> list[str]:
    """What a reader has to know about the figures, one line each."""
    noise = sweep.config.noise
    frames = sorted({int(value) for r in sweep.records for value in r.values("frames")}) or [0]
    over = f"{frames[0]} frames" if len(frames) == 1 else f"{frames[0]} to {frames[-1]} frames"
    noisy = f"noise (depth {noise.depth:g} z² m, grey values {noise.intensity:g})"
    lines = [f"RMSE over {over}, one seed of {noisy}: no intervals"]
    if noise.seeds > 1:
        lines = [
            f"RMSE over {over}; geometric mean over {noise.seeds} seeds of {noisy}, in brackets its "
            f"{100 * CONFIDENCE:.0f} % interval: what other noise would change, not what another motion would"
        ]
    some = [f"{r.method} on {r.case} {lost} of {noise.seeds}" for r in sweep.records if (lost := _lost(sweep, r))]
    if some:
        lines.append(f"† lost or failed (poses for fewer than half of the frames): {', '.join(some)}")
    lines += failures(sweep.records)
    if sweep.lacking:
        lines.append(f"left out, not installed: {', '.join(sweep.lacking)} ({how_to_install('peers', 'orbslam3')})")
    if sweep.interrupted:
        lines.append("not run yet (-): the same command goes on where this one ended")
    return [*lines, provenance(sweep.records)]


def sweep_charts(sweep: Sweep) -> list[Chart]:
    """ATE over readout with its interval: motions, then exposures. Points that are lost are left out."""
    charts = []
    order = sweep.config.exposures_s.index
    for (motion, exposure), methods in sorted(_panels(sweep).items(), key=lambda item: order(item[0][1])):
        at = f", exposure {1e3 * exposure:g} ms" if len(sweep.config.exposures_s) > 1 else ""
        charts.append(readout_chart(f"{motion}{at}", methods))
    return charts


def readout_chart(title: str, methods: Mapping[str, Mapping[float, CellRecord]]) -> Chart:
    """ATE of methods by readout (s): geometric mean of the seeds and its interval, as `log_interval` has them."""
    colors, lines = method_colors(list(methods)), []
    for method, found in methods.items():
        mean, low, high = (numbers([log_interval(errors(r))[k] for _, r in sorted(found.items())]) for k in range(3))
        x, is_dashed = numbers(sorted(found), 1e3), method not in ("rs-pg", "rs-g")
        lines.append(Curve(method, colors[method], x, mean, is_dashed, True, low, high))
    return Chart(f"{title}: ATE (RMSE)", "mm", "readout, ms", tuple(lines), is_log=True, note=_DASHED)


# ---------------------------------------------------------------------------------------------------------------------


def _shutter(record: CellRecord) -> tuple[float, float]:
    """Readout and exposure, s."""
    given = record.settings["sequence"]["set"]
    return float(given["depth.readout_s"]), float(given["depth.exposure_s"])


def _panels(sweep: Sweep) -> dict[tuple[str, float], _Methods]:
    """By motion and exposure, then by method and readout."""
    panels: dict[tuple[str, float], _Methods] = {
        (entry.name, exposure): {method: {} for method in sweep.methods}
        for entry in sweep.config.motions
        for exposure in sweep.config.exposures_s
    }
    for record in sweep.records:
        readout, exposure = _shutter(record)
        panels[record.settings["group"], exposure][record.method][readout] = record
    return panels


def _lost(sweep: Sweep, record: CellRecord) -> int:
    """Seeds without an error."""
    return sweep.config.noise.seeds - len(errors(record))


def _entry(sweep: Sweep, record: CellRecord | None) -> Entry:
    if record is None:
        return Entry(NOTHING)
    mean, low, high = log_interval(errors(record))
    if mean is None:
        return Entry("lost")
    text = significant(mean) + ("" if low is None else f" [{significant(low, 2)}, {significant(high, 2)}]")
    return Entry(text, mark="†" if _lost(sweep, record) else "")


def _rows(sweep: Sweep) -> list[dict[str, Any]]:
    rows = []
    for record in sweep.records:
        readout, exposure = _shutter(record)
        row: dict[str, Any] = {"motion": record.settings["group"], "readout_s": readout, "exposure_s": exposure}
        row |= {"method": record.method, "seeds": len(errors(record)), "lost": _lost(sweep, record)}
        for name in ERRORS:
            row |= dict(zip((name, f"{name}_low", f"{name}_high"), log_interval(errors(record, name)), strict=True))
        rows.append(row)
    return rows
