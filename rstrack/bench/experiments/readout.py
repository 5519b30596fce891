"""The readout sweep, what each tracker's error comes to as the shutter gets slower: its YAML file, and its cells.

config = narrow(load_sweep(Path("configs/readout_sweep.yaml")), width=320, readouts_s=(0.0, 0.028))
outcome = run_cells(sweep_benchmark(config, config.methods), Path("out/readout_sweep"), Sources())
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, ValidationError, field_validator, model_validator

from rsgen.errors import UserError, first_problem, how_to_install
from rsgen.files import read_yaml
from rstrack.bench.cells import Benchmark, Cell
from rstrack.bench.definitions import OTHERS, CaseEntry, Name, NoiseEntry, SequenceEntry, StrictModel, validated
from rstrack.bench.experiments.methods import method_entry, variants
from rstrack.bench.measures.track import package_of
from rstrack.options import METHODS, Options

Seconds = Annotated[float, Field(ge=0.0, le=1.0)]
STREAMS = ("color", "depth")


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
    config = validated(SweepConfig, path, "configs/readout_sweep.yaml")
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
    try:
        return SweepConfig.model_validate(chosen)
    except ValidationError as error:
        raise UserError(f"the sweep: {first_problem(error)}") from None


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
