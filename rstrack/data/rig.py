"""What the tracker is fed: the cameras (`Rig`) and one `Frame` for each depth image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from rsgen.array_types import FloatArray
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rstrack.data.calibration_sigma import EXACT, CalibrationSigma


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
    sigma: CalibrationSigma = EXACT

    @property
    def is_registered(self) -> bool:
        """Whether depth images have been warped into the colour camera."""
        return self.depth_camera == self.color_camera and bool((self.T_color_depth == np.eye(4)).all())


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
