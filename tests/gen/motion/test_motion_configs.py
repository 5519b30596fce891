"""The six configs after the paper's Table 1: figures met within 2 %, rest at the ends, a way that suits the room."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import yaml

from rsgen.config.config import ColorConfig, DepthConfig
from rsgen.config.motion import MotionConfig
from rsgen.motion.fit import FitResult, fit_spline
from rsgen.motion.free_space import nearest_surface
from rsgen.motion.make import make_motion
from rsgen.motion.statistics import TABLE_1, motion_statistics
from rsgen.sequence.trajectory import Trajectory
from scenes.living_room import build

CONFIGS = Path(__file__).parents[3] / "configs"
ROBOTS = [name for name in TABLE_1 if name.startswith("robot")]
TABLES = [name for name in TABLE_1 if name.startswith("table")]
TABLE_TOP = np.array([[0.15, 0.54, 0.145], [0.85, 0.54, 1.295]])


@cache
def settings(name: str) -> dict[str, Any]:
    return yaml.safe_load((CONFIGS / f"{name}.yaml").read_text(encoding="utf-8"))


def made(name: str, seed: int) -> Trajectory:
    return make_motion(MotionConfig.model_validate(settings(name)["motion"]), seed)


@cache
def fitted(name: str) -> FitResult:
    return fit_spline(made(name, seed=0), dt=0.05, pad_begin_s=0.02, pad_end_s=0.03)


@cache
def room() -> np.ndarray:
    """(m, 3, 3) triangles of the living room."""
    pieces, lamps = build.contents()
    meshes = [*(mesh for piece in pieces for _, mesh in piece.parts), *(lamp.mesh for lamp in lamps)]
    return np.concatenate([mesh.v[mesh.f] for mesh in meshes])


@pytest.mark.parametrize("name", TABLE_1)
def test_the_papers_figures_are_met(name: str) -> None:
    fit = fitted(name)
    stats = motion_statistics(fit.spline)
    assert (stats.length_m, stats.mean_speed_m_s, stats.mean_rotation_deg_s) == pytest.approx(TABLE_1[name], rel=0.02)
    assert fit.residual_trans_m.max() < 5e-5
    assert stats.mean_acceleration_m_s2 < 3.0 and stats.max_acceleration_m_s2 < 10.0
    other = motion_statistics(made(name, seed=1))
    assert (other.length_m, other.mean_speed_m_s, other.mean_rotation_deg_s) == pytest.approx(TABLE_1[name], rel=0.005)


@pytest.mark.parametrize("name", ROBOTS)
def test_robots_move_along_x_or_turn_about_z(name: str) -> None:
    spline = fitted(name).spline
    v = spline.velocity(np.linspace(spline.t_begin, spline.t_end, 1000))
    part, axis = (v[:, :3], 0) if name.startswith("robot_t") else (v[:, 3:], 2)
    assert np.abs(part[:, axis]).sum() > 0.98 * np.linalg.norm(part, axis=1).sum()


@pytest.mark.parametrize("name", TABLE_1)
def test_the_camera_rests_at_both_ends(name: str) -> None:
    spline = fitted(name).spline
    v = spline.velocity(np.array([spline.t_begin, spline.t_end]))
    assert np.abs(v[:, :3]).max() < 0.005 and np.abs(v[:, 3:]).max() < np.radians(0.5)


@pytest.mark.parametrize("name", TABLE_1)
def test_the_cameras_are_valid_and_their_clocks_apart(name: str) -> None:
    data = settings(name)
    color, depth = ColorConfig.model_validate(data["color"]), DepthConfig.model_validate(data["depth"])
    assert data["name"] == name and color.spp == 32
    assert color.model == depth.model == "radtan" and color.intrinsics != depth.intrinsics
    assert 0.003 <= color.offset_s - depth.offset_s < 0.033
    assert 0.010 <= color.exposure_s <= 0.020 and depth.exposure_s <= 0.010
    T = np.array(data["T_color_depth"])
    assert np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-10) and np.linalg.det(T) > 0
    assert np.linalg.norm(T[:3, 3]) == pytest.approx(0.025, abs=1e-4)
    assert np.degrees(np.arccos((np.trace(T[:3, :3]) - 1) / 2)) == pytest.approx(0.3, abs=1e-3)


@cache
def way(name: str) -> np.ndarray:
    """(200, 3) positions of the camera."""
    spline = fitted(name).spline
    return spline.pose(np.linspace(spline.t_begin, spline.t_end, 200))[:, :3, 3]


@cache
def distances() -> dict[str, np.ndarray]:
    """By config, of each of its positions to the room, metres."""
    found, _ = nearest_surface(np.concatenate([way(name) for name in TABLE_1]), room(), 2.0)
    return dict(zip(TABLE_1, found.reshape(len(TABLE_1), -1), strict=True))


@pytest.mark.parametrize("name", TABLE_1)
def test_the_way_keeps_clear_of_the_room(name: str) -> None:
    asked = MotionConfig.model_validate(settings(name)["motion"]).clearance_m
    assert distances()[name].min() >= (0.5 if name in ROBOTS else 0.35) > asked
    assert (way(name) > room().min(axis=(0, 1))).all() and (way(name) < room().max(axis=(0, 1))).all()


@cache
def caster() -> Any:
    pyembree = pytest.importorskip("trimesh.ray.ray_pyembree")
    corners = room().reshape(-1, 3)
    return pyembree.RayMeshIntersector(trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False))


@pytest.mark.parametrize("name", TABLE_1)
def test_what_is_seen_is_half_a_metre_to_four_metres_away(name: str) -> None:
    triangles = room()
    depth = DepthConfig.model_validate(settings(name)["depth"])
    v, u = np.meshgrid(np.linspace(20, 460, 8), np.linspace(20, 620, 10), indexing="ij")
    rays = depth.camera.unproject(np.stack([u, v], axis=-1).reshape(-1, 2))
    spline = fitted(name).spline
    T = spline.pose(np.linspace(spline.t_begin, spline.t_end, 20))
    directions = (rays @ np.swapaxes(T[:, :3, :3], 1, 2)).reshape(-1, 3)
    origins = np.repeat(T[:, :3, 3], len(rays), axis=0)
    hit = caster().intersects_first(origins, directions)
    assert (hit >= 0).mean() > 0.95  # the rest leaves by the window, whose pane is not among the parts
    directions, origins, hit = directions[hit >= 0], origins[hit >= 0], hit[hit >= 0]
    normal = np.cross(triangles[hit, 1] - triangles[hit, 0], triangles[hit, 2] - triangles[hit, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.einsum("nk,nk->n", triangles[hit, 0] - origins, normal) / np.einsum("nk,nk->n", directions, normal)
    assert np.nanpercentile(z, 1) > 0.4 and np.nanpercentile(z, 99) < 4.5 and 0.6 < np.nanmedian(z) < 4.0


@pytest.mark.parametrize("name", TABLES)
def test_table_tours_look_at_the_table_from_all_sides(name: str) -> None:
    spline = fitted(name).spline
    T = spline.pose(np.linspace(1.0, spline.t_end - 1.0, 400))
    forward, position = T[:, :3, 2], T[:, :3, 3]
    hit = position + forward * ((TABLE_TOP[0, 1] - position[:, 1]) / forward[:, 1])[:, None]
    margin = 0.25  # the image's middle may wander off the top a little; the top fills much more than that
    on_table = ((hit >= TABLE_TOP[0] - margin) & (hit <= TABLE_TOP[1] + margin))[:, [0, 2]].all(axis=1)
    assert on_table.mean() > 0.75
    middle = TABLE_TOP.mean(axis=0)
    distance = np.linalg.norm(position - middle, axis=1)
    assert distance.min() > 0.7 and distance.max() < 1.8
    bearing = np.unwrap(np.arctan2(*(position - middle)[:, [0, 2]].T))
    assert np.ptp(bearing) > np.radians(300 if name == "table2" else 500)
