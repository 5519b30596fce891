"""One frame of colour or depth of a scene through a `RollingShutterSensor`: one launch for all lines.

Pixels are summed in a fixed order (no atomics), so the same frame is the same to the last bit each time on one backend.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from rsgen.array_types import Float32Array, UInt16Array
from rsgen.device.pose_table import PoseFunction
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.render.baked import BakedIntegrator
from rsgen.render.moving_objects import MovingObjects
from rsgen.render.sensor import RollingShutterSensor

# Samples in one launch; more are rendered in several and averaged, which bounds memory.
_LAUNCH = 1 << 24
# Steps of the R3 low-discrepancy sequence (Roberts 2018) over footprint x, footprint y and exposure time.
_R3 = (0.8191725133961645, 0.6710436067037893, 0.5497004779019703)


class ColorRenderer:
    """Linear colour frames of a scene. Holds the sensor between frames, so that kernels are compiled once."""

    def __init__(self, scene: Any, integrator: Any, camera: Camera, shutter: Shutter, spp: int) -> None:
        """`integrator`: any Mitsuba sampling integrator, e.g. `path` or `rsgen.render.baked.BakedIntegrator`.

        Only the latter shows moving objects, its `objects`.
        """
        self._scene = scene
        self._integrator = integrator
        self._spp = spp
        self._sampler = mi.load_dict({"type": "independent"})
        self.sensor = RollingShutterSensor(camera, shutter)
        self._objects = integrator.objects if isinstance(integrator, BakedIntegrator) else None

    def render(
        self, T_world_cam: PoseFunction, stamp: float, seed: int, exposure_s: float | None = None
    ) -> Float32Array:
        """Linear RGB (h, w, 3) of the frame at `stamp` (s); `seed` decides every random number of it.

        exposure_s: as in `RollingShutterSensor.expose`; the light is averaged over it, not summed.
        """
        self.sensor.expose(T_world_cam, stamp, exposure_s)
        camera = self.sensor.camera
        if self._objects is not None:
            self._objects.expose(camera, self.sensor.shutter, stamp)
        pixels = camera.width * camera.height
        per_launch = max(1, min(self._spp, _LAUNCH // pixels))
        total = np.zeros((pixels, 3), np.float64)
        for first in range(0, self._spp, per_launch):
            count = min(per_launch, self._spp - first)
            total += self._launch(pixels, first, count, seed)
        return (total / self._spp).astype(np.float32).reshape(camera.height, camera.width, 3)

    def _launch(self, pixels: int, first: int, count: int, seed: int) -> Float32Array:
        """Sum (pixels, 3) of samples first..first+count of every pixel."""
        # Mixed on the host: neighbouring seeds must not give neighbouring random streams. All launches of a frame go on
        # with one sequence of positions and times; only the integrator's own random numbers start anew.
        states = (np.random.SeedSequence([seed, k]).generate_state(2) for k in (0, first))
        rotation, sampler_key = (dr.opaque(mi.UInt32, int(state[k])) for k, state in enumerate(states))
        start = dr.opaque(mi.UInt32, first)
        index = dr.arange(mi.UInt32, pixels * count)
        if isinstance(self._integrator, BakedIntegrator):
            u = self._spread(index, count, start, rotation, len(_R3), 2)
            ray = mi.Ray3f(self._rays(index, count, start, rotation))
            radiance, rest = self._integrator.matte(self._scene, ray, mi.Point2f(*u))
            # Evenly spread samples stand for all of them, whatever they show: no bias, but more noise.
            step = max(1, self._spp // self._integrator.glossy_spp)
            rest &= (index % count + start) % step == 0
            stands_for = self._spp / len(range(0, self._spp, step))
            dr.eval(radiance, rest)
            index = dr.compress(rest)
        else:
            radiance = dr.zeros(mi.Color3f, pixels * count)
        if dr.width(index) > 0:
            self._sampler.seed(sampler_key, dr.width(index))
            ray = self._rays(index, count, start, rotation)
            ray.scale_differential(mi.Float(1.0 / np.sqrt(self._spp)))
            if isinstance(self._integrator, BakedIntegrator):
                number = (index % count + start) // step
                scramble = [mi.sample_tea_32(index // count, rotation + len(_R3) + 2 + k, 4)[0] for k in range(4)]
                traced = self._integrator.spread(self._scene, self._sampler, ray, number, scramble)
                traced = dr.gather(mi.Color3f, radiance, index) + stands_for * traced
            else:
                traced, _, _ = self._integrator.sample(self._scene, self._sampler, ray, None, mi.Bool(True))
            dr.scatter(radiance, mi.unpolarized_spectrum(traced), index)
        sums = [dr.block_sum(channel, count) for channel in radiance]
        dr.eval(sums)
        return np.stack([np.asarray(s) for s in sums], axis=1)

    @staticmethod
    def _spread(index: Any, count: int, start: Any, rotation: Any, first: int, dimensions: int) -> list[Any]:
        """Uniform numbers, evenly spread over each pixel's samples; first: the first of their dimensions."""
        pixel = index // count
        sample = mi.Float(index - pixel * count + start)
        return [_fraction(sample * _R3[k] + _hash(pixel, rotation, first + k)) for k in range(dimensions)]

    def _rays(self, index: Any, count: int, start: Any, rotation: Any) -> Any:
        """Camera rays of samples `index` of a launch: `count` neighbours share a pixel."""
        camera = self.sensor.camera
        pixel = index // count
        u, v, w = self._spread(index, count, start, rotation, 0, 3)
        x, y = mi.Float(pixel % camera.width) + u, mi.Float(pixel // camera.width) + v
        position = mi.Point2f(x / camera.width, y / camera.height)
        time = w * self.sensor.shutter.exposure_s
        return self.sensor.sample_ray_differential(time, mi.Float(0), position, mi.Point2f(0.5))[0]


class DepthCast(NamedTuple):
    """z (h, w): planar, m, 0 where a ray hits nothing. ids (h, w): which moving object, 0 none; None: nothing moves.

    labels (h, w): number of the thing, of moving objects after those of the scene; None where not asked for.
    """

    z: Float32Array
    ids: Float32Array | None
    labels: UInt16Array | None


class DepthRenderer:
    """Planar depth frames: one ray through each pixel's centre at its line's mid-exposure."""

    def __init__(
        self, scene: Any, camera: Camera, shutter: Shutter, objects: MovingObjects | None = None,
        instances: Any = None,
    ) -> None:  # fmt: skip
        """instances: `rsgen.truth.instances.Instances` of the scene, where labels are asked for."""
        self._scene, self._instances = scene, instances
        self.sensor = RollingShutterSensor(camera, shutter)
        self._exposure = shutter.exposure_s
        self._objects = objects

    def render(self, T_world_cam: PoseFunction, stamp: float) -> Float32Array:
        """Planar z (h, w) float32, metres, of the frame at `stamp` (s); 0 where the ray hits nothing."""
        return self.cast(T_world_cam, stamp).z

    def cast(self, T_world_cam: PoseFunction, stamp: float) -> DepthCast:
        """What the pixels' rays meet in the frame at `stamp` (s)."""
        self.sensor.expose(T_world_cam, stamp)
        camera = self.sensor.camera
        pixel = dr.arange(mi.UInt32, camera.width * camera.height)
        u, v = mi.Float(pixel % camera.width), mi.Float(pixel // camera.width)
        position = mi.Point2f((u + 0.5) / camera.width, (v + 0.5) / camera.height)
        ray, _ = self.sensor.sample_ray(0.5 * self._exposure, mi.Float(0), position, mi.Point2f(0.5))
        hit = self._scene.ray_intersect_preliminary(ray, coherent=True)
        shape = camera.height, camera.width
        label = mi.UInt32(0) if self._instances is None else self._instances.seen_by(hit)
        if self._objects is None:
            z = dr.select(hit.is_valid(), hit.t * self.sensor.planar_depth_scale(u, v), 0)
            dr.eval(z, label)
            return DepthCast(np.array(z, np.float32).reshape(shape), None, self._labels(label, shape))
        objects = self._objects.expose(camera, self.sensor.shutter, stamp)
        meeting = objects.meet(ray, dr.select(hit.is_valid(), hit.t, dr.inf))
        z = dr.select(dr.isfinite(meeting.t), meeting.t * self.sensor.planar_depth_scale(u, v), 0)
        if self._instances is not None:
            label = dr.select(meeting.number > 0, len(self._instances.names) + meeting.number, label)
        dr.eval(z, meeting.number, label)
        ids = np.array(meeting.number, np.float32).reshape(shape)
        return DepthCast(np.array(z, np.float32).reshape(shape), ids, self._labels(label, shape))

    def _labels(self, label: Any, shape: tuple[int, int]) -> UInt16Array | None:
        return None if self._instances is None else np.array(label).astype(np.uint16).reshape(shape)


def global_shutter(shutter: Shutter) -> Shutter:
    """The same shutter with all lines at once."""
    return replace(shutter, readout_s=0.0)


def _fraction(x: Any) -> Any:
    return x - dr.floor(x)


def _hash(pixel: Any, key: Any, dimension: int) -> Any:
    return mi.sample_tea_float32(pixel, key + dimension, 4)
