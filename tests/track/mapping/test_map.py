"""Mapping: a box room with a ball, mapped from exact and from wrong motions, and surfaces compared."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from synthetic import BALL, BALL_RADIUS, BOX, make_config, make_sequence

from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.sequence.reader import read_sequence
from rstrack.cli.main import main
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.data.estimate import Estimate, write_estimate
from rstrack.mapping.map import Reconstruction, reconstruct, run_map
from rstrack.metrics.map_eval import Triangles, cut, evaluate_map, run_map_eval, seen_surface
from rstrack.options import MapOptions
from rstrack.volume.mesh import write_ply

OPTIONS = MapOptions(voxel_m=0.03, backend="llvm")


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_sequence(tmp_path_factory.mktemp("room") / "seq", make_config(128, 96))


@pytest.fixture(scope="module")
def dataset(root: Path) -> Dataset:
    return open_dataset(root)


def exact(dataset: Dataset, T_estimate_world: np.ndarray | None = None, spline: bool = True) -> Estimate:
    """The truth, in a world of its own."""
    assert dataset.truth is not None
    T = np.eye(4) if T_estimate_world is None else T_estimate_world
    moved = Spline(T @ dataset.truth.control_points, dataset.truth.t0, dataset.truth.dt)
    stamps = dataset.stamps if spline else np.arange(-0.05, 0.4, 0.01)
    return Estimate(stamps, moved.pose(stamps), moved if spline else None)


def to_room(p: np.ndarray) -> np.ndarray:
    """Distances (n,) of points (n, 3) to the nearest wall or the ball: closed form, for points near one of them."""
    walls = np.abs(p[:, None] - BOX).min(axis=(1, 2))
    return np.minimum(walls, np.abs(np.linalg.norm(p - BALL, axis=1) - BALL_RADIUS))


@pytest.fixture(scope="module")
def rolling(dataset: Dataset) -> Reconstruction:
    T = se3.exp(np.array([1.0, -2.0, 0.5, 0.4, -0.3, 0.8]))
    return reconstruct(dataset, exact(dataset, T), OPTIONS)


def test_the_room_comes_back_in_the_truths_world(rolling: Reconstruction) -> None:
    assert (rolling.frames, rolling.without_pose, rolling.shutter, rolling.world) == (6, 0, "rs", "truth")
    error = to_room(rolling.surface.vertices)
    assert len(error) > 2000
    assert np.median(error) < 5e-4 and error.mean() < 2e-3  # voxels are 30 mm; corners are cut


def test_taking_the_shutter_for_a_global_one_costs(dataset: Dataset, rolling: Reconstruction) -> None:
    wrong = reconstruct(dataset, exact(dataset), replace(OPTIONS, shutter="gs", color=False))
    assert wrong.shutter == "gs" and wrong.surface.colors is None
    assert np.median(to_room(wrong.surface.vertices)) > 5 * np.median(to_room(rolling.surface.vertices))


def test_faces_look_at_the_camera(rolling: Reconstruction) -> None:
    s = rolling.surface
    mesh = trimesh.Trimesh(s.vertices, s.faces, process=False)
    wall = np.abs(mesh.triangles_center[:, 2] - BOX[1, 2]) < 0.01
    assert wall.sum() > 100 and (mesh.face_normals[wall, 2] < -0.9).mean() > 0.95  # but for cut corners


def test_colors_are_those_of_the_texture(rolling: Reconstruction) -> None:
    s = rolling.surface
    assert s.colors is not None
    wall = np.abs(s.vertices[:, 2] - BOX[1, 2]) < 0.003
    true = 127.5 + 110 * np.sin(s.vertices[wall] @ np.array([[5, 2, 1], [1, 6, -2], [-2, 1, 7.0]]))
    assert np.median(np.abs(s.colors[wall] - true)) < 4.0


def test_poses_without_a_spline(dataset: Dataset) -> None:
    poses = exact(dataset, spline=False)
    with pytest.raises(UserError, match="--shutter gs"):
        reconstruct(dataset, poses, replace(OPTIONS, shutter="rs"))
    found = reconstruct(dataset, poses, replace(OPTIONS, every=2, color=False))
    with_spline = reconstruct(dataset, exact(dataset), replace(OPTIONS, shutter="gs", every=2, color=False))
    assert (found.shutter, found.frames) == ("gs", 3)
    assert len(found.surface.vertices) == pytest.approx(len(with_spline.surface.vertices), rel=0.01)
    assert np.median(to_room(found.surface.vertices)) == pytest.approx(
        np.median(to_room(with_spline.surface.vertices)), rel=0.05
    )


def test_frames_without_a_pose_are_left_out(dataset: Dataset) -> None:
    poses = exact(dataset)
    some = replace(poses, info={"spline_valid": [[0.0, 0.1]]})
    found = reconstruct(dataset, some, replace(OPTIONS, color=False))
    assert found.frames == 3 and found.without_pose == 3 and "3 left out" in found.text()
    with pytest.raises(UserError, match="none of 6 frames has a pose"):
        reconstruct(dataset, replace(poses, info={"spline_valid": [[5.0, 6.0]]}), OPTIONS)


def test_the_estimates_own_world(dataset: Dataset, root: Path, tmp_path: Path) -> None:
    T = se3.exp(np.array([0.0, 0.0, 5.0, 0.0, 0.0, 0.0]))
    found = reconstruct(dataset, exact(dataset, T), replace(OPTIONS, world="estimate", color=False))
    np.testing.assert_array_less(np.median(to_room(found.surface.vertices - [0, 0, 5.0])), 5e-4)
    write_ply(tmp_path / "mesh.ply", found.surface, f"world {found.world}")
    with pytest.raises(UserError, match="--world truth"):
        run_map_eval(tmp_path / "mesh.ply", root / "scene.ply")


def test_from_folder_to_figures(
    dataset: Dataset, root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    estimate = exact(dataset)
    write_estimate(tmp_path / "run", estimate.stamps, estimate.T_world_depth, estimate.spline, {})
    stages = []
    result = run_map(
        root, tmp_path / "run", tmp_path / "mesh.ply", OPTIONS, tmp_path / "cloud.ply",
        progress=lambda stage, part, note: stages.append((stage, part)),
    )  # fmt: skip
    assert stages[-1] == ("meshing", 1.0) and ("integrating", 1.0) in stages
    assert len(trimesh.load(tmp_path / "cloud.ply").vertices) == len(result.surface.vertices)
    report = run_map_eval(tmp_path / "mesh.ply", root / "scene.ply", samples=2000)
    assert report.completeness is not None and report.within_2cm is not None
    # The scene's ball is an icosphere: up to 6 mm off the one that was seen.
    assert report.accuracy.mean_m < 2e-3 and report.accuracy.median_m < 5e-4
    assert report.completeness.median_m < 1e-3 and report.within_2cm > 0.8
    assert "accuracy, mm" in report.text() and report.as_dict()["accuracy"]["points"] == 2000
    for truth in (root, root / "scene.ply"):
        assert main(["evaluate", str(truth), str(tmp_path / "mesh.ply"), "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["accuracy"]["median_m"] < 5e-4
    assert main(["evaluate", str(root), str(tmp_path / "mesh.ply"), "--truth-offset", "0.01"]) == 2
    assert "--truth-offset: is not for a mesh" in capsys.readouterr().err
    for wrong in (tmp_path / "mesh.obj", tmp_path / "nowhere" / "mesh.ply"):
        with pytest.raises(UserError, match="mesh"):
            run_map(root, tmp_path / "run", wrong, OPTIONS)


# ---------------------------------------------------------------------------------------------------------------------


def test_distances_are_exact() -> None:
    rng = np.random.default_rng(1)
    triangles = rng.normal(size=(60, 1, 3)) + rng.normal(size=(60, 3, 3)) * rng.choice([0.01, 0.1, 0.5], (60, 1, 1))
    points = rng.normal(size=(200, 3))
    every = trimesh.triangles.closest_point(np.tile(triangles, (200, 1, 1)), np.repeat(points, 60, axis=0))
    expected = np.linalg.norm(every - np.repeat(points, 60, axis=0), axis=1).reshape(200, 60).min(axis=1)
    np.testing.assert_allclose(Triangles(triangles).distance(points), expected, atol=1e-9)


def test_cut_triangles_cover_the_same_area() -> None:
    triangles = np.random.default_rng(2).normal(size=(5, 3, 3))
    pieces = cut(triangles, 0.3)
    assert np.linalg.norm(pieces[:, [1, 2, 0]] - pieces, axis=-1).max() <= 0.3
    assert trimesh.triangles.area(pieces).sum() == pytest.approx(trimesh.triangles.area(triangles).sum())


def test_a_known_offset_is_what_is_reported() -> None:
    scene = trimesh.creation.box([2.0, 2.0, 0.001]).triangles
    mesh = np.array([[[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0]]]) + np.array([0.0, 0.0, 0.0105])
    seen = np.array([[0.2, 0.0, 0.0005], [0.2, -0.1, 0.0005], [0.3, -0.45, 0.0505]])
    report = evaluate_map(mesh, np.asarray(scene), seen, samples=500)
    assert report.accuracy.mean_m == pytest.approx(0.010, abs=1e-9) and report.accuracy.std_m < 1e-9
    assert report.completeness is not None
    assert report.completeness.median_m == pytest.approx(0.010) and report.within_2cm == pytest.approx(2 / 3)
    assert report.completeness.mean_m == pytest.approx(0.02)
    with pytest.raises(UserError, match="without triangles"):
        evaluate_map(np.empty((0, 3, 3)), np.asarray(scene), None)


def test_what_was_seen_lies_on_the_room(root: Path) -> None:
    seen = seen_surface(read_sequence(root))
    assert len(seen) > 300
    assert to_room(seen).max() < 1e-5


def test_wrong_files_are_named(root: Path, tmp_path: Path) -> None:
    (tmp_path / "bad.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 9\n")
    for name in ("bad.ply", "none.ply"):
        with pytest.raises(UserError, match=name):
            run_map_eval(tmp_path / name, root / "scene.ply")
