"""What a wrong camera file does to a track is what the model of it says: by tracking with wrong cameras."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import synthetic
from nightly import sampled
from shaken_recording import OPTIONS, SHORT
from shaken_recording import told as told_wrongly

from rsgen.device.lens import Lens
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rstrack.data.camera_file import camera_content, read_rig
from rstrack.data.dataset import Dataset
from rstrack.data.rig import (
    CALIBRATION_NAMES,
    DEFAULT_SIGMA,
    EXACT_SIGMA,
    UNDISTORTED,
    UNSTATED_POSE,
    CalibrationSigma,
    Frame,
    Image,
    Rig,
)
from rstrack.options import Options
from rstrack.tracking.judgement.calibration_errors import CalibrationErrors
from rstrack.tracking.judgement.consider import CLOCK, COUNT, Rays, _moves
from rstrack.tracking.runs.run import track
from rstrack.tracking.spline_tracker import Tracker

CAMERA = Camera(160, 120, 120.0, 120.0, 79.5, 59.5)
SHUTTER = Shutter(readout_s=0.028)
TRUTH = synthetic.make_spline(0.3)
FRAMES = 12
# Every parameter by itself: one σ is one unit, but of the clock, which is put right where it may be off by much.
UNIT = CalibrationSigma(1.0, 1.0, 1.0, 1.0, 1.0, float(np.degrees(1.0)), 1.0, 1.0, 1e-6, 1.0, 1.0)
UNITS = np.where(np.arange(COUNT) == CLOCK, UNIT.offset_s, 1.0)
RIG = Rig(CAMERA, SHUTTER, CAMERA, SHUTTER, synthetic.T_COLOR_DEPTH)


@cache
def frames() -> tuple[Frame, ...]:
    def at(stamp: float) -> Frame:
        depth = synthetic.render_depth(TRUTH, CAMERA, SHUTTER, stamp)
        color = synthetic.render_color(TRUTH, CAMERA, SHUTTER, stamp, synthetic.T_COLOR_DEPTH)
        return Frame(Image(stamp, depth), (Image(stamp, color),))

    return tuple(at(k / 30.0) for k in range(FRAMES))


def tracked(rig: Rig, method: str = "rs-pg", scale: float = 1.0, late_s: float = 0.0) -> Tracker:
    tracker = Tracker(rig, Options(method=method))  # type: ignore[arg-type]
    for frame in frames():
        depth = replace(frame.depth, pixels=np.float32(scale) * frame.depth.pixels)
        tracker.feed(Frame(depth, tuple(replace(image, stamp=image.stamp + late_s) for image in frame.colors)))
    assert not any(report.lost for report in tracker.reports)
    return tracker


@cache
def told(method: str) -> tuple[np.ndarray, np.ndarray]:
    """Poses of frames, and what one unit of each parameter does to them (n, 6, 25)."""
    tracker = tracked(replace(RIG, sigma=UNIT), method)
    common = np.stack([report.common for report in tracker.reports[-6:]])  # type: ignore[misc]
    return tracker.trajectory[1][-6:], common / UNITS


def wrong(name: str, by: float) -> tuple[Rig, float, float]:
    """The rig with one parameter told wrongly, depth's scale, and by how much colours' stamps are late."""
    kind, _, own = name.partition(".")
    if name == "depth.scale":
        return RIG, 1.0 + by, 0.0
    if name == "color.offset_s":
        return RIG, 1.0, by
    if kind == "T_color_depth":
        step = np.zeros(6)
        step[["x", "y", "z", "rx", "ry", "rz"].index(own)] = by
        return replace(RIG, T_color_depth=se3.exp(step) @ RIG.T_color_depth), 1.0, 0.0
    camera = {
        "focal": replace(CAMERA, fx=CAMERA.fx * (1.0 + by), fy=CAMERA.fy * (1.0 + by)),
        "aspect": replace(CAMERA, fy=CAMERA.fy * (1.0 + by)),
        "cx": replace(CAMERA, cx=CAMERA.cx + by * CAMERA.fx),
        "cy": replace(CAMERA, cy=CAMERA.cy + by * CAMERA.fx),
        "k1": replace(CAMERA, model="radtan", distortion=(by, 0.0, 0.0, 0.0)),
        "p1": replace(CAMERA, model="radtan", distortion=(0.0, 0.0, by, 0.0)),
        "p2": replace(CAMERA, model="radtan", distortion=(0.0, 0.0, 0.0, by)),
    }[own]  # fmt: skip
    return (replace(RIG, depth_camera=camera) if kind == "depth" else replace(RIG, color_camera=camera)), 1.0, 0.0


@pytest.mark.parametrize(
    ("name", "by", "method", "part"),
    sampled([
        ("depth.focal", 0.01, "rs-pg", 0.5), ("depth.focal", 0.01, "rs-g", 0.5), ("depth.aspect", 0.01, "rs-g", 0.5),
        ("depth.cx", 0.01, "rs-g", 0.5), ("depth.cy", 0.01, "rs-g", 0.5), ("depth.k1", 0.05, "rs-g", 0.5),
        ("color.p1", 0.005, "rs-p", 0.6),
        ("depth.scale", 0.01, "rs-g", 0.1), ("depth.scale", 0.01, "rs-pg", 0.1), ("depth.scale", 0.01, "rs-p", 0.1),
        ("color.focal", 0.01, "rs-p", 0.6), ("color.k1", 0.03, "rs-p", 0.6),
    ], 3),
)  # fmt: skip
def test_a_wrong_camera_moves_poses_as_the_model_says(name: str, by: float, method: str, part: float) -> None:
    """To that part: the model is of first order, and made of some hundred points."""
    T, common = told(method)
    rig, scale, late_s = wrong(name, by)
    moved = se3.log(se3.inverse(T) @ tracked(rig, method, scale, late_s).trajectory[1][-6:])
    expected = by * common[:, :, CALIBRATION_NAMES.index(name)]
    weight = np.repeat([1.0, 2.0], 3)  # m, rad: things are some two metres away
    assert np.linalg.norm((moved - expected) * weight) < part * np.linalg.norm(moved * weight)


@pytest.mark.parametrize("stream", ["depth", "color"])
@pytest.mark.parametrize("own", ["focal", "aspect", "cx", "cy", "k1", "p1", "p2"])
def test_a_wrong_lens_moves_the_points_of_pixels_as_the_camera_has_it(stream: str, own: str) -> None:
    """Of planar z, as depth images have it, by a difference quotient."""
    by, uv = 1e-4, np.random.default_rng(3).uniform((5.0, 5.0), (150.0, 110.0), (50, 2))
    rig, _, _ = wrong(f"{stream}.{own}", by)
    z = np.linspace(0.5, 3.0, len(uv))[:, None]
    q = z * CAMERA.unproject(uv)
    moved = z * (getattr(rig, f"{stream}_camera").unproject(uv) - CAMERA.unproject(uv)) / by
    T = np.eye(4) if stream == "depth" else RIG.T_color_depth
    p, lens = se3.transform(se3.inverse(T), q), Lens(CAMERA, SHUTTER)
    by_name = _moves(Rays(lens, lens, RIG.T_color_depth, False), stream == "depth", p, q, np.zeros(6), uv[:, 0], lens)
    found = by_name[CALIBRATION_NAMES.index(f"{stream}.{own}")]
    assert found == pytest.approx(moved @ T[:3, :3], abs=1e-3 * float(np.abs(moved).max()))


def test_colours_that_are_late_are_so_by_how_far_the_camera_moves_meanwhile() -> None:
    """Of one image: a camera that moves as the keyframe's did sees nothing odd, another is off by the difference."""
    tracker = tracked(replace(RIG, sigma=UNIT))
    covariances = tracker.track.covariances
    calibration, common = covariances.calibration, covariances.common
    window, ref = tracker.track.known()
    (color,) = [o for o in window.active if not o.is_depth and o.ref.index == ref.index][-1:]
    _, velocity = window.spline.pose_and_velocity(color.image.exposure.mid_time)
    relative = se3.inverse(window.spline.pose(color.image.exposure.mid_time)) @ ref.T_world_base
    at = common.velocities[ref.index]
    of_keyframe = se3.adjoint(relative) @ at
    moved = calibration.moved(color, window.state, at)[:, CLOCK] / UNITS[CLOCK]
    assert moved == pytest.approx(of_keyframe - velocity, abs=0.15 * np.linalg.norm(velocity))
    lagging = calibration.lagging(color, window.state, at)[:6]
    assert lagging == pytest.approx(-of_keyframe, abs=0.15 * np.linalg.norm(velocity)), "the keyframe alone is late"


def test_an_exact_camera_file_costs_nothing_and_says_nothing() -> None:
    tracker = tracked(RIG)
    assert all(report.common is None for report in tracker.reports)
    assert tracker.track.covariances.considered(0.03) is None


def test_only_what_may_be_wrong_has_a_column() -> None:
    tracker = tracked(replace(RIG, sigma=CalibrationSigma(focal=0.01, offset_s=0.002)))
    common = tracker.reports[-1].common
    assert common is not None and common.shape == (6, 3)  # both cameras' focal lengths, and the clock
    _, unit = told("rs-pg")
    at = [CALIBRATION_NAMES.index(name) for name in ("depth.focal", "color.focal", "color.offset_s")]
    assert common == pytest.approx(unit[-1][:, at] * (0.01, 0.01, 0.002), rel=0.2, abs=2e-4)


def test_registered_depth_has_one_lens_and_no_extrinsics() -> None:
    sigmas = DEFAULT_SIGMA.vector(is_registered=True)
    assert not sigmas[:7].any() and not sigmas[14:20].any() and sigmas[7:14].all()
    assert DEFAULT_SIGMA.vector()[:20].all() and not EXACT_SIGMA.vector().any()


FILE = "color: {width: 640, height: 480, intrinsics: [500.0, 500.0, 319.5, 239.5], readout_s: 0.03%s}\n%s"


def read(tmp_path: Path, lens: str, sigma: str) -> Rig:
    (tmp_path / "camera.yaml").write_text(FILE % (lens, sigma))
    return read_rig(tmp_path / "camera.yaml", (640, 480), (640, 480)).rig


def test_a_camera_file_states_what_it_knows_and_the_rest_is_as_usual(tmp_path: Path) -> None:
    bent = ", model: radtan, distortion: [0.1, 0.0, 0.0, 0.0]"
    assert read(tmp_path, bent, "").sigma == DEFAULT_SIGMA
    assert read(tmp_path, "", "").sigma == replace(DEFAULT_SIGMA, **UNDISTORTED)
    stated = read(tmp_path, bent, "sigma: {focal: 0.002, center_px: 1.5}").sigma
    assert stated == replace(DEFAULT_SIGMA, focal=0.002, center=0.003)


def test_extrinsics_that_are_left_out_may_be_as_far_off_as_housings_are_wide(tmp_path: Path) -> None:
    apart = "depth: {width: 640, height: 480, intrinsics: [585.0, 585.0, 319.5, 239.5], readout_s: 0}\n"
    bent = ", model: radtan, distortion: [0.1, 0.0, 0.0, 0.0]"
    beside = "T_color_depth: [[1, 0, 0, 0.02], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
    assert read(tmp_path, bent, apart).sigma == replace(DEFAULT_SIGMA, **UNSTATED_POSE)
    assert read(tmp_path, bent, apart + beside).sigma == DEFAULT_SIGMA
    stated = read(tmp_path, bent, apart + "sigma: {rotation_deg: 0.1}").sigma
    assert stated.rotation_deg == 0.1 and stated.translation_m == UNSTATED_POSE["translation_m"]


def test_a_run_keeps_the_sigmas_that_it_went_by(tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text(FILE % ("", "sigma: {k1: 0.03, readout_s: 0.001}"))
    file = read_rig(tmp_path / "camera.yaml", (640, 480), (640, 480))
    run = {"dataset": {"camera": camera_content(file)}}
    (tmp_path / "run.json").write_text(json.dumps(run))
    again = read_rig(tmp_path / "run.json", (640, 480), (640, 480)).rig.sigma
    assert asdict(again) == pytest.approx(asdict(file.rig.sigma))


@pytest.mark.parametrize("sigma", ["sigma: {focal: -0.1}", "sigma: {focus: 0.1}", "sigma: {k1: .nan}"])
def test_what_no_sigma_is_ends_in_one_line(tmp_path: Path, sigma: str) -> None:
    with pytest.raises(UserError, match=r"camera\.yaml: sigma"):
        read(tmp_path, "", sigma)


# -- what a track's images tell of the calibration --------------------------------------------------------------------


def test_it_is_the_solution_of_all_frames_at_once() -> None:
    """Of normal equations with the prior, as if the clock had not been put right after every frame."""
    rng = np.random.default_rng(5)
    true, known = rng.normal(size=COUNT), CalibrationErrors()
    A, b = np.eye(COUNT), np.zeros(COUNT)
    for _ in range(40):
        D, root = rng.normal(size=(6, COUNT)), rng.normal(size=(6, 6))
        R = root @ root.T + np.eye(6)
        apart = D @ true + np.linalg.cholesky(R) @ rng.normal(size=6)
        A += D.T @ np.linalg.solve(R, D) / 30.0
        b += D.T @ np.linalg.solve(R, apart) / 30.0
        known = known.with_frame(apart - D[:, CLOCK] * known.clock[0], D, R)
    np.testing.assert_allclose(known.mean, np.linalg.solve(A, b), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(known.covariance, np.linalg.inv(A), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("late_s", sampled([0.006, -0.006], 2))
def test_a_clock_is_found_while_tracking(shaken: Dataset, tmp_path: Path, late_s: float) -> None:
    """As far as σ says, though the first keyframes have the old one; what is done with the run later goes by it."""
    wrong = told_wrongly(shaken, shaken.rig.color_shutter.readout_s, late_s, np.zeros(6))
    unsure = replace(wrong, rig=replace(wrong.rig, sigma=CalibrationSigma(offset_s=0.015)))
    found = track(unsure, OPTIONS, tmp_path, SHORT)
    late = found.estimate.info["color_late"]
    assert late["seconds"] == pytest.approx(-late_s, abs=min(2e-3, 3.0 * late["sigma_s"])) and late["sigma_s"] < 4e-3
    assert f"{1e3 * late['seconds']:+.1f} ±" in found.text()
    again = wrong.as_seen_by(found.estimate.info)
    np.testing.assert_allclose(again.color_stamps, wrong.color_stamps + late["seconds"], atol=1e-9)


def test_a_clock_that_is_exact_stays(shaken: Dataset, tmp_path: Path) -> None:
    found = track(shaken, OPTIONS, tmp_path, slice(0, 4))
    assert "color_late" not in found.estimate.info and "while tracking" not in found.text()
