"""Configs by name: those of the checkout, used where they are, or those that came with the wheel.

A wheel carries configs/ and the scripts of scenes/ in the package's folder `share`. They are copied into
$XDG_CACHE_HOME/rsgen (~/.cache/rsgen) before they are used, so that scenes are built, lit and stored there.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Annotated

from rsgen.files import atomic_write

_PACKAGE = Path(__file__).resolve().parents[1]


def config_file(name: str) -> Path:
    """The config that is called so, unless `name` is a file or no config is."""
    known = configs_folder() / f"{name}.yaml"
    return Path(name) if Path(name).is_file() or not known.is_file() else known


def configs_folder() -> Path:
    """The folder of the configs; the scenes are beside it. Raises OSError if the user's cache cannot be written."""
    share = _PACKAGE / "share"
    return (_kept(share, user_cache()) if share.is_dir() else _PACKAGE.parent) / "configs"


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
