"""From a configuration to a sequence folder: read, fit, light, render, write. A run can be stopped and resumed.

On workers the bytes are the same. To them go whole sequences, scene by scene, or blocks of images of one to render,
whose encoded files come back: only the process that the user started writes to its folder then, and workers need the
scene (and, to share the baked light, its cache) at the same path, nothing else of the disk.
"""

from __future__ import annotations

import json
import socket
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol, TypeVar

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.config.config import Config
from rsgen.console.progress import Progress, no_progress
from rsgen.console.scheduler import Workers
from rsgen.errors import UserError
from rsgen.files import atomic_write, encode_yaml
from rsgen.motion.free_space import check_clearance
from rsgen.motion.object_paths import check_objects_clear
from rsgen.produce.camera_sources import FrameSource, render_shots
from rsgen.produce.parts import (
    LoadedScene,
    TrueMotion,
    engine_versions,
    input_hashes,
    load_motion,
    load_scene,
    mesh_hashes,
    open_frames,
    scene_hash,
    scene_instances,
    sequence_stamps,
)
from rsgen.produce.writer import SequenceWriter
from rsgen.scene.meshes import ply_bytes, surface
from rsgen.scene.object_meshes import load_object
from rsgen.sensors.color import Reading, Setting, adapt
from rsgen.sequence.truth_files import LABELS, labels_yaml, mesh_file, thing_of

# What a sequence folder remembers of the machine that rendered it, for commands that render again. Not part of the
# format: a sequence is whole without it.
ORIGIN = "origin.yaml"


def render_sequence(
    config: Config, out: Path, frames: slice, progress: Progress, workers: Workers | None = None,
    loaded: LoadedScene | None = None,
) -> Path:  # fmt: skip
    """Render the missing frames among `frames` into `out` and (re)write its listings and truth; returns `out`.

    workers: what renders (and bakes the light) in place of this process; the bytes are the same. loaded: its scene
    and light, as `load_scene_and_light` returns them.

    Raises UserError on any bad input, or if `out` holds another sequence; nothing already written is lost.
    """
    motion = load_motion(config)
    stamps = sequence_stamps(config, motion)
    if frames.start is not None and frames.start >= (longest := max(map(len, stamps.values()))):
        raise UserError(f"--frames: the sequence has no frame {frames.start}, only 0 to {longest - 1}")
    identity = engine_versions(config.backend), input_hashes(config)
    meshes = [load_object(thing) for thing in config.objects]

    @cache
    def scene() -> Any:
        return loaded.scene if loaded else load_scene(config)

    @cache
    def source() -> FrameSource:
        return open_frames(config, progress, scene=scene(), objects=writer.objects, loaded=loaded)

    # In a new folder: a scene that does not load must not leave one behind that its repaired self cannot continue.
    if not (out / "sequence.yaml").exists():
        _check_ways(config, motion, meshes, scene())
    writer = SequenceWriter.open(out, config, motion.spline, stamps, *identity, motion.objects)
    write_origin(out, config)
    for name in (name for name, camera in config.cameras.items() if camera.adapts):
        writer = writer.adapted(name, automatic_settings(name, source(), writer, progress))
    wanted = {s: range(*frames.indices(len(of_stream))) for s, of_stream in stamps.items()}
    todo = sorted((k, s) for s in config.cameras for k in writer.missing(s) if k in wanted[s])
    if not (out / "scene.ply").is_file():
        atomic_write(out / "scene.ply", ply_bytes(*surface(scene())))
    if config.truth.labels and not (out / LABELS).is_file():
        atomic_write(out / LABELS, encode_yaml(label_table(scene(), config, meshes)))
    for thing, mesh in zip(config.objects, meshes, strict=True):
        atomic_write(out / mesh_file(thing.name), ply_bytes(mesh.vertices, mesh.faces))
    try:
        if todo and workers is not None:
            render_blocks(writer, todo, *identity, workers, progress)
        elif todo:
            render_shots(writer, source(), todo, progress)
    except (KeyboardInterrupt, SystemExit):
        # A run that the user ends here leaves a readable, shorter sequence.
        writer.finish()
        raise
    writer.finish()
    return out


def automatic_settings(name: str, source: FrameSource, writer: SequenceWriter, progress: Progress) -> list[Setting]:
    """How an automatic camera takes all frames of its clock, also those that a driver loses."""
    stamps, color = writer.stamps(name), source.colors[name].config
    gain = color.noise.gain if color.noise.model == "camera" and color.noise.gain > 0 else 1.0
    meter = source.colors[name].light_meter(writer.spline, stamps)

    def watched(frame: int, setting: Setting) -> Reading:
        progress("metering", (frame + 1) / len(stamps), f"frame {frame}")
        return meter(frame, setting)

    reference = Setting(color.exposure_s, gain)
    return adapt(watched, len(stamps), reference, color.auto_exposure, color.auto_white_balance)


def _check_ways(config: Config, motion: TrueMotion, meshes: Sequence[Any], scene: Any) -> None:
    """Raises UserError if an object comes through a camera, or a camera too near to the scene."""
    triangles, names = [mesh.vertices[mesh.faces] for mesh in meshes], [thing.name for thing in config.objects]
    span, cameras = (motion.first_stamp, motion.last_stamp), [config.T_cam_body(name) for name in config.cameras]
    check_objects_clear(names, motion.objects, triangles, motion.spline, span, cameras)
    least = config.trajectory.clearance_m if config.motion is None else config.motion.clearance_m
    if least is not None:
        check_clearance(motion.spline, scene_triangles(scene), least)


def label_table(scene: Any, config: Config, meshes: Sequence[Any]) -> dict[str, Any]:
    """What labels stand for: things of the scene, then the objects that move. Raises UserError."""
    instances, corners = scene_instances(scene, config), scene_triangles(scene)
    order = np.argsort(instances.of_triangle, kind="stable")
    ends = np.cumsum(np.bincount(instances.of_triangle, minlength=len(instances.names) + 1)[1:])
    of_thing = np.split(corners[order], ends[:-1])
    things = [thing_of(name, part) for name, part in zip(instances.names, of_thing, strict=True)]
    for thing, mesh in zip(config.objects, meshes, strict=True):
        things.append(thing_of(thing.name, mesh.vertices[mesh.faces]))
    return labels_yaml(things, config.truth.classes)


def scene_triangles(scene: Any) -> FloatArray:
    """Corners (m, 3, 3) of all triangles of a Mitsuba scene, world frame, metres."""
    vertices, faces = surface(scene)
    return np.asarray(vertices, float)[faces]


def write_origin(out: Path, config: Config) -> None:
    """Note where the scene and trajectory of the sequence in `out` are on this machine. Raises UserError."""
    where = {"scene": str(config.scene.file.resolve())}
    if config.trajectory.file is not None:
        where["trajectory"] = str(config.trajectory.file.resolve())
    where |= {f"object {thing.name}": str(thing.mesh.resolve()) for thing in config.objects if thing.mesh is not None}
    atomic_write(out / ORIGIN, encode_yaml(where))


class SceneJob(Protocol):
    """Work in a scene. key: of what scene and light are made from."""

    @property
    def key(self) -> str: ...


Job = TypeVar("Job", bound=SceneJob)
Result = TypeVar("Result")
Loaded = TypeVar("Loaded")

# Images a job makes: a few seconds of work and some megabytes of files.
_BLOCK = 8


def by_scene(
    function: Callable[[Job, Progress], Result], jobs: Sequence[Job], workers: Workers, progress: Progress
) -> Iterator[tuple[Job, Result]]:
    """Yield each job with function(job, progress), in any order. Raises what a job raises, and as `Workers.apply`.

    The first one of each scene alone: it bakes the light, if need be, and the others find it in the cache.
    """
    first = {job.key: k for k, job in reversed(list(enumerate(jobs)))}
    ahead = [job for k, job in enumerate(jobs) if first[job.key] == k]
    rest = sorted((job for k, job in enumerate(jobs) if first[job.key] != k), key=lambda job: job.key)
    for part in (ahead, rest):
        for k, result in workers.apply(function, part, progress):
            yield part[k], result


# Scene and light that this process rendered last, by what they were made from.
_loaded: dict[str, Any] = {}


def loaded_last(key: str, load: Callable[[], Loaded]) -> Loaded:
    """Scene and light that are made from what `key` names: those that this process rendered last, or loaded now."""
    if key not in _loaded:
        _loaded.clear()
        _loaded[key] = load()
    found: Loaded = _loaded[key]
    return found


def for_other_processes(config: Config, variant: str | None = None) -> Config:
    """The config with full paths of scene and meshes, and the backend of Dr.Jit's variant, whatever a worker has."""
    things = tuple(
        thing if thing.mesh is None else thing.model_copy(update={"mesh": thing.mesh.absolute()})
        for thing in config.objects
    )
    scene = config.scene.model_copy(update={"file": config.scene.file.absolute()})
    backend = {} if variant is None else {"backend": variant.partition("_")[0]}
    return config.model_copy(update={"scene": scene, "objects": things, **backend})


@dataclass(frozen=True)
class RenderJob:
    """Images (frame, stream) that one job renders. writer: of the sequence; versions, inputs: as in sequence.yaml."""

    writer: SequenceWriter
    versions: Mapping[str, str]
    inputs: Mapping[str, str]
    shots: tuple[tuple[int, str], ...]
    key: str


def render_blocks(
    writer: SequenceWriter,
    shots: Sequence[tuple[int, str]],
    versions: Mapping[str, str],
    inputs: Mapping[str, str],
    workers: Workers,
    progress: Progress,
) -> None:
    """Render the images (frame, stream) on `workers` and write them into the writer's folder, in any order.

    Raises UserError if a worker has other versions or another scene, or is lost too often; what came back is kept.
    """
    config = for_other_processes(writer.config, versions["variant"])
    key = json.dumps([config.model_dump_json(), dict(inputs), dict(versions)])
    whole = RenderJob(replace(writer, config=config), versions, inputs, (), key)
    blocks = [replace(whole, shots=tuple(shots[i : i + _BLOCK])) for i in range(0, len(shots), _BLOCK)]
    done = 0
    for block, files in by_scene(render_block, blocks, workers, progress):
        for name, data in files.items():
            atomic_write(writer.out / name, data)
        done += len(block.shots)
        progress("frames", done / len(shots), f"{done} of {len(shots)} images")


def render_block(block: RenderJob, progress: Progress) -> dict[str, bytes]:
    """On a worker: the block's files by their paths within the sequence. Raises UserError."""
    try:
        source = loaded_last(block.key, lambda: _source(block, progress))
    except UserError as error:
        raise UserError(f"worker on {socket.gethostname()}: {error}") from None
    with TemporaryDirectory(prefix="rsgen-") as folder:
        writer = replace(block.writer, out=Path(folder))
        writer.make_folders()
        render_shots(writer, source, block.shots, no_progress)
        made = sorted(path for path in writer.out.rglob("*") if path.is_file())
        return {path.relative_to(writer.out).as_posix(): path.read_bytes() for path in made}


def _source(block: RenderJob, progress: Progress) -> FrameSource:
    """Raises UserError if this process would render other bytes than the one that opened the sequence."""
    config = block.writer.config
    mine = engine_versions(config.backend)
    for name, wanted in block.versions.items():
        if mine.get(name) != wanted:
            raise UserError(
                f"has {name} {mine.get(name)}, the sequence needs {wanted}: install the same on all workers"
            )
    if not config.scene.file.exists():
        raise UserError(f"{config.scene.file}: is missing: workers need the scene at the same path (a shared disk)")
    if scene_hash(config) != block.inputs["scene"]:
        raise UserError(f"{config.scene.file}: or a file of it is another one here: copy the scene again")
    for name, found in mesh_hashes(config).items():
        if found != block.inputs[name]:
            raise UserError(f"{name}: its mesh is another one here: copy it again")
    return open_frames(config, progress, objects=block.writer.objects)
