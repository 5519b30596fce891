"""The tracker's settings: one set of defaults for everything."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from rsgen.device.backend import Backend
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.so3 import FloatArray

Method = Literal["rs-pg", "rs-g", "rs-p", "gs-pg", "gs-g", "gs-p", "baseline"]
METHODS: tuple[str, ...] = get_args(Method)
PEERS: tuple[str, ...] = ("open3d-hybrid", "open3d-icp", "open3d-hybrid-keyframe", "open3d-icp-keyframe")
"""Open3D's joint photometric and geometric error or its point-to-plane ICP; to the frame before or to a keyframe."""
Strategy = Literal["converged", "newest"]
STRATEGIES: tuple[str, ...] = get_args(Strategy)
Source = Literal["keyframe", "model"]
SOURCES: tuple[str, ...] = get_args(Source)


@dataclass(frozen=True)
class Options:
    """What can be chosen. Times in seconds, lengths in metres, angles in degrees.

    method: rs/gs models the rolling shutter or takes all lines at mid readout; p/g: photometric, geometric error.
    knot_spacing_s, knot_phase: control points are spacing apart, the first knot phase · spacing before the first line;
      with a global shutter they are as far apart as the frames if that is more, since each gives one pose only.
    keyframe_overlap: a new keyframe is made once less than this share of the depth points that the current keyframe
      saw at first falls on it; keyframe_distance, keyframe_angle_deg: or once the camera is that far from it.
    blur_sigma_px: pixels; points of a colour image that its exposure blurs count less, by equation (13); 0: all alike.
    keyframe_strategy: which frame that is (paper, section 3.5): the last one that has converged, rectified at once; or
      the newest, with its rolling shutter until it has converged and can be rectified.
    fuse: average the depth of later frames into the keyframe; None: where it is known when each line was taken, that is
      if the method models the rolling shutter or there is none. Otherwise what is averaged does not fit together.
    reference: keyframe: new frames are aligned to one frame, with the depth of others fused in; model: its depth is
      averaged with a signed distance volume of all frames, with voxels of voxel_m, frames are aligned to the oldest
      keyframe in view too, and a keyframe is used again when the camera comes back to it. The baseline has no model.
    """

    method: Method = "rs-pg"
    knot_spacing_s: float = 0.025
    knot_phase: float = 0.5
    backend: Backend = "auto"
    keyframe_overlap: float = 0.65
    keyframe_distance: float = 0.3
    keyframe_angle_deg: float = 20.0
    keyframe_strategy: Strategy = "converged"
    fuse: bool | None = None
    bootstrap_frames: int = 6
    max_depth: float = 12.0
    blur_sigma_px: float = 0.0
    reference: Source = "keyframe"
    voxel_m: float = 0.01

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise UserError(f"unknown method '{self.method}': choose {', '.join(METHODS)}")
        if self.keyframe_strategy not in STRATEGIES:
            raise UserError(f"unknown keyframe_strategy '{self.keyframe_strategy}': choose {', '.join(STRATEGIES)}")
        if not 0.001 <= self.knot_spacing_s <= 1.0:
            raise UserError(f"knot_spacing_s = {self.knot_spacing_s!r} must be between 0.001 and 1 s")
        if not 0.0 <= self.knot_phase <= 1.0:
            raise UserError(f"knot_phase = {self.knot_phase!r} must be between 0 and 1")
        if not 0.0 < self.keyframe_overlap < 2.0:
            raise UserError(
                f"keyframe_overlap = {self.keyframe_overlap!r} must be positive; 1 makes new ones all the time"
            )
        if self.reference not in SOURCES:
            raise UserError(f"unknown reference '{self.reference}': choose {', '.join(SOURCES)}")
        for name in ("keyframe_distance", "keyframe_angle_deg", "max_depth"):
            if not getattr(self, name) > 0.0:
                raise UserError(f"{name} = {getattr(self, name)!r} must be positive")
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
        return self.method in ("rs-pg", "rs-g", "gs-pg", "gs-g", "baseline")

    @property
    def photometric(self) -> bool:
        """Whether the photometric term is used."""
        return self.method in ("rs-pg", "rs-p", "gs-pg", "gs-p")

    def decided(self, depth_shutter: Shutter) -> Options:
        """With `fuse` chosen for such a depth camera where it is None."""
        return replace(self, fuse=self.rolling or depth_shutter.readout_s == 0.0) if self.fuse is None else self

    def left_behind(self, T_base_cam: FloatArray, overlap: float) -> bool:
        """Whether a camera at T_base_cam (4, 4), that sees `overlap` of what the keyframe had, needs another one."""
        return self.remoteness(T_base_cam) > 1.0 or overlap < self.keyframe_overlap

    def remoteness(self, T_base_cam: FloatArray) -> float:
        """The larger of distance and angle of a camera at T_base_cam (4, 4), each over where a keyframe is left."""
        distance, angle = np.linalg.norm(T_base_cam[:3, 3]), np.linalg.norm(se3.log(T_base_cam)[3:])
        return float(max(distance / self.keyframe_distance, np.degrees(angle) / self.keyframe_angle_deg))
