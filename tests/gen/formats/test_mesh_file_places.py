"""Where the meshes of a file are, what light they get, and what is wrong with them."""

from __future__ import annotations

import base64
import json
import re
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from mesh_files import AXES, TURNED, baked, flat_arrays, looking, ours, picture, seen_from_above, write_gltf
from PIL import Image
from rendering import mi

from rsgen.config.config import load_config
from rsgen.errors import UserError
from rsgen.formats.meshes.default_light import Probe
from rsgen.scene.loading import content_hash, load_scene
from rsgen.scene.meshes import mesh_arrays, surface
from rsgen.scene.placement import SceneOptions

# --- where things are


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_scale_and_up_place_every_point(tmp_path: Path, up: Any) -> None:
    rng = np.random.default_rng(8)
    mesh = trimesh.creation.icosphere(1)
    mesh.vertices *= rng.uniform(0.5, 2.0, (len(mesh.vertices), 1)) * [1, 2, 3]
    mesh.export(tmp_path / "blob.stl")
    scene = load_scene(tmp_path / "blob.stl", options=SceneOptions(scale=0.25, up=up))
    axis, sign = up[-1], -1 if up[0] == "-" else 1
    vertices, faces = surface(scene)
    heights = np.sort(vertices[faces][..., 1].ravel())
    np.testing.assert_allclose(heights, np.sort(0.25 * sign * mesh.triangles[..., AXES[axis]].ravel()), atol=1e-5)
    # A rotation: nothing is mirrored. Rays from outside then meet what trimesh says they meet.
    assert trimesh.Trimesh(vertices, faces).volume == pytest.approx(mesh.volume * 0.25**3, rel=1e-4)
    R = np.array(_rotation(axis, sign), float)
    moved = trimesh.Trimesh(0.25 * mesh.vertices @ R.T, mesh.faces, process=False)
    direction = rng.normal(size=(500, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origin = rng.normal(scale=0.1, size=(500, 3)) - 4 * direction
    ray = mi.Ray3f(mi.Point3f(origin.T.astype(np.float32)), mi.Vector3f(direction.T.astype(np.float32)))
    points, which, _ = moved.ray.intersects_location(origin, direction, multiple_hits=False)
    assert len(which) > 400
    np.testing.assert_allclose(np.array(scene.ray_intersect(ray).p).T[which], points, atol=1e-4)


def _rotation(axis: str, sign: int) -> Any:
    """The rotation by a quarter turn about a horizontal axis, or by a half turn about x, that takes sign·axis to y."""
    if axis == "y":
        return np.diag([1, sign, sign])
    about = np.cross(np.eye(3)[AXES[axis]] * sign, [0, 1.0, 0])
    return np.round(trimesh.transformations.rotation_matrix(np.pi / 2, about)[:3, :3])


def test_shapes_are_in_one_order_whatever_their_nodes_are_called(tmp_path: Path) -> None:
    """trimesh names nodes of meshes of several primitives at random."""
    first, second = flat_arrays(), np.array([0, 1, 2], np.uint32)
    path = write_gltf(tmp_path / "scene.gltf", first | {"half": second}, None)
    header = json.loads(path.read_text())
    primitive = header["meshes"][0]["primitives"][0]
    half = primitive["attributes"].pop("half")
    header["meshes"][0]["primitives"] = [
        primitive,
        {"attributes": primitive["attributes"], "indices": half, "material": 0},
    ]
    header["nodes"] = [{"mesh": 0, "translation": [0, k, 0], "scale": [1, 1, -1 if k == 2 else 1]} for k in range(4)]
    header["scenes"] = [{"nodes": [3, 1, 0, 2]}]
    header["materials"] = [{}]
    path.write_text(json.dumps(header))
    scenes = [[mesh_arrays(shape) for shape in load_scene(path, options=TURNED).shapes()] for _ in range(6)]
    assert [len(faces) for _, faces in scenes[0]] == [8, 4]  # one shape a material
    for other in scenes[1:]:
        for (v, f), (v0, f0) in zip(other, scenes[0], strict=True):
            np.testing.assert_array_equal(v, v0)
            np.testing.assert_array_equal(f, f0)
    vertices, faces = scenes[0][0]
    corners = vertices[faces]
    up = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
    assert (up > 0).all()  # mirrored ones are not turned over


def test_normals_turn_with_their_surfaces(tmp_path: Path) -> None:
    """Under mirrors and uneven scales; a file without normals is flat."""
    ball = trimesh.creation.icosphere(3)
    smooth = trimesh.Trimesh(ball.vertices, ball.faces, vertex_normals=np.array(ball.vertices), process=False)
    for normals in (True, False):
        scene = trimesh.Scene()
        T = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3]) @ np.diag([-1.0, 2.0, 0.5, 1.0])
        scene.add_geometry(smooth, transform=T)
        scene.export(tmp_path / "ball.glb", include_normals=normals)
        loaded = load_scene(tmp_path / "ball.glb", options=SceneOptions())
        si, _ = seen_from_above(loaded, np.random.default_rng(2).uniform(-0.4, 0.4, (500, 2)))
        # The ellipsoid's own normal is the gradient of |T⁻¹ p|².
        gradient = np.array(si.p).T @ np.linalg.inv(T[:3, :3] @ T[:3, :3].T)
        cosine = np.einsum("ij,ij->i", np.array(si.sh_frame.n).T, gradient) / np.linalg.norm(gradient, axis=1)
        if normals:
            assert cosine.min() > 0.9995
        else:
            assert 0.95 < cosine.min() < 0.9995
            np.testing.assert_allclose(np.array(si.sh_frame.n), np.array(si.n), atol=1e-6)


# --- light


def room(open_top: bool = False) -> trimesh.Trimesh:
    """A room of 4 x 5 x 2.5 m whose walls face inwards, with a block in its middle."""
    walls = trimesh.creation.box((4, 5, 2.5))
    walls.invert()
    if open_top:
        walls.update_faces(walls.triangles_center[:, 2] < 1.2)
    block = trimesh.creation.box((0.6, 0.6, 0.6))
    return trimesh.util.concatenate([walls, block])


def test_rooms_get_lamps_and_objects_a_sky(tmp_path: Path) -> None:
    files = {}
    crooked = room()
    crooked.faces[:4] = crooked.faces[:4, ::-1]  # two walls turned over
    meshes = {"room": room(), "crooked": crooked, "open": room(open_top=True), "ball": trimesh.creation.icosphere(2)}
    for name, mesh in (meshes | {"turned": trimesh.creation.box((4, 5, 2.5))}).items():
        mesh.export(tmp_path / f"{name}.ply")
        files[name] = tmp_path / f"{name}.ply"

    def lights(name: str, light: Any = "auto") -> list[bool]:
        return [
            bool(e.is_environment())
            for e in load_scene(files[name], options=SceneOptions(up="z", light=light)).emitters()
        ]

    assert lights("ball") == [True] and lights("open") == [True] and lights("turned") == [True]
    assert lights("room") == lights("crooked") == [False] * 2  # one for each 2.5 m
    assert lights("room", "sky") == [True] and lights("room", "none") == []
    assert lights("turned", "ceiling") == [False] * 2  # walls that face outwards: an object, unless one says so
    with pytest.raises(UserError, match=r"open\.ply: has no ceiling.*scene\.light"):
        load_scene(files["open"], options=SceneOptions(up="z", light="ceiling"))
    bare = room(open_top=True)
    assert not Probe(mi, np.array(bare.vertices), np.array(bare.faces)).encloses()
    scene = load_scene(files["room"], options=SceneOptions(up="z"))
    lamps = [shape for shape in scene.shapes() if shape.is_emitter()]
    for shape in lamps:
        vertices, faces = mesh_arrays(shape)
        assert 1.0 < vertices[:, 1].min() < 1.25 and np.abs(vertices[:, [0, 2]]).max() < 2.5
        a, b, c = vertices[faces[0]]
        assert np.cross(b - a, c - a)[1] < 0  # shining down
    # The floor is about as bright as a sky would make it in the open.
    field = baked(scene, 0.5)
    poses = looking((1.5, 0.3, 2.0), (-1.5, -0.9, -2.0))
    seen = ours(scene, poses, field, 4)
    assert 0.3 < np.median(seen) < 0.95


# --- what goes wrong


def fails(path: Path, *words: str) -> None:
    with pytest.raises(UserError) as caught:
        load_scene(path)
    message = str(caught.value)
    assert "\n" not in message and len(message) < 400 and path.name in message
    for word in words:
        assert re.search(word, message), f"{word!r} is not in: {message}"


def test_broken_files_say_what_is_wrong_in_one_line(tmp_path: Path) -> None:
    arrays = flat_arrays()

    def gltf(name: str, change: dict[str, np.ndarray] | None = None, **more: Any) -> Path:
        return write_gltf(tmp_path / f"{name}.gltf", arrays | (change or {}), {}, **more)

    nan = arrays["POSITION"].copy()
    nan[1, 0] = np.nan
    fails(gltf("nan", {"POSITION": nan}), "not finite", "mend it")
    fails(gltf("flat", {"POSITION": np.zeros((4, 3), np.float32)}), "no triangles", "export")
    fails(gltf("far", {"POSITION": arrays["POSITION"] * np.float32(1e8)}), "beyond", "scene.scale")
    fails(gltf("index", {"indices": np.array([0, 1, 9], np.uint32)}), "faces without vertices", "export it again")
    fails(gltf("zero", nodes=[{"mesh": 0, "scale": [0, 0, 0]}]), "no triangles")
    fails(gltf("endless", nodes=[{"mesh": 0, "translation": [0, float("inf"), 0]}]), "JSON cannot be read")
    fails(gltf("draco", extensionsRequired=["KHR_draco_mesh_compression"]), "KHR_draco_mesh_compression", "without")
    fails(gltf("gone", images=[{"uri": "gone%20away.png"}]), "gone away.png", "missing")
    texture = {"materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}], "textures": [{"source": 0}]}
    fails(gltf("words", images=[{"uri": "data:image/png;base64,AAAA"}], **texture), "texture", "PNG")
    half = base64.b64encode(cv2.imencode(".png", picture(1, 64))[1].tobytes()[:900]).decode()
    fails(gltf("half", images=[{"uri": f"data:image/png;base64,{half}"}], **texture), "texture", "damaged")
    sparse = json.loads(gltf("sparse").read_text())["accessors"]
    sparse[0]["sparse"] = {"count": 0}
    fails(gltf("sparse", accessors=sparse), "sparse accessors", "export it without")
    for name, content in {
        "empty.glb": b"", "words.glb": b"this is not a scene, is it?", "empty.gltf": b"", "list.gltf": b"[]",
        "short.glb": struct.pack("<IIIII", 0x46546C67, 2, 999, 999, 0x4E4F534A), "hollow.gltf": b"{}",
    }.items():  # fmt: skip
        (tmp_path / name).write_bytes(content)
        fails(tmp_path / name)
    (tmp_path / "odd.gltf").write_text('{"asset": {"version": "2.0"}, "buffers": 3, "images": [4]}')
    fails(tmp_path / "odd.gltf")
    with pytest.raises(UserError, match=r"odd\.gltf: is malformed"):
        content_hash(tmp_path / "odd.gltf")
    (tmp_path / "b.obj").write_text("mtllib b.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl m\nf 1/1 2/1 3/1\n")
    (tmp_path / "b.mtl").write_text("newmtl m\nmap_Kd b.png\n")
    (tmp_path / "b.png").write_bytes(b"no picture")
    fails(tmp_path / "b.obj", "b.png' cannot be read", "PNG")
    (tmp_path / "a.obj").write_text("mtllib none.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    fails(tmp_path / "a.obj", "none.mtl", "missing", "put it there")


def test_triangles_without_area_are_left_out(tmp_path: Path) -> None:
    indices = np.array([0, 1, 2, 0, 2, 3, 0, 0, 1, 2, 2, 2], np.uint32)
    path = write_gltf(tmp_path / "scene.gltf", flat_arrays() | {"indices": indices}, None)
    assert len(surface(load_scene(path))[1]) == 2


# --- what the light is cached under, and the config


def test_the_content_hash_covers_files_and_placement(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl m\nf 1/1 2/1 3/1\n")
    (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd maps\\paint.png\n")
    (tmp_path / "maps").mkdir()
    paint = tmp_path / "maps" / "paint.png"
    Image.fromarray(np.full((2, 2, 3), 80, np.uint8)).save(paint)
    gltf = write_gltf(tmp_path / "b.gltf", flat_arrays(), {}, images=[{"uri": "maps/paint.png"}])
    seen = {content_hash(path) for path in (tmp_path / "a.obj", gltf)}
    assert seen == {content_hash(path) for path in (tmp_path / "a.obj", gltf)} and len(seen) == 2
    seen |= {content_hash(gltf, SceneOptions(**how)) for how in ({"scale": 2.0}, {"up": "x"}, {"light": "sky"})}
    assert len(seen) == 5
    Image.fromarray(np.full((2, 2, 3), 81, np.uint8)).save(paint)
    seen |= {content_hash(path) for path in (tmp_path / "a.obj", gltf)}
    assert len(seen) == 7
    (tmp_path / "a.mtl").write_text("newmtl m\nKd 1 1 1\nmap_Kd maps\\paint.png\n")
    seen.add(content_hash(tmp_path / "a.obj"))
    assert len(seen) == 8
    load_scene(tmp_path / "a.obj")
    paint.unlink()
    for path in (tmp_path / "a.obj", gltf):
        with pytest.raises(UserError, match=r"paint\.png' that it names is missing"):
            content_hash(path)


def test_a_config_places_scenes_and_lights_mesh_files(tmp_path: Path) -> None:
    (tmp_path / "t.yaml").write_text("name: t\ntrajectory: {file: t.txt}\nscene: {file: a.glb}\n")
    config = load_config(tmp_path / "t.yaml")
    assert config.content()["scene"] == {"file": "a.glb"}  # as sequences of older versions have it
    placed = load_config(tmp_path / "t.yaml", {"scene.scale": "0.01", "scene.up": "-y", "scene.light": "ceiling"})
    assert placed.content()["scene"] == {"file": "a.glb", "scale": 0.01, "up": "-y", "light": "ceiling"}
    for key, value in (("scene.scale", "0"), ("scene.scale", "-1"), ("scene.up", "w"), ("scene.light", "lamp")):
        with pytest.raises(UserError, match=key):
            load_config(tmp_path / "t.yaml", {key: value})
    xml = load_config(tmp_path / "t.yaml", {"scene.file": "a.xml", "scene.scale": "2", "scene.up": "z"})
    assert xml.content()["scene"] == {"file": "a.xml", "scale": 2.0, "up": "z"}
    with pytest.raises(UserError, match="light: is for mesh files"):
        load_config(tmp_path / "t.yaml", {"scene.file": "a.xml", "scene.light": "sky"})
