"""Render a suite: every sequence whole, one job each, and its manifest; a run killed at any moment goes on.

made = render_suite(read_definition("rollingrooms"), RenderOptions(tier="small"), Path("suites/rr"), workers, progress)
"""

from __future__ import annotations

import json
import logging
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rsgen.config.cameras import ColorConfig
from rsgen.config.config import Config
from rsgen.console.progress import Progress, no_progress
from rsgen.console.scheduler import Workers
from rsgen.errors import UserError
from rsgen.files import (
    atomic_write,
    encode_yaml,
    is_temporary,
    read_text,
    read_yaml,
    remove_stale_temporaries,
    write_error,
)
from rsgen.produce.generate import ORIGIN, by_scene, for_other_processes, loaded_last, render_sequence
from rsgen.produce.parts import LoadedScene, load_scene_and_light
from rsgen.produce.records import fingerprint
from rsgen.sequence.camera_yaml import Cameras, ColorClock, camera_yaml
from rsgen.suite.definition import FORMAT, SUITE, Definition, Planned, RenderOptions, estimate
from rsgen.suite.manifest import MANIFEST, FileRecord, read_manifest, record_files, rule_of, sha256_of, write_manifest

log = logging.getLogger("rsgen")

# Records of finished sequences, until the manifest has them.
_DONE = ".done"
# What a tracker is given of a test sequence; a camera.yaml stands for its sequence.yaml.
_INPUTS = ("rgb", "depth", "rgb.txt", "depth.txt", "associations.txt", "imu.csv", "camera.yaml")


@dataclass(frozen=True)
class SuiteJob:
    """One sequence: what a worker has to know. key: of its scene and light. truth: where what is held back goes."""

    planned: Planned
    folder: Path
    done: Path
    truth: Path | None

    @property
    def key(self) -> str:
        """Of the scene and its light."""
        config = self.planned.config
        lit = config.scene, config.light, config.target
        return json.dumps([part.model_dump(mode="json") for part in lit if part])


@dataclass(frozen=True)
class SuiteSummary:
    """What `out` holds now. new: sequences made in this run; skipped: a line each."""

    sequences: int
    new: int
    files: int
    bytes: int
    skipped: tuple[str, ...]


def render_suite(
    suite: Definition, options: RenderOptions, out: Path, workers: Workers, progress: Progress = no_progress
) -> SuiteSummary:
    """Render the sequences that `out` lacks, and write suite.yaml and manifest.json.

    Raises UserError: `out` holds another suite or other files, a config is wrong, something cannot be written.
    """
    only, truth = options.only or (), options.hold_back_truth
    planned, skipped = suite.planned(options.tier, only, options.data, options.test_seed)
    for line in skipped:
        log.warning("%s", line)
    if truth is not None and options.test_seed is None:
        log.warning("--hold-back-truth: seeds are the configs', which anybody can render again: give --test-seed N too")
    if truth is not None and (rigs := [p.name for p in planned if p.config.streams and p.entry.role == "test"]):
        raise UserError(f"{rigs[0]}: is of a rig, which has no camera.yaml: truth cannot be held back, make it train")
    _open(out, suite, planned, options)
    jobs = [_job(one, out, truth) for one in planned]
    recorded = _recorded(out)
    todo = [job for job in jobs if job.planned.name not in recorded or not job.folder.is_dir()]
    for job in jobs:
        if job not in todo:
            _hold_back(job)
    guess = estimate(job.planned.config for job in todo)
    log.info("%d of %d sequences to render: %s", len(todo), len(jobs), guess.text())
    begun, done, behind = time.monotonic(), 0, 0.0
    whole = max(guess.seconds, 1e-9)
    for job, _ in by_scene(make_sequence, todo, workers, progress):
        if not job.done.is_file():
            raise UserError(f"{job.folder}: a worker has written it, but not here: choose an --out all share")
        done, behind = done + 1, behind + estimate([job.planned.config]).seconds
        took = time.monotonic() - begun
        left = took * max(0.0, whole / max(behind, 1e-9) - 1)
        progress("sequences", min(1.0, behind / whole), f"{done} of {len(todo)}, {left / 3600:.2f} h left as measured")
    files = _finish(out, suite, truth)
    shutil.rmtree(out / _DONE)
    size = sum(record.size for record in files.values())
    return SuiteSummary(len(jobs), len(todo), len(files), size, tuple(skipped))


def make_sequence(job: SuiteJob, progress: Progress) -> None:
    """Render one sequence, record its files, and put away what is held back. Raises UserError."""
    config = job.planned.config
    if (job.folder / "camera.yaml").is_file() and not (job.folder / "sequence.yaml").is_file():
        raise UserError(
            f"{job.folder}: is without its truth, and its record is lost: delete the folder, then try again"
        )
    render_sequence(config, job.folder, slice(None), no_progress, None, _loaded_scene(job, progress))
    try:
        if job.truth is not None:
            atomic_write(job.folder / "camera.yaml", encode_yaml(_stated_cameras(config)))
        (job.folder / ORIGIN).unlink(missing_ok=True)  # it names folders of this machine
        files = record_files(job.folder)
        held = {name for name in files if job.truth is not None and name.partition("/")[0] not in _INPUTS}
        records = {name: asdict(record) | {"held_back": name in held} for name, record in files.items()}
        atomic_write(job.done, json.dumps(records).encode())
        _hold_back(job)
    except OSError as error:
        raise write_error(job.folder, error) from None


# ---------------------------------------------------------------------------------------------------------------------


def _loaded_scene(job: SuiteJob, progress: Progress) -> LoadedScene | None:
    """None where things move: their light is made for each sequence."""
    config = job.planned.config
    if config.objects:
        return None
    view = config.cameras[config.view]
    key = job.key + str(view.spp if isinstance(view, ColorConfig) else 1)
    return loaded_last(key, lambda: load_scene_and_light(config, progress))


def _stated_cameras(config: Config) -> dict[str, Any]:
    """A camera.yaml of what sequence.yaml states: of a driver's stamps colour's offset is not known."""
    cameras = Cameras.of(config.declared_color, config.declared_depth, config.declared_T_color_depth)
    is_exact = config.injected.color is None and config.injected.depth is None
    clock = ColorClock() if is_exact else ColorClock("auto", is_exact=False)
    return camera_yaml(cameras, clock, config.depth.registered)


def _job(one: Planned, out: Path, truth: Path | None) -> SuiteJob:
    one = Planned(one.name, one.entry, for_other_processes(one.config))
    held = None if truth is None or one.entry.role != "test" else (truth / one.name).resolve()
    return SuiteJob(one, (out / one.name).resolve(), (out / _DONE / f"{one.name}.json").resolve(), held)


def _hold_back(job: SuiteJob) -> None:
    """Move what gives the motion away; what a killed run has moved is there already."""
    if job.truth is None:
        return
    for path in sorted(job.folder.iterdir()):
        if path.name not in _INPUTS:
            job.truth.mkdir(parents=True, exist_ok=True)
            target = job.truth / path.name
            if path.is_dir():
                shutil.copytree(path, target, dirs_exist_ok=True)
                shutil.rmtree(path)
            else:
                shutil.move(path, target)


def _open(out: Path, suite: Definition, planned: Sequence[Planned], options: RenderOptions) -> None:
    """Begin or continue the suite in `out`, and write its suite.yaml. Raises UserError if it holds anything else."""
    is_held = options.hold_back_truth is not None
    # Where truth is held back not even a hash of the seed is published: of a small number it can be found by trying.
    identity = fingerprint({
        "definition": suite.model_dump(mode="json"), "held_back": is_held,
        "test_seed": None if is_held else options.test_seed,
    })  # fmt: skip
    cure = "choose another --out or delete the folder"
    entries = {one.name: one.about() for one in planned}
    try:
        if (out / SUITE).is_file():
            old = read_yaml(out / SUITE)
            if old.get("fingerprint") != identity:
                raise UserError(
                    f"{out}: holds another suite ({old.get('name')} {old.get('version')}), another state of this one, "
                    f"or one with other test seeds or truth: {cure}"
                )
            entries = {str(entry["name"]): entry for entry in old["entries"]} | entries
        elif out.exists() and (not out.is_dir() or any(not is_temporary(p) and p.name != _DONE for p in out.iterdir())):
            raise UserError(f"{out}: holds other files and no {SUITE}: {cure}")
        (out / _DONE).mkdir(parents=True, exist_ok=True)
        for folder in (out, out / _DONE):
            remove_stale_temporaries(folder)
    except OSError as error:
        raise write_error(out, error) from None
    about = {
        "format": FORMAT, "name": suite.name, "version": suite.version, "license": suite.license, "about": suite.about,
        "homepage": suite.homepage, "truth": "held back of test sequences" if is_held else "whole",
        "fingerprint": identity, "entries": [entries[name] for name in sorted(entries)],
    }  # fmt: skip
    atomic_write(out / SUITE, encode_yaml(about))


def _recorded(out: Path) -> dict[str, dict[str, FileRecord]]:
    """Files of each finished sequence by their paths within it: of a manifest, and of records made since."""
    found: dict[str, dict[str, FileRecord]] = {}
    for path, record in (read_manifest(out) if (out / MANIFEST).is_file() else {}).items():
        folder, _, name = path.partition("/")
        if name:
            found.setdefault(folder, {})[name] = record
    for done in sorted((out / _DONE).glob("*.json")):
        found[done.stem] = {name: FileRecord(**record) for name, record in json.loads(read_text(done)).items()}
    return found


def _finish(out: Path, suite: Definition, truth: Path | None) -> Mapping[str, FileRecord]:
    """Write the manifests of all finished sequences. Raises UserError."""
    recorded = _recorded(out)
    files = {f"{name}/{path}": record for name, own in recorded.items() for path, record in own.items()}
    about, path = {"suite": suite.name, "version": suite.version}, out / SUITE
    everything = files | {SUITE: FileRecord(path.stat().st_size, sha256_of(path), rule_of(path))}
    write_manifest(out, about, everything)
    if truth is not None:
        truth.mkdir(parents=True, exist_ok=True)
        held = {name: FileRecord(r.size, r.sha256, r.match) for name, r in files.items() if r.held_back}
        write_manifest(truth, about, held)
    return everything
