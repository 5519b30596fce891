"""Bake a scene's diffuse irradiance once: direct light by emitter sampling, indirect by gathering over bounces.

1. Every lattice point of `irradiance.Lattice` (both sides of each triangle; points that coincide are one) gets direct
   light from each emitter with a stratified set of samples.
   Where a mesh is finer than the texel, a thinned set of points is computed and the others are interpolated.
2. Indirect light varies slowly, so it is gathered at a still thinner set, a few texels apart, by cosine-distributed
   rays that look the previous bounce up where they hit, and interpolated in position and normal.
3. Points that never get any light (buried in another object) are marked as not alive.

All randomness is a fixed low-discrepancy sequence rotated by a hash of the point's number: a scene bakes to the same
bytes each time on one backend.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from rsgen.config import LightConfig
from rsgen.errors import UserError
from rsgen.irradiance import IrradianceField, Lattice, lattice_barycentric, make_field, make_lattice
from rsgen.scene import mesh_arrays

log = logging.getLogger("rsgen")

Progress = Callable[[float, str], None]  # fraction done in [0, 1], what is being done

# Raise when the method changes, so that older caches are not taken for new ones.
_METHOD = 3
_OFFSET_M = 2e-4  # ray origins above their surface
_INSET_M = 2e-3  # samples on a triangle's rim move this far inwards: a corner exactly on two surfaces sees neither
_FINE_TEXELS = 0.9  # direct light is computed at points at least about this far apart
_COARSE_TEXELS = 3.0  # and indirect light at these
_NEIGHBOURS = 8
_NORMAL_SCALE = 0.35  # normals this far apart count as much as one spacing
_SMOOTHING = 0.3  # spacings: closer sources than this count alike
_FIRST_LOOK_RAYS = 16
_FIRST_LOOK_BOUNCES = 2
_BOUNCE_RAYS = 64
_CHUNK = 1 << 18
_MANY_EMITTERS = 24
_SMALL_EMITTER_M = 0.3


@dataclass(frozen=True)
class _Points:
    """Unique sample points: position on the surface, shading normal, geometric normal, (n, 3) float32 each, and (n,)
    the number of the connected piece of surface that each lies on.
    """

    position: NDArray[np.float32]
    normal: NDArray[np.float32]
    geometric: NDArray[np.float32]
    island: NDArray[np.int64]


def baked_field(scene: Any, scene_hash: str, light: LightConfig, cache: Path, progress: Progress) -> IrradianceField:
    """The scene's irradiance: from `cache` (a folder) if it was baked with the same inputs before, else baked now."""
    lattice = make_lattice(scene, light.texel_m)
    key = cache_key(scene_hash, light)
    path = cache / f"irradiance-{key}.npz"
    stored = _load(path, lattice)
    if stored is None:
        front, back = bake(scene, lattice, light, progress)
        _store(path, front, back)
    else:
        front, back = stored
    return make_field(lattice, front, back)


def cache_key(scene_hash: str, light: LightConfig) -> str:
    """Name of a bake: hash of the scene's files, the light's settings, this method's version and the engine's."""
    facts = {
        "scene": scene_hash,
        "light": light.model_dump(exclude={"mode", "max_depth"}),
        "method": _METHOD,
        "mitsuba": mi.__version__,
        "variant": mi.variant(),
    }
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:24]


def cache_folder(scene_file: Path) -> Path:
    """Where a scene's bakes are kept: beside the scene if that is writable, else in the user's cache."""
    if os.access(scene_file.parent, os.W_OK):
        return scene_file.parent / ".rsgen-cache"
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "rsgen"


def bake(scene: Any, lattice: Lattice, light: LightConfig, progress: Progress) -> tuple[NDArray, NDArray]:
    """Irradiance (points, 4) float32 of the front and back sides: E_r, E_g, E_b (scene units), alive (0 or 1)."""
    points, index = _sample_points(scene, lattice)
    fine, fine_of_point = _thin(points, light.texel_m * _FINE_TEXELS)
    log.info("baking %d irradiance samples on %d triangles (%d stored)", len(fine), len(lattice.first), len(fine_of_point))
    total = np.zeros((len(fine), 3), np.float32)

    # A first look with few samples finds what any light reaches; only that gets the full effort.
    first_look = _direct(scene, points, fine, 2, _reporter(progress, 0.0, 0.05, "finding lit surfaces"))
    for bounce in range(_FIRST_LOOK_BOUNCES):
        field = _field(
            lattice, index, total[fine_of_point] + first_look[fine_of_point], np.ones(len(fine_of_point), bool)
        )
        report = _reporter(progress, 0.05 + 0.03 * bounce, 0.03, "finding lit surfaces")
        total = _gather(scene, field, points, fine, _FIRST_LOOK_RAYS, report)
    alive = (first_look + total).max(axis=1) > 0
    alive_point = alive[fine_of_point]
    fine = fine[alive]
    if not len(fine):
        raise UserError("the scene is dark: no light reaches any surface; add an emitter or move it into the open")

    direct = _direct(scene, points, fine, light.direct_samples, _reporter(progress, 0.11, 0.39, "direct light"))
    lit_points = np.flatnonzero(alive_point)
    to_point = _Interpolation.between(points, fine, lit_points, light.texel_m)
    coarse = fine[_thin(points, light.texel_m * _COARSE_TEXELS, fine)[0]]
    coarse_to_fine = _Interpolation.between(points, coarse, fine, light.texel_m * _COARSE_TEXELS)
    indirect = np.zeros_like(direct)
    values = np.zeros((len(points.position), 3), np.float32)
    for bounce in range(light.bounces):
        last = bounce == light.bounces - 1
        values[lit_points] = to_point(direct + indirect)
        field = _field(lattice, index, values, alive_point)
        begin = 0.5 + 0.3 * bounce / light.bounces
        report = _reporter(progress, begin, 1 - begin if last else 0.3 / light.bounces, f"bounce {bounce + 1}")
        rays = light.gather_rays if last else min(_BOUNCE_RAYS, light.gather_rays)
        indirect = coarse_to_fine(_gather(scene, field, points, coarse, rays, report))
    values[lit_points] = to_point(direct + indirect)
    table = _table(values, alive_point)
    progress(1.0, "light baked")
    return table[index[0]], table[index[1]]


def _reporter(progress: Progress, begin: float, span: float, what: str) -> Callable[[float], None]:
    return lambda fraction: progress(begin + span * fraction, what)


def _sample_points(scene: Any, lattice: Lattice) -> tuple[_Points, NDArray[np.int64]]:
    """Unique points of both sides of the lattice, and (2, points) index of each lattice point's front and back one."""
    face, uv = lattice_barycentric(lattice)
    count = len(face)
    centre = np.full((count, 2), 1 / 3, np.float32)
    position = np.empty((count, 3), np.float32)
    normal, geometric, middle = (np.empty_like(position) for _ in range(3))
    shapes = [s for s in scene.shapes() if s.is_mesh()]
    owner = np.zeros(count, np.int64)
    firsts = np.sort(lattice.shape_first[lattice.shape_first >= 0])
    owner = np.searchsorted(firsts, face, side="right") - 1
    island = np.empty(count, np.int64)
    islands = 0
    for number, shape in enumerate(shapes):
        label = _islands(*mesh_arrays(shape))
        here = np.flatnonzero(owner == number)
        island[here] = islands + label[face[here] - firsts[number]]
        islands += int(label.max()) + 1
        for part in np.array_split(here, max(1, len(here) // (1 << 20))):
            local = (face[part] - firsts[number]).astype(np.uint32)
            position[part], normal[part], geometric[part] = _surface_at(shape, local, uv[part])
            middle[part] = _surface_at(shape, local, centre[part])[0]
    # The side that shading lights, where winding and vertex normals disagree.
    geometric *= np.where(np.einsum("ij,ij->i", geometric, normal) < 0, -1, 1)[:, None].astype(np.float32)
    # Rounded positions and normals make one key: points that triangles share are computed once, so edges cannot show.
    key_parts = np.concatenate([np.round(position * 1e4), np.round(normal * 32)], axis=1).astype(np.int64)
    inward = middle - position
    distance = np.linalg.norm(inward, axis=1, keepdims=True)
    position = position + inward * np.minimum(_INSET_M / np.maximum(distance, 1e-9), 0.1)

    unique_first, index = [], np.empty((2, count), np.int64)
    multipliers = np.array([73856093, 19349663, 83492791, 2654435761, 40503, 2246822519], np.uint64)
    offset = 0
    for side, sign in enumerate((1, -1)):
        parts = key_parts * np.array([1, 1, 1, sign, sign, sign])
        with np.errstate(over="ignore"):
            key = _mix((parts.astype(np.uint64) * multipliers[None]).cumsum(axis=1))
        _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
        unique_first.append(first)
        index[side] = inverse + offset
        offset += len(first)
    front, back = unique_first
    return _Points(
        np.concatenate([position[front], position[back]]),
        np.concatenate([normal[front], -normal[back]]),
        np.concatenate([geometric[front], -geometric[back]]),
        np.concatenate([island[front], island[back]]),
    ), index


def _islands(vertices: NDArray, faces: NDArray) -> NDArray[np.int64]:
    """(f,) label of the connected piece that each triangle of a mesh belongs to; vertices at one place are one."""
    _, same = np.unique(np.round(vertices * 1e5).astype(np.int64), axis=0, return_inverse=True)
    a, b, c = same.ravel()[faces.astype(np.int64)].T
    ends = np.concatenate([a, b]), np.concatenate([b, c])
    size = int(same.max()) + 1
    edges = coo_array((np.ones(2 * len(a), bool), ends), shape=(size, size))
    return connected_components(edges, directed=False)[1][a]


def _mix(columns: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """One well-mixed 64-bit hash of each row (splitmix64's finaliser, chained over columns)."""
    h = np.zeros(len(columns), np.uint64)
    for column in columns.T:
        h = h ^ column
        h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        h = h ^ (h >> np.uint64(31))
    return h


def _surface_at(shape: Any, face: NDArray[np.uint32], uv: NDArray[np.float32]) -> tuple[NDArray, NDArray, NDArray]:
    """Position, shading normal and geometric normal, as the renderer sees them, at barycentric `uv` of triangles."""
    pi = dr.zeros(mi.PreliminaryIntersection3f, len(face))
    pi.prim_index = mi.UInt32(face)
    pi.prim_uv = mi.Point2f(uv[:, 0], uv[:, 1])
    pi.shape = mi.ShapePtr(shape)
    pi.valid = mi.Bool(True)
    ray = dr.zeros(mi.Ray3f, len(face))
    ray.d = mi.Vector3f(0, 0, 1)
    si = pi.compute_surface_interaction(ray, mi.RayFlags.All)
    return tuple(np.array(v, np.float32).reshape(3, -1).T for v in (si.p, si.sh_frame.n, si.n))  # type: ignore[return-value]


def _thin(
    points: _Points, spacing: float, among: NDArray[np.int64] | None = None
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Of `among` (default: all), one in each cell of `spacing` metres, of like normals on one piece of surface.

    Returns the chosen ones as indices into `among`, and for each of `among` which of the chosen stands for it.
    """
    position, normal, island = points.position, points.normal, points.island
    if among is not None:
        position, normal, island = position[among], normal[among], island[among]
    scaled = position / spacing
    cell = np.floor(scaled)
    off_centre = ((scaled - cell - 0.5) ** 2).sum(axis=1)
    # A buried face must not stand for a lit one just in front of it, so pieces of surface are kept apart.
    key = _mix(np.concatenate([cell, np.round(normal), island[:, None]], axis=1).astype(np.int64).astype(np.uint64))
    order = np.lexsort((off_centre, key))
    sorted_key = key[order]
    starts = np.concatenate([[True], sorted_key[1:] != sorted_key[:-1]])
    stands_for = np.empty(len(order), np.int64)
    stands_for[order] = np.cumsum(starts) - 1
    return order[starts], stands_for


@dataclass(frozen=True)
class _Interpolation:
    """Values at some points from those at `sources`: neighbours (n, k) among the sources and weights (n, k)."""

    neighbours: NDArray[np.int32]
    weights: NDArray[np.float32]

    @classmethod
    def between(cls, points: _Points, sources: NDArray, targets: NDArray, spacing: float) -> _Interpolation:
        """By distance in position (in units of `spacing` metres) and normal together."""
        scaled = np.concatenate([points.position / spacing, points.normal / _NORMAL_SCALE], axis=1)
        k = min(_NEIGHBOURS, len(sources))
        distance, neighbours = cKDTree(scaled[sources]).query(scaled[targets], k=k, workers=-1, eps=0.2)
        distance, neighbours = distance.reshape(-1, k), neighbours.reshape(-1, k)
        # Falls to zero at the furthest neighbour, so that the interpolant is continuous as neighbours change, and
        # grows without bound towards a source, so that it passes through the sources.
        near = np.clip(1 - (distance / (distance[:, -1:] * 1.0001 + 1e-9)) ** 2, 0, 1) ** 2
        weights = (near + 1e-6) / (distance**2 + _SMOOTHING**2)
        weights /= weights.sum(axis=1, keepdims=True)
        return cls(neighbours.astype(np.int32), weights.astype(np.float32))

    def __call__(self, at_sources: NDArray[np.float32]) -> NDArray[np.float32]:
        out = np.zeros((len(self.neighbours), 3), np.float32)
        for k in range(self.neighbours.shape[1]):
            out += self.weights[:, k, None] * at_sources[self.neighbours[:, k]]
        return out


def _table(values: NDArray, alive: NDArray) -> NDArray[np.float32]:
    return np.where(alive[:, None], np.concatenate([values, alive[:, None]], axis=1), 0).astype(np.float32)


def _field(lattice: Lattice, index: NDArray, values: NDArray, alive: NDArray) -> IrradianceField:
    table = _table(values, alive)
    return make_field(lattice, table[index[0]], table[index[1]])


def _rotation(index: Any, dimension: int) -> Any:
    """Uniform offset in [0, 1) from a hash of a point's number and a dimension."""
    return mi.sample_tea_float32(index, mi.UInt32(dimension), 4)


def _r2(i: Any, offset: Any) -> Any:
    """Point i of the R2 low-discrepancy sequence (Roberts 2018), rotated by `offset`."""
    x = offset.x + mi.Float(i) * 0.7548776662466927
    y = offset.y + mi.Float(i) * 0.5698402909980532
    return mi.Point2f(x - dr.floor(x), y - dr.floor(y))


def _chunks(points: _Points, which: NDArray, report: Callable[[float], None]):
    for begin in range(0, len(which), _CHUNK):
        part = which[begin : begin + _CHUNK]
        p, n, g = (mi.Vector3f(a[part].T) for a in (points.position, points.normal, points.geometric))
        yield begin, part, mi.Point3f(p + g * _OFFSET_M), n, mi.UInt32(part.astype(np.uint32))
        report(min(1.0, (begin + len(part)) / len(which)))


def _direct(scene: Any, points: _Points, which: NDArray, samples: int, report: Callable[[float], None]) -> NDArray:
    """Direct irradiance (len(which), 3) from all emitters, `samples` for each."""
    out = np.zeros((len(which), 3), np.float32)
    emitters = scene.emitters()
    for begin, part, p, n, number in _chunks(points, which, report):
        total = mi.Color3f(0)
        if len(emitters) > _MANY_EMITTERS:
            total = _from_emitter(scene, None, p, n, number, samples * _MANY_EMITTERS, 0)
        else:
            for k, emitter in enumerate(emitters):
                total += _from_emitter(scene, emitter, p, n, number, _samples_for(emitter, samples), k)
                dr.eval(total)
        out[begin : begin + len(part)] = np.array(total).reshape(3, -1).T
    return out


def _samples_for(emitter: Any, samples: int) -> int:
    """A small emitter's penumbra is narrow: a quarter of the samples serves as well."""
    shape = emitter.get_shape()
    small = shape is not None and dr.norm(shape.bbox().extents()) < _SMALL_EMITTER_M
    return max(1, samples // 4) if small else samples


@dr.syntax
def _from_emitter(scene, emitter, p, n, number, samples, dimension):
    """Mean irradiance at p (normal n) from one emitter, or from a random one where `emitter` is None."""
    it = dr.zeros(mi.Interaction3f, dr.width(p))
    it.p = p
    it.t = mi.Float(1)
    it.n = mi.Normal3f(n)
    offset = mi.Point2f(_rotation(number, 2 * dimension), _rotation(number, 2 * dimension + 1))
    count = dr.opaque(mi.UInt32, samples)
    total = mi.Color3f(0)
    i = mi.UInt32(0)
    while i < count:
        u = _r2(i, offset)
        if dr.hint(emitter is None, mode="scalar"):
            ds, value = scene.sample_emitter_direction(it, u, False)
        else:
            ds, value = emitter.sample_direction(it, u)
        cosine = dr.dot(n, ds.d)
        lit = (cosine > 0) & (ds.pdf > 0) & (dr.max(value) > 0)
        # Short of the emitter itself, whose surface would shadow its own sample.
        shadow = mi.Ray3f(p, ds.d, ds.dist * (1 - 1e-4) - 1e-5, 0.0, mi.Color0f())
        lit &= ~scene.ray_test(shadow, active=lit)
        total += dr.select(lit, value * cosine, 0)
        i += 1
    return total / mi.Float(count)


def _gather(
    scene: Any, field: IrradianceField, points: _Points, which: NDArray, rays: int, report: Callable[[float], None]
) -> NDArray:
    """Irradiance (len(which), 3) that arrives from other surfaces, each lit as `field` says."""
    out = np.zeros((len(which), 3), np.float32)
    for begin, part, p, n, number in _chunks(points, which, report):
        out[begin : begin + len(part)] = np.array(_gather_at(scene, field, p, n, number, rays)).reshape(3, -1).T
    return out


@dr.syntax
def _gather_at(scene, field, p, n, number, rays):
    frame = mi.Frame3f(n)
    offset = mi.Point2f(_rotation(number, 101), _rotation(number, 102))
    lobe = _rotation(number, 103)
    count = dr.opaque(mi.UInt32, rays)
    context = mi.BSDFContext()
    total = mi.Color3f(0)
    i = mi.UInt32(0)
    while i < count:
        u = _r2(i, offset)
        d = frame.to_world(mi.warp.square_to_cosine_hemisphere(u))
        ray = mi.Ray3f(p, d)
        pi = scene.ray_intersect_preliminary(ray, coherent=False)
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All)
        hit = si.is_valid()
        # The sampled weight's mean is the albedo, exactly and without noise for Lambert's law.
        pick = lobe + mi.Float(i) * 0.6180339887498949
        _, albedo = si.bsdf(ray).sample(context, si, pick - dr.floor(pick), mi.Point2f(u.y, u.x), hit)
        total += dr.select(hit, albedo * field.lookup(pi, si, -d, hit), 0)
        i += 1
    # ∫ E ρ/π cosθ dω with pdf cosθ/π: the mean of ρ E.
    return total / mi.Float(count)


def _load(path: Path, lattice: Lattice) -> tuple[NDArray, NDArray] | None:
    """Both sides of a stored bake, or None if there is none that fits (a damaged file is baked again)."""
    try:
        with np.load(path) as data:
            front, back = data["front"].astype(np.float32), data["back"].astype(np.float32)
    except (OSError, ValueError, KeyError, EOFError):
        return None
    return (front, back) if front.shape == back.shape == (lattice.points, 4) else None


def _store(path: Path, front: NDArray, back: NDArray) -> None:
    """Write atomically; a cache that cannot be written only costs time, so it is no error."""
    temporary = path.with_suffix(f".{os.getpid()}.tmp.npz")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(temporary, front=front, back=back)
        temporary.replace(path)
    except OSError as error:
        log.warning("light cache %s cannot be written (%s): it will be baked again next time", path, error.strerror)
        temporary.unlink(missing_ok=True)
