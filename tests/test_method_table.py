"""docs/method.md's table of equations and functions is true: each function is there and names its equations."""

from __future__ import annotations

import ast
import inspect
import io
import pkgutil
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = sorted(path for package in ("rsgen", "rstrack") for path in (ROOT / package).rglob("*.py"))
PAPERS = {3, 4, 5, 6, 8, 11, 12, 13, 14, 15}

# "equation (3)", "equations (4) and (5)", "equations (6)/(15)"
NAMED = re.compile(r"[Ee]quations?\s+(\(\d+\)(?:(?:,\s|\sand\s|/|,\sand\s)\(\d+\))*)")


def numbers(text: str) -> set[int]:
    return {int(number) for number in re.findall(r"\((\d+)\)", text)}


def table() -> list[tuple[set[int], list[str]]]:
    """Equations and functions of each row."""
    text = (ROOT / "docs/method.md").read_text().partition("## Equation and function")[2].partition("\n## ")[0]
    rows = [line.strip("|").split("|") for line in text.splitlines() if line.startswith("| (")]
    assert all(len(row) == 4 for row in rows), "a cell holds a bar"
    return [(numbers(row[0]), re.findall(r"`([\w.]+)`", row[2])) for row in rows]


def mentioned(path: Path) -> Iterator[int]:
    """Equations that a file names: '(n)' in comments, 'equation (n)' in any text."""
    text = path.read_text()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            yield from numbers(" ".join(re.findall(r"(?<![\w)\]])\(\d{1,2}\)", token.string)))
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            for found in NAMED.findall(node.value):
                yield from numbers(found)


def test_the_table_has_the_papers_equations() -> None:
    assert set().union(*(equations for equations, _ in table())) == PAPERS


@pytest.mark.parametrize(("equations", "functions"), table(), ids=lambda value: str(value))
def test_functions_name_their_equations(equations: set[int], functions: list[str]) -> None:
    assert functions
    for name in functions:
        assert equations <= numbers(inspect.getsource(pkgutil.resolve_name(name))), name


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_equations_of_the_source_have_a_row(path: Path) -> None:
    assert set(mentioned(path)) <= PAPERS
