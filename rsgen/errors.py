"""The one exception that means "the input is wrong": its message is one line: what, where, and what to do."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pydantic import ValidationError


class UserError(Exception):
    """Bad input (file, config, machine set-up). Command line tools print it as one line and exit with status 2."""


def first_few(names: Sequence[str], most: int = 3) -> str:
    """'a, b, c and 2 more': at most so many of the names."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def first_problem(error: ValidationError, *within: str) -> str:
    """'FIELD: what is wrong with it' of the first field that a model refuses; `within`: the fields it lies in."""
    first = error.errors()[0]
    where = ".".join(str(part) for part in (*within, *first["loc"])) or "the file"
    return f"{where}: {first['msg'].removeprefix('Value error, ')}"
