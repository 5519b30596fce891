"""Old scenes' scaled textures and lobes that mirror: as bright as they were."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rendering import dr, mi

from rsgen import srgb
from rsgen.scene.loading import content_hash, load_scene

IMAGE = np.random.default_rng(1).integers(0, 255, (4, 4, 3)).astype(np.uint8)
COLOR = srgb.decode(IMAGE.astype(float) / 255)


def loaded(folder: Path, *elements: str, version: str = "0.6.0") -> Any:
    mi.Bitmap(IMAGE).write(str(folder / "image.png"))
    (folder / "scene.xml").write_text(f'<scene version="{version}">' + "".join(elements) + "</scene>")
    return load_scene(folder / "scene.xml")


def shown(scene: Any, name: str = "reflectance") -> np.ndarray:
    """What the texture of that name has at the middles of the texels (16, 3) of the last shape."""
    u, v = np.meshgrid(np.arange(0.125, 1, 0.25), np.arange(0.125, 1, 0.25))
    si = dr.zeros(mi.SurfaceInteraction3f, 16)
    si.uv = mi.Point2f(u.ravel().astype(np.float32), v.ravel().astype(np.float32))
    si.wi = mi.Vector3f(0, 0, 1)
    shape = scene.shapes()[-1]
    if name == "radiance":
        return np.array(shape.emitter().eval(si)).T
    return np.array(shape.bsdf().eval_diffuse_reflectance(si) + dr.zeros(mi.Color3f, 16)).T


BITMAP = """<texture type="bitmap" {}><string name="filename" value="image.png"/>
    <string name="filterType" value="nearest"/></texture>"""


def scaled(factor: str, inner: str, name: str = "reflectance") -> str:
    return f'<texture type="scale" name="{name}"><{factor}/>{inner}</texture>'


def matte(inner: str) -> str:
    return f'<shape type="rectangle"><bsdf type="diffuse">{inner}</bsdf></shape>'


NAMED = 'id="it" name="diffuseReflectance"'
HALF, TINT = 'float name="scale" value="0.5"', 'rgb name="scale" value="0.5, 1, 0.25"'


@pytest.mark.parametrize(
    ("first", "inner", "expected"),
    [
        ("", scaled(HALF, BITMAP.format("")), 0.5 * COLOR),
        ("", scaled(TINT, BITMAP.format("")), [0.5, 1, 0.25] * COLOR),
        ("", scaled(HALF, scaled(TINT, BITMAP.format(""), "value")), [0.25, 0.5, 0.125] * COLOR),
        (BITMAP.format('id="it"'), scaled(TINT, '<ref id="it"/>'), [0.5, 1, 0.25] * COLOR),
        (
            BITMAP.format('id="it"') + matte('<ref name="reflectance" id="it"/>'),
            scaled(HALF, '<ref id="it"/>'),
            0.5 * COLOR,
        ),
        ("", scaled('float name="scale" value="3"', BITMAP.format("")), np.minimum(3 * COLOR, 1)),
        ("", scaled(HALF, '<spectrum name="value" value="0.8, 0.4, 0.2"/>'), np.tile([0.4, 0.2, 0.1], (4, 4, 1))),
        ("", scaled(TINT, '<texture type="checkerboard"><rgb name="color0" value="0.8"/></texture>'), None),
    ],
    ids=["bitmap", "tint", "twice", "ref", "ref-of-two", "bright", "colour", "checkerboard"],
)
def test_scaled_textures(
    tmp_path: Path, first: str, inner: str, expected: np.ndarray | None, caplog: pytest.LogCaptureFixture
) -> None:
    scene = loaded(tmp_path, first, matte(inner))
    found = shown(scene)
    if expected is None:
        assert {tuple(row) for row in found.astype(float).round(3).tolist()} == {(0.4, 0.8, 0.2), (0.1, 0.2, 0.05)}
    else:
        np.testing.assert_allclose(found, np.reshape(expected, (16, 3)), rtol=2e-3, atol=1e-4)
    assert not caplog.records and len(content_hash(tmp_path / "scene.xml")) == 64


@pytest.mark.parametrize(
    "first",
    [
        matte(scaled(HALF, BITMAP.format('id="it"'))),
        matte(scaled(TINT, scaled(HALF, BITMAP.format('id="it"'), "value"))),
        f'<shape type="disk"><bsdf type="phong">{BITMAP.format(NAMED)}</bsdf></shape>',
    ],
    ids=["scaled", "twice", "phong"],
)
def test_a_texture_that_is_multiplied_where_it_is_defined_stays_as_it_is_for_others(tmp_path: Path, first: str) -> None:
    scene = loaded(tmp_path, first, matte('<ref name="reflectance" id="it"/>'))
    np.testing.assert_allclose(shown(scene), COLOR.reshape(16, 3), rtol=2e-3, atol=1e-4)


def test_lamps_may_be_brighter_than_their_picture(tmp_path: Path) -> None:
    lamp = scaled('float name="scale" value="7"', BITMAP.format(""), "radiance")
    scene = loaded(tmp_path, f'<shape type="rectangle"><emitter type="area">{lamp}</emitter></shape>')
    np.testing.assert_allclose(shown(scene, "radiance"), 7 * COLOR.reshape(16, 3), rtol=2e-3, atol=1e-3)


def test_more_than_all_is_not_reflected(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, "rsgen"):
        scene = loaded(tmp_path, matte('<rgb name="reflectance" value="255, 102, 51"/>'))
    np.testing.assert_allclose(shown(scene)[0], [0.99, 0.396, 0.198], rtol=1e-5)
    assert "replaced: reflectance of 255 by 0.99" in caplog.text


def albedo(bsdf: Any, cosine: float, kind: Any = None) -> np.ndarray:
    """(3,) of light from there, by sampling all of it, or one kind of lobe."""
    si = dr.zeros(mi.SurfaceInteraction3f, 1 << 16)
    si.wi = mi.Vector3f(float(np.sqrt(1 - cosine**2)), 0, float(cosine))
    rng = np.random.default_rng(3).random((3, 1 << 16)).astype(np.float32)
    context = mi.BSDFContext()
    if kind is not None:
        context.type_mask = kind
    return np.array(bsdf.sample(context, si, mi.Float(rng[0]), mi.Point2f(rng[1:]))[1]).mean(axis=1)


@pytest.mark.parametrize("n", [8, 60, 400])
def test_phong_is_as_bright_and_as_sharp_as_it_was(tmp_path: Path, n: int) -> None:
    inside = (
        '<rgb name="diffuseReflectance" value="0.3, 0.2, 0.1"/><rgb name="specularReflectance" value="0.5, 0.4, 0.2"/>'
    )
    phong = f'<bsdf type="phong">{inside}<float name="exponent" value="{n}"/></bsdf>'
    bsdf = loaded(tmp_path, f'<shape type="rectangle">{phong}</shape>').shapes()[0].bsdf()
    steep = albedo(bsdf, 0.98)
    np.testing.assert_allclose(steep, [0.8, 0.6, 0.3], rtol=0.03)
    assert (albedo(bsdf, 0.2) < 0.81).all()
    # Its own formula (Lafortune and Willems 1994), at angles from the mirrored direction, seen from straight above.
    angle = np.linspace(0, 1.2 / np.sqrt(n), 20)
    si = dr.zeros(mi.SurfaceInteraction3f, 20)
    si.wi = mi.Vector3f(0, 0, 1)
    got = np.array(
        bsdf.eval(
            mi.BSDFContext(), si, mi.Vector3f(np.sin(angle).astype(np.float32), 0, np.cos(angle).astype(np.float32))
        )
    ).T
    lobe = (n + 2) / (2 * np.pi) * np.cos(angle) ** n
    expected = (np.outer(lobe, [0.5, 0.4, 0.2]) + np.array([0.3, 0.2, 0.1]) / np.pi) * np.cos(angle)[:, None]
    np.testing.assert_allclose(got, expected, rtol=0.15)
    np.testing.assert_allclose(got[0], expected[0], rtol=1e-3)


def test_what_phong_adds_up_to_is_at_most_all(tmp_path: Path) -> None:
    inside = '{}<rgb name="specularReflectance" value="0.6"/><float name="exponent" value="300"/>'
    for diffuse, expected in (
        ('<rgb name="diffuseReflectance" value="0.9"/>', [0.594, 0.396]),
        (scaled(HALF, BITMAP.format(""), "diffuseReflectance"), [0.45 * COLOR[0, 0], 0.54]),  # of white: 1.1 in all
        ('<rgb name="diffuseReflectance" value="0"/>', [0.0, 0.6]),
    ):
        bsdf = loaded(tmp_path, f'<shape type="rectangle"><bsdf type="phong">{inside.format(diffuse)}</bsdf></shape>')
        found = [albedo(bsdf.shapes()[0].bsdf(), 1.0, k) for k in (mi.BSDFFlags.Diffuse, mi.BSDFFlags.Glossy)]
        np.testing.assert_allclose(found[1], np.broadcast_to(expected[1], 3), rtol=0.05)
        np.testing.assert_allclose(found[0], np.broadcast_to(expected[0], 3), rtol=0.02, atol=1e-6)


def test_ward_keeps_its_widths(tmp_path: Path) -> None:
    ward = '<bsdf type="ward"><float name="alphaU" value="0.3"/><float name="alphaV" value="0.05"/></bsdf>'
    scene = loaded(tmp_path, f'<shape type="rectangle">{ward}</shape>')
    metal = str(scene.shapes()[0].bsdf())
    assert "RoughConductor" in metal and "0.3" in metal and "0.05" in metal
    np.testing.assert_allclose(albedo(scene.shapes()[0].bsdf(), 1.0), 0.7, rtol=0.03)


@pytest.mark.parametrize("keeps", ["true", "false"])
def test_a_mixture_of_more_than_all_of_each(tmp_path: Path, keeps: str) -> None:
    parts = """<bsdf type="diffuse"><rgb name="reflectance" value="0.8, 0.4, 0.2"/></bsdf>
        <bsdf type="conductor"><string name="material" value="none"/>
        <rgb name="specularReflectance" value="0.1"/></bsdf>"""
    flag = f'<boolean name="ensureEnergyConservation" value="{keeps}"/><string name="weights" value="1, 1"/>'
    scene = loaded(tmp_path, f'<shape type="rectangle"><bsdf type="mixturebsdf">{flag}{parts}</bsdf></shape>')
    found = [albedo(scene.shapes()[0].bsdf(), 0.7, k) for k in (mi.BSDFFlags.Diffuse, mi.BSDFFlags.Delta)]
    expected = np.array([[0.8, 0.4, 0.2], 3 * [0.1]]) * (0.5 if keeps == "true" else 1)
    np.testing.assert_allclose(found, expected, rtol=0.03)


@pytest.mark.parametrize("version", ["0.6.0", "3.0.0"])
def test_blends_of_metal_are_black_from_behind_and_not_nan(tmp_path: Path, version: str) -> None:
    """NaN there would spread in baked light, over all that sees it."""
    blend = '<bsdf type="blendbsdf"><float name="weight" value="0.5"/><bsdf type="diffuse"/>{}</bsdf>'
    blend = blend.format('<bsdf type="roughconductor"/>')
    bsdf = '<bsdf type="phong"/>' if version < "3" else blend
    scene = loaded(tmp_path, f'<shape type="rectangle">{bsdf}</shape>', version=version)
    assert (albedo(scene.shapes()[0].bsdf(), -0.7) == 0).all()
    assert (albedo(scene.shapes()[0].bsdf(), 0.7) > 0.3).all()
