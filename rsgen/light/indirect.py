"""Indirect light, from surface to surface: bounce by bounce with few rays, then once more with as many as it takes.

It is gathered by cosine-distributed rays that look up how what they meet is lit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsgen.array_types import Float32Array, FloatArray, IntArray
from rsgen.config.config import LightConfig
from rsgen.light.sampling import (
    CHANNELS,
    PATCH,
    Interpolation,
    Sampler,
    about_normal,
    denoised,
    part_of,
    sampled_adaptively,
    sampler_at,
    standard_error,
    thin,
    visible_error,
)
from rsgen.light.specular import shines, surface_radiance
from rsgen.light.surface_points import SamplePoints
from rsgen.render.irradiance import IrradianceField, Lattice

_COARSE_TEXELS = 3.0  # light off surfaces is gathered at points about this far apart
_BOUNCE_TEXELS = 6.0  # and by all bounces but the last, whose many rays average over what these blur
_MOST_AGAIN = 0.5  # of so many points: those between them that are drawn for themselves
_BOUNCE_RAYS = 16
_LAST_ROUNDS = 4  # the last bounce's rays: an eighth of them at first
_REGION_M = 2.0  # parts of the scene, of like normals on one piece of surface, that light fades by itself in
_FEW_LEFT = 0.02  # of the light at nearly all places: bounces that bring less are extrapolated from those before
_NEARLY_ALL = 0.9
_MOST_KEPT = 0.97  # of the light by a bounce
_LEAST_SHARE, _MOST_SHARE = 0.3, 1.06  # of light that gets into lacquer: at 86 degrees, and what comes straight


@dataclass(frozen=True)
class Surfaces:
    """What is baked: a scene's lattice, its unique points, (2, points) which of them each lattice point's front and
    back is, how far these count (see `sample_points`), and whether light is followed through panes.
    """

    scene: Any
    lattice: Lattice
    points: SamplePoints
    index: IntArray
    reach: tuple[NDArray[np.uint32], NDArray[np.uint32]]
    follow: bool

    def field(self, values: NDArray, alive: NDArray[np.bool_]) -> IrradianceField:
        """Irradiance (n, 4), see `in_channels`, of the unique points, as far as they are alive (n,)."""
        return IrradianceField(self.lattice, *self.sides(values, alive))

    def sides(self, values: NDArray, alive: NDArray[np.bool_]) -> tuple[Float32Array, Float32Array]:
        """The same as (points, 5) of the lattice's front and back, as `IrradianceField` takes it."""
        # In half precision, as it is kept: light from the cache must be the same to the last bit.
        share = values[:, 3] / np.maximum(values[:, :3].mean(axis=1), 1e-30)
        share = share.clip(_LEAST_SHARE, _MOST_SHARE).astype(np.float16).astype(np.float32)
        front, back = (np.empty((len(far), 5), np.float32) for far in self.reach)
        for side, i, far in zip((front, back), self.index, self.reach, strict=True):
            side[:, :3] = values[i, :3]
            side[:, 3] = 1 + far.astype(np.float32)
            side[:, 4] = share[i]
            side[~alive[i]] = 0
        return front, back


def gathering(scene: Any, field: IrradianceField, points: SamplePoints, which: IntArray) -> Sampler:
    """Samples the irradiance that arrives from other surfaces, each lit as `field` states, but no emitter's own.

    By way of panes and whatever mirrors too.
    """
    follow = shines(scene)

    def sample(at: Sequence[Any], _: IntArray, begin: int, count: int) -> Any:
        p, n, number = at

        def light_along(ray: Any, i: Any, pick: Any) -> Any:
            return surface_radiance(scene, field, ray, number, i, pick, follow)

        return about_normal(p, n, number, begin, count, 101, light_along)

    return sampler_at(points, which, sample)


def light_off_surfaces(
    surfaces: Surfaces, fine: IntArray, direct: Float32Array, lit_by: Callable[[Float32Array], IrradianceField],
    light: LightConfig, scatter: float, report: Callable[[float], None],
) -> Float32Array:  # fmt: skip
    """Irradiance (n, 4) that surfaces throw on the points `fine` (n,), which have `direct` (n, 4) from elsewhere.

    lit_by: the field of a light (n, 4) at `fine`. Sampled until twice `scatter` is left (see `sampled_adaptively`),
    which smoothing and interpolation bring down to about that: they reach over a dozen points. Where these differ most,
    as in corners and where things touch, light is sampled at each point itself.
    """
    if not light.bounces:
        return np.zeros_like(direct)
    points, spacing = surfaces.points, light.texel_m * _COARSE_TEXELS
    beside = direct.mean(axis=1)
    before = _before_the_last(surfaces, fine, direct, lit_by, light, part_of(report, 0.0, 0.5))
    field = lit_by(direct + before)
    of_fine = thin(points, spacing, fine, steps=True)[0]
    coarse = fine[of_fine]
    to_fine = Interpolation.between(points, coarse, fine, spacing)
    first = max(2, light.gather_rays >> (_LAST_ROUNDS - 1))

    def at_last(of: IntArray, apart: float, begin: float) -> Float32Array:
        patch = thin(points, PATCH * apart, fine[of])[1]
        means, left = sampled_adaptively(
            gathering(surfaces.scene, field, points, fine[of]), patch, lambda own: own + beside[of], 2 * scatter, first,
            _LAST_ROUNDS, math.inf, part_of(report, begin, 0.25),
        )  # fmt: skip
        noisy = np.flatnonzero(left > scatter)
        return denoised(points, fine[of], means, standard_error(patch, means), apart, noisy)

    own = at_last(of_fine, spacing, 0.5)
    smooth = to_fine(own)
    everywhere = thin(points, PATCH * spacing, fine)[1]
    uneven = visible_error(everywhere, to_fine.spread(own.mean(axis=1)), smooth.mean(axis=1) + beside)
    worst = np.argsort(-uneven, kind="stable")[: int(_MOST_AGAIN * len(coarse))]
    again = np.sort(worst[uneven[worst] > 2 * scatter])
    if len(again):
        smooth[again] = at_last(again, light.texel_m, 0.75)
    report(1.0)
    return smooth


def _before_the_last(
    surfaces: Surfaces, fine: IntArray, direct: Float32Array, lit_by: Callable[[Float32Array], IrradianceField],
    light: LightConfig, report: Callable[[float], None],
) -> Float32Array:  # fmt: skip
    """Light off surfaces (n, 4) at the points `fine` after all bounces but the last; arguments as above."""
    points, spacing = surfaces.points, light.texel_m * _BOUNCE_TEXELS
    of_fine = thin(points, spacing, fine, steps=True)[0]
    coarse = fine[of_fine]
    to_fine = Interpolation.between(points, coarse, fine, spacing)
    region = thin(points, _REGION_M, coarse)[1]

    def thrown(off_surfaces: Float32Array, rays: int, share: Callable[[float], None]) -> Float32Array:
        draw = gathering(surfaces.scene, lit_by(direct + to_fine(off_surfaces)), points, coarse)
        sums = draw(np.arange(len(coarse)), 0, rays, share)
        return (sums.sum(axis=0) / rays).astype(np.float32)

    return to_fine(_bounced(thrown, direct.mean(axis=1)[of_fine], region, light, report))


def _bounced(
    thrown: Callable[[Float32Array, int, Callable[[float], None]], Float32Array], beside: FloatArray, region: IntArray,
    light: LightConfig, report: Callable[[float], None],
) -> Float32Array:  # fmt: skip
    """Light off surfaces (n, 4) after all bounces but the last; from the third on, what comes after is extrapolated.

    thrown: what surfaces throw on the n points if they get so much off others, by so many rays. beside: direct light
    (n,) of the points, in grey. region: (n,) the part of the scene that each is in: in a white room behind a window
    bounces go on long after the street outside, which has most of the light, has had all that it gets.
    """
    rays = min(_BOUNCE_RAYS, light.gather_rays)
    off_surfaces = np.zeros((len(region), CHANNELS), np.float32)
    brought: list[FloatArray] = []  # by each bounce to each region
    for bounce in range(light.bounces - 1):
        gathered = thrown(off_surfaces, rays, part_of(report, bounce / light.bounces, 1 / light.bounces))
        increase, off_surfaces = gathered - off_surfaces, gathered
        brought.append(np.stack([np.bincount(region, channel) for channel in increase.T], axis=1))
        if not bounce:
            continue
        # From one bounce to the next what is added falls by the same part again and again, in the end. Floors and
        # ceilings take turns, so two bounces, where there are enough, are compared with the two before the last.
        span = min(bounce, 2)
        recent, earlier = sum(brought[-span:]), sum(brought[-span - 1 : -1])
        kept = np.clip(recent / np.maximum(earlier, 1e-30), 0, _MOST_KEPT)
        rest = (kept / (1 - kept))[region] * increase
        part = rest.mean(axis=1) / np.maximum(beside + gathered.mean(axis=1), 1e-30)
        if bounce == light.bounces - 2 or np.quantile(part, _NEARLY_ALL) < _FEW_LEFT:
            return off_surfaces + rest.astype(np.float32)
    return off_surfaces
