"""Truth images: made as they are asked for, twins at their instants with the frame's exposure, the same bytes again."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from rendering import CAMERA, SCANS, RayProbe, constant_twist, emission_integrator, pixel_times, room_xml
from truth_frames import EVERYTHING, NEXT, SPLINE, STAMP, bilinear, motion, render, stream

from rsgen.config.sections import TruthConfig
from rsgen.errors import UserError
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.render.images import ColorRenderer
from rsgen.scene.loading import load_scene
from rsgen.sensors.color import to_srgb8
from rsgen.truth.renderer import TruthRenderer


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return load_scene(room_xml(tmp_path_factory.mktemp("room")))


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
    truth = TruthConfig(sharp=True, global_shutter=("first", "middle"), spp=4)
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


# --- frames and their places in time


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
