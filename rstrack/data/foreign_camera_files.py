"""Camera files of other programs: YAML that OpenCV's FileStorage wrote, and Kalibr's camera chains.

**OpenCV**, such as those of Kerl et al.'s rolling-shutter sets. Their keys are documented nowhere, so several customary
names are taken, in any case, with '.', '-' or nesting for '_':

    camera_matrix, K, intrinsics      3x3 or [fx, fy, cx, cy]; or fx, fy, cx, cy one by one
    distortion, distortion_coefficients, dist_coeffs, D      k1 k2 p1 p2 [k3], as OpenCV has them; optional
    width, image_width; height, image_height                 optional: those of the images
    readout_s, readout_ms, readout, readout_time             also with rolling_shutter_ before it
    exposure_s, exposure_ms, exposure, exposure_time         optional
    depth_scale                                              units per metre, optional
    T_color_depth, T_rgb_depth, extrinsics, extrinsic        4x4, depth to colour camera; optional

Times end in _s for seconds or _ms for milliseconds; without, 1 and more are taken for milliseconds, less for seconds:
no camera takes a second, or less than a millisecond, to read an image out. (0 is a global shutter either way.)
Each name may have rgb_, color_ or depth_ before it, or _rgb, _color, _depth behind it, to hold for that camera only; a
matrix that only one camera has is the other's too. What is not known by name is ignored.

**Kalibr**, camchain.yaml or camchain-imucam.yaml, which also has the place of the IMU:

    cam0: {camera_model: pinhole, intrinsics: [fx, fy, cx, cy], distortion_model: radtan, distortion_coeffs: [...],
           resolution: [w, h], T_cam_imu: ..., timeshift_cam_imu: 0.002, line_delay: 5.8e-5}
    cam1: {..., T_cn_cnm1: ...}           p_cam1 from p_cam0

Which camera is which: by `rostopic` (depth, infra or ir; color or rgb), else cam0 is colour's and the second depth's;
one camera alone is of colour with registered depth. timeshift_cam_imu: t_imu = t_cam + shift; line_delay: seconds from
a row to the next (Kalibr's rolling-shutter calibration), below 0 where rows are read upwards. (Kalibr's wiki, "Yaml
formats", "Supported models".)
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Field

from rsgen.array_types import FloatArray
from rsgen.errors import UserError, validated
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera, Model
from rsgen.geometry.shutter import Shutter
from rstrack.data.rig import rigid_transform

_STREAMS = {"color": ("color", "rgb"), "depth": ("depth",)}
_OTHER = {"color": "depth", "depth": "color"}
_MATRIX = ("camera_matrix", "k", "intrinsics")
_SCALARS = ("fx", "fy", "cx", "cy")
_DISTORTION = ("distortion", "distortion_coefficients", "dist_coeffs", "d")
_EXTRINSIC = ("t_color_depth", "t_rgb_depth", "extrinsics", "extrinsic")

Values = dict[str, Any]
Size = tuple[int, int]

# Our lens models by Kalibr's camera and distortion model; its cameras by the names of their topics.
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


class _Loader(yaml.SafeLoader):
    """YAML with matrices."""


def _matrix(loader: yaml.SafeLoader, node: yaml.MappingNode) -> FloatArray:
    data = loader.construct_mapping(node, deep=True)
    try:
        shape = data["sizes"] if "sizes" in data else (data["rows"], data["cols"])
        return np.array(data["data"], float).reshape([int(n) for n in shape])
    except (KeyError, TypeError, ValueError, OverflowError):
        raise yaml.constructor.ConstructorError(problem="bad matrix", problem_mark=node.start_mark) from None


for _tag in ("opencv-matrix", "opencv-nd-matrix"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_tag}", _matrix)


def is_opencv(text: str) -> bool:
    """Whether it looks like a FileStorage file: its header (%YAML:1.0, since OpenCV 5 %YAML 1.2), or its matrices."""
    return text.lstrip().startswith("%YAML") or "!!opencv-" in text


def opencv_content(path: Path, text: str, color_size: Size, depth_size: Size) -> dict[str, Any]:
    """What a camera.yaml with the same cameras has.

    path: for messages. text: what is in it. Sizes are (width, height) in pixels, for where the file has none.
    Raises UserError that lists the keys that are there.
    """
    keys = _Keys(path, _parse(path, text))
    content: dict[str, Any] = {"color": keys.stream("color", color_size), "depth": keys.stream("depth", depth_size)}
    if (scale := keys.first(("depth_scale",))) is not None:
        content["depth"]["depth_scale"] = scale
    if (T := keys.first(_EXTRINSIC)) is not None:
        content["T_color_depth"] = np.asarray(T).tolist()
    return content


@dataclass(frozen=True)
class _Keys:
    """The file's entries by normalised name: lower case, nesting and punctuation as '_'."""

    path: Path
    values: Values

    def first(self, names: tuple[str, ...], stream: str | None = None) -> Any:
        """The entry of the first name that is there, the stream's own before the common one; None if none is."""
        words = _STREAMS[stream] if stream else ()
        own = [key for name in names for word in words for key in (f"{word}_{name}", f"{name}_{word}")]
        return next((self.values[key] for key in (*own, *names) if key in self.values), None)

    def fail(self, message: str) -> UserError:
        there = ", ".join(self.values)[:400] or "none"
        return UserError(f"{self.path}: {message}; keys that are there: {there}")

    def stream(self, stream: str, size: Size) -> dict[str, Any]:
        """Camera and shutter of a stream. Raises UserError."""
        intrinsics = self._intrinsics(stream) or self._intrinsics(_OTHER[stream])
        if intrinsics is None:
            raise self.fail(f"no camera matrix for {stream}: add '{stream}_intrinsics: [fx, fy, cx, cy]'")
        width, height = (
            default if (stated := self.first((name, f"image_{name}"), stream)) is None else stated
            for name, default in zip(("width", "height"), size, strict=True)
        )
        stated = self.first(_DISTORTION, stream)
        distortion = _flat([] if stated is None else stated)
        if len(distortion) > 5 and not any(distortion[5:]):
            distortion = distortion[:5]  # OpenCV's longer models with their further terms at zero
        lens = {"model": "radtan", "distortion": distortion} if any(distortion) else {}
        readout = self._seconds(stream, ("readout", "rolling_shutter_readout"))
        if readout is None:
            raise self.fail(
                f"no readout time for {stream}: add 'readout_s: 0.028' (seconds; 0 for a global shutter), "
                "or give a camera file"
            )
        return {
            "width": width, "height": height, "intrinsics": intrinsics, "readout_s": readout,
            "exposure_s": self._seconds(stream, ("exposure",)) or 0.0, "scan": "top-bottom", **lens,
        }  # fmt: skip

    def _intrinsics(self, stream: str) -> tuple[float, float, float, float] | None:
        stated = self.first(_MATRIX, stream)
        if stated is None:
            stated = [self.first((name,), stream) for name in _SCALARS]
            if any(value is None for value in stated):
                return None
        numbers = _flat(stated)
        if len(numbers) == 9 and numbers[1:2] + numbers[3:4] + numbers[6:] == [0, 0, 0, 0, 1]:
            numbers = [numbers[i] for i in (0, 4, 2, 5)]
        if len(numbers) != 4 or np.shape(stated) == (2, 2):
            raise self.fail(f"the camera matrix of {stream} is neither [fx 0 cx; 0 fy cy; 0 0 1] nor [fx, fy, cx, cy]")
        fx, fy, cx, cy = numbers
        return fx, fy, cx, cy

    def _seconds(self, stream: str, names: tuple[str, ...]) -> float | None:
        units = {"_s": 1.0, "_ms": 1e-3, "": None, "_time": None, "_time_s": 1.0, "_time_ms": 1e-3}
        for name in names:
            for suffix, unit in units.items():
                value = self.first((name + suffix,), stream)
                if value is not None:
                    number = _number(value)
                    if unit is None:
                        unit = 1e-3 if number >= 1.0 else 1.0
                    return number * unit
        return None


def _parse(path: Path, text: str) -> Values:
    # Not the YAML that its header claims to be: PyYAML would refuse the directive.
    body = re.sub(r"\A\s*%YAML[^\n]*", "", text)
    try:
        data = yaml.load(body, Loader=_Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        raise UserError(f"{path}:{f' line {mark.line + 1}' if mark else ''} is not valid OpenCV YAML") from None
    if not isinstance(data, dict | None):
        raise UserError(f"{path}: expected entries 'name: value'")
    values: Values = {}
    _flatten("", data or {}, values)
    return values


def _flatten(prefix: str, data: Values, into: Values) -> None:
    for key, value in data.items():
        name = prefix + "".join(c if c.isalnum() else "_" for c in str(key).lower())
        if isinstance(value, dict):
            _flatten(f"{name}_", value, into)
        else:
            into[name] = value


def _flat(value: Any) -> list[float]:
    """All numbers in a matrix or list; NaN for what is no number."""
    try:
        return [float(x) for x in np.array(value, float).ravel()]
    except (TypeError, ValueError):
        return [math.nan]


def _number(value: Any) -> float:
    numbers = _flat(value)
    return numbers[0] if len(numbers) == 1 else math.nan


# ---------------------------------------------------------------------------------------------------------------------
# of Kalibr


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
