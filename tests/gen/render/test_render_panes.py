"""What is seen through glass, and in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lit import bake, scene_of
from nightly import sampled
from rendering import constant_twist, mi

from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.render.baked import BakedIntegrator
from rsgen.render.images import ColorRenderer
from rsgen.render.irradiance import IrradianceField

CAMERA = Camera(32, 24, 30.0, 30.0, 15.5, 11.5)
BEFORE, BEHIND = 40.0, 0.3  # radiance of what the pane shows as a mirror, and of what is seen through it


def wall(z: float, turned: str, radiance: float) -> str:
    return f"""<shape type="rectangle"><transform name="to_world"><scale value="20"/>{turned}<translate z="{z}"/>
        </transform><bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf>
        <emitter type="area"><rgb name="radiance" value="{radiance}"/></emitter></shape>"""


WALLS = wall(-1.0, "", BEFORE), wall(3.0, '<rotate y="1" angle="180"/>', BEHIND)
GLASS = '<bsdf type="{}"><float name="int_ior" value="1.5"/><float name="ext_ior" value="1.0"/></bsdf>'


def seen(scene: Any, integrator: Any, spp: int, seed: int) -> np.ndarray:
    return ColorRenderer(scene, integrator, CAMERA, Shutter(), spp).render(constant_twist(np.zeros(6)), 0.0, seed)


def test_a_bright_reflection_in_a_pane_is_no_speckle(tmp_path: Path) -> None:
    """Each pixel is R times what is before the pane and 1 - R times what is behind, by Fresnel, at 16 samples."""
    pane = f"""<shape type="rectangle"><transform name="to_world"><scale value="20"/><translate z="1"/></transform>
        {GLASS.format("thindielectric")}</shape>"""
    scene = scene_of(tmp_path, *WALLS, pane)
    image = seen(scene, BakedIntegrator(IrradianceField(*bake(scene, texel_m=2.0, direct_samples=4))), 16, 1)
    ray = CAMERA.unproject(CAMERA.pixel_grid())
    c = 1 / np.linalg.norm(ray, axis=-1)
    refracted = np.sqrt(1 - (1 - c**2) / 1.5**2)
    s, p = (c - 1.5 * refracted) / (c + 1.5 * refracted), (1.5 * c - refracted) / (1.5 * c + refracted)
    once = (s**2 + p**2) / 2
    R = 2 * once / (1 + once)  # to and fro within the pane
    expected = R * BEFORE + (1 - R) * BEHIND
    np.testing.assert_allclose(image, np.repeat(expected[..., None], 3, axis=2), rtol=2e-3)


@pytest.mark.parametrize("kind", sampled(["dielectric", "roughdielectric"], 2))
def test_thick_glass_is_as_the_path_tracer_has_it(kind: str, tmp_path: Path) -> None:
    """A block, with total reflection within: nothing is counted twice. Frosted glass too."""
    block = f"""<shape type="cube"><transform name="to_world"><scale x="0.25" y="0.2" z="0.3"/><rotate y="1" x="0.4"
        angle="35"/><translate z="1.2"/></transform>{GLASS.format(kind)}</shape>"""
    scene = scene_of(tmp_path, *WALLS, block)
    ours = BakedIntegrator(IrradianceField(*bake(scene, texel_m=2.0, direct_samples=4)), glossy_spp=512)
    path = mi.load_dict({"type": "path", "max_depth": 18})
    baked, traced = (np.mean([seen(scene, i, 512, k) for k in range(2)], axis=0) for i in (ours, path))
    assert traced[8:16, 12:20].min() > 5 * BEHIND  # the block is in the middle, and both walls in it
    assert baked.mean() == pytest.approx(traced.mean(), rel=0.02)
    np.testing.assert_allclose(baked.mean(axis=1), traced.mean(axis=1), rtol=0.15)
