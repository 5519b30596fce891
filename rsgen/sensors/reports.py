"""What a recording reports beside its images: a driver's stamps, losses and repetitions; a motion capture's poses.

Also what sequence.yaml says of its sensors beside the cameras: IMU, motion capture, calibration target.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import numpy as np
from pydantic import BaseModel, ValidationError

from rsgen.array_types import BoolArray, FloatArray, IntArray
from rsgen.config.faults import ImuFaults, StreamFaults, split_imu
from rsgen.config.sections import ImuConfig, MocapConfig, TargetConfig
from rsgen.errors import UserError, first_problem
from rsgen.geometry import se3, so3
from rsgen.geometry.spline import Spline
from rsgen.sensors.imu import ImuSamples, simulate_imu
from rsgen.sensors.seed import driver_generator, mocap_generator
from rsgen.sequence.camera_yaml import ColorClock
from rsgen.sequence.format import StreamName, pose_rows, round_stamps
from rsgen.sequence.images import Rig

# Listings must rise; two images that arrive at once are stamped this far apart where no grid keeps them apart.
_LEAST_STEP_S = 1e-6


@dataclass(frozen=True)
class Delivery:
    """What a driver makes of a stream's n frames.

    listed (n,): stamps it gives, s, rising. shows (n,): the frame whose image it delivers as frame k, k itself or an
    earlier one. is_delivered (n,): False where the image was lost.
    """

    listed: FloatArray
    shows: IntArray
    is_delivered: BoolArray


def deliver(stamps: FloatArray, config: StreamFaults | None, seed: int, stream: StreamName) -> Delivery:
    """What the driver makes of frames whose true stamps are `stamps` (n,), s, rising; without a config: all as it is.

    listed = ⌈t + (t − t_0) drift + offset + N(0, jitter²)⌉ to the grid, less half a grid's step so that the mean delay
    stays `offset_s`; where that does not rise, the later image waits for the next step of the grid. Each frame's random
    numbers depend on the seed, the stream and the frame's number alone. The first frame is always delivered, but in a
    blackout.
    """
    count = len(stamps)
    frames = np.arange(count)
    if config is None:
        return Delivery(stamps, frames, np.ones(count, bool))
    jitter, fate = (driver_generator(seed, stream, part) for part in ("jitter", "fate"))
    arrival = stamps + (stamps - stamps[0]) * (1e-6 * config.drift_ppm) + config.offset_s
    arrival = arrival + config.jitter_s * jitter.standard_normal(count)
    step = config.grid_s or _LEAST_STEP_S
    tick = arrival / step
    if config.grid_s:
        tick = np.ceil(tick - 0.5)
    tick = np.maximum.accumulate(tick - frames) + frames
    drawn = fate.random(count)
    is_delivered = (drawn >= config.dropped) | (frames == 0)
    for begin, length in config.blackouts:
        is_delivered &= (stamps < begin) | (stamps >= begin + length)
    is_repeated = is_delivered & (drawn < config.dropped + config.repeated) & (frames > 0)
    # A repetition shows the last image that came itself.
    shows = np.maximum.accumulate(np.where(is_delivered & ~is_repeated, frames, 0))
    return Delivery(round_stamps(tick * step), np.where(is_delivered, shows, frames), is_delivered)


def color_clock(
    color: StreamFaults | None, depth: StreamFaults | None, color_first: float, depth_first: float, middle: float
) -> ColorClock:
    """What colour's listed stamps need, in the mean, to agree with depth's.

    color_first, depth_first: true stamps in s of both streams' first frames; middle: the listed stamp of depth that it
    holds at.
    """
    if color is None and depth is None:
        return ColorClock()
    color, depth = color or StreamFaults(), depth or StreamFaults()
    color_rate, depth_rate = 1.0 + 1e-6 * color.drift_ppm, 1.0 + 1e-6 * depth.drift_ppm
    # What colour's driver lists at `middle` was taken at t, when depth's would have listed `as_depth`.
    t = color_first + (middle - color.offset_s - color_first) / color_rate
    as_depth = depth_first + depth_rate * (t - depth_first) + depth.offset_s
    return ColorClock(as_depth - middle, 1e6 * (depth_rate / color_rate - 1.0), is_exact=False)


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


SectionT = TypeVar("SectionT", bound=BaseModel)


class SequenceImu(NamedTuple):
    """The IMU of a sequence, its samples over the whole spline, and what is wrong with them."""

    config: ImuConfig
    samples: ImuSamples
    faults: ImuFaults


def sequence_imu(sequence: Rig) -> SequenceImu | None:
    """The IMU of a sequence; None where it has none.

    Equal to what imu.csv was written from. Raises UserError if sequence.yaml's config.imu is not one.
    """
    found = _section(sequence, "imu", ImuConfig, lambda recorded: split_imu(recorded)[0])
    wrong = _section(sequence, "imu", ImuFaults, lambda recorded: split_imu(recorded)[1] or {})
    if found is None or wrong is None:
        return None
    (imu, seed), (faults, _), spline = found, wrong, sequence.spline
    return SequenceImu(imu, simulate_imu(spline, imu, spline.t_begin, spline.t_end, seed, faults), faults)


def sequence_mocap(sequence: Rig) -> tuple[MocapConfig, int] | None:
    """The motion capture of a sequence's groundtruth.txt and the sequence's seed; None where the poses are exact.

    Raises UserError if sequence.yaml's config.mocap is not one.
    """
    return _section(sequence, "mocap", MocapConfig)


def sequence_target(sequence: Rig) -> TargetConfig | None:
    """The calibration target in a sequence's scene; None where there is none.

    Raises UserError if sequence.yaml's config.target is not one.
    """
    found = _section(sequence, "target", TargetConfig)
    return None if found is None else found[0]


def _section(
    sequence: Rig, name: str, model: type[SectionT], part: Callable[[dict[str, Any]], Any] = dict
) -> tuple[SectionT, int] | None:
    """A section of the config in sequence.yaml, or a part of it, and the seed; None where there is no such section.

    Raises UserError.
    """
    where = sequence.root / "sequence.yaml"
    config: Any = sequence.meta.get("config")
    data = config.get(name) if isinstance(config, dict) else None
    if data is None:
        return None
    try:
        section = model.model_validate(part(data) if isinstance(data, dict) else data)
    except ValidationError as error:
        problem = first_problem(error, "config", name)
        raise UserError(f"{where}: {problem}: restore the file or render again") from None
    seed = sequence.meta.get("seed")
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise UserError(f"{where}: seed is not a whole number of 0 or more: restore the file or render again")
    return section, seed
