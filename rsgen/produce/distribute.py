"""Jobs on workers: whole sequences, scene by scene, or blocks of one sequence's images, with the same bytes as here.

To workers go blocks of images to render, and encoded files come back. Only the process that the user started writes to
the sequence's folder. Workers need the scene (and, to share the baked light, its cache) at the same path, nothing else
of the disk.
"""

from __future__ import annotations

import json
import socket
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol, TypeVar

from rsgen.config.config import Config
from rsgen.console.progress import Progress, no_progress
from rsgen.console.scheduler import Workers
from rsgen.errors import UserError
from rsgen.files import atomic_write
from rsgen.produce.camera_sources import FrameSource, render_shots
from rsgen.produce.parts import engine_versions, mesh_hashes, open_frames, scene_hash
from rsgen.produce.writer import SequenceWriter


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
