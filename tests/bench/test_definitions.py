"""Definitions of benchmarks: what cells they make, what those depend on, and what is refused in one line."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import yaml

from rsgen.errors import UserError
from rstrack.bench.cells import CaseEntry, Cell, MethodEntry, SequenceEntry, load_benchmark
from rstrack.bench.changes import CHANGES

BASE: dict[str, Any] = {
    "sequences": {"demo": {"config": "demo", "group": "all"}, "desk": {"path": "tum/desk"}},
    "cases": {"demo-dark": {"sequence": "demo", "frames": "5:20", "changes": [{"darkened": {"factor": 0.5}}]}},
    "methods": {"slow": {"method": "rs-pg", "options": {"knot_spacing_s": 0.05}}},
    "cells": [{"cases": ["demo*"], "methods": ["rs-pg", "slow", "kiss-icp"], "seeds": 2}],
}


FAMILY: dict[str, Any] = {
    "cases": {
        "demo-dark": {"frames": ["0:", "7:20"], "but": {"wide": [{"camera_told": {"cx_px": 2.5}}]}},
        "desk": {"frames": [":9"], "but": {"wide": None}},
    },
    "perturbations": {"as_told": [], "wide": [{"camera_told": {"cx_px": 5.0}}]},
}


def write(folder: Path, name: str = "a.yaml", **changes: Any) -> Path:
    path = folder / name
    path.write_text(yaml.safe_dump(BASE | changes))
    return path


def test_cells_are_all_methods_on_all_cases(tmp_path: Path) -> None:
    cells = {cell.name: cell for cell in load_benchmark([write(tmp_path)]).cells}
    assert list(cells) == [f"track/{case}/{m}" for case in ("demo", "demo-dark") for m in ("rs-pg", "slow", "kiss-icp")]
    slow, peer = cells["track/demo-dark/slow"], cells["track/demo/kiss-icp"]
    assert (slow.seeds, slow.frames, slow.group) == ((0, 1), slice(5, 20), "all")
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


def test_a_family_is_every_perturbation_of_every_piece(tmp_path: Path) -> None:
    cells = [{"cases": ["cliff-*"], "methods": ["rs-pg"]}]
    made = load_benchmark([write(tmp_path, families={"cliff": FAMILY}, cells=cells)]).cells
    assert [(cell.case, cell.frames) for cell in made] == [
        ("cliff-demo-dark-as_told-from_0", slice(0, None)),
        ("cliff-demo-dark-as_told-from_7", slice(7, 20)),
        ("cliff-demo-dark-wide-from_0", slice(0, None)),
        ("cliff-demo-dark-wide-from_7", slice(7, 20)),
        ("cliff-desk-as_told-from_0", slice(None, 9)),
    ]
    # The case's own changes come first; everything else of it stays, but for the group.
    dark, wide = {"darkened": {"factor": 0.5}}, {"camera_told": {"cx_px": 2.5}}
    assert [cell.case_entry.changes for cell in made] == [(dark,), (dark,), (dark, wide), (dark, wide), ()]
    assert {cell.group for cell in made} == {"cliff"} and made[0].case_entry.sequence == "demo"
    # Cases of later files are none of the family's.
    later = tmp_path / "later.yaml"
    later.write_text(yaml.safe_dump({"cases": {"demo-dark": {"sequence": "desk"}}}))
    first = tmp_path / "a.yaml"
    assert load_benchmark([first, later]).cells == load_benchmark([first]).cells


def test_cells_that_are_drawn(tmp_path: Path) -> None:
    def drawn(names: list[str], **how: int) -> list[str]:
        cells = [{"cases": names, "methods": ["rs-pg", "rs-g"]} | how]
        sequences = {f"s{k}": {"path": f"s{k}"} for k in range(20)}
        return [
            cell.name for cell in load_benchmark([write(tmp_path, sequences=sequences, cases={}, cells=cells)]).cells
        ]

    every = drawn(["s*"])
    some = drawn(["s*"], draw=24)
    assert len(every) == 40 and len(set(some)) == 24 and some == [name for name in every if name in some]
    assert drawn(["s*"], draw=24) == some == drawn(["s*"], draw=24, draw_seed=0) != drawn(["s*"], draw=24, draw_seed=1)
    assert set(drawn(["s1?", "s?"], draw=24)) == set(some)  # whatever order the cells are in
    assert drawn(["s*"], draw=40) == every
    # By chance: none of the cells is always kept, none never.
    times = [sum(name in drawn(["s*"], draw=10, draw_seed=seed) for seed in range(40)) for name in every[:2]]
    assert all(1 <= count <= 25 for count in times)


def test_the_cliff_test_is_whole_in_the_full_tier_and_drawn_in_the_gate() -> None:
    root = Path(__file__).parents[2] / "benchmarks"
    full, gate = (
        [
            cell
            for cell in load_benchmark([root / "cases.yaml", root / f"{tier}.yaml"]).cells
            if (cell.group, cell.measure) == ("cliff", "track")
        ]
        for tier in ("full", "gate")
    )
    assert len(gate) == 24 + 4 and {cell.name for cell in gate} < {cell.name for cell in full}
    # The same in both, so that records of either can be shown.
    assert all(cell == next(other for other in full if other.name == cell.name) for cell in gate)
    pieces = Counter((cell.case_entry.sequence, repr(cell.case_entry.changes)) for cell in full)
    assert set(pieces.values()) == {3}  # begun at three frames, no two perturbations of a sequence alike
    assert len({sequence for sequence, changes in pieces if changes == "()"}) == 8
    for cell in full:
        told = [change.get("camera_told", {}) for change in cell.case_entry.changes]
        at_320 = cell.case_entry.sequence in ("demo", "table1-320", "robot_r2-320", "wild2-320")
        assert all(
            abs(one[name]) == (2.5 if at_320 else 5.0) for one in told for name in one if name in ("cx_px", "cy_px")
        )
        assert all(change.keys() <= CHANGES.keys() for change in cell.case_entry.changes)


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
        ({"families": {"f": {"cases": {}, "perturbations": {"a": []}}}}, "families.f.cases"),
        ({"families": {"f": FAMILY | {"perturbations": {}}}}, "families.f.perturbations"),
        ({"families": {"f": FAMILY | {"cases": {"demo": {"frames": []}}}}}, "families.f.cases.demo.frames"),
        ({"families": {"f": FAMILY | {"cases": {"demo": {"frames": ["all"]}}}}}, "families.f.cases.demo.frames.0"),
        ({"families": {"f": FAMILY | {"cases": {"nope": {"frames": ["0:"]}}}}}, "family f: no case or sequence 'nope'"),
        (
            {"families": {"f": FAMILY | {"cases": {"demo": {"frames": ["0:"], "but": {"tall": None}}}}}},
            "family f: demo: no perturbation 'tall'",
        ),
        (
            {"families": {"f": FAMILY | {"cases": {"demo": {"frames": [":5", "0:9"]}}}}},
            "family f: f-demo-as_told-from_0 is there twice",
        ),
        ({"cells": [{"cases": ["demo"], "methods": ["rs-g"], "draw": 0}]}, "cells.0.draw"),
        ({"cells": [{"cases": ["demo*"], "methods": ["rs-g"], "draw": 3}]}, "cells: draw: 3 of 2 cells"),
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
