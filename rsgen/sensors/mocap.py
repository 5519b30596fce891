"""What a motion capture reports of a camera's path: poses of a body fixed to it, noisy, by a clock of its own."""

from __future__ import annotations

import math

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.config.sections import MocapConfig
from rsgen.geometry import se3, so3
from rsgen.geometry.spline import Spline
from rsgen.sensors.seed import mocap_generator
from rsgen.sequence.format import pose_rows, round_stamps


def T_camera_body(config: MocapConfig) -> FloatArray:
    """Coordinates of the reported body to the camera's (4, 4)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = so3.exp(np.deg2rad(config.rotation_deg)), config.translation_m
    return T


def reported_poses(spline: Spline, config: MocapConfig, seed: int, T_cam_depth: FloatArray | None = None) -> FloatArray:
    """Rows (n, 8), as of groundtruth.txt: listed stamp, s, and T_world_body = T_world_cam T_camera_body exp(noise).

    spline: T_world_depth(t). T_cam_depth: of the camera that is meant, where it is not depth's. Poses are taken at all
    multiples of 1 / rate_hz within the spline; `seed` decides their noise.
    """
    first = math.ceil(spline.t_begin * config.rate_hz)
    last = math.floor(spline.t_end * config.rate_hz)
    t = np.clip(np.arange(first, last + 1) / config.rate_hz, spline.t_begin, spline.t_end)
    T = spline.pose(t)
    if T_cam_depth is not None:
        T = T @ se3.inverse(T_cam_depth)
    sigma = np.repeat([config.position_sigma_m, math.radians(config.rotation_sigma_deg)], 3)
    noise = sigma * mocap_generator(seed).standard_normal((len(t), 6))
    T = T @ T_camera_body(config) @ se3.exp(noise)
    return np.column_stack([round_stamps(t + config.offset_s), pose_rows(T)])
