"""Sums of the geometric kernel against a twin in NumPy, chained to control points, and in fixed point."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np
import pytest
import synthetic
from rstrack_util import (
    ENGINE,
    depth_of,
    disturbed,
    exact_reference,
    exposure,
    maker,
    small_camera,
)

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rsgen.geometry.so3 import hat
from rsgen.geometry.spline import Spline
from rstrack.alignment import block_sums as block_sums_module
from rstrack.alignment import residuals
from rstrack.alignment.block_sums import BlockSums, Contribution, PixelGrid, Runs, Scaling, block_counts
from rstrack.alignment.normal_equations import Slopes, chain
from rstrack.alignment.weights import LEAST_CURVATURE, NU, weight
from rstrack.images import line_poses as lines
from rstrack.images.line_poses import IDENTITY_FROM_BASE, to_base_table
from rstrack.images.pyramid import DepthImage
from rstrack.images.sampling import EDGE
from rstrack.keyframes.keyframe import Reference

DEPTH = small_camera("radtan")


def newton_weight(s: np.ndarray) -> np.ndarray:
    """Second derivative of the cost by s where it is convex enough, otherwise a share of the weight."""
    second = (NU + 1.0) * (NU - s**2) / (NU + s**2) ** 2
    return np.maximum(second, LEAST_CURVATURE * weight(s))


def assert_sums(got: BlockSums, want: BlockSums, median_depth: float, error: tuple[float, float, float]) -> None:
    """Equal to 1e-5, or up to absolute errors of H, of g (rotations over `median_depth`) and of the two scalars."""
    scale = median_depth ** np.array([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
    square = np.outer(scale, scale)
    np.testing.assert_allclose(got.H / square, want.H / square, rtol=1e-5, atol=error[0])
    np.testing.assert_allclose(got.g / scale, want.g / scale, rtol=1e-5, atol=error[1])
    np.testing.assert_allclose((got.cost, got.weighted), (want.cost, want.weighted), rtol=1e-5, atol=error[2])
    assert got.count == want.count


@dataclass(frozen=True)
class PixelTerms:
    """Per pixel of the current image: line, row vector j (n, 6), s = r/σ, and whether rounding could flip its mask."""

    line: np.ndarray
    j: np.ndarray
    s: np.ndarray
    ambiguous: np.ndarray
    active: np.ndarray

    def blocks(self, count: int, per: int) -> BlockSums:
        """Sums per block of `per` lines."""
        on = self.active
        j, s, block = self.j[on], self.s[on], self.line[on] // per
        w = weight(s)
        H, g = np.zeros((count, 1, 6, 6)), np.zeros((count, 1, 6))
        np.add.at(H[:, 0], block, newton_weight(s)[:, None, None] * j[:, :, None] * j[:, None, :])
        np.add.at(g[:, 0], block, (w * s)[:, None] * j)
        cost = 0.5 * (NU + 1.0) * np.log1p(s**2 / NU)
        return BlockSums(H, g, float((w * s**2).sum()), float(cost.sum()), int(on.sum()))


def geometric_pixels(z: np.ndarray, image: DepthImage, ref: Reference, spline: Spline, sigma: float) -> PixelTerms:
    """The definition, pixel by pixel in float64: every second pixel of every second row, rectified reference."""
    lens, camera = image.exposure.lens, ref.lens.camera
    shape = camera.height, camera.width
    rho, slope_x, slope_y = (
        ENGINE.download(a, shape).astype(float) for a in (ref.inverse_depth, ref.slope_x, ref.slope_y)
    )
    uv = lens.camera.pixel_grid()[::2, ::2].reshape(-1, 2)
    z = z[::2, ::2].reshape(-1)
    line = lens.shutter.line_of_pixel(uv, lens.camera)
    T = se3.inverse(ref.T_world_base) @ spline.pose(image.exposure.times()[line.astype(int)])
    p = se3.transform(T, lens.camera.backproject(uv, z))
    with np.errstate(invalid="ignore", divide="ignore"):
        x = camera.project(p)[0]
    inside = (z > 0) & (x >= 0).all(axis=1) & (x < np.array([camera.width, camera.height]) - 1).all(axis=1)
    x = np.where(inside[:, None], x, 1.0)
    x0 = np.floor(x).astype(int)
    fx, fy = (x - x0).T
    near = np.stack([rho[x0[:, 1] + b, x0[:, 0] + a] for b, a in ((0, 0), (0, 1), (1, 0), (1, 1))])
    spread = np.where(near.max(0) > 0, (near.max(0) - near.min(0)) / np.maximum(near.max(0), 1e-9), 1.0)
    value = (near[0] * (1 - fx) + near[1] * fx) * (1 - fy) + (near[2] * (1 - fx) + near[3] * fx) * fy
    nearest = np.floor(x + 0.5).astype(int)
    m_xy = np.stack([slope_x[nearest[:, 1], nearest[:, 0]], slope_y[nearest[:, 1], nearest[:, 0]]], axis=-1)
    ray = (x - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    m = np.concatenate([m_xy, (value - (m_xy * ray).sum(axis=1))[:, None]], axis=1)
    length = np.linalg.norm(m, axis=1)
    safe = np.where(length > 0, length, 1.0)
    even = np.minimum((ref.median_depth / np.where(z > 0, z, 1.0)) ** 2, residuals.NEAREST)
    r = even * (1.0 - p[:, 2] * value) / safe
    # 1 − m·p is the error; on a plane, where m does not depend on p, its derivative by p is −m.
    j = np.concatenate([-m, -np.einsum("ni,nij->nj", m, -hat(p))], axis=1) * (even / safe)[:, None]
    active = inside & (near.min(0) > 0) & (spread < EDGE)
    edge = np.concatenate([x - np.round(x - 0.5) - 0.5, x, x - np.array([camera.width, camera.height]) + 1], axis=1)
    ambiguous = (np.abs(edge).min(axis=1) < 1e-3) | (np.abs(spread - EDGE) < 1e-4)
    return PixelTerms(line.astype(int), j, r / sigma, ambiguous & (z > 0), active)


@pytest.fixture(autouse=True)
def exact_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every line's pose from the spline: with these small images a block of eight would take 5 ms."""
    monkeypatch.setattr(lines, "NODES", 10**6)


@pytest.fixture(scope="module")
def room() -> tuple[Callable[[np.ndarray], DepthImage], Reference, Spline, np.ndarray]:
    """A box with a ball in it, edges included: maker of the depth image from its z, reference, spline, z.

    The spline is off by 2 cm and 0.02 rad. Pixels that rounding could take across a pixel's border, or into the mask
    or out of it, have no depth.
    """
    truth = synthetic.make_spline()
    image = exposure(0.30, "bottom-top", DEPTH)
    ref = exact_reference(synthetic.cast, truth, exposure(0.25, None))

    def as_input(z: np.ndarray) -> DepthImage:
        rho = np.divide(1.0, z, out=np.zeros_like(z), where=z > 0)
        return DepthImage(image, ENGINE.upload(z), ENGINE.upload(rho), int((z > 0).sum()))

    spline, z = disturbed(truth, 11, 0.02), depth_of(synthetic.cast, truth, image).astype(np.float32)
    ambiguous = geometric_pixels(z, as_input(z), ref, spline, 1.0).ambiguous
    assert ambiguous.sum() < 60
    z[::2, ::2][ambiguous.reshape(z[::2, ::2].shape)] = 0.0
    return as_input, ref, spline, z


def test_sums_equal_those_of_a_loop_over_pixels(room: tuple, monkeypatch: pytest.MonkeyPatch) -> None:
    as_input, ref, spline, z = room
    monkeypatch.setattr(block_sums_module, "BLOCKS", 6)  # of 8 lines
    sigma = 0.01
    pixels = geometric_pixels(z, as_input(z), ref, spline, sigma)
    want, got = pixels.blocks(6, 8), block_sums(as_input(z), ref, spline, 10.0, sigma)
    assert want.count > 400
    assert np.count_nonzero(pixels.active) < 0.95 * np.count_nonzero(z[::2, ::2])  # edges and borders were tried
    assert np.abs(pixels.s[pixels.active]).max() > 3.0
    assert_sums(got, want, ref.median_depth, (2e-4, 2e-3, 1e-2))


def block_sums(
    image: DepthImage, ref: Reference, spline: Spline, gate: float, sigma: float, roughness: float = np.inf,
    coarse: float = 1.0, shifts: bool = False, whole: FloatArray = residuals.LEVEL,
) -> BlockSums:  # fmt: skip
    """The kernel itself, with a gate of one's own."""
    kernel = residuals.geometric_kernel(ENGINE, image.exposure.lens, ref.lens, 2, shifts)
    camera = image.exposure.lens.camera
    scaling = Scaling(ref.median_depth, ref.bound, camera.width * camera.height // 4)
    to_base = ENGINE.upload(to_base_table(spline, ref.T_world_base, image.exposure))
    constants = ENGINE.upload(np.append(scaling.parameters(sigma, gate), [roughness, coarse, *whole]))
    surface = ref.inverse_depth, ref.slope_x, ref.slope_y, ref.roughness, ENGINE.upload(IDENTITY_FROM_BASE)
    raw = kernel(residuals.GeometricInput(image.z, *maker(DEPTH).device_rays, to_base, *surface, constants))
    current, reference, _, _ = block_counts(image.exposure.lens, ref.lens)
    return scaling.unpack(raw.numpy(), current, reference, len(whole) if shifts else 0)


def test_what_an_image_is_off_by_as_a_whole_is_what_its_columns_say(room: tuple) -> None:
    as_input, ref, _, z = room
    x, y = np.moveaxis(DEPTH.unproject(DEPTH.pixel_grid())[..., :2], -1, 0)
    rho = np.divide(1.0, z, out=np.zeros_like(z), where=z > 0)
    sigma, unit = 0.05, residuals.whole_image_unit(ref.median_depth)

    def found(off: np.ndarray) -> np.ndarray:
        bent = np.where(z > 0, rho + off[0] + off[1] * x + off[2] * y, 0.0)
        image = as_input(np.divide(1.0, bent, out=np.zeros_like(z), where=z > 0).astype(np.float32))
        own = block_sums(image, ref, synthetic.make_spline(), 10.0, sigma, shifts=True).columns
        assert own is not None
        return -sigma * unit * np.linalg.solve(own.H, own.g)

    for off in 2e-3 * np.eye(3):
        np.testing.assert_allclose(0.5 * (found(-off) - found(off)), off, atol=6e-5)


def test_what_an_image_is_off_by_as_a_whole_is_taken_off(room: tuple) -> None:
    as_input, ref, _, z = room
    x, y = np.moveaxis(DEPTH.unproject(DEPTH.pixel_grid())[..., :2], -1, 0)
    off = np.array([5e-3, 0.02, -0.01])
    rho = np.divide(1.0, z, out=np.zeros_like(z), where=z > 0)
    bent = np.where(z > 0, rho - off[0] - off[1] * x - off[2] * y, 0.0)
    image = as_input(np.divide(1.0, bent, out=np.zeros_like(z), where=z > 0).astype(np.float32))

    def cost(image: DepthImage, whole: np.ndarray) -> float:
        return block_sums(image, ref, synthetic.make_spline(), 10.0, 0.01, shifts=True, whole=whole).cost

    straight, wrong, put_right = cost(as_input(z), 0.0 * off), cost(image, 0.0 * off), cost(image, off)
    assert wrong > 2.0 * straight and put_right - straight < 0.05 * (wrong - straight)
    assert put_right == pytest.approx(straight, rel=0.1)


def test_further_columns_change_no_other_sum(room: tuple) -> None:
    as_input, ref, spline, z = room
    plain, more = (block_sums(as_input(z), ref, spline, 10.0, 0.01, shifts=shifts) for shifts in (False, True))
    np.testing.assert_array_equal(more.H, plain.H)
    assert (more.g == plain.g).all() and more.cost == plain.cost


def test_the_gate_drops_what_lies_beyond_it(room: tuple) -> None:
    as_input, ref, spline, z = room
    pixels = geometric_pixels(z, as_input(z), ref, spline, 1.0)
    r = np.sort(np.abs(pixels.s[pixels.active]))
    gate = float(0.5 * (r[250] + r[251]))
    assert block_sums(as_input(z), ref, spline, gate, 0.01).count == 251


def test_rough_pixels_of_the_reference_weigh_less_or_are_left_out(room: tuple) -> None:
    as_input, ref, spline, z = room
    rough = ENGINE.download(ref.roughness, z.shape)
    limit = float(np.median(rough[rough > 0]))

    def sums(roughness: np.ndarray, coarse: float) -> BlockSums:
        there = replace(ref, roughness=ENGINE.upload(roughness))
        return block_sums(as_input(z), there, spline, 10.0, 0.01, limit, coarse)

    smooth, soft, without = sums(0.0 * rough, 1.0), sums(rough, 1.0), sums(rough, 0.0)
    far = sums(np.where(rough <= limit, rough, 1e6), 1.0)
    traces = [float(np.trace(s.H.sum(axis=(0, 1)))) for s in (without, soft, smooth)]
    assert 0 < traces[0] < 0.99 * traces[1] < 0.9 * traces[2]
    np.testing.assert_allclose(far.H, without.H, atol=1e-6 * np.abs(without.H).max())  # weight fades out
    # σ and what is counted are those of the smooth ones alone, however many others there are.
    assert without.count == soft.count == far.count < 0.9 * smooth.count and soft.compared == soft.count
    assert soft.weighted == without.weighted < smooth.weighted and soft.cost > without.cost


def test_blocks_chained_to_control_points_equal_dense_pixel_jacobians(room: tuple) -> None:
    as_input, ref, spline, z = room
    image = as_input(z)
    pixels = geometric_pixels(z, image, ref, spline, 0.01)
    slopes = Slopes.of(spline, ref.T_world_base, image.exposure.block_times(1), None)
    model, _ = chain(pixels.blocks(image.exposure.lens.lines, 1), slopes)
    # Each pixel's own time, not its line's.
    j, s, line = pixels.j[pixels.active], pixels.s[pixels.active], pixels.line[pixels.active]
    shutter = image.exposure.lens.shutter
    at, J = spline.pose_jacobian(shutter.line_mid_time(image.exposure.stamp, line, DEPTH))
    by_point = np.zeros((len(j), len(spline.control_points), 6))
    to_base = se3.adjoint(se3.inverse(ref.T_world_base))
    for i in range(4):
        by_point[np.arange(len(j)), at + i] = np.einsum("ni,nij->nj", j @ to_base, J[:, i])
    rows = by_point[:, model.first : model.last].reshape(len(j), -1)
    w, h = weight(s), newton_weight(s)
    dense = rows.T @ (h[:, None] * rows)
    np.testing.assert_allclose(model.H, dense, atol=1e-9 * np.abs(dense).max())
    np.testing.assert_allclose(model.g, rows.T @ (w * s), atol=1e-9 * np.abs(model.g).max())
    assert np.count_nonzero(np.abs(rows).sum(axis=0)) == rows.shape[1]


# -- fixed point ---------------------------------------------------------------------------------------------------


def scattered(found: Contribution, size: int) -> Any:
    """Pixel by pixel."""
    sums = dr.zeros(ENGINE.Int, size)
    for k, value in enumerate(found.values):
        dr.scatter_reduce(dr.ReduceOp.Add, sums, value, found.slot + k, found.compared)
    return sums


def accumulate(
    g: np.ndarray, p: np.ndarray, r: np.ndarray, scaling: Scaling, sigma: float, gate: float
) -> tuple[np.ndarray, BlockSums]:
    """All pixels into one block."""
    constants = [ENGINE.Float(float(c)) for c in scaling.parameters(sigma, gate)]
    columns = [ENGINE.upload(c) for c in (*g.T, *p.T, r)]
    raw = scattered(
        block_sums_module.contribution(
            ENGINE, tuple(columns[:3]), tuple(columns[3:6]), -1.0, columns[6], ENGINE.Bool(True), constants,
            ENGINE.UInt(0),
        ), 32,
    ).numpy()  # fmt: skip
    return raw, scaling.unpack(raw, 1, 1)


def dense_sums(g: np.ndarray, p: np.ndarray, r: np.ndarray, scaling: Scaling, sigma: float) -> BlockSums:
    """The same in float64, with the bound on |j|."""
    j = -np.concatenate([g, np.cross(p, g)], axis=1)
    s = r / sigma
    size = np.maximum((j[:, :3] ** 2).sum(axis=1), (j[:, 3:] ** 2).sum(axis=1) / scaling.median_depth**2)
    w = weight(s) * np.minimum(1.0, scaling.bound**2 / size)
    h = newton_weight(s) * w / weight(s)
    H, gradient = j.T @ (h[:, None] * j), j.T @ (w * s)
    cost = 0.5 * (NU + 1.0) * np.log1p(s**2 / NU)
    return BlockSums(H[None, None], gradient[None, None], float((w * s**2).sum()), float(cost.sum()), len(r))


@pytest.mark.parametrize(
    ("s", "length"),
    [(1e-3, 1.0), (np.sqrt(5.0), 1.0), (250.0, 1.0), (np.sqrt(5.0), 100.0), (-np.sqrt(5.0), 1e6), (0.0, 1.0)],
)
def test_full_blocks_of_the_worst_pixels_do_not_overflow(s: float, length: float) -> None:
    # All pixels alike and a block filled to its capacity: |g| at the bound (or beyond it), the largest weights.
    scaling, count, sigma = Scaling(2.5, 1.7, 3000), 3000, 2e-4
    g = np.tile(length * 1.7 * np.array([0.6, 0.0, 0.8]), (count, 1))
    p = np.tile([0.4, 2.5, -0.3], (count, 1))
    r = np.full(count, s * sigma)
    raw, got = accumulate(g, p, r, scaling, sigma, 1.0)
    want = dense_sums(g, p, r, scaling, sigma)
    assert np.abs(raw.astype(np.int64)).max() < 2**31 - 2**24
    # All pixels are rounded alike, by half a unit at most.
    assert_sums(got, want, scaling.median_depth, tuple(count / scaling.parameters(sigma, 1.0)[4:]))


@pytest.mark.parametrize(
    ("width", "height", "stride", "down", "run"),
    [(101, 67, 1, False, 1), (101, 67, 1, False, 40), (90, 61, 2, True, 3), (3, 200, 1, False, 40)],
)
def test_runs_of_pixels_add_up_to_what_pixels_do(
    monkeypatch: pytest.MonkeyPatch, width: int, height: int, stride: int, down: bool, run: int
) -> None:
    monkeypatch.setattr(block_sums_module, "_run", lambda *_: run)
    rng = np.random.default_rng(width + run)
    y, x = np.mgrid[:height:stride, :width:stride]
    # Runs leave blocks at every other step here, stay long there, and some pixels belong to none.
    block = np.where(x > width // 2, rng.integers(0, 6, x.shape), y // 9 % 6)
    values, active = rng.integers(-1000, 1000, (2, *x.shape)), rng.random(x.shape) < 0.8
    want = np.zeros((6, 2), int)
    np.add.at(want, block[active], np.moveaxis(values * active, 0, -1)[active])
    arrays = [ENGINE.UInt(2 * block.ravel()), *(ENGINE.Int(v.ravel()) for v in values), ENGINE.Bool(active.ravel())]
    seen = dr.zeros(ENGINE.Int, width * height)

    def at(pixels: PixelGrid) -> Contribution:
        slot, a, b, is_active = (dr.gather(type(array), array, pixels.number) for array in arrays)
        compared = is_active & pixels.meant
        dr.scatter_add(seen, ENGINE.Int(1), pixels.y * width + pixels.x, pixels.meant & (pixels.index < len(seen)))
        return Contribution(slot, tuple(dr.select(compared, v, 0) for v in (a, b)), compared)

    got = block_sums_module.summed(ENGINE, Runs.over(ENGINE, width, height, stride, down), (12, 2), at, False)
    assert np.array_equal(got.numpy().reshape(6, 2), want)
    assert np.array_equal(seen.numpy().reshape(height, width)[::stride, ::stride], np.ones_like(x))
    assert seen.numpy().sum() == x.size


def test_sums_unpack_to_float64_ones() -> None:
    rng = np.random.default_rng(2)
    n, sigma = 5000, 0.01
    scaling = Scaling(3.0, 2.0, n)
    g, p, r = rng.normal(size=(n, 3)), rng.uniform(-5, 5, (n, 3)), rng.standard_t(5, n) * sigma
    _, got = accumulate(g, p, r, scaling, sigma, 100.0)
    want = dense_sums(g, p, r, scaling, sigma)
    # Errors of up to half a unit for each pixel, with random signs.
    assert_sums(got, want, scaling.median_depth, tuple(5 * np.sqrt(n / 12) / scaling.parameters(sigma, 1.0)[4:]))
    assert np.array_equal(got.H, np.swapaxes(got.H, -1, -2))


def test_pixels_that_are_not_numbers_do_not_count() -> None:
    g, p = np.ones((2, 4, 3))
    r = np.zeros(4)
    g[0, 1], p[1, 2], r[2] = np.nan, np.inf, np.nan
    _, got = accumulate(g, p, r, Scaling(1.0, 2.0, 4), 1.0, 1.0)
    assert got.count == 1
    assert np.isfinite(got.H).all() and np.isfinite((got.cost, got.weighted)).all()


def test_sums_have_the_same_bits_on_every_run(room: tuple) -> None:
    as_input, ref, spline, z = room
    runs = [block_sums(as_input(z), ref, spline, 0.05, 0.01) for _ in range(4)]
    for other in runs[1:]:
        assert np.array_equal(runs[0].H, other.H) and np.array_equal(runs[0].g, other.g)
        assert (runs[0].cost, runs[0].weighted, runs[0].count) == (other.cost, other.weighted, other.count)


@pytest.mark.parametrize("curved", [1, 0])
def test_a_column_that_moves_pixels_as_a_shift_does_has_the_curvature_of_one(curved: int) -> None:
    # Otherwise what the two have in common would be known of each alone.
    e, rng, bound = ENGINE, np.random.default_rng(1), 2.0
    scaling = Scaling(1.0, bound, 100)
    g, p = rng.uniform(-0.5, 0.5, (3, 50)), rng.uniform(-1.0, 1.0, (3, 50))
    r = rng.standard_normal(50) * 2.0
    device = [tuple(e.Float(row.astype(np.float32)) for row in rows) for rows in (g, p)]
    parameters = [e.Float(x) for x in scaling.parameters(1.0, 10.0)]
    given = e.Float(r.astype(np.float32)), e.Bool(True), parameters, e.UInt(0), [device[0][0] / bound], True, curved
    values = block_sums_module.contribution(e, *device, 1.0, *given).values
    raw = np.array([[np.broadcast_to(np.array(v, float), 50).sum() for v in values]])
    sums = scaling.unpack(np.pad(raw, ((0, 0), (0, 48 - raw.shape[1]))), 1, 1, 1)
    assert sums.columns is not None
    own, shared, moved = sums.columns.H[0, 0], sums.columns.coupling[0, 0, 0, 0], sums.H[0, 0, 0, 0]
    # A column's unit is `bound` here, whatever it is called.
    assert shared == pytest.approx(moved / bound, rel=1e-4)
    assert (own == pytest.approx(moved / bound**2, rel=1e-4)) == bool(curved) and own > 0.99 * moved / bound**2
