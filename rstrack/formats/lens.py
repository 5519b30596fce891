"""Lens models by the names that others give them, as a `Camera`."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rsgen.errors import UserError
from rsgen.geometry.camera import Camera

# Larger than any camera's: a damaged file, which must not decide how much memory is taken.
_MOST_PIXELS = 1 << 26
_PINHOLE = ("", "none", "pinhole")
_RADTAN = ("plumb_bob", "radtan", "radial-tangential", "brown_conrady", "modified_brown_conrady")
_INVERSE = ("inverse_brown_conrady",)
_RATIONAL = ("rational_polynomial", "rational")
_DOUBLE_SPHERE = ("double_sphere", "ds")
_FISHEYE = ("equidistant", "fisheye", "kannala_brandt", "kannala_brandt4")


def camera_of(
    name: str, width: int, height: int, intrinsics: npt.ArrayLike, model: str, coefficients: npt.ArrayLike
) -> Camera:
    """The camera of a ROS camera_info, of librealsense or of an ASL sensor.yaml.

    name: for messages. intrinsics: fx, fy, cx, cy in pixels, pixel centres at integers. coefficients: in OpenCV's
    order, k1 k2 p1 p2 k3 k4 k5 k6 of the rational model, xi alpha of the double sphere; zeros at the end are no matter.
    librealsense's inverse Brown-Conrady is what its own projection makes of it, radtan. Raises UserError: a model that
    there is none of.
    """
    d = np.ravel(np.asarray(coefficients, float)).tolist()
    key = model.strip().lower().replace(" ", "_")
    fx, fy, cx, cy = np.ravel(np.asarray(intrinsics, float)).tolist()
    if width * height > _MOST_PIXELS:
        raise UserError(f"{name}: {width}x{height} pixels are absurd: the file is damaged")
    try:
        if not any(d) and key not in (*_FISHEYE, *_DOUBLE_SPHERE):
            return Camera(width, height, fx, fy, cx, cy)
        if key in _PINHOLE:
            raise UserError(f"distortion {d} without a model")
        if key in _FISHEYE:
            return Camera(width, height, fx, fy, cx, cy, "fisheye", tuple((d + [0.0] * 4)[:4]))
        if key in _DOUBLE_SPHERE and len(d) == 2:
            return Camera(width, height, fx, fy, cx, cy, "double_sphere", (d[0], d[1]))
        if key in (*_RADTAN, *_INVERSE, *_RATIONAL) and not any(d[5:]):
            return Camera(width, height, fx, fy, cx, cy, "radtan", tuple((d + [0.0] * 4)[: 5 if any(d[4:]) else 4]))
        if key in _RATIONAL and len(d) >= 8 and not any(d[8:]):
            return Camera(width, height, fx, fy, cx, cy, "rational", tuple(d[:8]))
    except UserError as error:
        raise UserError(f"{name}: {error}") from None
    raise UserError(
        f"{name}: lens model {model!r} with {len(d)} coefficients is not supported: undistort the images (OpenCV's "
        "initUndistortRectifyMap, or image_proc) and import those with the new camera matrix"
    )
