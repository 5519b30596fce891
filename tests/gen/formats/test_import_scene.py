"""What every import of a scene shares: polygons, pictures, a folder whole or not at all, one line for each fault."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image
from rendering import dr, mi
from usd_scenes import albedo, imported, triangles

from rsgen import formats, srgb
from rsgen.cli.main import main
from rsgen.errors import UserError
from rsgen.formats.meshes.mesh_file import part_shapes
from rsgen.formats.meshes.parts import Part, triangulate
from rsgen.formats.scenes import import_scene
from rsgen.formats.scenes.import_scene import Content, write_folder, write_scene
from rsgen.scene.loading import content_hash, load_scene
from rsgen.scene.material import Material, Texture, bsdf
from rsgen.scene.placement import SceneOptions


def test_polygons_of_a_mesh_keep_their_area_and_order_and_holes_are_left_out() -> None:
    """A triangle, an L whose first corner is its inner one, a hole, and an arrow head."""
    L = [[1, 1], [1, 2], [0, 2], [0, 0], [2, 0], [2, 1]]
    polygons = [[[0, 0], [4, 0], [0, 1]], L, [[0, 0], [1, 0], [1, 1], [0, 1]], [[0, 0], [4, 0], [2, 1], [2, 4]]]
    flat = np.concatenate(polygons)
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    points = np.pad(flat, ((0, 0), (0, 1))) @ turn
    corners, polygon = triangulate(points, np.arange(len(flat)), np.array([3, 6, 4, 4]), np.array([1, 1, 0, 1], bool))
    a, b, c = (points[corners[:, k]] for k in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    np.testing.assert_allclose(np.bincount(polygon, areas), [2, 3, 0, 5], atol=1e-12)
    assert polygon.tolist() == [0, 1, 1, 1, 1, 3, 3]


def test_a_mesh_file_becomes_the_scene_that_it_is_by_itself(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    image = rng.integers(0, 255, (4, 4, 3), dtype=np.uint8)
    visual = trimesh.visual.TextureVisuals(
        uv=np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]),
        material=trimesh.visual.material.PBRMaterial(
            baseColorTexture=Image.fromarray(image), metallicFactor=0.0, roughnessFactor=1.0
        ),
    )
    corners = [[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]]
    mesh = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)
    mesh.export(tmp_path / "card.glb")
    scene, notes = imported(tmp_path / "card.glb")
    direct = load_scene(tmp_path / "card.glb")
    np.testing.assert_array_equal(triangles(scene), triangles(direct))
    where = rng.uniform(-0.9, 0.9, (50, 2))
    np.testing.assert_allclose(albedo(scene, where), albedo(direct, where), atol=1e-3)
    assert len(scene.emitters()) == len(direct.emitters()) == 1
    assert "scene.file of a config takes a mesh file as it is" in notes[0]
    assert list((tmp_path / "card/textures").glob("*.png"))


def test_pictures_that_bytes_cannot_hold_are_written_as_they_are(tmp_path: Path) -> None:
    pixels = np.random.default_rng(2).integers(0, 255, (3, 5, 4), dtype=np.uint8)
    transform = np.array([[2.0, 0.5, 0.1], [0, -1, 0.3]])
    looks = Material(np.array([0.31, 0.52, 0.93]), Texture(pixels, "mirror", True, transform), roughness=0.4)
    scene = {"type": "scene", "shape": {"type": "rectangle", "bsdf": bsdf(mi, looks, None)}}
    dr.set_thread_count(max(2, dr.thread_count()))  # with one, Mitsuba waits for itself for ever over an EXR
    direct = mi.load_dict(scene)
    write_scene(scene, ["a -- comment"], tmp_path)
    read = load_scene(tmp_path / "scene.xml")
    assert list((tmp_path / "textures").glob("*.exr"))
    uv = np.random.default_rng(3).uniform(-1, 1, (2, 40)).astype(np.float32)
    rays = mi.Ray3f(mi.Point3f(uv[0], uv[1], 3), mi.Vector3f(0, 0, -1))
    values = [
        np.array(s.ray_intersect(rays).bsdf().eval_diffuse_reflectance(s.ray_intersect(rays))) for s in (direct, read)
    ]
    np.testing.assert_allclose(values[0], values[1], rtol=2e-3)
    assert np.ptp(values[0]) > 0.3


def test_a_folder_is_there_whole_or_not_at_all(tmp_path: Path) -> None:
    out = tmp_path / "room"

    def fails(folder: Path) -> None:
        (folder / "scene.xml").write_text("half")
        raise UserError("no more")

    with pytest.raises(UserError, match="no more"):
        write_folder(out, False, fails)
    assert not list(tmp_path.iterdir())
    assert write_folder(out, False, lambda folder: (folder / "scene.xml").write_text("one")) == 3
    with pytest.raises(UserError, match="is there already: choose another folder, or replace it with --force"):
        write_folder(out, False, fails)
    with pytest.raises(UserError, match="no more"):
        write_folder(out, True, fails)
    assert (out / "scene.xml").read_text() == "one"
    write_folder(out, True, lambda folder: (folder / "scene.xml").write_text("two"))
    assert (out / "scene.xml").read_text() == "two" and [p.name for p in tmp_path.iterdir()] == ["room"]
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/diary.txt").write_text("mine")
    with pytest.raises(UserError, match="no folder of 'rsgen import'"):
        write_folder(tmp_path / "mine", True, fails)


def test_what_is_missing_is_said_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.usda").write_text("#usda 1.0\n")
    (tmp_path / "a.blend").write_bytes(b"BLENDER")
    (tmp_path / "a.txt").write_text("")
    monkeypatch.setattr(import_scene, "find_spec", lambda name: None)
    for name, text in [
        ("a.usda", "need the package usd-core, which is not installed: install it with: pip install"),
        ("a.blend", "need Blender's Python module bpy, which is not installed: install it with: pip install"),
        ("a.txt", "is no file to import: of these kinds are read: .usd"),
        ("none.usdz", "no such file"),
    ]:
        assert main(["import", str(tmp_path / name), str(tmp_path / "out")]) == 2
        said = capsys.readouterr().err
        assert text in said and said.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_colours_survive_as_bytes() -> None:
    """What the PNGs rest on: sRGB's bytes, decoded and encoded again, are the same bytes."""
    codes = np.arange(256)
    np.testing.assert_array_equal(np.round(srgb.encode(srgb.decode(codes / 255)) * 255), codes)


def test_another_kind_of_scene_is_one_module_and_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of scene.file and of `rsgen import`: boxes as lines of numbers, by the lines in the registry."""
    module: Any = ModuleType("rsgen.formats.meshes.boxes")

    def parts(path: Path, scale: float) -> list[Part]:
        boxes = [trimesh.creation.box(extents=scale * row) for row in np.loadtxt(path, ndmin=2)]
        return [Part(np.asarray(box.vertices), np.asarray(box.faces), Material()) for box in boxes]

    module.scene_dict = lambda mi, path, scratch, options: {
        "type": "scene",
        **part_shapes(mi, parts(path, options.scale), scratch),
    }
    module.hash_into = lambda digest, path, options: digest.update(repr(options.scale).encode())
    module.read_content = lambda path, scale, up: Content(parts(path, scale or 1.0), [], ["boxes"])
    monkeypatch.setitem(sys.modules, module.__name__, module)
    for table in (formats.SCENES, formats.IMPORTS):
        monkeypatch.setitem(table, ".boxes", "meshes.boxes")
    file = tmp_path / "three.boxes"
    file.write_text("1 2 3\n2 2 2\n1 1 1\n")
    direct = load_scene(file, options=SceneOptions(scale=0.5))
    scene, notes = imported(file, scale=0.5)
    assert len(triangles(direct)) == 36 and notes[0] == "boxes"
    np.testing.assert_array_equal(triangles(scene), triangles(direct))
    assert content_hash(file) != content_hash(file, SceneOptions(scale=0.5))
