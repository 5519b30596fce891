"""Parametric motions: targets met, rest at the ends, the shake's spectrum, directions, clearance, one-line errors."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import trimesh
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from rsgen.config.motion import MotionConfig, Waypoint
from rsgen.errors import UserError
from rsgen.geometry.spline import Spline
from rsgen.motion.fit import fit_spline
from rsgen.motion.free_space import check_clearance, clearance, nearest_surface, plan_tour
from rsgen.motion.make import TourCurve, band_noise, look_at, make_motion, make_path, travel, window
from rsgen.motion.statistics import TABLE_1, motion_statistics, stats_table
from rsgen.sequence.trajectory import Trajectory

STILL: dict[str, Any] = {"shake_position_m": 0.0, "shake_rotation_deg": 0.0}
SHAKEN: dict[str, Any] = {"shake_position_m": 0.003, "shake_rotation_deg": 0.5}
FACING: dict[str, Any] = {"position": (0.2, 1.1, 0.3), "target": (1.2, 0.9, 2.3)}
LINE: dict[str, Any] = {"kind": "line", "length_m": 4, "mean_speed_m_s": 0.4, "mean_rotation_deg_s": 16, **FACING}
ROLL: dict[str, Any] = {"kind": "roll", "length_m": 2, "mean_speed_m_s": 0.2, "mean_rotation_deg_s": 60, **FACING}
RING = [
    {"position": (r * math.cos(a), 1.0 + 0.1 * math.sin(3 * a), r * math.sin(a)), "target": (0.1, 0.3, 0.0)}
    for r, a in zip((1.0, 1.3) * 4, np.arange(8) * math.tau / 8, strict=True)
]
TOUR: dict[str, Any] = {"kind": "tour", "mean_speed_m_s": 0.4, "mean_rotation_deg_s": 30, "waypoints": RING}
CLOSED, OPEN = {**TOUR, "length_m": 10.0}, {**TOUR, "length_m": 5.0, "closed": False}
ALL = {"line": {**LINE, "strokes": 5}, "roll": {**ROLL, "strokes": 5}, "closed": CLOSED, "open": OPEN}


def made(settings: dict[str, Any], more: dict[str, Any] = STILL, seed: int = 1) -> Trajectory:
    return make_motion(MotionConfig.model_validate({**settings, **more}), seed)


def spline_of(settings: dict[str, Any], more: dict[str, Any]) -> Spline:
    return fit_spline(made(settings, more)).spline


# --- targets ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shake", [STILL, SHAKEN], ids=["still", "shaken"])
@pytest.mark.parametrize("kind", ALL)
def test_the_fitted_spline_meets_the_targets(kind: str, shake: dict[str, float]) -> None:
    settings = ALL[kind]
    trajectory = made(settings, shake)
    fit = fit_spline(trajectory)
    stats = motion_statistics(fit.spline, 0.0, trajectory.stamps[-1])
    assert stats.length_m == pytest.approx(settings["length_m"], rel=0.005)
    assert stats.mean_speed_m_s == pytest.approx(settings["mean_speed_m_s"], rel=0.005)
    assert stats.mean_rotation_deg_s == pytest.approx(settings["mean_rotation_deg_s"], rel=0.005)
    assert fit.residual_trans_m.max() < 5e-5


def test_the_targets_by_scipy_and_plain_sums() -> None:
    trajectory = made(CLOSED, SHAKEN)
    R = Rotation.from_matrix(trajectory.T_world_cam[:, :3, :3])
    duration = trajectory.stamps[-1] - trajectory.stamps[0]
    assert duration == pytest.approx(10.0 / 0.4)
    assert np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1).sum() == pytest.approx(10.0, rel=1e-3)
    assert np.degrees((R[:-1].inv() * R[1:]).magnitude().sum()) / duration == pytest.approx(30.0, rel=1e-3)


@pytest.mark.parametrize("kind", ALL)
def test_motions_begin_and_end_at_rest(kind: str) -> None:
    spline = spline_of(ALL[kind], SHAKEN)
    ends = spline.velocity(np.array([0.0, spline.t_end]))
    assert np.abs(ends[:, :3]).max() < 0.005 and np.abs(ends[:, 3:]).max() < math.radians(0.5)
    fastest = np.linalg.norm(spline.velocity(np.linspace(1, 4, 300))[:, :3], axis=1).max()
    assert fastest > 0.2  # else rest would prove nothing


@pytest.mark.parametrize("kind", ALL)
def test_a_motion_is_decided_by_its_seed(kind: str) -> None:
    first = made(ALL[kind], SHAKEN, seed=3).T_world_cam
    assert np.array_equal(first, made(ALL[kind], SHAKEN, seed=3).T_world_cam)
    assert np.abs(first - made(ALL[kind], SHAKEN, seed=4).T_world_cam).max() > 1e-3


def test_the_motions_own_seed_goes_before_the_sequences() -> None:
    own = MotionConfig.model_validate({**LINE, **SHAKEN, "seed": 3})
    assert np.array_equal(make_motion(own, 8).T_world_cam, made(LINE, SHAKEN, seed=3).T_world_cam)


# --- ramps -----------------------------------------------------------------------------------------------------------


def test_travel_is_smooth_and_constant_between_its_ramps() -> None:
    t = np.linspace(0.0, 7.0, 70001)
    way = travel(t, 7.0, 1.5)
    speed, acceleration = np.gradient(way, t), np.gradient(np.gradient(way, t), t)
    assert way[0] == 0.0 and way[-1] == pytest.approx(1.0, abs=1e-12)
    assert np.allclose(speed[(t > 1.51) & (t < 5.49)], 1.0 / (7.0 - 1.5), rtol=1e-6)
    assert abs(speed[0]) < 1e-6 and abs(speed[-1]) < 1e-6 and (np.diff(way) >= -1e-15).all()
    assert np.abs(np.diff(acceleration)).max() < 1e-3  # no jump
    share = speed * (7.0 - 1.5)
    assert np.allclose(share[1:-1], window(t, 7.0, 1.5)[1:-1], atol=1e-5)


# --- hand-shake ------------------------------------------------------------------------------------------------------


def test_the_shakes_spectrum_lies_in_its_band_and_falls_as_asked() -> None:
    rate, count, p = 200.0, 4000, 2.5
    power = np.zeros(count // 2 + 1)
    for seed in range(60):
        signal = band_noise(np.random.default_rng(seed), count, rate, (0.5, 6.0), p)
        assert np.allclose(np.sqrt(np.mean(signal**2, axis=0)), 1.0, atol=1e-12)
        assert np.abs(signal.mean(axis=0)).max() < 1e-12
        power += (np.abs(np.fft.rfft(signal, axis=0)) ** 2).sum(axis=1)
    f = np.fft.rfftfreq(count, 1 / rate)
    inside = (f >= 0.5) & (f <= 6.0)
    assert power[~inside].sum() < 1e-20 * power.sum()
    # 60 x 6 periodograms: each bin's log power has a sigma of 1/sqrt(360); the slope's follows from least squares.
    x, y = np.log(f[inside]), np.log(power[inside])
    slope, sigma = np.polyfit(x, y, 1)[0], 360**-0.5 / (np.std(x) * math.sqrt(len(x)))
    assert abs(slope + p) < 5.0 * sigma < 0.1
    assert np.abs(y - np.polyval(np.polyfit(x, y, 1), x)).max() < 6.0 * 360**-0.5


def test_the_shakes_axes_are_independent() -> None:
    draws = [band_noise(np.random.default_rng(k), 3000, 200.0, (0.5, 6.0), 1.0) for k in range(40)]
    correlation = np.mean([np.corrcoef(d.T) for d in draws], axis=0) - np.eye(6)
    assert np.abs(correlation).max() < 0.12


def test_a_made_motion_shakes_in_its_band_with_its_size() -> None:
    trajectory = made(LINE, {"shake_position_m": 0.004, "mean_rotation_deg_s": 2, "ramp_s": 0.5})
    level = np.array([0.0, 1.0, 0.0])  # nothing but the shake moves the camera up
    height = trajectory.positions @ level
    height = (height - height.mean())[:-1]
    assert np.sqrt(np.mean(height**2)) == pytest.approx(0.004, rel=0.15)
    power = np.abs(np.fft.rfft(height)) ** 2
    f = np.fft.rfftfreq(len(height), trajectory.stamps[1])
    assert power[(f >= 0.2) & (f <= 6.5)].sum() > 0.99 * power.sum()
    assert power[f > 10.0].sum() < 1e-6 * power.sum()


# --- directions ------------------------------------------------------------------------------------------------------


def test_look_at_is_level_and_aims_at_the_target() -> None:
    rng = np.random.default_rng(0)
    position, target = rng.normal(size=(2, 50, 3))
    R = look_at(position, target)
    assert np.allclose(np.swapaxes(R, 1, 2) @ R, np.eye(3), atol=1e-12) and np.allclose(np.linalg.det(R), 1.0)
    in_cam = (np.swapaxes(R, 1, 2) @ (target - position)[..., None])[..., 0]
    assert np.allclose(in_cam[:, :2], 0.0, atol=1e-12) and (in_cam[:, 2] > 0).all()
    assert np.allclose(R[:, 1, 0], 0.0, atol=1e-12) and (R[:, 1, 1] < 0).all()  # x level, y down
    assert np.allclose(look_at((0, 0, 0), (0, 0, -1)), np.diag([1.0, -1.0, -1.0]), atol=1e-12)


def test_a_line_moves_along_the_cameras_x_axis() -> None:
    x_axis = look_at(LINE["position"], LINE["target"])[:, 0]
    for shake, away in ((STILL, 1e-9), (SHAKEN, 0.02)):
        offset = made(LINE, shake).positions - LINE["position"]
        along = offset @ x_axis
        assert np.linalg.norm(offset - along[:, None] * x_axis, axis=1).max() < away
        assert 0.4 < np.ptp(along) < 0.6  # 8 strokes, 4 m
    velocity = spline_of({**LINE, "mean_rotation_deg_s": 6}, STILL).velocity(np.linspace(1.0, 9.0, 500))
    velocity = velocity[np.linalg.norm(velocity[:, :3], axis=1) > 0.1]
    assert (np.abs(velocity[:, 0]) / np.linalg.norm(velocity[:, :3], axis=1)).min() > math.cos(math.radians(6))
    turning = np.sqrt(np.mean(velocity[:, 3:] ** 2, axis=0))
    assert turning[1] > turning[0] and turning[1] > turning[2]


@pytest.mark.parametrize(("shake", "share"), [(STILL, 0.999), (SHAKEN, 0.95)], ids=["still", "shaken"])
def test_a_roll_turns_about_the_cameras_z_axis(shake: dict[str, float], share: float) -> None:
    velocity = spline_of(ROLL, shake).velocity(np.linspace(1.0, 9.0, 500))
    assert np.abs(velocity[:, 5]).sum() > share * np.linalg.norm(velocity[:, 3:], axis=1).sum()
    if shake is STILL:  # the axis is a lever's length below the camera: v = ω × (0, −lever, 0)
        lever = velocity[:, 0] / velocity[:, 5]
        assert np.ptp(lever[np.abs(velocity[:, 5]) > 0.3]) < 1e-3 * lever.mean()
        assert lever.mean() == pytest.approx(2.0 / (math.radians(60) * 10.0), rel=0.005)
        assert np.abs(velocity[:, 1:3]).max() < 1e-4


def test_a_tour_passes_its_waypoints_and_looks_at_their_targets() -> None:
    config = MotionConfig.model_validate({**CLOSED, **STILL})
    position, R = make_path(config, np.linspace(0.0, config.duration_s, 20001)).poses(10.0, 0.0)
    for waypoint in config.waypoints:
        k = int(np.argmin(np.linalg.norm(position - waypoint.position, axis=1)))
        assert np.linalg.norm(position[k] - waypoint.position) < 1e-3
        aim = np.subtract(waypoint.target, position[k])
        assert R[k, :, 2] @ aim / np.linalg.norm(aim) > math.cos(1e-3)
    # With its sway and shake the target stays in view.
    T = made(CLOSED, SHAKEN).T_world_cam
    aim = np.asarray(RING[0]["target"]) - T[:, :3, 3]
    angle = np.degrees(
        np.arctan2(np.linalg.norm(np.cross(T[:, :3, 2], aim), axis=1), np.einsum("ni,ni->n", T[:, :3, 2], aim))
    )
    assert np.sqrt(np.mean(angle**2)) < 15.0 and angle.max() < 30.0


def test_a_tours_speed_is_constant_between_its_ramps() -> None:
    speed = np.linalg.norm(spline_of(CLOSED, STILL).velocity(np.linspace(1.2, 23.8, 900))[:, :3], axis=1)
    assert np.ptp(speed) < 0.002 * speed.mean()


def test_an_open_tour_keeps_its_shape_and_a_closed_one_its_place() -> None:
    waypoints = tuple(Waypoint.model_validate(w) for w in RING)
    curve = TourCurve.through(waypoints, closed=False)
    ends = made(OPEN, STILL).positions[[0, -1]]
    first, last = np.asarray(RING[0]["position"]), np.asarray(RING[-1]["position"])
    scale = np.linalg.norm(ends[1] - ends[0]) / np.linalg.norm(last - first)
    assert scale == pytest.approx(5.0 / curve.length, rel=1e-3)
    dense = TourCurve.through(waypoints, closed=True)
    points, _ = dense.at(np.linspace(0.0, dense.length, 4000))
    moved = made(CLOSED, STILL).positions
    assert max(np.linalg.norm(points - p, axis=1).min() for p in moved[::97]) < 2e-3


# --- clearance -------------------------------------------------------------------------------------------------------


def test_nearest_surface_against_brute_force() -> None:
    rng = np.random.default_rng(5)
    sizes = 10.0 ** rng.uniform(-3, 0.5, (300, 1, 1))  # as in a room: walls and leaves
    triangles = rng.uniform(-2, 2, (300, 1, 3)) + sizes * rng.normal(size=(300, 3, 3))
    points = rng.uniform(-3, 3, (200, 3))
    mesh = trimesh.Trimesh(triangles.reshape(-1, 3), np.arange(900).reshape(-1, 3), process=False)
    expected_point, expected, _ = trimesh.proximity.closest_point_naive(mesh, points)
    distance, nearest = nearest_surface(points, triangles, 10.0)
    assert np.allclose(distance, expected, atol=1e-9) and np.allclose(nearest, expected_point, atol=1e-7)
    reach = float(np.median(expected))
    distance, nearest = nearest_surface(points, triangles, reach)
    assert np.array_equal(np.isfinite(distance), expected <= reach)
    assert np.allclose(distance[expected <= reach], expected[expected <= reach], atol=1e-9)
    assert np.isnan(nearest[expected > reach]).all()


def test_clearance_of_a_line_before_a_wall() -> None:
    settings = {**LINE, "position": (0.0, 1.0, 0.0), "target": (0.0, 1.0, -1.0)}
    wall = np.array([[[-5, -5, -0.4], [5, -5, -0.4], [0, 9, -0.4]]], float)
    spline = fit_spline(made(settings, STILL)).spline
    assert clearance(spline, wall) == pytest.approx(0.4, abs=1e-6)
    assert clearance(spline, wall, reach_m=0.3) == math.inf
    check_clearance(spline, wall, 0.39)
    with pytest.raises(UserError, match=r"comes within 0\.400 m of a surface at .* s, at \[.*\]; clearance_m is 0\.41"):
        check_clearance(spline, wall, 0.41)


def distance_to(mesh: trimesh.Trimesh, tour: tuple[Waypoint, ...], closed: bool = True) -> float:
    curve = TourCurve.through(tour, closed)
    points, _ = curve.at(np.linspace(0.0, curve.length, 500))
    return float(trimesh.proximity.closest_point_naive(mesh, points)[1].min())


def test_a_planned_tour_goes_round_an_obstacle() -> None:
    waypoints = tuple(Waypoint.model_validate(w) for w in RING)
    pole = trimesh.creation.cylinder(radius=0.12, height=3.0, sections=24)
    pole.apply_transform(trimesh.transformations.rotation_matrix(math.pi / 2, (1, 0, 0)))
    pole.apply_translation((0.85, 1.0, 0.55))
    before = distance_to(pole, waypoints)
    assert before < 0.2  # else there is nothing to avoid
    tour = plan_tour(pole.triangles, waypoints, 0.3)
    assert distance_to(pole, tour) > 0.295 and 8 <= len(tour) <= 14
    assert [w for w in tour if w in waypoints]  # what is far from the pole stays
    assert plan_tour(pole.triangles, tour, 0.3) == tour
    assert distance_to(pole, plan_tour(pole.triangles, waypoints, 0.3, closed=False), closed=False) > 0.295


def test_a_tour_through_a_wall_cannot_be_planned() -> None:
    waypoints = tuple(Waypoint.model_validate(w) for w in RING)
    wall = np.array([[[0.0, -9, -9], [0.0, 9, -9], [0.0, 0, 30]]])
    with pytest.raises(UserError, match="waypoint") as error:
        plan_tour(wall, waypoints, 0.2)
    assert "\n" not in str(error.value)


# --- table -----------------------------------------------------------------------------------------------------------


def test_the_table_shows_the_papers_figures_beside_ours() -> None:
    stats = motion_statistics(made(ROLL, STILL))
    text = stats_table([("robot_r1", stats), ("mine", stats)]).splitlines()
    assert len(text) == 3 and "Table 1" in text[0]
    assert "2.000" in text[1] and "2.592 (-22.84 %)" in text[1] and "0.123 (+62.60 %)" in text[1]
    assert "%" not in text[2] and text[2].split()[:3] == ["mine", "10.00", "2.000"]
    assert "Table 1" not in stats_table([("mine", stats)])
    assert len(TABLE_1) == 6


# --- errors ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({**LINE, "position": None}, "needs position"),
        ({**LINE, "waypoints": RING}, "waypoints: not for kind line"),
        ({**ROLL, "sway_hz": 0.4}, "sway_hz: not for kind roll"),
        ({**CLOSED, "strokes": 3}, "strokes: not for kind tour"),
        ({**CLOSED, "waypoints": RING[:2]}, "at least 3 waypoints"),
        ({**OPEN, "waypoints": RING[:1]}, "at least 2 waypoints"),
        ({**LINE, "shake_band_hz": (3, 1)}, "must rise"),
        ({**LINE, "length_m": 0.5}, "must lie above 2 ramp_s"),
        ({**LINE, "length_m": 9000}, "within 3600 s"),
        ({**LINE, "strokes": 100}, "more than 4 a second"),
        ({**LINE, "sway": (0, 0, 0)}, "at least one axis"),
        ({**LINE, "length_m": math.nan}, "length_m"),
        ({**LINE, "speed": 1}, "speed"),
    ],
)
def test_impossible_settings_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError) as error:
        MotionConfig.model_validate(settings)
    (problem,) = error.value.errors()
    text = ".".join(map(str, problem["loc"])) + problem["msg"]
    assert message in text and "\n" not in text


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({**LINE, "shake_rotation_deg": 5}, "mean_rotation_deg_s is too small.*reduce shake_rotation_deg"),
        ({**LINE, "mean_rotation_deg_s": 3000}, "mean_rotation_deg_s is too large.*sway_hz"),
        ({**ROLL, "mean_rotation_deg_s": 3000}, "mean_rotation_deg_s is too large.*strokes"),
        ({**ROLL, "shake_position_m": 0.1}, "length_m is too small.*shake_position_m"),
        ({**CLOSED, "mean_rotation_deg_s": 5}, "mean_rotation_deg_s is too small.*how far the tour turns"),
        ({**OPEN, "length_m": 100}, "length_m is too large.*distances between waypoints"),
        ({**LINE, "target": (0.2, 5.0, 0.3)}, "straight up or down"),
        ({**LINE, "target": LINE["position"]}, "straight up or down, or at itself"),
        ({**CLOSED, "waypoints": [RING[0], *RING]}, "waypoints 0 and 1 are at one place"),
        ({**LINE, "shake_band_hz": (0.51, 0.52)}, "holds no multiple"),
    ],
)
def test_unreachable_targets_are_refused_in_one_line(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message) as error:
        made(settings, {})
    assert "\n" not in str(error.value) and str(error.value).startswith("motion: ")
