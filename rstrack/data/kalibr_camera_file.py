"""Kalibr's results, camchain.yaml or camchain-imucam.yaml, as a camera file and as the place of the IMU.

    cam0: {camera_model: pinhole, intrinsics: [fx, fy, cx, cy], distortion_model: radtan, distortion_coeffs: [...],
           resolution: [w, h], T_cam_imu: ..., timeshift_cam_imu: 0.002, line_delay: 5.8e-5}
    cam1: {..., T_cn_cnm1: ...}           p_cam1 from p_cam0

Which camera is which: by `rostopic` (depth, infra or ir; color or rgb), else cam0 is colour's and the second depth's;
one camera alone is of colour with registered depth. timeshift_cam_imu: t_imu = t_cam + shift; line_delay: seconds from
a row to the next (Kalibr's rolling-shutter calibration), below 0 where rows are read upwards. (Kalibr's wiki, "Yaml
formats", "Supported models".)
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from rsgen.array_types import FloatArray
from rsgen.errors import UserError, validated
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera, Model
from rsgen.geometry.shutter import Shutter
from rstrack.data.rig import rigid_transform

_MODELS: dict[tuple[str, str], Model] = {
    ("pinhole", "none"): "pinhole",
    ("pinhole", "radtan"): "radtan",
    ("pinhole", "equidistant"): "fisheye",
    ("ds", "none"): "double_sphere",
}
_KNOWN = "pinhole with radtan, equidistant or none, and ds with none"
_DEPTH, _COLOR = re.compile(r"depth|infra|(^|/)ir(/|$)"), re.compile(r"colou?r|rgb")

Finite = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
Pixels = Annotated[int, Field(ge=1, le=16384)]


class _Cam(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)

    camera_model: str
    intrinsics: tuple[Finite, ...]
    distortion_model: str = "none"
    distortion_coeffs: tuple[Finite, ...] = ()
    resolution: tuple[Pixels, Pixels]
    rostopic: str = ""
    T_cn_cnm1: Any = None
    T_cam_imu: Any = None
    timeshift_cam_imu: Annotated[float, Field(ge=-10, le=10, allow_inf_nan=False)] | None = None
    line_delay: Annotated[float, Field(ge=-0.01, le=0.01, allow_inf_nan=False)] | None = None


@dataclass(frozen=True)
class ChainCamera:
    """One camera of a chain.

    has_readout: whether its readout is stated. T_cam_imu (4, 4), and shift_s: t_imu - t_cam of the line that is read
    first; None where they are not stated.
    """

    camera: Camera
    shutter: Shutter
    has_readout: bool
    T_cam_imu: FloatArray | None
    shift_s: float | None


@dataclass(frozen=True)
class Camchain:
    """depth: None where it is registered to colour. T_color_depth (4, 4): p_color from p_depth."""

    color: ChainCamera
    depth: ChainCamera | None
    T_color_depth: FloatArray

    @property
    def color_offset_s(self) -> float | None:
        """Seconds to add to colour's stamps for depth's clock; None where not both are stated against the IMU."""
        shifts = self.color.shift_s, None if self.depth is None else self.depth.shift_s
        return None if shifts[0] is None or shifts[1] is None else shifts[0] - shifts[1]

    @property
    def notes(self) -> tuple[str, ...]:
        """What a chain does not state."""
        cameras = {"color": self.color} | ({} if self.depth is None else {"depth": self.depth})
        return tuple(
            f"the camchain has no line_delay of {name}: taken for a global shutter, rstrack calibrate finds its readout"
            for name, camera in cameras.items()
            if not camera.has_readout
        )


def is_camchain(data: dict[str, Any]) -> bool:
    """Whether a YAML mapping is one of Kalibr's camera chains."""
    return isinstance(data.get("cam0"), dict) and "camera_model" in data["cam0"]


def read_camchain(path: Path, data: dict[str, Any]) -> Camchain:
    """path: for messages. data: the file's content. Raises UserError, one line."""
    names = [f"cam{k}" for k in range(len(data)) if f"cam{k}" in data]
    cams = {name: validated(_Cam.model_validate, data[name], path, name) for name in names}
    color, depth = _roles(path, cams)
    T_cam_cam0 = _chain(path, cams)
    T = np.eye(4) if depth is None else T_cam_cam0[color] @ se3.inverse(T_cam_cam0[depth])
    found = {name: _camera(path, name, cams[name]) for name in (color, depth) if name is not None}
    return Camchain(found[color], None if depth is None else found[depth], se3.orthonormalise(T))


def _roles(path: Path, cams: dict[str, _Cam]) -> tuple[str, str | None]:
    """Names of colour's camera and of depth's. Raises UserError."""
    topics = {name: cam.rostopic.lower() for name, cam in cams.items()}
    depths = [name for name, topic in topics.items() if _DEPTH.search(topic)]
    colors = [name for name, topic in topics.items() if _COLOR.search(topic) and name not in depths]
    rest = [name for name in cams if name not in (*depths[:1], *colors[:1])]
    color = colors[0] if colors else rest.pop(0) if rest else None
    if color is None or (not depths and len(rest) > 1):
        raise UserError(
            f"{path}: which of {', '.join(cams)} is colour's and which depth's? leave these two in the file"
        )
    return color, depths[0] if depths else rest[0] if rest else None


def _chain(path: Path, cams: dict[str, _Cam]) -> dict[str, FloatArray]:
    """T_cam_cam0 (4, 4) of each, by T_cn_cnm1, or by the IMU where the chain is broken. Raises UserError."""
    T = {"cam0": np.eye(4)}
    for before, name in zip(list(cams), list(cams)[1:], strict=False):
        cam, first = cams[name], cams["cam0"]
        if cam.T_cn_cnm1 is not None:
            T[name] = rigid_transform(f"{path}: {name}.T_cn_cnm1", cam.T_cn_cnm1) @ T[before]
        elif cam.T_cam_imu is not None and first.T_cam_imu is not None:
            T_cam0_imu = rigid_transform(f"{path}: cam0.T_cam_imu", first.T_cam_imu)
            T[name] = rigid_transform(f"{path}: {name}.T_cam_imu", cam.T_cam_imu) @ se3.inverse(T_cam0_imu)
        else:
            raise UserError(f"{path}: {name}.T_cn_cnm1: is missing: nothing states where the camera sits")
    return T


def _camera(path: Path, name: str, cam: _Cam) -> ChainCamera:
    key: tuple[str, str] = (cam.camera_model, cam.distortion_model)
    if key not in _MODELS:
        raise UserError(f"{path}: {name}: lens {' with '.join(key)[:60]!r} is not supported: there are {_KNOWN}")
    model, bent = _MODELS[key], cam.distortion_coeffs if cam.distortion_model != "none" else ()
    own = cam.intrinsics[:-4] if model == "double_sphere" else ()
    if len(cam.intrinsics) != len(own) + 4 or (model == "double_sphere") != (len(own) == 2):
        raise UserError(
            f"{path}: {name}.intrinsics: expected fx, fy, cx, cy (ds: xi, alpha before), got {cam.intrinsics}"
        )
    fx, fy, cx, cy = cam.intrinsics[-4:]
    try:
        camera = Camera(*cam.resolution, fx, fy, cx, cy, model, (*own, *bent))
    except UserError as error:
        raise UserError(f"{path}: {name}: {error}") from None
    delay = cam.line_delay or 0.0
    scan: Literal["top-bottom", "bottom-top"] = "bottom-top" if delay < 0 else "top-bottom"
    # Kalibr's shift is that of row 0, which is read last where rows are read upwards.
    shift = cam.timeshift_cam_imu
    first = None if shift is None else shift + min(delay, 0.0) * (camera.height - 1)
    T = None if cam.T_cam_imu is None else rigid_transform(f"{path}: {name}.T_cam_imu", cam.T_cam_imu)
    return ChainCamera(camera, Shutter(abs(delay) * camera.height, 0.0, scan), cam.line_delay is not None, T, first)
