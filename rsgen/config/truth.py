"""Which exact images come with every colour frame, and the names and channels under which `truth/` holds them."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

GlobalTime = Literal["first", "middle", "last"]
FlowTarget = Literal["global", "next"]

FLOW_CHANNELS = ("u", "v", "valid")


class TruthConfig(BaseModel):
    """Exact images beside every colour frame, in truth/NAME/; all off by default."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    sharp: bool = Field(
        default=False, description="the frame without blur, each line at its mid-exposure; truth/sharp, 8-bit sRGB PNG"
    )
    global_shutter: tuple[GlobalTime, ...] = Field(
        default=(),
        description="first, middle, last: the frame without blur, all lines at that line's mid-exposure; "
        "truth/global_TIME, 8-bit sRGB PNG",
    )
    spp: int = Field(default=16, ge=1, le=65536, description="samples per pixel of sharp and global_shutter")
    flow: tuple[FlowTarget, ...] = Field(
        default=(),
        description="global: flow to every frame in global_shutter, truth/flow_global_TIME; next: to the next frame, "
        "line by line, truth/flow_next; px, EXR u v valid",
    )
    normals: bool = Field(
        default=False,
        description="unit surface normals in the camera frame of the pixel's line; truth/normals, EXR x y z",
    )
    blur_length: bool = Field(
        default=False, description="how far a pixel's point moves in its line's exposure, px; truth/blur_length, EXR"
    )
    color_depth: bool = Field(
        default=False, description="planar z seen by the colour camera itself, m; truth/color_depth, EXR"
    )

    @model_validator(mode="after")
    def _flow_has_a_target(self) -> TruthConfig:
        if "global" in self.flow and not self.global_shutter:
            raise ValueError("flow 'global' needs a time in global_shutter: add first, middle or last")
        for name in ("global_shutter", "flow"):
            if len(set(getattr(self, name))) < len(getattr(self, name)):
                raise ValueError(f"{name} names one twice: name each once")
        return self

    @property
    def images(self) -> dict[str, tuple[str, ...]]:
        """Names of the images of a frame, each with its EXR channels; no channels: an 8-bit sRGB PNG."""
        images: dict[str, tuple[str, ...]] = {"sharp": ()} if self.sharp else {}
        images |= {f"global_{time}": () for time in self.global_shutter}
        if "global" in self.flow:
            images |= {f"flow_global_{time}": FLOW_CHANNELS for time in self.global_shutter}
        if "next" in self.flow:
            images["flow_next"] = FLOW_CHANNELS
        single = {"normals": ("x", "y", "z"), "blur_length": ("Y",), "color_depth": ("Z",)}
        return images | {name: channels for name, channels in single.items() if getattr(self, name)}
