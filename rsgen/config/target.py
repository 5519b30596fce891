"""The `target:` section: a calibration board that is put into the scene."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from rsgen.config.sections import Section
from rsgen.geometry.aprilgrid import AprilGrid
from rsgen.limits import RigidTransform, limits

MOST_TAGS = 587  # in the family 36h11


class TargetConfig(Section):
    """An AprilGrid of Kalibr's (tags 36h11) in the scene; truth/target_corners.txt has its corners."""

    rows: int = Field(default=6, ge=1, le=MOST_TAGS, description="tags above each other")
    columns: int = Field(default=6, ge=1, le=MOST_TAGS, description="tags beside each other")
    tag_size_m: Annotated[float, limits(1e-3, 100, "m")] = Field(
        default=0.088, description="edge of a tag, its black border included, m"
    )
    spacing: Annotated[float, limits(0.01, 1, "(tag sizes)")] = Field(
        default=0.3, description="gap between tags, tag sizes: whole hundredths"
    )
    T_world_target: RigidTransform = Field(
        description="target to world coordinates: origin in tag 0's lower left corner, x right, y up, z out of it"
    )

    @property
    def grid(self) -> AprilGrid:
        """Its geometry."""
        return AprilGrid(self.rows, self.columns, self.tag_size_m, self.spacing)

    @model_validator(mode="after")
    def _can_be_drawn(self) -> TargetConfig:
        if self.rows * self.columns > MOST_TAGS:
            raise ValueError(f"rows x columns: {self.rows * self.columns} tags, there are {MOST_TAGS}")
        if abs(100 * self.spacing - round(100 * self.spacing)) > 1e-9:
            raise ValueError(f"spacing: {self.spacing:g} is no whole number of hundredths")
        return self
