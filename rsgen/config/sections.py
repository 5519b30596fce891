"""Sections of a sequence's configuration: trajectory, scene, light, target, exact images, motion capture, IMU."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from rsgen.array_types import FloatArray
from rsgen.config.presets import ImuPreset, with_imu_preset
from rsgen.geometry import se3
from rsgen.geometry.aprilgrid import AprilGrid
from rsgen.limits import MOST_M, Matrix4, RigidTransform, limits

Coordinate = Annotated[float, limits(-MOST_M, MOST_M, "m")]
Position = tuple[Coordinate, Coordinate, Coordinate]
Angle = Annotated[float, limits(-180, 180, "degrees")]
Row34 = tuple[Coordinate, Coordinate, Coordinate, Coordinate]
Matrix34 = tuple[Row34, Row34, Row34]
Up = Literal["x", "y", "z", "-x", "-y", "-z"]
SceneLight = Literal["auto", "sky", "ceiling", "none"]


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


class StretchConfig(Section):
    """A piece of the motion in place of all of it."""

    start_s: Annotated[float, limits(0, 1e6, "s")] = Field(
        default=0.0, description="where it begins, s after the motion's first pose; the sequence's time is 0 there"
    )
    duration_s: Annotated[float, limits(1e-3, 1e6, "s")] = Field(description="of the sequence, s")
    speed: Annotated[float, limits(1e-3, 1e3, "times the motion's own")] = Field(
        default=1.0, description="times the motion's own"
    )
    turn_deg: tuple[Angle, Angle, Angle] = Field(
        default=(0.0, 0.0, 0.0), description="the body looks aside: rotation vector [pitch, yaw, roll], degrees"
    )


class SceneConfig(Section):
    """What the camera sees."""

    file: Path = Field(description="Mitsuba 3 scene .xml, or a mesh file that trimesh reads (light added)")
    scale: Annotated[float, limits(1e-9, 1e9, "m")] = Field(default=1.0, description="metres per unit of the file")
    up: Up = Field(default="y", description="axis of the file that is up, the world's y")
    light: SceneLight = Field(
        default="auto", description="light of a mesh file; auto: lamps under a room's ceiling, a sky around objects"
    )

    skip_missing: bool = Field(
        default=False,
        description="leave out meshes, textures and sky pictures that are not there, as --skip-missing",
    )

    @model_validator(mode="after")
    def _is_a_mesh_if_lit(self) -> SceneConfig:
        if self.file.suffix.lower() == ".xml" and self.light != "auto":
            raise ValueError("light: is for mesh files: a Mitsuba scene has its own light")
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


GlobalTime = Literal["first", "middle", "last"]
FlowTarget = Literal["global", "next"]

FLOW_CHANNELS = ("u", "v", "valid")


class TruthConfig(Section):
    """Exact images beside every colour frame, in truth/NAME/; all off by default."""

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

    labels: bool = Field(
        default=False,
        description="which thing each pixel of colour and depth shows; 16-bit PNG, truth/labels, truth/depth_labels; "
        "table truth/labels.yaml, boxes truth/boxes_*.csv",
    )
    classes: dict[str, tuple[str, ...]] = Field(
        default={}, description="of labels: patterns of names by class; others: the name without its number"
    )

    def content(self) -> dict[str, Any]:
        """As sequence.yaml records it: labels only where there are some, as before there were any."""
        return self.model_dump(mode="json", exclude=set() if self.labels else {"labels", "classes"})

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


Metres = Annotated[float, limits(-100, 100, "m")]
Degrees = Annotated[float, limits(-180, 180, "deg")]


class MocapConfig(Section):
    """Errors of a motion capture in groundtruth.txt alone; spline.npz and all of truth/ stay exact."""

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


# Bounded so that products of two stay far from overflow.
Number = Annotated[float, Field(ge=-1e6, le=1e6)]
Density = Annotated[float, Field(ge=0, le=1e6)]
Range = Annotated[float, Field(gt=0, le=1e6)]
Vector3 = tuple[Number, Number, Number]
Matrix3 = tuple[Vector3, Vector3, Vector3]

_ZERO: Vector3 = (0.0, 0.0, 0.0)
_IDENTITY3: Matrix3 = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_IDENTITY4: Matrix4 = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


# Fields that are left out of sequence.yaml where they are not set: what was rendered before there were any stays same.
_LATER = ("preset", "warmup_s", "gyroscope_warmup", "accelerometer_warmup")


class ImuConfig(Section):
    """An inertial measurement unit fixed to the depth camera; the noise defaults are those of EuRoC's (ADIS16448)."""

    preset: ImuPreset | None = Field(
        default=None,
        description="phone (LSM6DSO), d435i (BMI055) or euroc (ADIS16448): noise, biases, place; other fields override",
    )
    rate_hz: float = Field(default=200.0, gt=0, le=100_000, description="samples per second")
    T_imu_depth: RigidTransform = Field(default=_IDENTITY4, description="depth-camera to IMU coordinates, m")
    gravity: Vector3 = Field(default=(0.0, -9.80665, 0.0), description="gravity in the world, m/s^2 (default: y is up)")
    gyroscope_noise_density: Density = Field(default=1.6968e-4, description="white noise, rad/s/sqrt(Hz)")
    gyroscope_random_walk: Density = Field(default=1.9393e-5, description="bias diffusion, rad/s^2/sqrt(Hz)")
    accelerometer_noise_density: Density = Field(default=2.0e-3, description="white noise, m/s^2/sqrt(Hz)")
    accelerometer_random_walk: Density = Field(default=3.0e-3, description="bias diffusion, m/s^3/sqrt(Hz)")
    gyroscope_bias: Vector3 = Field(default=_ZERO, description="bias at the first sample, rad/s")
    accelerometer_bias: Vector3 = Field(default=_ZERO, description="bias at the first sample, m/s^2")
    gyroscope_matrix: Matrix3 = Field(
        default=_IDENTITY3, description="scale (diagonal) and misalignment: takes the true rate to the measured one"
    )
    accelerometer_matrix: Matrix3 = Field(
        default=_IDENTITY3, description="scale (diagonal) and misalignment: takes the true force to the measured one"
    )
    gyroscope_range: Range | None = Field(default=None, description="largest reading of an axis, rad/s; null: no limit")
    accelerometer_range: Range | None = Field(
        default=None, description="largest reading of an axis, m/s^2; null: no limit"
    )

    warmup_s: Annotated[float, limits(0.1, 1e5, "s")] = Field(
        default=90.0, description="time constant of the biases' drift while the unit warms up, s"
    )
    gyroscope_warmup: Density = Field(default=0.0, description="size of that drift, an axis, by the seed, RMS, rad/s")
    accelerometer_warmup: Density = Field(default=0.0, description="size of that drift, an axis, RMS, m/s^2")

    @model_validator(mode="before")
    @classmethod
    def _fills_in_the_preset(cls, data: Any) -> Any:
        return with_imu_preset(data)

    def has_truth(self, faults: Section | None) -> bool:
        """Whether truth/ has its samples' true times and biases: where they are more than white noise and a walk.

        faults: the section `faults.imu`.
        """
        return bool(set(self.content()) & set(_LATER)) or (faults is not None and faults != type(faults)())

    def content(self) -> dict[str, Any]:
        """What decides its bytes, as plain YAML types."""
        fields = type(self).model_fields
        unset = {name for name in _LATER if getattr(self, name) == fields[name].default}
        return self.model_dump(mode="json", exclude=unset)

    def T_depth_imu(self) -> FloatArray:
        """IMU to depth-camera coordinates (4, 4)."""
        return se3.inverse(se3.orthonormalise(self.T_imu_depth))
