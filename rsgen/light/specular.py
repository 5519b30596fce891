"""Light by way of what mirrors or lets through: rays followed to surfaces and lamps, shadows of panes, and caustics.

Caustics are of lacquer and brushed metal: photons from lit places on them along their lobes to where they land. A ray
from where the light lands finds the sun in a varnished table one time in a thousand, so light is followed from the
table instead (photon mapping: Jensen 1996). Photons are averaged over decimetres: they are few.
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
from rsgen.light.sampling import CHANNELS, about_normal, golden, in_channels, rotation, sampler_at, shaded_nearby, thin
from rsgen.light.surface_points import SamplePoints
from rsgen.render.irradiance import at_triangles, registry_id
from rsgen.scene.meshes import mesh_corners, meshes_of
from rsgen.scene.rays import proper

# Panes and mirrors that a ray is followed through: a double-glazed window seen in a mirror has nine.
_MOST = 10
_STRAIGHT = int(mi.BSDFFlags.Delta) | int(mi.BSDFFlags.Null)
_NULL = int(mi.BSDFFlags.Null)
_GLOSSY = int(mi.BSDFFlags.Glossy)
_SPECULAR = _GLOSSY | _STRAIGHT
_DIFFUSE = int(mi.BSDFFlags.DiffuseReflection) | int(mi.BSDFFlags.DiffuseTransmission)


def passes_light_on(scene: Any) -> bool:
    """Whether a scene has panes, mirrors or cut-out surfaces."""
    return any(f & _NULL or (f & _STRAIGHT and not f & _DIFFUSE) for f in _kinds(scene))


def shines(scene: Any) -> bool:
    """Whether anything in a scene mirrors or lets through, be it faintly like lacquer or blurred like brushed metal."""
    return any(f & _SPECULAR for f in _kinds(scene))


def casts_caustics(shape: Any) -> bool:
    """Whether a surface is matte beneath what mirrors, or mirrors blurred: lacquer, satin, brushed metal."""
    kind = _kind(shape)
    return bool(kind & _GLOSSY or (kind & _STRAIGHT and kind & _DIFFUSE and not kind & _NULL))


def _kinds(scene: Any) -> list[int]:
    return [_kind(shape) for shape in scene.shapes()]


def _kind(shape: Any) -> int:
    return int(shape.bsdf().flags()) if shape.bsdf() is not None else 0


@dr.syntax
def first_scatterer(scene, ray, pick, follow, active):
    """What a ray meets behind panes and mirrors; without `follow` what it meets.

    pick: uniform in [0, 1), which lobe of glass and of cut-outs is taken. Returns its hit, the surface there, the ray
    that met it, what gets through (Color3f), and whether the ray was turned on its way: through thin panes and
    cut-outs it goes straight on (`transmitted`).
    """
    context = mi.BSDFContext()
    through = mi.Color3f(1)
    passed = mi.UInt32(0)
    turned = mi.Bool(False)
    going = mi.Bool(active)
    pi = scene.ray_intersect_preliminary(ray, coherent=False, active=going)
    if dr.hint(follow, mode="scalar"):
        while going:
            # Most of what is met is matte: flags show that without the costly description of the place.
            kind = pi.shape.bsdf().flags()
            going &= pi.is_valid() & (passed < _MOST) & ((kind & _STRAIGHT) != 0)
            si = pi.compute_surface_interaction(ray, mi.RayFlags.All, going)
            bsdf = si.bsdf(ray)
            u = golden(passed, pick)
            bs, weight = bsdf.sample(context, si, u, mi.Point2f(u, 0.5), going)
            straight_on = (bs.sampled_type & _NULL) != 0
            going &= straight_on | (((bs.sampled_type & _STRAIGHT) != 0) & ((kind & _DIFFUSE) == 0))
            turned |= going & ~straight_on
            through = dr.select(going, through * weight, through)
            onward = si.spawn_ray(si.to_world(bs.wo))
            ray.o = dr.select(going, onward.o, ray.o)
            ray.d = dr.select(going, onward.d, ray.d)
            again = scene.ray_intersect_preliminary(ray, coherent=False, active=going)
            pi = dr.select(going, again, pi)
            passed = dr.select(going, passed + 1, passed)
    si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
    return pi, si, ray, through, turned


@dr.syntax
def surface_radiance(scene, field, ray, number, i, pick, follow):
    """Radiance times π (Color3f) that matte surfaces send along a ray, lit as `field` states.

    With `follow` by way of whatever mirrors or lets through, which of a surface's lobes by lot; without, the first
    surface counts as matte altogether, as the last one does after many. number, i: of the place and of its ray, for
    random numbers; pick: uniform in [0, 1), the first lot.
    """
    context = mi.BSDFContext()
    light = mi.Color3f(0)
    through = mi.Color3f(1)
    passed = mi.UInt32(0)
    going = mi.Bool(True)
    while going:
        pi = scene.ray_intersect_preliminary(ray, coherent=False, active=going)
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, going)
        going &= si.is_valid()
        # The sampled weight's mean is the albedo ρ, exactly and without noise for Lambert's law.
        bs, weight = si.bsdf(ray).sample(context, si, pick, _drawn(number, i, passed), going)
        onward = going & ((bs.sampled_type & _SPECULAR) != 0) & (passed < _MOST) & (dr.max(weight) > 0)
        if dr.hint(not follow, mode="scalar"):
            onward = mi.Bool(False)
        ends = going & ~onward
        # Lambert's surface sends L = ρE/π.
        light += dr.select(ends, through * weight * field.lookup(pi, si, -ray.d, ends), 0)
        through = dr.select(onward, through * weight, through)
        ray = si.spawn_ray(si.to_world(bs.wo))
        going = onward
        passed += 1
        pick = golden(1, pick)
    return light


@dr.syntax
def caustic_radiance(scene, ray, number, i, pick):
    """Radiance (Color3f) of lamps and sky that comes along a ray by way of lacquer or brushed metal.

    Arguments as of `surface_radiance`. What brushed metal blurs is found by sampling lamps and lobe, with the balance
    heuristic (Veach and Guibas 1995).
    """
    specular = mi.BSDFContext()
    specular.type_mask = _SPECULAR
    light = mi.Color3f(0)
    through = mi.Color3f(1)
    passed = mi.UInt32(0)
    thrown = mi.Bool(False)  # by lacquer or brushed metal
    blurred = mi.Bool(False)  # at the last turn, by a lobe of this density, there
    density = mi.Float(1)
    there = dr.zeros(mi.Interaction3f, dr.width(ray.o))
    going = mi.Bool(True)
    while going:
        pi = scene.ray_intersect_preliminary(ray, coherent=False, active=going)
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, going)
        emitter = si.emitter(scene, going)
        found = going & (emitter != dr.zeros(mi.EmitterPtr)) & thrown
        towards = mi.DirectionSample3f(scene, si, there)
        drawn = scene.pdf_emitter_direction(there, towards, found & blurred)
        share = dr.select(blurred, density / dr.maximum(density + drawn, 1e-20), 1)
        light += dr.select(found, through * share * emitter.eval(si, found), 0)
        bsdf = si.bsdf(ray)
        kind = bsdf.flags()
        going &= si.is_valid() & ((kind & _SPECULAR) != 0) & (passed < _MOST)
        brushed = going & ((kind & _GLOSSY) != 0)
        ds, value = scene.sample_emitter_direction(si, _drawn(number, i, 2 * _MOST + passed), False, brushed)
        cast, lobe = bsdf.eval_pdf(specular, si, si.to_local(ds.d), brushed)
        gain = value * cast * dr.select(ds.delta, 1, ds.pdf / dr.maximum(ds.pdf + proper(lobe), 1e-20))
        lit = brushed & (ds.pdf > 0) & (dr.max(through * gain) > 0)
        lit &= ~scene.ray_test(si.spawn_ray_to(ds.p), lit)
        light += dr.select(lit, through * gain, 0)
        bs, weight = bsdf.sample(specular, si, pick, _drawn(number, i, passed), going)
        through = dr.select(going, through * weight, through)
        going &= dr.max(through) > 0
        thrown |= going & ((bs.sampled_type & _NULL) == 0) & ((kind & (_GLOSSY | _DIFFUSE)) != 0)
        blurred = (bs.sampled_type & _GLOSSY) != 0
        density = proper(bs.pdf)
        there = mi.Interaction3f(si)
        ray = si.spawn_ray(si.to_world(bs.wo))
        passed += 1
        pick = golden(1, pick)
    return light


def _drawn(number: Any, i: Any, passed: Any) -> Any:
    """Two uniform numbers for a ray's turn."""
    seed = i * (4 * _MOST) + passed
    return mi.Point2f(mi.sample_tea_float32(number, 2 * seed, 4), mi.sample_tea_float32(number, 2 * seed + 1, 4))


@dr.syntax
def transmitted(scene, p, d, distance, active, follow):
    """Part (Color3f) of the light that gets straight from `distance` along d (unit) to p; with `follow` through panes.

    Panes that bend light, of a thickness, throw a shadow; what they let through is found by `first_scatterer`.
    """
    # Short of the emitter itself, whose surface would shadow its own sample.
    length = distance * (1 - 1e-4) - 1e-5
    end = p + d * length
    ray = mi.Ray3f(p, d, length, 0.0, mi.Color0f())
    if dr.hint(not follow, mode="scalar"):
        return mi.Color3f(dr.select(active & ~scene.ray_test(ray, active=active), 1, 0))
    through = mi.Color3f(dr.select(active, 1, 0))
    passed = mi.UInt32(0)
    going = mi.Bool(active)
    while going:
        pi = scene.ray_intersect_preliminary(ray, coherent=False, active=going)
        going &= pi.is_valid()
        clear = going & ((pi.shape.bsdf().flags() & _NULL) != 0) & (passed < _MOST)
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, clear)
        share = si.bsdf(ray).eval_null_transmission(si, clear)
        through = dr.select(clear, through * share, dr.select(going, 0, through))
        onward = si.spawn_ray(ray.d)
        # It goes on a little beside its line, and is aimed anew: else it would reach into the emitter.
        rest = end - onward.o
        length = dr.norm(rest)
        ray.o = dr.select(clear, onward.o, ray.o)
        ray.d = dr.select(clear, rest / length, ray.d)
        ray.maxt = dr.select(clear, length, ray.maxt)
        going = clear & (dr.max(through) > 0)
        passed += 1
    return through


# Where photons land, the normals of the sides they land on, (n, 3) each, and what each brings, W: (n, CHANNELS).
Photons = tuple[NDArray, NDArray, NDArray]

_A_SAMPLE, _MOST_PHOTONS, _BATCH = 1 << 15, 1 << 21, 1 << 18  # for each of a point's samples, in all, at a time
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
    for landed in _photons(scene, shapes, min(_MOST_PHOTONS, samples * _A_SAMPLE), follow):
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
    specular.type_mask = _SPECULAR
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
