"""Rigid objects with motions of their own, met by rays of a rolling shutter at each ray's own time, lit and shading.

A ray meets an object at T_world_object(t) where, in the object's own frame, the ray moved by the inverse meets its
mesh: so each keeps one Mitsuba scene, built once, and a table of poses on the device for the rays' times.

Light is approximate. An object's matte surface is lit by what arrives at its middle, as a function of the direction it
faces: irradiance of spherical harmonics up to the second order (Ramamoorthi and Hanrahan, SIGGRAPH 2001), gathered
along its path. Around it, surfaces lose the share of their sky that an ellipsoid in its place covers, as if light came
evenly from everywhere: the exact form factor of a ball (Quilez, "sphere ambient occlusion", 2014), in coordinates in
which the ellipsoid is one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rsgen.array_types import FloatArray
from rsgen.device.arrays import aligned
from rsgen.device.lens import PoseTable
from rsgen.device.projection import rotated, rotated_back
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.spline import Spline
from rsgen.scene.object_meshes import ObjectMesh

Rows = list[Any]  # of [R t]

HARMONICS = 9
_BANDS = np.repeat([np.pi, 2 * np.pi / 3, np.pi / 4], [1, 3, 5])
# 0.5 sqrt(1/pi), sqrt(3/4pi), 0.5 sqrt(15/pi), 0.25 sqrt(5/pi), 0.25 sqrt(15/pi)
_K = 0.5 * np.sqrt(np.array([1, 3, 15, 5, 15]) / np.pi) * np.array([1, 1, 1, 0.5, 0.5])


def harmonics(d: Any) -> list[Any]:
    """The nine real spherical harmonics up to order two of a unit direction with x, y and z: floats, or arrays."""
    x, y, z = d
    k0, k1, k2, k3, k4 = (float(k) for k in _K)
    first = [k0 + 0 * x, k1 * y, k1 * z, k1 * x]
    return [*first, k2 * x * y, k2 * y * z, k3 * (3 * z * z - 1), k2 * x * z, k4 * (x * x - y * y)]


def irradiance_coefficients(radiance: FloatArray) -> FloatArray:
    """Coefficients (..., 9, 3) of irradiance by the normal from those of radiance by the direction."""
    return radiance * _BANDS[:, None]


def covered(distance: tuple[Any, Any, Any], normal: tuple[Any, Any, Any]) -> Any:
    """Share of the cosine-weighted hemisphere about `normal` (unit) that a unit ball covers.

    distance: from the surface point to the ball's middle, in its radii. Points inside the ball count as just outside.
    """
    squared = distance[0] ** 2 + distance[1] ** 2 + distance[2] ** 2
    h2 = dr.maximum(squared, 1.0001)
    cosine = dr.clip(sum(a * b for a, b in zip(distance, normal, strict=True)) * dr.rsqrt(dr.maximum(squared, 1e-12)),
                     -0.9999, 0.9999)  # fmt: skip
    above = dr.maximum(cosine, 0.0) / h2
    cut = 1.0 - h2 * cosine * cosine  # above 0 where the surface's own plane cuts the ball
    root, out = dr.sqrt(dr.maximum(cut, 1e-9)), dr.sqrt(h2 - 1.0)
    edge = dr.clip(-cosine * out * dr.rsqrt(1.0 - cosine * cosine), -1.0, 1.0)
    across = (cosine * dr.acos(edge) - root * out) / h2 + dr.atan(root / out)
    return dr.clip(dr.select(cut > 1e-3, across * dr.inv_pi, above), 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class ObjectLight:
    """Irradiance by direction along a path: coefficients (n, 9, 3) at n times, `begin` s on, `step` s apart."""

    coefficients: FloatArray
    begin: float
    step: float

    def at(self, t: float) -> FloatArray:
        """(9, 3) at t s, linear between the times and constant beyond them."""
        x = float(np.clip((t - self.begin) / self.step, 0, len(self.coefficients) - 1))
        k = min(int(x), max(len(self.coefficients) - 2, 0))
        low, high = self.coefficients[k], self.coefficients[min(k + 1, len(self.coefficients) - 1)]
        return np.asarray(low + (x - k) * (high - low))


@dataclass(frozen=True, eq=False)
class MovingObject:
    """An object: its mesh, T_world_object(t), and what lights it; None where it is only met, not seen."""

    mesh: ObjectMesh
    spline: Spline
    light: ObjectLight | None = None


@dataclass(frozen=True)
class Meeting:
    """What rays meet first among objects: which (UInt32; 0 none, k + 1 the k-th), at what distance, and each one's hit.

    t: of the rays' own length, no more than what was given. hits: each with the ray in its frame, and its pose.
    """

    number: Any
    t: Any
    hits: tuple[tuple[Any, Any, Rows], ...]


class ObjectsInFrame:
    """All objects over one frame of one camera. No dataclass, which Dr.Jit's loops would take apart as their state."""

    def __init__(
        self, objects: Sequence[MovingObject], camera: Camera, shutter: Shutter, stamp: float,
        reference: FloatArray | None = None,
    ) -> None:  # fmt: skip
        """Of the frame at `stamp` (s). reference (3,): what `carried` counts positions from; default: the origin.

        Raises UserError if an object's spline does not cover the frame.
        """
        self._objects, self._exposure_s = objects, shutter.exposure_s
        self._span = shutter.exposure_s + shutter.readout_s
        of, own = PoseTable.of, [o.spline.pose for o in objects]
        self._poses = [of(mi.Vector4f, camera, shutter, pose, stamp) for pose in own]
        # One table of all, for points that know their object: first of what stays, then of each object.
        still = np.tile(np.eye(4), (1, 1, 1))
        still[:, :3, 3] = 0.0 if reference is None else reference
        self._carried = of(mi.Vector4f, camera, shutter, lambda t: still, stamp, reference).followed_by(
            *(of(mi.Vector4f, camera, shutter, pose, stamp, reference) for pose in own)
        )
        self._light = [self._light_of(o, stamp) for o in objects]

    def _light_of(self, thing: MovingObject, stamp: float) -> Any:
        if thing.light is None:
            return None
        ends = [thing.light.at(stamp - self._exposure_s), thing.light.at(stamp - self._exposure_s + self._span)]
        table = mi.Float(aligned(np.stack(ends)))
        dr.make_opaque(table)
        return table

    def meet(self, ray: Any, t_static: Any) -> Meeting:
        """What rays meet within `t_static`; their `time` is seconds after the stamp, as the sensor makes it."""
        t, number = mi.Float(t_static), mi.UInt32(0)
        hits = []
        for k, (thing, poses) in enumerate(zip(self._objects, self._poses, strict=True)):
            rows = poses.at(ray.time + self._exposure_s)
            own, near = _own_ray(thing, rows, ray, t)
            _settle(own, near)
            hit = thing.mesh.scene.ray_intersect_preliminary(own, coherent=True, active=near)
            _settle(hit)
            nearer = near & hit.is_valid() & (hit.t < t)
            t = dr.select(nearer, hit.t, t)
            number = dr.select(nearer, k + 1, number)
            hits.append((hit, own, rows))
        return Meeting(number, t, tuple(hits))

    def hide(self, ray: Any, active: Any) -> Any:
        """Whether an object stands in the way of rays, which end at their `maxt`."""
        hidden = mi.Bool(False)
        for thing, poses in zip(self._objects, self._poses, strict=True):
            own, near = _own_ray(thing, poses.at(ray.time + self._exposure_s), ray, ray.maxt)
            own.maxt = ray.maxt
            near &= active
            _settle(own, near, hidden)
            hidden |= near & thing.mesh.scene.ray_test(own, coherent=True, active=near)
            _settle(hidden)
        return hidden

    def shaded(self, ray: Any, meeting: Meeting) -> Any:
        """Radiance (Color3f) back along rays, of what they meet; matte, and 0 where that is nothing."""
        total = mi.Color3f(0)
        share = dr.clip((ray.time + self._exposure_s) / self._span, 0, 1) if self._span > 0 else mi.Float(0)
        for k, (hit, own, rows) in enumerate(meeting.hits):
            table = self._light[k]
            if table is None:
                continue
            here = meeting.number == k + 1
            si = hit.compute_surface_interaction(own, mi.RayFlags.All, here)
            n = si.sh_frame.n
            n = dr.select(dr.dot(n, own.d) < 0, n, -n)
            basis = harmonics(rotated(rows, n))
            ends = [
                [sum(b * dr.gather(mi.Float, table, mi.UInt32(e * HARMONICS * 3 + 3 * j + c))
                     for j, b in enumerate(basis)) for c in range(3)]
                for e in range(2)
            ]  # fmt: skip
            light = mi.Color3f(*(dr.maximum(dr.lerp(a, b, share), 0) for a, b in zip(*ends, strict=True)))
            albedo = dr.minimum(si.bsdf(own).eval_diffuse_reflectance(si, here), 1)  # a blend's may be more
            total += dr.select(here, albedo * light * dr.inv_pi, 0)
        return total

    def normal(self, meeting: Meeting) -> Any:
        """Unit normals (Normal3f) of the triangles that rays meet, in the objects' own frames, towards the rays."""
        normal = mi.Normal3f(0)
        for k, (hit, own, _) in enumerate(meeting.hits):
            here = meeting.number == k + 1
            n = hit.compute_surface_interaction(own, mi.RayFlags.Minimal, here).n
            normal = dr.select(here, dr.select(dr.dot(n, own.d) < 0, n, -n), normal)
        return normal

    def place(self, meeting: Meeting) -> Any:
        """Points (Point3f) that rays meet, in the objects' own frames; 0 where that is nothing."""
        place = mi.Point3f(0)
        for k, (_, own, _) in enumerate(meeting.hits):
            place = dr.select(meeting.number == k + 1, own(meeting.t), place)
        return place

    def carried(self, number: Any, t: Any, p: Any, normal: Any) -> tuple[Any, Any]:
        """Points and normals at t seconds after the first line's shutter opened, from the reference, world axes.

        Given in the frame of the object `number` - 1; where number is 0 they stay what they are.
        """
        rows = self._carried.at(t, beyond=True, number=number)
        moved = mi.Point3f(*(a + row.w for a, row in zip(rotated(rows, p), rows, strict=True)))
        return moved, mi.Normal3f(*rotated(rows, normal))

    def openness(self, p_world: Any, n_world: Any, time: Any) -> Any:
        """Share of its light that a surface point keeps, `time` seconds after the stamp; n_world: the lit side's."""
        open_ = mi.Float(1)
        for thing, poses in zip(self._objects, self._poses, strict=True):
            rows = poses.at(time + self._exposure_s)
            p, n = rotated_back(rows, p_world - _origin(rows)), rotated_back(rows, n_world)
            middle, axes = thing.mesh.middle.tolist(), thing.mesh.axes.tolist()
            away = [(m - x) / a for m, x, a in zip(middle, p, axes, strict=True)]
            scaled = dr.normalize(mi.Vector3f(*(x * a for x, a in zip(n, axes, strict=True))))
            open_ *= 1 - covered(tuple(away), tuple(scaled))
        return open_


class MovingObjects:
    """The objects of a sequence; what renders them points them at each frame, as `RollingShutterSensor` is."""

    def __init__(self, objects: Sequence[MovingObject]) -> None:
        self.objects = tuple(objects)
        self.now: ObjectsInFrame | None = None

    def expose(self, camera: Camera, shutter: Shutter, stamp: float) -> ObjectsInFrame:
        """Make the frame at `stamp` (s) the present one. Raises UserError if a spline does not cover it."""
        self.now = ObjectsInFrame(self.objects, camera, shutter, stamp)
        return self.now


class ShadedField:
    """A scene's irradiance without what the objects around take of it; stands in for `IrradianceField`."""

    def __init__(self, field: Any, objects: MovingObjects) -> None:
        self._field, self._objects = field, objects

    def lookup(self, pi: Any, si: Any, wi_world: Any, active: Any = True) -> Any:
        """As `IrradianceField.lookup`; hits carry their rays' times."""
        assert self._objects.now is not None
        n = dr.select(dr.dot(si.n, wi_world) < 0, -si.n, si.n)
        return self._field.lookup(pi, si, wi_world, active) * self._objects.now.openness(si.p, n, si.time)


def _own_ray(thing: MovingObject, rows: Rows, ray: Any, most: Any) -> tuple[Any, Any]:
    """Rays in the object's own frame, and whether they come near it within `most`."""
    o = mi.Point3f(*rotated_back(rows, ray.o - _origin(rows)))
    d = mi.Vector3f(*rotated_back(rows, ray.d))
    to_middle = mi.Point3f(*thing.mesh.middle.tolist()) - o
    along = dr.dot(to_middle, d)
    radius = thing.mesh.radius * (1 + 1e-4)
    near = dr.squared_norm(to_middle - along * d) < radius * radius
    near &= (along > -radius) & (along - radius < most)
    return mi.Ray3f(o, d), near


def _origin(rows: Rows) -> Any:
    return mi.Point3f(*(row.w for row in rows))


def _settle(*values: Any) -> None:
    """On CUDA, a kernel traces rays in one scene only: what comes before the next scene is computed first."""
    if dr.backend_v(mi.Float) == dr.JitBackend.CUDA:
        dr.eval(*values)
