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

Poses reach the device as a table of T_world_cam on a uniform time grid over the frame's whole exposure, evaluated in
float64 by the one NumPy spline and blended linearly per ray. Its step is the frame's whole span over four times the
number of lines, so that the blend's error is far below a micrometre, and rolling shutter and blur together cost what a
still costs.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter

PoseFunction = Callable[[Any], NDArray[np.float64]]

# Newton steps for inverting the distortion on the device: quadratic convergence reaches float32's end in fewer.
_UNDISTORT_STEPS = 8


class RollingShutterSensor(mi.Sensor):
    """Pinhole sensor with distortion whose lines are exposed one after the other (DESIGN: stamp = end of line 0).

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
        self._table = mi.Float(0)
        self._steps = 1
        self._step_s = 1.0
        self.expose(lambda t: np.broadcast_to(np.eye(4), (*np.shape(t), 4, 4)), 0.0)

    def expose(self, T_world_cam: PoseFunction, stamp: float) -> None:
        """Take the next frame at `stamp` (s) along `T_world_cam`: times (n,) s → (n, 4, 4), e.g. `Spline.pose`.

        Times from stamp − t_e to stamp + t_r are asked for; that may raise UserError if the trajectory ends before.
        """
        exposure, readout = self.shutter.exposure_s, self.shutter.readout_s
        span = exposure + readout
        lines = self.shutter.line_count(self.camera)
        self._steps = 4 * lines
        self._step_s = span / self._steps if span > 0 else 1.0
        grid = stamp - exposure + self._step_s * np.arange(self._steps + 1, dtype=np.float64) * (span > 0)
        T = T_world_cam(grid if span > 0 else grid[:1])
        T = np.broadcast_to(np.asarray(T, np.float64), (len(grid), 4, 4))
        self._table = mi.Float(np.ascontiguousarray(T[:, :3, :], dtype=np.float32).ravel())
        dr.make_opaque(self._table)

    def sample_ray(self, time, sample1, sample2, sample3, active=True):
        """Rays through film positions `sample2` in [0, 1]², at `time` in [0, t_e] after their line's shutter opened."""
        ray, weight = self.sample_ray_differential(time, sample1, sample2, sample3, active)
        return mi.Ray3f(ray), weight

    def sample_ray_differential(self, time, sample1, sample2, sample3, active=True):
        """Rays and unit weights; the ray's `time` is seconds after the stamp."""
        camera, shutter = self.camera, self.shutter
        u = sample2.x * camera.width - 0.5
        v = sample2.y * camera.height - 0.5
        t = time + self._line(u, v) * shutter.line_delay(camera)
        origin, rotate = self._pose(t)

        wavelengths, weight = self.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), sample1, active)
        ray = dr.zeros(mi.RayDifferential3f)
        ray.o = origin
        ray.d = rotate(dr.normalize(self._direction(u, v)))
        ray.time = t - shutter.exposure_s
        ray.maxt = dr.largest(mi.Float)
        ray.wavelengths = wavelengths
        ray.o_x = ray.o_y = ray.o
        ray.d_x = rotate(dr.normalize(self._direction(u + 1, v)))
        ray.d_y = rotate(dr.normalize(self._direction(u, v + 1)))
        ray.has_differentials = True
        return ray, weight

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
        position = v if self.shutter.scan in ("top-bottom", "bottom-top") else u
        last = float(self.shutter.line_count(self.camera) - 1)
        line = dr.clip(dr.floor(position + 0.5), 0.0, last)
        return line if self.shutter.scan in ("top-bottom", "left-right") else last - line

    def _pose(self, t):
        """Origin and rotation at `t` seconds after the first line's shutter opened, blended from the table."""
        x = dr.clip(t / self._step_s, 0.0, float(self._steps))
        index = dr.minimum(mi.UInt32(x), self._steps - 1)
        fraction = x - mi.Float(index)
        low, high = (_rows(self._table, i) for i in (index, index + 1))
        rows = [dr.fma(fraction, b - a, a) for a, b in zip(low, high, strict=True)]
        origin = mi.Point3f(*(row.w for row in rows))
        return origin, lambda d: dr.normalize(mi.Vector3f(*(row.x * d.x + row.y * d.y + row.z * d.z for row in rows)))

    def _direction(self, u, v):
        """Direction (x, y, 1) in the camera's frame of pixel position (u, v), distortion undone."""
        camera = self.camera
        x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
        if camera.model == "radtan" and any(camera.distortion):
            x, y = _undistort_radtan(x, y, *(*camera.distortion, 0.0)[:5])
        elif camera.model == "fisheye":
            x, y = _undistort_fisheye(x, y, *camera.distortion)
        return mi.Vector3f(x, y, 1.0)


def _rows(table, index):
    """The three rows (R t) of entry `index` of the pose table."""
    return [dr.gather(mi.Vector4f, table, index * 3 + k) for k in range(3)]


def _undistort_radtan(xd, yd, k1, k2, p1, p2, k3):
    """Invert OpenCV's radial-tangential model by Newton steps; device twin of `Camera.unproject`."""
    x, y = mi.Float(xd), mi.Float(yd)
    for _ in range(_UNDISTORT_STEPS):
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))  # d radial / d r² · 2
        ex = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) - xd
        ey = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y - yd
        a = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
        b = x * y * slope + 2 * p1 * x + 2 * p2 * y
        d = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
        inverse = dr.rcp(a * d - b * b)
        x, y = x - (d * ex - b * ey) * inverse, y - (a * ey - b * ex) * inverse
    return x, y


def _undistort_fisheye(xd, yd, k1, k2, k3, k4):
    """Invert Kannala-Brandt: θ_d = θ(1 + k1 θ² + …) by Newton steps, then x = tan θ; twin of `Camera.unproject`."""
    theta_d = dr.sqrt(xd * xd + yd * yd)
    theta = mi.Float(theta_d)
    for _ in range(_UNDISTORT_STEPS):
        t2 = theta * theta
        value = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) - theta_d
        slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
        theta = theta - value / slope
    scale = dr.select(theta_d > 1e-6, dr.tan(theta) / dr.maximum(theta_d, 1e-6), 1.0)
    return xd * scale, yd * scale
