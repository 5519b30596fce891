"""Reads every hostile file in a process of its own, whose memory is bounded, and says what came of each, as JSON lines.

python hostile_worker.py FOLDER quick|all GROUP...     with tests/support on the path; see tests/test_hostile_files.py
"""

from __future__ import annotations

import contextlib
import json
import resource
import shutil
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import hostile_bags
import hostile_cases
import hostile_folders
import hostile_phones
import hostile_scenes
import hostile_sequences
import hostile_usd

from rsgen.errors import UserError

GROUPS: dict[str, Callable[[Path], Iterator[hostile_cases.Case]]] = {
    "bags": hostile_bags.bags,
    "phones": hostile_phones.phones,
    "folders": hostile_folders.folders,
    "sequences": hostile_sequences.sequences,
    "trajectories": hostile_sequences.trajectories,
    "configs": hostile_sequences.configs,
    "scenes": hostile_scenes.scenes,
    "usd": hostile_usd.usd,
}
_MOST_ADDRESSES = 12 << 30  # what stops a reader that would take all memory of the machine
_CANARY = "a canary that belongs to nobody's recording"


def _listing(folder: Path) -> dict[str, tuple[int, int]]:
    found = {}
    for path in folder.rglob("*"):
        stat = path.lstat()
        found[path.relative_to(folder).as_posix()] = (stat.st_size, stat.st_mtime_ns)
    return {name: about for name, about in found.items() if not (folder / name).is_dir()}


def _run(case: hostile_cases.Case, folder: Path) -> dict[str, Any]:
    place, beside = folder / "place", folder / "beside"
    shutil.rmtree(folder, ignore_errors=True)
    for made in (place, beside):
        made.mkdir(parents=True)
    (beside / "secret.txt").write_text(_CANARY)
    path = case.write(place)
    before, begin, kept = _listing(folder), time.process_time(), ""
    out = beside / "out"
    try:
        case.read(path, out)
        kind, said = "read", ""
    except UserError as error:
        kind, said = "refused", str(error)
    except BaseException:
        kind, said = "raised", traceback.format_exc()
    seconds = time.process_time() - begin
    if kind == "read" and out.exists():
        if any(_CANARY.encode() in file.read_bytes() for file in out.rglob("*") if file.is_file()):
            kept = "what is outside the recording was copied"
        shutil.rmtree(out)
    after = _listing(folder)
    changed = sorted(name for name in before.keys() | after.keys() if before.get(name) != after.get(name))
    return {
        "group": case.group, "name": case.name, "must_refuse": case.must_refuse, "kind": kind, "said": said,
        "path": str(path), "changed": changed, "leaked": kept, "seconds": seconds,
        "peak_kb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
    }  # fmt: skip


# Of damages that may be harmless, a quick run has every so manieth; what has to be refused it has all.
_EVERY = 8


def main(folder: Path, is_quick: bool, groups: list[str]) -> None:
    warnings.simplefilter("error")
    hostile_cases.prepare()
    resource.setrlimit(resource.RLIMIT_AS, (_MOST_ADDRESSES, _MOST_ADDRESSES))
    with contextlib.redirect_stdout(sys.stderr):
        cases = [case for group in groups for case in GROUPS[group](folder / group)]
    for k, case in enumerate(cases):
        if is_quick and k % _EVERY and not (case.must_refuse or case.name.endswith("as it is")):
            continue
        print(json.dumps(_run(case, folder / "one")), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2] == "quick", sys.argv[3:])
