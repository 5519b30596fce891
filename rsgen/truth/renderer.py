"""The exact images of one colour frame. One ray through each pixel's centre serves flow, normals, blur, depth, masks.

Importing this module needs an active Mitsuba variant (`rsgen.device.backend.mitsuba()`).

A pixel stands for the surface point p that its centre's ray first meets at its line's mid-exposure, or for a point at
infinity where it meets nothing.

flow: where p is seen in the other image minus the pixel, px. Into the next frame each line has its own time: equation
(3) of Kerl, Stückler, Cremers (ICCV 2015) is solved for every pixel. u and v are 0 where the other image does not hold
p; valid is 1 where it does and p is not hidden there (a ray from that camera reaches p, on the side seen before).

blur_length: ‖x_t − x_{t−t_e}‖ of equation (13), px: x_t is p as seen with the pose at the end of the pixel's own line's
exposure, x_{t−t_e} with that at its begin.

normals: of the triangle at p, in the camera frame of the line's mid-exposure, towards the camera; 0 at infinity.

color_depth: planar z of p, m; 0 at infinity.

object_ids: which of the moving objects p is on, 0 for none; p then moves with it, in all of the above.

labels: which thing of the scene p is on, moving objects counted after those that rest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from rsgen.array_types import Float32Array, FloatArray
from rsgen.config.cameras import ColorConfig
from rsgen.config.sections import GlobalTime, TruthConfig
from rsgen.device.lens import Lens, PoseFunction, PoseTable, contains
from rsgen.device.projection import MovingCamera, rotated_back
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.render.images import ColorRenderer
from rsgen.render.sensor import RollingShutterSensor
from rsgen.scene.moving_objects import MovingObjects, ObjectsInFrame
from rsgen.sensors.color import to_srgb8
from rsgen.sequence.format import LABELS_IMAGE, OBJECT_IDS
from rsgen.truth.instances import Instances

# Rays that ask whether a point is seen end this much short of it, as a fraction of their length: 0.1 mm at 1 m.
_SHORT = 1e-4
_TIMES: tuple[GlobalTime, ...] = ("first", "middle", "last")


class TruthRenderer:
    """Renders what a `TruthConfig` asks for. Holds its sensors between frames, so that kernels are compiled once."""

    def __init__(
        self, scene: Any, integrator: Any, color: ColorConfig, truth: TruthConfig, objects: MovingObjects | None = None,
        instances: Instances | None = None,
    ) -> None:  # fmt: skip
        """`scene` and `integrator` as for `ColorRenderer`; `color` is the stream that the images belong to.

        objects: moving objects, whose masks then are made too. instances: of the scene, for labels.
        """
        self._scene, self._truth, self._instances = scene, truth, instances
        self._camera, self._shutter = color.camera, color.shutter
        self._gain = color.exposure_gain
        sharp = Shutter(self._shutter.readout_s, 0.0, self._shutter.scan)
        self._sharp = ColorRenderer(scene, integrator, self._camera, sharp, truth.spp)
        self._global = ColorRenderer(scene, integrator, self._camera, Shutter(), truth.spp)
        self._sensor = RollingShutterSensor(self._camera, self._shutter)
        self._things = () if objects is None else objects.objects

    def render(
        self, T_world_cam: PoseFunction, stamp: float, next_stamp: float | None, seed: int,
        exposure_s: tuple[float, float] | None = None, brightness: float = 1.0,
    ) -> dict[str, NDArray[Any]]:  # fmt: skip
        """Every image of `TruthConfig.images` of the frame at `stamp` (s): uint8 sRGB (h, w, 3), or float32 (h, w, n).

        With `object_ids` if there are moving objects, and `labels`, uint16 (h, w), where instances are known. n is the
        number of the image's EXR channels; with one channel the image is (h, w). `T_world_cam` takes times (n,) s to
        poses (n, 4, 4) of the colour camera; UserError if it ends before a frame's last line. `next_stamp` is the next
        frame's stamp, None after the last frame: then flow_next is 0 and nowhere valid. `seed` decides the random
        numbers of the frame's twins. exposure_s: of this frame and the next, where they are others than the stream's.
        brightness: factor on the light of the 8-bit images.
        """
        if exposure_s is not None:
            shutters = [replace(self._shutter, exposure_s=each) for each in exposure_s]
        else:
            shutters = [self._shutter, self._shutter]
        shutter, gain = shutters[0], self._gain * brightness
        truth, mid = self._truth, stamp - 0.5 * shutter.exposure_s
        images: dict[str, NDArray[Any]] = {}
        if truth.sharp:
            images["sharp"] = to_srgb8(self._sharp.render(T_world_cam, mid, _seed(seed, 0)), gain)
        for time in truth.global_shutter:
            instant = global_instant(self._camera, shutter, stamp, time)
            linear = self._global.render(T_world_cam, instant, _seed(seed, 1 + _TIMES.index(time)))
            images[f"global_{time}"] = to_srgb8(linear, gain)
        if truth.flow or truth.normals or truth.blur_length or truth.color_depth or self._things or self._instances:
            images |= self._geometry(T_world_cam, stamp, next_stamp, *shutters)
        others = [*([OBJECT_IDS] if self._things else []), *([LABELS_IMAGE] if self._instances else [])]
        return {name: images[name] for name in (*truth.images, *others)}

    def _geometry(
        self, T_world_cam: PoseFunction, stamp: float, next_stamp: float | None, shutter: Shutter, next_shutter: Shutter
    ) -> dict[str, NDArray[Any]]:
        camera, truth = self._camera, self._truth
        reference, now, things, hits = self._cast_frame(T_world_cam, stamp, shutter)
        now = _carrying(now, things, hits)
        images: dict[str, list[Any]] = {}
        if things is not None:
            images[OBJECT_IDS] = [mi.Float(hits.number)]
        if self._instances is not None:
            images[LABELS_IMAGE] = [mi.Float(hits.label)]  # whole numbers of 16 bits, exact
        if truth.color_depth:
            images["color_depth"] = [hits.z]
        if truth.normals:
            images["normals"] = list(hits.n_cam)
        if truth.blur_length:
            ends = (shutter.exposure_s + hits.begin, hits.begin)
            (x_end, ok_end), (x_begin, ok_begin) = (now.project_at(t, hits.p, hits.w) for t in ends)
            length = dr.norm(mi.Point2f(x_end) - mi.Point2f(x_begin))
            images["blur_length"] = [dr.select(ok_end & ok_begin, length, 0)]
        if "global" in truth.flow:
            for time in truth.global_shutter:
                instant = global_instant(camera, shutter, stamp, time)
                things = self._in_frame(Shutter(), instant, reference)
                still = _carrying(_moving(camera, Shutter(), T_world_cam, instant, reference), things, hits)
                uv, defined = still.project_at(mi.Float(0), hits.p, hits.w)
                found = defined & contains(camera, *uv)
                images[f"flow_global_{time}"] = self._flow(hits, uv, found, still, mi.Float(0), reference, things)
        if "next" in truth.flow and next_stamp is not None:
            images["flow_next"] = self._flow_into(T_world_cam, hits, next_stamp, next_shutter, reference)
        dr.eval(images)
        shape = (camera.height, camera.width)
        out = {name: np.stack([np.array(c, np.float32) for c in images[name]], axis=-1) for name in images}
        if "next" in truth.flow and next_stamp is None:
            out["flow_next"] = np.zeros((camera.height * camera.width, 3), np.float32)
        shaped = {name: a.reshape(*shape, *(a.shape[1:] if a.shape[1] > 1 else ())) for name, a in out.items()}
        if LABELS_IMAGE in shaped:
            shaped[LABELS_IMAGE] = shaped[LABELS_IMAGE].astype(np.uint16)
        return shaped

    def flow_into(self, T_world_cam: PoseFunction, stamp: float, other: Shutter, other_stamp: float) -> Float32Array:
        """Flow (h, w, 3), u v valid, from the frame at `stamp` (s) into one that the same camera takes with the shutter
        `other` at other_stamp (s). T_world_cam: as in `render`.
        """
        reference, _, _, hits = self._cast_frame(T_world_cam, stamp, self._shutter)
        flow = self._flow_into(T_world_cam, hits, other_stamp, other, reference)
        dr.eval(flow)
        size = self._camera.height, self._camera.width
        return np.stack([np.array(c, np.float32) for c in flow], axis=-1).reshape(*size, 3)

    def _cast_frame(
        self, T_world_cam: PoseFunction, stamp: float, shutter: Shutter
    ) -> tuple[FloatArray, MovingCamera, ObjectsInFrame | None, _PixelHits]:
        """Of the frame at `stamp` (s): what positions are relative to, its camera, its moving objects, its hits."""
        self._sensor.expose(T_world_cam, stamp, shutter.exposure_s)
        reference = np.asarray(T_world_cam(np.array([stamp])), float).reshape(4, 4)[:3, 3]
        camera = _moving(self._camera, shutter, T_world_cam, stamp, reference)
        things = self._in_frame(shutter, stamp, reference)
        return reference, camera, things, self._cast(camera, shutter, things)

    def _flow_into(
        self, T_world_cam: PoseFunction, hits: _PixelHits, stamp: float, shutter: Shutter, reference: FloatArray
    ) -> list[Any]:
        """u, v, valid of the flow of the points hit into the frame at `stamp`, each of whose lines has its own time."""
        things = self._in_frame(shutter, stamp, reference)
        following = _carrying(_moving(self._camera, shutter, T_world_cam, stamp, reference), things, hits)
        uv, t, found = following.project(following.lens.line_of(*hits.uv), hits.p, hits.w)
        return self._flow(hits, uv, found, following, t, reference, things)

    def _in_frame(self, shutter: Shutter, stamp: float, reference: FloatArray) -> ObjectsInFrame | None:
        if not self._things:
            return None
        return ObjectsInFrame(self._things, self._camera, shutter, stamp, reference)

    def _cast(self, now: MovingCamera, shutter: Shutter, things: ObjectsInFrame | None) -> _PixelHits:
        """What the pixels' centres see at their lines' mid-exposure. The sensor must be exposed to the frame."""
        u, v, ray = self._sensor.central_rays()
        uv = mi.Point2f(u, v)
        hit = self._scene.ray_intersect_preliminary(ray, coherent=True)
        normal = hit.compute_surface_interaction(ray, mi.RayFlags.Minimal).n
        normal = dr.select(hit.is_valid(), dr.select(dr.dot(normal, ray.d) < 0, normal, -normal), 0)
        begin = now.lens.line_of(*uv) * shutter.line_delay(self._camera)
        origin, rows = now.pose(begin + 0.5 * shutter.exposure_s)
        w = dr.select(hit.is_valid(), mi.Float(1), 0)
        p = dr.select(hit.is_valid(), mi.Point3f(origin) + hit.t * ray.d, ray.d)
        z = dr.select(hit.is_valid(), hit.t * self._sensor.planar_depth_scale(uv.x, uv.y), 0)
        label = mi.UInt32(0) if self._instances is None else self._instances.seen_by(hit)
        if things is None:
            return _PixelHits(uv, begin, p, w, normal, rotated_back(rows, normal), z, label=label)
        meeting = things.meet(ray, dr.select(hit.is_valid(), hit.t, dr.inf))
        met, number = meeting.number > 0, meeting.number
        p = dr.select(met, things.place(meeting), p)
        normal = dr.select(met, things.normal(meeting), normal)
        _, n_world = things.carried(number, begin + 0.5 * shutter.exposure_s, p, normal)
        z = dr.select(met, meeting.t * self._sensor.planar_depth_scale(uv.x, uv.y), z)
        dr.eval(p, normal, number, z, w)
        if self._instances is not None:
            label = dr.select(met, len(self._instances.names) + number, label)
        n_cam = rotated_back(rows, n_world)
        return _PixelHits(uv, begin, p, dr.select(met, 1, w), normal, n_cam, z, number, label)

    def _flow(
        self, hits: _PixelHits, uv: tuple[Any, Any], found: Any, other: MovingCamera, t: Any, reference: FloatArray,
        things: ObjectsInFrame | None,
    ) -> list[Any]:  # fmt: skip
        """u, v, valid of the flow to pixels `uv`, where `found`, of another camera at its times t; things: of its."""
        camera = mi.Point3f(other.pose(t)[0])
        p, normal = (hits.p, hits.normal) if things is None else things.carried(hits.number, t, hits.p, hits.normal)
        towards = p - hits.w * camera
        distance = dr.norm(towards)
        at = mi.Point3f(*(dr.opaque(mi.Float, float(x)) for x in reference))
        ray = mi.Ray3f(camera + at, towards / distance)
        ray.maxt = dr.select(hits.w > 0, distance * (1 - _SHORT), dr.inf)
        front = (hits.w == 0) | (dr.dot(normal, towards) < 0)
        valid = found & front
        valid &= ~self._scene.ray_test(ray, coherent=True, active=valid)
        if things is not None:
            ray.time = t - other.lens.shutter.exposure_s
            dr.eval(valid)
            valid &= ~things.hide(ray, valid)
        flow = mi.Point2f(uv) - hits.uv
        keep = dr.isfinite(flow.x) & dr.isfinite(flow.y) & found
        return [dr.select(keep, flow.x, 0), dr.select(keep, flow.y, 0), dr.select(valid, mi.Float(1), 0)]


def _moving(
    camera: Camera, shutter: Shutter, T_world_cam: PoseFunction, stamp: float, reference: FloatArray
) -> MovingCamera:
    """The camera of the frame at `stamp` (s), positions relative to `reference` (3,), world, m."""
    return MovingCamera(
        Lens(camera, shutter), PoseTable.of(mi.Vector4f, camera, shutter, T_world_cam, stamp, reference)
    )


def _carrying(camera: MovingCamera, things: ObjectsInFrame | None, hits: _PixelHits) -> MovingCamera:
    """The camera of a frame over which the points hit move with the objects that they are on."""
    if things is None:
        return camera
    return replace(camera, carry=lambda t, p: tuple(things.carried(hits.number, t, mi.Point3f(p), mi.Normal3f(0))[0]))


@dataclass(frozen=True)
class _PixelHits:
    """Per pixel, on the device: what its ray meets. Positions relative to the reference, m, world axes.

    Those on moving objects, and the normals there, are in the objects' own frames.
    """

    uv: Any  # the pixel itself
    begin: Any  # s from the first line's shutter opening to its own line's
    p: Any  # point, or direction where w = 0
    w: Any
    normal: Any  # world axes, towards the camera, 0 at infinity
    n_cam: Any
    z: Any
    number: Any = 0  # of the object, 0 for none
    label: Any = 0  # number of the thing, of objects after those of the scene; 0 for none


def global_instant(camera: Camera, shutter: Shutter, stamp: float, time: GlobalTime) -> float:
    """The instant (s) of a global-shutter twin: mid-exposure of the first, the last or, between lines, the middle."""
    line = {"first": 0.0, "middle": 0.5, "last": 1.0}[time] * (shutter.line_count(camera) - 1)
    return float(shutter.line_mid_time(stamp, line, camera))


def _seed(seed: int, image: int) -> int:
    # Of its own for each image and apart from the frame's: a twin's noise is independent of the frame's.
    return int(np.random.SeedSequence([seed, 1 + image]).generate_state(1)[0])
