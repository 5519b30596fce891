"""The signed distance volume and its mesh: integrating, ray casting and meshing closed-form surfaces."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import trimesh
from nightly import sampled
from rstrack_util import ENGINE, Plane

from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rstrack.keyframes.keyframe import rectified_lens
from rstrack.volume.blocks import FarBlocks
from rstrack.volume.kernels import BLOCK, scale_kernel
from rstrack.volume.mesh import extract_surface, write_ply
from rstrack.volume.volume import Blocks, Volume

LENS = rectified_lens(Camera(96, 72, 72.0, 73.0, 47.0, 36.5))
SHAPE = LENS.camera.height, LENS.camera.width
WALL = Plane(np.array([0.3, -0.2, 1.0]) / np.linalg.norm([0.3, -0.2, 1.0]), 1.5)
POSES = se3.exp(np.array([[0, 0, 0, 0, 0, 0], [0.1, 0.03, -0.1, 0.05, -0.1, 0.1], [-0.1, 0.1, 0.1, -0.05, 0.1, 0.0]]))
RAYS = LENS.camera.unproject(LENS.camera.pixel_grid())


def depth_of(plane: Plane, T_world_cam: np.ndarray) -> np.ndarray:
    """z (h, w) of a plane."""
    d = RAYS @ T_world_cam[:3, :3].T
    return (plane.offset - plane.normal @ T_world_cam[:3, 3]) / (d @ plane.normal)


def inverse(z: np.ndarray) -> object:
    return ENGINE.upload(np.where(z > 0, 1.0 / np.where(z > 0, z, 1.0), 0.0))


def filled(voxel_m: float = 0.02, **kwargs: bool) -> Volume:
    volume = Volume(ENGINE, voxel_m, **kwargs)
    for T in POSES:
        volume.integrate(inverse(depth_of(WALL, T)), T, LENS)
    return volume


def test_a_plane_is_seen_again_from_another_pose() -> None:
    T = se3.exp(np.array([0.05, 0.0, -0.05, 0.02, 0.03, 0.2]))
    rho = filled().raycast(T, LENS)
    z, true = ENGINE.download(rho, SHAPE), depth_of(WALL, T)
    z, seen = 1.0 / np.maximum(z, 1e-6), z > 0
    uv, _ = LENS.camera.project(se3.transform(se3.inverse(POSES[0]) @ T, RAYS * true[..., None]))
    # Four voxels (5 px) inside of what the first pose saw; others saw more.
    inside = ((uv > 5) & (uv < np.array(SHAPE[::-1]) - 6)).all(axis=-1)
    assert inside.mean() > 0.6 and seen[inside].all()
    assert np.abs(z - true)[seen].max() < 2e-4  # a hundredth of a voxel


def test_nothing_is_seen_where_nothing_was() -> None:
    assert not ENGINE.download(Volume(ENGINE).raycast(np.eye(4), LENS), SHAPE).any()
    behind = se3.exp(np.array([0, 0, 0, 0, np.pi, 0.0]))
    assert not ENGINE.download(filled().raycast(behind, LENS), SHAPE).any()
    beyond = np.eye(4)
    beyond[2, 3] = 4.0  # looking away from the wall, from behind it
    assert not ENGINE.download(filled().raycast(beyond, LENS), SHAPE).any()


def test_the_distance_to_a_pixels_plane() -> None:
    z = depth_of(WALL, POSES[1])
    scale = ENGINE.download(scale_kernel(ENGINE, LENS)(inverse(z)), SHAPE)
    expected = WALL.offset - WALL.normal @ POSES[1, :3, 3]
    np.testing.assert_allclose(scale, expected, rtol=2e-5)
    # Beside an edge the slope is not known: the plane is square to the ray.
    z[:, 50:] += 1.0
    scale = ENGINE.download(scale_kernel(ENGINE, LENS)(inverse(z)), SHAPE)
    square = z * np.linalg.norm(RAYS, axis=-1)
    np.testing.assert_allclose(scale[:, 47:53], square[:, 47:53], rtol=2e-5)
    np.testing.assert_allclose(scale[:, :47], expected, rtol=2e-5)


def test_depths_are_averaged_by_weight() -> None:
    volume, ones = Volume(ENGINE, 0.02), np.ones(SHAPE)
    for offset, weight in ((1.50, 1.0), (1.508, 3.0)):
        z = depth_of(Plane(np.array([0.0, 0.0, 1.0]), offset), np.eye(4))
        volume.integrate(inverse(z), np.eye(4), LENS, weight=ENGINE.upload(weight * ones))
    seen = ENGINE.download(volume.raycast(np.eye(4), LENS), SHAPE)[8:-8, 8:-8]
    # Farther measurements are seen as squarely, so that only the weights count: (1.5 + 3 · 1.508) / 4.
    np.testing.assert_allclose(1.0 / seen, 1.506, atol=1e-4)


def test_near_measurements_count_more() -> None:
    """Nguyen et al.: (σ(1 m) / σ(z))², σ = 0.0012 + 0.0019 (z − 0.4)²."""
    weights = []
    for z in (1.0, 2.0):
        volume = Volume(ENGINE, 0.02)
        volume.integrate(inverse(np.full(SHAPE, z)), np.eye(4), LENS)
        p = np.array([0.0, 0.0, z])
        index = np.rint(p / 0.02).astype(int)
        found = volume.download()
        block = int(np.flatnonzero((found.at == index // BLOCK).all(axis=1))[0])
        weights.append(found.weight[block, index[2] % BLOCK, index[1] % BLOCK, index[0] % BLOCK])
    sigma = 0.0012 + 0.0019 * (np.array([1.0, 2.0]) - 0.4) ** 2
    assert weights[0] == pytest.approx(1.0, abs=0.01)
    assert weights[1] == pytest.approx((sigma[0] / sigma[1]) ** 2, rel=0.01)


def test_depth_is_not_interpolated_across_edges() -> None:
    z = np.full(SHAPE, 2.0)
    z[:, : SHAPE[1] // 2] = 1.0
    volume = Volume(ENGINE, 0.02)
    volume.integrate(inverse(z), np.eye(4), LENS)
    found = volume.download()
    depth = (found.at[:, 2, None] * BLOCK + np.arange(BLOCK)) * 0.02
    crossing = (found.tsdf <= 0) & (found.weight > 0)
    where = np.broadcast_to(depth[:, :, None, None], crossing.shape)[crossing]
    # Behind a surface are only points within the truncation (0.08 m, slant included) of one of the two.
    assert (np.minimum(np.abs(where - 1.0), np.abs(where - 2.0)) < 0.1).all() and len(where) > 100


def test_the_same_frames_give_the_same_bits_and_no_more_blocks() -> None:
    a, b = filled(), filled()
    np.testing.assert_array_equal(a.download().tsdf, b.download().tsdf)
    np.testing.assert_array_equal(a.download().weight, b.download().weight)
    blocks, size = a.blocks, a.bytes
    for T in POSES:
        a.integrate(inverse(depth_of(WALL, T)), T, LENS)
    assert (a.blocks, a.bytes) == (blocks, size)


def far_apart(n: int) -> list[np.ndarray]:
    """Poses along a long way, and back to the start."""
    out = []
    for x in (*np.linspace(0.0, 30.0, n), 0.1):
        T = se3.exp(np.array([0, 0, 0, 0.02 * x, 0.01 * x, 0.03]))
        T[:3, 3] = 3.0 * x, 0.1 * x, -0.2 * x
        out.append(T)
    return out


@pytest.fixture
def small_window(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rstrack.volume.blocks.MOST_ENTRIES", 60_000)
    monkeypatch.setattr("rstrack.volume.volume._AT_ONCE", 50)
    monkeypatch.setattr("rstrack.volume.blocks._FIRST_BLOCKS", 16)


def blocks_away(volume: Volume) -> int:
    """Blocks of which the file alone has the values."""
    return int(np.count_nonzero(volume._directory.slots < 0))


@pytest.mark.parametrize("color", sampled([True, False], 2))
def test_what_is_far_away_goes_to_a_file_and_comes_back_to_the_bit(
    monkeypatch: pytest.MonkeyPatch, small_window: None, color: bool
) -> None:
    """A small window and hardly any memory against one window for all, and all in memory."""
    poses, images = far_apart(20), []
    rng = np.random.default_rng(0)
    for k, _ in enumerate(poses):
        z = 1.5 + 0.2 * np.sin(0.3 * k + 5.0 * RAYS[..., 0]) + 0.1 * RAYS[..., 1]
        images.append((inverse(z), [ENGINE.upload(rng.uniform(0, 1, SHAPE)) for _ in range(4)] if color else None))
    away = 0

    def made(most_bytes: float) -> tuple[Volume, list[np.ndarray]]:
        nonlocal away
        volume, seen = Volume(ENGINE, 0.02, color, most_bytes=most_bytes), []
        for T, (rho, planes) in zip(poses, images, strict=True):
            volume.integrate(rho, T, LENS, color=planes)
            seen.append(ENGINE.download(volume.raycast(T, LENS), SHAPE))
            away = max(away, blocks_away(volume))
        return volume, seen

    far, far_seen = made(2e6 if color else 0.7e6)
    assert blocks_away(far) > 0.5 * far.blocks
    monkeypatch.setattr("rstrack.volume.blocks.MOST_ENTRIES", 2**24)
    away = 0
    whole, whole_seen = made(np.inf)
    assert away == 0 and far.bytes < 0.3 * whole.bytes
    for a, b in zip(far_seen, whole_seen, strict=True):
        np.testing.assert_array_equal(a, b)
    a, b = far.download(), whole.download()
    np.testing.assert_array_equal(a.at, b.at)
    np.testing.assert_array_equal(a.tsdf, b.tsdf)
    np.testing.assert_array_equal(a.weight, b.weight)
    assert (a.color is None) == (not color)
    if color:
        np.testing.assert_array_equal(a.color, b.color)
    assert np.ptp(far.download().at[:, 0]) * 0.02 * BLOCK > 85.0  # m
    whole_mesh, far_mesh = extract_surface(b, 0.02), extract_surface(a, 0.02)
    np.testing.assert_array_equal(whole_mesh.vertices, far_mesh.vertices)
    assert np.ptp(far_mesh.vertices[:, 0]) > 85.0


@pytest.mark.parametrize("away_m", [1.0e3, 1.0e5])
def test_a_volume_is_as_good_far_from_the_origin(away_m: float) -> None:
    shift = np.eye(4)
    shift[:3, 3] = np.round(np.array([away_m, -0.3 * away_m, 2.0 * away_m]) / 0.16) * 0.16
    volume, near = Volume(ENGINE, 0.02), filled()
    for T in POSES:
        volume.integrate(inverse(depth_of(WALL, T)), shift @ T, LENS)
    a, b = (ENGINE.download(v.raycast(s @ POSES[0], LENS), SHAPE) for v, s in ((volume, shift), (near, np.eye(4))))
    both = (a > 0) & (b > 0)
    assert both.sum() > 0.99 * max((a > 0).sum(), (b > 0).sum())
    np.testing.assert_allclose(a[both], b[both], atol=2e-5)
    mesh = extract_surface(volume.download(), 0.02)
    off = (mesh.vertices - shift[:3, 3]) @ WALL.normal - WALL.offset
    assert np.abs(off).max() < 2e-3 and np.median(np.abs(off)) < 2e-4


def test_what_is_away_goes_into_a_checkpoint_as_it_is_then() -> None:
    away, rng = FarBlocks(5), np.random.default_rng(1)
    first, second = rng.normal(size=(2, 3, 5)).astype(np.float32)
    away.put(np.array([7, 2, 9]), first)
    away.put(np.array([9]), second[:1])
    written = pickle.dumps(away)
    away.put(np.array([7, 2, 9, 4]), np.zeros((4, 5), np.float32))
    np.testing.assert_array_equal(pickle.loads(written).get(np.array([9, 7, 2])), [second[0], first[0], first[1]])
    assert pickle.loads(pickle.dumps(FarBlocks(5))).get(np.zeros(0, int)).shape == (0, 5)


def test_a_full_disk_is_said_in_one_line(monkeypatch: pytest.MonkeyPatch, small_window: None) -> None:
    monkeypatch.setattr("rstrack.volume.blocks.os.pwrite", lambda *_: 0)
    volume = Volume(ENGINE, 0.02, most_bytes=1e5)
    with pytest.raises(UserError, match="No space left"):
        for T in far_apart(20):
            volume.integrate(inverse(np.full(SHAPE, 1.5)), T, LENS)


def test_colors_come_back() -> None:
    volume, z = Volume(ENGINE, 0.02, color=True), depth_of(WALL, np.eye(4))
    left = np.broadcast_to(np.arange(SHAPE[1]) < SHAPE[1] // 2, SHAPE)
    planes = [ENGINE.upload(np.where(left, a, b)) for a, b in ((0.8, 0.1), (0.3, 0.6), (0.2, 0.9), (1.0, 1.0))]
    volume.integrate(inverse(z), np.eye(4), LENS, color=planes)
    blocks = volume.download()
    assert blocks.color is not None
    block, *zyx = np.nonzero(blocks.color[..., 3] > 0)
    points = 0.02 * (BLOCK * blocks.at[block] + np.stack(zyx[::-1], axis=-1))
    column, found = LENS.camera.project(points)[0][:, 0], blocks.color[block, *zyx, :3]
    for side, rgb in ((column < SHAPE[1] // 2 - 1, [0.8, 0.3, 0.2]), (column > SHAPE[1] // 2, [0.1, 0.6, 0.9])):
        assert side.sum() > 1000
        np.testing.assert_allclose(found[side], np.broadcast_to(rgb, (side.sum(), 3)), atol=1e-3)


def test_what_cannot_be_is_refused() -> None:
    for voxel_m in (0.0, 2.0, np.nan):
        with pytest.raises(UserError, match="voxel size"):
            Volume(ENGINE, voxel_m)
    with pytest.raises(UserError, match="finite"):
        Volume(ENGINE).integrate(inverse(np.ones(SHAPE)), np.full((4, 4), np.nan), LENS)
    with pytest.raises(UserError, match="larger voxels"):
        Volume(ENGINE, 0.001).integrate(inverse(np.full(SHAPE, 50.0)), np.eye(4), LENS)
    empty = Volume(ENGINE)
    empty.integrate(inverse(np.zeros(SHAPE)), np.eye(4), LENS)
    assert empty.blocks == 0
    with pytest.raises(UserError, match="no surface"):
        extract_surface(empty.download(), 0.01)


# ---------------------------------------------------------------------------------------------------------------------


def ball_blocks(radius: float, centre: np.ndarray, color: bool = False) -> Blocks:
    """A ball's distances in 12³ blocks around the origin: more than one chunk, seams inside the ball."""
    n = 12
    grid = (np.arange(n * BLOCK) - n * BLOCK // 2).astype(float)
    z, y, x = np.meshgrid(grid, grid, grid, indexing="ij")
    tsdf = np.clip((np.sqrt((x - centre[0]) ** 2 + (y - centre[1]) ** 2 + (z - centre[2]) ** 2) - radius) / 4, -1, 1)

    def packed(values: np.ndarray) -> np.ndarray:
        return values.reshape(n, BLOCK, n, BLOCK, n, BLOCK).transpose(0, 2, 4, 1, 3, 5).reshape(-1, BLOCK, BLOCK, BLOCK)

    planes = [np.clip(0.5 + x / 100, 0, 1), np.full_like(x, 0.25), np.full_like(x, 1.0), np.ones_like(x)]
    colors = np.stack([packed(p) for p in planes], axis=-1).astype(np.float32) if color else None
    one = np.ones_like(tsdf)
    at = np.stack(np.unravel_index(np.arange(n**3), (n, n, n))[::-1], axis=-1) - n // 2
    return Blocks(at, packed(tsdf).astype(np.float32), packed(one).astype(np.float32), colors)


def test_a_ball_becomes_a_closed_mesh_without_seams() -> None:
    centre = np.array([1.3, -2.6, 4.1])
    surface = extract_surface(ball_blocks(30.0, centre), 0.01)
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * 0.3**3, rel=5e-3)  # positive: outside is in front
    radius = np.linalg.norm(surface.vertices - 0.01 * centre, axis=1)
    np.testing.assert_allclose(radius, 0.3, atol=2e-4)


def test_points_that_were_not_seen_leave_a_hole() -> None:
    blocks = ball_blocks(30.0, np.zeros(3))
    whole = len(extract_surface(blocks, 0.01).faces)
    z = (np.arange(12) - 6)[:, None, None] * BLOCK
    weight = blocks.weight.reshape(12, 12, 12, BLOCK, BLOCK, BLOCK).copy()
    weight[(z >= 0).ravel()] = 0.0
    half = extract_surface(Blocks(blocks.at, blocks.tsdf, weight.reshape(-1, 8, 8, 8), None), 0.01)
    assert half.vertices[:, 2].max() <= -0.01 + 1e-9
    assert 0.4 < len(half.faces) / whole < 0.55


def test_vertices_have_the_lattices_colors() -> None:
    surface = extract_surface(ball_blocks(30.0, np.zeros(3), color=True), 0.01)
    assert surface.colors is not None
    np.testing.assert_allclose(surface.colors[:, 0] / 255, 0.5 + surface.vertices[:, 0], atol=5e-3)
    np.testing.assert_array_equal(surface.colors[:, 1:], [[64, 255]] * len(surface.colors))


def test_ply_files_are_read_back(tmp_path: Path) -> None:
    surface = extract_surface(ball_blocks(30.0, np.zeros(3), color=True), 0.01)
    write_ply(tmp_path / "mesh.ply", surface, "made by a test")
    mesh = trimesh.load(tmp_path / "mesh.ply", process=False)
    np.testing.assert_allclose(mesh.vertices, surface.vertices, atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, surface.faces)
    np.testing.assert_array_equal(mesh.visual.vertex_colors[:, :3], surface.colors)
    assert b"comment made by a test\n" in (tmp_path / "mesh.ply").read_bytes()[:200]
    write_ply(tmp_path / "cloud.ply", surface, cloud=True)
    assert isinstance(cloud := trimesh.load(tmp_path / "cloud.ply"), trimesh.PointCloud)
    assert len(cloud.vertices) == len(surface.vertices)
