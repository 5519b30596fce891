"""The living room as a scene: closed, well formed, reproducible, and wide enough for its trajectories."""

from __future__ import annotations

import hashlib
import struct
import xml.etree.ElementTree as ET
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from scenes.kit.materials import Material
from scenes.living_room import build as scene

ROOT = Path(__file__).resolve().parents[3]
ICL = ROOT.parent / "shared" / "data" / "icl_nuim_livingroom"
ROOM = np.array([[-2.425, 0.133, -1.930], [2.512, 2.632, 3.090]])  # SOURCE.md with x = -x_POV; z up to the window pane
CLEARANCE = 0.15


@dataclass(frozen=True)
class Built:
    """A built scene and its meshes: vertices (n, 8) = x y z nx ny nz u v, faces (m, 3), by file stem."""

    xml: Path
    meshes: dict[str, tuple[np.ndarray, np.ndarray]]

    @property
    def triangles(self) -> np.ndarray:
        """(m, 3, 3) corners of every triangle."""
        return np.concatenate([v[:, :3][f] for v, f in self.meshes.values()])


def read_ply(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 8) float64 and faces (m, 3) of our binary PLY, read from its header and not by our writer."""
    head, body = path.read_bytes().split(b"end_header\n", 1)
    counts = {line.split()[1]: int(line.split()[2]) for line in head.splitlines() if line.startswith(b"element")}
    names = [line.split()[-1] for line in head.splitlines() if line.startswith(b"property float")]
    assert names == [b"x", b"y", b"z", b"nx", b"ny", b"nz", b"u", b"v"]
    n, m = counts[b"vertex"], counts[b"face"]
    assert len(body) == n * struct.calcsize("<8f") + m * struct.calcsize("<B3i")
    v = np.frombuffer(body, "<f4", 8 * n).reshape(n, 8).astype(float)
    f = np.frombuffer(body, np.dtype([("n", "u1"), ("i", "<i4", 3)]), m, offset=32 * n)
    assert (f["n"] == 3).all()
    return v, f["i"].astype(int)


@pytest.fixture(scope="session")
def built(tmp_path_factory: pytest.TempPathFactory) -> Built:
    """The room, built once for all tests, its textures painted at a quarter of their size: it takes less time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene, "MATERIALS", painted_small(4))
        xml = scene.build(tmp_path_factory.mktemp("living_room"))
    return Built(xml, {p.stem: read_ply(p) for p in sorted((xml.parent / "meshes").glob("*.ply"))})


def painted_small(part: int) -> dict[str, Material]:
    """The room's materials with textures of so many times fewer pixels each way."""
    return {n: replace(m, pixels=(m.pixels[0] // part, m.pixels[1] // part)) for n, m in scene.MATERIALS.items()}


def digest(folder: Path) -> dict[str, str]:
    """SHA-256 of every file below `folder`."""
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def distances(triangles: np.ndarray, points: np.ndarray, reach: float) -> np.ndarray:
    """(n,) exact distance of each point to the nearest triangle, `reach` where there is none nearer than that."""
    centre = triangles.mean(1)
    radius = np.linalg.norm(triangles - centre[:, None], axis=-1).max(1)
    tree = cKDTree(points)
    near = np.flatnonzero(tree.query(centre)[0] - radius < reach)
    hits = tree.query_ball_point(centre[near], reach + radius[near])
    i = np.concatenate([np.asarray(h, int) for h in hits])
    j = np.repeat(near, [len(h) for h in hits])
    out = np.full(len(points), reach)
    np.minimum.at(out, i, np.linalg.norm(trimesh.triangles.closest_point(triangles[j], points[i]) - points[i], axis=1))
    return out


def test_distances_against_brute_force() -> None:
    rng = np.random.default_rng(1)
    triangles = rng.normal(size=(60, 1, 3)) + rng.normal(size=(60, 3, 3)) * rng.uniform(0.05, 1.5, (60, 1, 1))
    points = rng.normal(size=(40, 3))
    w = rng.dirichlet(np.ones(3), 20000)
    sampled = np.stack([np.linalg.norm(w @ t - points[:, None], axis=-1).min(1) for t in triangles]).min(0)
    exact = distances(triangles, points, 9.0)
    assert (exact <= sampled + 1e-9).all() and np.abs(exact - sampled).max() < 0.03


def test_two_builds_are_equal_byte_for_byte(
    built: Built, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    monkeypatch.setattr(scene, "MATERIALS", painted_small(4))
    again = digest(scene.build(tmp_path / "again").parent)
    assert again == digest(built.xml.parent) and len(again) > 60


def test_meshes_are_well_formed(built: Built) -> None:
    assert 200_000 <= len(built.triangles) <= 700_000
    assert len(built.meshes) <= 60
    for name, (v, f) in built.meshes.items():
        assert np.isfinite(v).all(), name
        assert np.abs(np.linalg.norm(v[:, 3:6], axis=1) - 1).max() < 1e-5, name
        assert f.min() >= 0 and f.max() < len(v), name
        assert (v[:, :3] >= ROOM[0] - 1e-5).all() and (v[:, :3] <= ROOM[1] + 1e-5).all(), name
        face = np.cross(v[f[:, 1], :3] - v[f[:, 0], :3], v[f[:, 2], :3] - v[f[:, 0], :3])
        sized = np.linalg.norm(face, axis=1) > 1e-9
        agree = np.einsum("fk,fk->f", face, v[f, 3:6].mean(1)) > 0
        assert agree[sized].mean() > 0.999, f"{name}: normals against the winding"


def test_shell_is_closed(built: Built) -> None:
    rng = np.random.default_rng(2)
    d = rng.normal(size=(10_000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    shell = [
        built.meshes[n] for n in ("floor", "ceiling", "wall_back", "wall_front", "wall_left", "wall_right", "paint")
    ]
    shell.append(built.meshes["window_pane"])
    meshes = [trimesh.Trimesh(v[:, :3], f, process=False) for v, f in shell]
    mesh = trimesh.util.concatenate(meshes)
    centre = np.array([0.0, 1.4, 0.6])
    edges = np.array(np.meshgrid(*ROOM.T)).reshape(3, -1).T - centre  # and straight into the corners
    d = np.concatenate([d, edges / np.linalg.norm(edges, axis=1, keepdims=True)])
    try:
        from trimesh.ray.ray_pyembree import RayMeshIntersector
    except ImportError:
        pytest.skip("embreex is not installed")
    hit = RayMeshIntersector(mesh).intersects_any(np.broadcast_to(centre, d.shape), d)
    assert hit.all(), f"{(~hit).sum()} rays leave the room"


def test_scene_file_names_what_exists(built: Built) -> None:
    root = ET.parse(built.xml).getroot()
    files = [e.get("value", "") for e in root.iter("string") if e.get("name") == "filename"]
    assert all(not Path(f).is_absolute() and (built.xml.parent / f).is_file() for f in files)
    assert sorted(f for f in files if f.endswith(".ply")) == [f"meshes/{name}.ply" for name in built.meshes]
    ids = {e.get("id") for e in root.findall("bsdf")}
    assert len(ids) <= 50
    assert {e.get("id") for e in root.iter("ref")} <= ids
    assert all(e.get("type") == "twosided" for e in root.findall("bsdf"))
    kinds = {e.get("type") for e in root.iter("bsdf")}
    assert kinds <= {"twosided", "diffuse", "roughplastic", "roughconductor"}
    assert {e.get("type") for e in root.iter("emitter")} == {"area"}


def test_albedos_are_those_of_a_room(built: Built) -> None:
    textures = sorted((built.xml.parent / "textures").glob("*.png"))
    assert sum(p.stat().st_size for p in textures) < 60e6
    for path in textures:
        image = cv2.imread(str(path)).astype(float) / 255
        linear = np.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4)
        assert linear.max() <= 0.85, path.name
        assert 0.04 < linear.mean() < 0.8, path.name
        assert linear.std() > 0.003, f"{path.name} has no texture"


@pytest.mark.parametrize("k", range(4))
def test_icl_nuim_trajectories_keep_clear(built: Built, k: int) -> None:
    path = ICL / f"livingRoom{k}.rh_tum.txt"
    if not path.is_file():
        pytest.skip("ICL-NUIM's trajectories are not part of the repository")
    p = np.loadtxt(path)[:, 1:4]
    p = np.concatenate([p[:-1] + (p[1:] - p[:-1]) * a for a in (0.0, 1 / 3, 2 / 3)] + [p[-1:]])
    assert distances(built.triangles, p, 0.3).min() >= CLEARANCE


@pytest.mark.parametrize("path", sorted((ROOT / "configs").glob("*_trajectory.txt")), ids=lambda p: p.stem)
def test_own_trajectories_keep_clear(built: Built, path: Path) -> None:
    assert distances(built.triangles, np.loadtxt(path)[:, 1:4], 0.3).min() >= CLEARANCE
