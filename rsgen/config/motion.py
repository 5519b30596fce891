"""What moves: the camera (`motion:`, `tremor:`) and rigid things in the scene (`objects:`)."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from rsgen.config.sections import Position, Section, Up
from rsgen.limits import limits

Coordinate = Annotated[float, limits(-1e4, 1e4, "m")]
Share = Annotated[float, limits(0, 1e4, "(relative)")]
Hertz = Annotated[float, limits(1e-6, 50, "Hz")]
Vector3 = tuple[Coordinate, Coordinate, Coordinate]

MAX_DURATION_S = 3600.0
"""Longer motions are refused: a length or speed in the wrong unit."""

MAX_STROKES_HZ = 4.0
"""Ways there or back a second, at most: two whole swings, ten 50 ms knots each."""

Fields = Mapping[str, tuple[str, ...]]
"""Names of fields by kind of motion."""

_NEEDED = {"line": ("position", "target"), "roll": ("position", "target"), "tour": ("waypoints",)}
_OPTIONAL = {"line": ("strokes", "sway", "sway_hz"), "roll": ("strokes",), "tour": ("closed", "sway", "sway_hz")}


def _check_kind(section: Section, kind: str, needs: Fields, takes: Fields) -> None:
    """Raises ValueError if a field that this kind of motion needs is missing, or one of another kind is set."""
    if missing := [name for name in needs[kind] if not getattr(section, name)]:
        raise ValueError(f"kind {kind} needs {' and '.join(missing)}")
    others = {name for k in needs for name in (*needs[k], *takes[k])} - {*needs[kind], *takes[kind]}
    fields = type(section).model_fields  # a default that is written out, as in sequence.yaml, does not count
    if foreign := sorted(name for name in others if getattr(section, name) != fields[name].default):
        raise ValueError(f"{', '.join(foreign)}: not for kind {kind}: remove")


class Waypoint(Section):
    """A place that a tour passes, and what the camera looks at there; world frame, metres."""

    position: Vector3 = Field(description="camera centre, world, m")
    target: Vector3 = Field(description="point in the middle of the image, world, m")


class TremorConfig(Section):
    """The hand's tremor, added to any trajectory, recorded or made; the ground truth gets knots fine enough for it."""

    position_m: Annotated[float, limits(0, 0.1, "m")] = Field(default=0.0003, description="along each axis, RMS, m")
    rotation_deg: Annotated[float, limits(0, 10, "deg")] = Field(default=0.05, description="about each axis, RMS, deg")
    band_hz: tuple[Hertz, Hertz] = Field(default=(8.0, 12.0), description="band of the tremor, Hz")
    seed: int | None = Field(default=None, ge=0, lt=2**31, description="seed of the tremor; default: the sequence's")

    @model_validator(mode="after")
    def _band_rises(self) -> TremorConfig:
        if not self.band_hz[0] < self.band_hz[1]:
            raise ValueError("band_hz: low and high must rise")
        return self


class MotionConfig(Section):
    """A motion of the body (depth camera), in place of a recorded trajectory. World: y up, metres."""

    kind: Literal["line", "roll", "tour"] = Field(
        description="line: to and fro along the camera's x axis; roll: to and fro about its z axis; tour: by waypoints"
    )
    length_m: Annotated[float, limits(1e-6, 1e4, "m")] = Field(description="length of the path, hand-shake included, m")
    mean_speed_m_s: Annotated[float, limits(1e-6, 1e4, "m/s")] = Field(
        description="mean translational speed, m/s; decides the duration"
    )
    mean_rotation_deg_s: Annotated[float, limits(1e-6, 1e4, "deg/s")] = Field(
        description="mean rotational speed, hand-shake included, deg/s"
    )
    position: Vector3 | None = Field(default=None, description="line, roll: first camera centre, world, m")
    target: Vector3 | None = Field(default=None, description="line, roll: first point looked at, world, m")
    strokes: int = Field(default=8, ge=1, le=1000, description="line: ways there or back; roll: swings")
    waypoints: tuple[Waypoint, ...] = Field(default=(), description="tour: where it passes and what it looks at")
    closed: bool = Field(
        default=True,
        description="tour: round and round until the length is used up; else once, scaled about the waypoints' mean",
    )
    sway: tuple[Share, Share, Share] = Field(
        default=(0.5, 1.0, 0.5),
        description="line, tour: slow turning about the camera's x, y, z; relative, its size follows from the targets",
    )
    sway_hz: Annotated[float, limits(1e-6, 2, "Hz: 50 ms knots follow no faster turning")] = Field(
        default=0.3, description="line, tour: frequency of the turning about y, Hz"
    )
    ramp_s: Annotated[float, limits(0.1, 1e4, "s")] = Field(
        default=1.0, description="time of the smooth start, and of the stop, s"
    )
    shake_position_m: Annotated[float, limits(0, 0.1, "m")] = Field(
        default=0.0, description="hand-shake along each axis, RMS, m"
    )
    shake_rotation_deg: Annotated[float, limits(0, 10, "deg")] = Field(
        default=0.0, description="hand-shake about each axis, RMS, deg"
    )
    shake_band_hz: tuple[Hertz, Hertz] = Field(
        default=(0.5, 6.0), description="band of the hand-shake, Hz; 50 ms knots follow up to about 6 Hz"
    )
    shake_exponent: Annotated[float, limits(0, 8, "(exponent)")] = Field(
        default=3.0, description="p of the hand-shake's power spectrum f^-p within the band"
    )
    clearance_m: Annotated[float, limits(0, 1e4, "m")] = Field(
        default=0.15, description="least distance of the path to the scene's surfaces, m"
    )
    seed: int | None = Field(
        default=None, ge=0, lt=2**31, description="seed of the hand-shake; default: the sequence's"
    )

    @property
    def duration_s(self) -> float:
        """Seconds from rest to rest."""
        return self.length_m / self.mean_speed_m_s

    @model_validator(mode="after")
    def _is_complete(self) -> MotionConfig:
        _check_kind(self, self.kind, _NEEDED, _OPTIONAL)
        fewest = 3 if self.closed else 2
        if self.kind == "tour" and len(self.waypoints) < fewest:
            raise ValueError(f"a {'closed' if self.closed else 'open'} tour needs at least {fewest} waypoints")
        if not any(self.sway):
            raise ValueError("sway: at least one axis must be above zero")
        return self

    @model_validator(mode="after")
    def _has_time(self) -> MotionConfig:
        low, high = self.shake_band_hz
        if not low < high <= 50:
            raise ValueError("shake_band_hz: low and high must rise, and end at 50 Hz at most")
        if not 2 * self.ramp_s < self.duration_s <= MAX_DURATION_S:
            raise ValueError(
                f"length_m / mean_speed_m_s = {self.duration_s:g} s: must lie above 2 ramp_s = {2 * self.ramp_s:g} s "
                f"and within {MAX_DURATION_S:g} s"
            )
        if self.kind != "tour" and self.strokes > MAX_STROKES_HZ * (self.duration_s - self.ramp_s):
            raise ValueError(f"strokes: more than {MAX_STROKES_HZ:g} a second in {self.duration_s:g} s: reduce")
        return self


MOST_OBJECTS = 8
"""Each is a scene of its own, in which every ray is looked for."""

Length = Annotated[float, limits(1e-3, 100, "m")]
Degrees = Annotated[float, limits(-1e5, 1e5, "deg")]
Channel = Annotated[float, Field(ge=0, le=1)]
Color = tuple[Channel, Channel, Channel]
# 50 ms knots follow four turns a second.
Period = Annotated[float, limits(0.25, 1e4, "s: 50 ms knots follow no faster motion")]

_OBJECT_NEEDS = {
    "file": ("file",),
    "waypoints": ("waypoints",),
    "circle": ("position", "radius_m", "period_s"),
    "swing": ("position", "pivot", "angle_deg", "period_s"),
    "drive": ("points", "speed_m_s"),
}
_OBJECT_TAKES: dict[str, tuple[str, ...]] = {
    "file": (),
    "waypoints": (),
    "circle": ("phase_deg", "rotation_deg", "spin_deg_s"),
    "swing": ("axis", "phase_deg", "rotation_deg", "spin_deg_s"),
    "drive": ("closed", "rotation_deg", "spin_deg_s"),
}


class ShapeConfig(Section):
    """A box, ball or upright cylinder about its own origin, where there is no mesh file."""

    kind: Literal["box", "sphere", "cylinder"] = Field(description="fills size_m; a sphere's may differ by axis")
    size_m: tuple[Length, Length, Length] = Field(description="extent along its x, y (up) and z, m")
    color: Color = Field(default=(0.5, 0.5, 0.5), description="reflectance, linear R G B")
    check_color: Color | None = Field(default=None, description="reflectance of every other check; none: one colour")
    check_m: Length = Field(default=0.05, description="edge of the checks, m")


class ObjectWaypoint(Section):
    """A pose that an object passes."""

    time_s: Annotated[float, limits(-1e6, 1e6, "s")] = Field(description="after the sequence's first pose, s")
    position: Position = Field(description="of the object's origin, world, m")
    rotation_deg: tuple[Degrees, Degrees, Degrees] = Field(
        default=(0, 0, 0), description="rotation vector, object to world, deg"
    )


class ObjectMotionConfig(Section):
    """How an object moves. World: y up, metres; it goes on before the first frame and after the last."""

    kind: Literal["file", "waypoints", "circle", "swing", "drive"] = Field(
        description="file: poses of a file; waypoints: poses given here; circle: round and round, level; "
        "swing: a pendulum; drive: along points, as a vehicle heads"
    )
    file: Path | None = Field(default=None, description="TUM file of T_world_object, on the sequence's clock")
    waypoints: tuple[ObjectWaypoint, ...] = Field(default=(), description="poses, times rising")
    position: Position | None = Field(
        default=None, description="circle: its centre; swing: the object hanging still; world, m"
    )
    radius_m: Length | None = Field(default=None, description="circle: radius, m")
    pivot: Position | None = Field(default=None, description="swing: a point of the axis it swings about, world, m")
    axis: Position = Field(default=(0, 0, 1), description="swing: direction of that axis, world")
    angle_deg: Annotated[float, limits(0.01, 170, "deg")] | None = Field(
        default=None, description="swing: from the middle to either end, deg"
    )
    period_s: Period | None = Field(default=None, description="circle, swing: once round, or to and fro, s")
    phase_deg: Degrees = Field(default=0.0, description="circle, swing: where in its period it begins, deg")
    points: tuple[Position, ...] = Field(default=(), description="drive: places passed, world, m")
    speed_m_s: Annotated[float, limits(1e-4, 100, "m/s")] | None = Field(default=None, description="drive: mean speed")
    closed: bool = Field(default=True, description="drive: round and round; else to and fro")
    rotation_deg: tuple[Degrees, Degrees, Degrees] = Field(
        default=(0, 0, 0), description="circle, swing, drive: the object in its own place, rotation vector, deg"
    )
    spin_deg_s: Annotated[float, limits(-720, 720, "deg/s")] = Field(
        default=0.0, description="circle, swing, drive: turning about the object's own y axis, deg/s"
    )
    knot_spacing_s: Annotated[float, limits(1e-3, 10, "s")] = Field(
        default=0.05, description="knot spacing of the object's spline, s"
    )

    @model_validator(mode="after")
    def _has_what_its_kind_needs(self) -> ObjectMotionConfig:
        _check_kind(self, self.kind, _OBJECT_NEEDS, _OBJECT_TAKES)
        if self.kind == "waypoints" and len(self.waypoints) < 2:
            raise ValueError("waypoints: give two at least")
        times = [w.time_s for w in self.waypoints]
        if any(b <= a for a, b in pairwise(times)):
            raise ValueError("waypoints: their times must rise")
        if self.kind == "drive" and len(self.points) < (3 if self.closed else 2):
            raise ValueError(f"points: give {3 if self.closed else 2} at least")
        if not any(self.axis):
            raise ValueError("axis: has no direction")
        return self


class ObjectConfig(Section):
    """A rigid thing that moves through the scene."""

    name: str = Field(pattern=r"^[A-Za-z0-9_-]{1,40}$", description="its name, part of file names in truth/objects")
    mesh: Path | None = Field(default=None, description="mesh file that trimesh reads, with its colours; or a shape")
    scale: Annotated[float, limits(1e-9, 1e9, "m")] = Field(default=1.0, description="metres per unit of the mesh")
    up: Up = Field(default="y", description="axis of the mesh that is up, the object's y")
    shape: ShapeConfig | None = Field(default=None, description="in place of a mesh")
    motion: ObjectMotionConfig = Field(description="where it goes")

    @model_validator(mode="after")
    def _looks_like_one_thing(self) -> ObjectConfig:
        if (self.mesh is None) == (self.shape is None):
            raise ValueError("give one of mesh, a file, and shape")
        return self


def content_of(config: ObjectConfig) -> dict[str, object]:
    """All that decides the object's bytes as plain YAML types; files by name, defaults left out."""
    content = config.model_dump(mode="json", exclude_defaults=True)
    for part, name in ((content, "mesh"), (content["motion"], "file")):
        if name in part:
            part[name] = Path(part[name]).name
    return content
