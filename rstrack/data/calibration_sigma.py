"""How far a camera file may be wrong: what the tracker does not solve for, and what its poses inherit.

Consider parameters (Schmidt 1966; Woodbury and Junkins, AIAA 2010): their σ enter covariances, their values stay.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from rsgen.array_types import FloatArray

_LENS = "focal", "aspect", "cx", "cy", "k1"
NAMES = (
    *(f"depth.{name}" for name in _LENS), *(f"color.{name}" for name in _LENS),
    *(f"T_color_depth.{axis}" for axis in ("x", "y", "z", "rx", "ry", "rz")),
    "depth.readout_s", "color.readout_s", "color.offset_s", "depth.scale", "depth.inverse_offset",
)  # fmt: skip
"""The parameters, in the order of vectors.

Lenses: focal lengths as a part of themselves, aspect as a part of fy alone, cx and cy in focal lengths, k1 as OpenCV
counts it. T_color_depth ← exp(ε) T_color_depth. Depth's scale as a part, its inverse offset in 1/m (`DepthError`).
"""


@dataclass(frozen=True)
class CalibrationSigma:
    """Standard deviations of what a camera file says, of both cameras alike; 0: exact.

    focal: part of the focal lengths; aspect: part of fy beyond that; center: principal point, in focal lengths; k1:
    distortion; rotation_deg, translation_m: of T_color_depth, an axis; readout_s; offset_s: colour's clock;
    depth_scale: part; depth_inverse_offset: 1/m. depth_image: 1/m, what inverse depth of each image is off by as a
    whole, by an offset and by two tilts: no parameter, but solved for with every pose.
    """

    focal: float = 0.0
    aspect: float = 0.0
    center: float = 0.0
    k1: float = 0.0
    rotation_deg: float = 0.0
    translation_m: float = 0.0
    readout_s: float = 0.0
    offset_s: float = 0.0
    depth_scale: float = 0.0
    depth_inverse_offset: float = 0.0
    depth_image: float = 0.0

    def vector(self, is_registered: bool = False) -> FloatArray:
        """In the order of NAMES (21,). is_registered: depth is seen through the colour camera, and the two are one."""
        lens = np.array([self.focal, self.aspect, self.center, self.center, self.k1])
        pose = np.array([self.translation_m, math.radians(self.rotation_deg)]).repeat(3)
        own = 0.0 if is_registered else 1.0
        times = self.readout_s, self.readout_s, self.offset_s
        return np.concatenate([own * lens, lens, own * pose, times, [self.depth_scale, self.depth_inverse_offset]])

    @property
    def is_exact(self) -> bool:
        """Whether nothing may be wrong."""
        return not any(getattr(self, field.name) for field in fields(self))


EXACT = CalibrationSigma()
"""Of renderings, but for depth cameras with fixed errors."""

STATED = CalibrationSigma(0.01, 0.003, 0.01, 0.02, 0.3, 0.005, 0.003, 0.003, 0.01, 0.005, 0.001)
"""Of a camera file that does not say: a judgement of what such files have wrong, not a measurement."""

UNFOUND_OFFSET_S = 0.015
"""σ of colour's clock where it is looked for and not found: half a frame at 30 Hz, as cameras run that nothing ties."""

UNDISTORTED_K1 = 0.1
"""σ of k1 where a real lens is said to have no distortion, as it hardly ever is."""
