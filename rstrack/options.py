"""Settings of tracking and mapping: name, type, default and meaning of each, for programs and command lines alike."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal, get_args

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.device.backend import Backend
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.shutter import Shutter

Method = Literal["rs-pg", "rs-g", "rs-p", "rs-pgi", "rs-gi", "gs-pg", "gs-g", "gs-p", "baseline"]
METHODS: tuple[str, ...] = get_args(Method)
Peer = Literal["open3d-hybrid", "open3d-icp", "open3d-hybrid-keyframe", "open3d-icp-keyframe"]
PEERS: tuple[str, ...] = get_args(Peer)
"""Open3D's joint photometric and geometric error or its point-to-plane ICP; to the frame before or to a keyframe."""
CLOUD_PEERS = ("kiss-icp", "small-gicp")
"""Lidar odometries, on the points of depth images."""
SLAM_PEERS = ("orb-slam3",)
"""Whole SLAM systems, with map and loops."""
Strategy = Literal["converged", "newest"]
Source = Literal["keyframe", "model"]
Loops = Literal["off", "online", "end"]

# Knots (s), and where frames are further apart than so long (s), knots as this part of that, up to times (s) over which
# no motion is carried on.
_KNOTS_S, _SLOW_S, _KNOTS_PER_FRAME, _SLOWEST_S = 0.025, 0.04, 0.75, 0.3


# Of fields that are no options on the command line: nobody has had to touch them there.
_IN_PYTHON = {"command_line": False}


@dataclass(frozen=True)
class Options:
    """What can be chosen for a tracker; each field's text is also the help of the option of its name."""

    method: Annotated[
        Method,
        "rs models the rolling shutter, gs takes all lines at mid readout; p photometric, g geometric error, i "
        "an IMU's residuals besides; baseline has one pose a frame",
    ] = "rs-pg"
    knot_spacing_s: Annotated[
        float | None,
        "time between control points of the spline, s (default: 0.025, or three quarters of the time between frames "
        "where these come more slowly than 25 a second; beside an IMU as dense as what it reads needs); with gs that "
        "of the frames if it is more, since each gives one pose only",
    ] = None
    knot_phase: Annotated[float, "the first knot lies this part of the spacing before the first line"] = field(
        default=0.5, metadata=_IN_PYTHON
    )
    backend: Annotated[Backend, "where kernels run"] = "auto"
    keyframe_overlap: Annotated[
        float, "new keyframe once less than this part of the depth points that the current one saw at first is seen"
    ] = field(default=0.65, metadata=_IN_PYTHON)
    keyframe_distance: Annotated[float, "new keyframe after this distance, m"] = field(default=0.3, metadata=_IN_PYTHON)
    keyframe_angle_deg: Annotated[float, "new keyframe after this rotation, degrees"] = field(
        default=20.0, metadata=_IN_PYTHON
    )
    keyframe_strategy: Annotated[
        Strategy,
        "which frame that is (paper, section 3.5): the last that has converged, rectified at once, or the newest, "
        "rolling until it has converged",
    ] = "converged"
    fuse: Annotated[
        bool | None,
        "average the depth of later frames into the keyframe (default: yes, but not if a rolling shutter is taken for "
        "a global one, since what is averaged then does not fit together)",
    ] = None
    moving: Annotated[
        bool,
        "leave out what moves by itself, as far as it stands where a keyframe saw through, or the other way round (not "
        "for the baseline, nor where a rolling shutter is taken for a global one)",
    ] = True
    bootstrap_frames: Annotated[int, "frames that are aligned jointly at the start"] = field(
        default=6, metadata=_IN_PYTHON
    )
    max_depth: Annotated[float, "depth beyond this counts as missing, m"] = 12.0
    blur_sigma_px: Annotated[
        float, "colour that motion blurs counts less, by exp(-length / this squared), equation (13), px; 0: all alike"
    ] = 0.0
    reference: Annotated[
        Source,
        "what new frames are aligned to: one keyframe with the depth of others fused in, or one averaged with a "
        "distance volume of all frames, and the oldest keyframe in view: less drift where the camera comes back; not "
        "for the baseline",
    ] = "keyframe"
    voxel_m: Annotated[float, "voxels of that volume, m"] = field(default=0.01, metadata=_IN_PYTHON)
    loops: Annotated[
        Loops | None,
        "places that the camera has come back to are looked for, and the whole spline is corrected: end when the "
        "recording has ended, online whenever a keyframe is complete (default: end with 'rstrack track', off in "
        "benchmarks and live)",
    ] = None
    budget_ms: Annotated[
        float | None,
        "time for a frame, ms: once settled, alignment ends before it is done, and keyframes wait, where there is "
        "no time left; such poses have a larger covariance (default: as long as it takes; with a budget results depend "
        "on how fast the machine is)",
    ] = None
    memory_gb: Annotated[
        float,
        "images of old keyframes that take more than this go to temporary files (in TMPDIR) until needed, and so do "
        "far parts of a volume",
    ] = 2.0

    def __post_init__(self) -> None:
        chosen: dict[str, Any] = {"method": Method, "keyframe_strategy": Strategy, "reference": Source}
        for name, kind in (chosen if self.loops is None else chosen | {"loops": Loops}).items():
            if getattr(self, name) not in get_args(kind):
                raise UserError(f"unknown {name} '{getattr(self, name)}': choose {', '.join(get_args(kind))}")
        if self.knot_spacing_s is not None and not 0.001 <= self.knot_spacing_s <= 1.0:
            raise UserError(f"knot_spacing_s = {self.knot_spacing_s!r} must be between 0.001 and 1 s")
        if not 0.0 <= self.knot_phase <= 1.0:
            raise UserError(f"knot_phase = {self.knot_phase!r} must be between 0 and 1")
        if not 0.0 < self.keyframe_overlap < 2.0:
            raise UserError(
                f"keyframe_overlap = {self.keyframe_overlap!r} must be positive; 1 makes new ones all the time"
            )
        for name in ("keyframe_distance", "keyframe_angle_deg", "max_depth", "memory_gb"):
            if not getattr(self, name) > 0.0:
                raise UserError(f"{name} = {getattr(self, name)!r} must be positive")
        if self.budget_ms is not None and not self.budget_ms > 0.0:
            raise UserError(f"budget_ms = {self.budget_ms!r} must be positive, or not given")
        if not 0.0 <= self.blur_sigma_px < 1e3:
            raise UserError(f"blur_sigma_px = {self.blur_sigma_px!r} must be 0 (off) or positive, in pixels")
        if self.bootstrap_frames < 3:
            raise UserError(f"bootstrap_frames = {self.bootstrap_frames!r} must be 3 or more")

    @property
    def rolling(self) -> bool:
        """Whether the rolling shutter is modelled."""
        return self.method.startswith("rs")

    @property
    def models(self) -> bool:
        """Whether references are synthesised from a model."""
        return self.reference == "model"

    @property
    def geometric(self) -> bool:
        """Whether the geometric term is used."""
        return self.method in ("rs-pg", "rs-g", "rs-pgi", "rs-gi", "gs-pg", "gs-g", "baseline")

    @property
    def photometric(self) -> bool:
        """Whether the photometric term is used."""
        return self.method in ("rs-pg", "rs-p", "rs-pgi", "gs-pg", "gs-p")

    @property
    def inertial(self) -> bool:
        """Whether an IMU is used."""
        return self.method in ("rs-pgi", "rs-gi")

    def decided(self, depth_shutter: Shutter, interval_s: float | None = None) -> Options:
        """With `fuse` chosen for such a depth camera where it is None, and the knots for frames so far apart."""
        knots = self.knot_spacing_s if interval_s is None else self.knots_s(interval_s)
        fuse = self.rolling or depth_shutter.readout_s == 0.0 if self.fuse is None else self.fuse
        return replace(self, fuse=fuse, knot_spacing_s=knots)

    def knots_s(self, interval_s: float = 0.0) -> float:
        """Time between knots for frames interval_s apart.

        Between slow frames nothing is seen: knots as dense as for fast ones follow the noise of each frame's few lines,
        and what is predicted from them misses the next frame.
        """
        if self.knot_spacing_s is not None:
            return self.knot_spacing_s
        return _KNOTS_S if interval_s < _SLOW_S else _KNOTS_PER_FRAME * min(interval_s, _SLOWEST_S)

    def left_behind(self, T_base_cam: FloatArray, overlap: float) -> bool:
        """Whether a camera at T_base_cam (4, 4), that sees `overlap` of what the keyframe had, needs another one."""
        return self.remoteness(T_base_cam) > 1.0 or overlap < self.keyframe_overlap

    def remoteness(self, T_base_cam: FloatArray) -> float:
        """The larger of distance and angle of a camera at T_base_cam (4, 4), each over where a keyframe is left."""
        return float(self.remoteness_of_each(T_base_cam))

    def remoteness_of_each(self, T_base_cam: FloatArray) -> FloatArray:
        """The same (...) of cameras at T_base_cam (..., 4, 4)."""
        distance = np.linalg.norm(T_base_cam[..., :3, 3], axis=-1)
        angle = np.degrees(np.linalg.norm(se3.log(T_base_cam)[..., 3:], axis=-1))
        return np.asarray(np.maximum(distance / self.keyframe_distance, angle / self.keyframe_angle_deg))


@dataclass(frozen=True)
class MapOptions:
    """What can be chosen for a map; texts as in `Options`."""

    shutter: Annotated[
        Literal["rs", "gs"] | None,
        "rs: every line from its own pose; gs: all from the middle line's (default: rs if the run has a spline)",
    ] = None
    world: Annotated[
        Literal["truth", "estimate"] | None,
        "frame of the mesh; truth: trajectories are aligned first, as by 'rstrack evaluate' (default: truth if the "
        "sequence has one)",
    ] = None
    voxel_m: Annotated[float, "voxels of the distance volume, m", "--voxel"] = 0.01
    every: Annotated[int, "use every N-th frame"] = 1
    color: Annotated[bool, "colour the mesh (default: yes)"] = True
    max_depth: Annotated[float, "depth beyond this is left out, m"] = 6.0
    memory_gb: Annotated[
        float, "parts of the volume that take more than this go to a temporary file (in TMPDIR) until needed"
    ] = 2.0
    backend: Annotated[Backend, "where kernels run"] = "auto"

    def __post_init__(self) -> None:
        if self.every < 1:
            raise UserError(f"every = {self.every!r} must be 1 or more")
        for name in ("max_depth", "memory_gb"):
            if not getattr(self, name) > 0.0:
                raise UserError(f"{name} = {getattr(self, name)!r} must be positive")
