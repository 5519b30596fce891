"""The validated configuration of one sequence: a YAML file plus `--section.field value` overrides.

The whole file is validated at once and errors name the field. Relative paths in a file are relative to that file,
those of an override to the working directory.
"""

from __future__ import annotations

from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

import numpy as np
import yaml
from pydantic import BaseModel, Field, ValidationError, model_validator

from rsgen.array_types import FloatArray
from rsgen.config.cameras import ColorConfig, DepthConfig, StreamConfig
from rsgen.config.faults import FaultsConfig, as_declared, from_recorded, moved_to, to_recorded
from rsgen.config.motion import MOST_OBJECTS, MotionConfig, ObjectConfig, TremorConfig, content_of
from rsgen.config.presets import Preset, with_presets
from rsgen.config.rig import RigColorConfig, RigStream, T_cam_body, check_stereo, with_left_cameras
from rsgen.config.sections import (
    ImuConfig,
    LightConfig,
    MocapConfig,
    SceneConfig,
    Section,
    StretchConfig,
    TargetConfig,
    TrajectoryConfig,
    TruthConfig,
)
from rsgen.errors import UserError
from rsgen.files import parse_yaml
from rsgen.inputs import check_input
from rsgen.limits import Matrix4, RigidTransform
from rsgen.sequence.format import IMAGE_KINDS, MOST_CAMERAS, STREAMS, CameraName

__all__ = ["Config", "StreamConfig", "describe_fields", "load_config", "validate_config"]

Backend = Literal["auto", "llvm", "cuda"]
# Fields that change how fast or where a sequence is made, never one byte of it.
_NOT_CONTENT = {"backend", "faults"}
# Sections that are left out where they are not set: sequences rendered before there were any stay the same.
_LATER = ("target", "objects", "streams", "stretch")
# Sections of a sequence of two cameras, in place of which a rig has `streams`.
_TWO_CAMERAS = ("color", "depth", "T_color_depth")
# Fields that hold paths, by section.
_PATHS = (("trajectory", "file"), ("scene", "file"))
# PyYAML lets impossible dates, endless digits and endless nesting through as these.
_BAD_YAML = (yaml.YAMLError, ValueError, RecursionError)


class Config(Section):
    """One sequence."""

    name: str = Field(
        pattern=r"^[A-Za-z0-9_-][A-Za-z0-9_.-]*$", description="the sequence's name, also its default folder"
    )
    preset: Preset | None = Field(
        default=None,
        description="kinect_v1, xtion: cameras, noise, exposure, driver, tremor of these; other fields override",
    )
    trajectory: TrajectoryConfig = TrajectoryConfig()
    motion: MotionConfig | None = None
    tremor: TremorConfig | None = None
    stretch: StretchConfig | None = None
    scene: SceneConfig
    target: TargetConfig | None = None
    objects: tuple[ObjectConfig, ...] = Field(
        default=(), max_length=MOST_OBJECTS, description="things that move by themselves (docs/format.md); []: none"
    )
    light: LightConfig = LightConfig()
    color: ColorConfig = ColorConfig()
    depth: DepthConfig = DepthConfig()
    T_color_depth: RigidTransform = Field(
        default=((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)),
        description="depth-camera to colour-camera coordinates, m",
    )
    streams: dict[CameraName, RigStream] = Field(
        default={}, max_length=MOST_CAMERAS,
        description="a rig: any cameras by name, in place of color, depth and T_color_depth (docs/format.md); {}: none",
    )  # fmt: skip
    truth: TruthConfig = TruthConfig()
    imu: ImuConfig | None = None
    mocap: MocapConfig | None = None
    faults: FaultsConfig | None = None
    seed: int = Field(default=0, ge=0, lt=2**31, description="seed of every random number")
    backend: Backend = Field(default="auto", description="where Dr.Jit runs")

    @model_validator(mode="after")
    def _has_one_motion(self) -> Config:
        if (self.trajectory.file is None) == (self.motion is None):
            given = "one of them, not both" if self.motion else "a recorded file, or a section 'motion'"
            raise ValueError(f"trajectory.file: is required: give {given}")
        return self

    @model_validator(mode="after")
    def _names_its_objects(self) -> Config:
        names = [thing.name for thing in self.objects]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"objects: two are named {twice[0]!r}: give each a name of its own")
        if self.objects and self.light.mode == "path":
            raise ValueError("objects: are rendered in baked light only: set light.mode baked")
        return self

    @model_validator(mode="after")
    def _is_a_rig_or_two_cameras(self) -> Config:
        if not self.streams:
            return self
        if twice := sorted(self.model_fields_set & set(_TWO_CAMERAS)):
            raise ValueError(f"{twice[0]}: a rig has its cameras in streams: describe it there, or remove streams")
        faults = self.injected
        if not faults.declared is faults.color is faults.depth is None:
            raise ValueError("faults: of a rig can be those of the IMU only: remove the others, or streams")
        if self.objects and any(isinstance(c, RigColorConfig) and c.dots is not None for c in self.streams.values()):
            raise ValueError("objects: a projector's dots do not fall on what moves: remove the objects, or the dots")
        check_stereo(self.streams)
        return self

    @model_validator(mode="after")
    def _has_possible_faults(self) -> Config:
        for name in STREAMS:
            try:
                _ = self.declared_color if name == "color" else self.declared_depth
            except ValueError as error:
                raise ValueError(f"faults.declared.{name}.{error}") from None
        if self.imu is None and self.injected.imu is not None:
            raise ValueError("faults.imu: there is no IMU: add a section imu, or remove it")
        return self

    @property
    def cameras(self) -> dict[str, ColorConfig | DepthConfig]:
        """All cameras by name: of a rig, else "color" and "depth"."""
        return {**self.streams} if self.streams else {"color": self.color, "depth": self.depth}

    def T_cam_body(self, camera: str) -> FloatArray:
        """Pose (4, 4) of a camera in the body; of two cameras the body is the depth camera."""
        if self.streams:
            return T_cam_body(self.streams[camera])
        return np.asarray(self.T_color_depth, float) if camera == "color" else np.eye(4)

    @property
    def view(self) -> str:
        """The camera whose view light is made for: the first one of colour, else of grey, else of depth."""
        if not self.streams:
            return "color"
        of_kind = (name for kind in IMAGE_KINDS for name, camera in self.streams.items() if camera.kind == kind)
        return next(of_kind, next(iter(self.streams)))

    @property
    def injected(self) -> FaultsConfig:
        """The faults; none where the section is left out."""
        return self.faults or FaultsConfig()

    @property
    def declared_color(self) -> ColorConfig:
        """The colour camera that the sequence states: the true one, unless `faults.declared` replaces it."""
        declared = self.injected.declared
        return as_declared(self.color, None if declared is None else declared.color)

    @property
    def declared_depth(self) -> DepthConfig:
        """The depth camera that the sequence states: the true one, unless `faults.declared` replaces it."""
        declared = self.injected.declared
        return as_declared(self.depth, None if declared is None else declared.depth)

    @property
    def declared_T_color_depth(self) -> Matrix4:
        """The pose between the cameras that the sequence states."""
        declared = self.injected.declared
        return self.T_color_depth if declared is None or declared.T_color_depth is None else declared.T_color_depth

    def content(self) -> dict[str, Any]:
        """All that decides the sequence's bytes, as sequence.yaml records it: plain YAML types, files by name."""
        unset = {name for name in _LATER if not getattr(self, name)}
        absent = set(_TWO_CAMERAS) if self.streams else set()
        content = self.model_dump(mode="json", exclude=_NOT_CONTENT | unset | absent)
        for section, name in _PATHS:
            if content[section][name] is not None:
                content[section][name] = Path(content[section][name]).name
        content["truth"] = self.truth.content()
        for section in content.get("streams", content).values():  # what cameras had no fields for before stays away
            noise = section.get("noise") if isinstance(section, dict) else None
            if noise is not None and noise.get("region_sigma_px") == 0:
                del noise["region_sigma_px"], noise["region_px"]
        if self.imu is not None:
            content["imu"] = self.imu.content()
        if self.objects:
            content["objects"] = [content_of(thing) for thing in self.objects]
        content["scene"] = {k: v for k, v in content["scene"].items() if v != SceneConfig.model_fields[k].default}
        return to_recorded(content, self.injected)


def load_config(path: Path, overrides: dict[str, str] | None = None) -> Config:
    """Read and validate a YAML config with overrides `{'color.spp': '64'}` (values parsed as YAML).

    Raises UserError naming the file and every wrong field on one line.
    """
    path = Path(path)
    check_input(path)
    try:
        data = parse_yaml(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a text file"
        raise _error(f"config {path}: cannot be read ({reason})") from None
    except _BAD_YAML as error:
        mark = getattr(error, "problem_mark", None)
        where = f" line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or getattr(error, "reason", None) or type(error).__name__
        raise _error(f"config {path}:{where} is not valid YAML ({problem})") from None
    if not isinstance(data, dict):
        raise _error(f"config {path}: expected a mapping of fields such as 'name:', 'trajectory:', 'scene:'")
    for where, part, name in _paths_in(data):
        try:
            part[name] = str(path.parent / Path(part[name]).expanduser())
        except RuntimeError:
            raise _error(f"config {path}: {where}.{name}: no such user's home, got {part[name]!r}") from None
    for key, text in (overrides or {}).items():
        _set(data, key, text)
    return validate_config(data, f"config {path}")


def _paths_in(data: dict[str, Any]) -> list[tuple[str, dict[str, Any], str]]:
    """(section, its fields, field) of every path that a config file gives."""
    places = [(section, data.get(section), name) for section, name in _PATHS]
    things = data.get("objects")
    for k, thing in enumerate(things if isinstance(things, list) else []):
        places.append((f"objects.{k}", thing, "mesh"))
        places.append((f"objects.{k}.motion", thing.get("motion") if isinstance(thing, dict) else None, "file"))
    return [(where, part, name) for where, part, name in places
            if isinstance(part, dict) and isinstance(part.get(name), str)]  # fmt: skip


def recorded_config(data: dict[str, Any], where: str) -> Config:
    """A config as a sequence.yaml records it (`Config.content`). Raises UserError as `validate_config` does."""
    return validate_config(from_recorded(data), where)


def validate_config(data: dict[str, Any], where: str) -> Config:
    """A config from plain YAML types; `where` begins the message. Raises UserError naming every wrong field."""
    try:
        data = with_presets(data)
        if "streams" in data:
            data = data | {"streams": with_left_cameras(data["streams"])}
        return Config.model_validate(data)
    except ValidationError as error:
        problems = "; ".join(_problem(e) for e in error.errors())
        raise _error(f"{where}: {problems}") from None


def _error(text: str) -> UserError:
    """One printable line, whatever names and values a file holds."""
    return UserError("".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text))


def _set(data: dict[str, Any], key: str, text: str) -> None:
    *sections, name = key.split(".")
    for section in sections:
        inner = data.setdefault(section, {})
        if not isinstance(inner, dict):
            raise _error(f"override --{key}: '{section}' is not a section")
        data = inner
    try:
        data[name] = parse_yaml(text)
    except _BAD_YAML:
        shown = text if len(text) <= 60 else f"{text[:57]}..."
        raise _error(f"override --{key}: '{shown}' is not a valid value") from None


def _problem(error: Any) -> str:
    parts = list(error["loc"])
    if parts[:1] == ["streams"] and len(parts) > 2:
        del parts[2]  # which of the kinds of cameras it was taken for
    where = ".".join(map(str, parts)) or "config"
    message = error["msg"].removeprefix("Value error, ")
    if error["type"] == "extra_forbidden":
        if (now := moved_to(where)) is not None:
            return f"{where}: is now {now}"
        return f"{where}: no such field (see 'rsgen render --help')"
    if error["type"] == "missing":
        return f"{where}: is required"
    given = repr(error["input"])
    return f"{where}: {message}, got {given if len(given) <= 60 else given[:57] + '...'}"


def describe_fields(section: type[BaseModel] = Config, prefix: str = "") -> list[tuple[str, str, str]]:
    """Rows (dotted name, default, description) of every field that a config or an override can set."""
    rows: list[tuple[str, str, str]] = []
    for name, field in section.model_fields.items():
        # An optional section, `Section | None`, is written like any other.
        either = get_origin(field.annotation) in (Union, UnionType)
        inner = next(t for t in get_args(field.annotation) if t is not NoneType) if either else field.annotation
        if isinstance(inner, type) and issubclass(inner, BaseModel):
            if either:
                what = str(inner.__doc__).partition("\n")[0].rstrip(".")
                rows.append((prefix + name, "none", f"{what}: {{}} for all defaults, null for none"))
            rows += describe_fields(inner, f"{prefix}{name}.")
        else:
            default = "required" if field.is_required() else str(field.default)
            rows.append((prefix + name, default, field.description or ""))
    return rows
