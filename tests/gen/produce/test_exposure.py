"""A scene that nobody has photographed: how a tour through it is exposed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from lit import scene_of, write_scene
from rendering import constant_twist

from rsgen.cli.main import main
from rsgen.geometry.camera import Camera
from rsgen.produce.tour import suggested_gain

CAMERA = Camera(640, 480, 480.0, 480.0, 319.5, 239.5)
GLOWING = """<shape type="cube"><transform name="to_world"><scale value="2"/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf><boolean name="flip_normals" value="true"/>
    <emitter type="area"><rgb name="radiance" value="{0}"/></emitter></shape>"""


@pytest.mark.parametrize(("radiance", "gain", "wanted"), [(0.002, 1.0, 90.0), (36.0, 1.0, 0.005), (0.1, 1.0, None)])
def test_the_typical_surface_is_mid_grey(radiance: float, gain: float, wanted: float | None, tmp_path: Path) -> None:
    """Walls that glow alike: mid-grey, 0.18, is the gain times what they send."""
    scene = scene_of(tmp_path, GLOWING.format(radiance))
    still = constant_twist(np.zeros(6))
    assert suggested_gain(scene, CAMERA, still, 1.0, gain) == wanted
    if wanted is not None:
        assert suggested_gain(scene, CAMERA, still, 1.0, wanted) is None


def test_bright_walls_above_a_dark_floor_are_not_white(tmp_path: Path) -> None:
    """The lower two thirds of the picture send 0.01, the rest 1: mid-grey there would be 18 times white here."""
    half = """<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="180"/><scale value="9"/>
        <translate y="{y}" z="{z}"/></transform><bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf>
        <emitter type="area"><rgb name="radiance" value="{radiance}"/></emitter></shape>"""
    scene = scene_of(tmp_path, half.format(y=0, z=2, radiance=1), half.format(y=9 - 1.9 / 6, z=1.9, radiance=0.01))
    gain = suggested_gain(scene, CAMERA, constant_twist(np.zeros(6)), 1.0, 10.0)
    assert gain == pytest.approx(0.6, rel=0.01)


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
