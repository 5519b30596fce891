"""The ground truth of a config, and what its cameras look at."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.config.config import Config, TrajectoryConfig
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.motion.fit import FitResult, fit_spline
from rsgen.motion.make import make_motion, with_tremor
from rsgen.produce.moving import object_splines
from rsgen.sequence.trajectory import Trajectory, read_trajectory

log = logging.getLogger("rsgen")

# About 12 days. Up to here a float64 tells 0.1 ns apart; in Unix time 0.24 us, half a percent of a line delay.
_LARGEST_STAMP_S = 1e6
_LOOKS = 64  # instants that lines of sight are taken at, and as many lines each


@dataclass(frozen=True)
class Motion:
    """The ground truth of a config: fitted spline of the body (depth camera), recorded stamps, and `fit`.

    fit: of the recorded or made trajectory, before any tremor: what it missed. objects: T_world_object(t) of the
    config's.
    """

    spline: Spline
    fit: FitResult
    first_stamp: float
    last_stamp: float
    objects: tuple[Spline, ...] = ()


def load_motion(config: Config) -> Motion:
    """Read or make, place and fit the config's trajectory; the spline covers every line of every frame.

    Stamps stay those of the file unless they are too large to time a line by (Unix time): then the first becomes 0.
    Raises UserError naming the trajectory's file and line, or what a motion cannot meet.
    """
    settings = config.trajectory
    trajectory = make_motion(config.motion, config.seed) if config.motion is not None else _recorded(settings)
    if settings.T_world_file is not None:
        trajectory = trajectory.moved(np.asarray(settings.T_world_file, float))
    spacing = settings.knot_spacing_s
    recorded = None
    if config.tremor is not None:
        recorded = fit_spline(trajectory, dt=spacing, smoothing=settings.smoothing)
        trajectory, spacing = with_tremor(recorded.spline, config.tremor, config.seed, trajectory.stamps[[0, -1]])
    streams = (config.color, config.depth)
    before = max(s.longest_exposure_s - min(s.offset_s, 0.0) for s in streams)
    after = max(s.readout_s for s in streams)
    fit = fit_spline(
        trajectory, dt=spacing, smoothing=settings.smoothing if recorded is None else 0.0, pad_begin_s=before,
        pad_end_s=after,
    )  # fmt: skip
    first, last = float(trajectory.stamps[0]), float(trajectory.stamps[-1])
    return Motion(fit.spline, recorded or fit, first, last, object_splines(config, first, last))


def _recorded(settings: TrajectoryConfig) -> Trajectory:
    assert settings.file is not None  # or there were a motion
    trajectory = read_trajectory(settings.file, format=settings.format, icl_start=settings.icl_start)
    if np.abs(trajectory.stamps).max() >= _LARGEST_STAMP_S:
        log.info("%s: large stamps, so time counts from the first, %.9f s", settings.file, trajectory.stamps[0])
        trajectory = trajectory.rebased()
    return trajectory


def lines_of_sight(config: Config) -> tuple[FloatArray, FloatArray]:
    """What the config's colour camera looks along, at random over picture and recording. Raises UserError."""
    motion = load_motion(config)
    camera = config.color.camera
    rng = np.random.default_rng(config.seed)
    stamps = rng.uniform(motion.first_stamp, motion.last_stamp, _LOOKS)
    T_world_color = motion.spline.pose(stamps) @ se3.inverse(np.asarray(config.T_color_depth, float))
    pixels = rng.uniform(-0.5, (camera.width - 0.5, camera.height - 0.5), (_LOOKS, _LOOKS, 2))
    ray = camera.unproject(pixels)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    direction = np.einsum("nij,nkj->nki", T_world_color[:, :3, :3], ray)
    seen = np.isfinite(direction).all(axis=-1)  # a lens may see nothing in its corners
    eye = np.broadcast_to(T_world_color[:, None, :3, 3], direction.shape)
    return eye[seen], direction[seen]
