"""Light drawn in rounds: at each point of a surface as many samples as what it shows needs, and no more."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from rsgen.array_types import Float32Array, FloatArray, IntArray
from rsgen.light.places.sampling import CHANNELS

# Sums (2, n, 4) over two halves of the samples `begin` to `begin + count` at some points, which it is told.
Draw = Callable[[IntArray, int, int, Callable[[float], None]], Float32Array]

GREY_SLOPE = 0.21  # of sRGB at its middle, by the logarithm of light
_TONE = 1 / 2.4  # sRGB goes by this power of light
PATCH = 8.0  # spacings that noise's size is estimated over


def scatter_of(patch: IntArray, halves: NDArray) -> FloatArray:
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


def shown(patch: IntArray, sigma: FloatArray, grey: FloatArray) -> FloatArray:
    """What an error sigma (n,) beside light `grey` (n,) amounts to, as a part of a mid-grey surface's light.

    A camera is exposed for what is typical: in the shade of that, sRGB shows less of an error. In what is brighter than
    that, as in what is overexposed, it is taken for no more.
    """
    size = np.bincount(patch)
    return sigma * _shown_of_one(size, np.bincount(patch, grey) / np.maximum(size, 1))[patch]


def _shown_of_one(size: IntArray, light: FloatArray) -> FloatArray:
    """`shown` of an error of 1 in each of the patches, which have so many points and such light, (p,) each."""
    order = np.argsort(light)
    exposed = _typical(np.repeat(light[order], size[order]))
    if exposed <= 0:
        return np.zeros(len(light))
    return np.minimum(np.maximum(light / exposed, 1e-12), 1.0) ** _TONE / np.maximum(light, 1e-30)


def in_rounds(
    draw: Draw, patch: IntArray, light: Callable[[NDArray], NDArray], scatter: float, first: int, rounds: int,
    effort: float, report: Callable[[float], None],
) -> tuple[Float32Array, FloatArray]:  # fmt: skip
    """Means (2, n, 4) of the halves of what `draw` drew at n points, and the errors (n,) left, as `shown` has them.

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

        def share(f: float, k: int = k) -> None:
            report((k + f) / rounds)

        own = sums[:, todo] + draw(of_todo, begin, count, share)
        sums[:, todo] = own
        drawn[todo] += count
        halves = own.mean(axis=2, dtype=np.float64) * (2 / (begin + count))
        apart[todo], grey[todo] = (halves[0] - halves[1]) ** 2, halves.mean(axis=0)
        # A patch's points have one error, so it is patches that are looked at.
        sigma = np.sqrt(np.bincount(patch, apart) / np.maximum(4 * size, 1))
        shows = sigma * _shown_of_one(size, np.bincount(patch, light(grey)) / np.maximum(size, 1))
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


def drawn_at(which: IntArray, chunks: Callable[..., Any], sample: Callable[..., Any]) -> Draw:
    """A `Draw` at the points `which`, from `sample(points on the device, their places in `which`, begin, count)`."""

    def draw(todo: IntArray, begin: int, count: int, report: Callable[[float], None]) -> Float32Array:
        out = np.zeros((2, len(todo), CHANNELS), np.float32)
        for first, part, *at in chunks(which[todo], report):
            here = slice(first, first + len(part))
            sums = sample(at, todo[here], begin, count)
            dr.eval(sums)
            for half, k in np.ndindex(2, CHANNELS):
                out[half, here, k] = np.array(sums[half][k])
        return out

    return draw
