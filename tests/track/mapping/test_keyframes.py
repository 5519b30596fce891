"""Fused keyframes as a TUM folder: read back, their depth and poses lie on the room's walls."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import synthetic

from rsgen.errors import UserError
from rsgen.geometry import se3
from rstrack.cli.main import main
from rstrack.data.dataset import open_dataset
from rstrack.data.estimate import Estimate, write_estimate
from rstrack.mapping.keyframes import write_keyframes


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return synthetic.make_sequence(tmp_path_factory.mktemp("room") / "seq", synthetic.make_config(128, 96), 12)


def test_they_are_a_folder_that_can_be_tracked(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth = open_dataset(root).truth
    assert truth is not None
    stamps = open_dataset(root).stamps
    write_estimate(tmp_path / "run", stamps, truth.pose(stamps), truth, {})
    out = tmp_path / "keyframes"
    words = [str(tmp_path / "run"), "keyframes", "--out", str(out), "--quiet"]
    assert main(["export", *words]) == 2 and not out.exists()
    assert "name it with --sequence" in capsys.readouterr().err
    assert main(["export", *words, "--sequence", str(root)]) == 0
    found = open_dataset(out)
    assert len(found) >= 2 and found.rig.depth_shutter.readout_s == 0.0
    rows = np.loadtxt(out / "trajectory.txt", ndmin=2)
    T_world_cam = se3.from_quat_trans(rows[:, 4:], rows[:, 1:4])
    np.testing.assert_allclose(T_world_cam, truth.pose(rows[:, 0]), atol=1e-6)
    camera = found.rig.depth_camera
    for k in range(len(found)):
        frame = found.frame(k)
        z = frame.depth.pixels
        assert (z > 0).mean() > 0.8
        # Away from edges every point lies on a wall or on the ball: closed form.
        d = camera.unproject(camera.pixel_grid()) @ T_world_cam[k, :3, :3].T
        expected = synthetic.cast(np.broadcast_to(T_world_cam[k, :3, 3], d.shape), d)
        error = np.abs(z - expected)[z > 0]
        assert np.median(error) < 2e-4 and np.percentile(error, 95) < 3e-3  # a unit is 0.2 mm
        assert frame.colors[0].pixels[z > 0].mean() > 20


def test_an_estimate_without_a_spline_is_refused_in_a_line(root: Path, tmp_path: Path) -> None:
    dataset = open_dataset(root)
    estimate = Estimate(dataset.stamps, np.repeat(np.eye(4)[None], len(dataset), axis=0))
    with pytest.raises(UserError, match="rstrack map"):
        write_keyframes(dataset, estimate, tmp_path / "out")
    assert not (tmp_path / "out").exists()
