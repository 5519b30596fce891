"""Scene files of Mitsuba 0.x: they render as the same scene in Mitsuba 3's words, and say what they lost."""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from nightly import sampled
from rendering import dr, mi

from rsgen.errors import UserError
from rsgen.formats.mitsuba_xml import Changes
from rsgen.formats.mitsuba_xml.upgrade import upgrade
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.render.images import ColorRenderer
from rsgen.scene.loading import content_hash, load_scene
from rsgen.scene.xml_scene import older_version, plugin_finder

CAMERA = Camera(80, 60, 60.0, 60.0, 39.5, 29.5)


def write(folder: Path, text: str, version: str = "0.6.0", name: str = "scene.xml") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / name
    path.write_text(f'<?xml version="1.0" encoding="utf-8"?>\n<scene version="{version}">{text}</scene>')
    return path


def upgraded(folder: Path, text: str, version: str = "0.6.0") -> tuple[str, Changes]:
    path = write(folder, text, version)
    number = older_version(path)
    assert number is not None
    xml, changes = upgrade(path, number, plugin_finder(mi))
    return xml.decode(), changes


def image(scene: Any) -> np.ndarray:
    """Path-traced, from z = 4 down to the origin."""
    pose = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 4], [0, 0, 0, 1]])
    renderer = ColorRenderer(scene, mi.load_dict({"type": "path", "max_depth": 4}), CAMERA, Shutter(), 4)
    return renderer.render(lambda t: np.broadcast_to(pose, (len(np.atleast_1d(t)), 4, 4)), 0.0, 1)


# A surface of an old file, and what it becomes in Mitsuba 3.
SURFACES = {
    "srgb": (
        '<bsdf type="diffuse"><srgb name="reflectance" value="#ff8000"/></bsdf>',
        '<bsdf type="diffuse"><rgb name="reflectance" value="1, 0.2158605, 0"/></bsdf>',
    ),
    "old name of a colour": (
        '<bsdf type="diffuse"><spectrum name="diffuseReflectance" value="0.1, 0.2, 0.7"/></bsdf>',
        '<bsdf type="diffuse"><rgb name="reflectance" value="0.1, 0.2, 0.7"/></bsdf>',
    ),
    "phong": (
        '<bsdf type="phong"><rgb name="diffuseReflectance" value="0.6 0.1 0.2"/></bsdf>',
        '<bsdf type="blendbsdf"><float name="weight" value="0.25"/><bsdf type="diffuse">'
        '<rgb name="reflectance" value="0.8, 0.1333333, 0.2666667"/></bsdf><bsdf type="roughconductor">'
        '<string name="material" value="none"/><float name="alpha" value="0.125"/>'
        '<rgb name="specular_reflectance" value="0.8"/></bsdf></bsdf>',
    ),
    "coating": (
        '<bsdf type="coating"><float name="intIOR" value="1.7"/><bsdf type="diffuse">'
        '<rgb name="reflectance" value="0.1, 0.6, 0.2"/></bsdf></bsdf>',
        '<bsdf type="diffuse"><rgb name="reflectance" value="0.1, 0.6, 0.2"/></bsdf>',
    ),
    "mixturebsdf": (
        '<bsdf type="mixturebsdf"><string name="weights" value="0.5, 0.3, 0.2"/>'
        '<bsdf type="diffuse"><rgb name="reflectance" value="1, 0, 0"/></bsdf>'
        '<bsdf type="diffuse"><rgb name="reflectance" value="0, 1, 0"/></bsdf>'
        '<bsdf type="diffuse"><rgb name="reflectance" value="0, 0, 1"/></bsdf></bsdf>',
        '<bsdf type="diffuse"><rgb name="reflectance" value="0.5, 0.3, 0.2"/></bsdf>',
    ),
    "difftrans": (
        '<bsdf type="difftrans"><spectrum name="transmittance" value="0.8"/></bsdf>',
        '<bsdf type="twosided"><bsdf type="diffuse"><rgb name="reflectance" value="0.8"/></bsdf></bsdf>',
    ),
    "texture": (
        '<bsdf type="diffuse"><texture type="ldrtexture" name="reflectance"><string name="filename" value="dots.png"/>'
        '<float name="uscale" value="3"/><float name="voffset" value="0.25"/><float name="vscale" value="2"/>'
        '<string name="filterType" value="trilinear"/></texture></bsdf>',
        '<bsdf type="diffuse"><texture type="bitmap" name="reflectance"><string name="filename" value="dots.png"/>'
        '<transform name="to_uv"><scale x="3" y="2"/><translate y="0.25"/></transform></texture></bsdf>',
    ),
    "scaled colour": (
        '<bsdf type="diffuse"><texture type="scale" name="reflectance"><float name="scale" value="0.5"/>'
        '<rgb name="value" value="0.8, 0.4, 0.2"/></texture></bsdf>',
        '<bsdf type="diffuse"><rgb name="reflectance" value="0.4, 0.2, 0.1"/></bsdf>',
    ),
    "bumpmap": (
        '<bsdf type="bumpmap"><texture type="scale"><float name="scale" value="0.3"/><texture type="bitmap">'
        '<string name="filename" value="dots.png"/></texture></texture><bsdf type="diffuse"/></bsdf>',
        '<bsdf type="bumpmap"><texture type="bitmap" name="it"><string name="filename" value="dots.png"/></texture>'
        '<float name="scale" value="0.3"/><bsdf type="diffuse"/></bsdf>',
    ),
}


def test_an_old_file_renders_as_the_same_scene_in_the_words_of_mitsuba_3(tmp_path: Path) -> None:
    trimesh.creation.icosphere(2).export(tmp_path / "ball.ply")
    old = """
        <integrator type="bdpt"><integer name="maxDepth" value="7"/></integrator>
        <sensor type="perspective"><float name="nearClip" value="1"/><sampler type="halton"/></sensor>
        <default name="grey" value="0.35"/>
        <medium type="homogeneous" id="fog"><rgb name="sigmaT" value="1"/></medium>
        <bsdf type="roughcoating" id="shiny"><bsdf type="plastic" id="inner"><float name="intIOR" value="1.3"/>
            <rgb name="diffuseReflectance" value="$grey"/></bsdf></bsdf>
        <shape type="ply"><string name="filename" value="ball.ply"/><boolean name="faceNormals" value="true"/>
            <animation name="toWorld">
                <transform time="0"><scale value="0.4"/><translate z="0.5"/></transform></animation>
            <ref id="shiny"/><ref name="interior" id="fog"/><subsurface type="dipole"/></shape>
        <shape type="rectangle"/>
        <emitter type="point"><spectrum name="intensity" value="20"/><point name="position" z="3"/></emitter>
        <include filename="sky.xml"/>"""
    new = """
        <shape type="ply"><string name="filename" value="ball.ply"/><boolean name="face_normals" value="true"/>
            <transform name="to_world"><scale value="0.4"/><translate z="0.5"/></transform>
            <bsdf type="plastic"><float name="int_ior" value="1.3"/>
                <rgb name="diffuse_reflectance" value="0.35"/></bsdf></shape>
        <shape type="rectangle"/>
        <emitter type="point"><rgb name="intensity" value="20"/><point name="position" x="0" y="0" z="3"/></emitter>
        <emitter type="constant"><rgb name="radiance" value="0.2"/></emitter>"""
    write(tmp_path, '<luminaire type="constant"><spectrum name="radiance" value="0.2"/></luminaire>', name="sky.xml")
    ours, theirs = image(load_scene(write(tmp_path, old))), image(load_scene(write(tmp_path, new, "3.0.0", "new.xml")))
    assert theirs.std() > 0.05 and np.isfinite(ours).all()
    np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", sampled(SURFACES, 3))
def test_each_surface_alone_from_both_sides(tmp_path: Path, name: str) -> None:
    mi.Bitmap(np.random.default_rng(1).integers(0, 255, (8, 8, 3)).astype(np.uint8)).write(str(tmp_path / "dots.png"))
    images = []
    for bsdf, version, pose in zip(SURFACES[name], ("0.5.0", "3.0.0"), ("toWorld", "to_world"), strict=True):
        turned = f'<transform name="{pose}"><rotate y="1" angle="180"/><translate x="2.2"/></transform>'
        text = f'<shape type="rectangle">{bsdf}</shape><shape type="rectangle">{turned}{bsdf}</shape>'
        light = '<emitter type="constant"><rgb name="radiance" value="1"/></emitter>'
        images.append(image(load_scene(write(tmp_path, text + light, version, f"{version}.xml"))))
    assert images[0].max() > 0.1
    np.testing.assert_allclose(images[0], images[1], rtol=1e-4, atol=1e-5)


def test_what_is_lost_is_said_once_counted_and_nothing_else_is(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    path = write(
        tmp_path,
        """<integrator type="path"/><sensor type="perspective"><film type="hdrfilm"/></sensor>
        <bsdf type="irawan" id="cloth"><string name="filename" value="gone.wv"/></bsdf>
        <shape type="cube"><ref id="cloth"/><integer name="mystery" value="3"/></shape>
        <shape type="cube"><bsdf type="conductor"><float name="extEta" value="1.2"/></bsdf></shape>
        <shape type="cube"><bsdf type="conductor"><float name="extEta" value="1.3"/></bsdf>
            <ref id="fog" name="exterior"/>
            <boolean name="flipNormals" value="true"/><boolean name="flipNormals" value="false"/></shape>
        <shape type="hair"><string name="filename" value="gone.hair"/></shape>
        <medium type="heterogeneous" id="fog"/>
        <emitter type="collimated"/><emitter type="constant"/>""",
    )
    with caplog.at_level(logging.INFO, "rsgen"):
        load_scene(path)
    assert [record.getMessage() for record in caplog.records] == [
        f"scene {path}: upgraded from Mitsuba 0.6; dropped: medium, repeated flip_normals, shape hair, "
        "emitter collimated, 2 x ext_eta of conductor, mystery of cube; replaced: bsdf irawan by diffuse; "
        "not used: integrator, sensor"
    ]
    assert capfd.readouterr() == ("", "")


def test_an_upgrade_without_loss_is_silent(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for version in ("0.5.0", "2.1.0", "3.0.0"):
        names = ("toWorld", "flipNormals") if version == "0.5.0" else ("to_world", "flip_normals")
        inside = f'<transform name="{names[0]}"/><boolean name="{names[1]}" value="true"/>'
        with caplog.at_level(logging.INFO, "rsgen"):
            load_scene(
                write(tmp_path / version, f'<sensor type="perspective"/><shape type="cube">{inside}</shape>', version)
            )
    assert not caplog.records


def test_files_of_mitsuba_3_are_refused_at_an_unknown_property_as_before(tmp_path: Path) -> None:
    cube = '<shape type="cube"><float name="sise" value="2"/></shape>'
    load_scene(write(tmp_path, cube, "2.0.0"))
    with pytest.raises(UserError, match="sise"):
        load_scene(write(tmp_path, cube, "3.0.0"))


def test_black_bodies_follow_planck(tmp_path: Path) -> None:
    inside = '<blackbody name="radiance" temperature="5000K" scale="2"/>'
    xml, changes = upgraded(tmp_path, f'<emitter type="constant">{inside}</emitter>')
    assert not changes.lossy
    spectrum = dict(pair.split(":") for pair in re.findall(r"\d+:[^,\"]+", xml))
    assert float(spectrum["500"]) == pytest.approx(2 * 12107, rel=2e-3)  # W m^-2 sr^-1 nm^-1
    colours = []
    for kelvin in (2700, 6500, 15000):
        inside = f'<blackbody name="radiance" temperature="{kelvin}"/>'
        shown = image(load_scene(write(tmp_path, f'<shape type="cube"/><emitter type="constant">{inside}</emitter>')))
        colours.append(shown[0, 0] / shown[0, 0].max())
    assert colours[0][0] == 1 and colours[0][2] < 0.25  # an incandescent lamp is orange
    np.testing.assert_allclose(colours[1], 1, atol=0.06)  # daylight nearly white
    assert colours[2][2] == 1 and colours[2][0] < 0.75


def brightest(scene: Any) -> np.ndarray:
    """Unit direction towards the brightest part of a scene's sky."""
    d = np.random.default_rng(0).normal(size=(3, 200_000))
    d /= np.linalg.norm(d, axis=0)
    si = dr.zeros(mi.SurfaceInteraction3f, d.shape[1])
    si.wi = mi.Vector3f(-d.astype(np.float32))
    light = np.array(scene.emitters()[0].eval(si)).sum(axis=0)
    mean = (d * np.where(light > 0.2 * light.max(), light, 0)).sum(axis=1)
    return mean / np.linalg.norm(mean)


def test_the_sun_stands_where_it_stood(tmp_path: Path) -> None:
    sun = '<emitter type="{}"><float name="sunRadiusScale" value="9"/>{}</emitter><shape type="cube"/>'
    # In Tokyo at three o'clock on the 10th of July it is in the west, 46 degrees high: -x, where east was x and up y.
    by_hour = brightest(load_scene(write(tmp_path, sun.format("sun", ""))))
    np.testing.assert_allclose(by_hour, [-0.69, 0.72, 0.05], atol=0.03)
    given = '<vector name="sunDirection" x="0.3" y="0.5" z="-0.8"/>'
    turned = given + '<transform name="toWorld"><rotate y="1" angle="70"/></transform>'
    for text in (given, turned):  # the direction is the world's
        found = brightest(load_scene(write(tmp_path, sun.format("sunsky", text))))
        np.testing.assert_allclose(found, np.array([0.3, 0.5, -0.8]) / np.sqrt(0.98), atol=0.03)
    sky, changes = upgraded(tmp_path, sun.format("sky", '<float name="scale" value="3"/>'))
    assert 'name="sun_scale" value="0"' in sky and 'name="sky_scale" value="3"' in sky
    assert list(changes.replaced) == ["emitter sky by the sunsky of Mitsuba 3"]


def test_skies_of_mitsuba_3_that_call_themselves_2_stay_as_they_are(tmp_path: Path) -> None:
    xml, changes = upgraded(tmp_path, '<emitter type="sunsky"/><shape type="cube"/>', "2.0.0")
    assert "matrix" not in xml and not changes.lossy


def test_textures_without_counterpart(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "b.png").write_bytes(b"")
    xml, changes = upgraded(
        tmp_path,
        """<texture type="wireframe" id="wire"><rgb name="interiorColor" value="0.1"/></texture>
        <texture type="bitmap" id="image"><string name="filename" value="a\\b.png"/>
            <string name="wrapModeU" value="zero"/><float name="gamma" value="1"/></texture>
        <texture type="scale" id="scaled"><ref id="image"/><float name="scale" value="0.5"/></texture>
        <bsdf type="diffuse"><ref name="reflectance" id="scaled"/></bsdf>
        <bsdf type="roughplastic"><texture name="alpha" type="checkerboard"/>
            <string name="distribution" value="as"/></bsdf>
        <bsdf type="normalmap"><texture type="bitmap"/><bsdf type="diffuse"/></bsdf>""",
    )
    assert '<texture type="srgb" id="wire"><rgb value="0.1" name="color" /></texture>' in xml
    assert 'value="a/b.png"' in xml and '<ref name="reflectance" id="scaled"' in xml
    assert xml.count('name="raw" value="true"') == 3 and 'type="bitmap" name="normalmap"' in xml
    assert changes.dropped == {"alpha texture of roughplastic": 1}
    assert changes.replaced == {
        "texture wireframe by one colour": 1,
        "wrap mode zero by clamp": 2,
        "distribution as by beckmann": 1,
    }


def test_names_of_before_0_4(tmp_path: Path) -> None:
    light = '<luminaire type="area"><rgb name="intensity" value="3"/></luminaire>'
    scene = load_scene(write(tmp_path, f'<camera type="perspective"/><shape type="sphere">{light}</shape>', "0.3.0"))
    assert scene.shapes()[0].is_emitter() and image(scene)[29, 39] == pytest.approx([3, 3, 3])


def test_files_are_found_as_mitsuba_finds_them(tmp_path: Path) -> None:
    box = trimesh.creation.box((1, 1, 1))
    for name in ("here", "parts/beside", "shared/far"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        box.export(tmp_path / f"{name}.ply")
    (tmp_path / "shared" / "grey.spd").write_text("400 0.5\n700 0.5\n")
    meshes = "".join(f'<shape type="ply"><string name="filename" value="{name}.ply"/>PAINT</shape>' for name in
                     ("here", "beside", "far"))  # fmt: skip
    paint = '<bsdf type="diffuse"><spectrum name="reflectance" filename="grey.spd"/></bsdf>'
    write(tmp_path / "parts", '<include filename="more.xml"/>', name="all.xml")
    write(tmp_path / "parts", meshes.replace("PAINT", paint), "2.0.0", name="more.xml")
    for version in ("0.6.0", "2.1.0"):
        path = write(tmp_path, '<path value="shared"/><include filename="parts/all.xml"/>', version)
        assert len(load_scene(path).shapes()) == 3
        hashes = [content_hash(path), content_hash(path)]
        (tmp_path / "shared" / "grey.spd").write_text(f"400 0.5\n700 0.{version[0]}1\n")
        hashes.append(content_hash(path))
        more = tmp_path / "parts" / "more.xml"
        more.write_text(more.read_text() + "\n")
        hashes.append(content_hash(path))
        trimesh.creation.box((1, 1, 2 + int(version[0]))).export(tmp_path / "here.ply")
        hashes.append(content_hash(path))
        assert hashes[0] == hashes[1] and len(set(hashes)) == 4


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<shape", "not well-formed"),
        ('<include filename="gone.xml"/>', "gone.xml.*cannot be read.*mend its path"),
        ('<include filename="scene.xml"/>', "include one another: end the circle"),
        ('<shape type="cube"><bsdf type="diffuse"><rgb name="reflectance" value="red"/></bsdf></shape>', "'red'.*mend"),
        ('<shape type="cube"><ref id="nobody"/></shape>', "nobody"),
        ('<shape type="teapot"/>', "no surfaces"),
    ],
    ids=["xml", "include", "circle", "number", "reference", "shapes"],
)
def test_old_files_that_cannot_be_upgraded(tmp_path: Path, text: str, words: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(UserError) as caught:
        load_scene(path)
    message = str(caught.value)
    assert "\n" not in message and len(message) < 600
    assert re.search(f"scene .*scene.xml: .*{words}", message), message
