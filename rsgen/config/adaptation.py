"""Settings of what a colour camera does by itself: exposure, gain and white balance that follow the picture."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, model_validator

from rsgen.limits import limits

Seconds = Annotated[float, limits(1e-6, 10, "s")]
Gain = Annotated[float, limits(1e-3, 1000, "(ISO / base ISO)")]
Stops = Annotated[float, Field(ge=0, le=8)]


class AutoExposureConfig(BaseModel):
    """A controller of exposure and gain; it sees each frame's mean intensity and sets that of a later one."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    target: Annotated[float, Field(ge=0.05, le=0.95)] = Field(
        default=0.53, description="mean intensity of the picture that is aimed at, 0..1 of 8 bits"
    )
    dead_band_ev: Stops = Field(default=0.25, description="errors up to this are left alone, stops")
    step_ev: Annotated[float, Field(ge=0.01, le=4)] = Field(
        default=0.25, description="exposure times gain changes in steps of this, stops"
    )
    speed: Annotated[float, Field(gt=0, le=1)] = Field(default=0.5, description="share of the error that is mended")
    lag_frames: int = Field(default=2, ge=1, le=100, description="frames from a picture to the first that it changes")
    exposure_s: tuple[Seconds, Seconds] = Field(
        default=(0.001, 0.033), description="shortest and longest exposure of a line, s"
    )
    gain: tuple[Gain, Gain] = Field(default=(1.0, 8.0), description="least gain, and most, used where exposure ends")

    @model_validator(mode="after")
    def _limits_are_ordered(self) -> AutoExposureConfig:
        for name in ("exposure_s", "gain"):
            low, high = getattr(self, name)
            if not low <= high:
                raise ValueError(f"{name} {[low, high]} must not fall: the least, then the most")
        return self


class AutoWhiteBalanceConfig(BaseModel):
    """Factors on red and blue that follow the picture until it is grey in the mean."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    strength: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.6, description="share of the picture's cast that is removed in the end"
    )
    speed: Annotated[float, Field(gt=0, le=1)] = Field(
        default=0.1, description="share of the way there that is gone each frame"
    )
    lag_frames: int = Field(default=2, ge=1, le=100, description="frames from a picture to the first that it changes")
    limit_ev: Stops = Field(default=1.0, description="most that red and blue change, stops")
