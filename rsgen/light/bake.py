"""A scene's diffuse irradiance: from the cache if it was baked with the same inputs before, else baked now and stored.

1. Every point of `irradiance.Lattice` gets direct light, by emitter sampling: from each lamp (`lamps`), from the sky
   and off mirrors (`sky`), and off lacquer and brushed metal (`specular`). Both sides of each triangle have points;
   points that coincide are one. Where a mesh is finer than the texel, a thinned set of points is computed and the
   others are interpolated.
2. Indirect light varies slowly, so it is gathered over bounces at a still thinner set, a few texels apart (`indirect`).
3. Points that no light reaches (buried in another object) are marked as not alive. Where something stands on a surface,
   `surface_points` limits how far its points count.

A point gets as many samples as the visible error of their scatter needs, and the scatter that is left is smoothed
where it hides any difference (`sampling`). All randomness is a fixed low-discrepancy sequence rotated by a hash of the
point's number: a scene bakes to the same bytes each time on one backend.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import math
import os
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from rsgen.array_types import Float32Array, FloatArray, IntArray
from rsgen.config.config import LightConfig
from rsgen.console.configs import user_cache
from rsgen.console.progress import Progress
from rsgen.errors import UserError
from rsgen.light.indirect import Surfaces, gathering, light_off_surfaces
from rsgen.light.lamps import first_look, lamp_light, straight_through_bulbs
from rsgen.light.quality import estimated_quality
from rsgen.light.sampling import (
    CHANNELS,
    GREY_SLOPE,
    PATCH,
    Interpolation,
    denoised,
    part_of,
    standard_error,
    thin,
    typical,
)
from rsgen.light.sky import has_sky_light, sky_light
from rsgen.light.specular import caustic_light, passes_light_on
from rsgen.light.surface_points import sample_points
from rsgen.render.irradiance import IrradianceField, Lattice, lattice_area, make_lattice

log = logging.getLogger("rsgen")


# Raise when the method changes, so that older caches are not taken for new ones.
METHOD = 9
_FINE_TEXELS = 0.9  # direct light is computed at points at least about this far apart
_FIRST_LOOK_TEXELS = 3.0
_FIRST_LOOK_RAYS = 12
_FIRST_LOOK_BOUNCES = 2
_AMBIENT = 0.1  # light off surfaces, as a part of the typical light off lamps, until it is known
_OF_THE_WHOLE = 0.25  # the scatter of each kind of light, of what is asked: they add up, and neighbours compare


def bake(scene: Any, lattice: Lattice, light: LightConfig, progress: Progress) -> tuple[NDArray, NDArray]:
    """Irradiance (points, 5) float32 of the front and back sides: E_r, E_g, E_b (scene units), w, share.

    w: 0 where no light reaches, else 1 + how far the sample counts (see `render.irradiance.packed_reach`). share: what
    lights the matte beneath lacquer, as a part of what would if the same light came from all sides alike.
    """
    progress("light", 0.0, "where light is looked at")
    points, index, reach = sample_points(scene, lattice, light.texel_m)
    surfaces = Surfaces(scene, lattice, points, index, reach, passes_light_on(scene))
    fine, fine_of_point = thin(points, light.texel_m * _FINE_TEXELS)
    area = _summed(fine_of_point, _summed(index.ravel(), np.tile(lattice_area(scene, lattice), 2)))
    log.info("baking light: %d triangles, %d samples of %d stored", len(lattice.first), len(fine), len(fine_of_point))
    scatter = 10 ** (-light.target_db / 20) / GREY_SLOPE
    direct, alive = _direct(surfaces, fine, fine_of_point, area, light, scatter, progress)
    fine, alive_point = fine[alive], alive[fine_of_point]

    lit_points = np.flatnonzero(alive_point)
    to_point = Interpolation.between(points, fine, lit_points, light.texel_m)
    values = np.zeros((len(points.position), CHANNELS), np.float32)

    def at_points(light_of_fine: Float32Array) -> Float32Array:
        values[lit_points] = to_point(light_of_fine)
        return values

    def lit_by(light_of_fine: Float32Array) -> Any:
        return surfaces.field(at_points(light_of_fine), alive_point)

    report = _reporter(progress, 0.6, 0.4, "light off surfaces")
    total = direct + light_off_surfaces(surfaces, fine, direct, lit_by, light, _OF_THE_WHOLE * scatter, report)
    progress("light", 1.0, "light baked")
    return surfaces.sides(at_points(total), alive_point)


def _direct(
    surfaces: Surfaces, fine: IntArray, fine_of_point: IntArray, area: FloatArray, light: LightConfig, scatter: float,
    progress: Progress,
) -> tuple[Float32Array, NDArray[np.bool_]]:  # fmt: skip
    """Direct irradiance (m, 4) of those of the points `fine` that any light reaches, and which these are (n,).

    area (n,): of the surface that each stands for, m². Raises UserError if there are none.
    """
    scene, points, follow = surfaces.scene, surfaces.points, surfaces.follow
    # A first look at some of the points estimates how bright the scene is, which scatter is compared with.
    looked_at, stands_for = thin(points, _FIRST_LOOK_TEXELS * light.texel_m, fine)
    report = _reporter(progress, 0.03, 0.04, "a first look at the light")
    grey = first_look(scene, points, fine[looked_at], follow, report).mean(axis=1)[stands_for]
    beside = grey + _AMBIENT * typical(grey)
    patch = thin(points, PATCH * light.texel_m, fine)[1]
    means, left = np.zeros((2, len(fine), CHANNELS), np.float32), np.zeros(len(fine))
    if has_sky_light(scene):
        report = _reporter(progress, 0.07, 0.18, "light of the sky and off mirrors")
        means, left = sky_light(
            scene, points, fine, patch, light.texel_m, light.direct_samples, beside, scatter, report
        )
        log.info("light of the sky: %.0f dB before smoothing", _as_db(left))
    report, part = _reporter(progress, 0.25, 0.3, "direct light"), _OF_THE_WHOLE * scatter
    all_light = beside + means.mean(axis=(0, 2))
    of_lamps, left_of_lamps = lamp_light(
        scene, points, fine, patch, light.direct_samples, follow, all_light, part, report
    )
    means += of_lamps
    del of_lamps
    off_lacquer = caustic_light(scene, points, fine, area, light.texel_m, light.direct_samples, follow)
    seen = means.mean(axis=0) + off_lacquer
    alive = _reached(surfaces, fine, fine_of_point, seen, _reporter(progress, 0.55, 0.05, "finding lit surfaces"))
    if not alive.any():
        raise UserError("the scene is dark: no light reaches any surface; add an emitter or move it into the open")
    fine, patch, means = fine[alive], np.unique(patch[alive], return_inverse=True)[1].ravel(), means[:, alive]
    noisy = np.flatnonzero(np.hypot(left, left_of_lamps)[alive] > part)
    direct = denoised(points, fine, means, standard_error(patch, means), light.texel_m, noisy)
    return direct + off_lacquer[alive], alive


def _reached(
    surfaces: Surfaces, fine: IntArray, fine_of_point: IntArray, seen: Float32Array, report: Callable[[float], None]
) -> NDArray[np.bool_]:
    """Which of `fine` (n,) any light reaches, given the direct light (n, 4) that a first look has seen there."""
    total = seen.copy()
    everywhere = np.ones(len(fine_of_point), bool)
    for bounce in range(_FIRST_LOOK_BOUNCES):
        dark = np.flatnonzero(total.max(axis=1) <= 0)
        if not len(dark):
            break
        field = surfaces.field(total[fine_of_point], everywhere)
        draw = gathering(surfaces.scene, field, surfaces.points, fine[dark])
        part = part_of(report, bounce / _FIRST_LOOK_BOUNCES, 1 / _FIRST_LOOK_BOUNCES)
        total[dark] = draw(np.arange(len(dark)), 0, _FIRST_LOOK_RAYS, part).sum(axis=0)
    return total.max(axis=1) > 0


def _summed(label: IntArray, values: FloatArray) -> FloatArray:
    return np.bincount(label, values).astype(np.float64)


def _as_db(left: FloatArray) -> float:
    return -20 * math.log10(max(float(np.sqrt(np.mean(left**2))) * GREY_SLOPE, 1e-5))


def _reporter(progress: Progress, begin: float, span: float, what: str) -> Callable[[float], None]:
    return lambda fraction: progress("light", begin + span * fraction, what)


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
        return IrradianceField(lattice, *stored)
    with straight_through_bulbs(scene) as glass:
        if glass:
            log.info("lamps in bulbs: their light goes straight through %d shapes of glass", len(glass))
        front, back = bake(scene, lattice, light, progress)
        _store(path, front, back)
        field = IrradianceField(lattice, front, back)
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
