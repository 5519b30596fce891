"""The spline fit against exact splines, SciPy's least squares and ICL-NUIM's trajectories; statistics; report."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import make_lsq_spline
from scipy.spatial.transform import Rotation

from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.motion.fit import FitResult, fit_spline
from rsgen.motion.statistics import motion_statistics, plot_fit, summarise_fit
from rsgen.sequence.trajectory import Trajectory, read_trajectory

ICL = Path(__file__).resolve().parents[4] / "shared" / "data" / "icl_nuim_livingroom"
needs_icl = pytest.mark.skipif(not ICL.is_dir(), reason="ICL-NUIM data (../shared/data/icl_nuim_livingroom) not here")


def wandering_spline(count: int = 40, t0: float = 0.2, dt: float = 0.05, seed: int = 5) -> Spline:
    """A smooth random motion of about 0.5 m/s and 60 degrees/s that turns all round."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(scale=np.repeat([0.01, 0.02], 3), size=(count, 6))
    steps += [0.02, 0.0, 0.01, 0.0, 0.04, 0.01]
    points = [se3.exp(np.array([1.0, 2.0, 3.0, 0.5, 1.0, 2.0]))]
    for step in steps[1:]:
        points.append(se3.orthonormalise(points[-1] @ se3.exp(step)))
    return Spline(np.array(points), t0, dt)


def sampled(spline: Spline, count: int = 400) -> Trajectory:
    stamps = np.linspace(spline.t_begin, spline.t_end, count)
    return Trajectory(stamps, spline.pose(stamps))


def translations(stamps: np.ndarray, positions: np.ndarray) -> Trajectory:
    poses = np.tile(np.eye(4), (len(stamps), 1, 1))
    poses[:, :3, 3] = positions
    return Trajectory(stamps, poses)


def noisy(trajectory: Trajectory, sigma: float, seed: int = 6) -> Trajectory:
    rng = np.random.default_rng(seed)
    return Trajectory(
        trajectory.stamps, trajectory.T_world_cam @ se3.exp(rng.normal(scale=sigma, size=(len(trajectory), 6)))
    )


def peak_accelerations(fit: FitResult, edge_knots: int = 2) -> tuple[float, float]:
    """(largest in the first and last knots, largest inside), m/s²."""
    spline = fit.spline
    times = np.linspace(spline.t_begin, spline.t_end, 2001)
    size = np.linalg.norm(spline.world_acceleration(times), axis=1)
    edge = np.minimum(times - spline.t_begin, spline.t_end - times) < edge_knots * spline.dt
    return float(size[edge].max()), float(size[~edge].max())


# --- exact cases -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("robust", ["huber", "none"])
def test_recovers_the_spline_that_made_the_poses(robust: str) -> None:
    truth = wandering_spline()
    fit = fit_spline(sampled(truth), dt=truth.dt, robust=robust)  # type: ignore[arg-type]
    assert fit.spline.t0 == pytest.approx(truth.t0, abs=1e-12)
    assert len(fit.spline.control_points) == len(truth.control_points)
    np.testing.assert_allclose(fit.spline.control_points, truth.control_points, atol=1e-7)
    times = np.linspace(truth.t_begin, truth.t_end, 1001)
    np.testing.assert_allclose(fit.spline.pose(times), truth.pose(times), atol=1e-8)
    assert fit.residual_trans_m.max() < 1e-8
    assert fit.residual_rot_rad.max() < 1e-8


def test_translations_equal_scipys_least_squares() -> None:
    """Without rotation the cumulative spline is an ordinary B-spline.

    Rotation must be made dear: on SE(3) a turn bends the path, and half a milliradian of it would follow some noise.
    """
    rng = np.random.default_rng(7)
    stamps = np.sort(rng.uniform(1.0, 8.0, 900))
    stamps[[0, -1]] = 1.0, 8.0
    positions = np.stack([np.sin(3 * stamps), stamps**2 / 10, np.cos(5 * stamps)], axis=1)
    positions += rng.normal(scale=2e-3, size=positions.shape)
    fit = fit_spline(translations(stamps, positions), dt=0.1, robust="none", metres_per_radian=1e5)
    oracle = make_lsq_spline(stamps, positions, 0.1 * np.arange(10 - 3, 80 + 4), k=3)
    ours = fit.spline.control_points[:, :3, 3]
    # Least-squares splines forget by a factor of 0.54 a knot: 25 knots inside nothing is left of what holds the ends.
    np.testing.assert_allclose(ours[25:-25], oracle.c[25:-25], atol=2e-8)
    np.testing.assert_allclose(ours[4:-4], oracle.c[4:-4], atol=5e-3)
    np.testing.assert_allclose(fit.spline.control_points[:, :3, :3], np.tile(np.eye(3), (73, 1, 1)), atol=1e-8)


def test_steady_screw_motion_is_exact_with_padding() -> None:
    """Equally spaced control points reproduce a constant twist exactly, and it goes on into the padding."""
    twist = np.array([0.3, -0.2, 0.5, 0.4, -0.7, 0.2])
    stamps = np.arange(61) / 30.0
    fit = fit_spline(Trajectory(stamps, se3.exp(stamps[:, None] * twist)), pad_begin_s=0.3, pad_end_s=0.3)
    times = np.linspace(-0.3, 2.3, 301)
    np.testing.assert_allclose(fit.spline.pose(times), se3.exp(times[:, None] * twist), atol=1e-6)
    np.testing.assert_allclose(fit.spline.velocity(times), np.tile(twist, (301, 1)), atol=1e-5)


def test_camera_at_rest() -> None:
    pose = se3.exp(np.array([1.0, 2.0, 3.0, 0.1, 0.2, 3.0]))
    fit = fit_spline(Trajectory(np.arange(31) / 30.0, np.tile(pose, (31, 1, 1))))
    np.testing.assert_allclose(fit.spline.control_points - pose, 0.0, atol=1e-9)
    assert motion_statistics(fit.spline).length_m < 1e-8


def test_moving_the_world_moves_the_fit() -> None:
    trajectory = noisy(sampled(wandering_spline(), 60), 1e-3)
    T = se3.exp(np.array([100.0, -50.0, 20.0, 1.0, -2.0, 0.5]))
    here, there = fit_spline(trajectory), fit_spline(trajectory.moved(T_scene_world=T))
    np.testing.assert_allclose(there.spline.control_points, T @ here.spline.control_points, atol=1e-6)


def test_smoothing_damps_as_documented() -> None:
    """A sine of angular frequency ω keeps 1 / (1 + w ω⁴) of its amplitude, whatever the rate of the poses."""
    omega, weight = 2 * np.pi * 1.5, 1e-4
    for rate in (30.0, 100.0):
        stamps = np.arange(0.0, 8.0, 1.0 / rate)
        sine = np.sin(omega * stamps)
        fit = fit_spline(translations(stamps, 0.1 * sine[:, None] * [1.0, 0.0, 0.0]), smoothing=weight, robust="none")
        inside = np.linspace(2.0, 6.0, 500)
        reference = np.sin(omega * inside)
        kept = fit.spline.pose(inside)[:, 0, 3] @ reference / (0.1 * reference @ reference)
        assert kept == pytest.approx(1.0 / (1.0 + weight * omega**4), rel=0.02)


# --- knots, ends, gaps, jumps ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("begin", "dt"), [(0.35, 0.05), (0.0, 0.05), (1.23456, 0.05), (1305031449.7996, 0.05), (0.3, 0.1)]
)
def test_knots_are_multiples_of_dt_and_cover_the_stamps(begin: float, dt: float) -> None:
    stamps = begin + np.arange(40) / 30.0
    trajectory = translations(stamps, np.arange(40)[:, None] * [0.01, 0.0, 0.0])
    spline = fit_spline(trajectory, dt=dt, pad_begin_s=0.02, pad_end_s=0.03).spline
    assert spline.t0 / dt == pytest.approx(round(spline.t0 / dt), abs=1e-6)
    spline.pose(np.array([stamps[0] - 0.02, stamps[-1] + 0.03]))  # raises outside
    assert spline.t_begin > stamps[0] - 0.02 - dt - 1e-6
    assert spline.t_end < stamps[-1] + 0.03 + dt + 1e-6


def test_no_knot_too_many_when_stamps_lie_on_knots() -> None:
    stamps = 0.35 + 0.05 * np.arange(21)  # 0.35 / 0.05 is 6.999999999999999
    spline = fit_spline(translations(stamps, stamps[:, None] * [1.0, 0.0, 0.0])).spline
    assert len(spline.control_points) == 20 + 3
    assert spline.t0 == pytest.approx(0.35, abs=1e-12)


@pytest.mark.parametrize("last", [0.334, 0.3667, 0.4])
def test_free_ends_are_held(last: float) -> None:
    """However few poses the last knot holds, noise must not swing the ends (kt2's free fit ends at 180 m/s²)."""
    truth = wandering_spline(count=60)
    stamps = np.append(np.arange(truth.t0, 2.3, 1 / 30), 2.0 + last)
    fit = fit_spline(noisy(Trajectory(stamps, truth.pose(stamps)), 1e-3), robust="none")
    ends, inside = peak_accelerations(fit)
    assert ends <= inside


def test_holding_the_ends_leaves_the_inside_alone() -> None:
    """Adding poses before and after replaces the hold by data; one second inside, that makes no difference."""
    trajectory = noisy(sampled(wandering_spline(count=160), 240), 1e-3)
    middle = slice(60, 180)
    part = Trajectory(trajectory.stamps[middle], trajectory.T_world_cam[middle])
    whole_fit, part_fit = fit_spline(trajectory, robust="none"), fit_spline(part, robust="none")
    times = np.linspace(part.stamps[0] + 1.0, part.stamps[-1] - 1.0, 300)
    np.testing.assert_allclose(part_fit.spline.pose(times), whole_fit.spline.pose(times), atol=1e-6)
    assert part_fit.rms_trans_m == pytest.approx(1e-3, rel=0.5)


def test_long_padding_goes_on_steadily() -> None:
    fit = fit_spline(noisy(sampled(wandering_spline(), 60), 1e-3), pad_begin_s=1.0, pad_end_s=1.0)
    ends, inside = peak_accelerations(fit, edge_knots=22)
    assert ends <= inside
    speed = np.linalg.norm(fit.spline.velocity(np.linspace(fit.spline.t_begin, fit.spline.t_end, 500)), axis=1)
    assert speed.max() < 3.0


def test_gap_of_many_knots_is_bridged_smoothly() -> None:
    truth = wandering_spline(count=80)
    whole = noisy(sampled(truth, 150), 1e-3)
    kept = (whole.stamps < 1.8) | (whole.stamps > 2.2)
    fit = fit_spline(Trajectory(whole.stamps[kept], whole.T_world_cam[kept]))
    gap = np.linspace(1.8, 2.2, 100)
    assert np.linalg.norm(fit.spline.pose(gap)[:, :3, 3] - truth.pose(gap)[:, :3, 3], axis=1).max() < 0.05
    outside = np.linspace(0.5, 1.5, 100)
    bend = np.linalg.norm(fit.spline.world_acceleration(gap), axis=1).max()
    assert bend <= np.linalg.norm(fit.spline.world_acceleration(outside), axis=1).max()


@pytest.mark.parametrize("dt", [0.03, 0.02, 0.005])
def test_knots_finer_than_the_poses_interpolate_them(dt: float) -> None:
    trajectory = sampled(wandering_spline(count=40), 56)  # 30 a second
    fit = fit_spline(trajectory, dt=dt)
    assert fit.residual_trans_m.max() < 1e-5
    assert fit.residual_rot_rad.max() < 1e-5
    between = np.linspace(trajectory.stamps[0], trajectory.stamps[-1], 700)
    truth = wandering_spline(count=40).pose(between)
    assert np.linalg.norm(fit.spline.pose(between)[:, :3, 3] - truth[:, :3, 3], axis=1).max() < 5e-3


@pytest.mark.parametrize("seed", range(4))
def test_irregular_poses_hardly_denser_than_knots_are_well_posed(seed: int) -> None:
    """Where two poses nearly coincide and their neighbours are far, counting poses would not find the loose knots."""
    truth = wandering_spline(count=40, dt=0.1)
    stamps = np.sort(np.random.default_rng(seed).uniform(truth.t_begin, truth.t_end, 45))
    fit = fit_spline(noisy(Trajectory(stamps, truth.pose(stamps)), 1e-3, seed), dt=0.1)
    times = np.linspace(truth.t_begin + 0.3, truth.t_end - 0.3, 500)
    off = np.linalg.norm(fit.spline.pose(times)[:, :3, 3] - truth.pose(times)[:, :3, 3], axis=1)
    assert off.max() < 0.03


def test_jump_stays_local_with_huber() -> None:
    """kt0's steps: least squares rings at the frames next to the two that straddle a jump, Huber does not."""
    stamps = np.arange(90) / 30.0
    positions = np.stack([0.2 * stamps, np.zeros(90), np.where(stamps > 1.51, 0.05, 0.0)], axis=1)
    positions += np.random.default_rng(8).normal(scale=2e-4, size=positions.shape)
    step = translations(stamps, positions)
    near = np.r_[40:45, 47:52]  # five frames on either side of the two that straddle the step
    robust, plain = fit_spline(step), fit_spline(step, robust="none")
    assert robust.residual_trans_m[near].max() < 0.5 * plain.residual_trans_m[near].max()
    assert (robust.weights[[45, 46]] < 1.0).any()
    assert (robust.weights < 1.0).sum() <= 6
    assert (plain.weights == 1.0).all()


def test_one_false_pose_hardly_pulls() -> None:
    trajectory = noisy(sampled(wandering_spline(), 120), 3e-4)
    poses = trajectory.T_world_cam.copy()
    poses[60, :3, 3] += [0.3, 0.0, 0.0]
    false = Trajectory(trajectory.stamps, poses)
    clean = fit_spline(trajectory).spline.pose(trajectory.stamps)
    robust, plain = fit_spline(false), fit_spline(false, robust="none")
    moved = [np.linalg.norm(fit.spline.pose(false.stamps)[60, :3, 3] - clean[60, :3, 3]) for fit in (robust, plain)]
    assert moved[0] < 3e-3 < 0.03 < moved[1]


def test_bad_parameters() -> None:
    trajectory = sampled(wandering_spline(), 60)
    for arguments, complaint in (
        ({"dt": 0.0}, "knot spacing"),
        ({"dt": float("nan")}, "knot spacing"),
        ({"dt": 1e-9}, "too long"),
        ({"smoothing": -1.0}, "smoothing"),
        ({"pad_begin_s": -0.1}, "pad_begin_s"),
        ({"pad_end_s": float("inf")}, "pad_end_s"),
        ({"robust": "tukey"}, "robust kernel"),
        ({"metres_per_radian": 0.0}, "metres_per_radian"),
    ):
        with pytest.raises(UserError, match=complaint):
            fit_spline(trajectory, **arguments)
    with pytest.raises(UserError, match="at least 4"):
        fit_spline(Trajectory(trajectory.stamps[:3], trajectory.T_world_cam[:3]))
    with pytest.raises(UserError, match="increase strictly"):
        fit_spline(Trajectory(trajectory.stamps[::-1], trajectory.T_world_cam))


# --- motion statistics -----------------------------------------------------------------------------------------------


def circle(count: int, radius: float = 0.5, turns_per_s: float = 0.25, duration: float = 4.0) -> Trajectory:
    """A camera that looks along its circle (about y): the speed, rotation and acceleration are constant and known."""
    stamps = np.linspace(0.0, duration, count)
    angle = 2 * np.pi * turns_per_s * stamps
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("y", angle[:, None]).as_matrix()
    poses[:, :3, 3] = radius * np.stack([-np.cos(angle), np.zeros(count), np.sin(angle)], axis=1)
    return Trajectory(stamps, poses)


@pytest.mark.parametrize("from_spline", [True, False])
def test_motion_on_a_circle(from_spline: bool) -> None:
    trajectory = circle(401)
    motion = motion_statistics(fit_spline(trajectory).spline if from_spline else trajectory)
    speed = 0.5 * 2 * np.pi * 0.25
    assert motion.duration_s == pytest.approx(4.0)
    assert motion.length_m == pytest.approx(np.pi, rel=1e-4)
    assert motion.mean_speed_m_s == pytest.approx(speed, rel=1e-4)
    assert motion.max_speed_m_s == pytest.approx(speed, rel=1e-4)
    assert motion.mean_rotation_deg_s == pytest.approx(90.0, rel=1e-4)
    assert motion.max_rotation_deg_s == pytest.approx(90.0, rel=1e-4)
    assert motion.mean_acceleration_m_s2 == pytest.approx(speed**2 / 0.5, rel=1e-3)
    assert motion.max_acceleration_m_s2 == pytest.approx(speed**2 / 0.5, rel=1e-3)


def test_motion_of_a_part_and_of_nothing() -> None:
    trajectory = circle(401)
    spline = fit_spline(trajectory).spline
    assert motion_statistics(spline, 1.0, 3.0).length_m == pytest.approx(np.pi / 2, rel=1e-4)
    assert motion_statistics(trajectory, 1.0, 3.0).length_m == pytest.approx(np.pi / 2, rel=1e-4)
    with pytest.raises(UserError, match="no motion"):
        motion_statistics(spline, 2.0, 2.0)
    with pytest.raises(UserError, match="fewer than three"):
        motion_statistics(trajectory, 2.0, 2.0)


# --- ICL-NUIM's trajectories -----------------------------------------------------------------------------------------


@needs_icl
@pytest.mark.parametrize(("k", "bound_mm"), [(0, 0.8), (1, 0.3), (2, 1.3), (3, 1.0)])
def test_residuals_of_the_living_room_trajectories(k: int, bound_mm: float) -> None:
    fit = fit_spline(read_trajectory(ICL / f"livingRoom{k}.rh_tum.txt"), dt=0.05)
    assert fit.rms_trans_m * 1e3 <= bound_mm
    assert np.degrees(fit.rms_rot_rad) <= 0.04
    assert fit.iterations <= 40  # hundreds without the true Hessian of Huber's kernel
    ends, inside = peak_accelerations(fit)
    assert ends <= inside


# --- report ----------------------------------------------------------------------------------------------------------


def tum_file(tmp_path: Path) -> Path:
    trajectory = noisy(circle(121), 5e-4)
    path = tmp_path / "circle.txt"
    q = Rotation.from_matrix(trajectory.T_world_cam[:, :3, :3]).as_quat()
    np.savetxt(path, np.column_stack([trajectory.stamps, trajectory.positions, q]), fmt="%.9f")
    return path


def test_report_says_what_the_fit_says(tmp_path: Path) -> None:
    path = tum_file(tmp_path)
    plot = tmp_path / "figures" / "fit.png"
    report = summarise_fit(path)
    plot_fit(report, plot)
    text = report.text()
    data = json.loads(json.dumps(report.as_dict()))
    assert data["poses"] == 121
    assert data["residual"]["rms_mm"] == pytest.approx(report.fit.rms_trans_m * 1e3)
    assert data["residual"]["max_mm"] == pytest.approx(
        report.fit.residual_trans_m[data["residual"]["max_mm_pose"]] * 1e3
    )
    assert data["motion"]["mean_rotation_deg_s"] == pytest.approx(90.0, rel=0.01)
    for value in (f"{data['residual']['rms_mm']:.3f}", f"{data['residual']['max_deg']:.4f}", "m/s²", "circle.txt"):
        assert value in text
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert "\x1b" not in text


def test_report_complains_about_the_plots_name(tmp_path: Path) -> None:
    report = summarise_fit(tum_file(tmp_path))
    with pytest.raises(UserError, match=r"\.png"):
        plot_fit(report, tmp_path / "fit.xyz")
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UserError, match="cannot be written"):
        plot_fit(report, tmp_path / "file" / "fit.png")
