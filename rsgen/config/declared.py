"""What a sequence says of its cameras, wrong on purpose, so that calibrations can be tested."""

from __future__ import annotations

from typing import TypeVar

from pydantic import Field, ValidationError

from rsgen.config.sections import Pixels, Seconds, Section, StreamConfig
from rsgen.errors import first_problem
from rsgen.geometry.camera import Model
from rsgen.geometry.shutter import Scan
from rsgen.limits import RigidTransform

StreamT = TypeVar("StreamT", bound=StreamConfig)


class DeclaredStream(Section):
    """What is said of one camera; each field stands in for the stream's own of that name."""

    intrinsics: tuple[Pixels, Pixels, Pixels, Pixels] | None = Field(default=None, description="fx, fy, cx, cy, px")
    model: Model | None = Field(default=None, description="distortion model; give distortion with it")
    distortion: tuple[float, ...] | None = Field(default=None, description="coefficients; [] claims that there is none")
    readout_s: Seconds | None = Field(default=None, description="time from first to one past the last line, s")
    exposure_s: Seconds | None = Field(default=None, description="exposure of each line, s")
    scan: Scan | None = Field(default=None, description="order in which lines are read out, along the true one's axis")


class DeclaredDepth(DeclaredStream):
    """What is said of the depth camera."""

    depth_scale: float | None = Field(default=None, description="stored units per metre")


class DeclaredConfig(Section):
    """What the sequence says of its cameras in place of the truth, which truth/cameras.yaml keeps."""

    color: DeclaredStream = DeclaredStream()
    depth: DeclaredDepth = DeclaredDepth()
    T_color_depth: RigidTransform | None = Field(
        default=None, description="depth-camera to colour-camera coordinates, m"
    )


def as_declared(stream: StreamT, said: DeclaredStream | None) -> StreamT:
    """The stream with what is said of it. Raises ValueError, one line: no camera is like that."""
    said_fields = {} if said is None else said.model_dump(exclude_none=True)
    if not said_fields:
        return stream
    try:
        declared = type(stream).model_validate(stream.model_dump() | said_fields)
    except ValidationError as error:
        raise ValueError(first_problem(error)) from None
    if declared.shutter.by_rows != stream.shutter.by_rows:
        raise ValueError(f"scan: {declared.scan} is across the true one, {stream.scan}: declare one along it")
    return declared
