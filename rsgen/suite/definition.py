"""What a suite is: a YAML file with its version, its licence and its entries; its configs, and what they would take.

suite = read_definition("rollingrooms")
planned, skipped = suite.planned(tier="small", only=(), data=None, test_seed=None)
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, StringConstraints, ValidationError, model_validator

from rsgen.config.cameras import ColorConfig
from rsgen.config.config import Config, load_config
from rsgen.config.sections import Section
from rsgen.console.configs import config_file, configs_folder, scaled
from rsgen.console.tables import Table
from rsgen.errors import UserError, first_problem
from rsgen.files import read_yaml
from rsgen.motion.stretch import Ranges, draw_stretch
from rsgen.sequence.trajectory import read_trajectory

FORMAT = "rsgen-suite/1"
SUITE = "suite.yaml"
Word = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_-][A-Za-z0-9_.-]*$")]


@dataclass(frozen=True)
class RenderOptions:
    """What of a suite is rendered; each field's text is also the help of the option of its name."""

    tier: Annotated[str | None, "only sequences of this tier (default: all)", "TIER"] = None
    only: Annotated[
        tuple[str, ...] | None, "only sequences whose name, group or role is this; * and ? allowed", "GLOB"
    ] = None
    data: Annotated[Path | None, "folder with recorded trajectories that do not ship, such as ICL-NUIM's", "DIR"] = None
    hold_back_truth: Annotated[
        Path | None, "put all of test sequences that gives their motion away into this folder instead", "DIR"
    ] = None
    test_seed: Annotated[int | None, "seeds of test sequences are drawn from this number: keep it to yourself", "N"] = (
        None
    )


class Ladder(Section):
    """One sequence a value: all `fields` (dotted, s) of the config are set to it, and the name tells it in ms."""

    fields: tuple[str, ...] = Field(min_length=1)
    values_s: tuple[float, ...] = Field(min_length=1)


class Draws(Section):
    """So many sequences along random stretches of the motion; ranges as `Ranges` has them, s."""

    count: int = Field(ge=1, le=1_000_000)
    seed: int = Field(ge=0, lt=2**31)
    readout: tuple[float, float] = (0.0, 0.030)
    exposure: tuple[float, float] = (0.0, 0.0)
    speed: tuple[float, float] = (0.7, 2.0)
    turn_deg: float = Field(default=20.0, ge=0, le=180)


class Entry(Section):
    """A sequence, or several by a ladder or by lot. set: fields of the config by dotted names. width: px of all images,
    lenses in proportion. frames: of a stretch of the motion from start_s on; without, all of it. data: fields of the
    config that are files which do not ship, to be looked for in --data. group: of sequences that differ in one thing.
    """

    name: Word
    config: str
    tier: Word = "full"
    role: Literal["train", "test"] = "train"
    group: str = ""
    set: dict[str, Any] = Field(default={})
    width: int | None = Field(default=None, ge=16)
    frames: int | None = Field(default=None, ge=2)
    start_s: float = Field(default=0.0, ge=0)
    data: dict[str, str] = Field(default={})
    ladder: Ladder | None = None
    draw: Draws | None = None

    @model_validator(mode="after")
    def _is_one_or_several(self) -> Entry:
        if self.draw is not None and (self.frames is None or self.ladder is not None):
            raise ValueError("draw: needs frames, the length of each sequence, and no ladder")
        return self

    def single(self) -> Iterator[Entry]:
        """The entries that a ladder stands for, or this one."""
        if self.ladder is None:
            yield self
            return
        for value in self.ladder.values_s:
            fields = dict.fromkeys(self.ladder.fields, value)
            name = f"{self.name}_{1000 * value:g}ms"
            yield self.model_copy(update={"name": name, "ladder": None, "set": self.set | fields})


class Definition(Section):
    """A suite. license: of the images, by its SPDX name; homepage: of the programs that made them."""

    format: Literal["rsgen-suite/1"]
    name: Word
    version: Annotated[str, StringConstraints(pattern=r"^\d+(\.\d+)*$")]
    license: str
    about: str
    homepage: str = ""
    entries: tuple[Entry, ...] = Field(min_length=1)

    @property
    def tiers(self) -> tuple[str, ...]:
        """Their names, in the order of the entries."""
        return tuple(dict.fromkeys(entry.tier for entry in self.entries))

    def chosen(self, tier: str | None, only: Sequence[str]) -> list[Entry]:
        """Entries of the tier (None: all) whose name or group matches a pattern, ladders spread. Raises UserError."""
        if tier is not None and tier not in self.tiers:
            raise UserError(f"--tier {tier}: {self.name} has {', '.join(self.tiers)}")
        entries = [one for entry in self.entries if tier in (None, entry.tier) for one in entry.single()]
        if only:
            entries = [e for e in entries if any(fnmatchcase(w, p) for w in (e.name, e.group, e.role) for p in only)]
        if not entries:
            raise UserError(f"--only {' '.join(only)}: no sequence of {self.name} has such a name, group or role")
        return entries

    def planned(
        self, tier: str | None, only: Sequence[str], data: Path | None, test_seed: int | None
    ) -> tuple[list[Planned], list[str]]:
        """The sequences to render, and a line for each that is skipped because --data lacks a file of it.

        test_seed: from which seeds of test sequences are drawn, in place of their configs'. Raises UserError.
        """
        planned, skipped = list[Planned](), list[str]()
        for entry in self.chosen(tier, only):
            lacking = [file for file in entry.data.values() if data is None or not (data / file).is_file()]
            if lacking:
                where = "no --data was given" if data is None else f"it is not in {data}"
                skipped.append(
                    f"{entry.name}: skipped: needs {lacking[0]}, and {where} (see configs/{entry.config}.yaml)"
                )
            else:
                planned += _of_entry(entry, data, test_seed)
        names = [one.name for one in planned]
        if twice := [name for name in dict.fromkeys(names) if names.count(name) > 1]:
            raise UserError(f"suite {self.name}: two sequences are named {twice[0]}")
        return planned, skipped


@dataclass(frozen=True)
class Planned:
    """One sequence to render; name: of its folder, too."""

    name: str
    entry: Entry
    config: Config

    def about(self) -> dict[str, Any]:
        """Its entry in suite.yaml."""
        entry, config = self.entry, self.config
        ms = {name: round(1000 * camera.readout_s, 6) for name, camera in config.cameras.items()}
        return {
            "name": self.name, "tier": entry.tier, "role": entry.role, "group": entry.group, "config": entry.config,
            "scene": config.scene.file.parent.name, "readout_ms": ms,
        }  # fmt: skip


def read_definition(name: str) -> Definition:
    """The suite of that name that ships, or of a YAML file. Raises UserError."""
    shipped = suites_folder() / f"{name}.yaml"
    path = Path(name) if Path(name).is_file() or not shipped.is_file() else shipped
    if not path.is_file():
        known = ", ".join(sorted(file.stem for file in suites_folder().glob("*.yaml")))
        raise UserError(f"{name}: is neither a file nor a suite that ships: {known}")
    try:
        return Definition.model_validate(read_yaml(path))
    except ValidationError as error:
        raise UserError(f"{path}: {first_problem(error)}") from None


def suites_folder() -> Path:
    """The folder of the suites that ship."""
    return configs_folder() / "suites"


# ---------------------------------------------------------------------------------------------------------------------


def _of_entry(entry: Entry, data: Path | None, test_seed: int | None) -> list[Planned]:
    path = config_file(entry.config)
    if not path.is_file():
        raise UserError(f"entry {entry.name}: config {entry.config}: is neither a file nor a name of 'rsgen scenes'")
    fields = {} if entry.width is None else scaled(path, read_yaml(path), entry.width)
    fields |= entry.set
    if data is not None:
        fields |= {field: str((data / file).resolve()) for field, file in entry.data.items()}
    if test_seed is not None and entry.role == "test":
        lot = np.random.SeedSequence([test_seed, zlib.crc32(entry.name.encode())])
        fields["seed"] = int(lot.generate_state(1)[0] >> 1)
    if entry.draw is not None:
        return list(_drawn(entry, entry.draw, path, fields))
    config = _config(path, fields | {"name": entry.name})
    if entry.frames is not None:
        stretch = {"start_s": entry.start_s, "duration_s": _lasts(config, entry.frames)}
        config = _config(path, fields | {"name": entry.name, "stretch": stretch})
    return [Planned(entry.name, entry, config)]


def _drawn(entry: Entry, draw: Draws, path: Path, fields: dict[str, Any]) -> Iterator[Planned]:
    """The sequences by lot of an entry, each of which depends on its number alone, not on how many there are."""
    from rsgen.produce.parts import load_motion

    assert entry.frames is not None
    whole = _config(path, fields | {"name": entry.name})
    motion, rate = load_motion(whole), whole.cameras[whole.view].rate_hz
    span = [(motion.first_stamp, motion.last_stamp)]
    ranges = Ranges(entry.frames, draw.readout, draw.exposure, draw.speed, draw.turn_deg)
    for index in range(draw.count):
        drawn = draw_stretch(ranges, draw.seed, index, span, [rate])
        stretch = {
            "start_s": drawn.start_s - motion.first_stamp, "duration_s": _lasts(whole, entry.frames),
            "speed": drawn.speed, "turn_deg": np.degrees(drawn.turn).tolist(),
        }  # fmt: skip
        name = f"{entry.name}_{index:06d}"
        own = {f"{camera}.{field}": value for camera in ("color", "depth")
               for field, value in (("readout_s", drawn.readout_s), ("exposure_s", drawn.exposure_s))}  # fmt: skip
        yield Planned(name, entry, _config(path, fields | own | {"name": name, "stretch": stretch, "seed": drawn.seed}))


def _lasts(config: Config, frames: int) -> float:
    """Seconds in which every camera takes so many frames, but for those of another rate."""
    return max(camera.offset_s + (frames - 1) / camera.rate_hz for camera in config.cameras.values())


def _config(path: Path, fields: dict[str, Any]) -> Config:
    return load_config(path, {name: json.dumps(value) for name, value in fields.items()})


# Seconds on two slow cores, everything written, of a sample, a depth, an image and a sequence: lr_kt2, 120 frames at
# 320x240 and 640x480 in 36 and 71 s.
_S_PER_SAMPLE, _S_PER_DEPTH, _S_PER_IMAGE, _S_PER_SEQUENCE = 1.2e-7, 3e-7, 0.05, 3.0
# A pixel's bytes, of colour and of depth with its exact image; of the poses of a line; of the scene's surface.
_BYTES_PER_COLOR, _BYTES_PER_DEPTH, _BYTES_PER_LINE, _BYTES_OF_SCENE = 1.7, 4.1, 56.0, 7.1e6


@dataclass(frozen=True)
class Estimate:
    """What sequences take: frames of all cameras, s of rendering on two cores, bytes; bakes of light come on top."""

    frames: int
    seconds: float
    bytes: float
    bakes: int

    def text(self) -> str:
        """In one line."""
        hours, gigabytes = self.seconds / 3600, self.bytes / 1e9
        took = f"{hours:.1f} h" if hours >= 1 else f"{self.seconds / 60:.0f} min"
        light = f"{self.bakes} bakes of light, minutes each" if self.bakes != 1 else "a bake of light, minutes"
        return f"{self.frames} images, about {gigabytes:.2g} GB and {took} of rendering, and {light}"


def estimate(configs: Iterable[Config]) -> Estimate:
    """By numbers of images, pixels and samples alone: other scenes and machines differ by a factor of two or three."""
    frames, seconds, size, baked = 0, 0.0, 0.0, set()
    for config in configs:
        lasts, size, seconds = _duration(config), size + _BYTES_OF_SCENE, seconds + _S_PER_SEQUENCE
        baked.add(f"{config.scene} {config.light}")
        for camera in config.cameras.values():
            count, pixels = int((lasts - camera.offset_s) * camera.rate_hz + 1e-6) + 1, camera.width * camera.height
            frames, size = frames + count, size + count * camera.height * _BYTES_PER_LINE
            if isinstance(camera, ColorConfig):
                images = 1 + len(config.truth.images)
                seconds += count * images * (_S_PER_IMAGE + pixels * camera.spp * _S_PER_SAMPLE)
                size += count * images * pixels * _BYTES_PER_COLOR
            else:
                seconds += count * (_S_PER_IMAGE + pixels * _S_PER_DEPTH)
                size += count * pixels * _BYTES_PER_DEPTH
    return Estimate(frames, seconds, size, len(baked))


def _duration(config: Config) -> float:
    """Of a sequence, s, without making its motion."""
    if config.stretch is not None:
        return config.stretch.duration_s
    if config.motion is not None:
        return config.motion.duration_s
    assert config.trajectory.file is not None  # or there were a motion
    stamps = read_trajectory(config.trajectory.file, config.trajectory.format, config.trajectory.icl_start).stamps
    return float(stamps[-1] - stamps[0])


def describe_suite(suite: Definition) -> str:
    """Its sequences by tier, and what those that need no --data would take. Raises UserError."""
    blocks = [f"{suite.name} {suite.version} ({suite.license}): {suite.about}"]
    for tier in suite.tiers:
        entries = suite.chosen(tier, ())
        rows = tuple((entry.name, entry.role, entry.group, entry.config, _length(entry)) for entry in entries)
        blocks.append(Table((f"tier {tier}", "role", "group", "config", "length"), rows, words=(0, 1, 2, 3, 4)).text())
        planned, skipped = suite.planned(tier, (), None, None)
        without = f", without {len(skipped)} that need --data" if skipped else ""
        blocks.append(f"{len(planned)} sequences: {estimate(p.config for p in planned).text()}{without}")
    return "\n".join(blocks)


def _length(entry: Entry) -> str:
    several = f"{entry.draw.count} of " if entry.draw else ""
    needs = f", needs {', '.join(entry.data.values())}" if entry.data else ""
    return several + ("the whole motion" if entry.frames is None else f"{entry.frames} frames") + needs
