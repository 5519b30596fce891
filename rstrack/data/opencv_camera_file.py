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
import yaml

from rsgen.array_types import FloatArray
from rsgen.errors import UserError

_STREAMS = {"color": ("color", "rgb"), "depth": ("depth",)}
_OTHER = {"color": "depth", "depth": "color"}
_MATRIX = ("camera_matrix", "k", "intrinsics")
_SCALARS = ("fx", "fy", "cx", "cy")
_DISTORTION = ("distortion", "distortion_coefficients", "dist_coeffs", "d")
_EXTRINSIC = ("t_color_depth", "t_rgb_depth", "extrinsics", "extrinsic")

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
