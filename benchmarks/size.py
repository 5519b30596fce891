"""The measure `size`: lines, modules and module constants of the product by wing, so that growth is seen.

It is a cell of the gate, `size/product/-`, which nothing is tracked for. It is shown and compared, and never judged.
"""

from __future__ import annotations

import ast
import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

from rsgen.console.tables import Entry, Table
from rstrack.bench.record import CellRecord, Figures, stamped

CELL = "size/product/-"
PACKAGES = ("rsgen", "rstrack", "benchmarks", "scenes")
WHAT = ("lines", "modules", "constants")
_CONSTANT = re.compile(r"_?[A-Z][A-Z0-9_]*")


def size_record(root: Path) -> CellRecord:
    """The size of the packages in a checkout, as a record of one run: WHAT in all, and WHAT_WING of each wing."""
    total, figures = Counter[str](), Counter[str]()
    for package in PACKAGES:
        for path in (root / package).rglob("*.py"):
            parts = path.relative_to(root).parts
            text = path.read_text("utf-8")
            found = (text.count("\n"), 1, constants(text))
            for what, count in zip(WHAT, found, strict=True):
                total[what] += count
                figures[f"{what}_{'.'.join(parts[: max(1, min(2, len(parts) - 1))])}"] += count
    run: Figures = {name: float(count) for name, count in (*total.items(), *sorted(figures.items()))}
    settings = {"case": {"sequence": "product"}, "method": {}, "settings": {}, "group": ""}
    return CellRecord(
        **stamped({"cell": CELL, "key": "", "settings": settings}), seeds=(0,), runs=(run,), complete=True
    )


def constants(text: str) -> int:
    """How many names in capitals a module's source assigns at its top level."""
    names: list[ast.expr] = []
    for node in ast.parse(text).body:
        targets = (
            node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        )
        for target in targets:
            names += target.elts if isinstance(target, ast.Tuple) else [target]
    return sum(isinstance(name, ast.Name) and _CONSTANT.fullmatch(name.id) is not None for name in names)


def size_table(record: CellRecord) -> Table:
    """A row for each package, with its wings beside it, and one for all."""
    figures = record.figures
    wings = [name.partition("_")[2] for name in figures if name.startswith(f"{WHAT[0]}_")]
    rows: list[tuple[Entry | str, ...]] = []
    for package in PACKAGES:
        own = [wing for wing in wings if wing.partition(".")[0] == package]
        parts = [f"{wing.partition('.')[2] or 'itself'} {figures[f'{WHAT[0]}_{wing}']:.0f}" for wing in own]
        sums = [sum(figures[f"{what}_{wing}"] for wing in own) for what in WHAT]
        rows.append((package, *(f"{count:.0f}" for count in sums), ", ".join(parts)))
    rows.append(("all", *(f"{figures[what]:.0f}" for what in WHAT), ""))
    return Table(("package", *WHAT, "lines of each wing"), tuple(rows), words=(0, len(WHAT) + 1))


def size_changes(old: Mapping[str, CellRecord], new: Mapping[str, CellRecord]) -> tuple[str, ...]:
    """What changed from one record to another, a line for all and one for each wing; empty where one is missing."""
    if CELL not in old or CELL not in new:
        return ()
    before, after = old[CELL].figures, new[CELL].figures
    lines = []
    for wing in ("", *dict.fromkeys(name.partition("_")[2] for name in (*before, *after) if "_" in name)):
        names = [f"{what}_{wing}".rstrip("_") for what in WHAT]
        pairs = [(before.get(name, 0.0), after.get(name, 0.0)) for name in names]
        if any(a != b for a, b in pairs):
            parts = (f"{what} {a:.0f} -> {b:.0f}" for what, (a, b) in zip(WHAT, pairs, strict=True) if a != b)
            lines.append(f"  {wing or 'all'}: {', '.join(parts)}")
    return ("size, shown and not judged:", *lines) if lines else ()
