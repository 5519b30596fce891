"""All pairs of a window at once: as each by itself, and their normal equations as written out."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from nightly import sampled
from shaken_recording import OPTIONS, bent

from rsgen.device.arrays import engine
from rstrack.alignment.block_sums import BlockSums
from rstrack.alignment.normal_equations import eliminate
from rstrack.alignment.weights import START_INTENSITY
from rstrack.calibration.pairs import kernels
from rstrack.calibration.pairs.images import ACROSS, LinePoses, lines_of
from rstrack.calibration.pairs.terms import PairSums, PairTerms
from rstrack.calibration.pairs.window import add_system, partners, without_brightness
from rstrack.calibration.parameters import COUNT, NAMES, free_of
from rstrack.calibration.run import parameters_of
from rstrack.calibration.start import load_window
from rstrack.data.dataset import Dataset

# A few columns of every kind: a kernel with all of them takes seconds to compile.
FREE = np.isin(NAMES, ("depth.fx", "depth.cx", "depth.k1", "color.fx", "color.cx", "color.k1", "depth.error.offset_m"))
APART = np.array([[1, 0], [2, 3], [0, 7], [7, 4], [5, 6]])


@pytest.mark.parametrize("scan", sampled(["top-bottom", "left-right"], 2))
def test_pairs_at_once_sum_to_the_same_as_one_by_one(
    shaken: Dataset, monkeypatch: pytest.MonkeyPatch, scan: str
) -> None:
    """Whether one launch takes all of them, or several do, of which the last has fewer."""
    rig = shaken.rig
    shutters = {name: replace(getattr(rig, name), scan=scan) for name in ("depth_shutter", "color_shutter")}
    dataset = bent(replace(shaken, rig=replace(rig, **shutters)))
    terms, p = PairTerms(engine("llvm"), dataset, FREE), parameters_of(dataset)
    assert shaken.truth is not None
    window = load_window(terms, dataset, range(4, 12), shaken.truth, p, OPTIONS)
    base, lever = window.base(p)
    depths = lines_of([view.depth for view in window.views], window.spline, p, base)
    colors = lines_of([view.color for view in window.views], window.spline, p, base)

    def summed(terms: PairTerms, pairs: np.ndarray) -> list[PairSums]:
        optics, brightness = terms.optics(p), 0.01 * np.arange(128.0).reshape(8, 8, 2)
        lines = depths, colors
        return [
            terms.by_depth(window.images, pairs, depths, optics, 1e-3, lever)(),
            terms.by_color(window.images, 1, pairs, lines, optics, brightness, 0.02, lever)(),
        ]

    alone = [summed(terms, APART[k : k + 1]) for k in range(len(APART))]
    for threshold in (dr.expand_threshold(), 60_000):
        monkeypatch.setattr("rstrack.calibration.pairs.terms.dr.expand_threshold", lambda n=threshold: n)
        for kind, found in enumerate(summed(terms, APART)):
            assert found.blocks.count == sum(one[kind].blocks.count for one in alone) > 1000
            assert found.blocks.cost == pytest.approx(sum(one[kind].blocks.cost for one in alone), rel=1e-12)
            for k, one in enumerate(alone):
                own, of = slice(*found.begin[k : k + 2]), one[kind]
                np.testing.assert_array_equal(found.blocks.H[own], of.blocks.H)
                np.testing.assert_array_equal(found.coupling[own], of.coupling)
                np.testing.assert_array_equal(found.current[own], of.current)
                np.testing.assert_array_equal(found.reference[own], of.reference)
                if kind:
                    np.testing.assert_array_equal(found.own_H[k], of.own_H[0])
                    np.testing.assert_array_equal(found.own_g[k], of.own_g[0])
            np.testing.assert_allclose(found.own_H.sum(axis=0), sum(one[kind].own_H[0] for one in alone), rtol=1e-10)


def test_views_without_colour_are_compared_by_depth_alone(shaken: Dataset) -> None:
    """Where colour has half of depth's rate, no two images are an odd number of frames apart."""
    halved = replace(shaken, groups=tuple(() if k % 2 else group for k, group in enumerate(shaken.groups)))
    terms, p = PairTerms(engine("llvm"), halved, free_of(())), parameters_of(halved)
    assert shaken.truth is not None
    window = load_window(terms, halved, range(4, 18), shaken.truth, p, OPTIONS)
    rough = replace(window, brightness=window.brightness.copy(), is_rough=True)
    few, whole = rough.sums(terms, p, 0), window.sums(terms, p, 0)
    assert few.pixels > 1000 and rough.sigma[1] == START_INTENSITY and not rough.brightness.any()
    assert not few.g[-COUNT + 1 : -COUNT + 3].any() and whole.g[-COUNT + 1 : -COUNT + 3].all()


def test_normal_equations_of_pairs_are_those_written_out() -> None:
    rng = np.random.default_rng(4)
    images, blocks, points, asked, apart, sigma = 3, 4, 9, [15, 17], 2, 0.3
    pairs, moved = np.array([[0, 1], [2, 1]]), (1, 2, 5)
    first = np.sort(rng.integers(0, points - 3, (images, blocks)), axis=1)
    slopes = rng.standard_normal((images, blocks, 6, 24 + len(moved)))
    lines = LinePoses(np.zeros((0, 0, 12), np.float32), np.zeros((0, 0, 18), np.float32), first, slopes, moved)
    of = np.array([(0, 0, 0), (0, 0, 1), (0, 2, 2), (1, 1, 1), (1, 1, 3)])
    root, n = rng.standard_normal((len(of), 6, 6)), len(asked) + apart
    H6, g6 = (root @ root.swapaxes(1, 2))[:, None], rng.standard_normal((len(of), 1, 6))
    coupling, own_H = rng.standard_normal((len(of), 6, n)), rng.standard_normal((2, n, n))
    own_H, own_g = own_H + own_H.swapaxes(1, 2), rng.standard_normal((2, n))
    current, reference = (pairs[of[:, 0], k] * blocks + of[:, 1 + k] for k in (0, 1))
    sums = PairSums(BlockSums(H6, g6, 0.0, 0.0, 0), np.array([0, 3, 5]), current, reference, coupling, own_H, own_g)
    x = 6 * points
    H, g = np.eye(x + COUNT), np.ones(x + COUNT)
    wanted_H, wanted_g, wanted_rest = H.copy(), g.copy(), np.zeros((2, x + COUNT, apart))
    for k, (q, c, r) in enumerate(of):
        J = np.zeros((6, x + COUNT))
        for sign, image, block in ((1.0, pairs[q, 0], c), (-1.0, pairs[q, 1], r)):
            at = 6 * first[image, block]
            J[:, at : at + 24] += sign * slopes[image, block, :, :24]
            J[:, x + np.array(moved)] += sign * slopes[image, block, :, 24:]
        wanted_H += J.T @ H6[k, 0] @ J / sigma**2
        wanted_g += J.T @ g6[k, 0] / sigma
        across = J.T @ coupling[k] / sigma**2
        wanted_H[:, x + np.array(asked)] += across[:, : len(asked)]
        wanted_H[x + np.array(asked)] += across[:, : len(asked)].T
        wanted_rest[q] += across[:, len(asked) :]
    at, m = x + np.array(asked), len(asked)
    wanted_H[np.ix_(at, at)] += own_H[:, :m, :m].sum(axis=0) / sigma**2
    wanted_g[at] += own_g[:, :m].sum(axis=0) / sigma
    wanted_rest[:, at] += own_H[:, :m, m:] / sigma**2
    rest = add_system(H, g, sums, lines, asked, sigma)
    np.testing.assert_allclose(H, wanted_H, rtol=1e-10, atol=1e-9)
    np.testing.assert_allclose(g, wanted_g, rtol=1e-10, atol=1e-9)
    np.testing.assert_allclose(rest[0], wanted_rest, rtol=1e-10, atol=1e-9)
    np.testing.assert_allclose(rest[1], own_H[:, m:, m:] / sigma**2)
    np.testing.assert_allclose(rest[2], own_g[:, m:] / sigma)


def test_brightnesses_are_taken_out_as_one_by_one() -> None:
    rng = np.random.default_rng(6)
    root = rng.standard_normal((12, 12))
    H, g = root @ root.T + 20.0 * np.eye(12), rng.standard_normal(12)
    coupling, own_g, at = (
        rng.standard_normal((3, 12, 2)),
        rng.standard_normal((3, 2)),
        0.1 * rng.standard_normal((3, 2)),
    )
    own = np.array([np.diag([3.0, 5.0])] * 3)
    wanted_H, wanted_g, steps = H, g, []
    for k in range(3):
        found = eliminate(wanted_H, wanted_g, coupling[k], own[k], own_g[k], np.array([0.3, 0.15]), at[k])
        wanted_H, wanted_g = found.H, found.g
        steps.append(at[k] + found.step)
    following = without_brightness(H, g, coupling, own, own_g, at)
    np.testing.assert_allclose(H, wanted_H, rtol=1e-10)
    np.testing.assert_allclose(g, wanted_g, rtol=1e-10)
    np.testing.assert_allclose(following, np.array(steps), rtol=1e-10)


def test_views_so_many_frames_apart_are_compared_once() -> None:
    pairs = partners(20, (1, 4, 9, 16))
    assert len(pairs) == 50 == len({frozenset(pair) for pair in pairs.tolist()})
    assert set(np.abs(np.diff(pairs, axis=1)).ravel().tolist()) == {1, 4, 9, 16}


def test_no_pixel_of_the_atlas_next_image_is_read() -> None:
    e, width, height, view = engine("llvm"), 160, 120, 29
    left, top = view % ACROSS * width, view // ACROSS * height
    for x, y in ((width - 2, 60.5), (80.5, height - 2)):
        # Just before the last four pixels; in the atlas it is rounded to the first place that is beyond them.
        before = (e.Float(np.nextafter(np.float32(v), np.float32(0.0))) for v in (x, y))
        at = kernels.in_atlas(e.UInt(view), width, height, *before)
        assert float(at[0][0]) == left + x and float(at[1][0]) == top + y
        assert not kernels._inside(e.UInt(view), width, height, 1.0, *at)[0]
        well_before = kernels.in_atlas(e.UInt(view), width, height, e.Float(x - 1.0), e.Float(y - 1.0))
        assert kernels._inside(e.UInt(view), width, height, 1.0, *well_before)[0]
