"""Settings of the motion capture whose poses a recording has for its ground truth."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from rsgen.limits import limits

Metres = Annotated[float, limits(-100, 100, "m")]
Degrees = Annotated[float, limits(-180, 180, "deg")]


class MocapConfig(BaseModel):
    """Errors of a motion capture in groundtruth.txt alone; spline.npz and all of truth/ stay exact."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    rate_hz: Annotated[float, limits(1, 2000, "Hz")] = Field(default=100.0, description="poses per second")
    offset_s: Annotated[float, limits(-10, 10, "s")] = Field(
        default=0.0, description="listed minus true stamp, s: the motion capture has a clock of its own"
    )
    translation_m: tuple[Metres, Metres, Metres] = Field(
        default=(0.0, 0.0, 0.0), description="where the body that it reports lies in the camera's frame, m"
    )
    rotation_deg: tuple[Degrees, Degrees, Degrees] = Field(
        default=(0.0, 0.0, 0.0), description="how that body is turned in the camera's frame, rotation vector, deg"
    )
    position_sigma_m: Annotated[float, limits(0, 1, "m")] = Field(
        default=0.0, description="white noise along each axis, m RMS"
    )
    rotation_sigma_deg: Annotated[float, limits(0, 30, "deg")] = Field(
        default=0.0, description="white noise about each axis, deg RMS"
    )
