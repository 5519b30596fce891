"""Labels of pixels: against closed forms of what is seen, objects' masks, and the nodes of a mesh file."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tiny
import trimesh

from rsgen.check.verify import verify_sequence
from rsgen.cli.main import main
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.sequence.images import Rig
from rsgen.sequence.reader import read_sequence
from rsgen.sequence.truth_files import Thing, boxes_text, class_of, labels_yaml, read_labels

BALL = {
    "name": "red ball".replace(" ", "_"),
    "shape": {"kind": "sphere", "size_m": [0.3, 0.3, 0.3]},
    "motion": {"kind": "circle", "position": [-0.4, -0.2, 1.2], "radius_m": 0.1, "period_s": 4.0},
}


def named_scene(folder: Path) -> None:
    """tiny's room whose shapes have names: the papered box, the ball, the lamp's panel."""
    path = tiny.write_scene(folder)
    text = path.read_text()
    for shape, name in (("cube", "room_1"), ("sphere", "globe 2"), ("rectangle", "panel")):
        text = text.replace(f'<shape type="{shape}">', f'<shape type="{shape}" id="{name}">', 1)
    path.write_text(text)


def rendered(folder: Path, **sections: Any) -> Rig:
    named_scene(folder)
    config = tiny.write_config(folder, truth={"labels": True, "classes": {"lamp": ["pan*"]}}, **sections)
    assert main(["render", str(config), "--out", str(folder / "seq"), "--frames", "0:2", "--quiet"]) == 0
    return read_sequence(folder / "seq")


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    return rendered(tmp_path_factory.mktemp("labels"), objects=[BALL], color={"readout_s": 0.02})


def test_the_table_has_shapes_then_objects_with_classes_and_boxes(sequence: Rig) -> None:
    table = sequence.label_table
    assert [label.name for label in table] == ["globe 2", "panel", "room_1", "red_ball"]
    assert [label.class_name for label in table] == ["globe", "lamp", "room", "red ball"]
    assert len({label.class_id for label in table}) == 4
    np.testing.assert_allclose(table[2].box, [[-2, -1.5, -2.5], [2, 1.5, 2.5]], atol=1e-6)
    np.testing.assert_allclose(table[0].box, [[-0.2, -0.1, 1.1], [0.8, 0.9, 2.1]], atol=0.01)
    np.testing.assert_allclose(table[3].box, [[-0.15] * 3, [0.15] * 3], atol=0.01)
    assert table[2].triangles == 12


def test_pixels_are_of_what_their_points_lie_on(sequence: Rig) -> None:
    """Points from exact depth and rows' poses: on the globe, on the moving ball, on the panel or on a wall."""
    stream = sequence.streams["depth"]
    uv = stream.camera.pixel_grid().reshape(-1, 2)
    z = sequence.exact_depth("depth", 1)
    p = se3.transform(sequence.pixel_poses("depth", 1, uv), stream.camera.backproject(uv, z.ravel()))
    wall = np.abs(np.abs(p) - [2, 1.5, 2.5]).min(axis=1)
    globe = np.abs(np.linalg.norm(p - [0.3, 0.4, 1.6], axis=1) - 0.5)
    panel = np.where((np.abs(p[:, [0, 2]]) <= 0.8).all(axis=1), np.abs(p[:, 1] + 1.4), np.inf)
    expected = np.argmin([globe, panel, wall], axis=0) + 1
    moving = sequence.object_ids("depth", 1).ravel() > 0
    expected[moving] = 4
    found = sequence.labels("depth", 1).ravel()
    assert set(np.unique(expected)) >= {1, 3, 4} and (found == expected).mean() > 0.995
    np.testing.assert_array_equal(sequence.labels("color", 0) == 4, sequence.object_ids("color", 0) > 0)


def test_boxes_hold_what_is_seen(sequence: Rig) -> None:
    with (sequence.root / "truth/boxes_color.csv").open() as file:
        rows = [{name: int(value) for name, value in row.items()} for row in csv.DictReader(file)]
    assert {row["frame"] for row in rows} == {0, 1}
    for row in rows:
        y, x = np.nonzero(sequence.labels("color", row["frame"]) == row["id"])
        assert (x.min(), y.min(), x.max(), y.max(), len(x)) == tuple(row[k] for k in ("x0", "y0", "x1", "y1", "pixels"))


def test_verify_checks_them_and_resuming_writes_what_is_missing(sequence: Rig) -> None:
    report = verify_sequence(sequence.root)
    assert report.ok and "4 things of 4 classes" in report.text(), report.text()
    path = sequence.root / "truth/depth_labels/000001.png"
    before = path.read_bytes()
    turned = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[:, ::-1]
    assert cv2.imwrite(str(path), turned)
    try:
        assert not verify_sequence(sequence.root).ok
    finally:
        path.unlink()
    config = sequence.root.parent / "tiny.yaml"
    assert main(["render", str(config), "--out", str(sequence.root), "--frames", "0:2", "--quiet"]) == 0
    assert path.read_bytes() == before


def test_labels_change_nothing_else(sequence: Rig, tmp_path: Path) -> None:
    named_scene(tmp_path)
    config = tiny.write_config(tmp_path, objects=[BALL], color={"readout_s": 0.02})
    assert main(["render", str(config), "--out", str(tmp_path / "seq"), "--frames", "0:2", "--quiet"]) == 0
    plain, labelled = tiny.digests(tmp_path / "seq"), tiny.digests(sequence.root)
    assert all(labelled[name] == digest for name, digest in plain.items() if name != "sequence.yaml")
    assert "labels" not in (tmp_path / "seq/sequence.yaml").read_text()
    with pytest.raises(UserError, match=r"truth\.labels"):
        read_sequence(tmp_path / "seq").labels("color", 0)


def test_nodes_of_a_mesh_file_are_things_though_they_share_a_material(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box((4, 3, 5)), node_name="hall")
    scene.geometry[next(iter(scene.geometry))].invert()
    for k, x in enumerate((-0.5, 0.5)):
        chair = trimesh.creation.box((0.5, 0.5, 0.5))
        scene.add_geometry(
            chair, node_name=f"chair_{k}", transform=trimesh.transformations.translation_matrix([x, 0, 1.5])
        )
    scene.export(tmp_path / "hall.glb")
    config = tiny.write_config(tmp_path, scene={"file": "hall.glb", "light": "sky"}, truth={"labels": True})
    assert main(["render", str(config), "--out", str(tmp_path / "seq"), "--frames", "0:1", "--quiet"]) == 0
    sequence = read_sequence(tmp_path / "seq")
    table = {label.name: label for label in sequence.label_table}
    assert set(table) == {"hall", "chair_0", "chair_1"} and table["chair_0"].class_id == table["chair_1"].class_id
    np.testing.assert_allclose(table["chair_1"].box, [[0.25, -0.25, 1.25], [0.75, 0.25, 1.75]], atol=1e-6)
    labels = sequence.labels("depth", 0)
    for name in ("chair_0", "chair_1"):
        x = np.nonzero(labels == table[name].id)[1]
        assert len(x) > 10 and (x.mean() < 23.5) == (name == "chair_0")


@pytest.mark.parametrize(
    ("name", "expected"),
    [("picture 12", "picture"), ("sofa_a", "sofa"), ("chair.001", "chair"), ("wall_back", "wall back"), ("12", "12"),
     ("Lamp-3b", "Lamp-3b")],
)  # fmt: skip
def test_a_class_is_the_name_without_its_number(name: str, expected: str) -> None:
    assert class_of(name, {}) == expected
    assert class_of(name, {"x": ["*"]}) == "x"


def test_boxes_of_nothing_and_tables_that_cannot_be(tmp_path: Path) -> None:
    assert boxes_text([(3, np.zeros((4, 5), np.uint16))]) == "frame,id,x0,y0,x1,y1,pixels\n"
    thing = Thing("a", 1, np.zeros((2, 3)))
    with pytest.raises(UserError, match="16 bits"):
        labels_yaml([thing] * 65536, {})
    (tmp_path / "labels.yaml").write_text(
        "labels:\n- {id: 2, name: a, class: a, class_id: 1, triangles: 1, box: [[0, 0, 0], [1, 1, 1]]}\n"
    )
    with pytest.raises(UserError, match="count from 1"):
        read_labels(tmp_path / "labels.yaml")
    (tmp_path / "labels.yaml").write_text("labels: 3\n")
    with pytest.raises(UserError, match="render again") as error:
        read_labels(tmp_path / "labels.yaml")
    assert "\n" not in str(error.value)
