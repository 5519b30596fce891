"""`RollingShutterSensor`: rays against float64 geometry, Mitsuba's stock camera, and use in a script of one's own."""

from __future__ import annotations

import re
import textwrap
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic
from rendering import (
    CAMERA,
    FISHEYE,
    RADTAN,
    SCANS,
    RayProbe,
    constant_twist,
    dr,
    emission_integrator,
    mi,
    pixel_rays,
    room_xml,
)
from shutter_reference import line_window

from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.render import sensor as sensor_module
from rsgen.render.sensor import RollingShutterSensor

STAMP = 0.31
# About 1 m/s and 1.5 rad/s from a pose that is not the identity.
MOTION = constant_twist((0.7, -0.5, 0.6, 0.6, -1.1, 0.9), se3.exp(np.array([0.1, 0.2, -0.3, 0.2, -0.4, 0.3])))
DOUBLE_SPHERE = replace(CAMERA, model="double_sphere", distortion=(-0.18, 0.59))
MODELS = {"pinhole": CAMERA, "radtan": RADTAN, "fisheye": FISHEYE, "double_sphere": DOUBLE_SPHERE}


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The glowing room's scene.xml."""
    return room_xml(tmp_path_factory.mktemp("room"))


@pytest.fixture(scope="module")
def scene(room: Path) -> Any:
    return mi.load_file(str(room))


def sensor_rays(
    sensor: RollingShutterSensor, uv: np.ndarray, time: float | np.ndarray = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray, Any]:
    """Origins, unit directions (n, 3), times (n,) and the device ray of pixel positions `uv` (..., 2)."""
    uv = uv.reshape(-1, 2)
    camera = sensor.camera
    position = mi.Point2f((uv[:, 0] + 0.5) / camera.width, (uv[:, 1] + 0.5) / camera.height)
    ray, weight = sensor.sample_ray_differential(mi.Float(time), mi.Float(0), position, mi.Point2f(0.5))
    assert np.all(np.array(weight) == 1)
    return *(np.array(v).reshape(3, -1).T for v in (ray.o, ray.d)), np.array(ray.time) + np.zeros(len(uv)), ray


def perspective(camera: Camera, T_world_cam: np.ndarray) -> dict[str, Any]:
    """Mitsuba's stock camera of an undistorted camera with square pixels; its axes are x left, y up."""
    assert camera.fx == camera.fy
    return {
        "type": "perspective",
        "fov_axis": "x",
        "fov": float(np.degrees(2 * np.arctan(0.5 * camera.width / camera.fx))),
        "principal_point_offset_x": 0.5 - (camera.cx + 0.5) / camera.width,
        "principal_point_offset_y": 0.5 - (camera.cy + 0.5) / camera.height,
        "near_clip": 1e-3,
        "to_world": mi.ScalarTransform4f(T_world_cam @ np.diag([-1.0, -1.0, 1.0, 1.0])),
        "film": {
            "type": "hdrfilm",
            "width": camera.width,
            "height": camera.height,
            "rfilter": {"type": "box"},
            "pixel_format": "rgb",
            "component_format": "float32",
        },
    }


def test_the_example_in_the_docs_runs(room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    block = re.search(r"script:\n\n((?:    .*\n|\n)+)", sensor_module.__doc__ or "")
    assert block, "the module docstring no longer holds an indented example"
    for file in room.parent.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    synthetic.make_spline().save(tmp_path / "spline.npz")
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(textwrap.dedent(block[1]), names)
    image = np.array(names["image"])
    assert image.shape == (480, 640, 3)
    assert image.min() > 0.05 and image.max() < 0.95 and image.std() > 0.05  # glow() lies in [0.1, 0.9]


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("scan", SCANS)
def test_every_pixels_ray_is_that_of_its_lines_pose(model: str, scan: Any) -> None:
    camera, shutter = MODELS[model], Shutter(0.028, 0.012, scan)
    sensor = RollingShutterSensor(camera, shutter)
    sensor.expose(MOTION, STAMP)
    origin, direction, time, _ = sensor_rays(sensor, camera.pixel_grid(), 0.5 * shutter.exposure_s)
    o, d = (a.reshape(-1, 3) for a in pixel_rays(camera, shutter, MOTION, STAMP))
    d = d / np.linalg.norm(d, axis=-1, keepdims=True)
    np.testing.assert_allclose(origin, o, atol=5e-7)
    np.testing.assert_allclose(direction, d, atol=1e-6)
    mid = shutter.line_mid_time(0.0, shutter.line_of_pixel(camera.pixel_grid(), camera), camera).ravel()
    np.testing.assert_allclose(time, mid, atol=1e-8)


@pytest.mark.parametrize("scan", SCANS)
def test_positions_within_a_pixel_share_its_lines_window(scan: Any) -> None:
    shutter = Shutter(0.03, 0.01, scan)
    sensor = RollingShutterSensor(CAMERA, shutter)
    sensor.expose(MOTION, STAMP)
    grid = CAMERA.pixel_grid()
    for offset in (-0.499, 0.499):
        for begin in (0.0, shutter.exposure_s):
            _, _, time, _ = sensor_rays(sensor, grid + offset, begin)
            opened, closed = line_window(shutter, 0.0, shutter.line_of_pixel(grid, CAMERA), CAMERA)
            np.testing.assert_allclose(time, (closed if begin else opened).ravel(), atol=1e-8)


@pytest.mark.parametrize("model", MODELS)
def test_ray_differentials_are_the_neighbouring_pixels_directions(model: str) -> None:
    camera = MODELS[model]
    sensor = RollingShutterSensor(camera, Shutter())
    sensor.expose(MOTION, STAMP)
    grid = camera.pixel_grid()[:-1, :-1]
    ray = sensor_rays(sensor, grid)[3]
    assert np.all(np.array(ray.has_differentials))
    for offset, got in (((1, 0), ray.d_x), ((0, 1), ray.d_y)):
        np.testing.assert_allclose(
            np.array(got).reshape(3, -1).T, sensor_rays(sensor, grid + np.array(offset))[1], atol=2e-7
        )


def test_the_pose_tables_blend_is_exact_to_a_micrometre_under_fast_motion() -> None:
    """3 m/s and 10 rad/s (570 deg/s), away from the table's knots."""
    motion = constant_twist((3.0, 0, 0, 0, 0, 10.0))
    shutter = Shutter(0.028, 0.02)
    sensor = RollingShutterSensor(CAMERA, shutter)
    sensor.expose(motion, STAMP)
    rng = np.random.default_rng(1)
    uv = CAMERA.pixel_grid().reshape(-1, 2)
    within = rng.uniform(0, shutter.exposure_s, len(uv))
    origin, direction, _, _ = sensor_rays(sensor, uv, within)
    T = motion(line_window(shutter, STAMP, shutter.line_of_pixel(uv, CAMERA), CAMERA)[0] + within)
    d = np.einsum("nij,nj->ni", T[:, :3, :3], CAMERA.unproject(uv))
    np.testing.assert_allclose(origin, T[:, :3, 3], atol=1e-6)
    np.testing.assert_allclose(direction, d / np.linalg.norm(d, axis=-1, keepdims=True), atol=1e-6)


SQUARE = replace(CAMERA, fy=CAMERA.fx)


def test_without_readout_its_rays_are_those_of_mitsubas_perspective_camera(scene: Any) -> None:
    T_world_cam = MOTION(np.array([STAMP]))[0]
    sensor = RollingShutterSensor(SQUARE, Shutter())
    sensor.expose(MOTION, STAMP)
    origin, direction, _, ray = sensor_rays(sensor, SQUARE.pixel_grid())
    stock = mi.load_dict(perspective(SQUARE, T_world_cam))
    uv = SQUARE.pixel_grid().reshape(-1, 2) + 0.5
    position = mi.Point2f(uv[:, 0] / SQUARE.width, uv[:, 1] / SQUARE.height)
    stock_ray, _ = stock.sample_ray(0.0, 0.0, position, mi.Point2f(0.5))
    np.testing.assert_allclose(direction, np.array(stock_ray.d).reshape(3, -1).T, atol=2e-6)
    np.testing.assert_allclose(origin, np.broadcast_to(T_world_cam[:3, 3], origin.shape), atol=1e-7)
    # Points hit are the same too; the stock camera's rays start at the near plane instead of the pinhole.
    ours, theirs = scene.ray_intersect(mi.Ray3f(ray)), scene.ray_intersect(stock_ray)
    np.testing.assert_allclose(np.array(ours.p), np.array(theirs.p), atol=2e-5)


def test_without_readout_mitsubas_own_render_gives_the_perspective_cameras_picture(scene: Any) -> None:
    """Same seed, same sampler, no other noise: pixel by pixel the same sums."""
    sensor = RollingShutterSensor(SQUARE, Shutter())
    sensor.expose(MOTION, STAMP)
    stock = mi.load_dict(perspective(SQUARE, MOTION(np.array([STAMP]))[0]))
    ours, theirs = (
        np.array(mi.render(scene, sensor=s, integrator=emission_integrator(), spp=8, seed=3)) for s in (sensor, stock)
    )
    assert ours.std() > 0.05
    np.testing.assert_allclose(ours, theirs, atol=2e-4)
    assert np.mean(np.abs(ours - theirs)) < 2e-6


def test_mitsubas_own_render_rolls_the_shutter(scene: Any) -> None:
    """In a picture of the rays' times, every row's mean is its window's middle and its spread is uniform."""
    shutter = Shutter(0.028, 0.02, "bottom-top")
    sensor = RollingShutterSensor(CAMERA, shutter)
    sensor.expose(MOTION, STAMP)
    probe = RayProbe()
    image = np.array(mi.render(scene, sensor=sensor, integrator=probe, spp=64, seed=1))[..., 0]
    mid = shutter.line_mid_time(0.0, shutter.line_of_pixel(CAMERA.pixel_grid(), CAMERA), CAMERA)
    sigma = shutter.exposure_s / np.sqrt(12 * 64)
    z = (image - mid) / sigma
    assert np.abs(z).max() < 5 and 0.9 < z.std() < 1.1 and abs(z.mean()) * np.sqrt(z.size) < 4


def test_asks_the_trajectory_for_the_whole_exposure_and_nothing_else() -> None:
    asked: list[np.ndarray] = []

    def motion(t: np.ndarray) -> np.ndarray:
        asked.append(t)
        return MOTION(t)

    RollingShutterSensor(CAMERA, Shutter(0.02, 0.01)).expose(motion, 5.0)
    assert asked[0].min() == pytest.approx(4.99, abs=1e-12) and asked[0].max() == pytest.approx(5.02, abs=1e-12)
    RollingShutterSensor(CAMERA, Shutter()).expose(motion, 5.0)
    np.testing.assert_array_equal(asked[1], [5.0])
    spline = synthetic.make_spline()
    with pytest.raises(UserError):
        RollingShutterSensor(CAMERA, Shutter(0.02)).expose(spline.pose, spline.t_end - 0.01)


def test_the_planar_depth_scale_is_the_cosine_to_the_optical_axis() -> None:
    for camera in MODELS.values():
        sensor = RollingShutterSensor(camera, Shutter())
        grid = camera.pixel_grid().reshape(-1, 2)
        scale = np.array(sensor.planar_depth_scale(mi.Float(grid[:, 0]), mi.Float(grid[:, 1])))
        np.testing.assert_allclose(scale, 1 / np.linalg.norm(camera.unproject(grid), axis=-1), rtol=1e-6)


def test_has_no_extent_and_says_what_it_is() -> None:
    sensor = RollingShutterSensor(CAMERA, Shutter(0.02))
    assert not sensor.bbox().valid()
    assert "readout_s=0.02" in str(sensor) and "width=40" in str(sensor)
    assert dr.all(mi.Vector2u(sensor.film().size()) == mi.Vector2u(40, 30))
