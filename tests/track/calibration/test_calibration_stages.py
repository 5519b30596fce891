"""Lenses are found by colour where depth is off by the same amount over whole regions of all its images."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import scipy.optimize
import yaml
from shaken_recording import OPTIONS, READOUT_S, SHORT

from rsgen.array_types import ByteArray, Float32Array
from rstrack.calibration.pairs.window import overcounted
from rstrack.calibration.parameters import BY_COLOR, COUNT, NAMES, Parameters
from rstrack.calibration.record import camera_file_of
from rstrack.calibration.run import calibrate
from rstrack.calibration.solve import Solution, joined
from rstrack.data.dataset import Dataset
from rstrack.data.image_files import ImageReader
from rstrack.data.rig import DEFAULT_SIGMA

LASTING = 0.005


@dataclass(frozen=True)
class UnevenDepth:
    """Images of which depth is off by a wave over the image, alike in all of them, by as much of inverse depth."""

    images: ImageReader
    by: float = LASTING

    def color(self, k: int) -> ByteArray:
        return self.images.color(k)

    def depth(self, k: int) -> Float32Array:
        z = self.images.depth(k)
        y, x = np.mgrid[: z.shape[0], : z.shape[1]] / z.shape[1]
        wave = np.sin(2 * np.pi * x / 0.5 + 1.0) * np.cos(2 * np.pi * y / 0.5 + 0.5) + np.sin(2 * np.pi * x)
        return np.where(z > 0, 1 / (1 / np.maximum(z, 1e-3) + self.by * wave), 0.0).astype(np.float32)


pytestmark = pytest.mark.usefixtures("few_pairs")


def uneven(dataset: Dataset, sigma: float) -> Dataset:
    """With such depth and a focal length that is told wrong by 2 %; sigma: of what is said of depth."""
    rig, color = dataset.rig, dataset.rig.color_camera
    lens = replace(color, fx=1.02 * color.fx, fy=1.02 * color.fy)
    told = replace(rig, color_camera=lens, sigma=replace(DEFAULT_SIGMA, depth_inverse_offset=sigma))
    return replace(dataset, images=UnevenDepth(dataset.images), rig=told)


@pytest.mark.nightly
def test_a_lens_is_not_bent_by_depth_that_is_off_in_the_same_way_in_all_images(shaken: Dataset) -> None:
    true = shaken.rig.color_camera
    errors = []
    for sigma in (0.0, LASTING):
        found = calibrate(uneven(shaken, sigma), ("readout", "offset", "intrinsics"), SHORT, OPTIONS)
        assert found.solution.finished and not found.undetermined[BY_COLOR].any()
        lens = found.calibrated().rig.color_camera
        errors.append(abs(lens.fx / true.fx - 1.0) + abs(lens.fy / true.fy - 1.0) + abs(lens.cx - true.cx) / true.fx)
    at_once, in_stages = errors
    assert in_stages < 0.25 * at_once
    assert abs(found.values.color_readout_s - READOUT_S) < 2.0 * found.sigmas[1] < 2e-3
    told = yaml.safe_load(camera_file_of(found))
    assert told["sigma"]["depth_image"] == 0.0 and told["sigma"]["focal"] > 0.0


@pytest.mark.parametrize("off", [1e-4, 0.1])
def test_a_term_that_repeats_itself_counts_so_many_times_too_much(off: float) -> None:
    """off: by which σ the control points are, where the term is looked at."""
    rng, x, times = np.random.default_rng(0), 12, 9.0
    told, found = np.zeros((x + COUNT, x + COUNT)), []
    told[:x, :x] = np.eye(x) / off**2
    for _ in range(1000):
        J = rng.standard_normal((40, x))
        J[:, -2:] = 0.0  # what nothing shows
        H, g = np.zeros((x + COUNT, x + COUNT)), np.zeros(x + COUNT)
        # Every reading is in it nine times over.
        H[:x, :x] = times * J.T @ J
        g[:x] = times * J.T @ rng.standard_normal(40) + H[:x, :x] @ (off * rng.standard_normal(x))
        found.append(overcounted(H, g, told))
    assert np.mean(found) == pytest.approx(times, rel=0.07)


def test_what_a_parameter_gains_is_what_the_cost_grows_by_without_it() -> None:
    rng, free = np.random.default_rng(2), np.arange(COUNT) < 3
    J = rng.standard_normal((50, 3)) * [1e2, 2e2, 50.0]
    A = (J.T @ J)[None]
    p = Parameters(0.03, 0.02, 0.01, 0.0, np.eye(4))
    found = Solution(p, free, A, np.zeros((1, 3)), 0.0, 1e-3, 1e-2)
    held = np.array([0.03 - 0.02, 0.02 - 0.025])  # of both readouts, from what is found

    def cost(offset: float) -> float:
        return 0.5 * float(np.square(J @ [-held[0], -held[1], offset]).sum())

    wanted = scipy.optimize.minimize_scalar(cost, tol=1e-12).fun
    other = replace(p, depth_readout_s=0.02, color_readout_s=0.025)
    assert found.gain_over(other, np.arange(COUNT) < 2) == pytest.approx(wanted, rel=1e-6)


def test_two_solutions_are_joined_with_each_others_unknowns_apart() -> None:
    rng, p = np.random.default_rng(1), Parameters(0.02, 0.02, 0.0, 0.0, np.eye(4))
    masks = (np.isin(NAMES, names) for names in (("color.fx", "color.readout_s"), ("depth.readout_s", "color.fy")))
    parts = []
    for k, free in enumerate(masks):
        A, b = np.array([np.diag(rng.uniform(1e4, 4e4, 2))] * 8), 90.0 * rng.standard_normal((8, 2))
        last = np.where(free, k + 1.0, 9.0)
        parts.append(Solution(p, free, A, b - b.mean(axis=0), 0.0, 1e-3, 1e-2, last))
    both = joined(*parts)
    assert both.A.shape == (8, 4, 4) and both.b.shape == (8, 4) and (both.free == parts[0].free | parts[1].free).all()
    for k, one in enumerate(parts):
        own = np.ix_(range(8), one.free[both.free], one.free[both.free])
        np.testing.assert_array_equal(both.A[own], one.A)
        np.testing.assert_array_equal(both.b[:, one.free[both.free]], one.b)
        assert (both.last_step[one.free] == k + 1.0).all()
    apart = parts[0].free[both.free]
    assert not both.A[:, apart][:, :, ~apart].any() and both.covariance.shape == (COUNT, COUNT)
