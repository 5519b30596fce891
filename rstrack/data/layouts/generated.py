"""Sequences of rsgen as a tracker gets them: exact, or as what a driver and a registration leave of them.

Where a sequence's listed stamps are a driver's, or its depth is registered, it is a recording like any other: cameras
as sequence.yaml tells them, stamps that are arrival times (`rstrack.data.timing`), colour's offset not known.
Its truth is the pose of each depth frame when it was taken, under the stamp at which it is tracked. Cameras that are
declared wrong on purpose are given as they are declared; the truth is that of the cameras that took the images.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rsgen.geometry import se3
from rsgen.sequence.reader import Sequence
from rsgen.sequence.trajectory import Trajectory
from rstrack.data.camera_file import usual
from rstrack.data.registration import DepthSensor, registered_shutter
from rstrack.data.rig import DEFAULT_SIGMA, EXACT_SIGMA, CalibrationSigma, Rig
from rstrack.data.timing import StampsMode, Timing, stream_timing


@dataclass(frozen=True)
class Recorded:
    """What a sequence is to a tracker; truth_poses: T_world_depth of the depth images' camera, at timing's stamps."""

    rig: Rig
    timing: Timing
    truth_poses: Trajectory


def is_exact(sequence: Sequence) -> bool:
    """Whether listed stamps are the true ones and depth is the sensor's own."""
    streams = sequence.streams.values()
    return not any(s.registered or (s.listed != s.stamps).any() for s in streams)


def sigma_of(sequence: Sequence) -> CalibrationSigma:
    """How far the cameras that sequence.yaml tells may be wrong: not at all, unless they are declared so on purpose.

    A depth camera with fixed errors of its own has them though its lens is told: as usual, since a user of such a
    camera knows no more.
    """
    sigma = usual(sequence.streams["color"].camera) if sequence.meta.get("declared") else EXACT_SIGMA
    noise: Any = sequence.meta
    for name in ("config", "depth", "noise"):
        noise = noise.get(name) if isinstance(noise, dict) else None
    if isinstance(noise, dict) and any(noise.get(name) for name in ("scale_error", "distortion_px")):
        own = "depth_scale", "depth_inverse_offset", "depth_image"
        return replace(sigma, **{name: getattr(DEFAULT_SIGMA, name) for name in own})
    return sigma


def with_depth_scale(sequence: Sequence, depth_scale: float) -> Sequence:
    """The sequence with its depth images read at so many units per metre."""
    depth = replace(sequence.streams["depth"], depth_scale=depth_scale)
    return replace(sequence, streams=sequence.streams | {"depth": depth})


def as_recorded(sequence: Sequence) -> Recorded:
    """The sequence as a recording. Raises UserError where registered depth's rows have no order."""
    color, depth = sequence.streams["color"], sequence.streams["depth"]
    shutter, late_s, T_color_depth = depth.shutter, 0.0, sequence.T_color_depth
    if depth.registered:
        sensor = DepthSensor(depth.camera, depth.shutter, sequence.T_color_depth)
        shutter, late_s = registered_shutter(color.camera, sensor)
        T_color_depth = np.eye(4)
    rig = Rig(
        sequence.depth_image_camera, shutter, color.camera, color.shutter, T_color_depth, sigma=sigma_of(sequence)
    )
    has_driver = any((s.listed != s.stamps).any() for s in (color, depth))
    mode: StampsMode = "auto" if has_driver else "raw"
    timing = Timing(
        stream_timing("depth", depth.listed, mode, late_s),
        stream_timing("colour", color.listed, mode, 0.0),
        None if has_driver else 0.0,
    )
    T_world_depth = sequence.spline.pose(np.clip(depth.stamps + late_s, sequence.spline.t_begin, sequence.spline.t_end))
    poses = T_world_depth @ se3.inverse(sequence.as_taken.T_image_depth)
    return Recorded(rig, timing, Trajectory(timing.depth.used, poses))
