"""Masks of what moves: kept, written, read, and heeded by a map."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic import BALL, BALL_RADIUS, make_config, make_sequence

from rsgen.errors import UserError
from rsgen.geometry import se3
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.data.estimate import Estimate, read_estimate, write_estimate
from rstrack.data.moving_masks import MOVING, MovingMasks
from rstrack.mapping.map import reconstruct
from rstrack.options import MapOptions

SHAPE = 15, 20


def masks() -> MovingMasks:
    rng, out = np.random.default_rng(1), MovingMasks()
    for frame in (3, 0, 8):
        out.put(frame, rng.random(SHAPE) < 0.3, 2)
    return out


def test_what_is_put_comes_back() -> None:
    mask, kept = np.random.default_rng(2).random(SHAPE) < 0.3, masks()
    kept.put(5, mask, 2)
    np.testing.assert_array_equal(kept.grid(5), mask)
    assert kept.grid(4) is None and kept.of(4, 29, 40) is None and len(kept) == 4
    full = kept.of(5, 29, 40)
    assert full is not None and full.shape == (29, 40)
    np.testing.assert_array_equal(full[::2, ::2], mask)
    np.testing.assert_array_equal(full[1::2, 1::2], mask[:-1])
    kept.put(5, np.zeros(SHAPE, bool), 2)
    assert kept.grid(5) is None and len(kept) == 3


def test_a_margin_is_as_wide_as_it_says() -> None:
    kept, one = MovingMasks(), np.zeros(SHAPE, bool)
    one[7, 10] = True
    kept.put(0, one, 2)
    wide = kept.of(0, 30, 40, margin=3)
    assert wide is not None
    rows, columns = (np.flatnonzero(wide.any(axis=axis)) for axis in (1, 0))
    assert (rows[0], rows[-1], columns[0], columns[-1]) == (11, 18, 17, 24)


def test_a_runs_folder_has_them_by_the_data_sets_frames(tmp_path: Path) -> None:
    kept = masks()
    kept.write(tmp_path, [10 * n for n in range(9)])
    found = MovingMasks.read(tmp_path)
    assert len(found) == 3
    for frame in (0, 3, 8):
        np.testing.assert_array_equal(found.grid(10 * frame), kept.grid(frame))
    assert len(MovingMasks.read(tmp_path / "elsewhere")) == 0
    MovingMasks().write(tmp_path / "none", [])
    assert not (tmp_path / "none").exists()


def test_a_new_run_takes_an_older_ones_away(tmp_path: Path) -> None:
    masks().write(tmp_path, range(9))
    T = np.broadcast_to(np.eye(4), (4, 4, 4))
    write_estimate(tmp_path, np.arange(4.0), T, None, {})
    assert len(read_estimate(tmp_path).moving) == 0


def test_what_does_not_fit_is_said(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="not of images of 640x480: give the sequence that was tracked"):
        masks().of(3, 480, 640)
    masks().write(tmp_path, range(9))
    data = (tmp_path / MOVING).read_bytes()
    for wrong in (data[:-200], b"nonsense", data.replace(b"stride", b"stridf")):
        (tmp_path / MOVING).write_bytes(wrong)
        with pytest.raises(UserError, match=r"moving\.npz: cannot be read .*: track again"):
            MovingMasks.read(tmp_path)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return open_dataset(make_sequence(tmp_path_factory.mktemp("room") / "seq", make_config(128, 96)))


def test_a_map_does_without_what_moves(dataset: Dataset) -> None:
    """The ball left out of every frame: no point of it is left, and the room behind it is what it was."""
    assert dataset.truth is not None
    stamps = dataset.stamps
    whole = Estimate(stamps, dataset.truth.pose(stamps), dataset.truth)
    kept = MovingMasks()
    for k in range(len(dataset)):
        frame = dataset.frame(k, color=False)
        camera, shutter = dataset.rig.depth_camera, dataset.rig.depth_shutter
        uv = camera.pixel_grid()
        t = shutter.line_mid_time(frame.depth.stamp, shutter.line_of_pixel(uv, camera), camera)
        z = np.asarray(frame.depth.pixels)
        p_world = se3.transform(dataset.truth.pose(t), camera.unproject(uv) * z[..., None])
        kept.put(k, np.abs(np.linalg.norm(p_world - BALL, axis=-1) - BALL_RADIUS) < 0.02, 1)
    options = MapOptions(voxel_m=0.03, backend="llvm", color=False)
    ghosts = []
    for estimate in (whole, replace(whole, moving=kept)):
        vertices = reconstruct(dataset, estimate, options).surface.vertices
        ghosts.append(np.count_nonzero(np.linalg.norm(vertices - BALL, axis=1) < 1.3 * BALL_RADIUS))
        assert len(vertices) > 5000
    assert ghosts[0] > 200 and ghosts[1] == 0
