"""Meshes that Mitsuba's loaders refuse or take for something else: polygons, corners' texture coordinates."""

from __future__ import annotations

import hashlib
import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rendering import mi
from scene_files import fails, hits, write_scene
from trimesh.transformations import random_rotation_matrix

from rsgen.formats.meshes.parts import is_convex, triangulated
from rsgen.formats.mitsuba_xml.mesh_files import with_triangles
from rsgen.scene.loading import content_hash, load_scene
from rsgen.scene.meshes import surface


def twice_area(corners: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Vectors (t, 3)."""
    a, b, c = (corners[triangles[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def polygons() -> list[np.ndarray]:
    rng = np.random.default_rng(1)
    angle = np.sort(rng.uniform(0, 2 * np.pi, 30))
    stars = [np.stack([np.cos(angle), np.sin(angle)], 1) * rng.uniform(0.2, 1, (30, 1)) for _ in range(6)]
    holed = np.array([[0, 0], [4, 0], [4, 3], [0, 3], [0, 0], [1, 1], [1, 2], [3, 2], [3, 1], [1, 1]], float)
    comb = np.array([[59.5, -1], *((k + 0.5 * top, 5 * top) for k in range(59, -1, -1) for top in (1, 0)), [0, -1]])
    turns = np.linspace(0, 6 * np.pi, 100)[:, None]
    around = np.concatenate([np.cos(turns), np.sin(turns)], axis=1)
    spiral = np.concatenate([(turns + 1) * around, ((turns + 3) * around)[::-1]])
    straight = np.array([[0, 0], [1, 0], [2, 0], [2, 2], [1, 1], [0, 2], [0, 1]], float)
    return [*stars, holed, comb[::-1], spiral, straight]


def test_triangles_fill_a_polygon_once() -> None:
    """As many as there must be, all of one turn, and together of its area: so none lies outside and none overlap."""
    rng = np.random.default_rng(2)
    for flat in polygons():
        T = random_rotation_matrix(rng.random(3))[:3, :3]
        corners = np.column_stack([flat, np.zeros(len(flat))]) @ T.T + rng.normal(size=3)
        whole = np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0)
        for polygon, normal in ((corners, whole), (corners[::-1], -whole)):
            triangles = triangulated(polygon)
            parts = twice_area(polygon, triangles) @ normal / (normal @ normal)
            assert len(triangles) == len(polygon) - 2 and not is_convex(polygon)
            assert parts.min() > -1e-9 and parts.sum() == pytest.approx(1, abs=1e-9)


def test_a_convex_polygon_is_the_fan_that_it_was() -> None:
    angle = np.linspace(0, 2 * np.pi, 9)[:-1]
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    assert triangulated(ring).tolist() == [[0, k, k + 1] for k in range(1, 7)]
    assert not is_convex(np.tile(ring, (2, 1)))  # twice round


# An arrow head, 10 in area, of which a fan makes 14; with texture coordinates, and named from its end.
ARROW = """v 0 0 0
v 4 0 0
v 4 4 0
v 2 1 0
v 0 4 0
vt 0.1 0.1
vt 0.9 0.1
f 1/1 2/2 3/2 4/1 5/1
v 0 0 9
v 4 0 9
v 4 4 9
f {}
"""


@pytest.mark.parametrize("last", ["6 7 8", "6 7 8 8 8 8", "-3 -2 -1", "6 7" + 1500 * " 8"], ids=str.split)
def test_polygons_of_obj_files(tmp_path: Path, last: str) -> None:
    file = write_scene(tmp_path, '<shape type="obj"><string name="filename" value="arrow.obj"/></shape>')
    (tmp_path / "arrow.obj").write_text(ARROW.format(last))
    if "-" in last:  # Mitsuba takes no such numbers, trimesh does
        text = with_triangles((tmp_path / "arrow.obj").read_bytes())
        assert text is not None and b"f -3 -2 -1" in text
    vertices, faces = surface(load_scene(file))
    area = 0.5 * twice_area(vertices, faces)[:, 2]
    assert area.min() > 0 and area.sum() == pytest.approx(10 + 8)


def wedged(folder: Path, ascii_file: bool, bad: str = "") -> Path:
    """A unit square in z = 0, seen from above; texture coordinates of its halves are 10 apart. Normals lean to x."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    lean = [0.6, 0, 0.8]
    halves = [[0, 1, 2], [0, 2, 3]]
    shift = (0, 10)
    header = [
        "ply",
        "format {} 1.0",
        "element vertex 4",
        *(f"property float {n}" for n in ("x", "y", "z", "nx", "ny", "nz")),
    ]
    header += ["element face 2", "property list uchar int vertex_indices", "property list uchar float texcoord"]
    header += [*(f"property uchar {n}" for n in ("red", "green", "blue")), "end_header", ""]
    text = "\n".join(header)
    coordinates = [(corners[half, :2] + by).ravel() for half, by in zip(halves, shift, strict=True)]
    if ascii_file:
        lines = [" ".join(map(str, [*p, *lean])) for p in corners]
        for half, uv in zip(halves, coordinates, strict=True):
            lines.append(" ".join(map(str, [3, *half, 6, *uv, 255, 0, 0])))
        data = (
            (text.format("ascii") + "\n".join(lines) + "\n")
            .replace("1.0 1.0 0.0 0.6", bad or "1.0 1.0 0.0 0.6")
            .encode()
        )
    else:
        rows = np.zeros(2, [("n", "u1"), ("v", "<i4", 3), ("k", "u1"), ("t", "<f4", 6), ("c", "u1", 3)])
        rows["n"], rows["v"], rows["k"], rows["t"], rows["c"] = 3, halves, 6, coordinates, [255, 0, 0]
        vertices = np.column_stack([corners, np.tile(lean, (4, 1))]).astype("<f4")
        data = text.format("binary_little_endian").encode() + vertices.tobytes() + rows.tobytes()
    folder.mkdir(exist_ok=True)
    (folder / "it.ply").write_bytes(data)
    return folder / "it.ply"


def from_above(scene: Any) -> dict[str, np.ndarray]:
    x, y = np.random.default_rng(5).uniform(0.02, 0.98, (2, 400)).astype(np.float32)
    return hits(scene, mi.Ray3f(mi.Point3f(x, y + 3, 5), mi.Vector3f(0, 0, -1)))


@pytest.mark.parametrize("ascii_file", [False, True], ids=["binary", "ascii"])
def test_texture_coordinates_of_corners(tmp_path: Path, ascii_file: bool, caplog: pytest.LogCaptureFixture) -> None:
    wedged(tmp_path, ascii_file)
    with pytest.raises(RuntimeError):
        mi.load_dict({"type": "ply", "filename": str(tmp_path / "it.ply")})
    inside = """<string name="filename" value="it.ply"/><transform name="to_world"><translate y="3"/></transform>
        <emitter type="area"><rgb name="radiance" value="1, 2, 3"/></emitter>
        <bsdf type="diffuse"><texture type="mesh_attribute" name="reflectance">
        <string name="name" value="face_color"/></texture></bsdf>"""
    flipped = '<boolean name="flip_tex_coords" value="true"/>'
    with caplog.at_level(logging.INFO, "rsgen"):
        lamp = '<shape type="disk"><emitter type="area"/></shape>'
        scene = load_scene(write_scene(tmp_path, f'<shape type="ply" id="it">{inside}</shape>', lamp))
    assert [r.getMessage() for r in caplog.records] == [
        f"scene {tmp_path / 'scene.xml'}: read by trimesh, Mitsuba does not: it.ply"
    ]
    found = from_above(scene)
    assert found["valid"].all() and scene.shapes()[0].id() == "it" and len(scene.emitters()) == 2
    expected = found["p"][:, :2] - [0, 3]
    expected += np.where(expected[:, 1] > expected[:, 0], 10, 0)[:, None]
    np.testing.assert_allclose(found["uv"], expected, atol=1e-5)
    np.testing.assert_allclose(found["sh_n"], np.tile([0.6, 0, 0.8], (400, 1)), atol=1e-6)
    np.testing.assert_array_equal(found["emitted"], np.tile([1, 2, 3], (400, 1)))
    np.testing.assert_allclose(np.array(mi.traverse(scene.shapes()[0])["face_color"]), [1, 0, 0] * 2)
    if ascii_file:
        turned = from_above(load_scene(write_scene(tmp_path, f'<shape type="ply">{inside}{flipped}</shape>')))
        np.testing.assert_allclose(turned["uv"][:, 1], 1 - expected[:, 1], atol=1e-5)


def test_polygons_of_ply_files(tmp_path: Path) -> None:
    """An arrow head, 10 in area, and a triangle of 2."""
    corners = "0 0 0\n4 0 0\n4 4 0\n2 1 0\n0 4 0\n"
    header = "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n"
    faces = "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "it.ply").write_text(f"{header}{faces}{corners}5 0 1 2 3 4\n3 0 1 3\n")
    scene = write_scene(tmp_path, '<shape type="ply"><string name="filename" value="it.ply"/></shape>')
    area = 0.5 * twice_area(*surface(load_scene(scene)))[:, 2]
    assert area.min() > 0 and area.sum() == pytest.approx(10 + 2)


def test_what_nobody_can_read_is_refused_as_before(tmp_path: Path) -> None:
    scene = write_scene(tmp_path, '<shape type="ply"><string name="filename" value="it.ply"/></shape>')
    wedged(tmp_path, True, bad="nan 1.0 0.0 0.6")
    fails(scene, "shape ply 'it.ply'", "export it anew")
    whole = wedged(tmp_path, False).read_bytes()
    (tmp_path / "it.ply").write_bytes(whole[:-9])
    fails(scene, "shape ply 'it.ply'", "export it anew")


def test_polygons_are_in_the_hash_only_where_they_count(tmp_path: Path) -> None:
    file = write_scene(tmp_path, '<shape type="obj"><string name="filename" value="it.obj"/></shape>')
    lines = ARROW.format("6 7 8").splitlines()
    marks = set()
    for middle in ("v 2 1 0", "v 3 5 0"):  # an arrow head, and a convex polygon
        data = "\n".join([*lines[:3], middle, *lines[4:]]).encode()
        (tmp_path / "it.obj").write_bytes(data)
        digest = hashlib.sha256(file.read_bytes())
        digest.update(b"it.obj\0" + hashlib.sha256(data).digest())
        marks.add(digest.hexdigest() == content_hash(file))
        assert (with_triangles(data) is None) == (middle == "v 3 5 0")
    assert marks == {True, False}


def test_an_obj_file_with_a_long_line_is_what_it_is_without(tmp_path: Path) -> None:
    text = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0.2\nvt 0 1\nvn 0.6 0 0.8\nvn 0 0 1\n"
    text += "f 1/1/1 2/2/1 3/3/2\nf 1/3/2 3/1/1 4/1/1\n"
    seen = []
    for line in ("# short", "#" + 3000 * "-"):
        (tmp_path / "it.obj").write_text(f"{line}\n{text}")
        pose = '<transform name="to_world"><translate y="3"/></transform><boolean name="flip_tex_coords" value="{}"/>'
        seen += [
            from_above(load_scene(write_scene(tmp_path, f'<shape type="obj">{it}{pose.format(flip)}</shape>')))
            for it in ['<string name="filename" value="it.obj"/>']
            for flip in ("true", "false")
        ]
    for name in ("valid", "p", "n", "sh_n", "uv"):
        for short, long in zip(seen[:2], seen[2:], strict=True):
            np.testing.assert_allclose(long[name], short[name], atol=1e-6, err_msg=name)
    assert np.ptp(seen[0]["uv"]) > 0.5 and np.ptp(seen[0]["sh_n"][:, 0]) > 0.3
