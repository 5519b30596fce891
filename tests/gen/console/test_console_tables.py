"""Tables as text, Markdown and CSV."""

from __future__ import annotations

import csv
import io
import math

import pytest

from rsgen.console.tables import Entry, Table, best_marked, csv_text, fixed, significant

TABLE = Table(
    ("method", "a, mm", "why"),
    ((Entry("rs-g", note="paper: RS"), Entry("1.00", "†", "12.9", is_best=True), "x"), ("longer", "-", "a word")),
    words=(0, 2),
)


def test_columns_line_up_and_notes_have_their_own_line() -> None:
    assert TABLE.text().splitlines() == [
        "method       a, mm  why", "rs-g         1.00†  x", "  paper: RS   12.9", "longer           -  a word",
    ]  # fmt: skip


def test_markdown_has_the_best_in_bold_and_notes_in_brackets() -> None:
    assert TABLE.markdown().splitlines() == [
        "| method | a, mm | why |", "| --- | ---: | --- |", "| `rs-g` | **1.00†** (12.9) | x |",
        "| `longer` | - | a word |",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0001234, "0.000123"), (12.345, "12.3"), (1266.9, "1267"), (0.0, "0"), (None, "-"), (math.nan, "-")],
)
def test_three_significant_digits_without_an_exponent(value: float | None, text: str) -> None:
    assert significant(value) == text


def test_fixed_digits() -> None:
    assert [fixed(0.0012, 2, 1e3), fixed(2.0, 1, sign="+"), fixed(math.inf, 2), fixed(None, 2)] == [
        "1.20", "+2.0", "-", "-",
    ]  # fmt: skip


@pytest.mark.parametrize(("ideal", "best"), [(0.0, [0, 1]), (math.inf, [3]), (2.9, [3])])
def test_the_best_are_those_that_read_as_the_nearest_to_the_ideal(ideal: float, best: list[int]) -> None:
    values = [1.001, 1.002, None, 3.0]
    marked = best_marked([Entry(fixed(v, 2)) for v in values], values, ideal)
    assert [k for k, entry in enumerate(marked) if entry.is_best] == best
    assert not any(entry.is_best for entry in best_marked([Entry("1.00")], [1.001]))


def test_csv_is_read_back() -> None:
    records = [{"a": 0.1, "b": "x, y"}, {"a": None, "b": ""}]
    assert list(csv.DictReader(io.StringIO(csv_text(records)))) == [{"a": "0.1", "b": "x, y"}, {"a": "", "b": ""}]
    assert csv_text([]) == ""
