"""The cameras of folders that are no rsgen sequence: our camera.yaml, or a calibration.yaml of OpenCV's FileStorage.

camera.yaml (depth left out: the same camera as colour, registered to it, global shutter, 5000 units per metre):

    color: {width: 640, height: 480, intrinsics: [481.2, 480.0, 319.5, 239.5], readout_s: 0.028}
    depth: {width: 640, height: 480, intrinsics: [481.2, 480.0, 319.5, 239.5], readout_s: 0.028, depth_scale: 5000}

Each may have model (pinhole, radtan, fisheye), distortion, exposure_s and scan as in rsgen's configs. T_color_depth
(4x4) is the identity where it is left out. calibration.yaml: see `rstrack.data.opencv_camera_file`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from rsgen.errors import UserError, first_problem
from rsgen.files import read_text, read_yaml
from rsgen.geometry.camera import Camera, Model
from rsgen.geometry.shutter import Scan, Shutter
from rsgen.sequence.format import DEPTH_SCALE
from rstrack.data.opencv_camera_file import check_fy, extrinsic, is_opencv, read_opencv_rig
from rstrack.data.rig import Rig

EXAMPLE = "color: {width: 640, height: 480, intrinsics: [fx, fy, cx, cy], readout_s: 0.028}"
_KEYS = "color, depth, T_color_depth, each camera with width, height, intrinsics, readout_s"

Size = tuple[int, int]
Finite = Annotated[float, Field(allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Pixels = Annotated[int, Field(ge=1, le=16384)]
Vector4 = tuple[Finite, Finite, Finite, Finite]


@dataclass(frozen=True)
class RigFile:
    """The cameras and the depth images' units per metre."""

    rig: Rig
    depth_scale: float


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _Stream(_Section):
    width: Pixels
    height: Pixels
    intrinsics: Vector4
    model: Model = "pinhole"
    distortion: tuple[Finite, ...] = ()
    readout_s: NonNegative
    exposure_s: NonNegative = 0.0
    scan: Scan = "top-bottom"

    @property
    def camera(self) -> Camera:
        return Camera(self.width, self.height, *self.intrinsics, self.model, self.distortion)

    @property
    def shutter(self) -> Shutter:
        return Shutter(self.readout_s, self.exposure_s, self.scan)


class _DepthStream(_Stream):
    depth_scale: Annotated[float, Field(ge=1, allow_inf_nan=False)] = DEPTH_SCALE
    # Warped into the colour camera: rows of such an image have no times of their own.
    registered: bool = False

    @model_validator(mode="after")
    def _has_no_row_times(self) -> _DepthStream:
        if self.registered and self.readout_s != 0.0:
            raise ValueError("registered depth has lost its rows' times: set readout_s to 0")
        return self


class _CameraYaml(_Section):
    color: _Stream
    depth: _DepthStream | None = None
    T_color_depth: tuple[Vector4, Vector4, Vector4, Vector4] | None = None


def read_rig(path: Path, color_size: Size, depth_size: Size) -> RigFile:
    """Read a camera.yaml or a calibration.yaml.

    color_size, depth_size: (width, height) in pixels of the first images: what a calibration.yaml may leave out.
    Raises UserError, one line, naming the file and what is missing or wrong in it.
    """
    text = read_text(path)
    if is_opencv(text):
        rig, depth_scale = read_opencv_rig(path, text, color_size, depth_size)
        return RigFile(rig, DEPTH_SCALE if depth_scale is None else depth_scale)
    try:
        data = _CameraYaml.model_validate(read_yaml(path))
    except ValidationError as error:
        raise UserError(f"{path}: {_first(error)}") from None
    depth = data.depth
    try:
        color_camera = _camera("color", data.color)
        depth_camera = color_camera if depth is None else _camera("depth", depth)
        T_color_depth = extrinsic(np.eye(4) if data.T_color_depth is None else data.T_color_depth, "T_color_depth")
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
    depth_shutter = Shutter() if depth is None else depth.shutter
    rig = Rig(depth_camera, depth_shutter, color_camera, data.color.shutter, T_color_depth)
    return RigFile(rig, DEPTH_SCALE if depth is None else depth.depth_scale)


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
