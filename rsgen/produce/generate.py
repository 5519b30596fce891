"""From a configuration to a sequence folder: read, fit, light, render, write. A run can be stopped and resumed."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.config.config import Config
from rsgen.console.progress import Progress
from rsgen.console.scheduler import Workers
from rsgen.errors import UserError
from rsgen.files import atomic_write, encode_yaml
from rsgen.motion.clearance import check_clearance
from rsgen.produce.distribute import engine_versions, render_blocks, render_shots
from rsgen.produce.frame_source import FrameSource, load_scene, scene_hash
from rsgen.produce.ground_truth import Motion, load_motion
from rsgen.produce.moving import (
    check_clear_of_camera,
    load_meshes,
    object_hashes,
    object_mesh_ply,
)
from rsgen.produce.writer import SequenceWriter
from rsgen.sensors.color import Reading, Setting, adapt
from rsgen.sequence.format import STREAMS, stream_stamps
from rsgen.sequence.truth_files import mesh_file

log = logging.getLogger("rsgen")

# What a sequence folder remembers of the machine that rendered it, for commands that render again. Not part of the
# format: a sequence is whole without it.
ORIGIN = "origin.yaml"


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
    from rsgen.render.meshes import surface

    vertices, faces = surface(scene)
    return np.asarray(vertices, float)[faces]


def write_scene_ply(scene: Any, path: Path) -> None:
    """All triangles of the scene, world frame, metres, as binary PLY. Raises UserError if it cannot be written."""
    from rsgen.render.meshes import ply_bytes, surface

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
