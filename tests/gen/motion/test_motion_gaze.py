"""What a suggested tour looks at."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import trimesh

from rsgen.motion.walk import AZIMUTHS, ELEVATIONS_DEG, choose_targets


def test_what_a_room_holds_is_looked_at_rather_than_its_bare_half() -> None:
    """Round a room of 6 m by 6 m by 2.6 m with forty boxes along one wall: most views turn to these, and none without.

    Rays by trimesh.
    """
    room = trimesh.creation.box((6, 2.6, 6))
    room.invert()
    rng = np.random.default_rng(1)
    things = [
        trimesh.creation.box(size, trimesh.transformations.translation_matrix(place))
        for size, place in zip(
            rng.uniform(0.2, 0.5, (40, 3)), rng.uniform((-2.8, -1.1, -2.8), (2.8, 0.4, -2.3), (40, 3)), strict=True
        )
    ]
    angle = np.linspace(0, math.tau, 16, endpoint=False)
    walk = np.stack([1.4 * np.cos(angle), np.full(16, 0.15), 1.4 * np.sin(angle)], axis=1)

    def turned_there(*meshes: Any, color: np.ndarray | None = None) -> float:
        mesh = trimesh.util.concatenate(meshes)

        def cast(origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            hit, ray, face = mesh.ray.intersects_location(origin, direction, multiple_hits=False)
            distance, normal = np.full(len(origin), np.inf), np.tile([0.0, 1.0, 0.0], (len(origin), 1))
            distance[ray] = np.linalg.norm(hit - origin[ray], axis=1)
            normal[ray] = mesh.face_normals[face]
            return distance, normal

        place, target = choose_targets(walk, cast, 0.2, np.random.default_rng(0), color)
        gaze = target - place
        return float(np.mean(gaze[:, 2] < 0))

    assert turned_there(room) < 0.6
    assert turned_there(room, *things) > 0.75
    # Without them, were that wall painted: directions towards it have edges, the others none or are burnt out too.
    azimuth = np.arange(AZIMUTHS) * (math.tau / AZIMUTHS)
    color = np.zeros((2, 16, AZIMUTHS, len(ELEVATIONS_DEG)))
    color[0, :, np.sin(azimuth) < -0.5] = 0.2
    painted = turned_there(room, color=color)
    color[1, :, np.sin(azimuth) > 0] = 0.3
    assert turned_there(room) < painted and turned_there(room, color=color) > 0.75
