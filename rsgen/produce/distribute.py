"""Render the images of an open sequence on workers, with the same bytes as in this process.

To workers go blocks of images to render, and encoded files come back. Only the process that the user started writes to
the sequence's folder. Workers need the scene (and, to share the baked light, its cache) at the same path, nothing else
of the disk.
"""

from __future__ import annotations

import json
import socket
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

from rsgen.array_types import FloatArray
from rsgen.config.config import Config
from rsgen.console.progress import Progress, no_progress
from rsgen.console.scheduler import Workers
from rsgen.errors import UserError
from rsgen.files import atomic_write
from rsgen.geometry.spline import Spline
from rsgen.produce.frame_source import FrameSource, render_shots
from rsgen.produce.parts import engine_versions, mesh_hashes, open_frames, scene_hash
from rsgen.produce.writer import SequenceWriter
from rsgen.sensors.color import Setting

# Images a job makes: a few seconds of work and some megabytes of files.
_BLOCK = 8


@dataclass(frozen=True)
class SequenceRecipe:
    """What a worker has to know of a sequence to render any of its frames.

    stamps: of each camera those (n,), s, of all frames; versions, inputs: as in sequence.yaml. settings: of each
    automatic camera, of all its frames. objects: T_world_object(t) of the config's.
    """

    config: Config
    spline: Spline
    stamps: Mapping[str, FloatArray]
    versions: Mapping[str, str]
    inputs: Mapping[str, str]
    settings: Mapping[str, tuple[Setting, ...]] = field(default_factory=dict)
    objects: tuple[Spline, ...] = ()


@dataclass(frozen=True)
class RenderJob:
    """Images (frame, stream) that one job renders."""

    plan: SequenceRecipe
    shots: tuple[tuple[int, str], ...]


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
    plan = SequenceRecipe(
        _for_other_processes(writer.config, versions),
        writer.spline,
        {name: writer.stamps(name) for name in writer.streams},
        versions,
        inputs,
        dict(writer.settings),
        writer.objects,
    )
    blocks = [RenderJob(plan, tuple(shots[i : i + _BLOCK])) for i in range(0, len(shots), _BLOCK)]
    done = 0
    # The first one alone: it bakes the light, if need be, and the others find it in the cache.
    for part in (blocks[:1], blocks[1:]):
        for index, files in workers.apply(render_block, part, progress):
            for name, data in files.items():
                atomic_write(writer.out / name, data)
            done += len(part[index].shots)
            progress("frames", done / len(shots), f"{done} of {len(shots)} images")


def render_block(block: RenderJob, progress: Progress) -> dict[str, bytes]:
    """On a worker: the block's files by their paths within the sequence. Raises UserError."""
    plan = block.plan
    source = _source(plan, progress)
    with TemporaryDirectory(prefix="rsgen-") as folder:
        out = Path(folder) / plan.config.name
        identity = plan.versions, plan.inputs
        writer = SequenceWriter.open(out, plan.config, plan.spline, plan.stamps, *identity, plan.objects)
        for name, settings in plan.settings.items():
            writer = writer.adapted(name, settings)
        before = set(out.rglob("*"))
        render_shots(writer, source, block.shots, no_progress)
        made = sorted(path for path in set(out.rglob("*")) - before if path.is_file())
        return {path.relative_to(out).as_posix(): path.read_bytes() for path in made}


def _for_other_processes(config: Config, versions: Mapping[str, str]) -> Config:
    """The config with full paths of scene and meshes, and the backend that runs here, whatever a worker has."""
    scene = config.scene.model_copy(update={"file": config.scene.file.absolute()})
    things = tuple(
        thing if thing.mesh is None else thing.model_copy(update={"mesh": thing.mesh.absolute()})
        for thing in config.objects
    )
    backend = versions["variant"].partition("_")[0]
    return config.model_copy(update={"scene": scene, "objects": things, "backend": backend})


# Scene and light that this process rendered last, by what they were made from.
_loaded: dict[str, FrameSource] = {}


def _source(plan: SequenceRecipe, progress: Progress) -> FrameSource:
    key = json.dumps([plan.config.model_dump_json(), dict(plan.inputs), dict(plan.versions)])
    if key not in _loaded:
        _loaded.clear()
        try:
            _check(plan)
            _loaded[key] = open_frames(plan.config, progress, objects=plan.objects)
        except UserError as error:
            raise UserError(f"worker on {socket.gethostname()}: {error}") from None
    return _loaded[key]


def _check(plan: SequenceRecipe) -> None:
    """Raises UserError if this process would render other bytes than the one that opened the sequence."""
    mine = engine_versions(plan.config.backend)
    for name, wanted in plan.versions.items():
        if mine.get(name) != wanted:
            raise UserError(
                f"has {name} {mine.get(name)}, the sequence needs {wanted}: install the same on all workers"
            )
    if not plan.config.scene.file.exists():
        raise UserError(
            f"{plan.config.scene.file}: is missing: workers need the scene at the same path (a shared disk)"
        )
    if scene_hash(plan.config) != plan.inputs["scene"]:
        raise UserError(f"{plan.config.scene.file}: or a file of it is another one here: copy the scene again")
    for name, found in mesh_hashes(plan.config.objects, plan.config.backend).items():
        if found != plan.inputs[name]:
            raise UserError(f"{name}: its mesh is another one here: copy it again")
