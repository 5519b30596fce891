"""What a driver makes of a stream: when it says that images came, and which it loses."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, model_validator

from rsgen.limits import limits

Seconds = Annotated[float, limits(-1e9, 1e9, "s")]
Length = Annotated[float, limits(1e-3, 1e4, "s")]
Share = Annotated[float, Field(ge=0, le=0.9)]


class DriverConfig(BaseModel):
    """Stamps of arrival by a computer's clock, and lost images; truth/frames_STREAM.txt keeps the true times."""

    model_config = ConfigDict(extra="forbid", frozen=True)

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

    blackouts: tuple[tuple[Seconds, Length], ...] = Field(
        default=(), max_length=1000, description="[from, for] in true seconds: no image of these times is delivered"
    )

    @model_validator(mode="after")
    def _some_are_delivered(self) -> DriverConfig:
        if self.dropped + self.repeated > 0.9:
            raise ValueError("dropped and repeated: together at most 0.9")
        return self
