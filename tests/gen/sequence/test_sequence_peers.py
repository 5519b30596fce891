"""What other tools read of a sequence: evo its ground truth, the TUM tools' conventions its listings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import synthetic
from evo.tools import file_interface

from rsgen.sequence.reader import read_sequence


def test_evo_reads_the_ground_truth(tmp_path: Path) -> None:
    synthetic.make_sequence(tmp_path / "seq", frames=4)
    sequence = read_sequence(tmp_path / "seq")
    trajectory = file_interface.read_tum_trajectory_file(tmp_path / "seq" / "groundtruth.txt")
    valid, _ = trajectory.check()
    assert valid
    expected = sequence.spline.pose(trajectory.timestamps)
    np.testing.assert_allclose(np.array(trajectory.poses_se3), expected, atol=1e-9)
    stamps = sequence.streams["depth"].stamps
    assert np.isin(stamps, trajectory.timestamps).all()


def test_associations_pair_rgb_first_as_the_tum_tools_do(tmp_path: Path) -> None:
    synthetic.make_sequence(tmp_path / "seq", frames=4)
    for line in (tmp_path / "seq" / "associations.txt").read_text().splitlines():
        stamp_rgb, rgb, stamp_depth, depth = line.split()
        assert rgb.startswith("rgb/") and depth.startswith("depth/")
        assert (tmp_path / "seq" / rgb).is_file() and (tmp_path / "seq" / depth).is_file()
        assert abs(float(stamp_rgb) - float(stamp_depth)) < 0.5 / 30
