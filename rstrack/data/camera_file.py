"""The cameras of folders that are no rsgen sequence: our camera.yaml, or a calibration.yaml of OpenCV's FileStorage.

camera.yaml (depth left out: registered to colour, read out as colour is, 5000 units per metre):

    color: {width: 640, height: 480, intrinsics: [481.2, 480.0, 319.5, 239.5], readout_s: 0.028, offset_s: 0.02}
    depth: {width: 640, height: 480, intrinsics: [481.2, 480.0, 319.5, 239.5], readout_s: 0.028, depth_scale: 5000}
    stamps: auto

Each may have model (pinhole, radtan, rational, fisheye, double_sphere), distortion, exposure_s and scan as in rsgen's
configs. T_color_depth (4x4) is the identity where it is left out. color.offset_s: seconds added to colour's stamps;
auto: see `rstrack.data.timing`. color.drift_ppm: millionths by which that grows over the recording, in whose middle it
holds. `rstrack calibrate` finds both and writes such a file. clocks: {NAME: {offset_s: 0.02, drift_ppm: 3}} of the
recording in a folder of that name alone. color.falloff: see `Rig`; auto: `track` finds it. stamps: see there, too.
sigma: {focal: 0.01, center_px: 3, ...}: how far this may be wrong, see `CalibrationSigma`; the rest is by default.
depth.registered: warped into the colour camera, see `rstrack.data.registration`. depth.offset_s: seconds added to
depth's stamps. calibration.yaml and Kalibr's camchain.yaml: see `rstrack.data.foreign_camera_files`. A run.json holds
the cameras of its run in the same form (`camera_content`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from rsgen.errors import UserError, first_problem
from rsgen.files import read_text, read_yaml
from rsgen.geometry.camera import Camera, Model
from rsgen.geometry.shutter import Scan, Shutter
from rsgen.sequence.format import DEPTH_SCALE
from rstrack.data.depth_pattern import PATTERN_SIZE
from rstrack.data.estimate import read_info
from rstrack.data.foreign_camera_files import Camchain, is_camchain, is_opencv, opencv_content, read_camchain
from rstrack.data.registration import registered_shutter
from rstrack.data.rig import NO_DEPTH_ERROR, DepthError, Rig, rigid_transform, sigma_of_file
from rstrack.data.timing import StampsMode

EXAMPLE = "color: {width: 640, height: 480, intrinsics: [fx, fy, cx, cy], readout_s: 0.028}"
CAMERA_FILES = ("camera.yaml", "calibration.yaml", "camchain-imucam.yaml", "camchain.yaml")
_KEYS = "color, depth, T_color_depth, stamps, clocks and sigma, each camera with width, height, intrinsics, readout_s"

Size = tuple[int, int]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Seconds = Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)]
Drift = Annotated[float, Field(ge=-1e4, le=1e4, allow_inf_nan=False)]
Pixels = Annotated[int, Field(ge=1, le=16384)]
Vector4 = tuple[Finite, Finite, Finite, Finite]
Matrix4 = tuple[Vector4, Vector4, Vector4, Vector4]


@dataclass(frozen=True)
class RigFile:
    """The cameras, the depth images' units per metre, and what is to be done with the stamps.

    depth_offset_s: to be added to depth's stamps, so that they belong to the first row of the image as it is.
    color_offset_s: to be added to colour's; None: to be found. color_drift: what that grows by, s/s. scan_named,
    scale_named: whether it states which way images are read, and depth_scale. notes: what was assumed, for the screen.
    depth_error: of its images. clocks: (color_offset_s, color_drift) of recordings by their folders' names, in place of
    those two.
    """

    rig: Rig
    depth_scale: float
    stamps: StampsMode = "auto"
    depth_offset_s: float = 0.0
    color_offset_s: float | None = None
    color_drift: float = 0.0
    scan_named: bool = True
    scale_named: bool = True
    notes: tuple[str, ...] = ()
    depth_error: DepthError = NO_DEPTH_ERROR
    clocks: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def of(self, recording: str) -> RigFile:
        """With the clocks of one recording."""
        if recording not in self.clocks:
            return self
        offset_s, drift = self.clocks[recording]
        return replace(self, color_offset_s=offset_s, color_drift=drift)


class _Entry(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _Lens(_Entry):
    width: Pixels
    height: Pixels
    intrinsics: Vector4
    model: Model = "pinhole"
    distortion: tuple[Finite, ...] = ()

    def camera(self, name: str) -> Camera:
        """Raises UserError naming the entry."""
        if (fy := self.intrinsics[1]) < 0:
            raise UserError(
                f"{name}.intrinsics: fy = {fy:g} belongs to ICL-NUIM's y-up camera: write {-fy:g}; the images stay as "
                "they are and its .gt.freiburg file is converted when it is read"
            )
        try:
            return Camera(self.width, self.height, *self.intrinsics, self.model, self.distortion)
        except UserError as error:
            raise UserError(f"{name}: {error}") from None


class _CameraStream(_Lens):
    readout_s: Seconds
    exposure_s: Seconds = 0.0
    scan: Scan = "top-bottom"

    @property
    def shutter(self) -> Shutter:
        return Shutter(self.readout_s, self.exposure_s, self.scan)


class _ColorStream(_CameraStream):
    offset_s: Finite | Literal["auto"] = "auto"
    falloff: Annotated[float, Field(ge=-0.5, le=2.0, allow_inf_nan=False)] | Literal["auto"] = "auto"
    drift_ppm: Drift = 0.0


class _RecordingClock(_Entry):
    offset_s: Finite
    drift_ppm: Drift = 0.0


class _RegisteredSensor(_Lens):
    T_color_sensor: Matrix4 | None = None


class _DepthError(_Entry):
    offset_m: Annotated[float, Field(ge=-1.0, le=1.0)] = 0.0
    inverse_offset: Annotated[float, Field(ge=-1.0, le=1.0)] = 0.0
    radial: Annotated[float, Field(ge=-1.0, le=1.0)] = 0.0
    pattern: tuple[Annotated[float, Field(ge=-1.0, le=1.0)], ...] | Literal["auto"] = "auto"

    @model_validator(mode="after")
    def _has_all_of_a_pattern(self) -> _DepthError:
        if self.pattern != "auto" and len(self.pattern) not in (0, PATTERN_SIZE):
            raise ValueError(
                f"pattern has {len(self.pattern)} values: give the {PATTERN_SIZE} that 'rstrack calibrate' writes, [] "
                "for a depth camera without one, or auto"
            )
        return self

    @property
    def value(self) -> DepthError:
        pattern = None if self.pattern == "auto" else self.pattern
        return DepthError(self.offset_m, self.inverse_offset, self.radial, pattern)


class _DepthStream(_CameraStream):
    depth_scale: Annotated[float, Field(ge=1, allow_inf_nan=False)] = DEPTH_SCALE
    offset_s: Finite = 0.0
    error: _DepthError = _DepthError()
    # Warped into the colour camera; sensor: the camera it was warped from, whose lines readout_s and scan are about.
    registered: bool = False
    sensor: _RegisteredSensor | None = None

    @model_validator(mode="after")
    def _only_registered_has_a_sensor(self) -> _DepthStream:
        if self.sensor is not None and not self.registered:
            raise ValueError("sensor is the camera that registered depth was warped from: add 'registered: true'")
        return self


Sigma = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]


class _Sigma(_Entry):
    focal: Sigma | None = None
    aspect: Sigma | None = None
    center_px: Annotated[float, Field(ge=0, le=1e3, allow_inf_nan=False)] | None = None
    k1: Sigma | None = None
    p: Sigma | None = None
    rotation_deg: Annotated[float, Field(ge=0, le=30, allow_inf_nan=False)] | None = None
    translation_m: Sigma | None = None
    readout_s: Sigma | None = None
    offset_s: Sigma | None = None
    depth_scale: Sigma | None = None
    depth_inverse_offset: Sigma | None = None
    depth_image: Sigma | None = None


class _CameraYaml(_Entry):
    color: _ColorStream
    depth: _DepthStream | None = None
    T_color_depth: Matrix4 | None = None
    stamps: StampsMode = "auto"
    clocks: dict[str, _RecordingClock] = {}
    sigma: _Sigma = _Sigma()


def read_rig(path: Path, color_size: Size, depth_size: Size) -> RigFile:
    """Read a camera.yaml, a calibration.yaml, a camchain.yaml, or the cameras of a run from its run.json.

    color_size, depth_size: (width, height) in pixels of the first images: what a calibration.yaml may leave out.
    Raises UserError, one line, naming the file and what is missing or wrong in it.
    """
    if path.suffix == ".json":
        content = run_cameras(read_info(path))
        if content is None:
            raise UserError(f"{path}: states no cameras: its run went by those of its sequence")
        return _of_content(path, content)
    text = read_text(path)
    if is_opencv(text):
        return _of_content(path, opencv_content(path, text, color_size, depth_size))
    content = read_yaml(path)
    return _of_camchain(read_camchain(path, content)) if is_camchain(content) else _of_content(path, content)


def find_camera_file(root: Path, camera_file: Path | None) -> Path | None:
    """The given one, else that in the folder, None without any."""
    if camera_file is not None:
        return camera_file
    return next((root / name for name in CAMERA_FILES if (root / name).exists()), None)


def run_cameras(info: Mapping[str, Any]) -> dict[str, Any] | None:
    """The cameras of a run whose run.json holds `info`, as a camera.yaml has them; None where it has none."""
    dataset = info.get("dataset")
    cameras = dataset.get("camera") if isinstance(dataset, dict) else None
    return cameras if isinstance(cameras, dict) else None


def camera_content(file: RigFile) -> dict[str, Any]:
    """What a camera.yaml of the same cameras holds, but for `color.falloff`."""

    def stream(camera: Camera, shutter: Shutter) -> dict[str, Any]:
        intrinsics = [camera.fx, camera.fy, camera.cx, camera.cy]
        lens = {"intrinsics": intrinsics, "model": camera.model, "distortion": list(camera.distortion)}
        return {"width": camera.width, "height": camera.height} | lens | asdict(shutter)

    rig, sigma, error = file.rig, asdict(file.rig.sigma), asdict(file.depth_error)
    error["pattern"] = "auto" if error["pattern"] is None else list(error["pattern"])
    sigma["center_px"] = sigma.pop("center") * rig.color_camera.fx
    offset = {} if file.color_offset_s is None else {"offset_s": file.color_offset_s}
    return {
        "color": stream(rig.color_camera, rig.color_shutter) | offset | {"drift_ppm": 1e6 * file.color_drift},
        "depth": stream(rig.depth_camera, rig.depth_shutter)
        | {"offset_s": file.depth_offset_s, "depth_scale": file.depth_scale, "error": error},
        "T_color_depth": rig.T_color_depth.tolist(),
        "stamps": file.stamps,
    } | ({} if rig.sigma.is_exact else {"sigma": sigma})


def _of_content(path: Path, content: Mapping[str, Any]) -> RigFile:
    """A camera.yaml. Raises UserError, one line, naming the file."""
    try:
        data = _CameraYaml.model_validate(content)
        depth, streams = data.depth, [stream for stream in (data.color, data.depth) if stream is not None]
        color_camera, color_shutter = data.color.camera("color"), data.color.shutter
        depth_camera = color_camera if depth is None else depth.camera("depth")
        T_color_depth = rigid_transform("T_color_depth", data.T_color_depth or np.eye(4))
        depth_shutter, late_s, notes = _depth_shutter(depth, depth_camera, color_shutter)
    except (UserError, ValidationError) as error:
        raise UserError(f"{path}: {_first(error) if isinstance(error, ValidationError) else error}") from None
    has_pose = data.T_color_depth is not None or depth is None
    sigma = sigma_of_file(color_camera, data.sigma.model_dump(exclude_none=True), has_pose)
    falloff = None if data.color.falloff == "auto" else data.color.falloff
    rig = Rig(depth_camera, depth_shutter, color_camera, color_shutter, T_color_depth, falloff, sigma)
    color_offset_s = None if data.color.offset_s == "auto" else data.color.offset_s
    scan_named = any("scan" in stream.model_fields_set for stream in streams)
    clocks = {name: (clock.offset_s, 1e-6 * clock.drift_ppm) for name, clock in data.clocks.items()}
    file = RigFile(
        rig, DEPTH_SCALE, data.stamps, late_s, color_offset_s, 1e-6 * data.color.drift_ppm, scan_named,
        scale_named=False, notes=notes, clocks=clocks,
    )  # fmt: skip
    if depth is None:
        return file
    return replace(
        file, depth_scale=depth.depth_scale, scale_named="depth_scale" in depth.model_fields_set,
        depth_offset_s=late_s + depth.offset_s, depth_error=depth.error.value,
    )  # fmt: skip


def _of_camchain(chain: Camchain) -> RigFile:
    color, depth = chain.color, chain.depth or chain.color
    rig = Rig(depth.camera, depth.shutter, color.camera, color.shutter, chain.T_color_depth)
    rig = replace(rig, sigma=sigma_of_file(color.camera))
    return RigFile(
        rig, DEPTH_SCALE, color_offset_s=chain.color_offset_s, scan_named=color.has_readout or depth.has_readout,
        scale_named=False, notes=chain.notes,
    )  # fmt: skip


def _depth_shutter(
    depth: _DepthStream | None, camera: Camera, color: Shutter
) -> tuple[Shutter, float, tuple[str, ...]]:
    """Shutter of the depth images as they are, seconds to add to their stamps, and what was assumed."""
    if depth is None:
        note = f"registered depth taken as read out like colour, {1e3 * color.readout_s:g} ms"
        return (Shutter(color.readout_s, 0.0, color.scan), 0.0, (note,)) if color.readout_s else (Shutter(), 0.0, ())
    if depth.registered and depth.readout_s == 0.0 and color.readout_s > 0.0:
        note = "registered depth without a readout: taken at mid readout of colour"
        return depth.shutter, 0.5 * color.readout_s, (note,)
    if depth.sensor is None:
        return depth.shutter, 0.0, ()
    T = rigid_transform("depth.sensor.T_color_sensor", depth.sensor.T_color_sensor or np.eye(4))
    return *registered_shutter(camera, depth.sensor.camera("depth.sensor"), depth.shutter, T), ()


def _first(error: ValidationError) -> str:
    first = error.errors()[0]
    if first["type"] == "extra_forbidden":
        return f"{'.'.join(str(part) for part in first['loc'])}: no such entry: a camera file has {_KEYS}"
    hint = f"; write e.g. '{EXAMPLE}'" if first["type"] == "missing" else ""
    hint = ": it is units per metre, such as 5000" if first["loc"][-1:] == ("depth_scale",) else hint
    return f"{first_problem(error)}{hint}"
