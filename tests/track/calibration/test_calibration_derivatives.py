"""Calibration: derivatives against finite differences, the solution against SciPy, and the size of errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize
import synthetic
from shaken_recording import CORNER, OPTIONS, READOUT_S, SHORT, bent, shaking, told

from rsgen.device.arrays import engine
from rsgen.device.lens import Lens
from rsgen.device.projection import project
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera, Model
from rsgen.geometry.shutter import Scan, Shutter
from rsgen.geometry.spline import Spline
from rstrack.calibration.figures import extrapolated, residuals_at, residuals_now
from rstrack.calibration.pairs import window as pairs_window
from rstrack.calibration.pairs.images import ImageTiming, lines_of
from rstrack.calibration.pairs.optics import camera_table, moves, traced
from rstrack.calibration.pairs.terms import PairTerms
from rstrack.calibration.parameters import (
    COUNT,
    DRIFT,
    LENS,
    NAMES,
    POSES,
    Known,
    Parameters,
    changed,
    free_of,
)
from rstrack.calibration.run import calibrate, parameters_of
from rstrack.calibration.solve import Solution, solve
from rstrack.calibration.start import like, load_window
from rstrack.data.dataset import Dataset
from rstrack.data.image_files import NoisyImages
from rstrack.data.rig import DepthError
from rstrack.images.line_poses import rows_of


@pytest.mark.parametrize("is_depth", [True, False])
@pytest.mark.parametrize("scan", ["top-bottom", "right-left"])
def test_lines_move_with_every_parameter_and_control_point_as_finite_differences_say(
    is_depth: bool, scan: Scan
) -> None:
    camera = synthetic.make_config(width=16, height=12).color.camera
    taken = ImageTiming(Lens(camera, Shutter(1.0, 0.0, scan)), 0.4, 0.006, is_depth)
    p = Parameters(0.017, 0.021, 0.004, 2e-4, synthetic.T_COLOR_DEPTH, epoch_s=0.1)
    spline, T_base_world = shaking(), se3.inverse(CORNER)
    lines = lines_of([taken], spline, p, T_base_world)
    count = taken.lens.lines
    # One line a block: 12 or 16 lines are fewer than there are blocks.
    assert lines.slopes.shape[:3] == (1, count, 6)

    def poses(by: Parameters, along: Spline) -> tuple[np.ndarray, np.ndarray]:
        first, readout = taken.begin(by)
        T_cam_body = np.eye(4) if is_depth else by.T_color_depth
        at = along.pose_and_velocity(first + readout * np.arange(count) / count)
        return T_base_world @ at[0] @ se3.inverse(T_cam_body), at[1] @ se3.adjoint(T_cam_body).T * readout / count

    T_base_cam, twist = poses(p, spline)
    np.testing.assert_allclose(lines.to_base[0], rows_of(T_base_cam), atol=1e-6)
    np.testing.assert_allclose(lines.from_base[0], np.hstack([rows_of(se3.inverse(T_base_cam)), twist]), atol=1e-6)

    def slope(ends: list[tuple[Parameters, Spline]], step: float) -> np.ndarray:
        there, here = (poses(*end)[0] for end in ends)
        return se3.log(there @ se3.inverse(here)) / (2.0 * step)

    for i in range(POSES):
        step = np.zeros(COUNT)
        step[i] = 1e-6
        numeric = slope([(p.moved(step), spline), (p.moved(-step), spline)], 1e-6)
        analytic = lines.slopes[0, ..., 24 + lines.moved.index(i)] if i in lines.moved else np.zeros((count, 6))
        np.testing.assert_allclose(analytic, numeric, atol=1e-6, err_msg=NAMES[i])
    for at in range(int(lines.first.min()) - 1, int(lines.first.max()) + 5):
        for k in range(6):
            ends = []
            for sign in (1e-6, -1e-6):
                points = spline.control_points.copy()
                points[at] = se3.exp(sign * np.eye(6)[k]) @ points[at]
                ends.append((p, Spline(points, spline.t0, spline.dt)))
            own = at - lines.first[0]
            analytic = np.zeros((count, 6))
            for line in np.flatnonzero((own >= 0) & (own < 4)):
                analytic[line] = lines.slopes[0, line, :, 6 * own[line] + k]
            np.testing.assert_allclose(analytic, slope(ends, 1e-6), atol=1e-7)


@pytest.mark.parametrize("readout_s", [0.03, -0.02, 0.0])
def test_lines_between_those_that_are_worked_out_lie_where_the_spline_has_them(readout_s: float) -> None:
    camera = synthetic.make_config(width=64, height=250).color.camera
    taken = ImageTiming(Lens(camera, Shutter(1.0, 0.0)), 0.4, 0.0, False)
    p = Parameters(0.0, readout_s, 0.0, 0.0, synthetic.T_COLOR_DEPTH)
    found = lines_of([taken, replace(taken, stamp=0.6)], shaking(), p, se3.inverse(CORNER))
    for k, stamp in enumerate((0.4, 0.6)):
        T_body, velocity = shaking().pose_and_velocity(stamp + readout_s * np.arange(250) / 250)
        T = se3.inverse(CORNER) @ T_body @ se3.inverse(synthetic.T_COLOR_DEPTH)
        np.testing.assert_allclose(found.to_base[k], rows_of(T), atol=1e-6)
        twist = velocity @ se3.adjoint(synthetic.T_COLOR_DEPTH).T * readout_s / 250
        np.testing.assert_allclose(found.from_base[k], np.hstack([rows_of(se3.inverse(T)), twist]), atol=1e-6)


def test_the_gradient_changes_along_every_parameter_as_the_normal_equations_say(
    shaken: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pairs_window, "_APART", (4,))
    lensed = bent(shaken)
    terms, p = PairTerms(engine("llvm"), lensed, np.ones(COUNT, bool)), parameters_of(lensed)
    assert shaken.truth is not None
    window = load_window(terms, lensed, range(4, 15), shaken.truth, p, OPTIONS)
    for _ in range(4):
        window.sums(terms, p, 0)
    sigma = window.sigma
    at = window.sums(terms, p, 0)
    for i in (*range(DRIFT), *range(DRIFT + 1, COUNT)):
        step = np.zeros(COUNT)
        step[i] = 3.0 / np.sqrt(at.H[-COUNT + i, -COUNT + i])
        ends = []
        for sign in (1.0, -1.0):
            window.sigma, window.brightness = sigma, np.zeros_like(window.brightness)
            ends.append(window.sums(terms, p.moved(sign * step), 0))
        bend = (ends[0].g - ends[1].g)[-COUNT + i] / (2.0 * step[i])
        assert bend == pytest.approx(at.H[-COUNT + i, -COUNT + i], rel=0.25), NAMES[i]


def test_scipy_finds_the_same_offset_by_the_cost_alone(shaken: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pairs_window, "_APART", (5,))
    terms, p = PairTerms(engine("llvm"), shaken, free_of(())), parameters_of(shaken)
    assert shaken.truth is not None
    windows = [load_window(terms, shaken, range(4, 20), shaken.truth, p, OPTIONS)]
    ours = solve(windows, terms, p, np.arange(COUNT) == 2, (0,))
    sigma = windows[0].sigma

    def cost(offset_ms: float) -> float:
        windows[0].sigma = sigma
        tried = replace(p, color_offset_s=1e-3 * offset_ms)
        return solve(windows, terms, tried, np.zeros(COUNT, bool), (0,)).cost

    found = scipy.optimize.minimize_scalar(cost, bounds=(-0.4, 0.4), method="bounded", options={"xatol": 2e-3})
    assert 1e-3 * found.x == pytest.approx(ours.values.color_offset_s, abs=2.5e-5)


@pytest.mark.parametrize("model", ["radtan", "fisheye", "pinhole"])
def test_points_move_as_pixels_do_when_a_lens_or_depth_changes(model: Model) -> None:
    bends = {"radtan": (0.1, -0.05, 2e-3, -1e-3, 0.02), "fisheye": (0.02, -0.01, 0.0, 0.0), "pinhole": ()}
    camera = Camera(160, 120, 121.0, 119.0, 78.0, 61.0, model, bends[model])
    e = engine("llvm")
    rng = np.random.default_rng(3)
    q = np.column_stack([rng.uniform(-0.4, 0.4, 50), rng.uniform(-0.3, 0.3, 50), np.ones(50)])
    q *= rng.uniform(0.7, 3.0, 50)[:, None]
    table = e.upload(camera_table(camera))
    lens = traced(e, Lens(camera, Shutter()), table)
    device = tuple(e.upload(q[:, i]) for i in range(3))
    names = (*(LENS if model == "radtan" else LENS[:4]), "offset_m", "inverse_offset", "radial")
    found = moves(names, lens.camera, project(lens.camera, device))
    uv = camera.project(q)[0]
    for name, move in zip(names, found, strict=True):
        shift = np.stack(np.broadcast_arrays(*(np.array(part) for part in move), q[:, 0])[:3], axis=-1)
        if name in LENS:
            step = np.zeros(len(LENS))
            step[LENS.index(name)] = 1e-5
            wanted = (changed(camera, step).project(q)[0] - changed(camera, -step).project(q)[0]) / 2e-5
            # By the larger unknown, and by the point's own move.
            got = (camera.project(q + 1e-5 * shift)[0] - camera.project(q - 1e-5 * shift)[0]) / 2e-5
            np.testing.assert_allclose(got, wanted, atol=2e-3 * np.abs(wanted).max(), err_msg=name)
            continue
        z, ends = q[:, 2], []
        for sign in (1e-4, -1e-4):
            error = replace(DepthError(), **{name: sign})
            x, y = np.rint(uv).astype(int).T
            image = np.zeros((120, 160), np.float32)
            r2 = ((q[:, :2] / z[:, None]) ** 2).sum(axis=1)
            image[y, x] = z
            near = (camera.unproject(np.stack([x, y], axis=-1))[:, :2] ** 2).sum(axis=1)
            # The pixel's ray is not quite the point's.
            own = error.corrected(image, camera)[y, x] - z
            ends.append(own * (r2 / near if name == "radial" else 1.0))
        grown = (ends[0] - ends[1]) / 2e-4
        unique = np.unique(np.rint(uv), axis=0, return_index=True)[1]
        np.testing.assert_allclose(-shift[unique, 2], grown[unique], rtol=0.02, atol=5e-3, err_msg=name)


@pytest.mark.nightly
def test_wrong_cameras_are_put_right(shaken: Dataset) -> None:
    moved, late_s = np.array([3e-3, -3e-3, 2e-3, 0.005, -0.004, 0.004]), 0.008
    wrong = told(shaken, 0.0, late_s, moved)
    found = calibrate(wrong, None, SHORT, OPTIONS)
    p, true = found.values, shaken.rig
    assert not found.undetermined[[0, 1, 2, 4, 5, 6, 7, 8, 9]].any() and found.solution.finished
    assert p.depth_readout_s == pytest.approx(READOUT_S, abs=1.5e-4)
    assert p.color_readout_s == pytest.approx(READOUT_S, abs=1.5e-4)
    assert p.color_offset_s == pytest.approx(-late_s, abs=1.5e-4)
    off = se3.log(p.T_color_depth @ se3.inverse(true.T_color_depth))
    assert np.abs(off[:3]).max() < 1.5e-3 and np.degrees(np.abs(off[3:])).max() < 0.06
    errors = p.depth_readout_s - READOUT_S, p.color_readout_s - READOUT_S, p.color_offset_s + late_s
    assert (np.abs(errors) < 5.0 * found.sigmas[:3]).all() and (found.sigmas[:3] < 3e-4).all()
    assert "±" in found.text() and "undetermined" not in found.text()


def test_what_residuals_hardly_feel_is_not_told() -> None:
    free, p = np.arange(COUNT) < 2, Parameters(0.02, 0.02, 0.0, 0.0, np.eye(4))
    A = np.array([np.diag([4e8, 4e8])] * 3)
    # Three times 10⁷ pixels: a useful change of 2 ms moves residuals by 0.07 of their noise, or by 0.002.
    few, many = (Solution(p, free, A, np.zeros((3, 2)), 0.0, 1e-3, 1e-2, pixels=n) for n in (10**6, 10**9))
    assert (few.unsure[:2] < 1.0).all() and (many.unsure[:2] > 1.0).all() and not many.unsure[2:].any()
    assert few.sigmas == pytest.approx(many.sigmas)


def test_too_little_to_go_by_is_said_in_one_line(shaken: Dataset) -> None:
    with pytest.raises(UserError, match="20 frames are too few to calibrate from: 42 or more"):
        calibrate(shaken, frames=slice(0, 20), options=OPTIONS)
    with pytest.raises(UserError, match="--free lens: choose one or more of readout, offset, extrinsics, depth"):
        calibrate(shaken, ("readout", "lens"), options=OPTIONS)
    blind = replace(shaken, groups=((),) * len(shaken))
    with pytest.raises(UserError, match="no colour images"):
        calibrate(blind, options=OPTIONS)


def test_looking_at_residuals_leaves_windows_as_they_are(shaken: Dataset) -> None:
    noisy = replace(shaken, images=NoisyImages(shaken.images, 2e-3, 0.02, 7))
    terms, p = PairTerms(engine("llvm"), noisy, free_of(())), parameters_of(noisy)
    assert noisy.truth is not None
    seen, other = (load_window(terms, noisy, range(4, 20), noisy.truth, p, OPTIONS) for _ in range(2))
    before = seen.sigma, seen.brightness.copy(), seen.spline.control_points.copy()
    found = residuals_at([seen], terms, p)
    assert seen.sigma == before[0]
    np.testing.assert_array_equal(seen.brightness, before[1])
    np.testing.assert_array_equal(seen.spline.control_points, before[2])
    # Pixels are summed as integers: two launches give the same.
    np.testing.assert_array_equal(seen.sums(terms, p, 0).g, other.sums(terms, p, 0).g)
    for _ in range(9):
        other.sums(terms, p, 0)
    settled = residuals_now([other])
    assert found.depth_m == pytest.approx(settled.depth_m, rel=0.06)
    assert found.intensity == pytest.approx(settled.intensity, rel=0.06)
    late = residuals_at([seen], terms, replace(p, color_offset_s=0.02))
    assert late.intensity > 1.3 * found.intensity and late.depth_m == pytest.approx(found.depth_m, rel=0.02)


def test_scales_are_extrapolated_by_the_factor_by_which_steps_shrink() -> None:
    steps = 3.0 + np.array([2.0, -1.0]) * 0.5 ** np.arange(4)[:, None]
    np.testing.assert_allclose(extrapolated(steps), [3.0, 3.0])
    still = np.full((3, 2), 4.0)
    np.testing.assert_array_equal(extrapolated(still), [4.0, 4.0])
    growing = np.array([[1.0], [2.0], [9.0]])
    assert 9.0 < extrapolated(growing)[0] <= 9.0 + 2.0 * 7.0


def test_sigmas_are_those_of_the_scatter() -> None:
    rng = np.random.default_rng(5)
    free = free_of(("readout",))
    A = np.array([np.diag([4e10, 1e10])] * 12) * rng.uniform(0.5, 1.5, (12, 1, 1))
    # Gradients three times as large as the normal equations say: so are σ.
    b = 3.0 * rng.standard_normal((12, 2)) * np.sqrt(np.einsum("snn->sn", A))
    p = Parameters(0.02, 0.02, 0.0, 0.0, np.eye(4))
    sigmas = Solution(p, free, A, b - b.mean(axis=0), 0.0, 1e-3, 1e-2).sigmas
    formal = 1.0 / np.sqrt(np.einsum("snn->n", A))
    assert (sigmas[:2] / formal > 2.0).all() and (sigmas[:2] / formal < 4.6).all() and not sigmas[2:].any()


def test_gains_that_chance_makes_are_called_chance() -> None:
    rng, free, p = np.random.default_rng(2), np.arange(COUNT) < 4, Parameters(0.02, 0.02, 0.0, 0.0, np.eye(4))
    which = np.arange(COUNT) < 2
    # Information that counts 50 times too much: what two unknowns gain is 50 halves of a chi-square of two.
    A, found = np.array([np.diag([4e4, 1e4, 9e4, 1e4])] * 60), []
    for _ in range(400):
        b = np.sqrt(50.0 * np.einsum("snn->sn", A)) * rng.standard_normal((60, 4))
        gain = 0.5 * float((b.sum(axis=0)[:2] ** 2 / np.einsum("snn->n", A)[:2]).sum())
        found.append(Solution(p, free, A, b, 0.0, 1e-3, 1e-2).chance(gain, which))
    assert np.mean(np.array(found) < 0.1) == pytest.approx(0.1, abs=0.05)
    assert np.mean(np.array(found) < 0.5) == pytest.approx(0.5, abs=0.08)


def test_a_spline_like_another_passes_through_its_poses() -> None:
    track = shaking()
    made = like(track, -0.013, 0.025, 44)
    through = Spline(track.pose(np.clip(-0.013 + 0.025 * (np.arange(44) - 1), track.t_begin, None)), -0.013, 0.025)
    t = np.linspace(0.05, 0.95, 200)
    off, plain = (np.abs(se3.log(se3.inverse(s.pose(t)) @ track.pose(t))).max() for s in (made, through))
    assert off < 1e-4 and off < 0.1 * plain


def test_known_values_draw_a_solution_by_as_much_as_they_weigh(shaken: Dataset) -> None:
    terms, start, free = PairTerms(engine("llvm"), shaken, free_of(())), parameters_of(shaken), free_of(("readout",))
    off = replace(start, color_readout_s=start.color_readout_s + 5e-4)
    assert shaken.truth is not None
    windows = [load_window(terms, shaken, range(4, 20), shaken.truth, start, OPTIONS)]
    errors = []
    for sigma_s in (np.inf, 1.0, 1e-7):
        known = Known(off, np.where(np.arange(COUNT) == 1, sigma_s, np.inf))
        found = solve(windows, terms, off, free, (0,), known=known)
        errors.append(found.values.color_readout_s - off.color_readout_s)
    assert errors[0] == pytest.approx(-5e-4, abs=1.5e-4) and errors[1] == pytest.approx(errors[0], abs=1e-5)
    assert abs(errors[2]) < 1e-6 and found.sigmas[1] == pytest.approx(1e-7, rel=0.1)
