"""What Apple's ARKit gives and two apps store: its frames, and depth of 256x192 that is aligned with the colour image.

ARKit's camera has y up and looks along −z; ours y down and along z. Pixel centres are at integers in both. A depth
image covers the colour image's field exactly, so that its camera is colour's with fewer pixels.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rsgen.geometry.camera import Camera
from rstrack.formats.lens import camera_of
from rstrack.formats.recording import Intrinsics

TRUTH = "ARKit's poses, from the same images and the phone's IMU"
Four = tuple[float, float, float, float]
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""T_arkit_camera: coordinates of our camera in ARKit's."""


def median_camera(name: str, size: tuple[int, int], intrinsics: npt.ArrayLike) -> Camera:
    """The camera (width, height) with the medians of fx, fy, cx, cy (n, 4). Raises UserError."""
    return camera_of(name, *size, np.median(np.asarray(intrinsics, float), axis=0), "", ())


def resized(name: str, camera: Camera, size: tuple[int, int]) -> Camera:
    """The same field of view with other pixels: (width, height). Raises UserError."""
    own = resized_intrinsics((camera.fx, camera.fy, camera.cx, camera.cy), (camera.width, camera.height), size)
    return camera_of(name, *size, own, "", ())


def resized_intrinsics(own: Four, size: tuple[int, int], new: tuple[int, int]) -> Four:
    """fx, fy, cx, cy of an image of `size` (width, height), for its field of view in `new` pixels."""
    (fx, fy, cx, cy), (sx, sy) = own, (new[0] / size[0], new[1] / size[1])
    return fx * sx, fy * sy, (cx + 0.5) * sx - 0.5, (cy + 0.5) * sy - 0.5


def intrinsics_items(stamp_ns: int, own: Four, color: Camera, depth: Camera) -> tuple[Intrinsics, Intrinsics]:
    """Those of the colour image of a time, and what they are for the depth image of that time."""
    beside = resized_intrinsics(own, (color.width, color.height), (depth.width, depth.height))
    return Intrinsics(stamp_ns, own), Intrinsics(stamp_ns, beside, "depth")
