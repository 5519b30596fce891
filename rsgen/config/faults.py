"""The `faults:` section: what is wrong on purpose, so that calibrations and trackers can be tested against it.

A recording keeps its own names in sequence.yaml (`to_recorded`): format rsgen-sequence/1 is older than the section.
"""

from __future__ import annotations

from typing import Annotated, Any, TypeVar

from pydantic import Field, ValidationError, model_validator

from rsgen.config.cameras import Pixels, Seconds, StreamConfig
from rsgen.config.sections import Section
from rsgen.errors import first_problem
from rsgen.geometry.camera import Model
from rsgen.geometry.shutter import Scan
from rsgen.limits import RigidTransform, limits
from rsgen.sequence.format import STREAMS

StreamT = TypeVar("StreamT", bound=StreamConfig)
Instant = Annotated[float, limits(-1e9, 1e9, "s")]
Length = Annotated[float, limits(1e-3, 1e4, "s")]
Share = Annotated[float, Field(ge=0, le=0.9)]


class DeclaredStream(Section):
    """What is stated of one camera; each field stands in for the stream's own of that name."""

    intrinsics: tuple[Pixels, Pixels, Pixels, Pixels] | None = Field(default=None, description="fx, fy, cx, cy, px")
    model: Model | None = Field(default=None, description="distortion model; give distortion with it")
    distortion: tuple[float, ...] | None = Field(default=None, description="coefficients; [] claims that there is none")
    readout_s: Seconds | None = Field(default=None, description="time from first to one past the last line, s")
    exposure_s: Seconds | None = Field(default=None, description="exposure of each line, s")
    scan: Scan | None = Field(default=None, description="order in which lines are read out, along the true one's axis")


class DeclaredDepth(DeclaredStream):
    """What is stated of the depth camera."""

    depth_scale: float | None = Field(default=None, description="stored units per metre")


class DeclaredCameras(Section):
    """What the sequence states of its cameras in place of the truth, which truth/cameras.yaml keeps."""

    color: DeclaredStream = DeclaredStream()
    depth: DeclaredDepth = DeclaredDepth()
    T_color_depth: RigidTransform | None = Field(
        default=None, description="depth-camera to colour-camera coordinates, m"
    )


class StreamFaults(Section):
    """Stamps of arrival by a computer's clock, and lost images; truth/frames_STREAM.txt keeps the true times."""

    offset_s: Annotated[float, limits(-10, 10, "s")] = Field(
        default=0.0, description="listed minus true stamp, mean, s: how long images take to arrive"
    )
    drift_ppm: Annotated[float, limits(-1e5, 1e5, "ppm")] = Field(
        default=0.0, description="how fast the listing clock runs against the true one, parts per million"
    )
    jitter_s: Annotated[float, limits(0, 1, "s")] = Field(default=0.0, description="normal jitter of arrival, s RMS")
    grid_s: Annotated[float, limits(1e-6, 1, "s", or_zero=True)] = Field(
        default=0.0, description="arrivals are noticed at multiples of this only, s; 0: at once"
    )
    dropped: Share = Field(default=0.0, description="probability that an image is lost")
    repeated: Share = Field(default=0.0, description="probability that the image before is delivered in its place")
    blackouts: tuple[tuple[Instant, Length], ...] = Field(
        default=(), max_length=1000, description="[from, for] in true seconds: no image of these times is delivered"
    )

    @model_validator(mode="after")
    def _some_are_delivered(self) -> StreamFaults:
        if self.dropped + self.repeated > 0.9:
            raise ValueError("dropped and repeated: together at most 0.9")
        return self


class ImuFaults(Section):
    """Samples of the IMU that come early or late or are lost, and stamps of a clock of its own."""

    jitter_s: Annotated[float, limits(0, 1, "s")] = Field(
        default=0.0, description="samples are taken early or late by this, RMS, at most a fifth of a period, s"
    )
    dropped: Share = Field(default=0.0, description="part of the samples that is lost")
    dropped_run: Annotated[float, Field(ge=1, le=1e4)] = Field(
        default=1.0, description="how many are lost in a row, in the mean"
    )
    clock_offset_s: Annotated[float, limits(-10, 10, "s")] = Field(
        default=0.0, description="the IMU's stamps minus true time at the first sample, s"
    )
    clock_drift_ppm: Annotated[float, limits(-1e4, 1e4, "ppm")] = Field(
        default=0.0, description="how fast the IMU's clock runs against the images', parts per million"
    )
    stamp_error_s: Annotated[float, limits(0, 1, "s")] = Field(
        default=0.0, description="white error of the stamps, RMS, at most a fifth of a period, s"
    )


class FaultsConfig(Section):
    """What is wrong on purpose; the truth stays what it is."""

    declared: DeclaredCameras | None = None
    color: StreamFaults | None = None
    depth: StreamFaults | None = None
    imu: ImuFaults | None = None


_MOVED = {"declared": "faults.declared"} | {f"{name}.driver": f"faults.{name}" for name in STREAMS}
_MOVED |= {f"imu.{name}": f"faults.imu.{name}" for name in ImuFaults.model_fields}


def moved_to(name: str) -> str | None:
    """The present name of a field, by its dotted name before there was a section `faults`; None: it had none."""
    for old, new in _MOVED.items():
        if name == old or name.startswith(f"{old}."):
            return new + name[len(old) :]
    return None


def from_recorded(config: dict[str, Any]) -> dict[str, Any]:
    """A config as a sequence.yaml records it, with its faults in their section. Left as it is: what is no mapping."""
    config = dict(config)
    faults: dict[str, Any] = {"declared": config.pop("declared", None)}
    for name in STREAMS:
        if isinstance(config.get(name), dict):
            config[name] = dict(config[name])
            faults[name] = config[name].pop("driver", None)
    if isinstance(config.get("imu"), dict):
        config["imu"], faults["imu"] = split_imu(config["imu"])
    # What no preset fills in need not be switched off.
    is_plain = config.get("preset") is None and all(value is None for value in faults.values())
    return config | {"faults": None if is_plain else faults}


def split_imu(recorded: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """The sections `imu` and `faults.imu` of an IMU as a sequence.yaml records it."""
    imu = {name: value for name, value in recorded.items() if name not in ImuFaults.model_fields}
    if imu == recorded and imu.get("preset") is None:
        return imu, None
    return imu, {name: recorded.get(name, field.default) for name, field in ImuFaults.model_fields.items()}


def to_recorded(config: dict[str, Any], faults: FaultsConfig) -> dict[str, Any]:
    """The inverse: a config as sequence.yaml records it. Values that are not set are left out where they came later."""
    for name in config.keys() & set(STREAMS):  # a rig has its cameras elsewhere, and none of these faults
        driver = getattr(faults, name)
        recorded = None if driver is None else driver.model_dump(mode="json")
        if recorded is not None and not driver.blackouts:
            del recorded["blackouts"]
        config[name] = _inserted(config[name], "scan", "driver", recorded)
    if faults.declared is not None:
        config = _inserted(config, "mocap", "declared", faults.declared.model_dump(mode="json"))
    if faults.imu is not None and config["imu"] is not None:
        config["imu"] |= faults.imu.model_dump(mode="json", exclude_defaults=True)
    return config


def _inserted(section: dict[str, Any], after: str, name: str, value: Any) -> dict[str, Any]:
    """The section with one entry more, where recordings have always had it: sequence.yaml stays the same bytes."""
    before = list(section)[: list(section).index(after) + 1]
    return {key: section[key] for key in before} | {name: value} | section


def as_declared(stream: StreamT, stated: DeclaredStream | None) -> StreamT:
    """The stream with what is stated of it. Raises ValueError, one line: no camera is like that."""
    fields = {} if stated is None else stated.model_dump(exclude_none=True)
    if not fields:
        return stream
    try:
        declared = type(stream).model_validate(stream.model_dump() | fields)
    except ValidationError as error:
        raise ValueError(first_problem(error)) from None
    if declared.shutter.by_rows != stream.shutter.by_rows:
        raise ValueError(f"scan: {declared.scan} is across the true one, {stream.scan}: declare one along it")
    return declared
