"""What the list `objects:` of a sequence's configuration holds: rigid things, each with a motion of its own."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from rsgen.config.sections import Coordinate, Section, Up
from rsgen.limits import limits

MOST_OBJECTS = 8
"""Each is a scene of its own, in which every ray is looked for."""

Vector3 = tuple[Coordinate, Coordinate, Coordinate]
Length = Annotated[float, limits(1e-3, 100, "m")]
Degrees = Annotated[float, limits(-1e5, 1e5, "deg")]
Channel = Annotated[float, Field(ge=0, le=1)]
Color = tuple[Channel, Channel, Channel]
# 50 ms knots follow four turns a second.
Period = Annotated[float, limits(0.25, 1e4, "s: 50 ms knots follow no faster motion")]

_NEEDED = {
    "file": ("file",),
    "waypoints": ("waypoints",),
    "circle": ("position", "radius_m", "period_s"),
    "swing": ("position", "pivot", "angle_deg", "period_s"),
    "drive": ("points", "speed_m_s"),
}
_OPTIONAL: dict[str, tuple[str, ...]] = {
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
    position: Vector3 = Field(description="of the object's origin, world, m")
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
    position: Vector3 | None = Field(
        default=None, description="circle: its centre; swing: the object hanging still; world, m"
    )
    radius_m: Length | None = Field(default=None, description="circle: radius, m")
    pivot: Vector3 | None = Field(default=None, description="swing: a point of the axis it swings about, world, m")
    axis: Vector3 = Field(default=(0, 0, 1), description="swing: direction of that axis, world")
    angle_deg: Annotated[float, limits(0.01, 170, "deg")] | None = Field(
        default=None, description="swing: from the middle to either end, deg"
    )
    period_s: Period | None = Field(default=None, description="circle, swing: once round, or to and fro, s")
    phase_deg: Degrees = Field(default=0.0, description="circle, swing: where in its period it begins, deg")
    points: tuple[Vector3, ...] = Field(default=(), description="drive: places passed, world, m")
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
        needed = _NEEDED[self.kind]
        if missing := [name for name in needed if getattr(self, name) in (None, ())]:
            raise ValueError(f"kind {self.kind} needs {' and '.join(missing)}")
        mine = {*needed, *_OPTIONAL[self.kind], "kind", "knot_spacing_s"}
        fields = type(self).model_fields
        if foreign := sorted(n for n in fields.keys() - mine if getattr(self, n) != fields[n].default):
            raise ValueError(f"{', '.join(foreign)}: not for kind {self.kind}: remove")
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
