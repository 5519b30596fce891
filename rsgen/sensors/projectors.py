"""Projectors fixed to cameras: where a structured-light camera's light does not reach, and the dots of an infrared one.

Importing this module needs an active Mitsuba variant (`rsgen.device.backend.mitsuba()`).
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rsgen.array_types import BoolArray, Float32Array, FloatArray
from rsgen.config.rig import DotsConfig
from rsgen.device.arrays import aligned
from rsgen.device.lens import PoseFunction
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.render.sensor import RollingShutterSensor
from rsgen.scene.moving_objects import MovingObjects

# Rays between surface and projector end this much short, as a fraction of their length: 0.1 mm at 1 m. Depth is exact
# to 1e-6.
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
        camera = sensor.camera
        self._emitter = RollingShutterSensor(camera, sensor.shutter)
        self._T_camera_projector = np.eye(4)
        self._T_camera_projector[0, 3] = baseline_m
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
        u, v, seen = self._camera.central_rays()
        lit = self._emitter.central_rays()[2]
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
        return np.array(reached, bool).reshape(z.shape) & inside


_SIDE = 3  # rays of a pixel, squared: a dot is about as wide as one
_TEXELS = 4  # of the pattern across a dot
_PATTERN = 0x646F7473  # "dots"


class DotProjector:
    """A pattern of infrared dots, the same in every frame, that moves with the camera line by line."""

    def __init__(self, scene: Any, camera: Camera, shutter: Shutter, config: DotsConfig, seed: int) -> None:
        """seed: of where the dots are."""
        self._scene, self._config = scene, config
        self._sensor = RollingShutterSensor(camera, shutter)
        self._middle = 0.5 * shutter.exposure_s
        self._half = np.tan(np.deg2rad(config.field_deg) / 2)
        self._pattern = mi.Texture2f(dot_pattern(config, self._half, seed)[..., None], wrap_mode=dr.WrapMode.Clamp)

    def light(self, T_world_cam: PoseFunction, stamp: float) -> Float32Array:
        """Light (h, w) that the dots add to the frame at `stamp` (s), 1 = white, as if all were white and matte.

        Of each pixel the mean over a grid of rays, each at its line's mid-exposure.
        """
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


def dot_pattern(config: DotsConfig, half: FloatArray, seed: int) -> Float32Array:
    """The pattern (rows, columns) on the plane at 1 m, from -half to half (2,) in x and y, m; 1 in a dot's middle.

    One dot at a random place in each of `count` cells of a grid, so that none of the field is bare.
    """
    width = np.deg2rad(config.dot_deg)
    columns, rows = (max(8, int(np.ceil(2 * h * _TEXELS / width))) for h in half)
    across = max(1, round(np.sqrt(config.count * columns / rows)))
    down = max(1, round(config.count / across))
    place = np.random.default_rng([_PATTERN, seed]).random((down, across, 2))
    x = ((np.arange(across) + place[..., 0]) / across * columns).ravel()
    y = ((np.arange(down)[:, None] + place[..., 1]) / down * rows).ravel()
    sigma = _TEXELS / np.sqrt(8 * np.log(2))
    reach = np.arange(-2 * _TEXELS, 2 * _TEXELS + 1)
    column, row = np.floor(x)[:, None, None] + reach, np.floor(y)[:, None, None] + reach[:, None]
    squared = (column + 0.5 - x[:, None, None]) ** 2 + (row + 0.5 - y[:, None, None]) ** 2
    column, row = np.broadcast_arrays(column, row)
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    pattern = np.zeros((rows, columns), np.float32)
    places = row[inside].astype(np.int64), column[inside].astype(np.int64)
    np.maximum.at(pattern, places, np.exp(-squared[inside] / (2 * sigma**2)).astype(np.float32))
    return pattern
