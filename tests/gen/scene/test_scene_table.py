"""The table's things: sound meshes, standing where they should, clear of one another; the scene around them."""

from __future__ import annotations

import hashlib
import itertools
import struct
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from rsgen.errors import UserError
from rsgen.scene.loading import content_hash, ensure_built, load_scene
from scenes.kit.pieces import Piece
from scenes.kit.shapes import merge
from scenes.living_room import layout, table
from scenes.living_room.room import FLOOR, RIGHT

ROOT = Path(__file__).resolve().parents[3]
STUB = (
    '<scene version="3.0.0"><bsdf type="diffuse" id="grey"/>'
    '<shape type="rectangle" id="ground"><ref id="grey"/></shape></scene>'
)
FURNITURE = [part for piece in layout.furnishing()[0] for part in piece.parts]
THINGS = {thing.name: thing for thing in table.things()}
Prism = tuple[np.ndarray, float, float]  # outline (n, 2) of x, z, counter-clockwise; lowest and highest y


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


def digest(folder: Path) -> dict[str, str]:
    """SHA-256 of every file below `folder`."""
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """table.xml, built once, beside a stand-in for the room."""
    folder = tmp_path_factory.mktemp("table")
    (folder / "scene.xml").write_text(STUB)
    return table.build(folder)


def vertices(thing: Piece) -> np.ndarray:
    """(n, 3) of all its parts."""
    return np.concatenate([mesh.v for _, mesh in thing.parts])


def prism(points: np.ndarray) -> Prism:
    """The upright prism over the convex outline of `points` (n, 3)."""
    flat = points[:, [0, 2]]
    return flat[ConvexHull(flat).vertices], float(points[:, 1].min()), float(points[:, 1].max())


def overlap(a: Prism, b: Prism) -> float:
    """How deep two prisms reach into each other, m, along the best separating direction; negative: a gap."""
    depth = min(a[2], b[2]) - max(a[1], b[1])
    for outline in (a[0], b[0]):
        edge = np.roll(outline, -1, axis=0) - outline
        normal = np.stack([edge[:, 1], -edge[:, 0]], 1) / np.linalg.norm(edge, axis=1)[:, None]
        pa, pb = a[0] @ normal.T, b[0] @ normal.T
        depth = min(depth, float(np.min(np.minimum(pa.max(0), pb.max(0)) - np.maximum(pa.min(0), pb.min(0)))))
    return depth


def test_overlap_of_known_prisms() -> None:
    square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    turned = square @ np.array([[1.0, 1], [-1, 1]]) / np.sqrt(2)  # a diamond from (0, 0) up to (0, sqrt 2)
    assert overlap((square, 0, 1), (square + 0.9, 0.0, 2)) == pytest.approx(0.1)
    assert overlap((square, 0, 1), (square, 0.98, 2)) == pytest.approx(0.02)
    assert overlap((square, 0, 1), (square, 1.25, 2)) == pytest.approx(-0.25)
    corner = overlap(
        (square, 0, 1), (turned + np.array([1.8, 0.8]), 0, 1)
    )  # bounding boxes overlap, the outlines do not
    assert corner < 0


def test_everyday_things_of_real_sizes() -> None:
    on_table = [thing for thing in THINGS.values() if thing.on == "table"]
    assert len(on_table) >= 12 and len(THINGS) - len(on_table) >= 8
    for thing in THINGS.values():
        outline, low, high = prism(vertices(thing))
        largest = max(np.linalg.norm(outline[:, None] - outline, axis=-1).max(), high - low)
        assert 0.05 <= largest <= 0.42, (thing.name, largest)


@pytest.mark.parametrize("name", THINGS)
def test_meshes_are_sound(name: str) -> None:
    mesh = merge([part for _, part in THINGS[name].parts])
    assert np.abs(np.linalg.norm(mesh.n, axis=1) - 1).max() < 1e-9
    solid = trimesh.Trimesh(mesh.v, mesh.f, process=False)
    solid.merge_vertices(merge_tex=True, merge_norm=True, digits_vertex=7)
    assert solid.is_watertight and solid.is_winding_consistent
    assert all(piece.volume > 0 for piece in solid.split(only_watertight=False))
    face = np.cross(mesh.v[mesh.f[:, 1]] - mesh.v[mesh.f[:, 0]], mesh.v[mesh.f[:, 2]] - mesh.v[mesh.f[:, 0]])
    sized = np.linalg.norm(face, axis=1) > 1e-9
    assert (np.einsum("fk,fk->f", face, mesh.n[mesh.f].mean(1)) > 0)[sized].mean() > 0.999


@pytest.mark.parametrize("name", THINGS)
def test_things_rest_on_what_bears_them(name: str) -> None:
    thing = THINGS[name]
    points = vertices(thing)
    low = points[points[:, 1] < points[:, 1].min() + 0.004]
    if thing.on in THINGS:
        bearer = THINGS[thing.on].parts
    else:
        bearer = [part for part in FURNITURE if part[0] == {"table": "lacquer", "rug": "rug"}.get(thing.on)]
    foot = low[:, [0, 2]].mean(0)
    if bearer:
        solid = trimesh.util.concatenate([trimesh.Trimesh(m.v, m.f, process=False) for _, m in bearer])
        ray = np.array([[foot[0], 3.0, foot[1]]])
        hits = solid.ray.intersects_location(ray, [[0.0, -1.0, 0.0]])[0]
        assert len(hits), f"{name} hangs in the air"
        level = float(hits[:, 1].max())
    else:
        level = FLOOR
    tolerance = 0.002 if thing.on == "rug" else 0.001  # the rug waves by 0.6 mm
    assert 0.0001 <= points[:, 1].min() - level <= tolerance
    centre = merge([part for _, part in thing.parts]).v[:, [0, 2]].mean(0)
    assert np.linalg.norm(centre - foot) < 0.05  # and does not tip over


def test_things_stay_on_the_table_top() -> None:
    (top,) = [m for material, m in FURNITURE if material == "lacquer"]
    flat = top.v[np.abs(top.v[:, 1] - top.v[:, 1].max()) < 1e-6]
    lo, hi = flat.min(0), flat.max(0)
    assert np.allclose((lo + hi)[[0, 2]] / 2, table.TABLE)
    for thing in THINGS.values():
        if thing.on == "table":
            foot = vertices(thing)
            foot = foot[foot[:, 1] < foot[:, 1].min() + 0.003]
            assert (foot >= lo)[:, [0, 2]].all() and (foot <= hi)[:, [0, 2]].all(), thing.name


def test_things_keep_clear_of_one_another() -> None:
    prisms = {name: prism(vertices(thing)) for name, thing in THINGS.items()}
    meeting = [(a, b, d) for a, b in itertools.combinations(prisms, 2) if (d := overlap(prisms[a], prisms[b])) > 0]
    # The block stands on its neighbour, the magazine's lifted corner is higher than what lies on it.
    bearing = {frozenset((thing.name, thing.on)) for thing in THINGS.values()}
    assert [m for m in meeting if frozenset(m[:2]) not in bearing] == []


def test_things_keep_clear_of_the_room() -> None:
    prisms = {name: prism(vertices(thing)) for name, thing in THINGS.items()}
    solids = [(material, prism(m.v)) for material, m in FURNITURE if material not in ("rug", "picture", "clock")]
    meeting = [(n, material, d) for n, p in prisms.items() for material, q in solids if (d := overlap(p, q)) > 0]
    assert meeting == []
    assert all(outline[:, 0].max() < RIGHT for outline, _, _ in prisms.values())


def test_two_builds_are_equal_byte_for_byte(built: Path, tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_text(STUB)
    (tmp_path / "objects").mkdir()
    (tmp_path / "objects" / "left over.ply").write_text("from an older version")
    assert digest(table.build(tmp_path).parent) == digest(built.parent)
    assert (built.parent / "scene.xml").read_text() == STUB


def test_files_are_small_and_named(built: Path) -> None:
    files = sorted((built.parent / "objects").iterdir())
    assert sum(f.stat().st_size for f in files if f.suffix == ".ply") < 3e6
    assert sum(f.stat().st_size for f in files if f.suffix == ".jpg") < 1.5e6
    root = ET.parse(built).getroot()
    named = [e.get("value", "") for e in root.iter("string")]
    assert sorted(named) == [f"objects/{f.name}" for f in files]
    assert {e.get("type") for e in root.iter("bsdf")} == {"twosided", "diffuse"}
    triangles = sum(len(read_ply(f)[1]) for f in files if f.suffix == ".ply")
    assert triangles == sum(len(m.f) for thing in THINGS.values() for _, m in thing.parts) < 80_000


def picture(file: Path) -> np.ndarray:
    """(h, w, 3) float32 sRGB in 0..1, blue first."""
    image = cv2.imread(str(file))
    assert image is not None
    return image.astype(np.float32) / 255


def texel_sizes(folder: Path) -> dict[str, float]:
    """Metres a texel (geometric mean over the surface) of every material's image."""
    sizes = {}
    for file in sorted(folder.glob("*.ply")):
        v, f = read_ply(file)
        height, width = picture(file.with_suffix(".jpg")).shape[:2]
        e, t = v[f[:, 1:], :3] - v[f[:, :1], :3], (v[f[:, 1:], 6:] - v[f[:, :1], 6:]) * (width, height)
        area, texels = np.linalg.norm(np.cross(e[:, 0], e[:, 1]), axis=1).sum(), np.abs(np.linalg.det(t)).sum()
        sizes[file.stem] = float(np.sqrt(area / texels))
    return sizes


def test_prints_have_gradients_at_millimetres(built: Path) -> None:
    folder = built.parent / "objects"
    for name, metres in texel_sizes(folder).items():
        assert 0.0001 < metres < 0.0012, (name, metres)
        image = picture(folder / f"{name}.jpg")
        linear = np.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4)
        assert np.quantile(linear, 0.999) <= 0.85 and 0.06 < linear.mean() < 0.75, name
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        grey = cv2.GaussianBlur(grey, (0, 0), 0.5e-3 / metres)  # as a camera at 1 m sees it
        step = np.hypot(cv2.Sobel(grey, -1, 1, 0), cv2.Sobel(grey, -1, 0, 1)) / 8 / (metres * 1e3)
        assert np.median(step) > 0.004, (name, np.median(step))  # grey levels (of 1) a millimetre


def test_scene_loads_with_the_room(built: Path) -> None:
    shapes = {shape.id(): shape for shape in load_scene(built).shapes()}
    assert "ground" in shapes and len(shapes) == 1 + len(table.OBJECT_MATERIALS)
    boxes = np.array([np.array([s.bbox().min, s.bbox().max]).reshape(2, 3) for n, s in shapes.items() if n != "ground"])
    points = np.concatenate([vertices(thing) for thing in THINGS.values()])
    assert np.allclose(boxes[:, 0].min(0), points.min(0), atol=1e-5)
    assert np.allclose(boxes[:, 1].max(0), points.max(0), atol=1e-5)


def test_print_is_not_mirrored(built: Path) -> None:
    """A camera above the open book sees its page as the image file has it."""
    v, _ = read_ply(built.parent / "objects" / "spread.ply")
    x_u = np.linalg.lstsq(np.c_[v[:, 6:], np.ones(len(v))], v[:, [0, 2]], rcond=None)[0]
    right, down = x_u[0], x_u[1]  # directions of growing u and v on the table, (x, z)
    assert np.cross(np.array([right[0], 0, right[1]]), np.array([down[0], 0, down[1]]))[1] < 0


@pytest.mark.parametrize("changed", ["table.xml", "scene.xml", "objects/tin.ply", "objects/covers.jpg"])
def test_hash_covers_room_and_things(built: Path, changed: str) -> None:
    before = content_hash(built)
    file = built.parent / changed
    kept = file.read_bytes()
    try:
        file.write_bytes(kept + b"\n")
        assert content_hash(built) != before
    finally:
        file.write_bytes(kept)
    assert content_hash(built) == before


def test_hash_covers_the_rooms_meshes(tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_text(
        '<scene version="3.0.0"><shape type="ply"><string name="filename" value="a.ply"/></shape></scene>'
    )
    (tmp_path / "table.xml").write_text('<scene version="3.0.0"><include filename="scene.xml"/></scene>')
    trimesh.creation.box().export(tmp_path / "a.ply")
    before = content_hash(tmp_path / "table.xml")
    trimesh.creation.box((1, 1, 2)).export(tmp_path / "a.ply")
    assert content_hash(tmp_path / "table.xml") != before
    (tmp_path / "scene.xml").unlink()
    with pytest.raises(UserError, match=r"table\.xml.*includ"):
        content_hash(tmp_path / "table.xml")


def test_a_missing_scene_is_built_by_its_own_script(tmp_path: Path) -> None:
    (tmp_path / "build.py").write_text(
        "import pathlib\npathlib.Path(__file__).with_name('scene.xml').write_text('s')\n"
    )
    (tmp_path / "table.py").write_text(
        "import pathlib\npathlib.Path(__file__).with_name('table.xml').write_text('t')\n"
    )
    ensure_built(tmp_path / "table.xml")
    assert (tmp_path / "table.xml").read_text() == "t" and not (tmp_path / "scene.xml").exists()
    ensure_built(tmp_path / "scene.xml")
    assert (tmp_path / "scene.xml").read_text() == "s"
    (tmp_path / "build.py").unlink()
    (tmp_path / "other.py").write_text("raise SystemExit(3)")
    with pytest.raises(UserError, match="no such file"):  # no folder of ours: its scripts are none of our business
        ensure_built(tmp_path / "other.xml")


def test_script_keeps_a_room_that_is_there(tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_text(STUB)
    script = ROOT / "scenes" / "living_room" / "table.py"
    done = subprocess.run([sys.executable, script, "--out", tmp_path], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == str(tmp_path / "table.xml")
    assert (tmp_path / "scene.xml").read_text() == STUB and (tmp_path / "table.xml").is_file()
