"""One frame of colour or depth of a scene through a `RollingShutterSensor`: one launch for all lines.

Pixels are summed in a fixed order (no atomics), so the same frame is the same to the last bit each time on one backend.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.stats import qmc

from rsgen.array_types import Float32Array, UInt16Array
from rsgen.device.arrays import aligned, recorded
from rsgen.device.lens import PoseFunction
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.render.baked import BakedIntegrator
from rsgen.render.sensor import RollingShutterSensor
from rsgen.scene.moving_objects import MovingObjects

# Samples in one launch; more are rendered in several and averaged, which bounds memory.
_LAUNCH = 1 << 24
# First dimensions of a sample's numbers, two each but for the time of exposure: the place in the pixel's footprint,
# what is matte beneath gloss, the lobe that is looked along, the place on lamps that are mirrored.
_PLACE, _TIME, _MATTE, _LOBE, _LAMPS, _DIMENSIONS = 0, 2, 3, 5, 7, 9


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
        self._samples = PixelSamples(spp, _DIMENSIONS)
        self._replay_direct, self._replay_traced = self._replayed(self._direct), self._replayed(self._traced)

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
        key, sampler_key = (dr.opaque(mi.UInt32, int(state[k])) for k, state in enumerate(states))
        start = dr.opaque(mi.UInt32, first)
        index = dr.arange(mi.UInt32, pixels * count)
        if isinstance(self._integrator, BakedIntegrator):
            *radiance, rest = self._replay_direct(index, start, key, count)
            # The first samples stand for all of them, whatever they show: no bias, but more noise.
            mirrored = min(self._spp, self._integrator.glossy_spp)
            index = dr.compress(rest & (index % count + start < mirrored))
            if dr.width(index) > 0:
                traced = self._replay_traced(index, start, key, sampler_key, count)
                for channel, values in zip(radiance, traced, strict=True):
                    dr.scatter_add(channel, values * (self._spp / mirrored), index, mode=dr.ReduceMode.NoConflicts)
        else:
            self._sampler.seed(sampler_key, pixels * count)
            ray = self._rays(index, start, key, count)
            traced, _, _ = self._integrator.sample(self._scene, self._sampler, ray, None, mi.Bool(True))
            radiance = list(mi.unpolarized_spectrum(traced))
        dr.eval(radiance)
        sums = [dr.block_sum(channel, count) for channel in radiance]
        dr.eval(sums)
        return np.stack([np.asarray(s) for s in sums], axis=1)

    def _replayed(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """`function`, traced once and then replayed: to trace it for each frame takes longer than a small picture."""
        if self._objects is not None:  # their poses are not part of the recording
            return function
        replay = recorded(function, self._state)

        def call(*args: Any) -> Any:
            try:
                return replay(*args)
            except RuntimeError:
                # Meshes, those of other scenes too, build the tables that their light is sampled by at first use, which
                # cannot be recorded: now, then.
                si = dr.zeros(mi.SurfaceInteraction3f, 1)
                dr.eval(self._scene.sample_emitter_direction(si, mi.Point2f(0.5), False))
                return replay(*args)

        return call

    def _state(self, *_: Any) -> list[Any]:
        """All on the device that a frame's colours depend on, beside the arguments."""
        field = self._integrator.state if isinstance(self._integrator, BakedIntegrator) else []
        # A pointer makes Dr.Jit look at all objects of its class, those of other scenes too, as a virtual call does.
        shape = mi.ShapePtr(self._scene.shapes()[0])
        kinds = [shape, shape.bsdf(), *(mi.EmitterPtr(e) for e in self._scene.emitters()[:1]), self._scene]
        return [*kinds, *field, *self.sensor.state, *self._samples.table]

    def _direct(self, index: Any, start: Any, key: Any, count: int) -> list[Any]:
        """Red, green, blue of samples `index` of a launch but for what surfaces mirror, and where they mirror."""
        ray = mi.Ray3f(self._rays(index, start, key, count))
        u = mi.Point2f(*self._numbers(index, start, key, count, _MATTE, 2))
        radiance, rest = self._integrator.matte(self._scene, ray, u)
        dr.eval(radiance, rest)
        return [*radiance, rest]

    def _traced(self, index: Any, start: Any, key: Any, sampler_key: Any, count: int) -> list[Any]:
        """Red, green, blue of what surfaces mirror in samples `index` of a launch."""
        sampler = self._sampler.clone()
        sampler.seed(sampler_key, dr.width(index))
        ray = self._rays(index, start, key, count)
        lobe, lamps = (mi.Point2f(*self._numbers(index, start, key, count, k, 2)) for k in (_LOBE, _LAMPS))
        radiance = self._integrator.mirrored(self._scene, sampler, ray, lobe, lamps)
        dr.eval(radiance)
        return list(radiance)

    def _numbers(self, index: Any, start: Any, key: Any, count: int, first: int, dimensions: int) -> list[Any]:
        """Of samples `index` of a launch, `count` neighbours of which share a pixel."""
        pixel = index // count
        return self._samples.at(index - pixel * count + start, pixel, key, first, dimensions)

    def _rays(self, index: Any, start: Any, key: Any, count: int) -> Any:
        """Camera rays of samples `index` of a launch."""
        camera = self.sensor.camera
        pixel = index // count
        u, v = self._numbers(index, start, key, count, _PLACE, 2)
        x, y = mi.Float(pixel % camera.width) + u, mi.Float(pixel // camera.width) + v
        position = mi.Point2f(x / camera.width, y / camera.height)
        time = self._numbers(index, start, key, count, _TIME, 1)[0] * self.sensor.exposure
        ray = self.sensor.sample_ray_differential(time, mi.Float(0), position, mi.Point2f(0.5))[0]
        ray.scale_differential(mi.Float(1.0 / np.sqrt(self._spp)))
        return ray


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
        self._objects = objects

    def render(self, T_world_cam: PoseFunction, stamp: float) -> Float32Array:
        """Planar z (h, w) float32, metres, of the frame at `stamp` (s); 0 where the ray hits nothing."""
        return self.cast(T_world_cam, stamp).z

    def cast(self, T_world_cam: PoseFunction, stamp: float) -> DepthCast:
        """What the pixels' rays meet in the frame at `stamp` (s)."""
        self.sensor.expose(T_world_cam, stamp)
        camera = self.sensor.camera
        u, v, ray = self.sensor.central_rays()
        hit = self._scene.ray_intersect_preliminary(ray, coherent=True)
        label = mi.UInt32(0) if self._instances is None else self._instances.seen_by(hit)
        t, number = dr.select(hit.is_valid(), hit.t, dr.inf), mi.UInt32(0)
        if self._objects is not None:
            meeting = self._objects.expose(camera, self.sensor.shutter, stamp).meet(ray, t)
            t, number = meeting.t, meeting.number
            if self._instances is not None:
                label = dr.select(number > 0, len(self._instances.names) + number, label)
        z = dr.select(dr.isfinite(t), t * self.sensor.planar_depth_scale(u, v), 0)
        dr.eval(z, number, label)
        shape = camera.height, camera.width
        return DepthCast(
            np.array(z, np.float32).reshape(shape),
            None if self._objects is None else np.array(number, np.float32).reshape(shape),
            None if self._instances is None else np.array(label).astype(np.uint16).reshape(shape),
        )


_BITS = 32
# Multipliers of the hash that scrambles a number's bits from the lowest up: N. Vegdahl's, after Laine and Karras,
# "Stratified Sampling for Stochastic Transparency" (2011); see Burley, "Practical Hash-based Owen Scrambling" (2020).
_MULTIPLIERS = (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6)


class PixelSamples:
    """Samples 0..count-1 of any pixel, in so many dimensions: Sobol's sequence, scrambled for each by Owen's method.

    The first 2^n samples of a pixel are stratified in each dimension, and in the first two together. Where an edge
    crosses the pixel their squared error falls with n^-1.5, that of random ones with n^-1 (Mitchell 1996).
    """

    def __init__(self, count: int, dimensions: int) -> None:
        points = qmc.Sobol(dimensions, scramble=False, bits=_BITS).random_base2(max(0, (count - 1).bit_length()))
        bits = np.ldexp(points, _BITS).astype(np.uint32)
        self.table = [dr.brev(mi.UInt32(aligned(column, np.uint32))) for column in bits.T]
        dr.eval(self.table)

    def at(self, sample: Any, pixel: Any, key: Any, first: int, dimensions: int) -> list[Any]:
        """Uniform numbers (Float) of samples of pixels, both UInt32: `dimensions` from `first` on; key: UInt32."""
        numbers = []
        for k in range(first, first + dimensions):
            bits = dr.gather(mi.UInt32, self.table[k], sample) + mi.sample_tea_32(pixel, key + k, 4)[0]
            for multiplier in _MULTIPLIERS:
                bits ^= bits * multiplier
            numbers.append(mi.Float(dr.brev(bits) >> 8) * 2.0**-24)
        return numbers
