"""What every reader of a foreign recording gives: the cameras, and a stream of items in the order of the file.

Readers hold one image at a time: items come from a generator that reads as it is asked, and closes the file at its end.
Lens models and shutters by the names that others give them, and what phones' recordings share, are below.

What Apple's ARKit gives and two apps store: its frames, and depth of 256x192 that is aligned with the colour image.
ARKit's camera has y up and looks along −z; ours y down and along z. Pixel centres are at integers in both. A depth
image covers the colour image's field exactly, so that its camera is colour's with fewer pixels.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, get_args

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rsgen.geometry.camera import Camera, Model
from rsgen.geometry.shutter import Scan
from rsgen.inputs import MOST_PIXELS
from rsgen.sequence.format import StreamName
from rstrack.data.imu.description import ImuNoise

FLOAT_DEPTH_SCALE = 5000.0
"""Units per metre of depth that was stored as floats."""

Vector3 = tuple[float, float, float]


@dataclass(frozen=True)
class RecordedImage:
    """One image as a file: PNG or JPEG colour, 16-bit PNG depth.

    stamp_ns: when it was taken, as the recording states; 0 where it does not. arrival_ns: when it was recorded, None
    where it is not known. ending: of the file's name.
    """

    stream: StreamName
    stamp_ns: int
    data: bytes
    ending: str = "png"
    arrival_ns: int | None = None


@dataclass(frozen=True)
class ImuSample:
    """A sample of an IMU: gyro rad/s, accel m/s²; None for the one that comes on its own."""

    stamp_ns: int
    gyro: Vector3 | None
    accel: Vector3 | None


@dataclass(frozen=True)
class RecordedPose:
    """T_world_color (4, 4) at a time."""

    stamp_ns: int
    T_world_color: FloatArray


def pose_of(q: npt.ArrayLike, t: npt.ArrayLike) -> FloatArray:
    """(4, 4) of a quaternion x y z w and a translation in metres; NaN where the quaternion is none."""
    q = np.asarray(q, float)
    if not (np.isfinite(q).all() and np.isfinite(t).all()) or abs(np.linalg.norm(q) - 1.0) > 1e-2:
        return np.full((4, 4), np.nan)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(q).as_matrix(), t
    return T


@dataclass(frozen=True)
class ImageIntrinsics:
    """fx, fy, cx, cy in pixels of a stream's image of a time, where they change from one to the next."""

    stamp_ns: int
    values: tuple[float, float, float, float]
    stream: StreamName = "color"


Item = RecordedImage | ImuSample | RecordedPose | ImageIntrinsics


@dataclass(frozen=True)
class StreamCamera:
    """A camera, and of its shutter what the recording states. readout_s: None where it does not."""

    camera: Camera
    readout_s: float | None = None
    exposure_s: float = 0.0
    scan: Scan | None = None


@dataclass(frozen=True)
class Recording:
    """A recording that has been opened.

    kind: its format in words. T_color_depth (4, 4): p_color from p_depth; None where it is not known. is_registered:
    depth images have been warped into the colour camera. depth_scale: units per metre. images: how many `items` will
    give, for the progress. truth: whose poses those among the items are, if any; is_measured: by another instrument,
    not estimated from the same images. notes: what was assumed, a line each. source: what was read of what, for
    import.json. T_imu_depth (4, 4): p_imu from p of the depth images' camera, and the IMU's noise; None: not known.
    """

    kind: str
    color: StreamCamera
    depth: StreamCamera
    T_color_depth: FloatArray | None
    depth_scale: float
    items: Iterator[Item]
    images: int
    is_registered: bool = False
    truth: str = ""
    is_measured: bool = False
    notes: tuple[str, ...] = ()
    source: Mapping[str, str | float] = field(default_factory=dict)
    T_imu_depth: FloatArray | None = None
    imu_noise: ImuNoise | None = None


@dataclass(frozen=True)
class ReadOptions:
    """What the user states of a recording.

    color, depth, color_info, depth_info: topics of bags; None: to be found. confidence: least of ARKit's depth that is
    kept, 0 to 2.
    """

    color: str | None = None
    depth: str | None = None
    color_info: str | None = None
    depth_info: str | None = None
    confidence: int = 1

    @property
    def topics(self) -> list[str]:
        """Those that are named."""
        return [name for name in (self.color, self.depth, self.color_info, self.depth_info) if name is not None]


_LENSES: dict[str, Model] = {
    **dict.fromkeys(("", "none", "pinhole"), "pinhole"),
    **dict.fromkeys(("plumb_bob", "radtan", "radial-tangential", "brown_conrady", "modified_brown_conrady"), "radtan"),
    "inverse_brown_conrady": "radtan",
    **dict.fromkeys(("rational_polynomial", "rational"), "rational"),
    **dict.fromkeys(("double_sphere", "ds"), "double_sphere"),
    **dict.fromkeys(("equidistant", "fisheye", "kannala_brandt", "kannala_brandt4"), "fisheye"),
}
"""Our models by others' names."""


def camera_of(
    name: str, width: int, height: int, intrinsics: npt.ArrayLike, model: str, coefficients: npt.ArrayLike
) -> Camera:
    """The camera of a ROS camera_info, of librealsense or of an ASL sensor.yaml.

    name: for messages. intrinsics: fx, fy, cx, cy in pixels, pixel centres at integers. coefficients: in OpenCV's
    order, k1 k2 p1 p2 k3 k4 k5 k6 of the rational model, xi alpha of the double sphere; zeros at the end are no matter.
    librealsense's inverse Brown-Conrady is what its own projection makes of it, radtan. Raises UserError: a model that
    there is none of.
    """
    d = np.ravel(np.asarray(coefficients, float)).tolist()
    lens = _LENSES.get(model.strip().lower().replace(" ", "_"))
    fx, fy, cx, cy = np.ravel(np.asarray(intrinsics, float)).tolist()
    pinhole = partial(Camera, width, height, fx, fy, cx, cy)
    if width * height > MOST_PIXELS:
        raise UserError(f"{name}: {width}x{height} pixels are absurd: the file is damaged")
    try:
        if not any(d) and lens not in ("fisheye", "double_sphere"):
            return pinhole()
        if lens == "pinhole":
            raise UserError(f"distortion {d} without a model")
        if lens == "fisheye":
            return pinhole("fisheye", tuple((d + [0.0] * 4)[:4]))
        if lens == "double_sphere" and len(d) == 2:
            return pinhole("double_sphere", (d[0], d[1]))
        if lens in ("radtan", "rational") and not any(d[5:]):
            return pinhole("radtan", tuple((d + [0.0] * 4)[: 5 if any(d[4:]) else 4]))
        if lens == "rational" and len(d) >= 8 and not any(d[8:]):
            return pinhole("rational", tuple(d[:8]))
    except UserError as error:
        raise UserError(f"{name}: {error}") from None
    raise UserError(
        f"{name}: lens model {model!r} with {len(d)} coefficients is not supported: undistort the images (OpenCV's "
        "initUndistortRectifyMap, or image_proc) and import those with the new camera matrix"
    )


def with_shutter(where: str, camera: Camera, facts: dict[str, Any]) -> StreamCamera:
    """A camera with the shutter of an entry `rolling_shutter` as `rsgen export` writes it.

    Raises UserError naming `where`: times that are none, or an unknown scan.
    """
    times = [facts.get(name, 0.0) for name in ("readout_s", "exposure_s")]
    scan: Scan = facts.get("scan", "top-bottom")
    if not all(isinstance(t, int | float) and 0 <= t < 10 for t in times) or scan not in get_args(Scan):
        raise UserError(f"{where}: rolling_shutter needs readout_s and exposure_s in seconds, and a scan")
    return StreamCamera(camera, float(times[0]), float(times[1]), scan)


ARKIT_TRUTH = "ARKit's poses, from the same images and the phone's IMU"
Four = tuple[float, float, float, float]


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


def intrinsics_items(stamp_ns: int, own: Four, color: Camera, depth: Camera) -> tuple[ImageIntrinsics, ImageIntrinsics]:
    """Those of the colour image of a time, and what they are for the depth image of that time."""
    beside = resized_intrinsics(own, (color.width, color.height), (depth.width, depth.height))
    return ImageIntrinsics(stamp_ns, own), ImageIntrinsics(stamp_ns, beside, "depth")
