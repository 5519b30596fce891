"""What every reader of a foreign recording gives: the cameras, and a stream of items in the order of the file.

Readers hold one image at a time: items come from a generator that reads as it is asked, and closes the file at its end.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from rsgen.array_types import FloatArray
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Scan
from rsgen.sequence.format import StreamName
from rstrack.data.imu.recording import ImuNoise

FLOAT_DEPTH_SCALE = 5000.0
"""Units per metre of depth that was stored as floats."""

Vector3 = tuple[float, float, float]


@dataclass(frozen=True)
class Picture:
    """One image as a file: PNG or JPEG colour, 16-bit PNG depth.

    stamp_ns: when it was taken, as the recording says; 0 where it does not. arrival_ns: when it was recorded, None
    where nothing tells. ending: of the file's name.
    """

    stream: StreamName
    stamp_ns: int
    data: bytes
    ending: str = "png"
    arrival_ns: int | None = None


@dataclass(frozen=True)
class Inertial:
    """A sample of an IMU: gyro rad/s, accel m/s²; None for the one that comes on its own."""

    stamp_ns: int
    gyro: Vector3 | None
    accel: Vector3 | None


@dataclass(frozen=True)
class Pose:
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
class Intrinsics:
    """fx, fy, cx, cy in pixels of a stream's image of a time, where they change from one to the next."""

    stamp_ns: int
    values: tuple[float, float, float, float]
    stream: StreamName = "color"


Item = Picture | Inertial | Pose | Intrinsics


@dataclass(frozen=True)
class StreamCamera:
    """A camera, and of its shutter what the recording says. readout_s: None where it says nothing."""

    camera: Camera
    readout_s: float | None = None
    exposure_s: float = 0.0
    scan: Scan | None = None


@dataclass(frozen=True)
class Recording:
    """A recording that has been opened.

    kind: its format in words. T_color_depth (4, 4): p_color from p_depth; None where nothing tells it. is_registered:
    depth images have been warped into the colour camera. depth_scale: units per metre. pictures: how many `items` will
    give, for the progress. truth: whose poses those among the items are, if any; is_measured: by another instrument,
    not estimated from the same images. notes: what was assumed, a line each. source: what was read of what, for
    import.json. T_imu_depth (4, 4): p_imu from p of the depth images' camera, and the IMU's noise; None: not told.
    """

    kind: str
    color: StreamCamera
    depth: StreamCamera
    T_color_depth: FloatArray | None
    is_registered: bool
    depth_scale: float
    items: Iterator[Item]
    pictures: int
    truth: str = ""
    is_measured: bool = False
    notes: tuple[str, ...] = ()
    source: Mapping[str, str | float] = field(default_factory=dict)
    T_imu_depth: FloatArray | None = None
    imu_noise: ImuNoise | None = None
