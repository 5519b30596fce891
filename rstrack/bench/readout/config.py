"""What the readout sweep is to run: its YAML file, and what the command line narrows it down to.

config = load_sweep_config(Path("configs/readout_sweep.yaml"))
sweep = narrow(config, width=320, readouts_s=(0.0, 0.028))
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from rsgen.errors import UserError, first_problem
from rsgen.files import read_yaml
from rstrack.bench.methods.config import Name
from rstrack.options import CLOUD_PEERS, METHODS, PEERS, SLAM_PEERS

_PACKAGES = {"kiss-icp": "kiss_icp", "small-gicp": "small_gicp", "orb-slam3": "pyorbslam3"}
Seconds = Annotated[float, Field(ge=0.0, le=1.0)]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class MotionEntry(_Section):
    """One motion."""

    name: Name = Field(description="of its panel, and the beginning of its folders' names")
    config: Path = Field(description="what 'rsgen render' makes it from, relative to this file")
    overrides: dict[str, Any] = Field(default={}, description="fields of the config that are to be others")


class NoiseEntry(_Section):
    """What is added to images when they are read, see `rstrack.data.noise.with_noise`."""

    depth: float = Field(default=0.0, ge=0.0, description="sigma of depth z is this times z squared, 1/m")
    intensity: float = Field(default=0.0, ge=0.0, description="sigma of grey values in [0, 1]")
    seeds: int = Field(default=3, ge=1, le=1000, description="how many times, each with other noise")


class SweepConfig(_Section):
    """The whole sweep: every readout with every exposure, motion and seed, for every method."""

    motions: tuple[MotionEntry, ...] = Field(min_length=1, description="what is rendered")
    overrides: dict[str, Any] = Field(default={}, description="fields of all their configs")
    readouts_s: tuple[Seconds, ...] = Field(min_length=1, description="of both cameras, s")
    exposures_s: tuple[Seconds, ...] = Field(default=(0.0,), min_length=1, description="of both cameras, s")
    noise: NoiseEntry = Field(default=NoiseEntry(), description="of the images")
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
        unknown = [name for name in self.methods if name not in known_methods()]
        if unknown:
            raise ValueError(f"methods: no method '{unknown[0]}': choose from {', '.join(known_methods())}")
        return self


def known_methods() -> tuple[str, ...]:
    """Ours and the peers'."""
    return (*METHODS, *PEERS, *CLOUD_PEERS, *SLAM_PEERS)


def is_sweep(path: Path) -> bool:
    """Whether a config of 'rstrack bench' is one of a sweep. Raises UserError: it cannot be read."""
    return "readouts_s" in read_yaml(Path(path))


def load_sweep_config(path: Path) -> SweepConfig:
    """Read and validate; paths come out relative to the working directory. Raises UserError naming file and entry."""
    path = Path(path)
    try:
        config = SweepConfig.model_validate(read_yaml(path))
    except ValidationError as error:
        raise UserError(f"{path}: {first_problem(error)} (configs/readout_sweep.yaml is an example)") from None
    here = tuple(entry.model_copy(update={"config": path.parent / entry.config}) for entry in config.motions)
    return config.model_copy(update={"motions": here})


def narrow(
    config: SweepConfig,
    *,
    motions: Sequence[str] = (),
    methods: Sequence[str] = (),
    readouts_s: Sequence[float] = (),
    exposures_s: Sequence[float] = (),
    seeds: int | None = None,
    width: int | None = None,
    frames: int | None = None,
) -> SweepConfig:
    """The sweep with what is given in place of what its file says. Raises UserError: a value or name that is none."""
    names = [entry.name for entry in config.motions]
    for name in motions:
        if name not in names:
            raise UserError(f"--sequence {name}: the sweep has no such motion: it has {', '.join(names)}")
    chosen = config.model_dump() | {
        "motions": [entry.model_dump() for entry in config.motions if not motions or entry.name in motions],
        "noise": config.noise.model_dump() | ({} if seeds is None else {"seeds": seeds}),
    }
    given = {
        "methods": methods, "readouts_s": readouts_s, "exposures_s": exposures_s, "width": width, "frames": frames,
    }  # fmt: skip
    chosen |= {name: value for name, value in given.items() if value}
    try:
        return SweepConfig.model_validate(chosen)
    except ValidationError as error:
        raise UserError(f"the sweep: {first_problem(error)}") from None


def installed(methods: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The methods that can run here, and those whose packages are not installed."""
    lacking = tuple(
        name for name in methods if name not in METHODS and find_spec(_PACKAGES.get(name, "open3d")) is None
    )
    return tuple(name for name in methods if name not in lacking), lacking
