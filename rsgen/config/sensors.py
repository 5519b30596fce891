"""Settings of the sensor models; the defaults, once a model is chosen, are those of a cheap hand-held RGB-D camera."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from rsgen.limits import limits

Electrons = Annotated[float, limits(0, 1e9, "electrons")]
Metres = Annotated[float, limits(0, 1e4, "m")]
PerMetre = Annotated[float, limits(0, 100, "1/m")]
Pixels = Annotated[float, limits(0, 100, "px")]
Balance = Annotated[float, limits(1e-3, 1e3, "(factor)")]
Fraction = Annotated[float, Field(ge=0, le=1)]
Stops = Annotated[float, Field(ge=-16, le=16)]
Angle = Annotated[float, Field(ge=0, le=90)]


class _Settings(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class ColorNoiseConfig(_Settings):
    """What the colour camera does to the light. Neutral: gain, corner_loss, exposure_ev, contrast 0, balance 1 1 1."""

    model: Literal["none", "camera"] = Field(
        default="none", description="none: clean sRGB, the fields below unused; camera: all of them"
    )
    exposure_ev: Stops = Field(default=0.0, description="error of the exposure, stops, before the noise")
    corner_loss: float = Field(
        default=0.25, ge=0, lt=1, description="vignetting: fraction of the light lost in the image's corners"
    )
    full_well_e: Annotated[float, limits(1, 1e9, "electrons")] = Field(
        default=6000.0, description="electrons of a white pixel at gain 1"
    )
    read_noise_e: Electrons = Field(default=4.0, description="read noise, electrons RMS")
    gain: Annotated[float, limits(1e-3, 1000, "(ISO / base ISO)", or_zero=True)] = Field(
        default=2.0, description="gain (ISO / base ISO): white is full_well_e / gain electrons; 0: no noise"
    )
    bayer: Literal["off", "bilinear", "edge-aware"] = Field(
        default="off", description="RGGB mosaic and how it is demosaicked; off: three values at every pixel"
    )
    white_balance: tuple[Balance, Balance, Balance] = Field(
        default=(1.03, 1.0, 0.96), description="error of the white balance: factors on R, G, B after the noise"
    )
    response: Literal["srgb", "gamma"] = Field(default="srgb", description="tone curve, linear to 8 bit")
    gamma: Annotated[float, Field(ge=0.1, le=10)] = Field(
        default=2.2, description="exponent of response 'gamma': y = x^(1/gamma)"
    )
    contrast: Fraction = Field(default=0.3, description="weight of an S-shaped curve after the response")


class DepthNoiseConfig(_Settings):
    """What the depth camera reports instead of the true depth."""

    model: Literal["none", "kinect", "tof", "gaussian"] = Field(
        default="none",
        description="none: exact; kinect: structured light; tof: axial noise, flying pixels; gaussian: sigma ~ z^2",
    )
    min_range_m: Metres = Field(default=0.4, description="nearest depth reported, m (all models but none)")
    max_range_m: Metres = Field(default=8.0, description="farthest depth reported, m (all models but none)")
    grazing_deg: tuple[Angle, Angle] = Field(
        default=(70.0, 82.0),
        description="kinect, tof: angles between ray and normal from which returns begin to fail, and all fail, deg",
    )
    projector_baseline_m: Annotated[float, limits(1e-4, 100, "m")] = Field(
        default=0.075, description="kinect: camera to projector along the camera's +x axis, m"
    )
    projector_width: Annotated[float, limits(0.1, 10, "(factor)")] = Field(
        default=1.0, description="kinect: width of the pattern, in widths of the camera's field of view"
    )
    shadow: bool = Field(default=True, description="kinect: nothing where the projector's light does not reach")
    lateral_sigma_px: Pixels = Field(default=0.5, description="kinect: shift of the lookup in x and y, px RMS")
    disparity_sigma_px: Pixels = Field(default=1 / 48, description="kinect: noise of the disparity, px RMS")
    disparity_step_px: Annotated[float, limits(1e-6, 100, "px", or_zero=True)] = Field(
        default=0.125, description="kinect: quantisation step, px; 0: none"
    )
    edge_dropout: Fraction = Field(default=0.5, description="kinect: probability of no return beside a depth edge")
    axial_base_m: Metres = Field(default=0.0012, description="tof: sigma = base + growth (z - nearest)^2; base, m")
    axial_growth_per_m: PerMetre = Field(default=0.0019, description="tof: growth, 1/m")
    axial_nearest_m: Metres = Field(default=0.4, description="tof: depth of the least noise, m")
    flying_pixels: Fraction = Field(
        default=0.3, description="tof: probability that a pixel beside a depth edge mixes both sides"
    )
    scale_error: Annotated[float, Field(ge=-0.5, le=0.5)] = Field(
        default=0.0, description="relative error of all depths (all models but none)"
    )
    distortion_px: Pixels = Field(
        default=0.0, description="fixed bends of the disparity over the image, px RMS (all models but none)"
    )
    distortion_period_px: Annotated[float, limits(8, 1e5, "px")] = Field(
        default=320.0, description="about how far the bends' hills are apart, px"
    )
    pattern_px: Pixels = Field(
        default=0.0, description="fixed error of each pixel's disparity, px RMS (all models but none)"
    )
    gaussian_per_m: PerMetre = Field(default=1.2e-3, description="gaussian: sigma / z^2, 1/m")

    @model_validator(mode="after")
    def _limits_are_ordered(self) -> DepthNoiseConfig:
        if not self.min_range_m < self.max_range_m:
            raise ValueError(f"min_range_m {self.min_range_m} must be below max_range_m {self.max_range_m}")
        if not self.grazing_deg[0] <= self.grazing_deg[1]:
            raise ValueError(f"grazing_deg {self.grazing_deg} must not fall: 'begin to fail', then 'all fail'")
        return self
