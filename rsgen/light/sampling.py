"""Estimates of light at surface points: drawn until their scatter is out of sight, then smoothed and interpolated.

Random numbers are the same each time. Each point gets as many samples as what their scatter shows needs, and no more.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from rsgen.array_types import Float32Array, FloatArray, IntArray
from rsgen.device.arrays import aligned
from rsgen.light.surface_points import SamplePoints, in_order, row_hash

CHANNELS = 4  # of light: see `in_channels`
_ETA = 1.5  # of lacquer
_GETS_IN = 0.90822  # of light from all sides alike: the mean over cosine-distributed directions of what Fresnel lets in
_CHUNK = 1 << 20


def in_channels(light: Any, cosine: Any) -> Any:
    """(Vector4f) irradiance by one direction, of this cosine: red, green, blue, and how much of it gets into lacquer.

    The last as a part of what would get in were it from all sides, in grey: what is beneath lacquer is lit by so much
    less by what comes at a glance, and by 6 % more by what comes straight.
    """
    gets_in = (1 - mi.fresnel(dr.clip(cosine, 0, 1), _ETA)[0]) / _GETS_IN
    # Not by dr.mean: it has the number of rays as a constant, and each number is another kernel to compile.
    grey = (light.x + light.y + light.z) * (1 / 3)
    return mi.Vector4f(light.x, light.y, light.z, grey * gets_in)


def rotation(index: Any, dimension: int) -> Any:
    """Uniform offset in [0, 1) from a hash of a point's number and a dimension, which is no part of the program."""
    return mi.sample_tea_float32(index, dr.opaque(mi.UInt32, dimension), 4)


def r2(i: Any, offset: Any) -> Any:
    """Point i of the R2 low-discrepancy sequence (Roberts 2018), rotated by `offset`."""
    x = offset.x + mi.Float(i) * 0.7548776662466927
    y = offset.y + mi.Float(i) * 0.5698402909980532
    return mi.Point2f(x - dr.floor(x), y - dr.floor(y))


def golden(i: Any, offset: Any) -> Any:
    """Number i of the sequence in [0, 1) that goes by the golden ratio from `offset` on."""
    x = offset + mi.Float(i) * 0.6180339887498949
    return x - dr.floor(x)


def interaction(p: Any, n: Any) -> Any:
    """Interaction3f at points p of normal n."""
    it = dr.zeros(mi.Interaction3f, dr.width(p))
    it.p, it.t, it.n = p, mi.Float(1), mi.Normal3f(n)
    return it


@dr.syntax
def in_halves(begin, count, light, bit=1):
    """Sums (Vector4f) over two halves of the samples light(i), i from `begin` to `begin + count`, by a bit of i."""
    i = dr.opaque(mi.UInt32, begin)
    end = i + dr.opaque(mi.UInt32, count)
    even, odd = mi.Vector4f(0), mi.Vector4f(0)
    while i < end:
        sample = light(i)
        first = (i & bit) == 0
        even += dr.select(first, sample, 0)
        odd += dr.select(first, 0, sample)
        i += 1
    return even, odd


def about_normal(
    p: Any, n: Any, number: Any, begin: int, count: int, dimension: int, light_along: Callable[[Any, Any, Any], Any]
) -> tuple[Any, Any]:
    """Sums over two halves of the cosine-distributed rays `begin` to `begin + count` from p about n.

    dimension: the first of three for random numbers (see `rotation`). light_along: of (ray, its number i, a uniform
    number for lots) π times the radiance that comes along it: with pdf cosθ/π, ∫ L cosθ dω is the mean of πL.
    """
    frame = mi.Frame3f(n)
    offset = mi.Point2f(rotation(number, dimension), rotation(number, dimension + 1))
    lobe = rotation(number, dimension + 2)

    def light(i: Any) -> Any:
        d = mi.warp.square_to_cosine_hemisphere(r2(i, offset))
        return in_channels(light_along(mi.Ray3f(p, frame.to_world(d)), i, golden(i, lobe)), d.z)

    return in_halves(begin, count, light)


def shaded_nearby(scene: Any, points: SamplePoints, which: NDArray, within_m: float, rays: int) -> FloatArray:
    """Part (n,) of the light from all sides that things less than `within_m` away would take, the farther the less."""
    within, out = dr.opaque(mi.Float, within_m), np.zeros(len(which))

    def taken_along(ray: Any, _: Any, __: Any) -> Any:
        ray.maxt = within
        pi = scene.ray_intersect_preliminary(ray, coherent=False)
        return mi.Color3f(dr.select(pi.is_valid(), 1 - dr.square(pi.t / within), 0))

    for begin, part, p, n, number in chunks(points, which, lambda _: None):
        even, odd = about_normal(p, n, number, 0, rays, 0, taken_along)
        out[begin : begin + len(part)] = np.array(even.x + odd.x) / rays
    return out


def chunks(
    points: SamplePoints, which: NDArray, report: Callable[[float], None], size: int = _CHUNK
) -> Iterator[tuple[int, NDArray, Any, Any, Any]]:
    """(first of them, their numbers, ray origins, normals and numbers on the device) of `which`, `size` at a time."""
    origin, normal = points.on_device
    for begin in range(0, len(which), size):
        part = which[begin : begin + size]
        number = mi.UInt32(aligned(part, np.uint32))
        yield begin, part, dr.gather(mi.Point3f, origin, number), dr.gather(mi.Vector3f, normal, number), number
        report(min(1.0, (begin + len(part)) / len(which)))


# Of (which points, begin, count, progress): sums (2, n, 4) over two halves of their samples `begin` to `begin + count`.
Sampler = Callable[[IntArray, int, int, Callable[[float], None]], Float32Array]

GREY_SLOPE = 0.21  # of sRGB at its middle, by the logarithm of light
_TONE = 1 / 2.4  # sRGB goes by this power of light
PATCH = 8.0  # spacings that noise's size is estimated over


def part_of(report: Callable[[float], None], begin: float, span: float) -> Callable[[float], None]:
    """Reports the progress of one part of a whole, which begins at `begin` of that and is `span` of it."""
    return lambda fraction: report(begin + span * fraction)


def standard_error(patch: IntArray, halves: NDArray) -> FloatArray:
    """Standard error (n,) of the mean of two independent estimates (2, n, 4) in grey, of each point's patch (n,)."""
    a, b = halves.mean(axis=2)
    return np.sqrt((np.bincount(patch, (a - b) ** 2) / (4 * np.bincount(patch)))[patch])


def typical(light: FloatArray) -> float:
    """The light (n,) that a camera is exposed for: half of the places have more, those left out that hardly have any.

    Hardly any is a hundredth of what the place has that half of all light falls short of; 0 where there is none at all.
    """
    return _typical(np.sort(light))


def _typical(rising: FloatArray) -> float:
    total = np.cumsum(rising)
    if not len(rising) or total[-1] <= 0:
        return 0.0
    common = rising[np.searchsorted(total, 0.5 * total[-1])]
    return float(np.median(rising[rising >= 0.01 * common]))


def visible_error(patch: IntArray, sigma: FloatArray, grey: FloatArray) -> FloatArray:
    """What an error sigma (n,) beside light `grey` (n,) amounts to, as a part of a mid-grey surface's light.

    A camera is exposed for what is typical: in the shade of that, sRGB shows less of an error. In what is brighter than
    that, as in what is overexposed, it is taken for no more.
    """
    size = np.bincount(patch)
    return sigma * _visible_unit_error(size, np.bincount(patch, grey) / np.maximum(size, 1))[patch]


def _visible_unit_error(size: IntArray, light: FloatArray) -> FloatArray:
    """`visible_error` of an error of 1 in each of the patches, which have so many points and such light, (p,) each."""
    order = np.argsort(light)
    exposed = _typical(np.repeat(light[order], size[order]))
    if exposed <= 0:
        return np.zeros(len(light))
    return np.minimum(np.maximum(light / exposed, 1e-12), 1.0) ** _TONE / np.maximum(light, 1e-30)


def sampled_adaptively(
    draw: Sampler, patch: IntArray, light: Callable[[NDArray], NDArray], scatter: float, first: int, rounds: int,
    effort: float, report: Callable[[float], None],
) -> tuple[Float32Array, FloatArray]:  # fmt: skip
    """Means (2, n, 4) of the halves of what `draw` drew at n points, and the `visible_error` (n,) left.

    patch: what each point's noise is estimated over. light: all the light (n,) of points, in grey, given what this kind
    brings. After the first round, each draws as much again as all before it, where more than `scatter` is left, the
    worst first while no more than `effort` samples a point are drawn on the average.
    """
    n, size = len(patch), np.bincount(patch)
    sums, drawn = np.zeros((2, n, CHANNELS), np.float32), np.zeros(n, np.int64)
    apart, grey, left = np.zeros((3, n))  # of a point's halves, squared; of their mean
    todo: IntArray | slice = slice(None)
    of_todo = np.arange(n)
    for k in range(rounds):
        begin = int(drawn[of_todo[0]])
        count = first if k == 0 else begin
        own = sums[:, todo] + draw(of_todo, begin, count, part_of(report, k / rounds, 1 / rounds))
        sums[:, todo] = own
        drawn[todo] += count
        halves = own.mean(axis=2, dtype=np.float64) * (2 / (begin + count))
        apart[todo], grey[todo] = (halves[0] - halves[1]) ** 2, halves.mean(axis=0)
        # A patch's points have one error, so it is patches that are looked at.
        sigma = np.sqrt(np.bincount(patch, apart) / np.maximum(4 * size, 1))
        shows = sigma * _visible_unit_error(size, np.bincount(patch, light(grey)) / np.maximum(size, 1))
        left = shows[patch]
        of_todo = of_todo[left[of_todo] > scatter]
        most = int(min(max(0.0, effort * n - drawn.sum()) / drawn.max(), n))
        if len(of_todo) > most:
            of_todo = np.sort(of_todo[np.argsort(-left[of_todo], kind="stable")[:most]])
        todo = of_todo
        if not len(of_todo):
            break
    report(1.0)
    return np.divide(sums, drawn[:, None] / 2, out=sums), left


def sampler_at(points: SamplePoints, which: IntArray, sample: Callable[..., Any]) -> Sampler:
    """A `Sampler` at the points `which`, from `sample(points on the device, their places in `which`, begin, count)`."""

    def draw(todo: IntArray, begin: int, count: int, report: Callable[[float], None]) -> Float32Array:
        out = np.zeros((2, len(todo), CHANNELS), np.float32)
        for first, part, *at in chunks(points, which[todo], report):
            here = slice(first, first + len(part))
            sums = sample(at, todo[here], begin, count)
            dr.eval(sums)
            for half, k in np.ndindex(2, CHANNELS):
                out[half, here, k] = np.array(sums[half][k])
        return out

    return draw


_NEIGHBOURS = 8
_SMOOTHING = 0.3  # spacings: closer sources than this count alike
_STEP, _BEYOND = 0.15, 1e-3  # spacings: of a step in a surface; what is beyond one counts for so little
_INTERPOLATED_AT_ONCE = 1 << 18
_DENOISED_OVER = 32
_DENOISING_REACH = 2.0  # spacings: of the weight's fall with distance
_DENOISING_CHUNK = 1 << 17


def thin(
    points: SamplePoints, spacing: float, among: IntArray | None = None, steps: bool = False
) -> tuple[IntArray, IntArray]:
    """Of `among` (default: all), one in each cell of `spacing` metres, of like normals on one piece of surface.

    steps: none stands for what is a step above or below it, as the bottom of a groove is. Returns the chosen ones as
    indices into `among`, and for each of `among` which of the chosen stands for it.
    """
    position, normal, piece = points.position, points.normal, points.piece
    if among is not None:
        position, normal, piece = position[among], normal[among], piece[among]
    cell = np.floor(position / spacing)
    off_centre = ((position / spacing - cell - 0.5) ** 2).sum(axis=1)
    # A buried face must not stand for a lit one just in front of it, so pieces of surface are kept apart.
    facing = np.round(normal)
    key = row_hash(*cell.T, *facing.T, piece)
    if steps:
        above = np.einsum("ij,ij->i", position / spacing - cell, facing / np.linalg.norm(facing, axis=1, keepdims=True))
        key = row_hash(key.view(np.int64), np.floor(above / _STEP).astype(np.int64))
    del cell
    order = np.lexsort((off_centre, key))
    sorted_key = key[order]
    starts = np.concatenate([[True], sorted_key[1:] != sorted_key[:-1]])
    chosen, rank = in_order(order[starts])
    stands_for = np.empty(len(order), np.int64)
    stands_for[order] = rank[np.cumsum(starts) - 1]
    return chosen, stands_for


@dataclass(frozen=True)
class Interpolation:
    """Values at some points from those at `sources`: neighbours (n, k) among the sources and weights (n, k)."""

    neighbours: NDArray[np.int32]
    weights: Float32Array

    @classmethod
    def between(cls, points: SamplePoints, sources: NDArray, targets: NDArray, spacing: float) -> Interpolation:
        """By distance in position (in units of `spacing` metres) and normal together, within one piece of surface.

        The dark inside of a thin sheet is a millimetre from its lit outside and has the normal of the other outside.
        """
        k = min(_NEIGHBOURS, len(sources))
        tree = cKDTree(points.coordinates(spacing, sources))
        near, weights = np.empty((len(targets), k), np.int32), np.empty((len(targets), k), np.float32)
        for begin in range(0, len(targets), _INTERPOLATED_AT_ONCE):
            part = slice(begin, begin + _INTERPOLATED_AT_ONCE)
            found = tree.query(points.coordinates(spacing, targets[part]), k=k, workers=-1, eps=0.2)
            distance, near[part] = (np.reshape(v, (-1, k)) for v in found)
            # Falls to zero at the furthest neighbour, so that the interpolant is continuous as neighbours change, and
            # grows without bound towards a source, so that it passes through the sources.
            falling = np.clip(1 - (distance / (distance[:, -1:] * 1.0001 + 1e-9)) ** 2, 0, 1) ** 2
            weight = (falling + 1e-6) / (distance**2 + _SMOOTHING**2)
            apart = points.position[sources[near[part]]] - points.position[targets[part], None]
            step = np.einsum("nki,ni->nk", apart, points.normal[targets[part]]) / (_STEP * spacing)
            weight *= np.exp(-(step**2)) + _BEYOND
            weights[part] = weight / weight.sum(axis=1, keepdims=True)
        return cls(near, weights)

    def __call__(self, at_sources: Float32Array) -> Float32Array:
        n, k = self.neighbours.shape
        rows = np.arange(0, n * k + 1, k)
        flat = self.weights.ravel(), self.neighbours.ravel(), rows
        return np.asarray(csr_array(flat, shape=(n, len(at_sources))) @ at_sources.astype(np.float32, copy=False))

    def spread(self, at_sources: FloatArray) -> FloatArray:
        """Standard deviation (n,), by their weights, of the values (m,) that each one is interpolated from."""
        mean, square = np.zeros((2, len(self.neighbours)))
        for weight, near in zip(self.weights.T, self.neighbours.T, strict=True):
            mean += weight * at_sources[near]
            square += weight * at_sources[near] ** 2
        return np.sqrt(np.maximum(square - mean**2, 0.0))


def denoised(
    points: SamplePoints, which: IntArray, halves: NDArray, sigma: FloatArray, spacing: float, noisy: IntArray
) -> Float32Array:
    """Mean (n, 4) of two independent estimates (2, n, 4) of irradiance, smoothed where noise hides any difference.

    sigma: standard error (n,) of the mean, in grey. noisy: which of the points are looked at, the others stay.
    Each half is averaged with weights by the other (Rousselle, Manzi, Zwicker, PG 2013), so that noise does not choose
    what it is averaged with: edges of shadows stay.
    """
    out = halves.mean(axis=0).astype(np.float32)
    if not len(noisy):
        return out
    scaled = points.coordinates(_DENOISING_REACH * spacing, which)
    grey = halves.mean(axis=2)
    # Variance of one half: of a point that scatters more than its neighbours its own.
    half = np.maximum(2.0 * sigma**2, 0.5 * (grey[0] - grey[1]) ** 2)
    tree = cKDTree(scaled)
    k = min(_DENOISED_OVER, len(which))
    for begin in range(0, len(noisy), _DENOISING_CHUNK):
        part = noisy[begin : begin + _DENOISING_CHUNK]
        distance, near = (np.reshape(v, (-1, k)) for v in tree.query(scaled[part], k=k, workers=-1))
        spread = half[part, None] + half[near]
        smoothed = np.zeros((len(near), halves.shape[2]))
        for one, other in ((0, 1), (1, 0)):
            apart = (grey[other][part, None] - grey[other][near]) ** 2 - spread
            weight = np.exp(-0.5 * distance**2 - np.maximum(apart, 0) / np.maximum(spread, 1e-20))
            smoothed += np.einsum("nk,nkc->nc", weight, halves[one][near]) / (2 * weight.sum(axis=1, keepdims=True))
        out[part] = smoothed
    return out
