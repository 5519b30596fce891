"""The cells of `rstrack bench`: which method runs on which frames of which folder, and what its result depends on."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from rsgen.errors import UserError
from rstrack.bench.methods.config import Choice, SequenceEntry
from rstrack.bench.methods.variants import folder_of, fuses, method_of, variants
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.data.estimate import TRAJECTORY
from rstrack.metrics.association import truth_of
from rstrack.metrics.clock import TruthOffset
from rstrack.options import METHODS, Options
from rstrack.tracking.runs.record import Noise

# What describes a sequence, rsgen's or TUM's; the images themselves are not read for the key.
_DESCRIPTIONS = (
    "sequence.yaml", "rgb.txt", "depth.txt", "associations.txt", "groundtruth.txt", "camera.yaml", "calibration.yaml"
)  # fmt: skip


@dataclass(frozen=True)
class Job:
    """One cell to run; plain enough to be sent to another process that sees the same files.

    data: the sequence's folder. frames [first, last). method: a variant (`variants`), `options` those of it; a peer;
    or another tracker, with `estimate` (a run folder or TUM file) or `command` (as in `run_command`). out: the cell's
    run folder. key: what the trajectory depends on. truth_offset: of the truth's clock, see
    `run_evaluate.evaluate_clocks`. noise: added to the images that are read; a command does not see it.
    """

    sequence: str
    method: str
    data: Path
    first: int
    last: int
    options: Options
    estimate: Path | None
    out: Path
    key: str
    truth_offset: TruthOffset | None = None
    command: str = ""
    noise: Noise | None = None


@dataclass(frozen=True)
class SequenceInfo:
    """A sequence of the grid; frames: how many of it are used."""

    name: str
    group: str
    path: Path
    frames: int


@dataclass(frozen=True)
class Plan:
    """All cells, row by row."""

    sequences: tuple[SequenceInfo, ...]
    methods: tuple[str, ...]
    jobs: tuple[Job, ...]
    out: Path


def make_plan(
    choice: Choice, data: Path, out: Path, options: Options | None = None, added: Mapping[str, Path] | None = None,
    truth_offset: TruthOffset | None = None, commands: Mapping[str, str] | None = None,
) -> Plan:  # fmt: skip
    """Look the sequences up and list the cells.

    Each of our methods is run with and without fusion, unless `options.fuse` says which.

    data: folder with a folder for each sequence. added: other trackers by name, each a folder with SEQUENCE.txt (TUM)
    or SEQUENCE/ (a run folder) inside. commands: others by name, run here. truth_offset: as in `Job`. Raises
    UserError, one line, if sequences are missing or not whole, saying how to make them.
    """
    options, added, commands = options or Options(), added or {}, commands or {}
    for option, name in (*(("--add", name) for name in added), *(("--peer-command", name) for name in commands)):
        if name in choice.methods or name in METHODS or (option == "--peer-command" and name in added):
            raise UserError(f"{option} {name}=...: there is a method of that name: choose another name")
    missing = [entry for entry in choice.sequences if not (data / entry.name).is_dir()]
    if missing:
        how = "; ".join(_render_command(entry, data, choice) for entry in missing)
        names = ", ".join(entry.name for entry in missing)
        raise UserError(f"{data}: has no {names}: leave them out with --sequence, or make them: {how}")
    sequences: list[SequenceInfo] = []
    jobs: list[Job] = []
    methods = (*(name for method in choice.methods for name in variants(method, options.fuse)), *added, *commands)
    for entry in choice.sequences:
        dataset = open_dataset(data / entry.name)
        if truth_of(dataset) is None:
            raise UserError(f"{dataset.root}: has no ground truth to compare with: leave it out with --sequence")
        chosen = _chosen(dataset, entry, data, choice)
        sequences.append(SequenceInfo(entry.name, entry.group, (data / entry.name).resolve(), len(chosen)))
        digest = sequence_digest(data / entry.name)
        for method in methods:
            cell_out = (out / "cells" / entry.name / folder_of(method)).resolve()
            job = Job(
                entry.name, method, sequences[-1].path, chosen.start, chosen.stop, options,
                _estimate_path(added[method], entry.name) if method in added else None, cell_out, "", truth_offset,
                commands.get(method, ""),
            )  # fmt: skip
            jobs.append(keyed(job, digest))
    return Plan(tuple(sequences), methods, tuple(jobs), out)


def keyed(job: Job, digest: str) -> Job:
    """A job with its variant's options and its key; digest: of its sequence, see `sequence_digest`."""
    used = None
    if method_of(job.method) in METHODS:
        asked = {"method": method_of(job.method), "fuse": fuses(job.method)}
        used = Options(**dataclasses.asdict(job.options) | asked)
    depends = [digest, job.method, job.first, job.last, used and dataclasses.asdict(used), package_version()]
    depends.append(_file_digest(job.estimate) if job.estimate is not None else None)
    depends += [job.command] if job.command else []
    depends += [dataclasses.asdict(job.noise)] if job.noise is not None else []
    key = hashlib.sha256(json.dumps(depends, sort_keys=True).encode()).hexdigest()
    return dataclasses.replace(job, options=used or job.options, key=key)


def sequence_digest(root: Path) -> str:
    """Of what describes a sequence: its lists, cameras and truth, not its images."""
    return ",".join(f"{name} {_file_digest(root / name)}" for name in _DESCRIPTIONS if (root / name).is_file())


def package_version() -> str:
    """Of this project."""
    return version("rolling-shutter-rgbd")


# ---------------------------------------------------------------------------------------------------------------------


def _render_command(entry: SequenceEntry, data: Path, choice: Choice) -> str:
    frames = "" if choice.last is None else f" --frames {choice.first}:{choice.last}"
    return f"rsgen render {entry.config} --out {data / entry.name}{frames}"


def _chosen(dataset: Dataset, entry: SequenceEntry, data: Path, choice: Choice) -> range:
    chosen = range(len(dataset))[choice.first : choice.last]
    if dataset.sequence is not None and (choice.last is None or choice.last > len(dataset)):
        there, in_all = min((len(s.paths), s.frames) for s in dataset.sequence.streams.values())
        if there < in_all:
            command = _render_command(entry, data, choice)
            raise UserError(
                f"{dataset.root}: {there} of {in_all} frames are rendered: finish it with '{command}', leave it out "
                f"with --sequence, or track what there is with --frames 0:{there}"
            )
    if not len(chosen):
        raise UserError(f"{dataset.root}: has no frame {choice.first}: its frames are 0 to {len(dataset) - 1}")
    return chosen


def _estimate_path(folder: Path, sequence: str) -> Path:
    file, run = folder / f"{sequence}.txt", folder / sequence
    return (run if run.is_dir() and not file.is_file() else file).resolve()


def _file_digest(path: Path) -> str | None:
    file = path / TRAJECTORY if path.is_dir() else path
    try:
        return hashlib.sha256(file.read_bytes()).hexdigest()
    except OSError:
        return None
