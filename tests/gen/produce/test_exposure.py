"""A scene that nobody has photographed: how a tour through it is exposed."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from lit import scene_of, write_scene

from rsgen.cli.main import main
from rsgen.geometry.camera import Camera
from rsgen.motion.free_space import Cast
from rsgen.produce.views import (
    MOST_CLIPPED,
    Exposure,
    Views,
    adapted,
    path_traced,
    score,
    suggested_exposure,
    views_along,
)
from rsgen.scene.rays import cast_rays

CAMERA = Camera(640, 480, 480.0, 480.0, 319.5, 239.5)
GLOWING = """<shape type="cube"><transform name="to_world"><scale value="2"/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf><boolean name="flip_normals" value="true"/>
    <emitter type="area"><rgb name="radiance" value="{0}"/></emitter></shape>"""


def seen(scene: Any) -> np.ndarray:
    cast: Cast = partial(cast_rays, scene)
    return views_along(np.eye(4)[None], CAMERA, cast, path_traced(scene)).light


@pytest.mark.parametrize(("radiance", "gain", "wanted"), [(0.002, 1.0, 90.0), (36.0, 1.0, 0.005), (0.1, 1.0, None)])
def test_the_typical_surface_is_mid_grey(radiance: float, gain: float, wanted: float | None, tmp_path: Path) -> None:
    """Walls that glow alike: mid-grey, 0.18, is the gain times what they send."""
    scene = scene_of(tmp_path, GLOWING.format(radiance))
    light = seen(scene)
    assert suggested_exposure(light, gain) == (None if wanted is None else Exposure(wanted))
    if wanted is not None:
        assert suggested_exposure(light, wanted) is None


def test_bright_walls_above_a_dark_floor_are_not_white() -> None:
    """Two thirds of the pictures send 0.01, the rest 1: mid-grey there would be 18 times white here."""
    light = np.full((2, 3, 30, 40, 3), 0.01, np.float32)
    light[:, :, :10] = 1.0
    assert suggested_exposure(light, 10.0) == Exposure(0.6)


def test_windows_do_not_clip_more_than_two_percent() -> None:
    """A window of a tenth of the pictures that is forty times as bright as the wall about it."""
    light = np.full((2, 4, 30, 40, 3), 0.1, np.float32)
    light[:, :, :12, :10] = 4.0
    exposure = suggested_exposure(light, 1.8)
    assert exposure is not None and exposure.target is None and 0.2 < exposure.gain <= 0.25
    views = Views(light, np.ones(4), np.ones((4, 1)))
    assert score(views, np.full(4, exposure.gain)).clipped.max() == 0
    assert score(views, np.full(4, 1.8)).clipped == pytest.approx(0.1)


def test_a_dark_room_beside_a_bright_one_asks_for_automatic_exposure() -> None:
    """Half of the views are a thousand times as bright as the others: no single gain shows both."""
    rng = np.random.default_rng(0)
    light = np.broadcast_to(rng.uniform(0.5, 1.0, (30, 40, 1)), (2, 6, 30, 40, 3)).astype(np.float32)
    light[:, 3:] *= 1e-3
    exposure = suggested_exposure(light, 1.0)
    assert exposure is not None and exposure.target == 0.53
    scores = score(Views(light, np.ones(6), np.ones((6, 1))), adapted(light, exposure.target))
    assert scores.clipped.mean() <= MOST_CLIPPED and scores.dark.max() == 0


def test_a_tour_through_a_dim_room_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    room = """<shape type="cube"><transform name="to_world"><scale x="2.5" y="1.3" z="2"/></transform>
        <bsdf type="twosided"><bsdf type="diffuse"/></bsdf></shape>"""
    lamp = """<emitter type="point"><point name="position" x="0.3" y="1.1" z="0.2"/>
        <rgb name="intensity" value="0.01"/></emitter>"""
    scene = write_scene(tmp_path, room, lamp)
    out = tmp_path / "tour.yaml"
    assert main(["motion", "suggest", str(scene), "--out", str(out), "--seconds", "4"]) == 0
    gain = yaml.safe_load(out.read_text())["color"]["exposure_gain"]
    assert gain > 10 and f"exposure gain of {gain:g}" in capsys.readouterr().out
