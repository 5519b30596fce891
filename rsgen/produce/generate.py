"""From a configuration to a sequence folder: read, fit, light, render, write. A run can be stopped and resumed."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.config.config import Config, TrajectoryConfig
from rsgen.console.progress import Progress
from rsgen.console.scheduler import Workers
from rsgen.errors import UserError
from rsgen.files import atomic_write, encode_yaml
from rsgen.geometry.spline import Spline
from rsgen.motion.clearance import check_clearance
from rsgen.motion.fit import FitResult, fit_spline
from rsgen.motion.make import make_motion
from rsgen.motion.tremor import with_tremor
from rsgen.produce.distribute import engine_versions, render_blocks, render_shots
from rsgen.produce.frame_source import FrameSource, load_scene, scene_hash
from rsgen.produce.moving import (
    check_clear_of_camera,
    load_meshes,
    object_hashes,
    object_mesh_ply,
    object_splines,
)
from rsgen.produce.writer import SequenceWriter
from rsgen.sensors.adaptation import Reading, Setting, adapt
from rsgen.sequence.format import STREAMS, stream_stamps
from rsgen.sequence.object_files import mesh_file
from rsgen.sequence.trajectory import Trajectory, read_trajectory

log = logging.getLogger("rsgen")

# About 12 days. Up to here a float64 tells 0.1 ns apart; in Unix time 0.24 us, half a percent of a line delay.
_LARGEST_STAMP_S = 1e6

# What a sequence folder remembers of the machine that rendered it, for commands that render again. Not part of the
# format: a sequence is whole without it.
ORIGIN = "origin.yaml"


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


def sequence_stamps(config: Config, motion: Motion) -> dict[str, FloatArray]:
    """Stamps (n,) in seconds of all frames of both streams."""
    return {s: stream_stamps(motion.first_stamp, motion.last_stamp, getattr(config, s)) for s in STREAMS}


def render_sequence(
    config: Config, out: Path, frames: slice, progress: Progress, workers: Workers | None = None
) -> Path:
    """Render the missing frames among `frames` into `out` and (re)write its listings and truth; returns `out`.

    workers: what renders (and bakes the light) in place of this process; the bytes are the same.

    Raises UserError on any bad input, or if `out` holds another sequence; nothing already written is lost.
    """
    motion = load_motion(config)
    stamps = sequence_stamps(config, motion)
    if frames.start is not None and frames.start >= (longest := max(map(len, stamps.values()))):
        raise UserError(f"--frames: the sequence has no frame {frames.start}, only 0 to {longest - 1}")
    identity = engine_versions(config), input_hashes(config)
    # In a new folder: a scene that does not load must not leave one behind that its mended self cannot continue.
    scene = None
    meshes = load_meshes(config) if motion.objects else ()
    if not (out / "sequence.yaml").exists():
        scene = load_scene(config)
        check_clear_of_camera(config, meshes, motion.objects, motion.spline, motion.first_stamp, motion.last_stamp)
        least = config.trajectory.clearance_m if config.motion is None else config.motion.clearance_m
        if least is not None:
            check_clearance(motion.spline, scene_triangles(scene), least)
    writer = SequenceWriter.open(
        out, config, motion.spline, stamps["color"], stamps["depth"], *identity, motion.objects
    )
    write_origin(out, config)
    source = None
    if config.color.adapts:
        source = FrameSource(config, progress, scene=scene, objects=writer.objects)
        writer = writer.adapted(automatic_settings(config, source, writer, progress))
    todo = sorted(
        [(k, stream) for stream in STREAMS for k in _chosen(writer.missing(stream), frames, len(stamps[stream]))],
    )
    if not (out / "scene.ply").is_file():
        scene = scene or load_scene(config)
        write_scene_ply(scene, out / "scene.ply")
    for thing, mesh in zip(config.objects, meshes, strict=True):
        atomic_write(out / mesh_file(thing.name), object_mesh_ply(mesh))
    try:
        if todo and workers is not None:
            render_blocks(writer, todo, *identity, workers, progress)
        elif todo:
            source = source or FrameSource(config, progress, scene=scene, objects=writer.objects)
            render_shots(writer, source, todo, progress)
    except (KeyboardInterrupt, SystemExit):
        # A run that the user ends here leaves a readable, shorter sequence.
        writer.finish()
        raise
    writer.finish()
    return out


def automatic_settings(
    config: Config, source: FrameSource, writer: SequenceWriter, progress: Progress
) -> list[Setting]:
    """How the automatic camera takes all colour frames of its clock, also those that a driver loses."""
    color, stamps = config.color, writer.stamps("color")
    gain = color.noise.gain if color.noise.model == "camera" and color.noise.gain > 0 else 1.0
    meter = source.light_meter(writer.spline, stamps)

    def watched(frame: int, setting: Setting) -> Reading:
        progress("metering", (frame + 1) / len(stamps), f"frame {frame}")
        return meter(frame, setting)

    reference = Setting(color.exposure_s, gain)
    return adapt(watched, len(stamps), reference, color.auto_exposure, color.auto_white_balance)


def _chosen(missing: Iterable[int], frames: slice, count: int) -> list[int]:
    wanted = set(range(*frames.indices(count)))
    return [k for k in missing if k in wanted]


def scene_triangles(scene: Any) -> FloatArray:
    """Corners (m, 3, 3) of all triangles of a Mitsuba scene, world frame, metres."""
    from rsgen.render.scene import surface

    vertices, faces = surface(scene)
    return np.asarray(vertices, float)[faces]


def write_scene_ply(scene: Any, path: Path) -> None:
    """All triangles of the scene, world frame, metres, as binary PLY. Raises UserError if it cannot be written."""
    from rsgen.render.scene import ply_bytes, surface

    vertices, faces = surface(scene)
    atomic_write(path, ply_bytes(vertices, faces))


def write_origin(out: Path, config: Config) -> None:
    """Note where the scene and trajectory of the sequence in `out` are on this machine. Raises UserError."""
    where = {"scene": str(config.scene.file.resolve())}
    if config.trajectory.file is not None:
        where["trajectory"] = str(config.trajectory.file.resolve())
    where |= {f"object {thing.name}": str(thing.mesh.resolve()) for thing in config.objects if thing.mesh is not None}
    atomic_write(out / ORIGIN, encode_yaml(where))


def input_hashes(config: Config) -> dict[str, str]:
    """Content hashes of the trajectory file, if there is one, and of the scene with all its files. Raises UserError."""
    file = config.trajectory.file
    trajectory = {} if file is None else {"trajectory": hashlib.sha256(file.read_bytes()).hexdigest()}
    return trajectory | {"scene": scene_hash(config)} | object_hashes(config)
