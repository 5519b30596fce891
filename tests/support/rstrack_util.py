"""Analytic scenes, images and references for the tests of rstrack's numerical core.

Everything here is float64 NumPy on rsgen.geometry and shares no formula with rstrack's kernels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from util import random_spline, random_twists

from rsgen.device.arrays import engine
from rsgen.device.lens import Lens
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Scan, Shutter
from rsgen.geometry.spline import Spline
from rstrack.alignment.linearise import Terms
from rstrack.images.line_poses import Exposure
from rstrack.images.pyramid import ColorImage, DepthImage, camera_rays, depth_image, pyramid
from rstrack.keyframes.keyframe import Reference, level_points
from rstrack.keyframes.maker import KeyframeMaker

FloatArray = np.ndarray
SCANS: tuple[Scan, ...] = ("top-bottom", "bottom-top", "left-right", "right-left")
T_COLOR_DEPTH = se3.exp(np.array([-0.05, 0.004, 0.002, 0.02, -0.03, 0.04]))
ENGINE = engine("llvm")


def small_camera(model: str = "pinhole", width: int = 64, height: int = 48) -> Camera:
    """Field of view of 67 degrees; the principal point is off centre."""
    f = 0.75 * width
    distortion = {"pinhole": (), "radtan": (-0.12, 0.04, 0.002, -0.003), "fisheye": (0.02, -0.01, 0.003, -0.001)}[model]
    return Camera(width, height, f, 1.02 * f, 0.49 * width, 0.51 * height, model, distortion)  # type: ignore[arg-type]


def hand_held(seed: int) -> Spline:
    """About 0.5 m/s and 1 rad/s over [0.3, 0.9] s."""
    return random_spline(seed, points=15, angle=0.05, distance=0.025)


def exposure(
    stamp: float, scan: Scan | None = "top-bottom", camera: Camera | None = None, T_cam_body: FloatArray | None = None,
    readout_s: float = 0.028,
) -> Exposure:  # fmt: skip
    """An image of a rolling shutter, or of a global one (scan None)."""
    shutter = Shutter(0.0, 0.006) if scan is None else Shutter(readout_s, 0.006, scan)
    return Exposure(Lens(camera or small_camera(), shutter), stamp, np.eye(4) if T_cam_body is None else T_cam_body)


@dataclass(frozen=True)
class Plane:
    """normal · p = offset in the world, seen from the side of the smaller values."""

    normal: FloatArray
    offset: float

    def cast(self, p: FloatArray, d: FloatArray) -> FloatArray:
        """Ray parameters (...,)."""
        return (self.offset - p @ self.normal) / (d @ self.normal)


def plane_before(T_world_cam: FloatArray, normal_cam: tuple[float, float, float], distance: float = 2.0) -> Plane:
    """A plane that the camera's axis meets after `distance` m; normal in the camera's frame, of any length."""
    n = T_world_cam[:3, :3] @ np.array(normal_cam) / np.linalg.norm(normal_cam)
    return Plane(n, float(n @ (T_world_cam[:3, 3] + distance * T_world_cam[:3, 2])))


def pixel_rays(spline: Spline, image: Exposure) -> tuple[FloatArray, FloatArray]:
    """Origins and directions (h, w, 3) of all pixels' rays in the world; planar z is the ray's parameter."""
    camera, shutter = image.lens.camera, image.lens.shutter
    uv = camera.pixel_grid()
    T = spline.pose(shutter.line_mid_time(image.stamp, shutter.line_of_pixel(uv, camera), camera))
    T = T @ se3.inverse(image.T_cam_body)
    return T[..., :3, 3], np.einsum("...ij,...j->...i", T[..., :3, :3], camera.unproject(uv))


Cast = Callable[[FloatArray, FloatArray], FloatArray]


def depth_of(cast: Cast, spline: Spline, image: Exposure, margin: int = 0) -> FloatArray:
    """Planar z (h, w); 0 within `margin` pixels of the border."""
    z = cast(*pixel_rays(spline, image))
    inside = np.zeros(z.shape, bool)
    inside[margin : z.shape[0] - margin, margin : z.shape[1] - margin] = True
    return np.where(inside, z, 0.0)


def texture(p_world: FloatArray) -> FloatArray:
    """A smooth solid texture in [0, 1]; waves are a metre long and longer."""
    waves = np.sin(
        p_world @ np.array([[4.0, 1.0, 0.5], [0.5, 5.0, -1.0], [-1.0, 0.5, 4.0]]) + np.array([0.3, 1.0, 2.0])
    )
    return 0.5 + 0.15 * waves.sum(axis=-1)


def intensity_of(cast: Cast, spline: Spline, image: Exposure) -> FloatArray:
    """The texture as an image shows it (h, w)."""
    p, d = pixel_rays(spline, image)
    return texture(p + d * cast(p, d)[..., None])


def depth_input(cast: Cast, spline: Spline, image: Exposure, margin: int = 0) -> DepthImage:
    """A depth image as the tracker takes it."""
    return depth_image(ENGINE, image, depth_of(cast, spline, image, margin), 100.0)


def color_input(cast: Cast, spline: Spline, image: Exposure) -> ColorImage:
    """A colour image as the tracker takes it, but without rounding to 8 bits."""
    levels = pyramid(intensity_of(cast, spline, image).astype(np.float32))
    return ColorImage(image, tuple(ENGINE.upload(level) for level in levels))


def maker(camera: Camera) -> KeyframeMaker:
    """Keyframes of a depth camera."""
    rays = camera_rays(Exposure(Lens(camera, Shutter()), 0.0, np.eye(4)))
    return KeyframeMaker(ENGINE, rays, (ENGINE.upload(rays[..., 0]), ENGINE.upload(rays[..., 1])))


def make_terms(camera: Camera) -> Terms:
    """Terms without gates and floors, so that costs are smooth."""
    return Terms(
        ENGINE, maker(camera).device_rays, gate_depth=(1.0,) * 3, gate_intensity=1.0, floor_depth=1e-7,
        floor_intensity=1e-7, smooth=1e9,
    )  # fmt: skip


def exact_reference(cast: Cast, spline: Spline, image: Exposure, margin: int = 0) -> Reference:
    """A reference of closed-form depth and intensities, nothing rectified or looked up.

    `image` is the depth camera's; a pinhole's if it is of a global shutter. No depth within `margin` pixels of the
    border.
    """
    depth = depth_input(cast, spline, image, margin)
    camera = image.lens.camera
    ref = maker(camera).rolling(0, depth, (), spline)
    rho = ENGINE.download(depth.inverse_z, (camera.height, camera.width))
    values = intensity_of(cast, spline, image).astype(np.float32)
    points = level_points(ENGINE, rho, camera_rays(image), values)
    return replace(ref, points=points)


def moved(spline: Spline, increments: FloatArray, first: int = 0) -> Spline:
    """The spline with its control points first, first + 1, ... moved on the left by increments (n, 6)."""
    points = spline.control_points.copy()
    last = first + len(increments)
    points[first:last] = se3.exp(increments) @ points[first:last]
    return Spline(points, spline.t0, spline.dt)


def disturbed(spline: Spline, seed: int, size: float = 0.004) -> Spline:
    """The spline with all control points moved by `size` m and rad."""
    return moved(spline, random_twists(np.random.default_rng(seed), (len(spline.control_points),), size, size))
