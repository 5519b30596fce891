"""A calibration board in the scene: rendered where the truth says, as Kalibr counts it, and written for Kalibr."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tiny
import trimesh
import yaml

from rsgen.array_types import FloatArray, IntArray
from rsgen.check.verify import verify_sequence
from rsgen.cli.main import main
from rsgen.config.config import load_config
from rsgen.errors import UserError
from rsgen.geometry.aprilgrid import AprilGrid
from rsgen.geometry.shutter import Shutter, project_rolling
from rsgen.produce.parts import load_scene, scene_hash, surfaces_hash
from rsgen.scene.loading import Board, board_drawing, board_surface
from rsgen.scene.meshes import mesh_arrays
from rsgen.sequence.images import Sequence
from rsgen.sequence.reader import read_sequence
from rsgen.sequence.truth_files import TARGET_CORNERS

# The tiny room's y points down: the board stands upright in it and looks at the camera.
T_WORLD_TARGET = [[1, 0, 0, -0.49], [0, -1, 0, 0.36], [0, 0, -1, 0.7], [0, 0, 0, 1]]
TARGET = {"rows": 3, "columns": 4, "tag_size_m": 0.2, "spacing": 0.3, "T_world_target": T_WORLD_TARGET}
CAMERA = {"width": 320, "height": 240, "intrinsics": [240.0, 240.0, 159.5, 119.5], "readout_s": 0.1}
# First codes of the family 36h11 as the AprilTag library has them, highest bit first.
CODES = (0xD5D628584, 0xD97F18B49, 0xDD280910E, 0xE479E9C98)


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    folder = tmp_path_factory.mktemp("target")
    config = tiny.write_config(
        folder, 8, target=TARGET, color=CAMERA | {"spp": 64, "rate_hz": 15.0}, imu={},
        T_color_depth=[[1, 0, 0, -0.03], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
    )  # fmt: skip
    assert main(["render", str(config), "--out", str(folder / "seq"), "--frames", "0:2", "--quiet"]) == 0
    return read_sequence(folder / "seq")


def found_corners(rgb: Any) -> tuple[IntArray, FloatArray]:
    """Tags (n,) in an image by OpenCV, which knows nothing of the board, and corners (n, 4, 2) px in Kalibr's order."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = 2
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11), parameters)
    # Larger and whiter, or the black squares would tie the tags together; then each corner in the image itself.
    large = cv2.dilate(cv2.resize(grey, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC), np.ones((3, 3)))
    corners, ids, _ = detector.detectMarkers(large)
    points = ((np.concatenate(corners) + 0.5) / 4 - 0.5).reshape(-1, 1, 2).astype(np.float32)
    cv2.cornerSubPix(grey, points, (3, 3), (-1, -1), (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4))
    # OpenCV's tag is Kalibr's upside down: its upper right corner is Kalibr's lower left.
    return ids.ravel(), points.reshape(-1, 4, 2)[:, [1, 0, 3, 2]].astype(float)


@pytest.mark.parametrize("frame", [0, 1])
def test_the_tags_are_seen_where_the_truth_says(frame: int, sequence: Sequence) -> None:
    table = np.loadtxt(sequence.root / TARGET_CORNERS)
    np.testing.assert_array_equal(table[:, :2], [[tag, k] for tag in range(12) for k in range(4)])
    p_world = table[:, 3:].reshape(12, 4, 3)
    ids, uv = found_corners(sequence.color(frame))
    assert len(ids) >= 10 and len(set(ids)) == len(ids) and set(ids) <= set(range(12))

    def distance(shutter: Shutter) -> FloatArray:
        stream = sequence.streams["color"]
        stamp = float(stream.stamps[frame])
        expected, _, valid = project_rolling(
            sequence.spline, sequence.T_color_depth, stream.camera, shutter, stamp, p_world[ids]
        )
        assert valid.all()
        return np.linalg.norm(uv - expected, axis=-1)

    rolling, still = distance(sequence.streams["color"].shutter), distance(Shutter())
    assert np.median(rolling) < 0.1 and np.quantile(rolling, 0.95) < 0.2
    assert np.median(still) > 1.0


def test_kalibr_gets_the_board_images_and_the_imu(sequence: Sequence, tmp_path: Path) -> None:
    assert main(["export", "kalibr", str(sequence.root), "--out", str(tmp_path / "k"), "--quiet"]) == 0
    target = yaml.safe_load((tmp_path / "k/target.yaml").read_text())
    assert target == {"target_type": "aprilgrid", "tagCols": 4, "tagRows": 3, "tagSize": 0.2, "tagSpacing": 0.3}
    # createGridPoints of Kalibr's GridCalibrationTargetAprilgrid.cpp, point by point, from what the file says.
    size, spacing = target["tagSize"], target["tagSpacing"]
    table = np.loadtxt(sequence.root / TARGET_CORNERS)
    p_world = table[np.argsort(table[:, 2]), 3:]
    for r in range(2 * target["tagRows"]):
        for c in range(2 * target["tagCols"]):
            point = [x // 2 * (1 + spacing) * size + x % 2 * size for x in (c, r)]
            expected = np.array(T_WORLD_TARGET) @ [*point, 0.0, 1.0]
            np.testing.assert_allclose(p_world[r * 2 * target["tagCols"] + c], expected[:3], atol=1e-12)
    color = sequence.streams["color"]
    images = sorted((tmp_path / "k/cam0").iterdir())
    assert [int(path.stem) for path in images] == [10**9 * 10**9 + round(t * 1e9) for t in color.stamps]
    assert images[1].read_bytes() == color.paths[1].read_bytes() and images[1].samefile(color.paths[1])
    lines = (tmp_path / "k/imu0.csv").read_text().splitlines()
    assert lines[0].startswith("#timestamp") and len(lines[1].split(",")) == 7 and len(lines[1].split(",")[0]) == 19


def test_verify_checks_the_corners(sequence: Sequence) -> None:
    path = sequence.root / TARGET_CORNERS
    text = path.read_text()
    report = verify_sequence(sequence.root)
    assert report.ok and "12 tags" in report.text(), report.text()
    try:
        path.write_text(text.replace("0.700000000000", "0.700000000001", 1))
        assert "target_corners.txt is not that of config.target" in verify_sequence(sequence.root).text()
    finally:
        path.write_text(text)


def test_the_drawing_is_kalibrs() -> None:
    image = board_drawing(AprilGrid(2, 2, 0.1, 0.25))
    assert image.shape == (2 * 100 + 5 * 25, 2 * 100 + 5 * 25)
    black = image < 128
    for tag, code in enumerate(CODES):
        row, column = divmod(tag, 2)
        top, left = 50 + (1 - row) * 125, 50 + column * 125  # tag 0 is the lower left one
        cells = ~black[top + 5 : top + 100 : 10, left + 5 : left + 100 : 10]
        expected = np.zeros((10, 10), bool)
        expected[2:8, 2:8] = [[bool(code >> (35 - 6 * i - j) & 1) for j in range(6)] for i in range(6)]
        np.testing.assert_array_equal(cells, expected)
    squares = black[25 + 12 :: 125, 25 + 12 :: 125]
    assert squares.shape == (3, 3) and squares.all()  # the black squares in all nine corners
    assert not black[:25].any() and not black[:, -25:].any()  # the white margin
    assert not black[30:48, 55:145].any()  # between two squares


def test_the_board_faces_its_z_axis() -> None:
    T = np.array(T_WORLD_TARGET, float)
    vertices, faces, normals, _ = board_surface(Board(AprilGrid(3, 4, 0.2, 0.3), T))
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    np.testing.assert_allclose(np.cross(b - a, c - a) @ T[:3, 2], np.prod([4 * 0.2 + 7 * 0.06, 3 * 0.2 + 6 * 0.06]))
    np.testing.assert_array_equal(normals, np.tile(T[:3, 2], (4, 1)))


def test_a_mesh_files_scene_takes_a_board_too(tmp_path: Path) -> None:
    trimesh.creation.box((4, 3, 5)).export(tmp_path / "box.ply")
    for scene, shapes in (("box.ply", 2), ("scene.xml", 4)):
        config = load_config(tiny.write_config(tmp_path, 4, target=TARGET, scene={"file": scene}))
        loaded = load_scene(config)
        assert len(loaded.shapes()) == shapes
        heights = [mesh_arrays(shape)[0][:, 2] for shape in loaded.shapes()]
        assert sum(len(z) == 4 and np.allclose(z, 0.7, atol=1e-6) for z in heights) == 1


def test_a_board_elsewhere_has_a_light_of_its_own(tmp_path: Path) -> None:
    moved = [*T_WORLD_TARGET[:2], [0, 0, -1, 0.8], T_WORLD_TARGET[3]]
    sections = ({}, {"target": TARGET}, {"target": TARGET | {"T_world_target": moved}})
    configs = [load_config(tiny.write_config(tmp_path, 4, **section)) for section in sections]
    assert len({surfaces_hash(config) for config in configs}) == 3
    assert surfaces_hash(configs[0]) == scene_hash(configs[0]) == scene_hash(configs[2])


@pytest.mark.parametrize(
    ("wrong", "complaint"),
    [
        ({"spacing": 0.333}, "target: spacing: 0.333 is no whole number of hundredths"),
        ({"rows": 30, "columns": 30}, "target: rows x columns: 900 tags, there are 587"),
        ({"tag_size_m": 0}, "target.tag_size_m: must lie in"),
        ({"T_world_target": None}, "target.T_world_target"),
    ],
)
def test_impossible_boards_are_refused_in_one_line(wrong: dict[str, Any], complaint: str, tmp_path: Path) -> None:
    with pytest.raises(UserError) as error:
        load_config(tiny.write_config(tmp_path, 4, target=TARGET | wrong))
    assert complaint in str(error.value) and "\n" not in str(error.value)
