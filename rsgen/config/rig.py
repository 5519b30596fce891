"""The section `streams`: a rig of any cameras by name, in place of `color`, `depth` and `T_color_depth`."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from rsgen.array_types import FloatArray
from rsgen.config.cameras import ColorConfig, DepthConfig, StreamConfig
from rsgen.config.sections import Section
from rsgen.geometry import se3
from rsgen.limits import RigidTransform, limits

_IDENTITY = ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))
Metres = Annotated[float, limits(-10, 10, "m")]
# Rows of two images must be the same epipolar lines to this part of a pixel at 1 m.
_RECTIFIED = 1e-9


class DotsConfig(Section):
    """A projector of infrared dots, fixed to the body: a random pattern, drawn by the config's seed."""

    position: tuple[Metres, Metres, Metres] = Field(
        default=(0.0, 0.0, 0.0), description="where it is in the camera's frame; it looks along the camera's z, m"
    )
    count: int = Field(default=5000, ge=1, le=100_000, description="dots in the field of view")
    field_deg: tuple[Annotated[float, Field(gt=1, lt=170)], Annotated[float, Field(gt=1, lt=170)]] = Field(
        default=(90.0, 63.0), description="how wide and high the pattern is, deg"
    )
    dot_deg: Annotated[float, Field(gt=0.001, lt=10)] = Field(
        default=0.15, description="width of a dot (full width at half maximum), deg"
    )
    power: Annotated[float, limits(0, 1e6, "(factor)")] = Field(
        default=3.0, description="light of a dot's middle on a white wall 1 m away, 1 = white"
    )


class StereoConfig(Section):
    """Depth by semi-global matching of two grey cameras (OpenCV's StereoSGBM), which are rendered for it."""

    left: str = Field(description="camera whose pixels the depth image has")
    right: str = Field(description="the other one: the same lens, beside it along its x axis")
    disparities: int = Field(default=128, ge=16, le=1024, multiple_of=16, description="largest disparity, px")
    block_px: int = Field(default=7, ge=1, le=21, description="size of the window that is compared, px: odd")
    uniqueness_pct: int = Field(default=10, ge=0, le=100, description="by how much the best match must beat the rest")
    speckle_px: int = Field(default=100, ge=0, le=100_000, description="smaller islands of disparity are left out, px")

    @model_validator(mode="after")
    def _has_a_middle(self) -> StereoConfig:
        if self.block_px % 2 == 0:
            raise ValueError(f"block_px: {self.block_px} has no middle pixel: take an odd number")
        return self


class RigColorConfig(ColorConfig):
    """A colour or grey camera of a rig."""

    kind: Literal["color", "mono", "infrared"]
    T_body_cam: RigidTransform = Field(default=_IDENTITY, description="the camera's coordinates to the body's, m")
    dots: DotsConfig | None = None

    @model_validator(mode="after")
    def _is_grey_where_it_must_be(self) -> RigColorConfig:
        if self.kind != "color" and (self.noise.bayer != "off" or self.auto_white_balance is not None):
            raise ValueError(f"noise.bayer and auto_white_balance: a {self.kind} camera has no colours: remove them")
        if self.dots is not None and self.kind != "infrared":
            raise ValueError(f"dots: are infrared, the camera is {self.kind}: make it kind: infrared")
        return self


class RigDepthConfig(DepthConfig):
    """A depth camera of a rig; with `stereo` its pixels, clock and place are those of the left camera."""

    kind: Literal["depth"]
    T_body_cam: RigidTransform = Field(default=_IDENTITY, description="the camera's coordinates to the body's, m")
    stereo: StereoConfig | None = None

    @model_validator(mode="after")
    def _can_be_of_a_rig(self) -> RigDepthConfig:
        if self.registered:
            raise ValueError("registered: is for a sequence of one colour and one depth camera")
        if self.stereo is not None and self.noise.model != "none":
            raise ValueError("noise.model: stereo makes errors of its own: leave it at none")
        return self


RigStream = Annotated[RigColorConfig | RigDepthConfig, Field(discriminator="kind")]

# What a depth camera that is computed has from the camera whose pixels it has.
_OF_LEFT = (
    "width", "height", "intrinsics", "model", "distortion", "rate_hz", "offset_s", "readout_s", "exposure_s", "scan",
    "T_body_cam",
)  # fmt: skip


def with_left_cameras(streams: Any) -> Any:
    """Data of the section, in which depth that stereo makes has what its left camera states."""
    if not isinstance(streams, dict):
        return streams
    made = dict(streams)
    for name, stream in streams.items():
        stereo = stream.get("stereo") if isinstance(stream, dict) else None
        left = streams.get(stereo.get("left")) if isinstance(stereo, dict) else None
        if isinstance(left, dict):
            made[name] = {field: left[field] for field in _OF_LEFT if field in left} | stream
    return made


def T_cam_body(stream: StreamConfig) -> FloatArray:
    """The pose (4, 4) of a rig's camera."""
    assert isinstance(stream, RigColorConfig | RigDepthConfig)
    return se3.inverse(np.asarray(stream.T_body_cam, float))


def check_stereo(streams: dict[str, RigColorConfig | RigDepthConfig]) -> None:
    """Raises ValueError where depth is to be made of cameras that are no rectified pair."""
    for name, stream in streams.items():
        if not isinstance(stream, RigDepthConfig) or stream.stereo is None:
            continue
        pair = [streams.get(side) for side in (stream.stereo.left, stream.stereo.right)]
        for side, camera in zip(("left", "right"), pair, strict=True):
            if not isinstance(camera, RigColorConfig):
                raise ValueError(f"streams.{name}.stereo.{side}: must name a colour, mono or infrared camera")
        left, right = pair
        same = [field for field in _OF_LEFT[:-1] if getattr(left, field) != getattr(right, field)]
        if same:
            raise ValueError(f"streams.{name}.stereo: {same[0]} of left and right must be the same")
        if any(getattr(stream, field) != getattr(left, field) for field in _OF_LEFT):
            raise ValueError(f"streams.{name}: with stereo it has the left camera's pixels and clock: remove its own")
        assert left is not None and right is not None
        T_right_left = T_cam_body(right) @ se3.inverse(T_cam_body(left))
        off = np.abs(T_right_left - np.eye(4))
        off[0, 3] = 0.0
        if left.distortion or off.max() > _RECTIFIED or T_right_left[0, 3] >= 0:
            raise ValueError(
                f"streams.{name}.stereo: takes a rectified pair: the right camera beside the left one along its x "
                "axis, not turned, both without distortion"
            )
