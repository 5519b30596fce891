"""Pictures for a report: frames, depth in colours, and a rolling-shutter frame turned into a global-shutter one."""

from __future__ import annotations

import base64

import cv2
import numpy as np
import numpy.typing as npt

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter, project_rolling
from rsgen.geometry.spline import Spline
from rstrack.data.rig import Image, Rig

_JPEG_QUALITY = 85
# Where nothing was measured.
_NOTHING = 128
# Pixels between the samples of a coarser depth image, which are filled from their neighbours.
_FILL_ROUNDS = 3


def jpeg_uri(image: npt.NDArray[np.uint8], width: int = 640) -> str:
    """An RGB image (h, w, 3) as a data URI, made smaller if it is wider than `width` pixels."""
    if image.shape[1] > width:
        height = round(image.shape[0] * width / image.shape[1])
        image = np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    ok, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    if not ok:
        raise ValueError("cv2 could not encode a JPEG")
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode("ascii")


def colored_depth(z: npt.NDArray[np.float32]) -> tuple[npt.NDArray[np.uint8], float, float]:
    """Planar z (h, w) in m as RGB (h, w, 3), grey where it is 0; and the depths in m of dark and bright."""
    seen = z > 0.0
    low, high = (float(v) for v in np.percentile(z[seen], [1.0, 99.0])) if seen.any() else (0.0, 1.0)
    scaled = np.clip((z - low) / max(high - low, 1e-6), 0.0, 1.0)
    image = cv2.applyColorMap(np.rint(255.0 * scaled).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    return np.where(seen[..., None], cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8(_NOTHING)), low, high


def rectified(rig: Rig, spline: Spline, depth: Image, color: Image) -> npt.NDArray[np.uint8]:
    """The colour image (h, w, 3) as a global shutter at its middle line's time would have taken it; grey where unknown.

    spline: T_world_depth(t), which must cover both readouts. The measured depth, each point moved by its own line's
    pose, is seen from the middle line's pose; each pixel's point is then looked up in the rolling-shutter image, where
    equation (3) of the paper says that it is.
    """
    camera, shutter = rig.color_camera, rig.color_shutter
    middle = shutter.line_mid_time(color.stamp, (shutter.line_count(camera) - 1) / 2, camera)
    T_world_color = spline.pose(middle) @ se3.inverse(rig.T_color_depth)
    p_world = _points(rig.depth_camera, rig.depth_shutter, spline, depth)
    z = _seen(camera, se3.transform(se3.inverse(T_world_color), p_world))
    known = z > 0.0
    there = se3.transform(T_world_color, camera.backproject(camera.pixel_grid()[known], z[known]))
    uv = np.full((*z.shape, 2), -10.0, np.float32)
    found, _, valid = project_rolling(spline, rig.T_color_depth, camera, shutter, color.stamp, there, iterations=4)
    uv[known] = np.where(valid[:, None], found, -10.0)
    grey = (_NOTHING, _NOTHING, _NOTHING)
    image = cv2.remap(
        color.pixels, uv[..., 0], uv[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=grey
    )
    # At the border the interpolation mixes the picture with what lies outside.
    image[(uv < 0.0).any(axis=-1)] = _NOTHING
    return np.asarray(image, np.uint8)


# ---------------------------------------------------------------------------------------------------------------------


def _points(camera: Camera, shutter: Shutter, spline: Spline, depth: Image) -> FloatArray:
    """Points (n, 3) in the world that a depth image measures, each from its own line's pose."""
    seen = (depth.pixels > 0.0) & np.isfinite(depth.pixels)
    uv = camera.pixel_grid()[seen]
    lines = np.arange(shutter.line_count(camera))
    T_world_depth = spline.pose(shutter.line_mid_time(depth.stamp, lines, camera))
    line = np.rint(shutter.line_of_pixel(uv, camera)).astype(np.int64)
    return se3.transform(T_world_depth[line], camera.backproject(uv, depth.pixels[seen]))


def _seen(camera: Camera, p_cam: FloatArray) -> npt.NDArray[np.float64]:
    """Planar z (h, w) of the nearest of the points (n, 3) in each pixel, small holes filled with the nearest beside."""
    uv, _ = camera.project(p_cam)
    inside = camera.contains(uv)
    x, y = np.rint(uv[inside]).astype(np.int64).T
    inverse = np.zeros((camera.height, camera.width))
    np.maximum.at(inverse, (y, x), 1.0 / p_cam[inside, 2])
    for _ in range(_FILL_ROUNDS):
        inverse = np.where(inverse > 0.0, inverse, cv2.dilate(inverse, np.ones((3, 3), np.uint8)))
    return np.where(inverse > 0.0, 1.0 / np.where(inverse > 0.0, inverse, 1.0), 0.0)
