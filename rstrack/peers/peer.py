"""Any tracker as a peer: a command that reads a sequence's folder and writes a TUM trajectory.

estimate = run_command("mine", "mytracker {sequence} --out {out}", Path("out/table1"), Path("out/bench/mine"))
"""

from __future__ import annotations

import os
import shlex
import subprocess
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.errors import UserError
from rsgen.files import write_error
from rstrack.data.dataset import Dataset
from rstrack.data.estimate import Estimate, read_estimate

PLACES = ("{sequence}", "{out}")
"""What a command has to name: the sequence's folder, and the TUM file (T_world_depth at depth stamps) to write."""


def words_of(command: str) -> list[str]:
    """The command's words, as a shell would part them. Raises UserError: quotes left open, or a place not named."""
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise UserError(f"peer command '{command}': {error}") from None
    for place in PLACES:
        if not any(place in word for word in words[1:]):
            raise UserError(f"peer command '{command}': does not say {place}, as does 'mytracker {' '.join(PLACES)}'")
    return words


def run_command(name: str, command: str, sequence: Path, folder: Path) -> Estimate:
    """Run a command, by no shell, in `folder` (made if need be): its poses. What it prints goes to command.log there.

    Raises UserError: it cannot be started, fails, or writes no trajectory that can be read.
    """
    folder = folder.resolve()
    out, log = folder / "command.txt", folder / "command.log"
    given = dict(zip(PLACES, (str(sequence.resolve()), str(out)), strict=True))
    words = [_filled(word, given) for word in words_of(command)]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        out.unlink(missing_ok=True)
        with log.open("wb") as file:
            status = subprocess.run(words, cwd=folder, stdout=file, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL)
    except (FileNotFoundError, PermissionError) as error:
        if error.filename == words[0]:
            raise UserError(f"{name}: cannot run '{words[0]}' ({error.strerror}): give its path") from None
        raise write_error(folder, error) from None
    except OSError as error:
        raise write_error(folder, error) from None
    if status.returncode:
        lines = log.read_text(errors="replace").split("\n")
        last = next((line.strip() for line in reversed(lines) if line.strip()), "it said nothing")
        raise UserError(f"{name}: ended with status {status.returncode}: {last[:200]} (all of it is in {log})")
    if not out.is_file():
        raise UserError(f"{name}: wrote no {out}: its command is to write a TUM trajectory to {{out}} (see {log})")
    return read_estimate(out)


def _filled(word: str, given: dict[str, str]) -> str:
    for place, path in given.items():
        word = word.replace(place, path)
    return word


def run_info(
    name: str, versions: Mapping[str, str], backend: str, dataset: Dataset, chosen: range, total_s: float,
    seconds: Sequence[float],
) -> dict[str, Any]:  # fmt: skip
    """Of frames `chosen` of a dataset, which took `seconds` each; keyframes, lost and frames are the peer's own."""
    ms = 1e3 * np.array(seconds)
    return {
        "method": name,
        "versions": {"rstrack": version("rolling-shutter-rgbd"), **versions},
        "backend": backend,
        "machine": {"cpu_count": os.cpu_count()},
        "dataset": {"name": dataset.name, "frames": [chosen.start, chosen.stop], "frames_in_all": len(dataset)},
        "end": "done",
        "error": None,
        "timings": {
            "total_s": total_s,
            "median_ms": float(np.median(ms)),
            "mean_ms": float(ms.mean()),
            "p95_ms": float(np.percentile(ms, 95)),
            "frame_ms": np.round(ms, 3),
        },
    }
