"""A scene's baked light: from the cache if it was baked with the same inputs before, else baked now and stored."""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from rsgen.array_types import FloatArray
from rsgen.config.config import LightConfig
from rsgen.console.configs import user_cache
from rsgen.console.progress import Progress
from rsgen.light.bake import METHOD, bake
from rsgen.light.lamps import straight_through_bulbs
from rsgen.light.quality import estimated_quality
from rsgen.render.irradiance import IrradianceField, Lattice, make_field, make_lattice

log = logging.getLogger("rsgen")

_SIDES = ("front", "back")


def baked_field(
    scene: Any, scene_hash: str, light: LightConfig, cache: Path, progress: Progress,
    view: Callable[[], tuple[FloatArray, FloatArray]] | None = None,
) -> IrradianceField:  # fmt: skip
    """The scene's irradiance: from `cache` (a folder) if it was baked with the same inputs before, else baked now.

    view: eyes and directions (n, 3) of rays along which it will be seen; with them, a new bake's quality is logged.
    """
    lattice = make_lattice(scene, light.texel_m)
    key = cache_key(scene_hash, light)
    path = cache / f"irradiance-{key}.npz"
    stored = _load(path, lattice)
    if stored is not None:
        return make_field(lattice, *stored)
    with straight_through_bulbs(scene) as glass:
        if glass:
            log.info("lamps in bulbs: their light goes straight through %d shapes of glass", len(glass))
        front, back = bake(scene, lattice, light, progress)
        _store(path, front, back)
        field = make_field(lattice, front, back)
        if view is not None:
            progress("light", 1.0, "how right it is")
            quality = estimated_quality(scene, field, light.texel_m, *view())
            log.info("light baked: %s (light.target_db: %g)", quality, light.target_db)
    return field


def cache_key(scene_hash: str, light: LightConfig) -> str:
    """Name of a bake: hash of the scene's files, the light's settings, this method's version and the engine's."""
    facts = {
        "scene": scene_hash,
        "light": light.model_dump(exclude={"mode", "max_depth", "glossy_spp"}),
        "method": METHOD,
        "mitsuba": mi.__version__,
        "variant": mi.variant(),
    }
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:24]


def cache_folder(scene_file: Path) -> Path:
    """Where a scene's bakes are stored: beside the scene if that is writable, else in the user's cache."""
    if os.access(scene_file.parent, os.W_OK):
        return scene_file.parent / ".rsgen-cache"
    return user_cache()


def _load(path: Path, lattice: Lattice) -> tuple[NDArray, NDArray] | None:
    """Both sides of a stored bake, or None if there is none that fits (a damaged file is baked again)."""
    sides = []
    try:
        with np.load(path) as data:
            for side in _SIDES:
                alive = np.unpackbits(data[f"{side}_alive"], count=lattice.points).astype(bool)
                values = np.zeros((lattice.points, 5), np.float32)
                values[alive, :3], values[alive, 4] = data[side], data[f"{side}_share"]
                values[alive, 3] = 1
                values[data[f"{side}_parted"], 3] += data[f"{side}_reach"]
                sides.append(values)
    except (OSError, ValueError, KeyError, EOFError, IndexError, zipfile.BadZipFile, zlib.error):
        return None
    return sides[0], sides[1]


def _store(path: Path, front: NDArray, back: NDArray) -> None:
    """Write atomically; a cache that cannot be written only costs time, so it is no error."""
    arrays: dict[str, NDArray] = {}
    for side, values in zip(_SIDES, (front, back), strict=True):
        alive = values[:, 3] > 0
        parted = np.flatnonzero(values[:, 3] > 1).astype(np.uint32)
        arrays |= {side: values[alive, :3], f"{side}_alive": np.packbits(alive)}
        arrays[f"{side}_share"] = values[alive, 4].astype(np.float16)
        arrays |= {f"{side}_parted": parted, f"{side}_reach": (values[parted, 3] - 1).astype(np.uint32)}
    temporary = path.with_suffix(f".{os.getpid()}.tmp.npz")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(temporary, allow_pickle=False, **arrays)
        temporary.replace(path)
    except OSError as error:
        log.warning("light cache %s cannot be written (%s): it will be baked again next time", path, error.strerror)
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
