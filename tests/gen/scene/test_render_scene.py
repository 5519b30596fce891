"""Scenes as triangles: analytic shapes, mesh files, content hashes, and scenes that build themselves."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from rendering import mi
from scene_files import ANY_POSE, EVEN_POSE, MIRRORED, SHAPES, fails, hits, rays_at, shape_xml, write_scene

from rsgen.errors import UserError
from rsgen.image_codecs import encode_exr
from rsgen.scene.loading import content_hash, ensure_built, load_scene
from rsgen.scene.meshes import mesh_arrays, surface

# What 96 segments around leave between chord and circle: radius · (1 − cos(π / 96)).
SAGITTA = 1 - np.cos(np.pi / 96)


@pytest.mark.parametrize("flip", [False, True], ids=["", "flipped"])
@pytest.mark.parametrize("mirrored", [False, True], ids=["", "mirrored"])
@pytest.mark.parametrize("plugin", SHAPES)
def test_analytic_shapes_become_meshes_of_the_same_surface(
    tmp_path: Path, plugin: str, mirrored: bool, flip: bool
) -> None:
    pose = (MIRRORED if mirrored else "") + (ANY_POSE if SHAPES[plugin][1] else EVEN_POSE)
    glow = '<emitter type="area"><rgb name="radiance" value="1,2,3"/></emitter>'
    path = write_scene(tmp_path, shape_xml(plugin, pose, glow, flip))
    ours, stock = load_scene(path), mi.load_file(str(path))
    assert all(s.is_mesh() for s in ours.shapes())
    assert plugin == "rectangle" or not any(s.is_mesh() for s in stock.shapes())  # the reference is analytic
    ray = rays_at(np.array([0.3, -0.2, 0.4]), 0.9)
    a, b = hits(ours, ray), hits(stock, ray)
    both = a["valid"] & b["valid"]
    assert both.sum() > 300
    outline = np.mean(a["valid"] != b["valid"]) / np.mean(b["valid"])
    assert outline < 0.02
    # Grazing rays stretch the sagitta; distances to the surface itself stay below it.
    cosine = np.abs(np.einsum("ij,ij->i", b["n"], np.array(ray.d).T))
    direct = both & (cosine > 0.2)
    flat = plugin in ("rectangle", "disk")
    off = np.abs(a["t"][direct] - b["t"][direct]) * cosine[direct]
    assert off.max() < (5e-6 if flat else 2.5 * SAGITTA)
    agree = np.einsum("ij,ij->i", a["sh_n"], b["sh_n"])  # a mirrored rectangle of Mitsuba's has n = −sh_n
    assert np.quantile(agree[direct], 0.01) > (1 - 1e-6 if flat else 1 - 2e-3)
    assert np.einsum("ij,ij->i", a["n"], a["sh_n"])[direct].min() > 0.99  # winding and vertex normals agree
    # The same side glows.
    np.testing.assert_allclose(a["emitted"][direct], b["emitted"][direct])
    if plugin != "sphere":
        assert 0.1 < np.mean(a["emitted"][direct, 0] > 0) < 0.9
    else:  # a closed one shows one side only
        assert np.all((a["emitted"][direct, 0] > 0) == (flip == mirrored))
    if plugin == "rectangle":
        np.testing.assert_allclose(a["uv"][direct], b["uv"][direct], atol=2e-5)
    if plugin in ("disk", "sphere"):
        difference = np.abs(a["uv"][direct] - b["uv"][direct])
        difference = np.minimum(difference, 1 - difference)  # around the seam
        assert np.quantile(difference, 0.95) < 0.02


def test_a_shape_without_any_parameter_is_mitsubas_unit_shape(tmp_path: Path) -> None:
    for plugin, low, high in (
        ("rectangle", (-1, -1, 0), (1, 1, 0)),
        ("disk", (-1, -1, 0), (1, 1, 0)),
        ("sphere", (-1, -1, -1), (1, 1, 1)),
        ("cylinder", (-1, -1, 0), (1, 1, 1)),
    ):
        vertices, _ = surface(load_scene(write_scene(tmp_path, f'<shape type="{plugin}"/>')))
        np.testing.assert_allclose([vertices.min(axis=0), vertices.max(axis=0)], [low, high], atol=1e-6)


def test_a_converted_shape_keeps_its_bsdf_and_emitter(tmp_path: Path) -> None:
    bsdf = '<bsdf type="diffuse" id="paint"><rgb name="reflectance" value="0.1,0.5,0.9"/></bsdf>'
    glow = '<emitter type="area"><rgb name="radiance" value="1,2,3"/></emitter>'
    scene = load_scene(write_scene(tmp_path, shape_xml("disk", EVEN_POSE, bsdf + glow)))
    (shape,) = scene.shapes()
    assert shape.is_emitter() and len(scene.emitters()) == 1
    si = scene.ray_intersect(rays_at(np.array([0.3, -0.2, 0.4]), 0.2, 50))
    albedo = np.array(shape.bsdf().eval_diffuse_reflectance(si, si.is_valid())).reshape(3, -1)
    np.testing.assert_allclose(albedo.max(axis=1), [0.1, 0.5, 0.9], rtol=1e-5)


@pytest.mark.parametrize("suffix", ["obj", "ply", "stl", "PLY"])
def test_mesh_files_load_lit_and_with_their_orientation(tmp_path: Path, suffix: str) -> None:
    mesh = trimesh.creation.box((1, 2, 3))
    mesh.apply_translation((0.5, 0, 0))
    path = tmp_path / f"mesh.{suffix}"
    path.write_bytes(
        trimesh.exchange.export.export_mesh(mesh, None, file_type=suffix.lower()) if suffix != "obj" else b""
    )
    if suffix == "obj":
        mesh.export(path)
    scene = load_scene(path)
    assert len(scene.emitters()) == 1
    vertices, faces = surface(scene)
    np.testing.assert_allclose([vertices.min(axis=0), vertices.max(axis=0)], mesh.bounds, atol=1e-6)
    assert trimesh.Trimesh(vertices, faces).volume == pytest.approx(6.0, rel=1e-5)  # negative if turned inside out
    found = hits(scene, rays_at(np.array([0.5, 0, 0]), 0.4))
    outward = np.einsum("ij,ij->i", found["n"], found["p"] - np.array([0.5, 0, 0]))
    assert found["valid"].all() and outward.min() > 0


def test_meshes_named_by_a_scene_are_found_beside_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "scene"
    path = write_scene(folder, '<shape type="ply"><string name="filename" value="meshes/box.ply"/></shape>')
    (folder / "meshes").mkdir()
    trimesh.creation.box((1, 2, 3)).export(folder / "meshes" / "box.ply")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    assert len(surface(load_scene(path))[1]) == 12
    monkeypatch.chdir(folder)
    assert len(surface(load_scene(Path("scene.xml")))[1]) == 12
    assert content_hash(Path("scene.xml")) == content_hash(path)


def test_the_surface_is_all_triangles_of_all_shapes(tmp_path: Path) -> None:
    scene = load_scene(
        write_scene(
            tmp_path,
            shape_xml("rectangle", ANY_POSE),
            '<shape type="cube"><transform name="to_world"><translate x="3"/></transform></shape>',
        )
    )
    vertices, faces = surface(scene)
    parts = [mesh_arrays(shape) for shape in scene.shapes()]
    assert len(parts) == 2
    triangles = np.concatenate([v[f] for v, f in parts])
    np.testing.assert_array_equal(vertices[faces], triangles)
    assert vertices.dtype == np.float32 and faces.dtype == np.uint32
    assert len(triangles) == 2 + 12
    # A unit square of Mitsuba's is 2 x 2, here scaled by 0.8 and 1.3; the cube is 2 x 2 x 2.
    assert trimesh.Trimesh(vertices, faces, process=False).area == pytest.approx(4 * 0.8 * 1.3 + 24, rel=1e-5)
    ray = rays_at(np.array([0.3, -0.2, 0.4]), 2.0)
    found = hits(scene, ray)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    origin, direction = np.array(ray.o).T, np.array(ray.d).T
    points, which, _ = mesh.ray.intersects_location(origin, direction, multiple_hits=False)
    both = np.isin(np.arange(len(origin)), which) & found["valid"]
    expected = np.full((len(origin), 3), np.nan)
    expected[which] = points
    assert both.mean() > 0.2 and np.mean(np.isin(np.arange(len(origin)), which) != found["valid"]) < 0.002
    np.testing.assert_allclose(found["p"][both], expected[both], atol=2e-5)


# --- what a scene's light is cached under


def test_the_content_hash_covers_every_file_of_the_scene(tmp_path: Path) -> None:
    path = write_scene(
        tmp_path,
        """<bsdf type="diffuse" id="paint"><texture type="bitmap" name="reflectance">
            <string name="filename" value="paint.png"/></texture></bsdf>""",
        '<shape type="ply"><string name="filename" value="box.ply"/><ref id="paint"/></shape>',
        '<include filename="more.xml"/>',
    )
    mesh = trimesh.creation.box((1, 2, 3))
    mesh.export(tmp_path / "box.ply")
    more = tmp_path / "more.xml"
    more.write_text('<scene version="3.0.0"><emitter type="constant"/></scene>')
    paint = tmp_path / "paint.png"
    mi.Bitmap(np.full((4, 4, 3), 100, np.uint8)).write(str(paint))
    first = content_hash(path)
    assert re.fullmatch("[0-9a-f]{64}", first) and content_hash(path) == first

    seen = {first}

    def is_new() -> bool:
        before = len(seen)
        seen.add(content_hash(path))
        return len(seen) == before + 1

    mi.Bitmap(np.full((4, 4, 3), 101, np.uint8)).write(str(paint))
    assert is_new()
    mesh.apply_translation((0, 0, 1e-3))
    mesh.export(tmp_path / "box.ply")
    assert is_new()
    path.write_text(path.read_text().replace('id="paint"', 'id="paint" '))
    assert is_new()
    more.write_text(more.read_text().replace('type="constant"', 'type="constant" id="sky"'))
    assert is_new()
    (tmp_path / "unrelated.txt").write_text("not part of the scene")
    assert not is_new()
    paint.unlink()
    with pytest.raises(UserError, match=r"paint\.png.*missing"):
        content_hash(path)


def test_the_content_hash_of_a_mesh_file(tmp_path: Path) -> None:
    path = tmp_path / "mesh.stl"
    trimesh.creation.box((1, 1, 1)).export(path)
    first = content_hash(path)
    trimesh.creation.box((1, 1, 1.001)).export(path)
    assert content_hash(path) != first
    with pytest.raises(UserError, match="no such file"):
        content_hash(tmp_path / "absent.stl")
    path = tmp_path / "broken.xml"
    path.write_text("<scene")
    with pytest.raises(UserError, match=r"broken\.xml"):
        content_hash(path)


# --- scenes that build themselves


def test_a_missing_scene_is_built_by_the_script_beside_it(tmp_path: Path) -> None:
    (tmp_path / "build.py").write_text(
        "from pathlib import Path\n"
        "here = Path(__file__).parent\n"
        "log = here / 'runs'\n"
        "log.write_text(log.read_text() + 'x' if log.exists() else 'x')\n"
        "(here / 'scene.xml').write_text('<scene version=\"3.0.0\"><shape type=\"cube\"/></scene>')\n"
    )
    path = tmp_path / "scene.xml"
    assert len(surface(load_scene(path))[1]) == 12
    load_scene(path)
    assert (tmp_path / "runs").read_text() == "x"  # once


def test_a_missing_variant_is_built_by_the_script_of_its_room(tmp_path: Path) -> None:
    (tmp_path / "build.py").write_text(
        "import sys\nfrom pathlib import Path\n"
        "assert sys.argv[1] == '--seed' and sys.argv[3] == '--out' and len(sys.argv) == 5, sys.argv\n"
        "out = Path(sys.argv[4])\nout.mkdir()\n"
        "cubes = '<shape type=\"cube\"/>' * int(sys.argv[2])\n"
        "(out / 'scene.xml').write_text(f'<scene version=\"3.0.0\">{cubes}</scene>')\n"
    )
    assert len(surface(load_scene(tmp_path / "seed3" / "scene.xml"))[1]) == 36
    fails(tmp_path / "seed" / "scene.xml", "no such file")
    fails(tmp_path / "other3" / "scene.xml", "no such file")


def test_a_build_script_that_fails_says_why_in_one_line(tmp_path: Path) -> None:
    script = tmp_path / "build.py"
    script.write_text("raise SystemExit('first line\\nno disk space left')")
    fails(tmp_path / "scene.xml", r"build\.py failed", "no disk space left")
    script.write_text("pass")
    fails(tmp_path / "scene.xml", "no such file")
    with pytest.raises(UserError, match="no such file"):
        ensure_built(tmp_path / "scene.xml")


def test_one_thread_is_enough_to_read_an_exr(tmp_path: Path) -> None:
    """As on a machine of one core, where Mitsuba alone waits for ever."""
    (tmp_path / "sky.exr").write_bytes(encode_exr(np.full((4, 8, 3), 0.5, np.float32), ("R", "G", "B")))
    (tmp_path / "scene.xml").write_text(
        '<scene version="3.0.0"><emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>'
        '<shape type="sphere"/></scene>'
    )
    code = (
        "from rsgen.device.backend import select\nselect()\nimport sys, drjit, pathlib\ndrjit.set_thread_count(1)\n"
        "from rsgen.scene.loading import load_scene\nload_scene(pathlib.Path(sys.argv[1]))\n"
        "assert drjit.thread_count() == 1"
    )
    words = [sys.executable, "-c", code, str(tmp_path / "scene.xml")]
    subprocess.run(words, cwd=Path(__file__).parents[3], check=True, timeout=60)
