"""Definitions of benchmarks: what cells they make, what those depend on, and what is refused in one line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from rsgen.errors import UserError
from rstrack.bench.definitions import CaseEntry, Cell, MethodEntry, SequenceEntry, frames_of, load_benchmark

BASE: dict[str, Any] = {
    "sequences": {"demo": {"config": "demo", "group": "all"}, "desk": {"path": "tum/desk"}},
    "cases": {"demo-dark": {"sequence": "demo", "frames": "5:20", "changes": [{"darkened": {"factor": 0.5}}]}},
    "methods": {"slow": {"method": "rs-pg", "options": {"knot_spacing_s": 0.05}}},
    "cells": [{"cases": ["demo*"], "methods": ["rs-pg", "slow", "kiss-icp"], "seeds": 2}],
}


def write(folder: Path, name: str = "a.yaml", **changes: Any) -> Path:
    path = folder / name
    path.write_text(yaml.safe_dump(BASE | changes))
    return path


def test_cells_are_all_methods_on_all_cases(tmp_path: Path) -> None:
    cells = {cell.name: cell for cell in load_benchmark([write(tmp_path)]).cells}
    assert list(cells) == [f"track/{case}/{m}" for case in ("demo", "demo-dark") for m in ("rs-pg", "slow", "kiss-icp")]
    slow, peer = cells["track/demo-dark/slow"], cells["track/demo/kiss-icp"]
    assert (slow.seeds, slow.piece, slow.group) == ((0, 1), slice(5, 20), "all")
    assert (slow.program, slow.is_ours) == ("rs-pg", True)
    assert (slow.options.method, slow.options.knot_spacing_s) == ("rs-pg", 0.05)
    assert (peer.program, peer.is_ours) == ("kiss-icp", False)
    assert slow.as_dict()["case"] == {
        "sequence": "demo", "frames": "5:20", "changes": ({"darkened": {"factor": 0.5}},),
    }  # fmt: skip


def test_later_files_are_on_top_and_files_are_beside_what_names_them(tmp_path: Path) -> None:
    more = tmp_path / "more"
    more.mkdir()
    sequences = {"demo": {"config": "mine.yaml"}}
    second = more / "b.yaml"
    second.write_text(
        yaml.safe_dump({"sequences": sequences, "cases": {"c": {"sequence": "desk", "camera": "c.yaml"}}})
    )
    (first, *_) = load_benchmark([write(tmp_path), second]).cells
    assert first.sequence.config == more / "mine.yaml"
    second.write_text(
        yaml.safe_dump({**yaml.safe_load(second.read_text()), "cells": [{"cases": ["c"], "methods": ["rs-g"]}]})
    )
    assert load_benchmark([write(tmp_path), second]).cells[-1].case_entry.camera == more / "c.yaml"


def test_only_some_cells(tmp_path: Path) -> None:
    benchmark = load_benchmark([write(tmp_path)])
    assert [c.name for c in benchmark.only(["*dark/slow"]).cells] == ["track/demo-dark/slow"]
    assert benchmark.only([]).cells == benchmark.cells
    with pytest.raises(UserError, match=r"^--only nothing: no cell has such a name[^\n]*$"):
        benchmark.only(["nothing"])


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"cells": [{"cases": ["nope"], "methods": ["rs-g"]}]}, "no case or sequence 'nope'"),
        ({"cells": [{"cases": ["demo"], "methods": ["nope"]}]}, "no method 'nope'"),
        (
            {"cases": {"c": {"sequence": "nope"}}, "cells": [{"cases": ["c"], "methods": ["rs-g"]}]},
            "no sequence 'nope'",
        ),
        ({"cells": 2 * [{"cases": ["demo"], "methods": ["rs-g"]}]}, "track/demo/rs-g is there twice"),
        ({"sequences": {"demo": {}}}, "sequences.demo"),
        ({"sequences": {"demo": {"config": "demo", "path": "x"}}}, "sequences.demo"),
        ({"sequences": {"../x": {"config": "demo"}}}, "sequences"),
        ({"sequences": {"demo": {"config": "demo", "width": 3}}}, "sequences.demo.width"),
        ({"cases": {"c": {"sequence": "demo", "frames": "all"}}}, "cases.c.frames"),
        ({"cases": {"c": {"sequence": "demo", "truth_noise": [2]}}}, "cases.c.truth_noise"),
        ({"cases": {"c": {"sequence": "demo", "truth_noise": [2, -1]}}}, "cases.c.truth_noise"),
        ({"cases": {"c": {"sequence": "demo", "truth_extrinsics": "some"}}}, "cases.c.truth_extrinsics"),
        ({"cells": [{"cases": ["demo"], "methods": ["rs-g"], "seeds": 0}]}, "cells.0.seeds"),
        ({"extra": 1}, "extra"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(tmp_path: Path, change: dict[str, Any], told: str) -> None:
    with pytest.raises(UserError) as error:
        load_benchmark([write(tmp_path, **change)])
    assert told in str(error.value) and "\n" not in str(error.value)


def test_unknown_options_are_said_in_one_line() -> None:
    how = MethodEntry(method="rs-g", options={"speed": 3})
    cell = Cell("track", "a", "mine", (0,), CaseEntry(sequence="a"), SequenceEntry(path=Path("a")), how, {})
    with pytest.raises(UserError, match=r"^method mine: .*'speed'$"):
        _ = cell.options


@pytest.mark.parametrize(
    ("text", "found"), [(None, slice(None)), ("3:9", slice(3, 9)), (":9", slice(None, 9)), ("3:", slice(3, None))]
)
def test_frames(text: str | None, found: slice) -> None:
    assert frames_of(text) == found
