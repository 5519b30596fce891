"""Pictures of meshes: what is drawn lies where a pinhole sees it, in its colour, lit; ceilings are looked through."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from rsgen.errors import UserError
from rsgen.pictures.meshes import ColoredMesh, frame_meshes, parse_point, picture_meshes, read_mesh

RED, GREEN, BLUE = (200, 30, 30), (30, 200, 30), (30, 30, 200)
SIZE = 64
TITLE, GAP = 30, 6


def write(path: Path, vertices: object, faces: object, colors: object = None) -> Path:
    """A PLY as trimesh writes it."""
    mesh = trimesh.Trimesh(np.asarray(vertices, float), np.asarray(faces), vertex_colors=colors, process=False)
    path.write_bytes(mesh.export(file_type="ply"))
    return path


def triangle(size: float) -> bytes:
    """A PLY of one triangle."""
    data: bytes = trimesh.Trimesh(np.eye(3) * size, [(0, 1, 2)], process=False).export(file_type="ply")
    return data


def write_room(path: Path, inward: bool) -> Path:
    """A 4 x 2 x 3 m box: red floor, blue ceiling, green walls; its faces seen from inside, or from outside."""
    box = trimesh.creation.box((4, 2, 3))
    box.unmerge_vertices()
    y = box.face_normals[:, 1]
    colors = np.where(y[:, None] < -0.5, RED, np.where(y[:, None] > 0.5, BLUE, GREEN))
    faces = box.faces[:, ::-1] if inward else box.faces
    vertices = np.add(box.vertices, (1.0, 5.0, -2.0))
    return write(path, vertices, faces, np.repeat(colors, 3, axis=0)[np.argsort(box.faces.ravel())])


def write_quad(path: Path, corners: object, color: object = (120, 120, 120)) -> Path:
    """A quad in z = 0, its front towards +z, from corner (x0, y0) to (x1, y1)."""
    (x0, y0), (x1, y1) = corners  # type: ignore[misc, attr-defined]
    vertices = [(x0, y0, 0), (x1, y0, 0), (x1, y1, 0), (x0, y1, 0)]
    return write(path, vertices, [(0, 1, 2), (0, 2, 3)], np.tile(color, (4, 1)))


def drawn(paths: list[Path], out: Path, **how: object) -> np.ndarray:
    """The picture without its titles (SIZE, SIZE, 3) of the first mesh."""
    picture_meshes(paths, out, width=SIZE, height=SIZE, **how)  # type: ignore[arg-type]
    return cv2.cvtColor(cv2.imread(str(out)), cv2.COLOR_BGR2RGB)[TITLE:, :SIZE].astype(int)


def kinds(image: np.ndarray) -> dict[str, int]:
    """Pixels in which one channel rules, by its name."""
    strongest, rest = image.argmax(-1), np.sort(image, axis=-1)
    return {name: int(((strongest == k) & (rest[..., 2] > 2 * rest[..., 1])).sum()) for k, name in enumerate("rgb")}


def test_a_room_is_looked_into_through_its_ceiling(tmp_path: Path) -> None:
    inside = kinds(drawn([write_room(tmp_path / "in.ply", inward=True)], tmp_path / "in.png"))
    assert inside["r"] > 300 and inside["g"] > 300 and inside["b"] == 0
    outside = kinds(drawn([write_room(tmp_path / "out.ply", inward=False)], tmp_path / "out.png"))
    assert outside["b"] > 300 and outside["g"] > 100 and outside["r"] == 0


@pytest.mark.parametrize("stretch", [(1, 1, 1), (3, 1, 1), (1, 1, 3), (0.2, 5, 0.2)])
@pytest.mark.parametrize(("width", "height"), [(64, 64), (160, 64)])
def test_the_view_from_above_takes_in_all_and_little_more(
    stretch: tuple[float, float, float], width: int, height: int
) -> None:
    rng = np.random.default_rng(1)
    vertices = (rng.uniform(-1, 1, (5000, 3)) * stretch + (3, -4, 5)).astype(np.float32)
    vertices[0] = (500, 500, 500)  # a stray
    half = [
        ColoredMesh(part, np.zeros((0, 3), np.int64), np.zeros_like(part), np.zeros_like(part))
        for part in np.array_split(vertices, 2)
    ]
    view = frame_meshes(half, None, None, width, height)
    R, eye = view.T_world_cam[:3, :3], view.T_world_cam[:3, 3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) > 0 and eye[1] > vertices[1:, 1].max()
    uv, valid = view.camera.project((vertices[1:] - eye) @ R)
    assert valid.all()
    inside = ((uv >= -0.5) & (uv <= (width - 0.5, height - 0.5))).all(axis=1)
    assert inside.mean() > 0.99
    filled = np.ptp(uv[inside], axis=0) / (width, height)
    assert filled.max() > 0.85
    middle = (uv[inside].max(axis=0) + uv[inside].min(axis=0)) / 2
    assert np.abs(middle - ((width - 1) / 2, (height - 1) / 2)).min() < 0.05 * width


def test_a_surface_is_drawn_where_a_pinhole_sees_it_in_its_lit_colour(tmp_path: Path) -> None:
    quad = write_quad(tmp_path / "quad.ply", ((0.3, -0.5), (0.9, 0.8)), (200, 100, 50))
    image = drawn([quad], tmp_path / "quad.png", eye=(0.0, 0.0, 4.0), target=(0.0, 0.0, 0.0))
    focal = SIZE / 2 / np.tan(np.pi / 8)  # 45 degrees high; x is right and y up, seen from +z
    left, right, top, bottom = (SIZE / 2 + focal * x / 4 for x in (0.3, 0.9, -0.8, 0.5))
    colored = np.argwhere(image.min(axis=-1) < 250)
    assert np.abs(colored.min(axis=0) - np.floor((top, left))).max() <= 1
    assert np.abs(colored.max(axis=0) - np.floor((bottom, right))).max() <= 1
    # 35 % ambient and 65 % of a lamp towards (-0.8, 0.8, 1) in the world; nothing is near that could darken it.
    light = 0.35 + 0.65 / np.sqrt(0.8**2 + 0.8**2 + 1)
    linear = ((np.array([200, 100, 50]) / 255 + 0.055) / 1.055) ** 2.4 * light
    expected = 255 * (1.055 * linear ** (1 / 2.4) - 0.055)
    centre = image[int((top + bottom) / 2), int((left + right) / 2)]
    assert np.abs(centre - expected).max() <= 1


def test_a_mesh_without_colours_is_grey_and_its_corners_and_bends_show(tmp_path: Path) -> None:
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-1, 1, 41), np.linspace(-1, 1, 41)))
    k = np.arange(41 * 40).reshape(40, 41)[:, :40].ravel()
    faces = np.concatenate([np.stack([k, k + 1, k + 42], -1), np.stack([k, k + 42, k + 41], -1)])
    eye = {"eye": (0.0, 0.0, 3.0), "target": (0.0, 0.0, 0.0)}
    flat, bent, corner = (
        drawn([write(tmp_path / f"{name}.ply", np.stack([x, y, z], -1), faces)], tmp_path / f"{name}.png", **eye)
        for name, z in (("flat", 0 * x), ("bent", 0.03 * np.sin(6 * x)), ("corner", np.abs(x)))
    )
    row = slice(SIZE // 2 - 4, SIZE // 2 + 4)
    middle = slice(SIZE // 4, 3 * SIZE // 4)
    assert np.ptp(flat[row, middle]) <= 1 and flat[SIZE // 2, SIZE // 2].max() < 240
    assert (np.ptp(flat[row, middle], axis=-1) == 0).all()
    assert np.ptp(bent[row, middle].mean(axis=(0, 2))) > 10  # 3 cm on 2 m
    valley = corner[row].mean(axis=(0, 2))
    assert valley[SIZE // 2 + 1] < valley[SIZE // 2 + 8] - 10  # same plane, nearer to the other


def test_meshes_stand_side_by_side_under_their_labels(tmp_path: Path) -> None:
    quad = write_quad(tmp_path / "a.ply", ((-1, -1), (1, 1)), BLUE)
    out = picture_meshes([quad, quad], tmp_path / "deep/both.png", ["left", ""], (0.0, 0.0, 4.0), width=SIZE, height=48)
    image = cv2.imread(str(out))
    assert image.shape == (48 + TITLE, 2 * SIZE + GAP, 3)
    assert (image[TITLE:, :SIZE] == image[TITLE:, SIZE + GAP :]).all()
    title = image[:TITLE].min(axis=-1) < 128
    assert title[:, :SIZE].sum() > 10 and not title[:, SIZE:].any()
    assert (image[TITLE:, SIZE : SIZE + GAP] == 255).all()


def test_all_meshes_are_seen_by_one_camera(tmp_path: Path) -> None:
    near = write_quad(tmp_path / "near.ply", ((-1, -1), (1, 1)))
    far = write_quad(tmp_path / "far.ply", ((9, -1), (11, 1)))
    meshes = [read_mesh(path) for path in (near, far)]
    for eye in (None, (5.0, 1.0, 20.0)):
        T = frame_meshes(meshes, eye, None, 64, 64).T_world_cam
        assert np.array_equal(frame_meshes(meshes[::-1], eye, None, 64, 64).T_world_cam, T)
        towards = T[:3, :3].T @ (np.array([5.0, 0.0, 0.0]) - T[:3, 3])
        assert np.abs(towards[:1]).max() < 1e-6 * towards[2]  # the middle of both is in the middle


def test_colours_can_be_left_out(tmp_path: Path) -> None:
    quad = write_quad(tmp_path / "quad.ply", ((-1, -1), (1, 1)), RED)
    pixel = drawn([quad], tmp_path / "grey.png", eye=(0.0, 0.0, 4.0), grey=True)[SIZE // 2, SIZE // 2]
    assert np.ptp(pixel) == 0 and 50 < pixel[0] < 240


def test_colours_follow_their_vertices(tmp_path: Path) -> None:
    vertices = [(9, 9, 9), (0, 0, 0), (1, 0, 0), (0, 1, 0)]  # the first in no triangle
    mesh = read_mesh(write(tmp_path / "m.ply", vertices, [(1, 2, 3)], [(0, 0, 0), RED, GREEN, BLUE]))
    assert np.array_equal(mesh.vertices[mesh.faces[0]], vertices[1:])
    assert mesh.colors[mesh.faces[0]].argmax(axis=1).tolist() == [0, 1, 2]
    np.testing.assert_allclose(mesh.normals, np.tile((0, 0, 1), (3, 1)), atol=1e-6)
    assert len(mesh.facing(np.array([0.0, 0.0, 1.0])).faces) == 1
    assert len(mesh.facing(np.array([0.0, 0.0, -1.0])).faces) == 0


@pytest.mark.parametrize(
    ("name", "data", "part"),
    [
        ("none.ply", None, "cannot be read"),
        ("empty.ply", b"", "is empty"),
        ("noise.ply", b"\x00\xff" * 200, "no mesh"),
        ("web.ply", b"<!DOCTYPE html>\n<html></html>\n", "no mesh"),
        ("other.doc", b"hello", "no mesh"),
        ("cloud.ply", trimesh.PointCloud(np.eye(3)).export(file_type="ply"), "point cloud"),
        ("nan.ply", triangle(np.nan), "finite"),
        ("huge.ply", triangle(1e30), "finite"),
    ],
)
def test_what_is_no_mesh_is_refused_in_one_line(tmp_path: Path, name: str, data: bytes | None, part: str) -> None:
    if data is not None:
        (tmp_path / name).write_bytes(data)
    with pytest.raises(UserError, match=part) as error:
        picture_meshes([tmp_path / name], tmp_path / "out.png")
    assert name in str(error.value) and "\n" not in str(error.value)
    assert not (tmp_path / "out.png").exists()


@pytest.mark.parametrize(
    ("how", "part"),
    [
        ({"labels": ["a", "b"]}, "2 labels for 1 mesh"),
        ({"out": "out.gif"}, "choose .png"),
        ({"width": 4}, "--width 4"),
        ({"height": 10**6}, "1000000"),
        ({"target": (0.0, 0.0, 0.0)}, "--from"),
        ({"eye": (0.0, 0.0, 0.0), "target": (0.0, 0.0, 0.0)}, "straight up or down"),
        ({"eye": (0.5, 3.0, 0.0), "target": (0.5, 0.0, 0.0)}, "straight up or down"),
        ({"eye": (0.5, 0.0, -3.0)}, "seen from behind"),
    ],
)
def test_what_cannot_be_drawn_is_refused(tmp_path: Path, how: dict, part: str) -> None:
    quad = write_quad(tmp_path / "quad.ply", ((0, 0), (1, 1)))
    out = tmp_path / how.pop("out", "out.png")
    with pytest.raises(UserError, match=part) as error:
        picture_meshes([quad], out, **how)
    assert "\n" not in str(error.value) and not out.exists()


def test_points_are_three_finite_numbers() -> None:
    assert parse_point("0.5, 1e0,-2") == (0.5, 1.0, -2.0)
    for text in ("", "1,2", "1,2,3,4", "a,b,c", "1,2,nan", "nan,2,3", "inf,0,0", "1;2;3", "1e300,0,0"):
        with pytest.raises(UserError, match="x,y,z"):
            parse_point(text)
