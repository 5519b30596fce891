"""Calibration out of recordings: derivatives, wrong starts, what is not told, and the file that comes of it."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import scipy.optimize
import synthetic

from rsgen.array_types import ByteArray, Float32Array
from rsgen.device.arrays import engine
from rsgen.device.lens import Lens
from rsgen.device.projection import project
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera, Model
from rsgen.geometry.shutter import Scan, Shutter
from rsgen.geometry.spline import Spline
from rstrack.calibration import run as calibration_run
from rstrack.calibration import solve as calibration_solve
from rstrack.calibration.findings.pace import Pace
from rstrack.calibration.findings.record import read_record
from rstrack.calibration.findings.residuals import Residuals, extrapolated, residuals_at, residuals_now
from rstrack.calibration.findings.result import Calibration
from rstrack.calibration.pairs.images import Taken, lines_of
from rstrack.calibration.pairs.load import like, load_stretch, pair_terms
from rstrack.calibration.pairs.optics import camera_table, moves, traced
from rstrack.calibration.pairs.trust import trust_in
from rstrack.calibration.run import calibrate, parameters_of
from rstrack.calibration.solve import Solution, solve
from rstrack.calibration.unknowns.devices import Device, Stream
from rstrack.calibration.unknowns.known import Known
from rstrack.calibration.unknowns.parameters import (
    COUNT,
    DEPTH_ERROR,
    DEPTH_LENS,
    DRIFT,
    LENS,
    NAMES,
    POSES,
    PRIOR,
    USEFUL,
    Parameters,
    changed,
    free_of,
)
from rstrack.cli.main import main
from rstrack.data.clocks.timing import Timing, stream_timing
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.data.depth_error import DepthError
from rstrack.data.noise import ImageReader, NoisyImages, with_noise
from rstrack.options import Options

READOUT_S, RATE_HZ, FRAMES = 0.014, 60.0, 60
CORNER = se3.exp(np.array([-0.3, -0.1, 0.2, -0.4, 0.65, 0.1]))
# As few as will do.
SHORT = slice(0, 42)
OPTIONS = Options(backend="llvm")
RESIDUALS, PACE = (Residuals(2e-3, 0.02), Residuals(1e-3, 0.01)), Pace(*np.ones((3, 2)))


def shaking() -> Spline:
    """T_world_depth over [-0.2, 1.3] s: turned and moved to and fro about all axes, before a corner of the room."""
    dt, t0 = 0.05, -0.2
    t = t0 + dt * (np.arange(33) - 1.0)
    turns = [0.07 * np.sin(9.0 * t), 0.08 * np.cos(11.0 * t), 0.06 * np.sin(13.0 * t)]
    moves = [0.05 * np.sin(7.0 * t), 0.05 * np.cos(5.0 * t), 0.04 * np.sin(6.0 * t)]
    return Spline(CORNER @ se3.exp(np.stack([*moves, *turns], axis=-1)), t0, dt)


def recording(root: Path, spline: Spline, readout_s: float = READOUT_S, scan: Scan = "top-bottom") -> Dataset:
    stream = {"rate_hz": RATE_HZ, "readout_s": readout_s, "scan": scan}
    config = synthetic.make_config(width=160, height=120, color=stream, depth=stream)
    writer = synthetic.open_writer(root, config, FRAMES, spline)
    synthetic.write_frames(writer)
    writer.finish()
    return open_dataset(root)


@pytest.fixture(scope="module")
def shaken(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return recording(tmp_path_factory.mktemp("calibration") / "seq", shaking())


@dataclass(frozen=True)
class FaultyDepth:
    """Images of which depth is what such an error makes of it."""

    images: ImageReader
    error: DepthError
    camera: Camera

    def color(self, k: int) -> ByteArray:
        return self.images.color(k)

    def depth(self, k: int) -> Float32Array:
        return self.error.corrected(self.images.depth(k), self.camera)


def bent(dataset: Dataset) -> Dataset:
    """With cameras that have a distortion, of nothing."""
    flat = [replace(c, model="radtan", distortion=(0.0,) * 5) for c in (dataset.rig.depth_camera,
                                                                       dataset.rig.color_camera)]  # fmt: skip
    return replace(dataset, rig=replace(dataset.rig, depth_camera=flat[0], color_camera=flat[1]))


def told(dataset: Dataset, readout_s: float, late_s: float, moved: np.ndarray, scan: Scan = "top-bottom") -> Dataset:
    """The dataset with cameras of which these are wrong."""
    rig = dataset.rig
    rig = replace(
        rig, depth_shutter=Shutter(readout_s, 0.0, scan), color_shutter=Shutter(readout_s, 0.0, scan),
        T_color_depth=se3.exp(moved) @ rig.T_color_depth,
    )  # fmt: skip
    return replace(dataset, rig=rig, color_stamps=dataset.color_stamps + late_s)


# --- derivatives -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("is_depth", [True, False])
@pytest.mark.parametrize("scan", ["top-bottom", "right-left"])
def test_lines_move_with_every_parameter_and_control_point_as_finite_differences_say(
    is_depth: bool, scan: Scan
) -> None:
    camera = synthetic.make_config(width=16, height=12).color.camera
    taken = Taken(Lens(camera, Shutter(1.0, 0.0, scan)), 0.4, 0.006, is_depth)
    p = Parameters(0.017, 0.021, 0.004, 2e-4, synthetic.T_COLOR_DEPTH, epoch_s=0.1)
    spline = shaking()
    lines = lines_of(taken, spline, p)
    # One line a block: 12 or 16 lines are fewer than there are blocks.
    assert len(lines.by_parameters) == taken.lens.lines == len(lines.T_world_cam)

    def moved(by: Parameters, along: Spline) -> np.ndarray:
        return se3.log(lines_of(taken, along, by).T_world_cam @ se3.inverse(lines.T_world_cam))

    for i in range(POSES):
        step = np.zeros(COUNT)
        step[i] = 1e-6
        numeric = (moved(p.moved(step), spline) - moved(p.moved(-step), spline)) / 2e-6
        np.testing.assert_allclose(lines.by_parameters[..., i], numeric, atol=1e-6, err_msg=NAMES[i])
    for column in range(lines.by_points.shape[2]):
        delta = np.zeros(6)
        delta[column % 6] = 1e-6
        at = lines.first + column // 6
        ends = []
        for sign in (1.0, -1.0):
            points = spline.control_points.copy()
            points[at] = se3.exp(sign * delta) @ points[at]
            ends.append(moved(p, Spline(points, spline.t0, spline.dt)))
        np.testing.assert_allclose(lines.by_points[..., column], (ends[0] - ends[1]) / 2e-6, atol=1e-7)


def test_the_gradient_changes_along_every_parameter_as_the_normal_equations_say(shaken: Dataset) -> None:
    lensed = bent(shaken)
    terms, p = pair_terms(engine("llvm"), lensed, np.ones(COUNT, bool)), parameters_of(lensed)
    assert shaken.truth is not None
    stretch = load_stretch(terms, lensed, range(4, 15), shaken.truth, p, OPTIONS)
    for _ in range(4):
        stretch.sums(terms, p, 0)
    sigma = stretch.sigma
    at = stretch.sums(terms, p, 0)
    for i in (*range(DRIFT), *range(DRIFT + 1, COUNT)):
        step = np.zeros(COUNT)
        step[i] = 3.0 / np.sqrt(at.H[-COUNT + i, -COUNT + i])
        ends = []
        for sign in (1.0, -1.0):
            stretch.sigma, stretch.brightness = sigma, dict.fromkeys(stretch.brightness, np.zeros(2))
            ends.append(stretch.sums(terms, p.moved(sign * step), 0))
        bend = (ends[0].g - ends[1].g)[-COUNT + i] / (2.0 * step[i])
        assert bend == pytest.approx(at.H[-COUNT + i, -COUNT + i], rel=0.25), NAMES[i]


def test_scipy_finds_the_same_offset_by_the_cost_alone(shaken: Dataset) -> None:
    terms, p = pair_terms(engine("llvm"), shaken), parameters_of(shaken)
    assert shaken.truth is not None
    stretches = [load_stretch(terms, shaken, range(4, 20), shaken.truth, p, OPTIONS)]
    ours = solve(stretches, terms, p, np.arange(COUNT) == 2, (0,))
    sigma = stretches[0].sigma

    def cost(offset_ms: float) -> float:
        stretches[0].sigma = sigma
        tried = replace(p, color_offset_s=1e-3 * offset_ms)
        return solve(stretches, terms, tried, np.zeros(COUNT, bool), (0,)).cost

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


# --- recordings ------------------------------------------------------------------------------------------------------


def test_wrong_cameras_are_put_right(shaken: Dataset) -> None:
    moved, late_s = np.array([3e-3, -3e-3, 2e-3, 0.005, -0.004, 0.004]), 0.008
    wrong = told(shaken, 0.0, late_s, moved)
    found = calibrate(wrong, options=OPTIONS)
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


def test_a_lens_and_depth_are_put_right(shaken: Dataset) -> None:
    rig, color = shaken.rig, shaken.rig.color_camera
    lens = replace(color, fx=1.02 * color.fx, fy=0.99 * color.fy, cx=color.cx + 1.5, cy=color.cy - 1.0)
    images = FaultyDepth(shaken.images, DepthError(-0.02), rig.depth_camera)
    wrong = replace(shaken, images=images, rig=replace(rig, color_camera=lens))
    found = calibrate(wrong, ("intrinsics", "depth"), options=OPTIONS)
    made = found.calibrated()
    for name in ("fx", "fy", "cx", "cy"):
        assert getattr(made.rig.color_camera, name) == pytest.approx(getattr(color, name), abs=0.15), name
        depth = getattr(made.rig.depth_camera, name), getattr(rig.depth_camera, name)
        assert depth[0] == pytest.approx(depth[1], abs=0.1), name
    assert made.rig.color_camera.distortion == pytest.approx((0.0,) * 5, abs=8e-3)
    np.testing.assert_allclose(made.depth(30), shaken.depth(30), atol=4e-3)
    assert found.values.error.offset_m == pytest.approx(0.02, abs=1e-3)
    text = found.text()
    assert "colour fx" in text and "depth offset" in text and "depth's scale cannot be told" in text


def test_lines_that_are_read_the_other_way_are_seen_to_be(tmp_path: Path) -> None:
    upward = recording(tmp_path / "seq", shaking(), scan="bottom-top")
    found = calibrate(told(upward, 0.004, 0.0, np.zeros(6)), frames=SHORT, options=OPTIONS)
    assert found.values.depth_readout_s < 0.0 and found.values.color_readout_s < 0.0
    right = found.calibrated()
    for shutter in (right.rig.depth_shutter, right.rig.color_shutter):
        assert shutter.scan == "bottom-top" and shutter.readout_s == pytest.approx(READOUT_S, abs=2e-4)
    # Stamps of both streams are those of the line that was thought to be first: alike for both, no offset.
    assert right.color_stamps == pytest.approx(upward.color_stamps, abs=2e-4)
    assert "depth is read bottom-top, not top-bottom" in found.text()


def test_columns_are_told_from_rows_where_nobody_names_them(tmp_path: Path) -> None:
    sideways = recording(tmp_path / "seq", shaking(), scan="right-left")
    unnamed = replace(told(sideways, 0.0, 0.0, np.zeros(6)), scan_named=False)
    found = calibrate(unnamed, ("readout",), SHORT, OPTIONS)
    for shutter in (found.calibrated().rig.depth_shutter, found.calibrated().rig.color_shutter):
        assert shutter.scan == "right-left" and shutter.readout_s == pytest.approx(READOUT_S, abs=2e-4)


def test_an_image_exposed_at_once_has_no_readout(tmp_path: Path) -> None:
    at_once = recording(tmp_path / "seq", shaking(), readout_s=0.0)
    found = calibrate(told(at_once, 0.012, 0.0, np.zeros(6)), ("readout",), SHORT, OPTIONS)
    sigmas = found.sigmas
    for i, readout_s in enumerate((found.values.depth_readout_s, found.values.color_readout_s)):
        assert abs(readout_s) < min(4.0 * sigmas[i], 3e-4)


def test_a_camera_at_rest_tells_nothing_and_that_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    spline = shaking()
    still = Spline(np.broadcast_to(CORNER, spline.control_points.shape).copy(), spline.t0, spline.dt)
    rest = recording(tmp_path / "seq", still)
    # Noise is not taken for motion either.
    noisy = replace(rest, images=NoisyImages(rest.images, 1.2e-3, 0.01, 1))
    found = calibrate(noisy, frames=SHORT, options=OPTIONS)
    assert found.undetermined[found.asked].all()
    assert found.values.since(found.start) == pytest.approx(np.zeros(COUNT), abs=1e-12)
    assert "undetermined: needs turning" in found.text() and "this recording moves at" in found.text()
    monkeypatch.setattr(calibration_run, "calibrate", lambda *_: found)
    assert main(["calibrate", str(tmp_path / "seq"), "--quiet"]) == 1
    assert "undetermined" in capsys.readouterr().out


def test_a_bare_wall_is_told_from_a_room(shaken: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def grey(*_: object) -> ByteArray:
        return np.full((120, 160, 3), 127, np.uint8)

    monkeypatch.setattr(synthetic, "BALL", np.array([0.35, 0.25, -30.0]))
    monkeypatch.setattr(synthetic, "render_color", grey)
    base = shaking()
    wall = se3.exp(np.array([0.0, 0.0, 1.0, 0.05, 0.1, 0.0])) @ se3.inverse(CORNER) @ base.control_points
    bare = recording(tmp_path / "wall", Spline(wall, base.t0, base.dt))
    trusts = []
    for dataset in (shaken, bare):
        noisy = replace(dataset, images=NoisyImages(dataset.images, 1.2e-3, 0.01, 1))
        terms, p = pair_terms(engine("llvm"), noisy), parameters_of(noisy)
        assert dataset.truth is not None
        stretch = load_stretch(terms, noisy, range(10, 24), dataset.truth, p, OPTIONS)
        for _ in range(3):
            stretch.sums(terms, p, 0)
        trusts.append(trust_in(stretch, terms, p))
    assert trusts[0] > 0.8 and trusts[1] < 0.3
    monkeypatch.setattr(calibration_run, "trust_in", lambda *_: 0.1)
    with pytest.raises(UserError, match="4 of 4 stretches what seems to be known of the motion is noise"):
        calibrate(shaken, ("readout",), options=OPTIONS)


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


@pytest.mark.parametrize("drift", [0.0, 3e-3])
def test_a_drift_is_found_or_else_held(shaken: Dataset, monkeypatch: pytest.MonkeyPatch, drift: float) -> None:
    monkeypatch.setattr(calibration_run, "_DRIFT_S", 0.5)
    # A second shows a drift a hundred times less well than ten do.
    monkeypatch.setattr(calibration_solve, "USEFUL", np.where(np.arange(COUNT) == DRIFT, 1e-3, USEFUL))
    off = drift * (shaken.color_stamps - shaken.middle)
    found = calibrate(replace(shaken, color_stamps=shaken.color_stamps - off), ("offset",), options=OPTIONS)
    assert found.asked[DRIFT] == (drift > 0.0) and not found.undetermined.any()
    assert found.values.color_drift == pytest.approx(drift, abs=2e-4 if drift else 0.0)
    assert ("colour drift" in found.text()) == (drift > 0.0)


def test_noise_is_that_of_track_and_makes_sigmas_grow(shaken: Dataset) -> None:
    noisy = replace(shaken, images=NoisyImages(shaken.images, 2e-3, 0.02, 7))
    frame = with_noise(shaken.frame(9), 9, 2e-3, 0.02, 7)
    np.testing.assert_array_equal(noisy.images.depth(9), frame.depth.pixels)
    np.testing.assert_array_equal(noisy.images.color(9), frame.colors[0].pixels)
    plain, grown = (calibrate(each, ("readout",), options=OPTIONS) for each in (shaken, noisy))
    assert (grown.sigmas[:2] > 2.0 * plain.sigmas[:2]).all()
    assert (np.abs(grown.values.since(grown.start)[:2]) < 5.0 * grown.sigmas[:2]).all()


def test_ctrl_c_keeps_what_there_is(shaken: Dataset) -> None:
    calls: list[str] = []

    def progress(stage: str, _: float, note: str) -> None:
        calls.append(stage)
        if note.startswith("readouts") and sum(stage == "calibrating" for stage in calls) > 6:
            raise KeyboardInterrupt

    found = calibrate(told(shaken, 0.012, 0.0, np.zeros(6)), options=OPTIONS, progress=progress)
    assert not found.solution.finished and "interrupted" in found.text()
    assert abs(found.values.color_readout_s - READOUT_S) < abs(0.012 - READOUT_S)


def test_looking_at_residuals_leaves_stretches_as_they_are(shaken: Dataset) -> None:
    noisy = replace(shaken, images=NoisyImages(shaken.images, 2e-3, 0.02, 7))
    terms, p = pair_terms(engine("llvm"), noisy), parameters_of(noisy)
    assert noisy.truth is not None
    seen, other = (load_stretch(terms, noisy, range(4, 20), noisy.truth, p, OPTIONS) for _ in range(2))
    before = seen.sigma, dict(seen.brightness), seen.spline.control_points.copy()
    found = residuals_at([seen], terms, p)
    assert (seen.sigma, seen.brightness) == before[:2]
    np.testing.assert_array_equal(seen.spline.control_points, before[2])
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


# --- what is said of it ----------------------------------------------------------------------------------------------


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


def test_a_spline_like_another_passes_through_its_poses() -> None:
    track = shaking()
    made = like(track, -0.013, 0.025, 44)
    through = Spline(track.pose(np.clip(-0.013 + 0.025 * (np.arange(44) - 1), track.t_begin, None)), -0.013, 0.025)
    t = np.linspace(0.05, 0.95, 200)
    off, plain = (np.abs(se3.log(se3.inverse(s.pose(t)) @ track.pose(t))).max() for s in (made, through))
    assert off < 1e-4 and off < 0.1 * plain


def test_the_camera_file_says_what_was_found(shaken: Dataset, tmp_path: Path) -> None:
    start = parameters_of(shaken)
    step = np.zeros(COUNT)
    step[:POSES] = -0.02, 2e-3, -1.5e-3, 1e-5, 1e-3, 0, 0, 0, 0.01, 0
    step[POSES : POSES + 4], step[DEPTH_ERROR] = (0.01, -0.02, 0.03, -0.01), (0.004, 1e-3, -2e-3)
    found = start.moved(step)
    free = np.ones(COUNT, bool)
    free[5] = False
    A = np.array([np.diag(1.0 / (1e-3 * PRIOR[free]) ** 2)] * 3)
    solution = Solution(found, free, A, np.zeros((3, COUNT - 1)), 0.0, 1e-3, 1e-2)
    motion = calibration_run.motion_of(shaken, [range(30)], shaking())
    made = Calibration(shaken, start, solution, np.ones(COUNT, bool), (range(30),), motion, 1.0, RESIDUALS, PACE)
    (tmp_path / "camera.yaml").write_text(made.camera_file())
    again = open_dataset(shaken.root, tmp_path / "camera.yaml")
    expected = made.calibrated()
    for ours, theirs in zip(
        (again.rig.depth_shutter, again.rig.color_shutter), (expected.rig.depth_shutter, expected.rig.color_shutter),
        strict=True,
    ):  # fmt: skip
        assert ours.scan == theirs.scan and ours.readout_s == pytest.approx(theirs.readout_s, abs=1e-7)
    assert again.rig.depth_shutter.scan == "bottom-top"
    assert again.depth_error == expected.depth_error == DepthError(0.004, 1e-3, -2e-3)
    assert pytest.approx(changed(shaken.rig.depth_camera, step[DEPTH_LENS]).K, rel=1e-9) == again.rig.depth_camera.K
    np.testing.assert_allclose(again.rig.T_color_depth, expected.rig.T_color_depth, atol=1e-10)
    np.testing.assert_allclose(again.color_stamps, expected.color_stamps, atol=2e-7)
    # Stamps are used as they were, whatever 'auto' would make of them.
    clock = stream_timing("depth", shaken.stamps, "regular", 0.0)
    regular = replace(made, dataset=replace(shaken, timing=Timing(clock, clock, 0.0)))
    assert "\nstamps: regular" in regular.camera_file() and "\nstamps" not in made.camera_file()
    text = (tmp_path / "camera.yaml").read_text()
    assert "±" in text and "undetermined, kept" in text
    parameters = made.as_dict()["parameters"]
    assert parameters["T_color_depth.y"]["sigma"] is None and parameters["color.offset_s"]["sigma"] > 0.0


def test_ctrl_c_while_calibrating_ends_track_too(
    shaken: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(dataset: Dataset, *_: object) -> Calibration:
        start = parameters_of(dataset)
        nothing = Solution(start, np.zeros(COUNT, bool), np.zeros((3, 0, 0)), np.zeros((3, 0)), 0, 1, 1, finished=False)
        motion = calibration_run.motion_of(dataset, [range(30)], shaking())
        return Calibration(dataset, start, nothing, nothing.free, (range(30),), motion, 1.0, RESIDUALS, PACE)

    monkeypatch.setattr(calibration_run, "calibrate", interrupted)
    assert main(["track", str(shaken.root), "--calibrate", "--out", str(tmp_path / "run"), "--quiet"]) == 130
    assert not (tmp_path / "run").exists()


def test_a_sequence_is_calibrated_and_tracked_by_command(
    shaken: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wrong = tmp_path / "wrong.yaml"
    K = [120.0, 120.0, 79.5, 59.5]
    T = shaken.rig.T_color_depth.tolist()
    stream = f"width: 160, height: 120, intrinsics: {K}, scan: top-bottom"
    wrong.write_text(
        f"color: {{{stream}, readout_s: 0.0, offset_s: 0.006}}\ndepth: {{{stream}, readout_s: 0.0}}\n"
        f"T_color_depth: {T}\n"
    )
    right, run = tmp_path / "right.yaml", tmp_path / "run"
    arguments = ["--camera", str(wrong), "--free", "readout,offset", "--out", str(right), "--quiet", "--json"]
    arguments += ["--report", str(tmp_path / "new/page.html")]
    assert main(["calibrate", str(shaken.root), *arguments, "--backend", "llvm"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["parameters"]["color.offset_s"]["value"] == pytest.approx(0.0, abs=2e-4)
    assert figures["parameters"]["color.offset_s"]["shown"] == {"label": "colour offset", "unit": "ms", "factor": 1e3}
    depth_m, intensity = (figures["residuals"][kind] for kind in ("depth_m", "intensity"))
    assert depth_m["before"] > 2.0 * depth_m["after"] and intensity["before"] >= intensity["after"]
    times, pace = np.array(figures["stretch_times_s"]), figures["pace"]
    assert (times[:, 1] - times[:, 0] == pytest.approx(13 / RATE_HZ, abs=2e-4)) and times.max() <= FRAMES / RATE_HZ
    turning = np.linalg.norm(shaking().velocity(np.array(pace["time_s"]) + shaken.stamps[0])[:, 3:], axis=1)
    assert np.median(np.abs(pace["rad_s"] - turning)) < 0.1 * turning.mean()
    assert "camera.yaml" in (tmp_path / "new/page.html").read_text()
    assert main(["track", str(shaken.root), "--camera", str(right), "--out", str(run), "--quiet"]) == 0
    assert main(["evaluate", str(shaken.root), str(run), "--json"]) == 0
    out = capsys.readouterr().out
    errors = json.loads(out[out.index("{\n") :])
    assert errors["ate_rmse_m"] < 2e-3
    more = ["--camera", str(wrong), "--calibrate", "--out", str(tmp_path / "again"), "--frames", "0:50", "--quiet"]
    assert main(["track", str(shaken.root), *more]) in (0, 1)
    assert (tmp_path / "again/camera.yaml").read_text().startswith("# rstrack calibrate synthetic")
    kept = read_record(tmp_path / "again/calibration.json")
    assert kept.camera_file == (tmp_path / "again/camera.yaml").read_text()
    assert main(["track", str(shaken.root), "--out", str(tmp_path / "again"), "--frames", "0:20", "--quiet"]) in (0, 1)
    assert not (tmp_path / "again/calibration.json").exists(), "it is of another run"


# --- a device that is known ------------------------------------------------------------------------------------------


def test_known_values_draw_a_solution_by_as_much_as_they_weigh(shaken: Dataset) -> None:
    terms, start, free = pair_terms(engine("llvm"), shaken), parameters_of(shaken), free_of(("readout",))
    off = replace(start, color_readout_s=start.color_readout_s + 5e-4)
    assert shaken.truth is not None
    stretches = [load_stretch(terms, shaken, range(4, 20), shaken.truth, start, OPTIONS)]
    errors = []
    for sigma_s in (np.inf, 1.0, 1e-7):
        known = Known(off, np.where(np.arange(COUNT) == 1, sigma_s, np.inf))
        found = solve(stretches, terms, off, free, (0,), known=known)
        errors.append(found.values.color_readout_s - off.color_readout_s)
    assert errors[0] == pytest.approx(-5e-4, abs=1.5e-4) and errors[1] == pytest.approx(errors[0], abs=1e-5)
    assert abs(errors[2]) < 1e-6 and found.sigmas[1] == pytest.approx(1e-7, rel=0.1)


def test_a_device_that_the_recording_contradicts_is_left_out(shaken: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calibration_run, "_COARSE", (1,))
    wrong = told(shaken, 0.01, 0.0, np.zeros(6))
    stream = Stream("global", "made up", "https://example.org", 0.0, 1e-4)
    device = Device("made-up", "Made up", stream, stream)
    found = calibrate(wrong, ("readout",), SHORT, OPTIONS, device=device)
    assert found.text().count("this recording contradicts the device's") == 2 and found.start.depth_readout_s == 0.0
    for readout_s in (found.values.depth_readout_s, found.values.color_readout_s):
        assert readout_s == pytest.approx(READOUT_S, abs=1e-3)
    assert "# device: Made up: depth global" in found.camera_file()
