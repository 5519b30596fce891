"""Files that a scene names as Windows finds them: in whatever case, with backslashes between folders."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

log = logging.getLogger("rsgen")

_MOST_LISTED = 3


def located(folder: Path, name: str) -> Path | None:
    """The file or folder `name` in `folder`: by that very name, else by the only one that it is but for its case.

    Backslashes part folders where there is no such name. None if there is nothing, or more than one could be meant.
    """
    plain = name.replace("\\", "/")
    for exact in (folder / name, folder / plain):
        if exact.exists():
            return exact
    if not plain or Path(plain).is_absolute():
        return None
    found = [folder]
    for part in Path(plain).parts:
        found = [here for place in found for here in _alike(place, part)]
    return found[0] if len(found) == 1 else None


def mend_names(state: Any, folder: Path) -> dict[str, str]:
    """Rename files that a parsed scene names otherwise than they are called, in place; returns their names by those.

    folder: of the scene's file, which names are relative to. Names of no file stay as they are.
    """
    renamed: dict[str, str] = {}
    for node in state.nodes:
        if "filename" not in node.props:
            continue
        name = str(node.props["filename"])
        file = None if (folder / name).exists() else located(folder, name)
        if file is not None:
            renamed[name] = node.props["filename"] = os.path.relpath(file, folder)
    return renamed


def tell_renamed(path: Path, renamed: Mapping[str, str]) -> None:
    """Say in a line which files of the scene `path` were found under other names than its own, if any."""
    pairs = [f"'{name}' is '{file}'" for name, file in sorted(renamed.items())]
    if pairs:
        more = f" and {len(pairs) - _MOST_LISTED} more" if len(pairs) > _MOST_LISTED else ""
        log.warning(
            "scene %s: found files by names that differ in case or slashes: %s%s",
            path, ", ".join(pairs[:_MOST_LISTED]), more,
        )  # fmt: skip


def _alike(folder: Path, name: str) -> list[Path]:
    if name == "..":
        return [folder / name]
    try:
        return [other for other in folder.iterdir() if other.name.casefold() == name.casefold()]
    except OSError:
        return []
