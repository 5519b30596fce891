"""Rows' times of registered depth: a driver that warps depth into the colour camera hardly changes the rows' order.

The cameras lie beside each other with their rows alike, so a row of the registered image shows one line of the depth
sensor, or between two, wherever in the row and however far away: line ≈ a·row + b. Its times are those of a shutter
that reads a times as long and starts b lines later. Where the sensor's geometry is not known, a = 1 and b = 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter

# Depths (m) that are looked at: the middle of what such sensors see.
_DEPTHS = (1.0, 2.0, 4.0)
_EVERY = 8


@dataclass(frozen=True)
class DepthSensor:
    """The camera that depth was warped from, its shutter, and T_color_sensor (4, 4) to the camera warped into."""

    camera: Camera
    shutter: Shutter
    T_color_sensor: FloatArray


def registered_shutter(camera: Camera, sensor: DepthSensor) -> tuple[Shutter, float]:
    """The shutter of images of `camera` that were warped from a sensor, and seconds to add to the sensor's stamps.

    Least squares over pixels and depths. Raises UserError if the sensor sees none of them, or its lines do not run
    along those of the image.
    """
    pixels = camera.pixel_grid()[::_EVERY, ::_EVERY].reshape(-1, 2)
    line = sensor.shutter.line_of_pixel(pixels, camera)
    rays = camera.unproject(pixels)
    seen_line, on_line = [], []
    for z in _DEPTHS:
        uv, _ = sensor.camera.project(se3.transform(se3.inverse(sensor.T_color_sensor), rays * z))
        seen = sensor.camera.contains(uv)
        seen_line.append(sensor.shutter.line_of_pixel(uv[seen], sensor.camera))
        on_line.append(line[seen])
    x, y = np.concatenate(on_line), np.concatenate(seen_line)
    slope = 0.0
    if len(x) and np.ptp(x) > 0.0:
        slope, first = np.polyfit(x, y, 1)
    if slope <= 0.1:
        raise UserError("depth.sensor: does not see what registered depth shows: check intrinsics and T_color_sensor")
    delay = sensor.shutter.line_delay(sensor.camera)
    readout = slope * delay * sensor.shutter.line_count(camera)
    return replace(sensor.shutter, readout_s=float(readout)), float(first * delay)
