"""Configs by name: those of the checkout, used where they are, or those that came with the wheel.

A wheel carries configs/ and the scripts of scenes/ in the package's folder `share`. They are copied into
$XDG_CACHE_HOME/rsgen (~/.cache/rsgen) before they are used, so that scenes are built, lit and stored there.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from rsgen.errors import UserError
from rsgen.files import atomic_write
from rsgen.sequence.format import STREAMS

_PACKAGE = Path(__file__).resolve().parents[1]


def config_file(name: str) -> Path:
    """The config that is called so, unless `name` is a file or no config is."""
    known = configs_folder() / f"{name}.yaml"
    return Path(name) if Path(name).is_file() or not known.is_file() else known


def configs_folder() -> Path:
    """The folder of the configs; the scenes are beside it. Raises OSError if the user's cache cannot be written."""
    share = _PACKAGE / "share"
    return (_kept(share, user_cache()) if share.is_dir() else _PACKAGE.parent) / "configs"


def scaled(path: Path, config: Mapping[str, Any], width: int) -> dict[str, Any]:
    """Fields of a config that make its images so wide, the same view in fewer or more pixels.

    Pixel centres are at whole numbers. Raises UserError: the config (of the file `path`) has no size.
    """
    out: dict[str, Any] = {}
    for stream in STREAMS:
        section = config.get(stream) or {}
        try:
            columns, rows = int(section["width"]), int(section["height"])
            fx, fy, cx, cy = (float(value) for value in section["intrinsics"])
        except (KeyError, TypeError, ValueError):
            needed = "width, height and intrinsics [fx, fy, cx, cy] must be numbers to be scaled"
            raise UserError(f"{path}: {stream}: {needed}") from None
        height = max(1, round(rows * width / columns))
        x, y = width / columns, height / rows
        lens = (fx * x, fy * y, (cx + 0.5) * x - 0.5, (cy + 0.5) * y - 0.5)
        out |= {f"{stream}.width": width, f"{stream}.height": height}
        out[f"{stream}.intrinsics"] = [round(value, 9) for value in lens]
    return out


def user_cache() -> Path:
    """Folder for large results that have no better place."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rsgen"


def _kept(share: Path, cache: Path) -> Path:
    """A copy of the folder within `cache`, written now if there is none of its present state."""
    files = {path.relative_to(share): path.read_bytes() for path in sorted(share.rglob("*.*")) if path.suffix != ".pyc"}
    state = hashlib.sha256(b"".join(str(name).encode() + data for name, data in files.items()))
    kept = cache / f"share-{state.hexdigest()[:12]}"
    for name, data in files.items():
        # Byte by byte: in a folder copied from one that is read-only no scene could be built.
        if not (kept / name).is_file():
            (kept / name).parent.mkdir(parents=True, exist_ok=True)
            atomic_write(kept / name, data)
    return kept


ConfigFile = Annotated[Path, "YAML file, or a name that 'rsgen scenes' lists", config_file]
