"""Instances of shape groups, flattened: their triangles, their order, and the side that they show."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import pytest
import trimesh
from nightly import sampled
from rendering import mi
from scene_files import EVEN_POSE, MIRRORED, hits, rays_at, write_scene

from rsgen.scene.loading import load_scene
from rsgen.scene.meshes import mesh_arrays, surface


def instanced(group: str, *poses: str) -> list[str]:
    place = '<shape type="instance"><ref id="g"/><transform name="to_world">{}</transform></shape>'
    return [f'<shape type="shapegroup" id="g">{group}</shape>', *(place.format(pose) for pose in poses)]


def test_instances_become_triangles_where_they_stand(tmp_path: Path) -> None:
    ball, box = trimesh.creation.icosphere(2), trimesh.creation.box((1, 2, 3))
    inner = trimesh.transformations.translation_matrix([0.7, 0, 0]) @ np.diag([0.5, 0.5, 0.5, 1])
    matrices = [trimesh.transformations.random_rotation_matrix(np.array(r)) @ np.diag([*s, 1.0])
                for r, s in (((0.1, 0.5, 0.9), (1, 1, 1)), ((0.7, 0.2, 0.4), (0.5, 1.5, 0.8)))]  # fmt: skip
    matrices[1][:3, 3] = 3, -1, 0.5
    tags = [f'<matrix value="{" ".join(map(str, m.ravel()))}"/>' for m in (inner, *matrices)]
    group = (
        '<shape type="ply"><string name="filename" value="box.ply"/></shape>'
        f'<shape type="ply"><string name="filename" value="ball.ply"/><transform name="to_world">{tags[0]}</transform>'
        '<emitter type="area"><rgb name="radiance" value="1,2,3"/></emitter></shape>'
    )
    path = write_scene(tmp_path, *instanced(group, *tags[1:]), '<shape type="cube"/>')
    box.export(tmp_path / "box.ply")
    ball.export(tmp_path / "ball.ply")
    expected = [m @ part for m in matrices for part in (np.eye(4), inner)]
    parts = [trimesh.creation.box((2, 2, 2))]
    parts += [mesh.copy().apply_transform(T) for mesh, T in zip((box, ball) * 2, expected, strict=True)]
    scene, again = load_scene(path), load_scene(path)
    assert [s.face_count() for s in scene.shapes()] == [12, 320, 12, 320, 12] and len(scene.emitters()) == 2
    np.testing.assert_array_equal(surface(scene)[0], surface(again)[0])
    ray = rays_at(np.array([1.0, 0, 0]), 3.0)
    origin, direction = np.array(ray.o).T, np.array(ray.d).T
    points, which, _ = trimesh.util.concatenate(parts).ray.intersects_location(origin, direction, multiple_hits=False)
    found = hits(scene, ray)
    valid = np.isin(np.arange(len(origin)), which)
    assert valid.mean() > 0.2 and np.mean(valid != found["valid"]) < 0.002
    expected_p = np.full((len(origin), 3), np.nan)
    expected_p[which] = points
    both = valid & found["valid"]
    assert np.quantile(np.linalg.norm(found["p"] - expected_p, axis=1)[both], 0.998) < 2e-5
    assert 0.005 < np.mean(found["emitted"][:, 2] == 3) < 0.9


def test_groups_may_hold_instances_of_groups(tmp_path: Path) -> None:
    shift = '<transform name="to_world"><translate x="{}"/></transform>'
    pair = "".join(f'<shape type="instance"><ref id="one"/>{shift.format(x)}</shape>' for x in (0, 10))
    path = write_scene(
        tmp_path,
        f'<shape type="shapegroup" id="one"><shape type="cube">{shift.format(1)}</shape></shape>',
        f'<shape type="shapegroup" id="two">{pair}</shape>',
        '<shape type="instance"><ref id="two"/><transform name="to_world"><scale value="2"/></transform></shape>',
    )
    middles = [mesh_arrays(shape)[0].mean(axis=0) for shape in load_scene(path).shapes()]
    np.testing.assert_allclose(middles, [[2, 0, 0], [22, 0, 0]], atol=1e-5)


@pytest.mark.parametrize(
    ("shape", "mirrored"), sampled(product(["smooth", "faceted", "cube", "sphere", "rectangle"], [False, True]), 3)
)
def test_instances_show_the_side_that_mitsubas_own_show(tmp_path: Path, shape: str, mirrored: bool) -> None:
    trimesh.creation.icosphere(2).export(tmp_path / "ball.ply")
    facets = '<boolean name="face_normals" value="true"/>' if shape == "faceted" else ""
    ball = f'<shape type="ply"><string name="filename" value="ball.ply"/>{facets}</shape>'
    group = ball if shape in ("smooth", "faceted") else f'<shape type="{shape}"/>'
    path = write_scene(tmp_path, *instanced(group, (MIRRORED if mirrored else "") + EVEN_POSE))
    ray = rays_at(np.array([0.3, -0.2, 0.4]), 0.3)
    ours, theirs = hits(load_scene(path), ray), hits(mi.load_file(str(path)), ray)
    both = ours["valid"] & theirs["valid"]
    assert both.mean() > 0.5
    for normal in ("n", "sh_n"):
        assert np.quantile(np.einsum("ij,ij->i", ours[normal], theirs[normal])[both], 0.01) > 0.99
