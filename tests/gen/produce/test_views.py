"""How good a view is: the shape and the edges that it has."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh
from trimesh.ray.ray_pyembree import RayMeshIntersector

from rsgen.geometry.camera import Camera
from rsgen.produce.views import Views, score, views_along

CAMERA = Camera(48, 36, 40.0, 40.0, 23.5, 17.5)


def cast_into(mesh: trimesh.Trimesh) -> Any:
    caster = RayMeshIntersector(mesh)

    def cast(origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        hit, ray, face = caster.intersects_location(origin, direction, multiple_hits=False)
        distance, normal = np.full(len(origin), np.inf), np.zeros((len(origin), 3))
        distance[ray], normal[ray] = np.linalg.norm(hit - origin[ray], axis=1), mesh.face_normals[face]
        return distance, normal

    return cast


def grey(p: np.ndarray, direction: np.ndarray) -> np.ndarray:
    return np.full((2, len(p), 3), 0.2, np.float32)


def test_shape_is_what_depth_holds_the_camera_by() -> None:
    """A wall alone leaves it free, a corner of three does not, and none of a scene twice as large differs."""
    T = np.eye(4)[None]
    wall = trimesh.creation.box((40, 40, 0.1), trimesh.transformations.translation_matrix((0, 0, 2)))
    room = trimesh.creation.box((2, 1.5, 4))
    room.invert()
    corner = views_along(T, CAMERA, cast_into(room), grey)
    bare = views_along(T, CAMERA, cast_into(wall), grey)
    assert bare.shape[0] < 1e-6 < 0.01 < corner.shape[0]
    assert [score(views, np.ones(1)).flat for views in (bare, corner)] == [1.0, 0.0]
    assert corner.nearest[0] == pytest.approx(0.75 * np.hypot(1, 40 / 17.5), rel=0.02)  # ceiling, floor
    room.apply_scale(1.7)
    assert views_along(T, CAMERA, cast_into(room), grey).shape == pytest.approx(corner.shape, rel=1e-3)
    none = views_along(T, CAMERA, lambda o, d: (np.full(len(o), np.inf), np.zeros((len(o), 3))), grey)
    assert none.shape[0] == 0 and none.nearest[0] == np.inf


def test_edges_are_what_both_halves_show() -> None:
    """Stripes on a quarter of the picture, and noise all over that is as strong."""
    rng = np.random.default_rng(0)
    light = np.full((2, 2, 36, 48, 3), 0.2, np.float32)
    light[:, 1, :, :12:4] = 0.5
    light[:, 1, :, 1:12:4] = 0.5
    light += rng.normal(0.0, 0.05, light.shape).astype(np.float32)
    edges = score(Views(light, np.ones(2), np.ones((2, 1))), np.ones(2)).edges
    assert edges[0] < 0.02 and 0.15 < edges[1] < 0.3
    burnt = score(Views(light, np.ones(2), np.ones((2, 1))), np.full(2, 100.0))
    assert burnt.edges.max() == 0 and burnt.clipped.min() == 1 and burnt.worst == 0


def test_a_tour_is_judged_by_its_worst_views_and_told_by_the_second() -> None:
    light = np.full((2, 20, 36, 48, 3), 0.2, np.float32)
    light[:, :, :, ::3] = 0.5
    light[:, 13] = 0.2  # a bare wall
    scores = score(Views(light, np.full(20, 0.05), np.ones((20, 1))), np.ones(20))
    assert scores.worst == pytest.approx(0.5) and scores.worth.mean() == pytest.approx(0.95)
    lines = scores.per_second(0.5 + np.arange(20))
    assert len(lines) == 21 and [line.split()[1] for line in lines[1:]] == ["1.00"] * 13 + ["0.00"] + ["1.00"] * 6
