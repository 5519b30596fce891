"""The sections of a sequence's configuration: trajectory, scene, light and the two streams."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from rsgen.config.adaptation import AutoExposureConfig, AutoWhiteBalanceConfig
from rsgen.config.driver import DriverConfig
from rsgen.config.sensors import ColorNoiseConfig, DepthNoiseConfig
from rsgen.errors import UserError
from rsgen.geometry.camera import Camera, Model
from rsgen.geometry.shutter import Scan, Shutter
from rsgen.limits import MOST_M, RigidTransform, limits
from rsgen.sequence.format import DEPTH_SCALE

Coordinate = Annotated[float, limits(-MOST_M, MOST_M, "m")]
Pixels = Annotated[float, limits(-1e6, 1e6, "px")]
Seconds = Annotated[float, limits(1e-9, 3600, "s", or_zero=True)]
Row34 = tuple[Coordinate, Coordinate, Coordinate, Coordinate]
Matrix34 = tuple[Row34, Row34, Row34]
Up = Literal["x", "y", "z", "-x", "-y", "-z"]
SceneLight = Literal["auto", "sky", "ceiling", "none"]
_LEAST_FOCAL_PX = 0.01


class Section(BaseModel):
    """Part of a configuration: no other fields than its own, and none changes."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class TrajectoryConfig(Section):
    """Where the camera goes."""

    file: Path | None = Field(
        default=None, description="recorded trajectory of the body (depth camera): TUM, ICL-NUIM or EuRoC file"
    )
    format: Literal["auto", "tum", "icl", "euroc"] = Field(
        default="auto", description="file format; auto: by its content"
    )
    icl_start: Matrix34 | None = Field(
        default=None, description="pose [R|t] of frame 1 in the POV-Ray world; places ICL-NUIM's start-relative files"
    )
    T_world_file: RigidTransform | None = Field(
        default=None, description="rigid transform that places the trajectory in the scene"
    )
    knot_spacing_s: Annotated[float, limits(1e-9, 1e3, "s")] = Field(
        default=0.05, description="knot spacing of the ground-truth spline, s"
    )
    clearance_m: Annotated[float, limits(0, 1e4, "m")] | None = Field(
        default=None, description="least distance of a recorded path to the scene's surfaces, m; null: not checked"
    )
    smoothing: Annotated[float, limits(0, 1e6, "s^4: 1 damps all but motions slower than a second")] = Field(
        default=0.0, description="weight of the acceleration penalty of the fit, s^4"
    )


class SceneConfig(Section):
    """What the camera sees."""

    file: Path = Field(description="Mitsuba 3 scene .xml, or a mesh file that trimesh reads (light added)")
    scale: Annotated[float, limits(1e-9, 1e9, "m")] = Field(default=1.0, description="metres per unit of the file")
    up: Up = Field(default="y", description="axis of the file that is up, the world's y")
    light: SceneLight = Field(
        default="auto", description="light of a mesh file; auto: lamps under a room's ceiling, a sky around objects"
    )

    @model_validator(mode="after")
    def _is_a_mesh_if_lit(self) -> SceneConfig:
        if self.file.suffix.lower() == ".xml" and self.light != "auto":
            raise ValueError("light: is for mesh files: a Mitsuba scene says that itself")
        return self


class LightConfig(Section):
    """How surfaces are lit."""

    mode: Literal["baked", "path"] = Field(
        default="baked", description="baked irradiance (fast, clean) or path tracing"
    )
    texel_m: Annotated[float, limits(1e-3, 100, "m: memory grows with 1 / texel_m^2")] = Field(
        default=0.015, description="spacing of the baked irradiance samples, m"
    )
    direct_samples: int = Field(
        default=64,
        ge=1,
        le=4096,
        description="samples of each lamp per irradiance sample: a sixteenth where that will do, at most twice as many",
    )
    target_db: float = Field(
        default=40.0, ge=20, le=70,
        description="PSNR that light is sampled for where a surface is mid-grey, before it is smoothed",
    )  # fmt: skip
    gather_rays: int = Field(
        default=512, ge=16, le=16384, description="hemisphere rays per indirect sample, last bounce, at most"
    )
    bounces: int = Field(
        default=8,
        ge=0,
        le=32,
        description="indirect diffuse bounces, at most; from 3 on those that follow are extrapolated",
    )
    glossy_spp: int | None = Field(
        default=None,
        ge=1,
        le=65536,
        description="samples per pixel at most of what a surface mirrors; null: a quarter of color.spp, at least 4",
    )
    max_depth: int = Field(default=12, ge=1, le=64, description="path length of mode 'path'")


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
    driver: DriverConfig | None = None

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
    def has_frame_table(self) -> bool:
        """Whether stamps or exposures of single frames are another matter than the clock and the shutter."""
        return self.driver is not None

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

    spp: int = Field(default=16, ge=1, le=65536, description="samples per pixel (footprint and exposure window)")
    exposure_gain: Annotated[float, limits(1e-6, 1e6, "(factor)")] = Field(
        default=1.0, description="factor on linear radiance before sRGB quantisation"
    )
    noise: ColorNoiseConfig = ColorNoiseConfig()
    auto_exposure: AutoExposureConfig | None = None
    auto_white_balance: AutoWhiteBalanceConfig | None = None

    @property
    def adapts(self) -> bool:
        """Whether exposure, gain or white balance change from frame to frame."""
        return self.auto_exposure is not None or self.auto_white_balance is not None

    @property
    def longest_exposure_s(self) -> float:
        return self.exposure_s if self.auto_exposure is None else self.auto_exposure.exposure_s[1]

    @property
    def has_frame_table(self) -> bool:
        return self.driver is not None or self.adapts

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
