"""A ground to the horizon: in pieces, and lit the more coarsely the farther it is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from lit import scene_of

from rsgen.array_types import FloatArray
from rsgen.device.arrays import rows_of
from rsgen.render.irradiance import make_lattice
from rsgen.scene.meshes import coarser, inhabited_box, mesh_arrays, split_triangles
from rsgen.scene.rays import rays_from

HOUSE = """<shape type="cube"><transform name="to_world"><scale x="3" y="2" z="1.5"/><translate z="1.4"/></transform>
    <bsdf type="diffuse"/></shape>"""
GROUND = """<shape type="rectangle" id="ground"><transform name="to_world"><scale value="200"/>
    <rotate z="1" angle="20"/></transform><bsdf type="diffuse"/></shape>"""
BOX = np.array([[-3.0, -2.0, -0.1], [3.0, 2.0, 2.9]])


def area(corners: FloatArray) -> FloatArray:
    return np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2


def test_land_is_cut_into_pieces_that_are_small_where_one_may_be(tmp_path: Path) -> None:
    scene = scene_of(tmp_path, HOUSE, GROUND)
    shapes = [shape for shape in scene.shapes() if shape.is_mesh()]
    np.testing.assert_allclose(inhabited_box(shapes), BOX, atol=1e-5)
    (vertices, faces) = next(mesh_arrays(s) for s in shapes if len(mesh_arrays(s)[1]) > 12)
    corners = vertices[faces].astype(float)
    assert abs(area(corners).sum() / 160000.0 - 1) < 1e-5
    longest = np.linalg.norm(np.roll(corners, 1, axis=1) - corners, axis=2).max(axis=1)
    distance = 2.0 * coarser(corners, BOX)  # by its definition, where that is above 1
    assert (longest <= np.maximum(10.0, distance) + 1e-3).all() and longest.max() > 30 and len(faces) < 1000

    # All as it was for a ray: place, normal, texture coordinates, by the plane's own pose.
    angle = np.radians(20)
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    local = np.random.default_rng(1).uniform(-0.99, 0.99, (2000, 2))
    xy = 200 * local @ R.T
    away = (np.abs(xy) > (3.1, 2.1)).any(axis=1)
    origin = np.column_stack([xy, np.full(len(xy), 5.0)])[away]
    si = scene.ray_intersect(rays_from(origin, np.tile([0.0, 0.0, -1.0], (len(origin), 1))))
    np.testing.assert_allclose(rows_of(si.p), np.column_stack([xy[away], np.zeros(away.sum())]), atol=1e-3)
    np.testing.assert_allclose(rows_of(si.sh_frame.n), np.tile([0, 0, 1], (away.sum(), 1)), atol=1e-5)
    np.testing.assert_allclose(rows_of(si.uv), (local[away] + 1) / 2, atol=1e-5)


def test_samples_of_light_are_where_one_may_be(tmp_path: Path) -> None:
    """The ground of 160,000 m² takes about as many as the house's own 100 m², and what is below the house is fine."""
    house = make_lattice(scene_of(tmp_path, HOUSE), 0.05).points
    both = make_lattice(scene_of(tmp_path, HOUSE, GROUND), 0.05)
    assert house < both.points < 8 * house
    far = scene_of(tmp_path, GROUND)  # nothing else: all of it is where one may be
    assert make_lattice(far, 1.0).points > 160000


def test_a_lamp_and_small_things_stay_as_they_are(tmp_path: Path) -> None:
    sky = """<shape type="rectangle"><transform name="to_world"><scale value="100"/><translate z="50"/></transform>
        <emitter type="area"/></shape>"""
    scene = scene_of(tmp_path, HOUSE, sky)
    assert sorted(len(mesh_arrays(shape)[1]) for shape in scene.shapes()) == [2, 12]
    faces, table = np.array([[0, 1, 2]]), np.array([[0.0, 0, 0], [9, 0, 0], [0, 2, 0]])
    assert split_triangles(faces, table, BOX)[0] is faces
