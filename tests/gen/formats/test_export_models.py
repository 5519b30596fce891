"""COLMAP models and transforms.json, read as their consumers read them, against the truth's rows and ray casting."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import synthetic
import trimesh
from scipy.spatial.transform import Rotation, Slerp

from rsgen.errors import UserError
from rsgen.formats.export.colmap import camera_line, export_colmap
from rsgen.formats.export.nerfstudio import export_nerfstudio, ngp_rolling_shutter
from rsgen.formats.export.poses import Loss, observations
from rsgen.formats.export.shared import NO_DEPTH, ExportOptions
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Scan, Shutter
from rsgen.image_codecs import read_png
from rsgen.produce.writer import quantise
from rsgen.sensors.depth import register_depth
from rsgen.sequence.format import poses_of_rows
from rsgen.sequence.images import Sequence
from rsgen.sequence.reader import read_sequence

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
RADTAN = (-0.05, 0.02, 0.001, -0.002)


def make(folder: Path, **color: Any) -> Sequence:
    depth = {"readout_s": 0.02, "offset_s": 0.004, "rate_hz": 15.0}
    return read_sequence(synthetic.make_sequence(folder / "seq", synthetic.make_config(color=color, depth=depth)))


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    """Six frames of a distorted colour camera with exposure; depth comes half as often."""
    return make(tmp_path_factory.mktemp("models"), model="radtan", distortion=list(RADTAN), exposure_s=0.01)


@pytest.fixture(scope="module")
def colmap(sequence: Sequence, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("colmap") / "model"
    assert "one pose an image" in export_colmap(sequence, out)
    return out


@pytest.fixture(scope="module")
def nerf(sequence: Sequence, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("nerf") / "data"
    said = export_nerfstudio(sequence, out)
    assert "start and end pose in gsplat" in said and "constant velocity in 3dgs-deblur" in said
    return out


def row_pose(sequence: Sequence, k: int, v: float) -> np.ndarray:
    """T_world_color between the truth's rows."""
    rows = poses_of_rows(sequence.rows("color")[k])
    i = int(np.clip(np.floor(v), 0, len(rows) - 2))
    return np.asarray(rows[i] @ se3.exp((v - i) * se3.log(se3.inverse(rows[i]) @ rows[i + 1])))


def off_px(sequence: Sequence, T_world_color: np.ndarray, true: np.ndarray) -> float:
    """How far points 1.5 m away move in the image if the one pose is taken for the other."""
    camera = sequence.streams["color"].camera
    pixels = camera.pixel_grid()[2:-2:5, 2:-2:5].reshape(-1, 2)
    p_world = se3.transform(true, 1.5 * camera.unproject(pixels))
    uv, _ = camera.project(se3.transform(se3.inverse(T_world_color), p_world))
    return float(np.abs(uv - pixels).max())


# --- COLMAP ----------------------------------------------------------------------------------------------------------


def records(path: Path, step: int = 1) -> list[list[str]]:
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    return [" ".join(lines[i : i + 1]).split() for i in range(len(lines))][::step]


def images_of(colmap: Path) -> list[tuple[np.ndarray, str, np.ndarray]]:
    """T_color_world, name and observations (n, 3) of each image, by COLMAP's own conventions."""
    lines = records(colmap / "sparse/0/images.txt")
    found = []
    for head, tail in zip(lines[::2], lines[1::2], strict=True):
        w, x, y, z = map(float, head[1:5])
        T = np.eye(4)
        T[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
        T[:3, 3] = list(map(float, head[5:8]))
        found.append((T, head[9], np.array(tail, float).reshape(-1, 3)))
    return found


def points_of(colmap: Path) -> tuple[np.ndarray, list[list[str]]]:
    lines = records(colmap / "sparse/0/points3D.txt")
    assert [line[0] for line in lines] == [str(i + 1) for i in range(len(lines))]
    return np.array([line[1:8] for line in lines], float), lines


def test_a_colmap_pose_is_the_middle_line_s(sequence: Sequence, colmap: Path) -> None:
    images = images_of(colmap)
    assert [name for _, name, _ in images] == [path.name for path in sequence.streams["color"].paths]
    for k, (T_color_world, name, _) in enumerate(images):
        assert off_px(sequence, np.linalg.inv(T_color_world), row_pose(sequence, k, 23.5)) < 0.01
        np.testing.assert_array_equal(read_png(colmap / "images" / name, (48, 64, 3), np.uint8), sequence.color(k))


def test_colmap_s_observations_are_where_the_rolling_shutter_shows_the_points(sequence: Sequence, colmap: Path) -> None:
    """By the pose of the truth's row there, with OpenCV's projection and pixel centres half a pixel off ours."""
    points, _ = points_of(colmap)
    ((_, model, width, height, *params),) = records(colmap / "sparse/0/cameras.txt")
    assert (model, width, height) == ("OPENCV", "64", "48")
    fx, fy, cx, cy, *distortion = map(float, params)
    assert (cx, cy) == (32.0, 24.0) and tuple(distortion) == RADTAN
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    for k, (_, _, observed) in enumerate(images_of(colmap)):
        assert len(observed) > 200
        for x, y, number in observed[::25]:
            T = np.linalg.inv(row_pose(sequence, k, y - 0.5))
            uv, _ = cv2.projectPoints(points[int(number) - 1, :3], T[:3, :3], T[:3, 3], K, np.array(distortion))
            assert np.abs(uv.ravel() - (x, y)).max() < 0.01


def test_colmap_s_tracks_points_and_errors_belong_together(sequence: Sequence, colmap: Path) -> None:
    points, lines = points_of(colmap)
    images = images_of(colmap)
    color = sequence.streams["color"].camera
    seen = 0
    for number, line in enumerate(lines, 1):
        track = np.array(line[8:], int).reshape(-1, 2)
        errors = []
        for image, place in track:
            T, _, observed = images[image - 1]
            assert observed[place, 2] == number
            uv, _ = color.project(se3.transform(T, points[number - 1, :3]))
            errors.append(np.linalg.norm(uv + 0.5 - observed[place, :2]))
        seen += len(track)
        assert float(line[7]) == pytest.approx(np.mean(errors), abs=1e-5)
    assert seen == sum(len(observed) for _, _, observed in images)
    loss = json.loads((colmap / "rolling_shutter.json").read_text())["loss_px"]["one pose an image"]
    assert 0.5 * loss["median_px"] < np.median(points[:, 6]) < 2 * loss["median_px"] and loss["max_px"] > 0.5


def test_colmap_s_points_are_visible_where_they_are_observed(sequence: Sequence, colmap: Path) -> None:
    points, _ = points_of(colmap)
    hits = []
    for k, (_, _, observed) in enumerate(images_of(colmap)):
        for _, y, number in observed[::20]:
            origin = row_pose(sequence, k, y - 0.5)[:3, 3]
            hits.append(synthetic.cast(origin, points[int(number) - 1, :3] - origin))
    # 1 is the point itself. Colour and depth are 5 cm apart: near the ball's edge one may see what the other does not.
    assert np.mean(np.abs(np.array(hits) - 1) < 0.02) > 0.97
    colors = points[:, 3:6]
    expected = 127.5 + 110 * np.sin(points[:, :3] @ np.array([[5, 2, 1], [1, 6, -2], [-2, 1, 7.0]]))
    assert np.median(np.abs(colors - expected)) < 15


CAMERAS = [
    Camera(64, 48, 50, 51, 31.5, 23.0),
    Camera(64, 48, 50, 51, 31.5, 23.0, "radtan", RADTAN),
    Camera(64, 48, 50, 51, 31.5, 23.0, "radtan", (*RADTAN, 0.01)),
    Camera(64, 48, 50, 51, 31.5, 23.0, "rational", (0.3, 0.1, 0.004, -0.003, 0.02, 0.5, 0.1, 0.01)),
    Camera(64, 48, 50, 51, 31.5, 23.0, "rational", (*RADTAN, 0.0, 0.0, 0.0, 0.0)),
    Camera(64, 48, 50, 51, 31.5, 23.0, "fisheye", (0.1, 0.02, 0.0, 0.001)),
]
P_CAM = np.array([[0.1, 0.2, 1.0], [-0.5, 0.3, 1.2], [0.4, -0.4, 0.9], [0.0, 0.0, 2.0]])


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: f"{camera.model}{len(camera.distortion)}")
def test_cameras_of_colmap_are_half_a_pixel_off_and_otherwise_opencv_s(camera: Camera) -> None:
    model, width, height, *words = camera_line(camera).split()
    fx, fy, cx, cy, *D = map(float, words)
    K, zero = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.zeros(3)
    assert (width, height) == ("64", "48")
    if model == "OPENCV_FISHEYE":
        uv, _ = cv2.fisheye.projectPoints(P_CAM[:, None], zero, zero, K, np.array(D))
    else:
        assert len(D) == {"PINHOLE": 0, "OPENCV": 4, "FULL_OPENCV": 8}[model]
        uv, _ = cv2.projectPoints(P_CAM, zero, zero, K, np.array(D) if D else None)
    np.testing.assert_allclose(uv.reshape(-1, 2), camera.project(P_CAM)[0] + 0.5, atol=1e-9)


@pytest.mark.parametrize(
    ("export", "model", "distortion"),
    [
        (export_colmap, "double_sphere", (-0.2, 0.6)),
        (export_nerfstudio, "double_sphere", (-0.2, 0.6)),
        (export_nerfstudio, "rational", (0.3, 0.1, 0.004, -0.003, 0.02, 0.5, 0.1, 0.01)),
    ],
)
def test_lenses_that_a_format_has_not(
    sequence: Sequence, tmp_path: Path, export: Any, model: Any, distortion: tuple[float, ...]
) -> None:
    camera = replace(sequence.streams["color"].camera, model=model, distortion=distortion)
    color = replace(sequence.streams["color"], camera=camera)
    with pytest.raises(UserError, match=rf"has no {model} lens: render with"):
        export(replace(sequence, streams={**sequence.streams, "color": color}), tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_pycolmap_reads_the_model(sequence: Sequence, colmap: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction(str(colmap / "sparse/0"))
    points, _ = points_of(colmap)
    assert (model.num_images(), model.num_points3D()) == (6, len(points))
    model.update_point_3d_errors()  # from the poses, the camera and the observations, in place of those in the file
    recomputed = [model.points3D[i + 1].error for i in range(len(points))]
    np.testing.assert_allclose(recomputed, points[:, 6], atol=1e-5)
    for camera in CAMERAS:
        name, width, height, *params = camera_line(camera).split()
        theirs = pycolmap.Camera(model=name, width=int(width), height=int(height), params=list(map(float, params)))
        np.testing.assert_allclose(theirs.img_from_cam(P_CAM), camera.project(P_CAM)[0] + 0.5, atol=1e-9)


# --- nerfstudio ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def meta(nerf: Path) -> dict[str, Any]:
    data: dict[str, Any] = json.loads((nerf / "transforms.json").read_text())
    return data


def opencv_pose(frame: dict[str, Any], name: str = "transform_matrix") -> np.ndarray:
    return np.array(frame[name]) @ FLIP


def test_the_keys_that_consumers_read_are_there(sequence: Sequence, nerf: Path, meta: dict[str, Any]) -> None:
    """nerfstudio's dataparser, SpectacularAI's fork of it, instant-ngp's loader."""
    assert meta["camera_model"] == "OPENCV" and (meta["w"], meta["h"]) == (64, 48)
    assert (meta["fl_x"], meta["cx"], meta["cy"]) == (48.0, 32.0, 24.0)
    assert [meta[name] for name in ("k1", "k2", "p1", "p2")] == list(RADTAN)
    assert (meta["rolling_shutter_time"], meta["exposure_time"]) == (0.028, pytest.approx(0.01))
    assert meta["shutter_type"] == "ROLLING_TOP_TO_BOTTOM" and len(meta["rolling_shutter"]) == 4
    for k, frame in enumerate(meta["frames"]):
        assert len(frame["camera_linear_velocity"] + frame["camera_angular_velocity"]) == 6
        np.testing.assert_array_equal(read_png(nerf / frame["file_path"], (48, 64, 3), np.uint8), sequence.color(k))
        assert (nerf / frame["depth_file_path"]).is_file() and frame["exposure_s"] == 0.01
    cloud = trimesh.load(nerf / meta["ply_file_path"])
    assert len(cloud.vertices) > 500 and len(cloud.visual.vertex_colors) == len(cloud.vertices)
    inside = (cloud.vertices > synthetic.BOX[0] - 0.01) & (cloud.vertices < synthetic.BOX[1] + 0.01)
    assert inside.all()


def test_start_middle_and_end_are_those_lines_poses(sequence: Sequence, meta: dict[str, Any]) -> None:
    for k, frame in enumerate(meta["frames"]):
        for name, row in (("_start", 0.0), ("", 23.5), ("_end", 47.0)):
            pose = opencv_pose(frame, f"transform_matrix{name}")
            assert off_px(sequence, pose, row_pose(sequence, k, row)) < 0.01


def test_gsplat_s_own_interpolation_comes_as_near_as_is_said(
    sequence: Sequence, nerf: Path, meta: dict[str, Any]
) -> None:
    """View matrices, world to camera: positions straight, rotations slerped, at floor(y) / (height − 1) of the way."""
    worst = 0.0
    for k, frame in enumerate(meta["frames"]):
        ends = [np.linalg.inv(opencv_pose(frame, f"transform_matrix_{name}")) for name in ("start", "end")]
        turn = Slerp([0, 1], Rotation.from_matrix([T[:3, :3] for T in ends]))
        for row in range(0, 48, 6):
            part = np.floor(row + 0.5) / 47
            view = np.eye(4)
            view[:3, :3] = turn(part).as_matrix()
            view[:3, 3] = (1 - part) * ends[0][:3, 3] + part * ends[1][:3, 3]
            worst = max(worst, off_px(sequence, np.linalg.inv(view), row_pose(sequence, k, row)))
    said = json.loads((nerf / "rolling_shutter.json").read_text())["loss_px"]["start and end pose in gsplat"]
    assert 0.5 * said["max_px"] < worst < 3 * said["max_px"] < 0.1


def test_the_velocities_move_points_as_3dgs_deblur_moves_them(
    sequence: Sequence, nerf: Path, meta: dict[str, Any]
) -> None:
    """Axes flipped, t = rolling_shutter_time (y / height − 1/2), y = row + 1/2, straight in the image."""
    seen, camera = observations(sequence), sequence.streams["color"].camera
    pinhole = replace(camera, model="pinhole", distortion=())
    errors = []
    for k, frame in enumerate(meta["frames"]):
        T = opencv_pose(frame)
        v, w = (FLIP[:3, :3] @ np.array(frame[f"camera_{name}_velocity"]) for name in ("linear", "angular"))
        mine = seen.image == k
        p = se3.transform(np.linalg.inv(T), seen.p_world[mine])
        p_dot = -(v + np.cross(w, p))
        fx, fy, z = camera.fx, camera.fy, p[:, 2]
        flow = (p_dot[:, :2] * z[:, None] - p[:, :2] * p_dot[:, 2:]) * (fx, fy)
        t = meta["rolling_shutter_time"] * ((seen.uv[mine, 1] + 0.5) / meta["h"] - 0.5)
        uv = pinhole.project(p)[0] + flow / z[:, None] ** 2 * t[:, None]
        # Where an undistorted image has what was seen.
        true = pinhole.project(camera.unproject(seen.uv[mine]))[0]
        errors.append(np.linalg.norm(uv - true, axis=1))
    error = np.concatenate(errors)
    said = json.loads((nerf / "rolling_shutter.json").read_text())["loss_px"]["constant velocity in 3dgs-deblur"]
    assert error.max() < 2 * said["max_px"] < 0.05 and np.median(error) == pytest.approx(said["median_px"], rel=0.3)


@pytest.mark.parametrize("scan", ["top-bottom", "bottom-top", "left-right", "right-left"])
def test_instant_ngp_s_four_numbers_give_every_pixel_s_part_of_the_way(scan: Scan) -> None:
    camera, shutter = Camera(64, 48, 50, 50, 31.5, 23.5), Shutter(0.028, 0.01, scan)
    a, b, c, d = ngp_rolling_shutter(camera, shutter)
    first, last = (float(shutter.line_mid_time(1.0, i, camera)) for i in (0, shutter.line_count(camera) - 1))
    for x, y in ((0, 0), (10, 20), (63, 47)):
        end = float(shutter.line_end_time(1.0, shutter.line_of_pixel([x, y], camera), camera))
        for blur, t in ((0.0, end - 0.01), (0.5, end - 0.005), (1.0, end)):
            part = a + b * (x + 0.5) / 64 + c * (y + 0.5) / 48 + d * blur
            assert first + part * (last - first) == pytest.approx(t, abs=1e-12)
    assert ngp_rolling_shutter(camera, Shutter()) == [0.0] * 4


def test_depth_is_warped_into_the_colour_camera(sequence: Sequence, nerf: Path, meta: dict[str, Any]) -> None:
    depth, camera = sequence.streams["depth"], sequence.streams["color"].camera
    assert meta["depth_unit_scale_factor"] == 1 / 5000
    rays = depth.camera.unproject(depth.camera.pixel_grid())
    z = register_depth(rays, sequence.depth(1), camera, sequence.T_color_depth)
    name = meta["frames"][2]["depth_file_path"]
    assert name == f"depth/{depth.paths[1].name}"
    np.testing.assert_array_equal(read_png(nerf / name, (48, 64), np.uint16), quantise(z, 5000.0))


def test_depth_in_the_colour_camera_s_pixels_is_linked_and_its_absence_is_zeros(tmp_path: Path) -> None:
    found = make(tmp_path, scan="bottom-top")
    depth = replace(found.streams["depth"], registered=True, stamps=found.streams["depth"].stamps + 0.1)
    late = replace(found, streams={**found.streams, "depth": depth}, T_color_depth=synthetic.T_COLOR_DEPTH)
    said = export_nerfstudio(late, tmp_path / "out")
    assert "no velocities: 3dgs-deblur does not know the scan bottom-top" in said
    data = json.loads((tmp_path / "out/transforms.json").read_text())
    assert data["shutter_type"] == "ROLLING_BOTTOM_TO_TOP" and "rolling_shutter_time" not in data
    assert not any("camera_linear_velocity" in frame for frame in data["frames"])
    first, last = data["frames"][0]["depth_file_path"], data["frames"][3]["depth_file_path"]
    assert first == f"depth/{NO_DEPTH}" and not read_png(tmp_path / "out" / first, (48, 64), np.uint16).any()
    assert last == "depth/000000.png" and (tmp_path / "out" / last).samefile(depth.paths[0])
    # The start is what is read first, at the bottom.
    for name, row in (("_start", 47.0), ("_end", 0.0)):
        pose = opencv_pose(data["frames"][1], f"transform_matrix{name}")
        assert off_px(found, pose, row_pose(found, 1, row)) < 0.01


# --- both ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["colmap", "nerf"])
def test_every_line_s_pose_follows_from_the_two_files_beside(
    sequence: Sequence, name: str, request: pytest.FixtureRequest
) -> None:
    out: Path = request.getfixturevalue(name)
    facts = json.loads((out / "rolling_shutter.json").read_text())
    shutter = facts["streams"]["color"]
    with np.load(out / "spline.npz") as curve, np.load(sequence.root / "spline.npz") as ours:
        assert all((curve[key] == ours[key]).all() for key in ours.files)
    i = np.arange(shutter["lines"])
    t = sequence.streams["color"].stamps[2] + i * shutter["readout_s"] / len(i) - 0.5 * shutter["exposure_s"]
    T = sequence.spline.pose(t) @ np.linalg.inv(np.array(facts["T_color_depth"]))
    assert max(off_px(sequence, T[row], row_pose(sequence, 2, row)) for row in (0, 13, 47)) < 0.01


def test_an_automatic_camera_s_exposures_count(sequence: Sequence, tmp_path: Path) -> None:
    """The middle of a longer exposure lies earlier; stamps are its end."""
    from rsgen.sequence.truth_files import FrameTable

    color = sequence.streams["color"]
    n, ones = np.arange(6), np.ones(6)
    table = FrameTable(n, n, color.stamps, color.listed, 0.03 * ones, ones, ones, np.ones((6, 3)))
    longer = replace(sequence, streams={**sequence.streams, "color": replace(color, table=table)})
    export_nerfstudio(longer, tmp_path / "out")
    data = json.loads((tmp_path / "out/transforms.json").read_text())
    assert data["exposure_time"] == pytest.approx(0.03) and data["frames"][0]["exposure_s"] == 0.03
    t = color.stamps[3] + 23.5 * 0.028 / 48 - 0.015
    expected = sequence.spline.pose(t) @ np.linalg.inv(synthetic.T_COLOR_DEPTH)
    np.testing.assert_allclose(opencv_pose(data["frames"][3]), expected, atol=1e-12)


def test_a_folder_in_use_is_refused_and_images_can_be_copies(sequence: Sequence, colmap: Path, tmp_path: Path) -> None:
    for write in (export_colmap, export_nerfstudio):
        with pytest.raises(UserError, match="is not empty"):
            write(sequence, colmap)
    export_colmap(sequence, tmp_path / "copy", ExportOptions(copy=True))
    file = sequence.streams["color"].paths[0]
    assert not (tmp_path / "copy/images" / file.name).samefile(file)
    assert (colmap / "images" / file.name).samefile(file)


def test_a_loss_of_no_points_is_null() -> None:
    assert Loss(np.nan, np.nan).as_dict() == {"median_px": None, "max_px": None}
    assert str(Loss(0.123, 4.567)) == "0.12 px median, 4.6 px at most"
