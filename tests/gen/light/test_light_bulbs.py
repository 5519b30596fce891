"""Lamps inside glass."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lit import FLOOR, UP, floor_grid, lookup, scene_of, silent
from rendering import mi

from rsgen.config.config import LightConfig
from rsgen.device.arrays import vectors
from rsgen.light.bake import baked_field
from rsgen.light.lamps import bulbs

HEIGHT_M = 0.6
XYZ = floor_grid(count=9) + 0.005 * UP


def ball(name: str, radius: float, inside: str, height: float = HEIGHT_M) -> str:
    return f"""<shape type="sphere" id="{name}"><point name="center" x="0" y="0" z="{height}"/>
        <float name="radius" value="{radius}"/>{inside}</shape>"""


def glass(colour: str = "1", kind: str = "dielectric") -> str:
    return f'<bsdf type="{kind}"><rgb name="specular_transmittance" value="{colour}"/></bsdf>'


SHADE = ball("shade", 0.08, glass("0.8", "roughdielectric"))
BLACK = '<bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf>'
FILAMENT = ball("filament", 0.01, BLACK + '<emitter type="area"><rgb name="radiance" value="100,200,300"/></emitter>')
SOCKET = f"""<shape type="cylinder" id="socket"><point name="p0" x="0" y="0" z="{HEIGHT_M + 0.02}"/>
    <point name="p1" x="0" y="0" z="{HEIGHT_M + 0.1}"/><float name="radius" value="0.012"/>{BLACK}</shape>"""


def floor_light(folder: Path, scene: Any) -> np.ndarray:
    light = LightConfig(texel_m=0.2, bounces=0, gather_rays=16, direct_samples=256)
    field = baked_field(scene, "of these", light, folder / f"cache {len(scene.shapes())}", silent)
    return lookup(scene, field, XYZ, -UP)[1]


@pytest.mark.nightly
def test_a_lamp_in_bulbs_shines_as_if_these_did_nothing_but_colour_it(tmp_path: Path) -> None:
    """And afterwards they are glass again. A path tracer finds as much light on the floor, but for what a small bulb's
    glass holds back at first and the filament takes.
    """
    bare = floor_light(tmp_path, scene_of(tmp_path, FLOOR, FILAMENT, SOCKET))
    got = floor_light(
        tmp_path, scene_of(tmp_path, FLOOR, FILAMENT, SOCKET, ball("bulb", 0.03, glass("0.9,0.5,0.2")), SHADE)
    )
    np.testing.assert_allclose(got, bare * np.array([0.9, 0.5, 0.2]) * 0.8, rtol=0.02)

    scene = scene_of(tmp_path, FLOOR, FILAMENT, ball("bulb", 0.03, glass()))
    before = [str(shape.bsdf()) for shape in scene.shapes()]
    got = floor_light(tmp_path, scene)
    assert [str(shape.bsdf()) for shape in scene.shapes()] == before
    rays = 1 << 14
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, len(XYZ) * rays)
    origin = vectors(mi.Point3f, np.repeat(XYZ, rays, axis=0))
    ray = mi.Ray3f(origin, mi.warp.square_to_cosine_hemisphere(sampler.next_2d()))
    path = mi.load_dict({"type": "path", "max_depth": 10})
    traced = np.pi * np.array(path.sample(scene, sampler, ray, None, mi.Bool(True))[0])
    assert got.mean() == pytest.approx(traced.mean(), rel=0.06)


@pytest.mark.parametrize(
    ("elements", "found"),
    [
        ([FILAMENT, ball("bulb", 0.03, glass())], ["bulb"]),
        ([FILAMENT, SOCKET, ball("bulb", 0.03, glass()), SHADE], ["bulb", "shade"]),
        ([FILAMENT, ball("pane", 0.03, '<bsdf type="thindielectric"/>')], []),  # straight on anyway
        ([FILAMENT, ball("beside", 0.03, glass(), HEIGHT_M + 0.05)], []),
        ([FILAMENT, ball("house", 0.5, glass())], []),
        ([FILAMENT, ball("shade", 0.03, BLACK), ball("bulb", 0.08, glass())], []),
    ],
    ids=["bulb", "two", "thin", "beside", "house", "dark"],
)  # fmt: skip
def test_what_a_bulb_is(elements: list[str], found: list[str], tmp_path: Path) -> None:
    assert sorted(shape.id() for shape in bulbs(scene_of(tmp_path, *elements))) == found
