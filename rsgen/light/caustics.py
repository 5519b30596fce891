"""Caustics of lacquer and brushed metal: photons from lit places on them along their lobes to where they land.

A ray from where the light lands finds the sun in a varnished table one time in a thousand, so light is followed from
the table instead (photon mapping: Jensen 1996). Photons are averaged over decimetres: they are few.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rsgen.array_types import Float32Array, FloatArray, IntArray
from rsgen.device.arrays import aligned, rows_of
from rsgen.light.sampling import CHANNELS, about_normal, in_channels, rotation, sampler_at, shaded_nearby, thin
from rsgen.light.specular_paths import SPECULAR, casts_caustics, caustic_radiance, transmitted
from rsgen.light.surface_points import SamplePoints
from rsgen.render.irradiance import at_triangles, registry_id
from rsgen.scene.meshes import mesh_corners, meshes_of

# Where photons land, the normals of the sides they land on, (n, 3) each, and what each brings, W: (n, CHANNELS).
Photons = tuple[NDArray, NDArray, NDArray]

_A_SAMPLE, _MOST, _BATCH = 1 << 15, 1 << 21, 1 << 18  # photons: for each of a point's samples, in all, at a time
_TURNS = 4  # surfaces that a photon is followed over
_CELL_M = 0.12  # photons are counted in cells of this size, of like normals
# Rays; and the part of the light that what is in a cell with a place takes if it is behind that: no photon gets there.
_LOOKS, _BURIED = 16, 0.8
_LEAST = 0.05  # of a cell's square: where there is less surface, a photon or two would be a spark
_NEAR = 8  # cells that each is shared out among


def caustic_light(
    scene: Any, points: SamplePoints, which: IntArray, area: FloatArray, texel_m: float, samples: int, follow: bool
) -> Float32Array:
    """Irradiance (n, 4) that lamps and sky send to the points `which` (n,) by way of lacquer and brushed metal.

    area (n,): of the surface that each stands for, m². samples: of each lamp at a point, which photons go by. follow:
    whether lamps shine through panes.
    """
    shapes = [shape for shape in meshes_of(scene) if casts_caustics(shape)]
    if not shapes:
        return np.zeros((len(which), CHANNELS), np.float32)
    # Whatever pieces of surface there are: where these are small, next to nothing would land on each.
    whole = replace(points, piece=np.zeros_like(points.piece))
    coarse, stands_for = thin(points, 2 * texel_m, which, steps=True)
    cells = which[thin(whole, _CELL_M, which)[0]]
    tree = cKDTree(_places(points.position[cells], points.normal[cells]))

    def spread(position: NDArray, normal: NDArray, what: NDArray) -> FloatArray:
        # Neighbours after each other: a tree is searched several times as fast as in no order.
        order = np.lexsort(np.floor(position / _CELL_M).T)
        position, normal, what = position[order], normal[order], what[order]
        near, weights = _shares(tree, _places(position, normal))
        return np.stack([np.bincount(near.ravel(), (weights * w[:, None]).ravel(), len(cells)) for w in what.T], axis=1)

    # What lands and the surface it lands on are shared out alike, so that it does not matter how cells lie.
    flux = np.zeros((len(cells), CHANNELS))
    for landed in _photons(scene, shapes, min(_MOST, samples * _A_SAMPLE), follow):
        flux += spread(*landed)
    there = which[coarse]
    seen = shaded_nearby(scene, points, there, _CELL_M, _LOOKS) < _BURIED
    each = np.where(seen, np.bincount(stands_for, area), 0)[:, None]
    around = spread(points.position[there], points.normal[there], each)
    light = flux / np.maximum(around, _LEAST * _CELL_M**2)
    out = np.empty((len(which), CHANNELS), np.float32)
    for begin in range(0, len(which), _BATCH):
        part = which[begin : begin + _BATCH]
        near, weights = _shares(tree, _places(points.position[part], points.normal[part]))
        out[begin : begin + _BATCH] = np.einsum("nk,nkc->nc", weights, light[near])
    out[~seen[stands_for]] = 0
    return out


def _places(position: NDArray, normal: NDArray) -> FloatArray:
    return np.concatenate([position / _CELL_M, normal], axis=1).astype(np.float64)


def _shares(tree: cKDTree, places: FloatArray) -> tuple[IntArray, FloatArray]:
    """Cells (n, k) near places and how each place is shared out among them, (n, k), in all 1."""
    k = min(_NEAR, tree.n)
    distance, near = (np.reshape(v, (-1, k)) for v in tree.query(places, k=k, workers=-1))
    weights = np.exp(-1.5 * distance**2) + 1e-9
    return near, weights / weights.sum(axis=1, keepdims=True)


def gathered_caustics(scene: Any, points: SamplePoints, which: IntArray, samples: int) -> Float32Array:
    """The same looked for from where it lands, in means of two halves (2, n, 4): it scatters, but blurs nothing."""

    def sample(at: Sequence[Any], _: IntArray, begin: int, count: int) -> Any:
        p, n, number = at

        def light_along(ray: Any, i: Any, pick: Any) -> Any:
            return dr.pi * caustic_radiance(scene, ray, number, i, pick)

        return about_normal(p, n, number, begin, count, 301, light_along)

    draw = sampler_at(points, which, sample)
    return draw(np.arange(len(which)), 0, samples, lambda _: None) / np.float32(samples / 2)


def _photons(scene: Any, shapes: list[Any], photons: int, follow: bool) -> Iterator[Photons]:
    """Yields what lands of so many photons that start from lit places on `shapes`, a batch and a turn at a time."""
    corners = [mesh_corners(shape) for shape in shapes]
    face = np.concatenate([np.arange(len(own), dtype=np.uint32) for own in corners])
    of = np.repeat(np.array([registry_id(s) for s in shapes], np.uint32), [len(own) for own in corners])
    growing = np.cumsum(trimesh.triangles.area(np.concatenate(corners)))
    for begin in range(0, photons, _BATCH):
        number = np.arange(begin, min(photons, begin + _BATCH))
        # Spread evenly over the area, and over each triangle (Osada et al. 2002).
        at = np.searchsorted(growing, (number + 0.5) / photons * growing[-1]).clip(max=len(growing) - 1)
        u, v = (number * a % 1 for a in (0.7548776662466927, 0.5698402909980532))
        root = np.sqrt(u)
        uv = np.stack([root * (1 - v), root * v], axis=1).astype(np.float32)
        yield from _thrown(scene, at_triangles(of[at], face[at], uv)[1], number, growing[-1] / photons, follow)


def _thrown(scene: Any, si: Any, which: IntArray, area: float, follow: bool) -> Iterator[Photons]:
    """What the photons `which` from places on lacquer bring, each of which has `area`, surface after surface."""
    specular = mi.BSDFContext()
    specular.type_mask = SPECULAR
    number = mi.UInt32(aligned(which, np.uint32))

    def drawn(dimension: int) -> Any:
        return mi.Point2f(rotation(number, 310 + 2 * dimension), rotation(number, 311 + 2 * dimension))

    ds, value = scene.sample_emitter_direction(si, drawn(0), False)
    cosine = dr.abs(dr.dot(si.sh_frame.n, ds.d))
    start = si.spawn_ray(ds.d).o
    way = ds.p - start
    distance = dr.norm(way)
    flux = value * cosine * area * transmitted(scene, start, way / distance, distance, ds.pdf > 0, follow)
    si.wi = si.to_local(ds.d)
    for turn in range(_TURNS):
        bs, weight = si.bsdf().sample(specular, si, drawn(2 * turn + 1).x, drawn(2 * turn + 2))
        flux *= weight
        alive = dr.compress(dr.max(flux) > 0)
        if not len(alive):
            return
        ray = si.spawn_ray(si.to_world(bs.wo))
        ray = mi.Ray3f(dr.gather(mi.Point3f, ray.o, alive), dr.gather(mi.Vector3f, ray.d, alive))
        flux, number = dr.gather(mi.Color3f, flux, alive), dr.gather(mi.UInt32, number, alive)
        si = scene.ray_intersect(ray)
        flux &= si.is_valid()
        normal = si.sh_frame.n * dr.select(dr.dot(si.sh_frame.n, ray.d) > 0, -1.0, 1.0)
        brought = in_channels(flux, -dr.dot(normal, ray.d))
        dr.eval(si, flux, normal, brought)
        landed = np.array(si.is_valid())
        yield rows_of(si.p)[landed], rows_of(normal)[landed], rows_of(brought)[landed]
