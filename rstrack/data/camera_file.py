"""The cameras of folders that are no rsgen sequence: our camera.yaml, or a calibration.yaml of OpenCV's FileStorage.

camera.yaml (depth left out: registered to colour, read out as colour is, 5000 units per metre):

    color: {width: 640, height: 480, intrinsics: [481.2, 480.0, 319.5, 239.5], readout_s: 0.028, offset_s: 0.02}
    depth: {width: 640, height: 480, intrinsics: [481.2, 480.0, 319.5, 239.5], readout_s: 0.028, depth_scale: 5000}
    stamps: auto

Each may have model (pinhole, radtan, rational, fisheye, double_sphere), distortion, exposure_s and scan as in rsgen's
configs.
T_color_depth (4x4) is the identity where it is left out. color.offset_s: seconds added to colour's stamps; auto: see
`rstrack.data.timing`; color.drift_ppm: millionths by which that grows over the recording, in whose middle it
holds; both are what `rstrack calibrate` finds, which writes such a file; clocks: {NAME: {offset_s: 0.02, drift_ppm: 3}}
of the recording in a folder of that name alone. color.falloff: see `Rig`; auto: `track` finds
it. stamps: auto, raw or regular, see there too.
sigma: {focal: 0.01, center_px: 3, ...}: how far this may be wrong, see `CalibrationSigma`; the rest is as usual.
depth.registered: warped into the colour camera, see `rstrack.data.registration`. depth.offset_s: seconds added to
depth's stamps. calibration.yaml: see `rstrack.data.opencv_camera_file`; Kalibr's camchain.yaml: see
`rstrack.data.kalibr_camera_file`. A run.json holds the cameras of its run in the same form (`camera_content`).
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
from rstrack.data.estimate import read_info
from rstrack.data.kalibr_camera_file import Camchain, is_camchain, read_camchain
from rstrack.data.opencv_camera_file import check_fy, extrinsic, is_opencv, read_opencv_rig
from rstrack.data.registration import DepthSensor, registered_shutter
from rstrack.data.rig import DEFAULT_SIGMA, NO_DEPTH_ERROR, UNDISTORTED_K1, CalibrationSigma, DepthError, Rig
from rstrack.data.timing import StampsMode

EXAMPLE = "color: {width: 640, height: 480, intrinsics: [fx, fy, cx, cy], readout_s: 0.028}"
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
    scale_named: whether it says which way images are read, and depth_scale. notes: what was assumed, for the screen.
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


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _Stream(_Section):
    width: Pixels
    height: Pixels
    intrinsics: Vector4
    model: Model = "pinhole"
    distortion: tuple[Finite, ...] = ()
    readout_s: Seconds
    exposure_s: Seconds = 0.0
    scan: Scan = "top-bottom"

    @property
    def camera(self) -> Camera:
        return Camera(self.width, self.height, *self.intrinsics, self.model, self.distortion)

    @property
    def shutter(self) -> Shutter:
        return Shutter(self.readout_s, self.exposure_s, self.scan)


class _ColorStream(_Stream):
    offset_s: Finite | Literal["auto"] = "auto"
    falloff: Annotated[float, Field(ge=-0.5, le=2.0, allow_inf_nan=False)] | Literal["auto"] = "auto"
    drift_ppm: Drift = 0.0


class _Clock(_Section):
    offset_s: Finite
    drift_ppm: Drift = 0.0


class _Sensor(_Section):
    width: Pixels
    height: Pixels
    intrinsics: Vector4
    model: Model = "pinhole"
    distortion: tuple[Finite, ...] = ()
    T_color_sensor: Matrix4 | None = None


class _DepthError(_Section):
    offset_m: Annotated[float, Field(ge=-1.0, le=1.0)] = 0.0
    inverse_offset: Annotated[float, Field(ge=-1.0, le=1.0)] = 0.0
    radial: Annotated[float, Field(ge=-1.0, le=1.0)] = 0.0


class _DepthStream(_Stream):
    depth_scale: Annotated[float, Field(ge=1, allow_inf_nan=False)] = DEPTH_SCALE
    offset_s: Finite = 0.0
    error: _DepthError = _DepthError()
    # Warped into the colour camera; sensor: the camera it was warped from, whose lines readout_s and scan are about.
    registered: bool = False
    sensor: _Sensor | None = None

    @model_validator(mode="after")
    def _only_registered_has_a_sensor(self) -> _DepthStream:
        if self.sensor is not None and not self.registered:
            raise ValueError("sensor is the camera that registered depth was warped from: add 'registered: true'")
        return self


Sigma = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]


class _Sigma(_Section):
    focal: Sigma | None = None
    aspect: Sigma | None = None
    center_px: Annotated[float, Field(ge=0, le=1e3, allow_inf_nan=False)] | None = None
    k1: Sigma | None = None
    rotation_deg: Annotated[float, Field(ge=0, le=30, allow_inf_nan=False)] | None = None
    translation_m: Sigma | None = None
    readout_s: Sigma | None = None
    offset_s: Sigma | None = None
    depth_scale: Sigma | None = None
    depth_inverse_offset: Sigma | None = None
    depth_image: Sigma | None = None


class _CameraYaml(_Section):
    color: _ColorStream
    depth: _DepthStream | None = None
    T_color_depth: Matrix4 | None = None
    stamps: StampsMode = "auto"
    clocks: dict[str, _Clock] = {}
    sigma: _Sigma = _Sigma()


def read_rig(path: Path, color_size: Size, depth_size: Size) -> RigFile:
    """Read a camera.yaml, a calibration.yaml, a camchain.yaml, or the cameras of a run from its run.json.

    color_size, depth_size: (width, height) in pixels of the first images: what a calibration.yaml may leave out.
    Raises UserError, one line, naming the file and what is missing or wrong in it.
    """
    if path.suffix == ".json":
        content = run_cameras(read_info(path))
        if content is None:
            raise UserError(f"{path}: tells no cameras: its run went by those of its sequence")
        return _of_content(path, content)
    text = read_text(path)
    if is_opencv(text):
        rig, depth_scale = read_opencv_rig(path, text, color_size, depth_size)
        rig = replace(rig, sigma=usual(rig.color_camera))
        return RigFile(rig, depth_scale or DEPTH_SCALE, scale_named=depth_scale is not None)
    content = read_yaml(path)
    if is_camchain(content):
        return _of_camchain(read_camchain(path, content))
    return _of_content(path, content)


def usual(camera: Camera, stated: Mapping[str, float] | None = None) -> CalibrationSigma:
    """How far a camera file may be wrong that states these σ, by the names that it has for them."""
    found = dict(stated or {})
    if "center_px" in found:
        found["center"] = found.pop("center_px") / camera.fx
    return replace(DEFAULT_SIGMA if any(camera.distortion) else replace(DEFAULT_SIGMA, k1=UNDISTORTED_K1), **found)


def run_cameras(info: Mapping[str, Any]) -> dict[str, Any] | None:
    """The cameras of a run whose run.json holds `info`, as a camera.yaml has them; None where it does not tell."""
    dataset = info.get("dataset")
    cameras = dataset.get("camera") if isinstance(dataset, dict) else None
    return cameras if isinstance(cameras, dict) else None


def camera_content(file: RigFile) -> dict[str, Any]:
    """What a camera.yaml that says the same holds, but for `color.falloff`."""

    def stream(camera: Camera, shutter: Shutter) -> dict[str, Any]:
        intrinsics = [camera.fx, camera.fy, camera.cx, camera.cy]
        lens = {"intrinsics": intrinsics, "model": camera.model, "distortion": list(camera.distortion)}
        return {"width": camera.width, "height": camera.height} | lens | asdict(shutter)

    rig = file.rig
    offset = {} if file.color_offset_s is None else {"offset_s": file.color_offset_s}
    return {
        "color": stream(rig.color_camera, rig.color_shutter) | offset | {"drift_ppm": 1e6 * file.color_drift},
        "depth": stream(rig.depth_camera, rig.depth_shutter)
        | {"offset_s": file.depth_offset_s, "depth_scale": file.depth_scale, "error": asdict(file.depth_error)},
        "T_color_depth": rig.T_color_depth.tolist(),
        "stamps": file.stamps,
    } | ({} if rig.sigma.is_exact else {"sigma": _stated(rig)})


def _stated(rig: Rig) -> dict[str, float]:
    sigma = asdict(rig.sigma)
    return sigma | {"center_px": sigma.pop("center") * rig.color_camera.fx}


def _of_content(path: Path, content: Mapping[str, Any]) -> RigFile:
    """A camera.yaml. Raises UserError, one line, naming the file."""
    try:
        data = _CameraYaml.model_validate(content)
    except ValidationError as error:
        raise UserError(f"{path}: {_first(error)}") from None
    depth = data.depth
    try:
        color_camera = _camera("color", data.color)
        depth_camera = color_camera if depth is None else _camera("depth", depth)
        T_color_depth = extrinsic(np.eye(4) if data.T_color_depth is None else data.T_color_depth, "T_color_depth")
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
    color_shutter = data.color.shutter
    try:
        depth_shutter, late_s, notes = _depth_shutter(depth, depth_camera, color_shutter)
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
    return RigFile(
        Rig(
            depth_camera,
            depth_shutter,
            color_camera,
            color_shutter,
            T_color_depth,
            None if data.color.falloff == "auto" else data.color.falloff,
            usual(color_camera, data.sigma.model_dump(exclude_none=True)),
        ),
        DEPTH_SCALE if depth is None else depth.depth_scale,
        data.stamps,
        late_s if depth is None else late_s + depth.offset_s,
        None if data.color.offset_s == "auto" else data.color.offset_s,
        1e-6 * data.color.drift_ppm,
        any("scan" in stream.model_fields_set for stream in (data.color, depth) if stream is not None),
        depth is not None and "depth_scale" in depth.model_fields_set,
        notes,
        NO_DEPTH_ERROR if depth is None else DepthError(**depth.error.model_dump()),
        {name: (clock.offset_s, 1e-6 * clock.drift_ppm) for name, clock in data.clocks.items()},
    )


def _of_camchain(chain: Camchain) -> RigFile:
    color, depth = chain.color, chain.depth or chain.color
    sigma = usual(color.camera)
    rig = Rig(depth.camera, depth.shutter, color.camera, color.shutter, chain.T_color_depth, sigma=sigma)
    known = color.has_readout or depth.has_readout
    return RigFile(
        rig, DEPTH_SCALE, color_offset_s=chain.color_offset_s, scan_named=known, scale_named=False, notes=chain.notes
    )


def _depth_shutter(
    depth: _DepthStream | None, camera: Camera, color: Shutter
) -> tuple[Shutter, float, tuple[str, ...]]:
    """Shutter of the depth images as they are, seconds to add to their stamps, and what was assumed."""
    if depth is None:
        if color.readout_s == 0.0:
            return Shutter(), 0.0, ()
        shutter = Shutter(color.readout_s, 0.0, color.scan)
        return shutter, 0.0, (f"registered depth taken as read out like colour, {1e3 * color.readout_s:g} ms",)
    if depth.registered and depth.readout_s == 0.0 and color.readout_s > 0.0:
        note = "registered depth without a readout: taken at mid readout of colour"
        return depth.shutter, 0.5 * color.readout_s, (note,)
    if depth.sensor is None:
        return depth.shutter, 0.0, ()
    sensor = depth.sensor
    given = Camera(sensor.width, sensor.height, *sensor.intrinsics, sensor.model, sensor.distortion)
    T = extrinsic(np.eye(4) if sensor.T_color_sensor is None else sensor.T_color_sensor, "depth.sensor.T_color_sensor")
    return *registered_shutter(camera, DepthSensor(given, depth.shutter, T)), ()


def _camera(name: str, stream: _Stream) -> Camera:
    check_fy(stream.intrinsics[1], f"{name}.intrinsics")
    try:
        return stream.camera
    except UserError as error:
        raise UserError(f"{name}: {error}") from None


def _first(error: ValidationError) -> str:
    first = error.errors()[0]
    if first["type"] == "extra_forbidden":
        return f"{'.'.join(str(part) for part in first['loc'])}: no such entry: a camera file has {_KEYS}"
    example = f"; write e.g. '{EXAMPLE}'" if first["type"] == "missing" else ""
    return f"{first_problem(error)}{example}"
