"""Infrared dots of a projector that is fixed to a camera, as that camera sees them on the scene.

Importing this module needs an active Mitsuba variant (`rsgen.device.backend.mitsuba()`).
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rsgen.array_types import Float32Array
from rsgen.config.rig import DotsConfig
from rsgen.device.pose_table import PoseFunction
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.render.sensor import RollingShutterSensor
from rsgen.sensors.stereo import dot_pattern

# Rays from a surface to the projector end this much short of either, as a fraction of their length.
_SHORT = 1e-4
_SIDE = 3  # rays of a pixel, squared: a dot is about as wide as one


class DotProjector:
    """A pattern of dots, the same in every frame, that moves with the camera line by line."""

    def __init__(self, scene: Any, camera: Camera, shutter: Shutter, config: DotsConfig, seed: int) -> None:
        """seed: of where the dots are."""
        self._scene, self._config = scene, config
        self._sensor = RollingShutterSensor(camera, shutter)
        self._middle = 0.5 * shutter.exposure_s
        half = np.tan(np.deg2rad(config.field_deg) / 2)
        self._pattern = mi.Texture2f(dot_pattern(config, half, seed)[..., None], wrap_mode=dr.WrapMode.Clamp)
        self._half = half

    def light(self, T_world_cam: PoseFunction, stamp: float) -> Float32Array:
        """Light (h, w) that the dots add to the frame at `stamp` (s), 1 = white, as if all were white and matte.

        Of each pixel the mean over a grid of rays, each at its line's mid-exposure.
        """
        T_cam_projector = np.eye(4)
        T_cam_projector[:3, 3] = self._config.position
        camera = self._sensor.camera
        self._sensor.expose(T_world_cam, stamp)
        index = dr.arange(mi.UInt32, camera.width * camera.height * _SIDE**2)
        pixel, part = index // _SIDE**2, index % _SIDE**2
        inside = mi.Vector2f(part % _SIDE + 0.5, part // _SIDE + 0.5) / _SIDE
        at = mi.Vector2f(pixel % camera.width, pixel // camera.width) + inside
        position = mi.Point2f(at.x / camera.width, at.y / camera.height)
        ray, _ = self._sensor.sample_ray(self._middle, mi.Float(0), position, mi.Point2f(0.5))
        hit = self._scene.ray_intersect_preliminary(ray, coherent=True)
        t, normal = hit.t, hit.compute_surface_interaction(ray, mi.RayFlags.Minimal).n
        across, down, forward = self._sensor.axes(self._middle, position)
        from_camera = t * ray.d
        x, y, z = mi.Vector3f(dr.dot(from_camera, across), dr.dot(from_camera, down), dr.dot(from_camera, forward))
        px, py, pz = (dr.opaque(mi.Float, float(value)) for value in self._config.position)
        to_surface = mi.Vector3f(x - px, y - py, z - pz)
        valid = hit.is_valid() & (to_surface.z > 0)
        u, v = (0.5 + 0.5 * s / (to_surface.z * float(h))
                for s, h in zip((to_surface.x, to_surface.y), self._half, strict=True))  # fmt: skip
        valid &= (u > 0) & (u < 1) & (v > 0) & (v < 1)
        distance = dr.norm(to_surface)
        origin = ray.o + across * px + down * py + forward * pz
        there = ray.o + from_camera - origin
        shadow = mi.Ray3f(origin, there / distance)
        shadow.maxt, shadow.time = distance * (1 - _SHORT), ray.time
        valid &= ~self._scene.ray_test(shadow, coherent=True, active=valid)
        cosine = dr.abs(dr.dot(normal, shadow.d))
        brightness = self._pattern.eval(mi.Point2f(u, v))[0] * cosine / dr.square(distance)
        light = dr.block_sum(dr.select(valid, brightness, 0), _SIDE**2)
        shape = camera.height, camera.width
        return np.asarray(light, np.float32).reshape(shape) * np.float32(self._config.power / _SIDE**2)
