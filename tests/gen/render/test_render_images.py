"""Frames: blur, samples, repeatability to the bit, an independent ray caster, sRGB, and frames of a configuration."""

from __future__ import annotations

import hashlib
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic
import trimesh
from rendering import CAMERA, RayProbe, constant_twist, mi, pixel_rays, room_meshes, room_xml
from room_frames import MOTION, STAMP, color, z_spread
from shutter_reference import line_window
from trimesh.ray.ray_pyembree import RayMeshIntersector

from rsgen.config.config import Config
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.produce import parts
from rsgen.render import images as render
from rsgen.render.images import ColorRenderer, DepthRenderer
from rsgen.scene.loading import load_scene
from rsgen.sensors.color import to_srgb8


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return room_xml(tmp_path_factory.mktemp("room"))


@pytest.fixture(scope="module")
def scene(room: Path) -> Any:
    return load_scene(room)


# --- blur


@pytest.mark.nightly
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
    assert 0.7 < z_spread(blurry, mean_of_sharp()) < 1.3
    # What a window that is off by a fifth of the exposure would give.
    late = np.stack([blurred.render(MOTION, STAMP + 0.2 * exposure, seed) for seed in range(12)])
    assert z_spread(late, blurry) > 3
    clean = color(scene, Shutter(readout), 64)
    still = np.stack([clean.render(MOTION, STAMP - 0.5 * exposure, seed) for seed in range(12)])
    assert z_spread(still, blurry) > 3


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
sys.path[:0] = sys.argv[1], sys.argv[1] + "/../gen/render"
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
    here = Path(__file__).parents[2] / "support"
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
    scene = parts.load_scene(config)
    source = parts.open_frames(config, scene=scene)
    np.testing.assert_array_equal(
        source.depth.exact(spline, STAMP),
        DepthRenderer(scene, config.depth.camera, config.depth.shutter).render(spline.pose, STAMP),
    )
    linear = source.color.linear(spline, STAMP, frame=2)
    T_depth_color = np.linalg.inv(synthetic.T_COLOR_DEPTH)
    expected = np.stack(
        [
            color(scene, config.color.shutter, 64, config.color.camera).render(
                lambda t: spline.pose(t) @ T_depth_color, STAMP, s
            )
            for s in range(4)
        ]
    )
    frames = np.stack([source.color.linear(spline, STAMP, frame=k) for k in range(8)])
    assert 0.7 < z_spread(frames, expected) < 1.3
    np.testing.assert_array_equal(linear, frames[2])
    assert np.mean(frames[2] != frames[3]) > 0.9
    np.testing.assert_array_equal(source.color.picture(spline, STAMP, 2), to_srgb8(linear, 0.7))
    other_seed = parts.open_frames(config.model_copy(update={"seed": 5})).color.linear(spline, STAMP, 2)
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
    twin, plain = parts.open_frames(config, global_shutter=True), parts.open_frames(no_readout)
    np.testing.assert_array_equal(twin.depth.exact(spline, STAMP), plain.depth.exact(spline, STAMP))
    np.testing.assert_array_equal(twin.color.linear(spline, STAMP, 1), plain.color.linear(spline, STAMP, 1))
