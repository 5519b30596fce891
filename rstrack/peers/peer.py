"""What the peers, trackers of others, have in common; and any tracker as a peer.

That is a command which reads a sequence's folder and writes a TUM trajectory:

estimate = run_command("mine", "mytracker {sequence} --out {out}", Path("out/table1"), Path("out/bench/mine"))
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from rsgen.console.progress import Progress
from rsgen.errors import UserError
from rsgen.files import write_error
from rstrack.data.dataset import Dataset
from rstrack.data.estimate import Estimate, read_estimate
from rstrack.data.image_files import prefetched

Input = TypeVar("Input")
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
    # All at once: what is filled in is not looked at again.
    words = [re.sub("|".join(PLACES), lambda place: given[place[0]], word) for word in words_of(command)]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        out.unlink(missing_ok=True)
        failure = run_logged(words, log, folder)
    except (FileNotFoundError, PermissionError) as error:
        if error.filename == words[0]:
            raise UserError(f"{name}: cannot run '{words[0]}' ({error.strerror}): give its path") from None
        raise write_error(folder, error) from None
    except OSError as error:
        raise write_error(folder, error) from None
    if failure:
        raise UserError(f"{name}: {failure} (all of it is in {log})")
    if not out.is_file():
        raise UserError(f"{name}: wrote no {out}: its command is to write a TUM trajectory to {{out}} (see {log})")
    return read_estimate(out)


def run_logged(words: Sequence[str], log: Path, folder: Path | None = None) -> str:
    """Run a command, what it prints goes to `log`: how it failed, with its last line; empty if it did not."""
    with log.open("wb") as file:
        done = subprocess.run(words, cwd=folder, stdout=file, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL)
    lines = [line.strip() for line in log.read_text(errors="replace").split("\n") if line.strip()]
    last = lines[-1][:200] if lines else "it printed nothing"
    return f"ended with status {done.returncode}: {last}" if done.returncode else ""


def timed_frames(
    name: str, chosen: range, read: Callable[[int], Input], feed: Callable[[int, Input], object], progress: Progress
) -> list[float]:
    """Feed frames, read ahead in threads of their own; the seconds that each feeding took."""
    seconds: list[float] = []
    begin = time.perf_counter()
    for k, given in zip(chosen, prefetched(read, chosen, 2), strict=True):
        start = time.perf_counter()
        feed(k, given)
        seconds.append(time.perf_counter() - start)
        rate = len(seconds) / (time.perf_counter() - begin)
        progress("tracking", len(seconds) / len(chosen), f"{rate:.1f} frames/s, {name}")
    return seconds


def readout_s(dataset: Dataset, part: float) -> float:
    """Seconds from a depth frame's stamp to the middle exposure of its last line (part 1), or a part of the way."""
    camera, shutter = dataset.rig.depth_camera, dataset.rig.depth_shutter
    return float(shutter.line_mid_time(0.0, part * (shutter.line_count(camera) - 1), camera))


def run_info(
    name: str, versions: Mapping[str, str], backend: str, dataset: Dataset, chosen: range, begin: float,
    seconds: Sequence[float],
) -> dict[str, Any]:  # fmt: skip
    """What run.json holds of frames `chosen`, begun at `begin` (of time.perf_counter), which took `seconds` each.

    Keyframes, lost and frames are the peer's own.
    """
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
            "total_s": time.perf_counter() - begin,
            "median_ms": float(np.median(ms)),
            "mean_ms": float(ms.mean()),
            "p95_ms": float(np.percentile(ms, 95)),
            "frame_ms": np.round(ms, 3),
        },
    }
