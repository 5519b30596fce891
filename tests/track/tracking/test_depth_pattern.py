"""The fixed pattern of a depth camera's error, from images that were made wrong by so much."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from shaken_recording import FaultyDepth

from rsgen.array_types import FloatArray
from rsgen.console.progress import no_progress
from rsgen.geometry import se3
from rstrack.calibration.depth_pattern import _depth_seen
from rstrack.calibration.run import parameters_of
from rstrack.data.dataset import Dataset
from rstrack.data.depth_pattern import PATTERN_SIZE, pattern_basis, pattern_image
from rstrack.data.rig import DEFAULT_SIGMA, DepthError
from rstrack.options import Options
from rstrack.tracking.first_look import depth_pattern, looked_at, wants_pattern
from rstrack.tracking.first_look.depth_pattern import estimate_depth_pattern
from rstrack.tracking.first_look.rough_track import GeometricTrack, GeometricTracks


def waves(seed: int = 3) -> tuple[float, ...]:
    """A pattern of some 5 mm at 1 m."""
    return tuple(float(x) for x in np.random.default_rng(seed).normal(0.0, 2.5e-3, PATTERN_SIZE))


def off_by(dataset: Dataset, pattern: tuple[float, ...]) -> Dataset:
    """Its depth images before they are corrected by a pattern, of a camera that may have one."""
    error = DepthError(pattern=tuple(-x for x in pattern))
    rig = replace(dataset.rig, sigma=DEFAULT_SIGMA)
    return replace(dataset, images=FaultyDepth(dataset.images, error, rig.depth_camera), rig=rig)


def true_track(dataset: Dataset) -> GeometricTrack:
    truth = dataset.truth
    assert truth is not None
    return GeometricTrack(range(len(dataset)), truth, truth.t_begin, truth.t_end)


def rms(dataset: Dataset, pattern: FloatArray) -> float:
    """Over the image, 1/m."""
    camera = dataset.rig.depth_camera
    return float(np.sqrt(np.mean(pattern_image(tuple(pattern), camera.width, camera.height) ** 2)))


def test_the_pattern_is_found_and_its_error_known(shaken: Dataset) -> None:
    true, noisy = np.array(waves()), off_by(shaken, waves()).noisy(0.005, 0.0, 3)
    found = estimate_depth_pattern(noisy, [true_track(shaken), None])
    off = np.array(found.pattern) - true
    assert rms(shaken, off) < 0.1 * rms(shaken, true)
    assert 0.3 < np.mean(off**2 / np.diag(found.covariance)) < 3.0
    assert found.rms == pytest.approx(rms(shaken, np.array(found.pattern)), rel=0.03)
    assert found.pairs > 20 and f"from {found.pairs} pairs" in found.text() and "mm at 1 m" in found.text()


def test_it_is_found_by_a_track_that_is_off_by_it_too(shaken: Dataset) -> None:
    faulty, true = off_by(shaken, waves()), np.array(waves())
    tracks = GeometricTracks(faulty, range(len(faulty)), Options(backend="llvm"), no_progress)
    found = estimate_depth_pattern(faulty, tracks)
    assert rms(shaken, np.array(found.pattern) - true) < 0.4 * rms(shaken, true)


def test_a_camera_without_one_has_hardly_any(shaken: Dataset) -> None:
    found = estimate_depth_pattern(off_by(shaken, ()).noisy(0.005, 0.0, 4), [true_track(shaken)])
    assert found.rms < 5e-4 and found.rms < 3.0 * found.sigma_rms


def test_too_few_images_show_none(shaken: Dataset) -> None:
    found = estimate_depth_pattern(shaken, [replace(true_track(shaken), frames=range(12))])
    assert found.pattern == () and found.pairs < 12 and "too few images overlap" in found.text()
    assert estimate_depth_pattern(shaken, [None]).pairs == 0


def test_derivatives_are_those_of_finite_differences(shaken: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset, track = off_by(shaken, ()), true_track(shaken)
    camera, shutter = dataset.rig.depth_camera, dataset.rig.depth_shutter
    rays, lines = camera.unproject(camera.pixel_grid()), np.arange(shutter.line_count(camera))

    def poses(k: int) -> FloatArray:
        return track.spline.pose(shutter.line_mid_time(dataset.stamps[k], lines, camera))

    def pair(pattern: FloatArray, twist: FloatArray) -> depth_pattern._Pair:
        z = [DepthError(pattern=tuple(pattern)).corrected(dataset.images.depth(k), camera) for k in (10, 20)]
        about, T_b = np.eye(4), poses(20)
        about[:3, 3] = T_b[len(T_b) // 2, :3, 3]
        moved = about @ se3.exp(twist) @ se3.inverse(about) @ T_b
        a, b = depth_pattern._surface(z[0], poses(10)), depth_pattern._surface(z[1], moved)
        found = depth_pattern._pair(dataset, rays, replace(a, smooth=np.ones_like(a.smooth)), replace(b, smooth=inner))
        assert found is not None
        return found

    # The same pixels whatever the step, edges of the room among them.
    monkeypatch.setattr(depth_pattern, "_SAME", np.inf)
    inner = np.zeros((camera.height, camera.width), bool)
    inner[20:-20, 20:-20] = True
    still, step = pair(np.zeros(PATTERN_SIZE), np.zeros(6)), 3e-5
    for n in range(PATTERN_SIZE + 6):
        x = np.where(np.arange(PATTERN_SIZE + 6) == n, step, 0.0)
        change = (pair(x[:PATTERN_SIZE], x[PATTERN_SIZE:]).r - still.r) / step
        expected = np.hstack([still.by_pattern, still.by_twist])[:, n]
        assert np.quantile(np.abs(change - expected), 0.8) < 0.03 * np.abs(expected).max()


def test_polynomials_are_orthogonal_and_have_no_constant() -> None:
    """Legendre's, over a square: 4 / ((2i + 1) (2j + 1)), by Gauss's quadrature."""
    at, weight = np.polynomial.legendre.leggauss(9)
    uv = np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2) / 2.0 + 0.5
    basis, weights = pattern_basis(uv, 2, 2), np.outer(weight, weight).ravel()
    gram = basis.T @ (weights[:, None] * basis)
    np.testing.assert_allclose(gram, np.diag(np.diag(gram)), atol=1e-12)
    sides = [4.0 / ((2 * (n - j) + 1) * (2 * j + 1)) for n in range(1, 7) for j in range(n + 1)]
    np.testing.assert_allclose(np.diag(gram), sides)
    np.testing.assert_allclose(weights @ basis, 0.0, atol=1e-12)


def test_only_where_depth_may_be_off_and_nothing_is_stated(shaken: Dataset) -> None:
    faulty, options = off_by(shaken, waves()), Options(backend="llvm", method="rs-g")
    assert not wants_pattern(shaken) and wants_pattern(faulty) and not wants_pattern(faulty.with_depth_pattern(()))
    assert looked_at(shaken, range(60), options, no_progress) is shaken
    seen = looked_at(faulty, range(60), options, no_progress)
    assert seen.depth_error.pattern and "fixed pattern" in seen.notes[-1]
    before, after = (np.abs(d.depth(30) - shaken.depth(30)).mean() for d in (faulty, seen))
    assert after < 0.5 * before
    assert seen.color_stamps is faulty.color_stamps and seen.rig is faulty.rig


def test_none_leaves_every_bit_of_depth(shaken: Dataset) -> None:
    for error in (DepthError(), DepthError(pattern=()), DepthError(pattern=(0.0,) * PATTERN_SIZE)):
        z = shaken.images.depth(0)
        np.testing.assert_allclose(error.corrected(z, shaken.rig.depth_camera), z, rtol=3e-7)
    assert DepthError(pattern=()).corrected(z, shaken.rig.depth_camera) is z


def test_calibration_looks_for_it_at_the_times_of_its_lines(shaken: Dataset) -> None:
    """A negative readout: lines are read the other way round, the first of the image when its stamp says."""
    p = replace(parameters_of(shaken), depth_readout_s=-0.01)
    seen = _depth_seen(shaken, p)
    camera, shutter = seen.rig.depth_camera, seen.rig.depth_shutter
    lines = np.arange(shutter.line_count(camera))
    times = shutter.line_mid_time(seen.stamps[5], shutter.line_of_pixel([[0.0, y] for y in lines], camera), camera)
    np.testing.assert_allclose(times - shaken.stamps[5], -0.01 * lines / len(lines), atol=1e-12)
