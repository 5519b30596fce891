"""A projector's dots on a wall: where its ray meets it, as bright as distance and slant say, and not in a shadow."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rendering import mi

from rsgen.array_types import Float32Array
from rsgen.config.rig import DotsConfig
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.sensors.projectors import DotProjector, dot_pattern

CAMERA = Camera(160, 120, 200.0, 200.0, 79.5, 59.5)
PLACE = np.array([0.06, -0.02, 0.01])
FIELD_DEG, DOT_DEG, POWER, SEED = (20.0, 16.0), 1.2, 3.0, 4


def still(t: Any) -> np.ndarray:
    return np.broadcast_to(np.eye(4), (*np.shape(t), 4, 4))


def plate(z: float, half: float = 10.0, x: float = 0.0, y: float = 0.0) -> dict[str, Any]:
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([x, y, z]).scale(half)}


def lit(**plates: dict[str, Any]) -> Float32Array:
    scene = mi.load_dict({"type": "scene", **plates})
    config = DotsConfig(position=tuple(PLACE), count=1, field_deg=FIELD_DEG, dot_deg=DOT_DEG, power=POWER)
    return DotProjector(scene, CAMERA, Shutter(0.02, 0.004), config, SEED).light(still, 1.0)


def the_dot() -> np.ndarray:
    """Slopes (2,) x / z and y / z of the one dot's ray, from the pattern's own generator: it is one cell."""
    place = np.random.default_rng([0x646F7473, SEED]).random(2)
    return (2 * place - 1) * np.tan(np.deg2rad(FIELD_DEG) / 2)


@pytest.mark.parametrize("z", [0.8, 1.7])
def test_a_dot_is_where_its_ray_meets_the_wall_and_as_bright_as_the_distance_says(z: float) -> None:
    light, slope = lit(wall=plate(z)).astype(float), the_dot()
    away = z - PLACE[2]
    expected = CAMERA.project(np.array([*(PLACE[:2] + slope * away), z]))[0]
    v, u = np.indices(light.shape)
    total = light.sum()
    np.testing.assert_allclose([(u * light).sum() / total, (v * light).sum() / total], expected, atol=0.1)
    # The pattern's Gaussian in the plane at 1 m from the projector, in pixels of the camera.
    sigma = np.deg2rad(DOT_DEG) / np.sqrt(8 * np.log(2)) * CAMERA.fx * away / z
    cosine = 1 / np.sqrt(1 + slope @ slope)
    assert total == pytest.approx(POWER * 2 * np.pi * sigma**2 * cosine / (away / cosine) ** 2, rel=0.03)


def test_what_stands_in_the_way_of_the_projector_takes_its_dot_off_the_wall() -> None:
    z, near, slope = 1.7, 0.5, the_dot()
    x, y = PLACE[:2] + slope * (near - PLACE[2])
    wall = CAMERA.project(np.array([*(PLACE[:2] + slope * (z - PLACE[2])), z]))[0].round().astype(int)
    free, hidden = lit(wall=plate(z)), lit(wall=plate(z), screen=plate(near, 0.02, x, y))
    assert free[wall[1], wall[0]] > 0.1
    assert hidden[wall[1], wall[0]] == 0 and hidden.max() > free.max()  # it is on the screen, which is nearer


def test_one_dot_is_where_its_ray_says_and_as_wide() -> None:
    config = DotsConfig(count=1, field_deg=(20.0, 20.0), dot_deg=1.0)
    half = np.tan(np.deg2rad(config.field_deg) / 2)
    pattern = dot_pattern(config, half, seed=3)
    place = np.random.default_rng([0x646F7473, 3]).random(2)
    y, x = np.unravel_index(int(pattern.argmax()), pattern.shape)
    np.testing.assert_allclose([x + 0.5, y + 0.5], place * np.array(pattern.shape[::-1]), atol=1.0)
    assert 0.5 < pattern.max() <= 1
    wide = (pattern > 0.5 * pattern.max()).sum() * np.prod(2 * half) / pattern.size  # its area at half height
    assert wide == pytest.approx(np.pi / 4 * np.deg2rad(1.0) ** 2, rel=0.3)
    np.testing.assert_array_equal(pattern, dot_pattern(config, half, seed=3))
