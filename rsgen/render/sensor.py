"""`RollingShutterSensor`: a Mitsuba sensor whose every image line has its own pose.

Importing this module needs an active Mitsuba variant (`rsgen.device.backend.mitsuba()`). In any Mitsuba script:

    from rsgen.device.backend import mitsuba
    mi = mitsuba()
    from rsgen.render.sensor import RollingShutterSensor
    from rsgen.geometry.camera import Camera
    from rsgen.geometry.shutter import Shutter
    from rsgen.geometry.spline import Spline

    sensor = RollingShutterSensor(Camera(640, 480, 481.2, 480.0, 319.5, 239.5), Shutter(readout_s=0.028))
    sensor.expose(Spline.load("spline.npz").pose, stamp=1.0)
    image = mi.render(mi.load_file("scene.xml"), sensor=sensor, spp=16)
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rsgen.device.lens import Lens, PoseFunction, PoseTable, undistort
from rsgen.device.projection import rotated
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter


class RollingShutterSensor(mi.Sensor):
    """Pinhole sensor with distortion whose lines are exposed one after the other (stamp: end of line 0).

    Line i of h is exposed over [stamp + i·t_r/h − t_e, stamp + i·t_r/h]; every sample draws its time within its own
    line's window through Mitsuba's shutter. Lines are rows or columns, in the order of `shutter.scan`. Rays start at
    the pinhole. Use a `box` reconstruction filter (the default here): a wider one mixes lines of different times.
    """

    def __init__(self, camera: Camera, shutter: Shutter, film: mi.Film | None = None) -> None:
        """`camera` in pixels, `shutter` in seconds; `film` (default: hdrfilm, box filter) of the camera's size."""
        properties = mi.Properties()
        properties.set_plugin_name("rolling_shutter")
        properties.set_id("rolling_shutter")
        properties["shutter_open"] = 0.0
        properties["shutter_close"] = shutter.exposure_s
        properties["film"] = film or mi.load_dict(
            {"type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"},
             "pixel_format": "rgb", "component_format": "float32", "sample_border": False}
        )  # fmt: skip
        super().__init__(properties)
        self.camera = camera
        self.shutter = shutter
        self._lens = Lens(camera, shutter)
        self.expose(lambda t: np.broadcast_to(np.eye(4), (*np.shape(t), 4, 4)), 0.0)

    def expose(self, T_world_cam: PoseFunction, stamp: float, exposure_s: float | None = None) -> None:
        """Take the next frame at `stamp` (s) along `T_world_cam`: times (n,) s → (n, 4, 4), e.g. `Spline.pose`.

        exposure_s: t_e from this frame on, where it is another one. Times from
        stamp − t_e to stamp + t_r are asked for; that may raise UserError if the trajectory ends before.
        """
        if exposure_s is not None:
            self.shutter = replace(self.shutter, exposure_s=exposure_s)
        table = PoseTable.of(mi.Vector4f, self.camera, self.shutter, T_world_cam, stamp)
        # Numbers that frames and sequences differ in are data, else kernels would be compiled for each.
        times = self.shutter.exposure_s, self.shutter.line_delay(self.camera), table.step_s
        self.exposure, self._line_delay, step = (dr.opaque(mi.Float, t) for t in times)
        self._poses = replace(table, step_s=step)

    @property
    def state(self) -> list[Any]:
        """All on the device that rays depend on."""
        return [self._poses.rows, self._poses.step_s, self.exposure, self._line_delay]

    def sample_ray(self, time, sample1, sample2, sample3, active=True):
        """Rays through film positions `sample2` in [0, 1]², at `time` in [0, t_e] after their line's shutter opened."""
        ray, weight = self.sample_ray_differential(time, sample1, sample2, sample3, active)
        return mi.Ray3f(ray), weight

    def sample_ray_differential(self, time, sample1, sample2, sample3, active=True):
        """Rays and unit weights; the ray's `time` is seconds after the stamp."""
        camera = self.camera
        u = sample2.x * camera.width - 0.5
        v = sample2.y * camera.height - 0.5
        t = time + self._line(u, v) * self._line_delay
        origin, rotate = self._pose(t)

        wavelengths, weight = self.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), sample1, active)
        ray = dr.zeros(mi.RayDifferential3f)
        ray.o = origin
        ray.d = rotate(dr.normalize(self._direction(u, v)))
        ray.time = t - self.exposure
        ray.maxt = dr.largest(mi.Float)
        ray.wavelengths = wavelengths
        ray.o_x = ray.o_y = ray.o
        ray.d_x = rotate(dr.normalize(self._direction(u + 1, v)))
        ray.d_y = rotate(dr.normalize(self._direction(u, v + 1)))
        ray.has_differentials = True
        return ray, weight

    def central_rays(self):
        """u and v of all pixels, row by row, and the rays through their centres at their lines' mid-exposure."""
        camera = self.camera
        pixel = dr.arange(mi.UInt32, camera.width * camera.height)
        u, v = mi.Float(pixel % camera.width), mi.Float(pixel // camera.width)
        position = mi.Point2f((u + 0.5) / camera.width, (v + 0.5) / camera.height)
        return u, v, self.sample_ray(0.5 * self.exposure, mi.Float(0), position, mi.Point2f(0.5))[0]

    def axes(self, time, sample2):
        """The camera's x, y and z axes in the world at `time` after the lines at film positions `sample2` opened."""
        camera = self.camera
        line = self._line(sample2.x * camera.width - 0.5, sample2.y * camera.height - 0.5)
        _, rotate = self._pose(time + line * self._line_delay)
        return tuple(rotate(mi.Vector3f(*axis)) for axis in np.eye(3).tolist())

    def planar_depth_scale(self, u, v):
        """Planar z per unit of ray length at pixel positions (u, v): the ray direction's z in the camera's frame."""
        return dr.normalize(self._direction(u, v)).z

    def bbox(self):
        """Empty: the sensor takes no room in the scene's bounds."""
        return mi.BoundingBox3f()

    def to_string(self) -> str:
        return f"RollingShutterSensor[{self.camera}, {self.shutter}]"

    def _line(self, u, v):
        """Whole index, in scan order, of the line that holds pixel position (u, v)."""
        camera = self.camera
        column = dr.clip(dr.floor(u + 0.5), 0.0, camera.width - 1.0)
        return self._lens.line_of(column, dr.clip(dr.floor(v + 0.5), 0.0, camera.height - 1.0))

    def _pose(self, t):
        """Origin and rotation at `t` seconds after the first line's shutter opened."""
        rows = self._poses.at(t)
        origin = mi.Point3f(*(row.w for row in rows))
        return origin, lambda d: dr.normalize(mi.Vector3f(*rotated(rows, d)))

    def _direction(self, u, v):
        """Direction (x, y, 1) in the camera's frame of pixel position (u, v), distortion undone."""
        camera = self.camera
        x, y = undistort(camera, (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
        return mi.Vector3f(x, y, 1.0)
