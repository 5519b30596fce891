"""What the tracker is fed: the cameras (`Rig`), how far they may be wrong, and one `Frame` for each depth image."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from rsgen.array_types import Float32Array, FloatArray
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.limits import rigid
from rstrack.data.depth_pattern import pattern_image

_ROTATION_TOLERANCE = 1e-3  # what printing a matrix to three or four digits loses
LENS = "focal", "aspect", "cx", "cy", "k1", "p1", "p2"
CALIBRATION_NAMES = (
    *(f"depth.{name}" for name in LENS), *(f"color.{name}" for name in LENS),
    *(f"T_color_depth.{axis}" for axis in ("x", "y", "z", "rx", "ry", "rz")),
    "depth.readout_s", "color.readout_s", "color.offset_s", "depth.scale", "depth.inverse_offset",
)  # fmt: skip
"""The parameters, in the order of vectors.

Lenses: focal lengths as a part of themselves, aspect as a part of fy alone, cx and cy in focal lengths, k1, p1 and p2
as OpenCV counts them. T_color_depth ← exp(ε) T_color_depth. Depth's scale as a part, its inverse offset in 1/m
(`DepthError`).
"""


@dataclass(frozen=True)
class CalibrationSigma:
    """Standard deviations of what a camera file states, of both cameras alike; 0: exact.

    focal: part of the focal lengths; aspect: part of fy beyond that; center: principal point, in focal lengths; k1:
    radial distortion; p: tangential distortion, p1 and p2 alike; rotation_deg, translation_m: of T_color_depth, an
    axis; readout_s; offset_s: colour's clock; depth_scale: part; depth_inverse_offset: 1/m. depth_image: 1/m, what
    inverse depth of each image is off by as a whole, by an offset and by two tilts: no parameter, but solved for with
    every pose.
    """

    focal: float = 0.0
    aspect: float = 0.0
    center: float = 0.0
    k1: float = 0.0
    p: float = 0.0
    rotation_deg: float = 0.0
    translation_m: float = 0.0
    readout_s: float = 0.0
    offset_s: float = 0.0
    depth_scale: float = 0.0
    depth_inverse_offset: float = 0.0
    depth_image: float = 0.0

    def vector(self, is_registered: bool = False) -> FloatArray:
        """In the order of CALIBRATION_NAMES (25,). is_registered: both streams are seen through the colour camera."""
        lens = np.array([self.focal, self.aspect, self.center, self.center, self.k1, self.p, self.p])
        pose = np.array([self.translation_m, math.radians(self.rotation_deg)]).repeat(3)
        own = 0.0 if is_registered else 1.0
        times = self.readout_s, self.readout_s, self.offset_s
        return np.concatenate([own * lens, lens, own * pose, times, [self.depth_scale, self.depth_inverse_offset]])

    @property
    def is_exact(self) -> bool:
        """Whether nothing may be wrong."""
        return not any(getattr(self, field.name) for field in fields(self))


EXACT_SIGMA = CalibrationSigma()
"""Of renderings, but for depth cameras with fixed errors."""

DEFAULT_SIGMA = CalibrationSigma(0.01, 0.003, 0.01, 0.02, 0.001, 0.3, 0.005, 0.003, 0.003, 0.01, 0.005, 0.001)
"""Of a camera file that states none: a judgement of what such files have wrong, not a measurement."""

UNFOUND_OFFSET_S = 0.015
"""σ of colour's clock where it is looked for and not found: half a frame at 30 Hz, as cameras run that nothing ties."""

UNDISTORTED = {"k1": 0.1, "p": 0.003}
"""σ where a real lens is stated to have no distortion, as it hardly ever is."""


UNSTATED_POSE = {"translation_m": 0.025, "rotation_deg": 1.0}
"""σ of T_color_depth where it is left out, though the cameras are two: they stand 15 to 60 mm apart in one housing."""


def sigma_of_file(
    camera: Camera, stated: Mapping[str, float] | None = None, has_pose: bool = True
) -> CalibrationSigma:  # fmt: skip
    """How far a camera file may be wrong that states these σ, by the names that it has for them.

    camera: colour's. has_pose: whether the file states T_color_depth.
    """
    found = dict(stated or {})
    if "center_px" in found:
        found["center"] = found.pop("center_px") / camera.fx
    unstated = {} if any(camera.distortion) else UNDISTORTED
    return replace(DEFAULT_SIGMA, **(unstated | ({} if has_pose else UNSTATED_POSE) | found))


@dataclass(frozen=True)
class DepthError:
    """True depth is 1 / (1 / z + pattern(x, y) + inverse_offset + radial r²) + offset_m.

    z: as measured, m; r: of the pixel's ray, in normalised coordinates. inverse_offset and radial in 1/m: an error of
    the disparity of structured light, whose effect grows with z² (Teichman et al., RSS 2013); offset_m: of time of
    flight. pattern (27,): coefficients, 1/m, see `rstrack.data.depth_pattern`; (): none; None: not known.
    """

    offset_m: float = 0.0
    inverse_offset: float = 0.0
    radial: float = 0.0
    pattern: tuple[float, ...] | None = None

    @property
    def is_none(self) -> bool:
        """Whether depth is taken as it was measured."""
        return not any((self.offset_m, self.inverse_offset, self.radial, self.pattern))

    def corrected(self, z: Float32Array, camera: Camera) -> Float32Array:
        """True planar z (h, w) in m of what the camera measured; 0, and what would lie beyond infinity, is 0."""
        if self.is_none:
            return z
        bent = np.float32(self.inverse_offset) + np.float32(self.radial) * _squared_radius(camera)
        if self.pattern:
            bent = bent + pattern_image(self.pattern, camera.width, camera.height)
        inverse = np.divide(np.float32(1), z, out=np.zeros_like(z), where=z > 0) + bent
        found = (z > 0) & (inverse > 0)
        true = np.divide(np.float32(1), inverse, out=np.zeros_like(z), where=found) + np.float32(self.offset_m)
        return np.where(found & (true > 0), true, np.float32(0))


NO_DEPTH_ERROR = DepthError()


@lru_cache(maxsize=4)
def _squared_radius(camera: Camera) -> Float32Array:
    rays = camera.unproject(camera.pixel_grid())
    return np.nan_to_num((rays[..., :2] ** 2).sum(axis=-1)).astype(np.float32)


@dataclass(frozen=True)
class Rig:
    """The cameras: everything the tracker must know beside the images.

    T_color_depth (4, 4): p_color from p_depth. color_falloff: f, where colour's intensities are those of an even image
    over 1 + f ρ² at ρ of the way from the centre to a corner; None: not known. sigma: how far this may be wrong.
    """

    depth_camera: Camera
    depth_shutter: Shutter
    color_camera: Camera
    color_shutter: Shutter
    T_color_depth: FloatArray
    color_falloff: float | None = None
    sigma: CalibrationSigma = EXACT_SIGMA

    @property
    def is_registered(self) -> bool:
        """Whether depth images have been warped into the colour camera."""
        return self.depth_camera == self.color_camera and bool((self.T_color_depth == np.eye(4)).all())


def rigid_transform(where: str, value: Any) -> FloatArray:
    """T (4, 4) of a file, its rotation made orthonormal to the last digit. Raises UserError naming `where`."""
    try:
        return se3.orthonormalise(rigid(value, _ROTATION_TOLERANCE))
    except ValueError as error:
        raise UserError(f"{where}: {error}") from None


@dataclass(frozen=True)
class Image:
    """One image. stamp: seconds, the instant at which line 0 stops being exposed.

    pixels: colour uint8 (h, w, 3) RGB; depth float32 (h, w), planar z in metres, 0 = missing.
    """

    stamp: float
    pixels: npt.NDArray[Any]


@dataclass(frozen=True)
class Frame:
    """One depth image and the colour images that go with it, sorted by stamp.

    Usually one; none where colour was dropped; two where colour is twice as fast.
    """

    depth: Image
    colors: tuple[Image, ...]
