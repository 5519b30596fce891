"""The living room is wide enough for the trajectories that pass through it."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from scenes.living_room import build as scene

ROOT = Path(__file__).resolve().parents[3]
ICL = ROOT.parent / "shared" / "data" / "icl_nuim_livingroom"
CLEARANCE = 0.15


@cache
def triangles() -> np.ndarray:
    """(m, 3, 3) corners of every triangle of the room."""
    pieces, lamps = scene.contents()
    meshes = [*(mesh for piece in pieces for _, mesh in piece.parts), *(lamp.mesh for lamp in lamps)]
    return np.concatenate([mesh.v[mesh.f] for mesh in meshes])


def distances(triangles: np.ndarray, points: np.ndarray, reach: float) -> np.ndarray:
    """(n,) exact distance of each point to the nearest triangle, `reach` where there is none nearer than that."""
    centre = triangles.mean(1)
    radius = np.linalg.norm(triangles - centre[:, None], axis=-1).max(1)
    tree = cKDTree(points)
    near = np.flatnonzero(tree.query(centre)[0] - radius < reach)
    hits = tree.query_ball_point(centre[near], reach + radius[near])
    i = np.concatenate([np.asarray(h, int) for h in hits])
    j = np.repeat(near, [len(h) for h in hits])
    out = np.full(len(points), reach)
    np.minimum.at(out, i, np.linalg.norm(trimesh.triangles.closest_point(triangles[j], points[i]) - points[i], axis=1))
    return out


def test_distances_against_brute_force() -> None:
    rng = np.random.default_rng(1)
    triangles = rng.normal(size=(60, 1, 3)) + rng.normal(size=(60, 3, 3)) * rng.uniform(0.05, 1.5, (60, 1, 1))
    points = rng.normal(size=(40, 3))
    w = rng.dirichlet(np.ones(3), 20000)
    sampled = np.stack([np.linalg.norm(w @ t - points[:, None], axis=-1).min(1) for t in triangles]).min(0)
    exact = distances(triangles, points, 9.0)
    assert (exact <= sampled + 1e-9).all() and np.abs(exact - sampled).max() < 0.03


@pytest.mark.parametrize("k", range(4))
def test_icl_nuim_trajectories_keep_clear(k: int) -> None:
    path = ICL / f"livingRoom{k}.rh_tum.txt"
    if not path.is_file():
        pytest.skip("ICL-NUIM's trajectories are not part of the repository")
    p = np.loadtxt(path)[:, 1:4]
    p = np.concatenate([p[:-1] + (p[1:] - p[:-1]) * a for a in (0.0, 1 / 3, 2 / 3)] + [p[-1:]])
    assert distances(triangles(), p, 0.3).min() >= CLEARANCE


@pytest.mark.parametrize("path", sorted((ROOT / "configs").glob("*_trajectory.txt")), ids=lambda p: p.stem)
def test_own_trajectories_keep_clear(path: Path) -> None:
    assert distances(triangles(), np.loadtxt(path)[:, 1:4], 0.3).min() >= CLEARANCE
