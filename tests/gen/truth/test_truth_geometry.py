"""Truth images against float64 geometry and Embree: flow, validity, blur length, normals, depth, and the projection."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import synthetic
import trimesh
from rendering import CAMERA, FISHEYE, RADTAN, mi, pixel_rays, pixel_times, room_meshes, room_xml
from shutter_reference import line_window
from trimesh.ray.ray_pyembree import RayMeshIntersector
from truth_frames import GEOMETRY, NEXT, SPLINE, STAMP, T_CAM_BODY, bilinear, motion, render

from rsgen.device.lens import Lens, PoseTable
from rsgen.device.projection import MovingCamera
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter, project_rolling
from rsgen.render.images import DepthRenderer
from rsgen.scene.loading import load_scene
from rsgen.truth.renderer import global_instant


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return load_scene(room_xml(tmp_path_factory.mktemp("room")))


@pytest.fixture(scope="module")
def caster() -> RayMeshIntersector:
    """Embree through trimesh on the same room."""
    return RayMeshIntersector(trimesh.util.concatenate(room_meshes()))


def first_hits(caster: Any, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) that rays meet first, NaN where none, and the triangles' normals (n, 3)."""
    points, ray, triangle = caster.intersects_location(o, d, multiple_hits=False)
    hits, normals = np.full((len(o), 3), np.nan), np.full((len(o), 3), np.nan)
    hits[ray], normals[ray] = points, caster.mesh.face_normals[triangle]
    return hits, normals


CASES = [
    (CAMERA, Shutter(0.028, 0.012, "top-bottom")),
    (RADTAN, Shutter(0.028, 0.012, "bottom-top")),
    (FISHEYE, Shutter(0.028, 0.012, "left-right")),
    (RADTAN, Shutter(0.02, 0.0, "right-left")),
    (FISHEYE, Shutter(0.0, 0.01)),
    (CAMERA, Shutter(0.0, 0.0)),
]


@pytest.mark.parametrize("camera, shutter", CASES, ids=lambda c: getattr(c, "model", getattr(c, "scan", "")))
def test_geometry_agrees_with_float64_and_an_independent_ray_caster(
    scene: Any, caster: Any, camera: Camera, shutter: Shutter
) -> None:
    images = render(scene, camera, shutter)
    grid, shape = camera.pixel_grid(), (camera.height, camera.width)
    o, d = (a.reshape(-1, 3) for a in pixel_rays(camera, shutter, motion, STAMP))
    p, n_world = first_hits(caster, o, d)
    times = pixel_times(camera, shutter, STAMP).ravel()
    T_cam_world = se3.inverse(motion(times))

    z = se3.transform(T_cam_world, p)[:, 2].reshape(shape)
    same = np.abs(images["color_depth"] - z) < 1e-4  # else the pixel's ray is on an outline
    assert same.mean() > 0.995
    n_cam = np.einsum("nij,nj->ni", T_cam_world[:, :3, :3], n_world)
    away = np.einsum("ni,ni->n", n_world, d) > 0
    n_cam = np.where(away[:, None], -n_cam, n_cam).reshape(*shape, 3)
    # Two triangles may meet at a pixel's centre.
    assert np.mean(np.abs(images["normals"] - n_cam).max(axis=-1)[same] < 1e-5) > 0.995

    # Equation (13), with the line's window from the shutter and the poses from the spline.
    opened, closed = line_window(shutter, STAMP, shutter.line_of_pixel(grid, camera).ravel(), camera)
    x_begin, x_end = (camera.project(se3.transform(se3.inverse(motion(t)), p))[0] for t in (opened, closed))
    blur = np.linalg.norm(x_end - x_begin, axis=-1).reshape(shape)
    np.testing.assert_allclose(images["blur_length"][same], blur[same], atol=3e-4)
    assert np.median(blur) > 0.1 or shutter.exposure_s == 0

    for name in GEOMETRY:
        if name == "flow_next":
            uv, t, inside = project_rolling(SPLINE, T_CAM_BODY, camera, shutter, NEXT, p)
            T_target = motion(np.where(inside, t, NEXT))
        else:
            instant = global_instant(camera, shutter, STAMP, name.rpartition("_")[2])  # type: ignore[arg-type]
            T_target = np.broadcast_to(motion(np.array([instant])), (len(p), 4, 4))
            uv, _ = camera.project(se3.transform(se3.inverse(T_target), p))
            inside = camera.contains(uv)
        flow = images[name].reshape(-1, 3)
        at_border = (np.abs((uv + 0.5) / (camera.width, camera.height) - 0.5) > 0.5 - 1e-4).any(axis=-1)
        check = same.ravel() & inside & ~at_border
        np.testing.assert_allclose(flow[check, :2], (uv - grid.reshape(-1, 2))[check], atol=5e-4)
        assert np.median(np.linalg.norm(flow[check, :2], axis=-1)) > (0.02 if shutter.readout_s else -1)
        # A point is visible if a ray from that camera towards it meets nothing before it.
        centre = T_target[:, :3, 3]
        met, _ = first_hits(caster, centre, p - centre)
        visible = inside & (np.linalg.norm(met - p, axis=-1) < 1e-3)
        decided = same.ravel() & ~at_border
        assert np.mean((flow[:, 2] > 0)[decided] == visible[decided]) > 0.998
        assert not flow[~inside & decided].any()
    assert (images["flow_next"][..., 2] == 0).mean() > 0.01  # some leave the image


def test_flow_to_the_next_frame_leads_to_its_depth(scene: Any) -> None:
    """The depth of a point, seen from where the next frame is when it shows it, is what that frame's depth says."""
    camera = Camera(96, 72, 62.0, 61.0, 47.2, 35.9)
    shutter = Shutter(0.028, 0.01)
    now, following = (render(scene, camera, shutter, stamps=s) for s in ((STAMP, NEXT), (NEXT, None)))
    valid = now["flow_next"][..., 2] > 0
    grid = camera.pixel_grid()
    p = se3.transform(motion(pixel_times(camera, shutter, STAMP)), camera.backproject(grid, now["color_depth"]))
    uv = grid + now["flow_next"][..., :2]
    t = shutter.line_mid_time(NEXT, shutter.line_of_pixel(uv, camera), camera)
    predicted = se3.transform(se3.inverse(motion(t)), p)[..., 2]
    observed = 1 / bilinear(1 / following["color_depth"], uv)
    difference = np.abs(predicted - observed)[valid]
    assert np.median(difference) < 2e-4 and np.mean(difference < 2e-3) > 0.95
    assert np.median(np.abs(predicted - now["color_depth"])[valid]) > 5e-3
    assert not following["flow_next"].any()  # nothing comes after the last frame


def test_depth_is_that_of_a_depth_camera_in_its_place(scene: Any) -> None:
    shutter = Shutter(0.028, 0.01, "left-right")
    expected = DepthRenderer(scene, RADTAN, shutter).render(motion, STAMP)
    np.testing.assert_array_equal(render(scene, RADTAN, shutter)["color_depth"], expected)


@pytest.mark.parametrize("rates", [(2, 1, 0, 1, -3, 1), (0, 0, 1, 6, 1, 2), (0, 0, 0, 0, 0, 12), (0, 0, 0, -14, 0, 0)])
def test_fast_motion_is_solved_wherever_float64_solves_it(scene: Any, rates: Any) -> None:
    """The image moves along the scan at up to half the scan's own speed (30 lines in 30 ms, f = 30 px, 14 rad/s)."""
    knots = 0.05 * (np.arange(20) - 1.0)
    fast = synthetic.Spline(se3.exp(np.multiply.outer(knots, np.array(rates, float))), -0.05, 0.05)
    shutter = Shutter(0.03, 0.01)
    o, d = (a.reshape(-1, 3) for a in pixel_rays(CAMERA, shutter, fast.pose, STAMP))
    images = render(scene, CAMERA, shutter, fast.pose)
    z = images["color_depth"].reshape(-1, 1)
    uv, _, inside = project_rolling(fast, np.eye(4), CAMERA, shutter, NEXT, o + d * z)
    flow = images["flow_next"].reshape(-1, 3)
    solved = flow.any(axis=-1)
    assert inside.sum() > 200
    assert np.mean(solved[inside]) > 0.995 and np.mean(inside[solved]) > 0.995
    both = solved & inside
    off = np.linalg.norm(flow[both, :2] - (uv - CAMERA.pixel_grid().reshape(-1, 2))[both], axis=-1)
    assert np.quantile(off, 0.999) < 2e-3


@pytest.mark.parametrize("camera", [CAMERA, RADTAN, FISHEYE], ids=lambda camera: camera.model)
def test_projection_is_the_cameras(camera: Camera) -> None:
    rng = np.random.default_rng(2)
    p = np.concatenate([rng.normal(size=(4000, 3)) * (1, 1, 0.7), [[0, 0, 1.0], [0, 0, 0], [1e-9, 0, 1]]])
    still = PoseTable.of(mi.Vector4f, camera, Shutter(), lambda t: np.eye(4), 0.0)
    points = tuple(mi.Float(p[:, k]) for k in range(3))
    uv, defined = MovingCamera(Lens(camera, Shutter()), still).project_at(mi.Float(0), points, mi.Float(1))
    expected, valid = camera.project(p.astype(np.float32))
    assert np.mean(np.array(defined) == valid) == 1
    close = valid & (np.abs(p[:, 2]) > 0.05)
    np.testing.assert_allclose(np.array([np.array(c) for c in uv]).T[close], expected[close], rtol=3e-6, atol=2e-4)
    assert 500 < valid.sum() < 3500
