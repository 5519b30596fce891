"""Rooms of several seeds, unpainted: closed, well formed, nothing intersects or floats, no two faces coincide."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from scenes.corridor import build as corridor
from scenes.kit.materials import Material, texture
from scenes.kit.pieces import Piece, kelvin
from scenes.kit.room_files import AreaLamp
from scenes.kit.shapes import Mesh, box, merge, move
from scenes.living_room import build as living_room
from scenes.office import build as office
from scenes.workshop import build as workshop

BOUNDS = {
    "office": np.array([[-4, 0, -3.14], [4, 2.8, 3.14]]),
    "corridor": np.array([[-0.1, 0, -1.3], [18.36, 4.7, 1.3]]),
    "workshop": np.array([[-10, 0, -6.16], [10, 6, 6.16]]),
    # ICL-NUIM's, with x = -x_POV; z up to the window pane
    "living_room": np.array([[-2.425, 0.133, -1.930], [2.512, 2.632, 3.090]]),
}
PLACES = {
    "office": np.array([[-0.2, 1.6, -1.9], [0.9, 1.7, 0.4], [1.9, 1.6, 0.0]]),
    "corridor": np.array([[1, 1.6, 0.1], [10, 1.6, -0.2], [16, 3.0, -0.4], [16.5, 1.5, 0.7]]),
    "workshop": np.array([[0.3, 2.1, 0.2], [-9.0, 1.6, 0.1], [9.0, 4.0, 0.0]]),
    "living_room": np.array([[0.0, 1.4, 0.6]]),
}
ROOMS: dict[str, ModuleType] = {
    "office": office,
    "corridor": corridor,
    "workshop": workshop,
    "living_room": living_room,
}
SEEDED = ("office", "corridor", "workshop")
VARIANTS = [("office", 0), ("office", 1), ("corridor", 1), ("workshop", 0), ("workshop", 1)]
ALL = [*VARIANTS, ("living_room", 0)]
TOUCH = 0.004  # metres within which things that bear each other stand apart


@dataclass(frozen=True)
class Room:
    """A room's triangles (m, 3, 3), and of each its piece, whether it is glass, and its corners' mean normal (m, 3)."""

    pieces: list[Piece]
    lamps: list[AreaLamp]
    triangles: np.ndarray
    owner: np.ndarray
    glass: np.ndarray
    normals: np.ndarray


@cache
def made(name: str, seed: int) -> Room:
    pieces, lamps = ROOMS[name].contents(*[seed] if name in SEEDED else [])
    parts = [(i, material, mesh) for i, piece in enumerate(pieces) for material, mesh in piece.parts]
    parts += [(len(pieces) + i, lamp.material, lamp.mesh) for i, lamp in enumerate(lamps)]
    sizes = [len(mesh.f) for _, _, mesh in parts]
    return Room(
        pieces,
        lamps,
        np.concatenate([mesh.v[mesh.f] for _, _, mesh in parts]),
        np.repeat([i for i, _, _ in parts], sizes),
        np.repeat([material == "glass" for _, material, _ in parts], sizes),
        np.concatenate([mesh.n[mesh.f].mean(1) for _, _, mesh in parts]),
    )


def caster(triangles: np.ndarray):
    embree = pytest.importorskip("trimesh.ray.ray_pyembree")
    mesh = trimesh.Trimesh(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3), process=False)
    return embree.RayMeshIntersector(mesh, scale_to_box=False)


def first_hits(triangles: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n,) index of the first triangle met, -1 for none, and its distance."""
    index = caster(triangles).intersects_first(origins, directions)
    hit = index >= 0
    t = np.full(len(origins), np.inf)
    a, b, c = (triangles[index[hit], k] for k in range(3))
    n = np.cross(b - a, c - a)
    t[hit] = np.einsum("ij,ij->i", a - origins[hit], n) / np.einsum("ij,ij->i", directions[hit], n)
    return index, t


def directions(count: int, seed: int) -> np.ndarray:
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


@pytest.mark.parametrize(("name", "seed"), ALL)
def test_meshes_are_well_formed(name: str, seed: int) -> None:
    room, (lo, hi) = made(name, seed), BOUNDS[name]
    assert 80_000 <= len(room.triangles) <= 700_000 and len(room.lamps) <= 20
    assert np.isfinite(room.triangles).all()
    assert (room.triangles >= lo - 1e-6).all() and (room.triangles <= hi + 1e-6).all()
    face = np.cross(room.triangles[:, 1] - room.triangles[:, 0], room.triangles[:, 2] - room.triangles[:, 0])
    sized = np.linalg.norm(face, axis=1) > 1e-9
    assert (np.einsum("fk,fk->f", face, room.normals) > 0)[sized].mean() > 0.999, "normals against the winding"


@pytest.mark.parametrize(("name", "seed"), ALL)
def test_rooms_are_closed_and_show_their_fronts(name: str, seed: int) -> None:
    room, bounds, places = made(name, seed), BOUNDS[name], PLACES[name]
    d = directions(4000, 2)
    edges = np.array(np.meshgrid(*bounds.T)).reshape(3, -1).T
    corners = [(edges - p) / np.linalg.norm(edges - p, axis=1, keepdims=True) for p in places]
    rays = np.concatenate([np.concatenate([d, corner]) for corner in corners])
    index, _ = first_hits(room.triangles, np.repeat(places, len(d) + len(edges), axis=0), rays)
    assert (index >= 0).all(), f"{(index < 0).sum()} rays leave the room"
    if name not in SEEDED:
        return  # its sheets show their backs
    back = (np.einsum("ij,ij->i", room.normals[index], rays) > 1e-3) & ~room.glass[index]
    shown = {room.pieces[i].name if i < len(room.pieces) else "lamp" for i in room.owner[index[back]]}
    assert back.mean() < 1e-3, f"backs are seen of {shown}"


def crossings(pieces: list[Piece]) -> list[tuple[str, str]]:
    """Pairs of pieces of which an edge of one goes through a face of the other."""
    found = []
    meshes = [np.concatenate([mesh.v[mesh.f] for _, mesh in piece.parts]) for piece in pieces]
    boxes = [(m.min((0, 1)), m.max((0, 1))) for m in meshes]
    for i, (lo, hi) in enumerate(boxes):
        others = [j for j, (a, b) in enumerate(boxes) if j != i and (a < hi).all() and (b > lo).all()]
        if not others:
            continue
        own = meshes[i]
        start = own.reshape(-1, 3)
        step = own[:, [1, 2, 0]].reshape(-1, 3) - start
        length = np.linalg.norm(step, axis=1)
        keep = length > 1e-6
        start, step, length = start[keep], step[keep], length[keep]
        for j in others:
            a, b = boxes[j]
            near = ((np.minimum(start, start + step) < b) & (np.maximum(start, start + step) > a)).all(1)
            if near.any():
                unit = step[near] / length[near, None]
                _, t = first_hits(meshes[j], start[near], unit)
                if ((t > 1e-5) & (t < length[near] - 1e-5)).any():
                    found.append((pieces[i].name, pieces[j].name))
    return found


@pytest.mark.parametrize(("name", "seed"), VARIANTS)
def test_nothing_intersects(name: str, seed: int) -> None:
    assert crossings(made(name, seed).pieces) == []


def test_crossings_are_found() -> None:
    a, b = Piece("a", [("", box([0, 0, 0], [1, 1, 1]))]), Piece("b", [("", box([0.4, 0.9, 0.4], [0.6, 1.5, 0.6]))])
    c = Piece("c", [("", box([0.4, 1.001, 0.4], [0.6, 1.5, 0.6]))])
    assert ("b", "a") in crossings([a, b]) and crossings([a, c]) == []


def floating(room: Room) -> list[str]:
    """Pieces none of whose outermost corners, along an axis, is within TOUCH of another piece."""
    origins, rays, whose = [], [], []
    for i, piece in enumerate(room.pieces[1:], start=1):
        v = np.concatenate([mesh.v for _, mesh in piece.parts])
        for axis in (1, 0, 2):
            for sign in (-1.0, 1.0):
                end = (sign * v[:, axis]).max()
                far = v[sign * v[:, axis] > end - 0.001]
                far = far[:: max(1, len(far) // 60)].copy()
                far[:, axis] = sign * (end + 1e-5)  # so that the piece itself is not met
                origins.append(far)
                rays.append(np.tile(sign * np.eye(3)[axis], (len(far), 1)))
                whose.append(np.full(len(far), i))
    _, t = first_hits(room.triangles, np.concatenate(origins), np.concatenate(rays))
    held = set(np.concatenate(whose)[t < TOUCH].tolist())
    return [piece.name for i, piece in enumerate(room.pieces) if i and i not in held]


@pytest.mark.parametrize(("name", "seed"), VARIANTS)
def test_nothing_floats(name: str, seed: int) -> None:
    assert floating(made(name, seed)) == []


def test_floating_is_found() -> None:
    room = made("corridor", 1)
    up = [
        replace(p, parts=[(m, replace(x, v=x.v + np.array([0, 0.05, 0]))) for m, x in p.parts])
        if p.name == "bin"
        else p
        for p in room.pieces
    ]
    i = [p.name for p in up].index("bin")
    moved = room.triangles + (room.owner == i)[:, None, None] * np.array([0, 0.05, 0])
    assert floating(replace(room, pieces=up, triangles=moved)) == ["bin"]


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


@pytest.mark.parametrize(("name", "seed"), VARIANTS)
def test_no_two_faces_coincide(name: str, seed: int) -> None:
    room = made(name, seed)
    meshes = [(piece.name, mesh) for piece in room.pieces for _, mesh in piece.parts]
    meshes += [(lamp.name, lamp.mesh) for lamp in room.lamps]
    owner = np.repeat([whose for whose, _ in meshes], [len(mesh.f) for _, mesh in meshes])
    assert {(a, b) for a, b in owner[same_planes([mesh for _, mesh in meshes])].tolist()} == set()


@pytest.mark.parametrize("name", SEEDED)
def test_seeds_differ(name: str) -> None:
    one, other = (made(name, seed) for seed in (0, 1))
    assert len(one.triangles) != len(other.triangles)
    assert [p.bounds.tolist() for p in one.pieces] != [p.bounds.tolist() for p in other.pieces]
    assert [lamp.radiance for lamp in one.lamps] != [lamp.radiance for lamp in other.lamps]


def small(material: Material) -> Material:
    h, w = material.pixels
    return replace(material, pixels=(max(h // 8, 96), max(w // 8, 96)))


@pytest.mark.parametrize("name", ROOMS)
def test_two_builds_are_equal_and_named_right(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script, seed = ROOMS[name], [1] if name in SEEDED else []
    if seed:
        painted = {k: small(m) for k, m in script.materials(1).items()}
        monkeypatch.setattr(script, "materials", lambda _: painted)
    else:
        monkeypatch.setattr(script, "MATERIALS", {k: small(m) for k, m in script.MATERIALS.items()})
    once = made(name, 1)
    monkeypatch.setattr(script, "contents", lambda *_: (once.pieces, once.lamps))
    xml = script.build(tmp_path / "a", *seed)
    script.build(tmp_path / "b", *seed)
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*") if p.is_file())
    assert all((tmp_path / "a" / f).read_bytes() == (tmp_path / "b" / f).read_bytes() for f in files)
    root = ET.parse(xml).getroot()
    named = [e.get("value", "") for e in root.iter("string") if e.get("name") == "filename"]
    assert {str(f) for f in files} == {*named, "scene.xml", "parts.csv"}
    ids = {e.get("id") for e in root.findall("bsdf")}
    assert {e.get("id") for e in root.iter("ref")} <= ids
    assert {e.get("type") for e in root.findall("bsdf")} <= {"twosided", "thindielectric"}
    for path in (xml.parent / "textures").glob("*.png"):
        image = cv2.imread(str(path)).astype(float) / 255
        linear = np.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4)
        assert 0.03 < linear.mean() < 0.8 and linear.max() <= 0.81, path.name
        assert linear.std() > 0.002, f"{path.name} has no texture"


def test_a_painter_keeps_within_the_kits_albedos() -> None:
    bright = texture(Material(lambda s: np.full((*s, 3), 2.0, np.float32), (4, 4)))
    assert bright.max() == 231  # sRGB of 0.80


def test_black_bodies_have_their_colours() -> None:
    for temperature, xy in ((2856, (0.4476, 0.4074)), (6504, (0.3135, 0.3237)), (4000, (0.3805, 0.3768))):
        rgb_to_xyz = np.array(
            [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
        )
        xyz = rgb_to_xyz @ kelvin(temperature)
        assert np.abs(xyz[:2] / xyz.sum() - xy).max() < 0.002
        assert abs(xyz[1] - 1) < 1e-3
