"""Scenes that are bad: one line for each, no memory taken and nothing on the screen; what is harmless loads."""

from __future__ import annotations

import logging
import re
import tracemalloc
import warnings
from pathlib import Path

import numpy as np
import pytest
import tiny
import trimesh
from rendering import mi
from scene_files import fails, hits, rays_at, write_scene

from rsgen.config.config import LightConfig, load_config
from rsgen.errors import UserError
from rsgen.light.bake import bake
from rsgen.produce.parts import make_integrator
from rsgen.render import irradiance
from rsgen.render.irradiance import IrradianceField, lattice_area, lattice_barycentric, make_lattice
from rsgen.scene.loading import load_scene
from rsgen.scene.meshes import ply_bytes, surface
from rsgen.scene.xml_scene import messages_to_log


@pytest.mark.parametrize(
    "shape",
    [
        '<shape type="bsplinecurve"><string name="filename" value="curves.txt"/></shape>',
        '<shape type="linearcurve"><string name="filename" value="curves.txt"/></shape>',
        '<shape type="sdfgrid"><string name="filename" value="grid.vol"/></shape>',
    ],
    ids=["bsplinecurve", "linearcurve", "sdfgrid"],
)
def test_shapes_that_cannot_become_triangles(tmp_path: Path, shape: str) -> None:
    fails(write_scene(tmp_path, shape), "cannot become triangles: export it as a mesh")


def test_bad_scene_files(tmp_path: Path) -> None:
    fails(tmp_path / "absent.xml", "no such file")
    fails(tmp_path / "absent.ply", "no such file")
    fails(write_scene(tmp_path / "unknown", '<shape type="nonsense"/>'), "nonsense")
    fails(write_scene(tmp_path / "property", '<shape type="cube"><float name="sise" value="2"/></shape>'), "sise")
    missing = write_scene(tmp_path / "missing", '<shape type="ply"><string name="filename" value="gone.ply"/></shape>')
    fails(missing, "gone.ply")
    for name, content in {
        "truncated.xml": b'<scene version="3.0.0"><shape type="cube">',
        "words.xml": b"this is not a scene",
        "empty.xml": b"",
        "binary.xml": bytes(range(256)),
        "words.ply": b"this is not a mesh",
        "empty.obj": b"",
        "truncated.ply": b"ply\nformat binary_little_endian 1.0\nelement vertex 5\nproperty float x\nend_header\n\0\0",
        "unknown.mesh7": b"?",
    }.items():
        (tmp_path / name).write_bytes(content)
        fails(tmp_path / name)


def test_scenes_without_surfaces(tmp_path: Path) -> None:
    fails(write_scene(tmp_path / "empty"), "no surfaces", "add a shape")
    fails(write_scene(tmp_path / "sky", '<emitter type="constant"/>'), "no surfaces")
    points = tmp_path / "points.ply"
    trimesh.PointCloud(np.eye(3)).export(points)
    fails(points)


@pytest.mark.parametrize("value", ["nan", "inf"])
def test_vertices_that_are_not_finite(tmp_path: Path, value: str) -> None:
    mesh = tmp_path / "bad.obj"
    mesh.write_text(f"v 0 0 0\nv 1 0 0\nv 0 {value} 0\nf 1 2 3\n")
    fails(mesh, "finite")
    folder = tmp_path / "xml"
    path = write_scene(folder, '<shape type="ply"><string name="filename" value="bad.ply"/></shape>')
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, float(value), 0]])
    (folder / "bad.ply").write_bytes(ply_bytes(vertices, np.array([[0, 1, 2]])))
    fails(path, "bad.ply.*invalid vertex position")


def scene_dict(folder: Path, name: str, content: bytes, more: str = "") -> Path:
    path = write_scene(folder, f'<shape type="{name[-3:]}"><string name="filename" value="{name}"/>{more}</shape>')
    (folder / name).write_bytes(content)
    return path


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("cut.ply", ply_bytes(np.eye(3), np.array([[0, 1, 2]]))[:-9], "shape ply 'cut.ply'.*export it anew"),
        ("bare.ply", ply_bytes(np.zeros((0, 3)), np.zeros((0, 3), int)), "shape ply 'bare.ply'.*export it anew"),
        ("far.ply", ply_bytes(np.eye(3), np.array([[0, 1, 7]])), "names vertex 7 of 3: export it anew"),
        ("line.ply", ply_bytes(np.eye(3), np.array([[0, 1, 1]])), "no triangle of it has an area: export"),
        ("words.obj", b"this is no mesh\n", "shape obj 'words.obj'.*export it anew"),
    ],
    ids=["cut", "empty", "indices", "line", "words"],
)
def test_meshes_that_are_broken(tmp_path: Path, name: str, content: bytes, words: str) -> None:
    fails(scene_dict(tmp_path, name, content), words)


def test_images_that_are_missing_or_broken(tmp_path: Path) -> None:
    image = '<texture type="bitmap" name="reflectance"><string name="filename" value="a.png"/></texture>'
    path = write_scene(tmp_path, f'<shape type="cube"><bsdf type="diffuse">{image}</bsdf></shape>')
    fails(path, "file 'a.png' that it names is missing: put it there, mend its path")
    (tmp_path / "a.png").write_bytes(b"\x89PNG and no more")
    fails(path, "texture bitmap 'a.png'.*save the image anew")


@pytest.mark.parametrize("plugin", ["cube", "rectangle", "sphere"])
@pytest.mark.parametrize("to_world", ['<scale y="0"/>', '<translate x="nan"/>'], ids=["flat", "nan"])
def test_transforms_that_squash_a_shape(tmp_path: Path, plugin: str, to_world: str) -> None:
    pose = f'<transform name="to_world">{to_world}</transform>'
    fails(write_scene(tmp_path, f'<shape type="{plugin}" id="wall">{pose}</shape>'), "shape 'wall'.*scale no axis by 0")


def test_plugins_that_do_not_exist(tmp_path: Path) -> None:
    fails(write_scene(tmp_path / "a", '<shape type="cube"><bsdf type="zork"/></shape>'), "bsdf zork: .*no such plugin")
    fails(write_scene(tmp_path / "b", '<shape type="cube"/><emitter type="zork"/>'), "emitter zork: .*no such plugin")


def test_triangles_without_area_and_normals_without_direction_are_harmless(tmp_path: Path) -> None:
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [0, -1, 0]], float)
    faces = np.array([[0, 1, 2], [0, 4, 1], [2, 2, 2], [0, 2, 3]])
    normals = np.tile([0, 0, 1.0], (5, 1))
    good = ply_bytes(corners, faces, normals)
    start = good.index(b"end_header\n") + len(b"end_header\n")
    table = np.frombuffer(good, "<f4", 30, start).reshape(5, 6).copy()
    table[1, 3:], table[2, 3:] = np.nan, 0
    line = '<shape type="ply" id="line"><string name="filename" value="line.ply"/></shape>'
    (tmp_path / "line.ply").write_bytes(ply_bytes(corners, np.array([[0, 4, 1]])))
    path = scene_dict(tmp_path, "it.ply", good[:start] + table.tobytes() + good[start + 120 :])
    path.write_text(path.read_text().replace("</scene>", f'{line}<emitter type="constant"/></scene>'))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = load_scene(path)
        assert len(scene.shapes()) == 1 and len(scene.emitters()) == 1
        np.testing.assert_array_equal(surface(scene)[1], faces[[0, 3]])
        ray = rays_at(np.zeros(3), 0.9)
        found = hits(scene, ray)
        light = LightConfig(texel_m=0.2, bounces=1, direct_samples=4, gather_rays=16)
        baked = bake(scene, make_lattice(scene, light.texel_m), light, lambda *_: None)
    seen = found["valid"]
    through = np.array(ray.o).T - np.array(ray.d).T * (np.array(ray.o.z) / np.array(ray.d.z))[:, None]
    assert seen.mean() > 0.3 and np.mean(seen != (np.abs(through) < 1).all(axis=1)) < 1e-3
    np.testing.assert_allclose(np.abs(found["sh_n"][seen]), np.tile([0, 0, 1.0], (seen.sum(), 1)), atol=1e-6)
    for side in baked:
        assert np.isfinite(side).all() and side[:, :3].mean() == pytest.approx(np.pi, rel=0.1)  # under a sky of 1


def test_light_that_would_not_fit_is_refused_before_memory_is_taken(tmp_path: Path) -> None:
    scene = load_scene(write_scene(tmp_path, '<shape type="rectangle"/>'))
    size = '<transform name="to_world"><scale value="300"/></transform>'
    large = load_scene(write_scene(tmp_path, *(f'<shape type="cube">{size}</shape>' for _ in range(2))))
    make_lattice(scene, 1.2e-3)
    tracemalloc.start()
    with pytest.raises(UserError, match=r"light.texel_m 0.015 needs .* GB.*set it to (\S+) or more") as caught:
        make_lattice(large, 0.015)
    assert tracemalloc.get_traced_memory()[1] < 1e6
    tracemalloc.stop()
    named = re.search(r"set it to (\S+) or", str(caught.value))
    assert named is not None
    fits = float(named[1])
    tracemalloc.start()
    points = make_lattice(large, fits).points
    tracemalloc.stop()
    # Two digits are named, rounded up: at most a tenth coarser than need be.
    assert 4e9 / 400 / 1.1**2 < points <= 4e9 / 400 and "\n" not in str(caught.value)
    config = load_config(tiny.write_config(tmp_path, light={"texel_m": 0.015}))
    with pytest.raises(UserError, match=r"^scene .*scene\.xml: light\.texel_m"):
        make_integrator(mi, large, config, lambda *_: None)


def test_nothing_reaches_the_screen_while_a_scene_loads(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    path = write_scene(tmp_path, '<shape type="cube"><bsdf type="twosided"><bsdf type="diffuse"/></bsdf></shape>')
    before = mi.logger().appender_count()
    with caplog.at_level(logging.DEBUG, "rsgen"), messages_to_log(mi) as seen:
        load_scene(path)
        mi.Log(mi.LogLevel.Warn, "a warning")
    assert any("a warning" in message for message in seen) and "a warning" in caplog.text
    assert capfd.readouterr() == ("", "") and mi.logger().appender_count() == before


def test_where_triangles_are_too_many_small_ones_have_one_sample(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fine ball on a floor under an even sky: the same light, from less than half of the samples."""
    trimesh.creation.icosphere(5, 0.3).export(tmp_path / "ball.ply")
    ball = """<shape type="ply"><string name="filename" value="ball.ply"/>
        <transform name="to_world"><translate z="0.5"/></transform></shape>"""
    sky = '<emitter type="constant"><rgb name="radiance" value="1"/></emitter>'
    scene = load_scene(write_scene(tmp_path, '<shape type="rectangle"/>', ball, sky))
    light = LightConfig(texel_m=0.025, bounces=0, direct_samples=1024)
    every = make_lattice(scene, light.texel_m)
    monkeypatch.setattr(irradiance, "_MOST_POINTS", 40_000)
    few = make_lattice(scene, light.texel_m)
    assert every.points > 2 * few.points and few.points <= 40_000
    triangles = [np.bincount(lattice_barycentric(k)[0], lattice_area(scene, k)) for k in (few, every)]
    np.testing.assert_allclose(*triangles)
    fields = [IrradianceField(k, *bake(scene, k, light, lambda *_: None)) for k in (few, every)]
    ray = rays_at(np.array([0.0, 0.0, 0.5]), 0.3)
    pi = scene.ray_intersect_preliminary(ray, coherent=False)
    si = pi.compute_surface_interaction(ray, mi.RayFlags.All)
    got, expected = (np.array(f.lookup(pi, si, -ray.d))[0][np.array(si.is_valid())] for f in fields)
    off = (got - expected) / np.pi
    assert len(got) > 1000 and np.abs(off).max() < 0.1 and off.std() < 0.012 and abs(off.mean()) < 0.002
