"""Truth images in closed form: walls along which, towards which and through which the camera moves."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rendering import CAMERA, constant_twist, mi, pixel_times
from truth_frames import GEOMETRY, STAMP, render

from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.scene.meshes import ply_bytes
from rsgen.truth.renderer import global_instant


def quads(folder: Path, *corners: tuple[float, float, float, float, float]) -> Any:
    """Scene of rectangles parallel to the image: x0, x1, y0, y1, z each, m."""
    shapes: dict[str, Any] = {"type": "scene"}
    for k, (x0, x1, y0, y1, z) in enumerate(corners):
        path = folder / f"{k}.ply"
        vertices = np.array([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]])
        path.write_bytes(ply_bytes(vertices, np.array([[0, 2, 1], [0, 3, 2]])))
        shapes[f"quad{k}"] = {"type": "ply", "filename": str(path)}
    return mi.load_dict(shapes, optimize=False)


def test_two_walls_and_the_strip_that_the_near_one_hides(tmp_path: Path) -> None:
    """Moving to +x at 2 m/s without readout: everything goes left by f v Δt / z, the near wall over the far one."""
    camera, near, far, step = Camera(80, 20, 60.0, 60.0, 39.5, 9.5), 1.0, 3.0, 2.0 / 30
    world = quads(tmp_path, (0.0, 9, -9, 9, near), (-9, 9, -9, 9, far))
    path = constant_twist((2.0, 0, 0, 0, 0, 0), se3.exp(np.array([-2.0 * STAMP, 0, 0, 0, 0, 0])))
    images = render(world, camera, Shutter(0.0, 0.01), path, flow=("next",), color_depth=True, blur_length=True)
    x = np.arange(80) - camera.cx  # px from the axis
    half = 2.0 * 0.005  # mid-exposure comes before the stamp
    is_near = x >= 60 * half / near
    z = np.where(is_near, near, far)
    np.testing.assert_allclose(images["color_depth"], np.broadcast_to(z, (20, 80)), rtol=1e-6)
    np.testing.assert_allclose(images["blur_length"], np.broadcast_to(60 * 2.0 * 0.01 / z, (20, 80)), atol=1e-4)
    flow = images["flow_next"]
    shift = -60 * step / z
    inside = x + shift + camera.cx >= -0.5
    np.testing.assert_allclose(flow[..., 0], np.broadcast_to(np.where(inside, shift, 0), (20, 80)), atol=1e-4)
    np.testing.assert_allclose(flow[..., 1], 0, atol=1e-4)
    edge_then = 60 * (half - step) / near  # where the near wall's edge is in the next frame
    hidden = ~is_near & (x + shift > edge_then)
    np.testing.assert_array_equal(flow[..., 2] > 0, np.broadcast_to(inside & ~hidden, (20, 80)))
    assert 2 <= hidden.sum() <= 4 and (~inside).sum() == 1


def test_rolling_flow_along_a_wall_in_closed_form(tmp_path: Path) -> None:
    """Sideways at v: the camera is v r (mid − y) / h ahead at the middle's time, v (1/rate + …) at the next's."""
    world = quads(tmp_path, (-9, 9, -9, 9, 2.0))
    path = constant_twist((0.8, 0, 0, 0, 0, 0))
    images = render(world, CAMERA, Shutter(0.03, 0.01), path)
    y = np.arange(30)[:, None]
    per_second = -CAMERA.fx * 0.8 / 2.0
    for name, ahead in (("first", -y), ("middle", 14.5 - y), ("last", 29 - y)):
        found = images[f"flow_global_{name}"][..., 2] > 0
        expected = np.broadcast_to(per_second * 0.03 / 30 * ahead, (30, 40))
        np.testing.assert_allclose(images[f"flow_global_{name}"][found, 0], expected[found], atol=1e-4)
        assert found.mean() > 0.95
    seen = images["flow_next"][..., 2] > 0  # a point stays in its row: 1/30 s later
    np.testing.assert_allclose(images["flow_next"][seen, 0], per_second / 30, atol=1e-4)
    np.testing.assert_allclose(images["blur_length"], -per_second * 0.01, atol=1e-4)
    np.testing.assert_array_equal(images["normals"], np.broadcast_to([0, 0, -1.0], (30, 40, 3)))


def test_moving_up_a_wall_the_rows_own_times_count(tmp_path: Path) -> None:
    """Along the scan at v: line y' of the next frame satisfies y' = y − k (1/rate + d (y' − y)), k = f v / z."""
    world = quads(tmp_path, (-9, 9, -9, 9, 2.0))
    delay, k = 0.03 / 30, CAMERA.fy * 1.5 / 2.0
    flow = render(world, CAMERA, Shutter(0.03), constant_twist((0, 1.5, 0, 0, 0, 0)))["flow_next"]
    seen = flow[..., 2] > 0
    np.testing.assert_allclose(flow[seen, 1], -k / 30 / (1 + k * delay), atol=1e-4)
    assert abs(k / 30 / (1 + k * delay) - k / 30) > 0.01 and seen.mean() > 0.9


def test_infinitely_far_things_move_with_the_cameras_rotation_only(tmp_path: Path) -> None:
    world = quads(tmp_path, (-0.1, 0.1, -0.1, 0.1, -5))  # behind the camera
    shutter = Shutter(0.03, 0.01)
    turning, moving = (constant_twist(xi) for xi in ((0, 0, 0, 0.4, -0.6, 0.5), (3, 2, 1, 0.4, -0.6, 0.5)))
    still, shifted = (
        render(world, CAMERA, shutter, path) for path in (turning, lambda t: _unturned(moving, turning, t))
    )
    assert not still["color_depth"].any() and not still["normals"].any()
    rays = CAMERA.unproject(CAMERA.pixel_grid())
    T = turning(pixel_times(CAMERA, shutter, STAMP).ravel()).reshape(30, 40, 4, 4)
    then = turning(np.array([global_instant(CAMERA, shutter, STAMP, "middle")]))[0]
    in_then = np.einsum("ji,hwjk,hwk->hwi", then[:3, :3], T[..., :3, :3], rays)
    flow = CAMERA.project(in_then)[0] - CAMERA.pixel_grid()
    seen = still["flow_global_middle"][..., 2] > 0
    np.testing.assert_allclose(still["flow_global_middle"][seen, :2], flow[seen], atol=2e-4)
    assert seen.mean() > 0.9
    for name in (*GEOMETRY, "blur_length"):
        np.testing.assert_allclose(still[name], shifted[name], atol=2e-4)


def _unturned(moving: Any, turning: Any, t: Any) -> np.ndarray:
    """The rotation of `turning` at the places of `moving`."""
    T = turning(t).copy()
    T[..., :3, 3] = moving(t)[..., :3, 3]
    return T


def test_a_surfaces_other_side_is_not_the_same_point(tmp_path: Path) -> None:
    """The camera goes through a wall, turns round and looks back at it: the points are there, their face is not."""
    world = quads(tmp_path, (-9, 9, -9, 9, 2.0))
    T_behind = np.diag([-1.0, 1, -1, 1])
    T_behind[:3, 3] = 0, 0, 4

    def path(t: Any) -> np.ndarray:
        return np.where(np.reshape(t, (-1, 1, 1)) < 0.32, np.eye(4), T_behind)

    flow = render(world, CAMERA, Shutter(), path, flow=("next",))["flow_next"]
    assert np.abs(flow[..., 0]).max() > 30 and not flow[..., 2].any()


def test_a_world_whose_origin_is_far_away_costs_no_precision(tmp_path: Path) -> None:
    """Poses are relative to the camera: at 4 km float32 positions are 0.2 mm apart, 0.006 px in this image."""
    world = quads(tmp_path, (4087, 4105, -9, 9, 2.0))
    path = constant_twist((0.8, 0, 0, 0, 0, 0), se3.exp(np.array([4096.0, 0, 0, 0, 0, 0])))
    images = render(world, CAMERA, Shutter(0.03, 0.01), path)
    seen = images["flow_next"][..., 2] > 0
    np.testing.assert_allclose(images["flow_next"][seen, 0], -CAMERA.fx * 0.8 / 2 / 30, atol=2e-4)
    np.testing.assert_allclose(images["blur_length"], CAMERA.fx * 0.8 / 2 * 0.01, atol=2e-4)
