"""Truth images: flow, validity, blur length, normals and depth against float64 geometry, Embree and closed forms."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import synthetic
import trimesh
from pydantic import ValidationError
from rendering import (
    CAMERA,
    FISHEYE,
    RADTAN,
    SCANS,
    RayProbe,
    constant_twist,
    emission_integrator,
    mi,
    pixel_rays,
    pixel_times,
    room_meshes,
    room_xml,
)
from shutter_reference import line_window
from trimesh.ray.ray_pyembree import RayMeshIntersector

from rsgen.config.sections import ColorConfig
from rsgen.config.truth import TruthConfig
from rsgen.device.lens import Lens
from rsgen.device.pose_table import PoseTable
from rsgen.device.projection import MovingCamera
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter, project_rolling
from rsgen.render.images import ColorRenderer, DepthRenderer
from rsgen.render.scene import load_scene, ply_bytes
from rsgen.sensors.response import to_srgb8
from rsgen.truth.renderer import TruthRenderer, global_instant

STAMP, NEXT = 0.31, 0.31 + 1 / 30
T_CAM_BODY = synthetic.T_COLOR_DEPTH
SPLINE = synthetic.make_spline()
EVERYTHING = TruthConfig(
    global_shutter=("first", "middle", "last"),
    flow=("global", "next"),
    normals=True,
    blur_length=True,
    color_depth=True,
)
GEOMETRY = ("flow_global_first", "flow_global_middle", "flow_global_last", "flow_next")


def motion(t: Any) -> np.ndarray:
    """The colour camera's poses along the spline."""
    return SPLINE.pose(t) @ se3.inverse(T_CAM_BODY)


def stream(camera: Camera, shutter: Shutter) -> ColorConfig:
    return ColorConfig(
        width=camera.width, height=camera.height, intrinsics=(camera.fx, camera.fy, camera.cx, camera.cy),
        model=camera.model, distortion=camera.distortion, readout_s=shutter.readout_s, exposure_s=shutter.exposure_s,
        scan=shutter.scan,
    )  # fmt: skip


def render(
    scene: Any, camera: Camera, shutter: Shutter, path: Any = motion, stamps: Any = (STAMP, NEXT), **what: Any
) -> dict[str, np.ndarray]:
    """All geometry of one frame (and twins of one sample a pixel, which nobody looks at), or what is asked for."""
    truth = TruthConfig(**what) if what else EVERYTHING.model_copy(update={"spp": 1})
    return TruthRenderer(scene, emission_integrator(), stream(camera, shutter), truth).render(path, *stamps, seed=3)


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


def bilinear(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Values of an image (h, w) at pixels uv (..., 2)."""
    u, v = (uv[..., k].astype(np.float32) for k in (0, 1))
    return cv2.remap(image.astype(np.float32), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


# --- settings


def test_nothing_is_made_unasked(scene: Any) -> None:
    assert TruthConfig().images == {}
    nothing = TruthRenderer(scene, emission_integrator(), stream(CAMERA, Shutter(0.028)), TruthConfig())
    assert nothing.render(motion, STAMP, NEXT, 1) == {}


def test_what_is_asked_for_is_made_under_its_name(scene: Any) -> None:
    images = render(scene, CAMERA, Shutter(0.028, 0.01), **EVERYTHING.model_dump() | {"sharp": True, "spp": 1})
    named = EVERYTHING.model_copy(update={"sharp": True}).images
    assert list(images) == list(named) and len(named) == 11
    for name, channels in named.items():
        assert images[name].dtype == (np.float32 if channels else np.uint8)
        assert images[name].shape == (30, 40) + (() if len(channels) == 1 else (3,))
        assert images[name].std() > 0
    alone = render(scene, CAMERA, Shutter(0.028, 0.01), global_shutter=("last",), spp=1)
    np.testing.assert_array_equal(alone["global_last"], images["global_last"])  # whatever else is asked for


def test_settings_that_make_no_sense_are_refused() -> None:
    with pytest.raises(ValidationError, match="flow 'global' needs a time in global_shutter"):
        TruthConfig(flow=("global",))
    with pytest.raises(ValidationError, match="flow names one twice"):
        TruthConfig(flow=("next", "next"))
    with pytest.raises(ValidationError):
        TruthConfig(global_shutter=("second",))


# --- twins


@pytest.mark.parametrize("scan", SCANS)
def test_twins_are_taken_at_their_instants(scene: Any, scan: Any) -> None:
    """A camera that moves 1 m/s along x carries its clock in its rays' origins."""
    shutter, clock = Shutter(0.028, 0.01, scan), constant_twist((1, 0, 0, 0, 0, 0))
    lines = shutter.line_count(CAMERA)
    expected = {
        "sharp": pixel_times(CAMERA, shutter, STAMP),
        "global_first": np.full((30, 40), STAMP - 0.005),
        "global_middle": np.full((30, 40), STAMP - 0.005 + 0.014 * (lines - 1) / lines),
        "global_last": np.full((30, 40), STAMP - 0.005 + 0.028 * (lines - 1) / lines),
    }
    for name, times in expected.items():
        what = {"sharp": True} if name == "sharp" else {"global_shutter": (name.removeprefix("global_"),)}
        probe = RayProbe()
        TruthRenderer(scene, probe, stream(CAMERA, shutter), TruthConfig(spp=4, **what)).render(clock, STAMP, None, 1)
        x = probe.origin[:, 0].reshape(30, 40, 4)
        np.testing.assert_allclose(x, np.broadcast_to(times[..., None], x.shape), atol=1e-7)


def test_twins_have_the_frames_exposure_and_noise_of_their_own(scene: Any) -> None:
    shutter = Shutter(0.028, 0.01)
    color = stream(CAMERA, shutter).model_copy(update={"exposure_gain": 0.6})
    truth = TruthConfig(sharp=True, global_shutter=("first", "middle"), spp=16)
    renderer = TruthRenderer(scene, emission_integrator(), color, truth)
    still = constant_twist(np.zeros(6), motion(np.array([STAMP]))[0])
    images, again, other = (renderer.render(still, STAMP, None, seed) for seed in (1, 1, 2))
    expected = ColorRenderer(scene, emission_integrator(), CAMERA, shutter, 256).render(still, STAMP, 9)
    for name in truth.images:
        np.testing.assert_array_equal(images[name], again[name])
        assert np.mean(images[name] != other[name]) > 0.2
        assert np.abs(images[name].astype(float) - to_srgb8(expected, 0.6)).mean() < 1
    assert np.mean(images["sharp"] != images["global_first"]) > 0.2
    assert np.mean(images["global_middle"] != images["global_first"]) > 0.2


def test_warping_the_global_twin_by_the_flow_gives_the_sharp_twin(scene: Any) -> None:
    """Two renderings and the flow between them: the room glows by place only, so that a point has one colour."""
    camera = Camera(96, 72, 62.0, 61.0, 47.2, 35.9)
    shutter = Shutter(0.028, 0.02)
    images = render(
        scene, camera, shutter, sharp=True, global_shutter=("first", "middle", "last"), spp=256, flow=("global",)
    )
    grid = camera.pixel_grid()
    sharp = images["sharp"][..., 1].astype(float)
    for time in ("first", "middle", "last"):
        flow, twin = images[f"flow_global_{time}"], images[f"global_{time}"][..., 1]
        there = grid + flow[..., :2]
        inside = ((there >= 0) & (there <= (camera.width - 1, camera.height - 1))).all(axis=-1)
        seen = (flow[..., 2] > 0) & inside
        assert seen.mean() > 0.8
        warped, unwarped = (np.abs(bilinear(twin, uv) - sharp)[seen] for uv in (there, grid))
        assert np.median(warped) < 0.6 and np.mean(warped) < 0.35 * np.mean(unwarped)


# --- flow, blur length, normals and depth against float64 and another ray caster

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


# --- closed forms


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


# --- numbers on the device


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


def test_a_world_whose_origin_is_far_away_costs_no_precision(tmp_path: Path) -> None:
    """Poses are relative to the camera: at 4 km float32 positions are 0.2 mm apart, 0.006 px in this image."""
    world = quads(tmp_path, (4087, 4105, -9, 9, 2.0))
    path = constant_twist((0.8, 0, 0, 0, 0, 0), se3.exp(np.array([4096.0, 0, 0, 0, 0, 0])))
    images = render(world, CAMERA, Shutter(0.03, 0.01), path)
    seen = images["flow_next"][..., 2] > 0
    np.testing.assert_allclose(images["flow_next"][seen, 0], -CAMERA.fx * 0.8 / 2 / 30, atol=2e-4)
    np.testing.assert_allclose(images["blur_length"], CAMERA.fx * 0.8 / 2 * 0.01, atol=2e-4)


def test_a_frame_does_not_depend_on_those_before(scene: Any) -> None:
    renderer = TruthRenderer(scene, emission_integrator(), stream(CAMERA, Shutter(0.028, 0.01)), EVERYTHING)
    first = renderer.render(motion, STAMP, NEXT, 5)
    renderer.render(motion, NEXT, None, 6)
    again = renderer.render(motion, STAMP, NEXT, 5)
    for name, image in first.items():
        np.testing.assert_array_equal(image, again[name])


def test_a_trajectory_that_ends_too_soon_is_refused(scene: Any) -> None:
    with pytest.raises(UserError, match="outside"):
        render(scene, CAMERA, Shutter(0.028), stamps=(STAMP, SPLINE.t_end - 0.01))
