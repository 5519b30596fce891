"""The one exception that means "the input is wrong", and its words, one line: what, where, what to do."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from importlib.metadata import requires
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from pydantic import ValidationError

Model = TypeVar("Model")


class UserError(Exception):
    """Bad input (file, config, machine set-up). Command line tools print it as one line and exit with status 2."""


def first_few(names: Sequence[str], most: int = 3) -> str:
    """'a, b, c and 2 more': at most so many of the names."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def how_to_install(*extras: str, package: str = "") -> str:
    """'pip install' with the packages of these extras, or with one of them, and their bounds, as the metadata has them.

    They are named themselves, which works wherever the project was installed from. Raises ValueError: no such extra or
    package; PackageNotFoundError: the project is not installed.
    """
    named = [part.partition(";") for part in requires("rolling-shutter-rgbd") or ()]
    wanted = [part for part, _, marker in named if any(f"extra == '{extra}'" in marker for extra in extras)]
    found = [part for part in wanted if package in ("", re.split(r"[^\w.-]", part)[0])]
    if not found:
        raise ValueError(f"no package '{package}' in the extras {', '.join(extras)}")
    return "pip install " + " ".join(f"'{part}'" for part in found)


def validated(
    validate: Callable[[Any], Model], data: Any, where: object, *within: str, cure: str = "", unknown: str = ""
) -> Model:
    """The data as pydantic validates it: `validate` is a model's model_validate or model_validate_json.

    Raises UserError, 'WHERE: FIELD: what is wrong with it' and the cure; within, unknown: as of `first_problem`.
    """
    from pydantic import ValidationError

    try:
        return validate(data)
    except ValidationError as error:
        raise UserError(f"{where}: {first_problem(error, *within, unknown=unknown)}{cure}") from None


def first_problem(error: ValidationError, *within: str, unknown: str = "") -> str:
    """'FIELD: what is wrong with it' of the first field that a model refuses.

    within: the fields it lies in. unknown: which entries there are, said where there is none of that name.
    """
    first = error.errors()[0]
    where = ".".join(str(part) for part in (*within, *first["loc"])) or "the file"
    if unknown and first["type"] == "extra_forbidden":
        return f"{where}: no such entry: {unknown}"
    return f"{where}: {first['msg'].removeprefix('Value error, ')}"
