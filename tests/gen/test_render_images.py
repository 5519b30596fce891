"""Frames: shutter limits, closed forms of planes, mirrored scans, blur, repeatability, an independent ray caster."""

from __future__ import annotations

import hashlib
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic
import trimesh
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

from rsgen.config.config import Config
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.produce import generate
from rsgen.render import images as render
from rsgen.render.images import ColorRenderer, DepthRenderer, global_shutter
from rsgen.render.scene import load_scene, ply_bytes
from rsgen.sensors.response import to_srgb8

STAMP = 0.31
MOTION = constant_twist((0.7, -0.5, 0.6, 0.6, -1.1, 0.9), se3.exp(np.array([0.1, 0.2, -0.3, 0.2, -0.4, 0.3])))


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return room_xml(tmp_path_factory.mktemp("room"))


@pytest.fixture(scope="module")
def scene(room: Path) -> Any:
    return load_scene(room)


def color(scene: Any, shutter: Shutter, spp: int = 16, camera: Camera = CAMERA) -> ColorRenderer:
    return ColorRenderer(scene, emission_integrator(), camera, shutter, spp)


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


def test_global_shutter_keeps_all_but_the_readout() -> None:
    shutter = Shutter(0.028, 0.01, "right-left")
    assert global_shutter(shutter) == Shutter(0.0, 0.01, "right-left")


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


@pytest.mark.parametrize("scan", MIRRORS)
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
    assert 0.7 < _z_spread(ours, same) < 1.3
    assert _z_spread(ours, wrong) > 3


def _z_spread(a: np.ndarray, b: np.ndarray) -> float:
    """Root mean square z-score of the difference of two sets of renders (n, h, w, 3) of one mean: 1 if it is one.

    The difference of the means is compared with the sets' own spread, pooled over the picture by the ratio of sums
    (single pixels' variances are too uncertain to divide by).
    """
    difference = a.mean(0, dtype=float) - b.mean(0, dtype=float)
    variance = a.var(0, ddof=1, dtype=float) / len(a) + b.var(0, ddof=1, dtype=float) / len(b)
    return float(np.sqrt((difference**2).sum() / variance.sum()))


# --- blur


def test_blur_is_the_mean_of_sharp_frames_over_each_lines_window(scene: Any) -> None:
    """A sharp frame stamped τ before the stamp shows each row τ before that row's end of exposure."""
    exposure, strata = 0.04, 64
    readout = 0.028
    rng = np.random.default_rng(11)
    sharp, blurred = color(scene, Shutter(readout), 4), color(scene, Shutter(readout, exposure), 64)
    replicates = 6
    before = exposure * (np.arange(strata) + rng.random((replicates, strata))) / strata

    def mean_of_sharp(shift: float = 0.0) -> np.ndarray:
        return np.stack(
            [
                np.mean([sharp.render(MOTION, STAMP - t + shift, 1000 * r + j) for j, t in enumerate(times)], axis=0)
                for r, times in enumerate(before)
            ]
        )

    blurry = np.stack([blurred.render(MOTION, STAMP, seed) for seed in range(12)])
    assert 0.7 < _z_spread(blurry, mean_of_sharp()) < 1.3
    # What a window that is off by a fifth of the exposure would give.
    late = np.stack([blurred.render(MOTION, STAMP + 0.2 * exposure, seed) for seed in range(12)])
    assert _z_spread(late, blurry) > 3
    clean = color(scene, Shutter(readout), 64)
    still = np.stack([clean.render(MOTION, STAMP - 0.5 * exposure, seed) for seed in range(12)])
    assert _z_spread(still, blurry) > 3


@pytest.mark.parametrize("scan", ["top-bottom", "right-left"])
def test_samples_fill_every_pixels_footprint_and_window_evenly(scene: Any, scan: Any) -> None:
    shutter, spp = Shutter(0.028, 0.02, scan), 64
    probe = RayProbe()
    renderer = ColorRenderer(scene, probe, CAMERA, shutter, spp)
    still = constant_twist(np.zeros(6))
    renderer.render(still, STAMP, seed=3)
    grid = CAMERA.pixel_grid()
    opened, _ = line_window(shutter, 0.0, shutter.line_of_pixel(grid, CAMERA), CAMERA)
    within = (probe.time.reshape(-1, spp) - opened.reshape(-1, 1)) / shutter.exposure_s
    ray = probe.direction / probe.direction[:, 2:]
    uv = ray[:, :2] * (CAMERA.fx, CAMERA.fy) + (CAMERA.cx, CAMERA.cy)
    offset = uv.reshape(-1, spp, 2) - grid.reshape(-1, 1, 2) + 0.5
    samples = np.concatenate([within[..., None], offset], axis=-1)  # (pixels, spp, 3), all in [0, 1)
    # A sample on the very edge of a pixel may round into the next.
    assert np.mean((samples > -1e-4) & (samples < 1 + 1e-4)) > 0.9999
    # Low discrepancy in each pixel: no eighth of the window or footprint goes without, or has twice its share.
    eighths = np.clip((samples * 8).astype(int), 0, 7)
    counts = np.stack([(eighths == k).sum(axis=1) for k in range(8)])
    assert counts.min() >= 2 and counts.max() <= 15
    # Over all pixels: uniform, and time is independent of where in the footprint.
    for k in range(3):
        ordered = np.sort(samples[..., k].ravel())
        assert np.abs(ordered - (np.arange(ordered.size) + 0.5) / ordered.size).max() < 0.005
    assert np.abs(np.corrcoef(samples.reshape(-1, 3).T) - np.eye(3)).max() < 0.01


# --- the same bytes again


def digest(image: np.ndarray) -> str:
    return hashlib.sha256(image.tobytes()).hexdigest()


_OTHER_PROCESS = """
import sys
sys.path[:0] = sys.argv[1], sys.argv[1] + "/../gen"
from pathlib import Path
import test_render_images as t
scene = t.load_scene(Path(sys.argv[2]))
shutter = t.Shutter(0.028, 0.01)
print(t.digest(t.path_color(scene, shutter).render(t.MOTION, t.STAMP, 7)))
print(t.digest(t.DepthRenderer(scene, t.CAMERA, shutter).render(t.MOTION, t.STAMP)))
"""


def path_color(scene: Any, shutter: Shutter, spp: int = 8) -> ColorRenderer:
    return ColorRenderer(scene, mi.load_dict({"type": "path", "max_depth": 3}), CAMERA, shutter, spp)


def test_a_frame_is_the_same_to_the_bit_whenever_and_wherever_it_is_rendered(room: Path, scene: Any) -> None:
    shutter = Shutter(0.028, 0.01)
    picture, depth = path_color(scene, shutter), DepthRenderer(scene, CAMERA, shutter)
    stamps = (STAMP, STAMP + 0.1, STAMP + 0.2)
    forward = [digest(picture.render(MOTION, t, 7 + k)) for k, t in enumerate(stamps)]
    backward = [digest(picture.render(MOTION, t, 7 + k)) for k, t in reversed(list(enumerate(stamps)))]
    assert forward == backward[::-1] and len(set(forward)) == 3
    z = [digest(depth.render(MOTION, t)) for t in stamps]
    assert z == [digest(depth.render(MOTION, t)) for t in stamps]
    here = Path(__file__).parents[1] / "support"
    out = subprocess.run(
        [sys.executable, "-c", _OTHER_PROCESS, str(here), str(room)],
        capture_output=True, text=True, check=True, cwd=here.parents[1],
    ).stdout  # fmt: skip
    assert re.findall("[0-9a-f]{64}", out) == [forward[0], z[0]]  # Mitsuba may warn there too


def test_another_seed_gives_other_noise_of_the_same_picture(scene: Any) -> None:
    renderer = path_color(scene, Shutter(0.028, 0.01))
    a, b = (renderer.render(MOTION, STAMP, seed) for seed in (7, 8))
    assert np.mean(a != b) > 0.99
    assert np.abs(a - b).mean() < 0.2 * a.mean()
    # Neighbouring seeds share nothing: noise around the mean of many is uncorrelated.
    mean = np.mean([renderer.render(MOTION, STAMP, seed) for seed in range(100, 116)], axis=0)
    assert abs(np.corrcoef((a - mean).ravel(), (b - mean).ravel())[0, 1]) < 0.15


def test_several_launches_take_the_same_samples_as_one(scene: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    renderer = color(scene, Shutter(0.028, 0.01), 12)
    whole = renderer.render(MOTION, STAMP, 3)
    pixels = CAMERA.width * CAMERA.height
    monkeypatch.setattr(render, "_LAUNCH", 5 * pixels)  # 5 + 5 + 2
    np.testing.assert_allclose(renderer.render(MOTION, STAMP, 3), whole, atol=1e-6)
    monkeypatch.setattr(render, "_LAUNCH", 1)  # never less than one sample a launch
    np.testing.assert_allclose(renderer.render(MOTION, STAMP, 3), whole, atol=1e-6)


# --- against others


def test_depth_agrees_with_an_independent_ray_caster(scene: Any) -> None:
    shutter = Shutter(0.028, 0.01, "left-right")
    camera = Camera(96, 72, 60.0, 61.0, 48.2, 35.1)
    spline = synthetic.make_spline()
    mesh = trimesh.util.concatenate(room_meshes())
    within, outlines = [], 0
    for stamp in (0.1, 0.5, 0.9):
        z = DepthRenderer(scene, camera, shutter).render(spline.pose, stamp)
        o, d = (a.reshape(-1, 3) for a in pixel_rays(camera, shutter, spline.pose, stamp))
        points, ray, _ = RayMeshIntersector(mesh).intersects_location(o, d, multiple_hits=False)
        expected = np.zeros(len(o))
        expected[ray] = np.einsum("ij,ij->i", points - o[ray], d[ray]) / np.einsum("ij,ij->i", d[ray], d[ray])
        within.append(np.abs(z.ravel() - expected) < 1e-4)
        outlines += int((np.abs(np.diff(z, axis=1)) > 0.3).sum())
    assert np.mean(within) >= 0.999
    assert outlines > 50  # the ball was in sight


def test_srgb_encoding() -> None:
    """Known values, and the standard's formula in float64 with every rounding boundary met."""
    known = {0.0: 0, 0.0031308: 10, 0.18: 118, 0.214041: 127.5, 0.5: 188, 1.0: 255, 2.0: 255, -0.5: 0}
    for linear, value in known.items():
        assert abs(int(to_srgb8(np.float32([linear]))[0]) - value) <= 0.5
    # Decoding every 8-bit value (IEC 61966-2-1, the inverse transfer function) must encode to itself.
    code = np.arange(256) / 255
    decoded = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4).astype(np.float32)
    np.testing.assert_array_equal(to_srgb8(decoded), np.arange(256))
    np.testing.assert_array_equal(to_srgb8(decoded / 4, gain=4.0), np.arange(256))
    # Halfway between codes it changes over.
    half = (np.arange(255) + 0.5) / 255
    boundary = np.where(half <= 0.04045, half / 12.92, ((half + 0.055) / 1.055) ** 2.4)
    np.testing.assert_array_equal(to_srgb8((boundary * (1 - 1e-5)).astype(np.float32)), np.arange(255))
    np.testing.assert_array_equal(to_srgb8((boundary * (1 + 1e-5)).astype(np.float32)), np.arange(1, 256))
    assert to_srgb8(np.zeros((2, 3, 3), np.float32)).dtype == np.uint8


# --- frames of a configuration


def config_for(room: Path, **color: Any) -> Config:
    config = synthetic.make_config(40, 30, color={"spp": 8, **color}, depth={"exposure_s": 0.004, "scan": "left-right"})
    return config.model_copy(
        update={
            "scene": config.scene.model_copy(update={"file": room}),
            "light": config.light.model_copy(update={"mode": "path", "max_depth": 1}),
            "seed": 4,
        }
    )


def test_frame_source_renders_both_streams_with_their_own_cameras(room: Path) -> None:
    config = config_for(room, exposure_s=0.01, exposure_gain=0.7)
    spline = synthetic.make_spline()
    source = generate.FrameSource(config)
    np.testing.assert_array_equal(
        source.depth(spline, STAMP),
        DepthRenderer(source.scene, config.depth.camera, config.depth.shutter).render(spline.pose, STAMP),
    )
    linear = source.linear_color(spline, STAMP, frame=2)
    T_depth_color = np.linalg.inv(synthetic.T_COLOR_DEPTH)
    expected = np.stack(
        [
            color(source.scene, config.color.shutter, 64, config.color.camera).render(
                lambda t: spline.pose(t) @ T_depth_color, STAMP, s
            )
            for s in range(4)
        ]
    )
    frames = np.stack([source.linear_color(spline, STAMP, frame=k) for k in range(8)])
    assert 0.7 < _z_spread(frames, expected) < 1.3
    np.testing.assert_array_equal(linear, frames[2])
    assert np.mean(frames[2] != frames[3]) > 0.9
    np.testing.assert_array_equal(source.color(spline, STAMP, 2), to_srgb8(linear, 0.7))
    other_seed = generate.FrameSource(config.model_copy(update={"seed": 5})).linear_color(spline, STAMP, 2)
    assert np.mean(other_seed != linear) > 0.9


def test_a_global_shutter_frame_source_is_that_of_a_config_without_readout(room: Path) -> None:
    config = config_for(room, exposure_s=0.01)
    no_readout = config.model_copy(
        update={
            "color": config.color.model_copy(update={"readout_s": 0.0}),
            "depth": config.depth.model_copy(update={"readout_s": 0.0}),
        }
    )
    spline = synthetic.make_spline()
    twin, plain = generate.FrameSource(config, global_shutter=True), generate.FrameSource(no_readout)
    np.testing.assert_array_equal(twin.depth(spline, STAMP), plain.depth(spline, STAMP))
    np.testing.assert_array_equal(twin.linear_color(spline, STAMP, 1), plain.linear_color(spline, STAMP, 1))
