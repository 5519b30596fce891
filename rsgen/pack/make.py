"""A training pack: many short sequences, each drawn, rendered and written by itself, whole or not at all.

made = make_pack((config,), PackOptions(count=1000), seed=0, out=Path("packs/demo"), workers=Workers())
"""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rsgen.config.config import Config
from rsgen.console.progress import Progress
from rsgen.console.scheduler import Workers
from rsgen.errors import UserError
from rsgen.files import atomic_write, encode_yaml, read_yaml, write_error
from rsgen.geometry.spline import Spline
from rsgen.motion.stretch import Drawn, draw_stretch
from rsgen.pack.draw import PackOptions
from rsgen.pack.pairs import (
    Place,
    gyro_samples,
    mark_file,
    mean_twist,
    pair_files,
    render_pairs,
)  # fmt: skip
from rsgen.produce.batches import by_scene
from rsgen.produce.parts import engine_versions, input_hashes, load_motion, load_scene_and_light
from rsgen.produce.records import fingerprint
from rsgen.sensors.imu import imu_csv

FORMAT = "rsgen-pack/1"
PACK, DRAWN, GYRO = "pack.yaml", "sequence.json", "imu.csv"


@dataclass(frozen=True)
class PackJob:
    """One sequence: what a worker has to know. folder: where it goes, on a disk that all share. spline:
    T_world_depth(t) of its config's motion. key: of its config and inputs, for scenes already loaded."""

    config: Config
    key: str
    spline: Spline
    drawn: Drawn
    options: PackOptions
    folder: Path


@dataclass(frozen=True)
class PackSummary:
    """What `out` holds now: sequences, pairs in them, and how many sequences were made in this run."""

    out: Path
    sequences: int
    pairs: int
    new: int


def make_pack(
    configs: Sequence[Config], options: PackOptions, seed: int, out: Path, workers: Workers, progress: Progress
) -> PackSummary:
    """Render the sequences that `out` lacks. A pack may be continued with a larger count, by nothing else.

    Raises UserError: a config that a pack cannot be made of, a folder that holds something else or cannot be written.
    """
    for config in configs:
        _check(config)
    motions = [load_motion(config) for config in configs]
    spans = [(motion.first_stamp, motion.last_stamp) for motion in motions]
    rates = [config.color.rate_hz for config in configs]
    drawn = [draw_stretch(options.ranges, seed, index, spans, rates) for index in range(options.sequences)]
    identities = [_identity(config) for config in configs]
    _open(out, identities, options, seed)
    jobs = []
    for index, one in enumerate(drawn):
        folder = out / f"{index:06d}"
        if not folder.is_dir():
            key = fingerprint(identities[one.config])
            config, variant = configs[one.config], identities[one.config]["versions"]["variant"]
            scene = config.scene.model_copy(update={"file": config.scene.file.absolute()})  # for other processes
            config = config.model_copy(update={"scene": scene, "backend": variant.partition("_")[0]})
            jobs.append(PackJob(config, key, motions[one.config].spline, one, options, folder.resolve()))
    done = 0
    for job, _ in by_scene(make_sequence, jobs, workers, progress):
        done += 1
        if not job.folder.is_dir():
            raise UserError(f"{job.folder}: a worker has written it, but not here: choose an --out all share")
        progress("sequences", done / len(jobs), f"{done * options.length} of {len(jobs) * options.length} pairs")
    return PackSummary(out, options.sequences, options.sequences * options.length, done)


def make_sequence(job: PackJob, progress: Progress) -> None:
    """Render one sequence into its folder, which is there when all of it is. Raises UserError."""
    place = _loaded_scene(job, progress)
    temporary = job.folder.with_name(f".{job.folder.name}.{os.getpid()}.tmp")
    try:
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir(parents=True)
        for k, pair in enumerate(render_pairs(place, job.drawn, job.options.length, job.options.depth)):
            for name, data in pair_files(job.options.layout, k, pair).items():
                (temporary / name).write_bytes(data)
        twist = mean_twist(place, job.drawn, job.options.length)
        name, text = mark_file(job.options.layout, job.drawn, twist, job.config.color.rate_hz)
        samples = gyro_samples(place, job.drawn, job.options.length)
        (temporary / GYRO).write_bytes(imu_csv(samples).encode())
        (temporary / DRAWN).write_text(json.dumps(_about(job, place), indent=1) + "\n")
        (temporary / name).write_bytes(text)
        os.replace(temporary, job.folder)  # noqa: PTH105 - one name for tests to break
    except OSError as error:
        raise write_error(job.folder, error) from None
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


# ---------------------------------------------------------------------------------------------------------------------


def _check(config: Config) -> None:
    """Raises UserError for what a pack does not know."""
    if config.objects:
        raise UserError(f"config {config.name}: has objects that move, which packs do not render: leave them out")
    if config.color.adapts:
        raise UserError(f"config {config.name}: packs have no automatic camera: leave auto_exposure and the like out")


def _identity(config: Config) -> dict[str, Any]:
    return {"config": config.content(), "inputs": input_hashes(config), "versions": engine_versions(config.backend)}


def _open(out: Path, identities: Sequence[dict[str, Any]], options: PackOptions, seed: int) -> None:
    """Begin or continue the pack in `out`. Raises UserError if it holds anything else."""
    content = {"format": FORMAT, "seed": seed, "options": options.content, "configs": list(identities)}
    content["fingerprint"] = fingerprint(content)
    cure = "choose another --out or delete the folder"
    if (out / PACK).is_file():
        old = read_yaml(out / PACK)
        if old.get("fingerprint") != content["fingerprint"]:
            names = [name for name in ("seed", "options", "configs") if old.get(name) != content[name]] or [
                "fingerprint"
            ]
            raise UserError(f"{out}: holds another pack, of other {' and '.join(names)}: {cure}")
        return
    try:
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise UserError(f"{out}: holds other files and no {PACK}: {cure}")
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(out, error) from None
    atomic_write(out / PACK, encode_yaml(content))


# Scene and light that this process rendered last, by what they were made from.
_loaded: dict[str, Place] = {}


def _loaded_scene(job: PackJob, progress: Progress) -> Place:
    if job.key not in _loaded:
        _loaded.clear()
        _loaded[job.key] = Place(job.config, load_scene_and_light(job.config, progress), job.spline)
    return _loaded[job.key]


def _about(job: PackJob, place: Place) -> dict[str, Any]:
    """What was drawn, and the camera; times count from the first frame's stamp."""
    color, drawn = place.config.color, job.drawn
    return {
        "config": place.config.name, **dataclasses.asdict(drawn), "frames": job.options.length,
        "rate_hz": color.rate_hz, "size": [color.width, color.height], "intrinsics": list(color.intrinsics),
        "model": color.model, "distortion": list(color.distortion), "scan": color.scan,
    }  # fmt: skip
