"""Light from surface to surface: bounce by bounce with few rays, then once more with as many as it takes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsgen.array_types import Float32Array, IntArray
from rsgen.config.config import LightConfig
from rsgen.light.drawing.gather import gathering
from rsgen.light.drawing.rounds import PATCH, in_rounds, scatter_of
from rsgen.light.places.bake_points import Interpolation, thin
from rsgen.light.places.denoise import denoised
from rsgen.light.places.surface_points import SurfacePoints
from rsgen.render.irradiance import IrradianceField, Lattice, make_field

_COARSE_TEXELS = 3.0  # light off surfaces is gathered at points about this far apart
_BOUNCE_RAYS = 32
_LAST_ROUNDS = 4  # the last bounce's rays: an eighth of them at first
_FEW_LEFT = 0.02  # of the light: bounces that bring less are extrapolated from those before
_MOST_KEPT = 0.97  # of the light by a bounce


@dataclass(frozen=True)
class Surfaces:
    """What is baked: a scene's lattice, its unique points, (2, points) which of them each lattice point's front and
    back is, how far these count (see `walls.Barriers`), and whether light is followed through panes.
    """

    scene: Any
    lattice: Lattice
    points: SurfacePoints
    index: IntArray
    reach: tuple[NDArray[np.uint32], NDArray[np.uint32]]
    follow: bool

    def field(self, values: NDArray, alive: NDArray[np.bool_]) -> IrradianceField:
        """Irradiance (n, 3) of the unique points, as far as they are alive (n,)."""
        return make_field(self.lattice, *self.sides(values, alive))

    def sides(self, values: NDArray, alive: NDArray[np.bool_]) -> tuple[Float32Array, Float32Array]:
        """The same as (points, 4) of the lattice's front and back, as `make_field` takes it."""
        front, back = (
            np.where(alive[i, None], np.column_stack([values[i], 1 + far.astype(np.float32)]), 0).astype(np.float32)
            for i, far in zip(self.index, self.reach, strict=True)
        )
        return front, back


def light_off_surfaces(
    surfaces: Surfaces, fine: IntArray, direct: Float32Array, lit_by: Callable[[Float32Array], IrradianceField],
    light: LightConfig, scatter: float, report: Callable[[float], None],
) -> Float32Array:  # fmt: skip
    """Irradiance (n, 3) that surfaces throw on the points `fine` (n,), which have `direct` (n, 3) from elsewhere.

    lit_by: the field of a light (n, 3) at `fine`. Drawn until twice `scatter` is left (see `rounds`), which smoothing
    and the interpolation bring down to about that: they reach over a dozen points.
    """
    if not light.bounces:
        return np.zeros_like(direct)
    points, spacing = surfaces.points, light.texel_m * _COARSE_TEXELS
    of_fine = thin(points, spacing, fine)[0]
    coarse = fine[of_fine]
    to_fine = Interpolation.between(points, coarse, fine, spacing)

    def gather_from(off_surfaces: Float32Array) -> Any:
        return gathering(surfaces.scene, lit_by(direct + off_surfaces), points, coarse, surfaces.follow)

    before = _bounced(gather_from, to_fine, direct, len(coarse), light, lambda f: report(0.5 * f))
    patch, beside = thin(points, PATCH * spacing, coarse)[1], direct[of_fine].mean(axis=1)
    first = max(2, light.gather_rays >> (_LAST_ROUNDS - 1))
    means, left = in_rounds(
        gather_from(before), patch, lambda own: own + beside, 2 * scatter, first, _LAST_ROUNDS, math.inf,
        lambda f: report(0.5 + 0.5 * f),
    )  # fmt: skip
    noisy = np.flatnonzero(left > scatter)
    return to_fine(denoised(points, coarse, means, scatter_of(patch, means), spacing, noisy))


def _bounced(
    gather_from: Callable[[Float32Array], Any], to_fine: Interpolation, direct: Float32Array, count: int,
    light: LightConfig, report: Callable[[float], None],
) -> Float32Array:  # fmt: skip
    """Light off surfaces after all bounces but the last; what comes after that, from the third on, is extrapolated."""
    rays = min(_BOUNCE_RAYS, light.gather_rays)
    off_surfaces = np.zeros_like(direct)
    brought = np.zeros(3)
    for bounce in range(light.bounces - 1):

        def share(f: float, k: int = bounce) -> None:
            report((k + f) / light.bounces)

        sums = gather_from(off_surfaces)(np.arange(count), 0, rays, share)
        gathered = to_fine((sums.sum(axis=0) / rays).astype(np.float32))
        increase, before = gathered - off_surfaces, brought
        brought, off_surfaces = increase.sum(axis=0, dtype=np.float64), gathered
        if not bounce:
            continue
        # From one bounce to the next, what is added falls by the same part again and again.
        kept = np.clip(brought / np.maximum(before, 1e-30), 0, _MOST_KEPT)
        rest = kept / (1 - kept)
        if bounce == light.bounces - 2 or (rest * brought).sum() < _FEW_LEFT * (direct + off_surfaces).sum():
            return off_surfaces + (increase * rest).astype(np.float32)
    return off_surfaces
