"""The two cameras: streams with a clock and a shutter, their noise, and what a colour camera sets by itself."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from rsgen.config.sections import Section
from rsgen.errors import UserError
from rsgen.geometry.camera import Camera, Model
from rsgen.geometry.shutter import Scan, Shutter
from rsgen.limits import limits
from rsgen.sequence.format import DEPTH_SCALE

Pixels = Annotated[float, limits(-1e6, 1e6, "px")]
Seconds = Annotated[float, limits(1e-9, 3600, "s", or_zero=True)]
Electrons = Annotated[float, limits(0, 1e9, "electrons")]
Metres = Annotated[float, limits(0, 1e4, "m")]
PerMetre = Annotated[float, limits(0, 100, "1/m")]
NoisePixels = Annotated[float, limits(0, 100, "px")]
Balance = Annotated[float, limits(1e-3, 1e3, "(factor)")]
Fraction = Annotated[float, Field(ge=0, le=1)]
EvStops = Annotated[float, Field(ge=-16, le=16)]
ExposureSeconds = Annotated[float, limits(1e-6, 10, "s")]
Gain = Annotated[float, limits(1e-3, 1000, "(ISO / base ISO)")]
Stops = Annotated[float, Field(ge=0, le=8)]
Angle = Annotated[float, Field(ge=0, le=90)]
_LEAST_FOCAL_PX = 0.01


class ColorNoiseConfig(Section):
    """What the colour camera does to the light. Neutral: gain, corner_loss, exposure_ev, contrast 0, balance 1 1 1."""

    model: Literal["none", "camera"] = Field(
        default="none", description="none: clean sRGB, the fields below unused; camera: all of them"
    )
    exposure_ev: EvStops = Field(default=0.0, description="error of the exposure, stops, before the noise")
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


class DepthNoiseConfig(Section):
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
    lateral_sigma_px: NoisePixels = Field(default=0.5, description="kinect: shift of the lookup in x and y, px RMS")
    disparity_sigma_px: NoisePixels = Field(default=1 / 48, description="kinect: noise of the disparity, px RMS")
    disparity_step_px: Annotated[float, limits(1e-6, 100, "px", or_zero=True)] = Field(
        default=0.125, description="kinect: quantisation step, px; 0: none"
    )
    region_sigma_px: NoisePixels = Field(
        default=0.0,
        description="kinect: noise of the disparity that neighbours have in common, px RMS, anew each frame",
    )
    region_px: Annotated[float, limits(1, 1e4, "px")] = Field(
        default=5.0, description="kinect: how far that noise is alike (to 1/e), px"
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
    distortion_px: NoisePixels = Field(
        default=0.0, description="fixed bends of the disparity over the image, px RMS (all models but none)"
    )
    distortion_period_px: Annotated[float, limits(8, 1e5, "px")] = Field(
        default=320.0, description="about how far the bends' hills are apart, px"
    )
    pattern_px: NoisePixels = Field(
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


class AutoExposureConfig(Section):
    """A controller of exposure and gain; it sees each frame's mean intensity and sets that of a later one."""

    target: Annotated[float, Field(ge=0.05, le=0.95)] = Field(
        default=0.53, description="mean intensity of the picture that is aimed at, 0..1 of 8 bits"
    )
    dead_band_ev: Stops = Field(default=0.25, description="errors up to this are left alone, stops")
    step_ev: Annotated[float, Field(ge=0.01, le=4)] = Field(
        default=0.25, description="exposure times gain changes in steps of this, stops"
    )
    speed: Annotated[float, Field(gt=0, le=1)] = Field(default=0.5, description="share of the error that is corrected")
    lag_frames: int = Field(default=2, ge=1, le=100, description="frames from a picture to the first that it changes")
    exposure_s: tuple[ExposureSeconds, ExposureSeconds] = Field(
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


class AutoWhiteBalanceConfig(Section):
    """Factors on red and blue that follow the picture until it is grey in the mean."""

    strength: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.6, description="share of the picture's cast that is removed in the end"
    )
    speed: Annotated[float, Field(gt=0, le=1)] = Field(
        default=0.1, description="share of the way there that is gone each frame"
    )
    lag_frames: int = Field(default=2, ge=1, le=100, description="frames from a picture to the first that it changes")
    limit_ev: Stops = Field(default=1.0, description="most that red and blue change, stops")


def _pixel_without_ray(camera: Camera) -> tuple[float, float] | None:
    """A position in the image, its outermost edges included, that the distortion sees nothing at; None if all see."""
    u, v = np.arange(camera.width + 1) - 0.5, np.arange(camera.height + 1) - 0.5
    rows = [np.stack([u, np.full_like(u, edge)], axis=-1) for edge in (v[0], v[-1])]
    columns = [np.stack([np.full_like(v, edge), v], axis=-1) for edge in (u[0], u[-1])]
    centre = np.array([[(camera.width - 1) / 2, (camera.height - 1) / 2]])
    uv = np.concatenate([*rows, *columns, centre])
    blind = uv[~np.isfinite(camera.unproject(uv)).all(axis=-1)]
    return (float(blind[0, 0]), float(blind[0, 1])) if len(blind) else None


class StreamConfig(Section):
    """One camera with its own clock."""

    width: int = Field(default=640, ge=8, le=16384, description="columns, px")
    height: int = Field(default=480, ge=8, le=16384, description="rows, px")
    intrinsics: tuple[Pixels, Pixels, Pixels, Pixels] = Field(
        default=(481.2, 480.0, 319.5, 239.5), description="fx, fy, cx, cy, px; pixel centres integer"
    )
    model: Model = Field(default="pinhole", description="distortion model")
    distortion: tuple[Annotated[float, limits(-1e6, 1e6, "(coefficient)")], ...] = Field(
        default=(),
        description="radtan k1 k2 p1 p2 [k3]; rational k1 k2 p1 p2 k3 k4 k5 k6; "
        "fisheye k1 k2 k3 k4; double_sphere xi alpha",
    )
    rate_hz: Annotated[float, limits(1e-4, 1e5, "Hz")] = Field(default=30.0, description="frames per second")
    offset_s: Annotated[float, limits(-1e9, 1e9, "s")] = Field(
        default=0.0, description="stamp of the first frame after the trajectory's first pose, s"
    )
    readout_s: Seconds = Field(
        default=0.028, description="time from first to one past the last line, s; 0: global shutter"
    )
    exposure_s: Seconds = Field(default=0.0, description="exposure of each line, s; 0: no motion blur")
    scan: Scan = Field(default="top-bottom", description="order in which lines are read out")

    @property
    def camera(self) -> Camera:
        fx, fy, cx, cy = self.intrinsics
        return Camera(self.width, self.height, fx, fy, cx, cy, self.model, tuple(self.distortion))

    @property
    def shutter(self) -> Shutter:
        return Shutter(self.readout_s, self.exposure_s, self.scan)

    @property
    def longest_exposure_s(self) -> float:
        """Of any frame, s."""
        return self.exposure_s

    @property
    def adapts(self) -> bool:
        """Whether exposure, gain or white balance change from frame to frame."""
        return False

    @model_validator(mode="after")
    def _geometry_is_valid(self) -> StreamConfig:
        try:
            camera, _ = self.camera, self.shutter
        except UserError as error:
            raise ValueError(str(error)) from None
        if min(self.intrinsics[:2]) < _LEAST_FOCAL_PX:
            raise ValueError(f"intrinsics: fx and fy must be at least {_LEAST_FOCAL_PX} px")
        blind = _pixel_without_ray(camera)
        if blind is not None:
            raise ValueError(
                f"distortion: no ray reaches pixel {blind}, where {self.model} folds back or sees 180 degrees: "
                "take a smaller image, longer focal lengths or other coefficients"
            )
        return self


class ColorConfig(StreamConfig):
    """The colour camera."""

    spp: int = Field(
        default=16,
        ge=1,
        le=65536,
        description="samples per pixel (footprint and exposure window): 8 without blur, 16 to 32 with it; a power of 2",
    )
    exposure_gain: Annotated[float, limits(1e-6, 1e6, "(factor)")] = Field(
        default=1.0, description="factor on linear radiance before sRGB quantisation"
    )
    noise: ColorNoiseConfig = ColorNoiseConfig()
    auto_exposure: AutoExposureConfig | None = None
    auto_white_balance: AutoWhiteBalanceConfig | None = None

    @property
    def adapts(self) -> bool:
        return self.auto_exposure is not None or self.auto_white_balance is not None

    @property
    def longest_exposure_s(self) -> float:
        return self.exposure_s if self.auto_exposure is None else self.auto_exposure.exposure_s[1]

    @model_validator(mode="after")
    def _has_a_reference(self) -> ColorConfig:
        if self.auto_exposure is not None and self.exposure_s == 0:
            raise ValueError("auto_exposure: exposure_s must be above 0: at that exposure exposure_gain holds")
        return self


class DepthConfig(StreamConfig):
    """The depth camera: planar z through each pixel's centre, 16 bit."""

    depth_scale: Annotated[float, limits(1e-3, 1e9, "units per metre")] = Field(
        default=DEPTH_SCALE, description="stored units per metre"
    )
    noise: DepthNoiseConfig = DepthNoiseConfig()
    blur_samples: int = Field(
        default=1,
        ge=1,
        le=64,
        description="instants of each line's exposure that a reported depth mixes; 1: its middle",
    )
    registered: bool = Field(
        default=False,
        description="warp reported depth into the colour camera, as drivers do; truth/depth stays as it is",
    )

    @model_validator(mode="after")
    def _has_an_exposure_to_mix(self) -> DepthConfig:
        if self.blur_samples > 1 and self.exposure_s == 0:
            raise ValueError("blur_samples: exposure_s must be above 0 to be mixed over")
        return self
