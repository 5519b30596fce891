"""What the `motion:` section of a sequence's configuration holds: kind of motion, targets, hand-shake."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from rsgen.limits import limits

Coordinate = Annotated[float, limits(-1e4, 1e4, "m")]
Share = Annotated[float, limits(0, 1e4, "(relative)")]
Hertz = Annotated[float, limits(1e-6, 50, "Hz")]
Vector3 = tuple[Coordinate, Coordinate, Coordinate]

MAX_DURATION_S = 3600.0
"""Longer motions are refused: a length or speed in the wrong unit."""

MAX_STROKES_HZ = 4.0
"""Ways there or back a second, at most: two whole swings, ten 50 ms knots each."""

_NEEDED = {"line": ("position", "target"), "roll": ("position", "target"), "tour": ("waypoints",)}
_OPTIONAL = {"line": ("strokes", "sway", "sway_hz"), "roll": ("strokes",), "tour": ("closed", "sway", "sway_hz")}


class Waypoint(BaseModel):
    """A place that a tour passes, and what the camera looks at there; world frame, metres."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    position: Vector3 = Field(description="camera centre, world, m")
    target: Vector3 = Field(description="point in the middle of the image, world, m")


class TremorConfig(BaseModel):
    """The hand's tremor, added to any trajectory, recorded or made; the ground truth gets knots fine enough for it."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    position_m: Annotated[float, limits(0, 0.1, "m")] = Field(default=0.0003, description="along each axis, RMS, m")
    rotation_deg: Annotated[float, limits(0, 10, "deg")] = Field(default=0.05, description="about each axis, RMS, deg")
    band_hz: tuple[Hertz, Hertz] = Field(default=(8.0, 12.0), description="band of the tremor, Hz")
    seed: int | None = Field(default=None, ge=0, lt=2**31, description="seed of the tremor; default: the sequence's")

    @model_validator(mode="after")
    def _band_rises(self) -> TremorConfig:
        if not self.band_hz[0] < self.band_hz[1]:
            raise ValueError("band_hz: low and high must rise")
        return self


class MotionConfig(BaseModel):
    """A motion of the body (depth camera), in place of a recorded trajectory. World: y up, metres."""

    model_config = ConfigDict(extra="forbid", frozen=True)

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
        mine = {*_NEEDED[self.kind], *_OPTIONAL[self.kind]}
        missing = [name for name in _NEEDED[self.kind] if not getattr(self, name)]
        if missing:
            raise ValueError(f"kind {self.kind} needs {' and '.join(missing)}")
        others = {name for kind in _NEEDED for name in (*_NEEDED[kind], *_OPTIONAL[kind])} - mine
        fields = type(self).model_fields  # a default that is written out, as in sequence.yaml, says nothing
        if foreign := sorted(name for name in others if getattr(self, name) != fields[name].default):
            raise ValueError(f"{', '.join(foreign)}: not for kind {self.kind}: remove")
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
