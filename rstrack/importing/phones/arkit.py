"""What Apple's ARKit gives and two apps store: its frames, and depth of 256x192 that is aligned with the colour image.

ARKit's camera has y up and looks along −z; ours y down and along z. Pixel centres are at integers in both. A depth
image covers the colour image's field exactly, so that its camera is colour's with fewer pixels.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rsgen.geometry.camera import Camera
from rstrack.importing.lens import camera_of

TRUTH = "ARKit's poses, from the same images and the phone's IMU"
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""T_arkit_camera: coordinates of our camera in ARKit's."""


def median_camera(name: str, size: tuple[int, int], intrinsics: npt.ArrayLike) -> Camera:
    """The camera (width, height) with the medians of fx, fy, cx, cy (n, 4). Raises UserError."""
    return camera_of(name, *size, np.median(np.asarray(intrinsics, float), axis=0), "", ())


def resized(name: str, camera: Camera, size: tuple[int, int]) -> Camera:
    """The same field of view with other pixels: (width, height). Raises UserError."""
    sx, sy = size[0] / camera.width, size[1] / camera.height
    cx, cy = (camera.cx + 0.5) * sx - 0.5, (camera.cy + 0.5) * sy - 0.5
    return camera_of(name, *size, (camera.fx * sx, camera.fy * sy, cx, cy), "", ())
