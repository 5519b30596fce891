"""A sequence's cameras as a camera.yaml, the syntax that `rstrack` reads: truth/cameras.yaml, and that of the exports.

truth/cameras.yaml is there where sequence.yaml declares other cameras than those that took the images.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, ValidationError

from rsgen.array_types import FloatArray
from rsgen.errors import UserError, first_problem
from rsgen.files import read_yaml
from rsgen.geometry.camera import Camera, Model
from rsgen.geometry.shutter import Scan, Shutter
from rsgen.limits import RigidTransform, rigid

TRUE_CAMERAS = "truth/cameras.yaml"


@dataclass(frozen=True)
class Cameras:
    """Both sensors. depth: that which measured, also where its images were registered; T_color_depth (4, 4) from it."""

    color: Camera
    color_shutter: Shutter
    depth: Camera
    depth_shutter: Shutter
    depth_scale: float
    T_color_depth: FloatArray

    @classmethod
    def of(cls, color: Any, depth: Any, T_color_depth: npt.ArrayLike) -> Cameras:
        """Of streams that have a camera and a shutter, depth a scale: of a config or of a sequence."""
        sensors = color.camera, color.shutter, depth.camera, depth.shutter
        return cls(*sensors, depth.depth_scale, np.array(T_color_depth, float))


@dataclass(frozen=True)
class ColorClock:
    """What colour's listed stamps need to agree with depth's.

    offset_s: to be added to them, "auto" where that is to be found; drift_ppm: by what it grows, in the recording's
    middle it holds. is_exact: stamps are true ones, not a driver's.
    """

    offset_s: float | Literal["auto"] = 0.0
    drift_ppm: float = 0.0
    is_exact: bool = True


def camera_yaml(cameras: Cameras, clock: ColorClock, is_registered: bool) -> dict[str, Any]:
    """Content of a camera.yaml; is_registered: depth images have been warped into the colour camera."""
    drift = {"drift_ppm": clock.drift_ppm} if clock.drift_ppm else {}
    depth = _camera(cameras.color if is_registered else cameras.depth) | _shutter(cameras.depth_shutter)
    T_color_depth = [[float(value) for value in row] for row in cameras.T_color_depth]
    if is_registered:
        depth |= {"registered": True, "sensor": _camera(cameras.depth) | {"T_color_sensor": T_color_depth}}
    return {
        # Stamps of a driver are for the reader to judge, true ones are to be left alone.
        "stamps": "raw" if clock.is_exact else "auto",
        "color": _camera(cameras.color) | _shutter(cameras.color_shutter) | {"offset_s": clock.offset_s} | drift,
        "depth": depth | {"depth_scale": cameras.depth_scale},
    } | ({} if is_registered else {"T_color_depth": T_color_depth})


def _camera(camera: Camera) -> dict[str, Any]:
    return {
        "width": camera.width,
        "height": camera.height,
        "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
        "model": camera.model,
        "distortion": list(camera.distortion),
    }


def _shutter(shutter: Shutter) -> dict[str, Any]:
    return {"readout_s": shutter.readout_s, "exposure_s": shutter.exposure_s, "scan": shutter.scan}


class _Yaml(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class _Camera(_Yaml):
    width: int
    height: int
    intrinsics: tuple[float, float, float, float]
    model: Model
    distortion: tuple[float, ...]

    @property
    def camera(self) -> Camera:
        return Camera(self.width, self.height, *self.intrinsics, self.model, self.distortion)


class _Stream(_Camera):
    readout_s: float
    exposure_s: float
    scan: Scan

    @property
    def shutter(self) -> Shutter:
        return Shutter(self.readout_s, self.exposure_s, self.scan)


class _Sensor(_Camera):
    T_color_sensor: RigidTransform


class _Depth(_Stream):
    depth_scale: float
    sensor: _Sensor | None = None


class _File(_Yaml):
    color: _Stream
    depth: _Depth
    T_color_depth: RigidTransform | None = None


def read_true_cameras(root: Path) -> Cameras:
    """The cameras of truth/cameras.yaml in a sequence's folder. Raises UserError naming the file and what is wrong."""
    path = root / TRUE_CAMERAS
    if not path.is_file():
        raise UserError(f"{path}: is missing, but sequence.yaml declares other cameras: render again to write it")
    try:
        file = _File.model_validate(read_yaml(path))
        sensor = file.depth.sensor
        T_color_depth = file.T_color_depth if sensor is None else sensor.T_color_sensor
        if T_color_depth is None:
            raise UserError("T_color_depth is missing")
        depth = (sensor or file.depth).camera
        return Cameras(
            file.color.camera, file.color.shutter, depth, file.depth.shutter, file.depth.depth_scale,
            rigid(T_color_depth),
        )  # fmt: skip
    except ValidationError as error:
        raise UserError(f"{path}: {first_problem(error)}: render again to write it") from None
    except UserError as error:
        raise UserError(f"{path}: {error}: render again to write it") from None
