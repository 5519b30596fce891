"""The workshop for several seeds: closed, sound, nothing inside of something else or in the air, no two faces alike."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from test_scene_living_room import digest
from trimesh.ray.ray_pyembree import RayMeshIntersector

from scenes.kit.materials import Material, texture
from scenes.kit.pieces import Piece
from scenes.kit.shapes import Mesh, box, merge, move
from scenes.workshop import build as scene
from scenes.workshop import hall, layout
from scenes.workshop.materials import materials

SEEDS = (0, 1)
EMBEDDED = 5e-4  # m; rays start so far before a surface


@cache
def placed(seed: int) -> list[Piece]:
    return layout.things(seed)


@cache
def things(seed: int) -> list[tuple[str, Mesh, bool]]:
    """Name, mesh and whether it hangs: all things, and the building's columns, crane, doors."""
    out = [(t.name, merge([m for _, m in t.parts]), t.on == "building") for t in placed(seed)]
    for name, parts in (("steelwork", hall.steelwork()), ("crane", layout.crane(seed)), ("doors", hall.doors())):
        out.append((name, merge([m for _, m in parts]), True))
    return [*out, ("bars", merge([m for _, m in hall.window_bars()]), True)]


@cache
def everything(seed: int) -> tuple[trimesh.Trimesh, np.ndarray]:
    """All things as one mesh, and the number of the thing of each triangle."""
    found = things(seed)
    mesh = merge([m for _, m, _ in found])
    owner = np.repeat(np.arange(len(found)), [len(m.f) for _, m, _ in found])
    return trimesh.Trimesh(mesh.v, mesh.f, process=False), owner


def shell_meshes() -> list[Mesh]:
    fixed = [*hall.floor(layout.bays()), *hall.shell()]
    return [m for _, m in fixed] + [hall.panes(side) for side in (-1, 1)]


@pytest.mark.parametrize("seed", SEEDS)
def test_meshes_are_sound_and_within_the_hall(seed: int) -> None:
    lamps, discs = layout.lamps(seed)
    surfaces = [*hall.floor(layout.bays()), *hall.shell(), *hall.doors(), *layout.crane(seed), *lamps]
    surfaces += [part for thing in placed(seed) for part in thing.parts]
    assert {name for name, _ in surfaces} <= set(materials(seed))
    whole = merge([m for _, m in surfaces])
    assert np.isfinite(whole.v).all() and 150_000 < len(whole.f) < 500_000
    assert np.abs(np.linalg.norm(whole.n, axis=1) - 1).max() < 1e-9
    deep = hall.WIDE + hall.DEEP
    assert (np.abs(whole.v) <= (hall.LONG + 1e-9, hall.RIDGE + 1e-9, deep + 1e-9)).all() and whole.v[:, 1].min() >= 0
    face = np.cross(whole.v[whole.f[:, 1]] - whole.v[whole.f[:, 0]], whole.v[whole.f[:, 2]] - whole.v[whole.f[:, 0]])
    sized = np.linalg.norm(face, axis=1) > 1e-9
    assert (np.einsum("fk,fk->f", face, whole.n[whole.f].mean(1)) > 0)[sized].mean() > 0.9995
    assert len(discs) == 10 and all((m.n[:, 1] < -0.99).all() for m, _ in discs)


def test_the_shell_is_closed() -> None:
    mesh = merge(shell_meshes())
    rng = np.random.default_rng(2)
    d = rng.normal(size=(20_000, 3))
    corners = np.concatenate([m.v for m in shell_meshes()])
    seams = np.concatenate([corners, (corners[1:] + corners[:-1]) / 2])  # and closely beside corners and seams
    centre = np.array([0.3, 2.1, 0.2])
    d = np.concatenate([d, seams + rng.normal(0, 5e-4, seams.shape) - centre])
    solid = trimesh.Trimesh(mesh.v, mesh.f, process=False)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    first = solid.ray.intersects_first(np.broadcast_to(centre, d.shape), d)
    assert (first >= 0).all()
    front = np.einsum("rk,rk->r", solid.face_normals[first], d)
    assert (front < 0).all()  # and all of it faces inwards


@pytest.mark.parametrize("seed", SEEDS)
def test_no_thing_is_inside_another(seed: int) -> None:
    """Points on each thing, and straight up from there: what is entered has been left before, thing by thing."""
    solid, owner = everything(seed)
    rng = np.random.default_rng(seed)
    count = 4_000
    face = rng.choice(len(solid.faces), count, p=solid.area_faces / solid.area_faces.sum())
    few = rng.integers(0, len(solid.faces), count)
    face = np.concatenate([face, few])
    w = rng.dirichlet(np.ones(3), len(face))
    start = np.einsum("nk,nkd->nd", w, solid.triangles[face]) + EMBEDDED * solid.face_normals[face]
    way = np.array([0.013, 1.0, 0.021]) / np.linalg.norm([0.013, 1.0, 0.021])
    _, ray, hit = RayMeshIntersector(solid).intersects_location(start, np.broadcast_to(way, start.shape))
    other = owner[hit] != owner[face[ray]]
    leaving = np.sign(solid.face_normals[hit] @ way)
    depth = np.zeros((len(start), len(things(seed))))
    np.add.at(depth, (ray[other], owner[hit[other]]), leaving[other])
    inside = np.argwhere(depth > 0.5)
    names = [name for name, _, _ in things(seed)]
    assert not len(inside), sorted({(names[owner[face[i]]], names[k]) for i, k in inside})


@pytest.mark.parametrize("seed", SEEDS)
def test_what_does_not_hang_stands(seed: int) -> None:
    solid, owner = everything(seed)
    caster = RayMeshIntersector(solid)
    for k, (name, mesh, hangs) in enumerate(things(seed)):
        if hangs:
            continue
        low = mesh.v[:, 1].min()
        feet = mesh.v[mesh.v[:, 1] < low + 0.0006]
        if low <= 0.0025:
            assert low > 0, name
            gap = np.array([low])
        else:
            start = feet + np.array([0, 1e-4, 0])
            hits, ray, hit = caster.intersects_location(start, np.broadcast_to([0.0, -1.0, 0.0], start.shape))
            alien = owner[hit] != k
            gap = start[ray[alien], 1] - 1e-4 - hits[alien, 1]
        assert len(gap) and 0 < gap.min() < 0.0035, (name, gap.min() if len(gap) else "nothing below")
        centre, spread = mesh.v[:, [0, 2]].mean(0), np.ptp(feet[:, [0, 2]], axis=0)
        assert (np.abs(centre - feet[:, [0, 2]].mean(0)) < 0.35 + 0.5 * spread).all(), f"{name} tips over"


def same_planes(meshes: list[Mesh]) -> NDArray[np.int64]:
    """Pairs (n, 2) of triangles that face the same way in one plane and overlap there by more than 0.1 mm."""
    mesh = merge(meshes)
    corners = mesh.v[mesh.f]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1)
    keep = np.flatnonzero(area > 1e-6)
    corners, n = corners[keep], cross[keep] / area[keep, None]
    offset = np.einsum("fk,fk->f", corners[:, 0], n)
    key = np.round(np.concatenate([n * 500, offset[:, None] / 2e-4], axis=1)).astype(np.int64)
    _, group = np.unique(key @ [1_000_003, 10_000_000_019, 100_000_000_000_031, 1], return_inverse=True)
    axis = np.abs(n).argmax(axis=1)
    flat = np.take_along_axis(corners, np.array([[1, 2], [0, 2], [0, 1]])[axis][:, None, :], axis=2)
    low, high = flat.min(axis=1), flat.max(axis=1)
    order = np.lexsort((low[:, 0], group.reshape(-1)))
    group, low, high, flat = group.reshape(-1)[order], low[order], high[order], flat[order]
    pairs, i = [], np.arange(len(order) - 1)
    for lag in range(1, len(order)):  # a sweep along the first axis of each plane
        i = i[i + lag < len(order)]
        i = i[(group[i] == group[i + lag]) & (low[i + lag, 0] < high[i, 0] - 1e-4)]
        if not len(i):
            break
        j = i + lag
        beside = np.minimum(high[i, 1], high[j, 1]) - np.maximum(low[i, 1], low[j, 1]) > 1e-4
        pairs.append(np.stack([i[beside], j[beside]], axis=1))
    found = np.concatenate(pairs)
    return keep[order[found[shared(flat[found[:, 0]], flat[found[:, 1]]) > 1e-4]]]


def shared(one: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) how far triangles (n, 3, 2) reach into others in their plane; negative: a gap. Separating axes."""
    depth = np.full(len(one), np.inf)
    for of in (one, other):
        edge = np.roll(of, -1, axis=1) - of
        normal = np.stack([edge[..., 1], -edge[..., 0]], -1)
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
        a, b = (np.einsum("pcd,pkd->pkc", t, normal) for t in (one, other))
        depth = np.minimum(depth, (np.minimum(a.max(2), b.max(2)) - np.maximum(a.min(2), b.min(2))).min(axis=1))
    return depth


def test_overlapping_of_known_triangles() -> None:
    one = np.array([[0.0, 0], [1, 0], [0, 1]])
    others = np.array([one + 0.2, 1 - one, one + np.array([2, 0])])  # over it, the other half of a square, beside it
    depth = shared(np.array([one, one, one]), others)
    assert depth[0] > 0.1 and abs(depth[1]) < 1e-9 and depth[2] == pytest.approx(-1)
    low, high = box([0, 0, 0], [1, 1, 1]), box([0.5, 0.2, 0.2], [1, 0.8, 0.8])
    assert len(same_planes([low, move(high, (0.5, 0, 0))])) == 0  # they touch, facing each other
    assert len(same_planes([low, high])) > 0


@pytest.mark.parametrize("seed", SEEDS)
def test_no_two_faces_coincide(seed: int) -> None:
    found = things(seed)
    meshes = [*(m for _, m, _ in found), merge([m for _, m in [*hall.floor(layout.bays()), *hall.shell()]])]
    owner = np.repeat(np.arange(len(meshes)), [len(m.f) for m in meshes])
    names = [*(name for name, _, _ in found), "shell"]
    assert {(names[a], names[b]) for a, b in owner[same_planes(meshes)]} == set()


def test_a_seed_decides_everything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    again = layout.things(0)
    same = zip([m for t in again for _, m in t.parts], [m for t in placed(0) for _, m in t.parts], strict=True)
    assert all(np.array_equal(a.v, b.v) and np.array_equal(a.uv, b.uv) for a, b in same)
    assert {t.name for t in placed(0)} != {t.name for t in placed(1)}
    small = {seed: {name: shrunk(m) for name, m in materials(seed).items()} for seed in SEEDS}
    monkeypatch.setattr(scene, "materials", small.__getitem__)
    monkeypatch.setattr(layout, "things", placed)
    one, two, other = (scene.build(tmp_path / name, seed) for name, seed in (("a", 0), ("b", 0), ("c", 1)))
    first, second, third = (digest(xml.parent) for xml in (one, two, other))
    assert first == second
    changed = {name for name, state in first.items() if third.get(name) != state}
    assert {"meshes/machine_a.ply", "textures/machine_a.png", "textures/sky_north.pfm", "scene.xml"} <= changed
    files = [p for p in one.parent.rglob("*.*") if p != one]
    assert len(files) > 100 and all(p.relative_to(one.parent).as_posix() in one.read_text() for p in files)


def shrunk(material: Material) -> Material:
    """The same in 64 x 64 texels."""
    return replace(material, pixels=(64, 64))


def test_albedos_are_those_of_a_room() -> None:
    for name, material in materials(0).items():
        if material.paint is None:
            continue
        image = texture(shrunk(material)).astype(float) / 255
        linear = np.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4)
        assert linear.max() <= 0.81 and 0.04 < linear.mean() < 0.8, name
        assert linear.std() > 0.003, f"{name} has no texture"
