"""Damaged and hostile files through every reader: one line or a right reading, and memory is bounded. Nightly: all.

They are read in a process of its own, whose memory is measured, and limited in case a reader would take all there is.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hostile_worker
import pytest
from nightly import QUICK_OR_ALL

WORKER = Path(hostile_worker.__file__)
# Files claim up to 200 GB and unpack to 3; a packed chunk of a bag may have 128 MB, and is there twice for a moment.
MOST_GROWTH_KB = 400_000
MOST_SECONDS = 5.0
LEAST = {
    "bags": 110,
    "phones": 110,
    "folders": 130,
    "sequences": 100,
    "trajectories": 35,
    "configs": 18,
    "scenes": 100,
    "usd": 60,
}


@dataclass(frozen=True)
class Outcome:
    """What came of one case: kind is read, refused or raised; said its one line, or the traceback."""

    group: str
    name: str
    must_refuse: bool
    kind: str
    said: str
    path: str
    changed: list[str]
    leaked: str
    seconds: float
    peak_kb: int


@pytest.fixture(scope="module", params=QUICK_OR_ALL)
def is_quick(request: pytest.FixtureRequest) -> bool:
    return bool(request.param)


@pytest.fixture(scope="module")
def outcomes(is_quick: bool, tmp_path_factory: pytest.TempPathFactory) -> list[Outcome]:
    folder, temporary = tmp_path_factory.mktemp("hostile"), tmp_path_factory.mktemp("temporary")
    places = os.pathsep.join([str(WORKER.parent), str(WORKER.parents[2])])
    environment = os.environ | {"TMPDIR": str(temporary), "PYTHONPATH": places}
    words = [sys.executable, str(WORKER), str(folder), "quick" if is_quick else "all", *hostile_worker.GROUPS]
    child = subprocess.run(words, capture_output=True, text=True, env=environment, timeout=900, check=False)
    rows: list[dict[str, Any]] = [json.loads(line) for line in child.stdout.splitlines()]
    assert child.returncode == 0, (rows[-1:], child.stderr[-2000:])
    assert "Traceback" not in child.stderr, child.stderr[-2000:]
    assert [path.name for path in temporary.iterdir()] == []
    return [Outcome(**row) for row in rows]


def test_there_are_many_of_every_kind(is_quick: bool, outcomes: list[Outcome]) -> None:
    counts = Counter(outcome.group for outcome in outcomes)
    print(dict(counts), len(outcomes), "in all;", Counter(outcome.kind for outcome in outcomes))
    names = Counter((outcome.group, outcome.name) for outcome in outcomes)
    assert names.most_common(1)[0][1] == 1 and len(outcomes) >= (200 if is_quick else 700), names.most_common(3)
    assert all(counts[group] >= (5 if is_quick else least) for group, least in LEAST.items()), counts


@pytest.mark.parametrize("group", LEAST)
def test_each_is_read_or_refused_in_one_line(group: str, outcomes: list[Outcome]) -> None:
    for outcome in (outcome for outcome in outcomes if outcome.group == group):
        what = f"{outcome.name}: {outcome.kind}: {outcome.said}"
        assert outcome.kind in ("read", "refused"), what
        assert outcome.kind == "refused" or not outcome.must_refuse, what
        assert outcome.kind == "read" or not outcome.name.endswith("as it is"), what
        if outcome.kind == "refused":
            assert outcome.said.isprintable() and Path(outcome.path).name in outcome.said, what
        assert outcome.changed == [] and outcome.leaked == "", what
        assert outcome.seconds < MOST_SECONDS, what


def test_memory_is_bounded(outcomes: list[Outcome]) -> None:
    peaks = [outcome.peak_kb for outcome in outcomes]
    steps = [(b - a, outcome.name) for a, b, outcome in zip(peaks, peaks[1:], outcomes[1:], strict=False)]
    assert peaks[-1] - peaks[0] < MOST_GROWTH_KB, max(steps)
