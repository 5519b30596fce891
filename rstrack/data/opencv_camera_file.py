"""Cameras out of a YAML file that OpenCV's FileStorage wrote, such as those of Kerl et al.'s rolling-shutter sets.

Their keys are documented nowhere, so several customary names are taken, in any case, with '.', '-' or nesting for '_':

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
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera, Model
from rsgen.geometry.shutter import Shutter
from rsgen.limits import rigid
from rstrack.data.rig import Rig

_STREAMS = {"color": ("color", "rgb"), "depth": ("depth",)}
_OTHER = {"color": "depth", "depth": "color"}
_MATRIX = ("camera_matrix", "k", "intrinsics")
_SCALARS = ("fx", "fy", "cx", "cy")
_DISTORTION = ("distortion", "distortion_coefficients", "dist_coeffs", "d")
_EXTRINSIC = ("t_color_depth", "t_rgb_depth", "extrinsics", "extrinsic")
_ROTATION_TOLERANCE = 1e-3  # what printing a matrix to three or four digits loses

Values = dict[str, Any]
Size = tuple[int, int]


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


def read_opencv_rig(path: Path, text: str, color_size: Size, depth_size: Size) -> tuple[Rig, float | None]:
    """The cameras and the depth images' units per metre (None: not told).

    path: for messages. text: what is in it. Sizes are (width, height) in pixels, for where the file tells none.
    Raises UserError that lists the keys that are there.
    """
    keys = _Keys(path, _parse(path, text))
    color_camera, depth_camera = keys.camera("color", color_size), keys.camera("depth", depth_size)
    color_shutter, depth_shutter = keys.shutter("color"), keys.shutter("depth")
    T_color_depth = keys.first(_EXTRINSIC)
    try:
        T = extrinsic(np.eye(4) if T_color_depth is None else T_color_depth, "T_color_depth")
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
    scale = keys.first(("depth_scale",))
    if scale is not None and not (np.ndim(scale) == 0 and 1.0 <= _number(scale) < math.inf):
        raise UserError(f"{path}: depth_scale {scale!r} is not a number of units per metre, such as 5000")
    rig = Rig(depth_camera, depth_shutter, color_camera, color_shutter, T)
    return rig, None if scale is None else _number(scale)


def extrinsic(T: npt.ArrayLike, name: str) -> FloatArray:
    """T (4, 4), its rotation made orthonormal to the last digit. Raises UserError if it is not a rigid transform."""
    try:
        return se3.orthonormalise(rigid(T, _ROTATION_TOLERANCE))
    except ValueError as error:
        raise UserError(f"{name}: {error}") from None


def check_fy(fy: float, where: str) -> None:
    """Raises UserError for ICL-NUIM's published focal length."""
    if fy < 0:
        raise UserError(
            f"{where}: fy = {fy:g} belongs to ICL-NUIM's y-up camera: write {-fy:g}; "
            "the images stay as they are and its .gt.freiburg file is converted when it is read"
        )


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

    def camera(self, stream: str, size: Size) -> Camera:
        intrinsics = self._intrinsics(stream) or self._intrinsics(_OTHER[stream])
        if intrinsics is None:
            raise self.fail(f"no camera matrix for {stream}: add '{stream}_intrinsics: [fx, fy, cx, cy]'")
        width, height = (
            default if (told := self.first((name, f"image_{name}"), stream)) is None else told
            for name, default in zip(("width", "height"), size, strict=True)
        )
        told = self.first(_DISTORTION, stream)
        distortion = _flat([] if told is None else told)
        if len(distortion) > 5 and not any(distortion[5:]):
            distortion = distortion[:5]  # OpenCV's longer models with their further terms at zero
        model: Model = "radtan" if any(distortion) else "pinhole"
        coefficients = tuple(distortion) if model == "radtan" else ()
        check_fy(intrinsics[1], f"{self.path}: {stream} camera matrix")
        try:
            return Camera(_whole(width), _whole(height), *intrinsics, model, coefficients)
        except UserError as error:
            raise UserError(f"{self.path}: {stream} {error}") from None

    def shutter(self, stream: str) -> Shutter:
        readout = self._seconds(stream, ("readout", "rolling_shutter_readout"))
        if readout is None:
            raise self.fail(
                f"no readout time for {stream}: add 'readout_s: 0.028' (seconds; 0 for a global shutter), "
                "or give a camera file"
            )
        try:
            return Shutter(readout, self._seconds(stream, ("exposure",)) or 0.0)
        except UserError as error:
            raise UserError(f"{self.path}: {stream} {error}") from None

    def _intrinsics(self, stream: str) -> tuple[float, float, float, float] | None:
        told = self.first(_MATRIX, stream)
        if told is None:
            told = [self.first((name,), stream) for name in _SCALARS]
            if any(value is None for value in told):
                return None
        numbers = _flat(told)
        if len(numbers) == 9 and numbers[1:2] + numbers[3:4] + numbers[6:] == [0, 0, 0, 0, 1]:
            numbers = [numbers[i] for i in (0, 4, 2, 5)]
        if len(numbers) != 4 or np.shape(told) == (2, 2):
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


def _whole(value: Any) -> int:
    number = _number(value)
    return int(number) if math.isfinite(number) and number == int(number) else 0
