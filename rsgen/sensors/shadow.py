"""Where the light of a structured-light camera's projector does not reach: rays from every pixel's surface point.

Importing this module needs an active Mitsuba variant (`rsgen.device.backend.mitsuba()`).
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rsgen.array_types import BoolArray, Float32Array
from rsgen.device.arrays import aligned
from rsgen.device.pose_table import PoseFunction
from rsgen.render.sensor import RollingShutterSensor
from rsgen.scene.moving_objects import MovingObjects

# Shadow rays end this much short of the surface, as a fraction of their length: 0.1 mm at 1 m. Depth is exact to 1e-6.
_SHORT = 1e-4


class Projector:
    """A pattern projector beside a depth camera, at (baseline, 0, 0) in its frame, moving with it line by line."""

    def __init__(
        self, scene: Any, sensor: RollingShutterSensor, baseline_m: float, width: float = 1.0,
        objects: MovingObjects | None = None,
    ) -> None:  # fmt: skip
        """`sensor`: the depth camera's (`DepthRenderer.sensor`). A positive baseline casts shadows to objects' left.

        width: of the pattern, in widths of the camera's field of view. objects: that move, exposed as the sensor.
        """
        self._scene, self._objects = scene, objects
        self._camera = sensor
        self._emitter = RollingShutterSensor(sensor.camera, sensor.shutter)
        self._T_camera_projector = np.eye(4)
        self._T_camera_projector[0, 3] = baseline_m
        camera = sensor.camera
        edges = np.array([[-0.5, camera.cy], [camera.width - 0.5, camera.cy]])
        self._left, self._right = camera.unproject(edges)[:, 0] * width
        self._x = camera.unproject(camera.pixel_grid())[..., 0].astype(np.float32)

    def lights(self, z: Float32Array, T_world_cam: PoseFunction, stamp: float) -> BoolArray:
        """Whether the pattern reaches the surface at each pixel (h, w) of a depth frame; False where z = 0 (nothing).

        `z` (h, w): its exact planar depth, m. The camera's sensor must still be exposed to that frame, of `stamp` (s)
        along `T_world_cam`; each line's projector is where the camera's motion takes it at that line's mid-exposure.
        The pattern spans the camera's own field of view, or `width` times that, moved by the baseline.
        """
        self._emitter.expose(lambda t: T_world_cam(t) @ self._T_camera_projector, stamp)
        camera = self._camera.camera
        pixel = dr.arange(mi.UInt32, camera.width * camera.height)
        u, v = mi.Float(pixel % camera.width), mi.Float(pixel // camera.width)
        position = mi.Point2f((u + 0.5) / camera.width, (v + 0.5) / camera.height)
        middle = 0.5 * self._camera.shutter.exposure_s
        seen, lit = (
            sensor.sample_ray(middle, mi.Float(0), position, mi.Point2f(0.5))[0]
            for sensor in (self._camera, self._emitter)
        )
        depth = mi.Float(aligned(z))
        to_surface = seen.o + seen.d * (depth / self._camera.planar_depth_scale(u, v)) - lit.o
        distance = dr.norm(to_surface)
        lit.d = to_surface / distance
        lit.maxt = distance * (1 - _SHORT)
        reached = ~self._scene.ray_test(lit, coherent=True, active=depth > 0)
        if self._objects is not None and self._objects.now is not None:
            dr.eval(reached)
            reached &= ~self._objects.now.hide(lit, depth > 0)
        x = self._x - np.float32(self._T_camera_projector[0, 3]) / np.where(z > 0, z, np.float32(np.inf))
        inside = (x >= self._left) & (x <= self._right) & (z > 0)
        return np.array(reached, bool).reshape(camera.height, camera.width) & inside
