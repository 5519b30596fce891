"""Frames of every shutter: its limits, planes in closed form, and scans against the mirrored case."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic
from nightly import sampled
from rendering import CAMERA, FISHEYE, RADTAN, SCANS, constant_twist, mi, pixel_rays, pixel_times, room_xml
from room_frames import MOTION, STAMP, color, z_spread

from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.render.images import DepthRenderer
from rsgen.scene.loading import load_scene
from rsgen.scene.meshes import ply_bytes


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return load_scene(room_xml(tmp_path_factory.mktemp("room")))


# --- limits of the shutter


def test_a_still_camera_makes_readout_and_exposure_invisible(scene: Any) -> None:
    still = constant_twist(np.zeros(6), MOTION(np.array([STAMP]))[0])
    plain, rolling = Shutter(), Shutter(0.028, 0.02)
    depth = [DepthRenderer(scene, CAMERA, s).render(still, STAMP) for s in (plain, rolling)]
    np.testing.assert_array_equal(*depth)
    pictures = [color(scene, s).render(still, STAMP, seed=5) for s in (plain, rolling)]
    np.testing.assert_array_equal(*pictures)
    assert depth[0].std() > 0.1 and pictures[0].std() > 0.05


def test_a_moving_camera_without_readout_stands_still(scene: Any) -> None:
    spline = synthetic.make_spline()
    still = constant_twist(np.zeros(6), spline.pose(np.array([STAMP]))[0])
    depth, picture = DepthRenderer(scene, CAMERA, Shutter()), color(scene, Shutter())
    np.testing.assert_array_equal(depth.render(spline.pose, STAMP), depth.render(still, STAMP))
    np.testing.assert_array_equal(picture.render(spline.pose, STAMP, 2), picture.render(still, STAMP, 2))
    rolling = DepthRenderer(scene, CAMERA, Shutter(0.028)).render(spline.pose, STAMP)
    assert np.mean(rolling != depth.render(still, STAMP)) > 0.9  # or this test would pass for any renderer


# --- closed forms


@pytest.fixture(scope="module")
def plane(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Load a plane z = depth + slope · x as one big quad."""
    folder = tmp_path_factory.mktemp("planes")

    def load(depth: float, slope: float = 0.0) -> Any:
        xy = 20.0 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        vertices = np.column_stack([xy, depth + slope * xy[:, 0]])
        path = folder / f"{depth}-{slope}.ply"
        path.write_bytes(ply_bytes(vertices, np.array([[0, 2, 1], [0, 3, 2]])))
        return mi.load_dict({"type": "scene", "plane": {"type": "ply", "filename": str(path)}})

    return load


SHUTTERS = [Shutter(0.028, exposure, scan) for scan in SCANS for exposure in (0.0, 0.015)]


def shutter_id(shutter: Shutter) -> str:
    return f"{shutter.scan}-{shutter.exposure_s}"


@pytest.mark.parametrize("shutter", SHUTTERS, ids=shutter_id)
def test_flying_towards_a_wall(plane: Any, shutter: Shutter) -> None:
    """z = D − v t, the same along each line and different from line to line."""
    speed, distance = 1.5, 2.0
    got = DepthRenderer(plane(distance), CAMERA, shutter).render(constant_twist((0, 0, speed, 0, 0, 0)), STAMP)
    lines = shutter.line_count(CAMERA)
    line = np.arange(lines) if shutter.scan in ("top-bottom", "left-right") else np.arange(lines)[::-1]
    z = distance - speed * (STAMP + line * 0.028 / lines - 0.5 * shutter.exposure_s)
    expected = np.broadcast_to(z[:, None] if lines == CAMERA.height else z, got.shape)
    np.testing.assert_allclose(got, expected, rtol=1e-6)


@pytest.mark.parametrize("shutter", SHUTTERS, ids=shutter_id)
def test_moving_sideways_along_a_slanted_plane(plane: Any, shutter: Shutter) -> None:
    """z = D + s (v t + z x̂), x̂ the ray's slope: z = (D + s v t) / (1 − s x̂)."""
    speed, distance, slope = -2.0, 1.8, 0.6
    got = DepthRenderer(plane(distance, slope), CAMERA, shutter).render(constant_twist((speed, 0, 0, 0, 0, 0)), STAMP)
    x = (np.arange(CAMERA.width) - CAMERA.cx) / CAMERA.fx
    t = pixel_times(CAMERA, shutter, STAMP)
    np.testing.assert_allclose(got, (distance + slope * speed * t) / (1 - slope * x), rtol=2e-6)


@pytest.mark.parametrize("shutter", SHUTTERS, ids=shutter_id)
def test_panning_in_front_of_a_wall(plane: Any, shutter: Shutter) -> None:
    """Rotation by α = ω t about y: the ray (x̂, ŷ, 1) has the world z component cos α − x̂ sin α."""
    rate, distance = 1.2, 2.2
    got = DepthRenderer(plane(distance), CAMERA, shutter).render(constant_twist((0, 0, 0, 0, rate, 0)), STAMP)
    x = (np.arange(CAMERA.width) - CAMERA.cx) / CAMERA.fx
    angle = rate * pixel_times(CAMERA, shutter, STAMP)
    np.testing.assert_allclose(got, distance / (np.cos(angle) - x * np.sin(angle)), rtol=3e-6)


@pytest.mark.parametrize("camera", [RADTAN, FISHEYE], ids=lambda camera: camera.model)
def test_a_slanted_plane_through_a_distorting_lens(plane: Any, camera: Camera) -> None:
    distance, slope = 2.0, 0.15
    shutter = Shutter(0.028, 0.01)
    motion = constant_twist((0.7, -0.5, 0.6, 0.2, -0.3, 0.9))
    got = DepthRenderer(plane(distance, slope), camera, shutter).render(motion, STAMP)
    o, d = pixel_rays(camera, shutter, motion, STAMP)
    normal = np.array([-slope, 0, 1.0])
    np.testing.assert_allclose(got, (distance - o @ normal) / (d @ normal), rtol=5e-6)
    straight = replace(camera, model="pinhole", distortion=())
    assert np.abs(got - DepthRenderer(plane(distance, slope), straight, shutter).render(motion, STAMP)).max() > 0.01


def test_nothing_in_sight_has_depth_zero(plane: Any) -> None:
    away = constant_twist(np.zeros(6), np.diag([-1.0, 1, -1, 1]))
    assert not DepthRenderer(plane(2.0), CAMERA, Shutter()).render(away, 0.0).any()


# --- scan directions


def _conjugate(M: np.ndarray, motion: Any) -> Any:
    """The motion seen in a world and a camera that M (3, 3, its own inverse) mirrors."""
    M4 = np.eye(4)
    M4[:3, :3] = M
    return lambda t: M4 @ motion(t) @ M4


FLIP_Y, FLIP_X = np.diag([1.0, -1, 1]), np.diag([-1.0, 1, 1])
TRANSPOSE = np.eye(3)[[1, 0, 2]]
MIRRORS = {
    "bottom-top": (FLIP_Y, "top-bottom", lambda image: image[::-1]),
    "right-left": (FLIP_X, "left-right", lambda image: image[:, ::-1]),
    "left-right": (TRANSPOSE, "top-bottom", lambda image: image.swapaxes(0, 1)),
}


@pytest.mark.parametrize("scan", sampled(MIRRORS, 2))
def test_reversed_scans_agree_with_the_mirrored_case(scene: Any, tmp_path: Path, scan: Any) -> None:
    """The same frame of a mirrored room by a mirrored camera on a mirrored path, read out in the mirrored order."""
    M, mirrored_scan, flip = MIRRORS[scan]
    c = CAMERA
    mirrored_camera = {
        "bottom-top": replace(c, cy=c.height - 1 - c.cy),
        "right-left": replace(c, cx=c.width - 1 - c.cx),
        "left-right": Camera(c.height, c.width, c.fy, c.fx, c.cy, c.cx),
    }[scan]
    mirrored = load_scene(room_xml(tmp_path, M))
    other = _conjugate(M, MOTION)
    shutter = Shutter(0.028, 0.01, scan)

    depth = DepthRenderer(scene, c, shutter).render(MOTION, STAMP)
    by_order = {
        s: flip(DepthRenderer(mirrored, mirrored_camera, replace(shutter, scan=s)).render(other, STAMP)) for s in SCANS
    }
    agree = {s: np.mean(np.abs(d - depth) < 5e-6) for s, d in by_order.items()}
    assert agree.pop(mirrored_scan) > 0.998  # the rest: pixels exactly on an outline
    assert max(agree.values()) < 0.5

    # Colour samples lie elsewhere in each pixel: agreement within their spread over seeds.
    def frames(world: Any, camera: Camera, scan: Any, motion: Any) -> np.ndarray:
        renderer = color(world, replace(shutter, scan=scan), 64, camera)
        return np.stack([renderer.render(motion, STAMP, seed) for seed in range(8)])

    ours = frames(scene, c, scan, MOTION)
    same = np.stack([flip(f) for f in frames(mirrored, mirrored_camera, mirrored_scan, other)])
    reverse = {"top-bottom": "bottom-top", "left-right": "right-left"}[mirrored_scan]
    wrong = np.stack([flip(f) for f in frames(mirrored, mirrored_camera, reverse, other)])
    assert 0.7 < z_spread(ours, same) < 1.3
    assert z_spread(ours, wrong) > 3
