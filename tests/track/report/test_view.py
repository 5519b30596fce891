"""What one watches of a tracker: residuals against exact ray casting, and a recording that changes nothing."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
import synthetic

from rsgen.errors import UserError
from rsgen.geometry.shutter import Scan, project_rolling
from rstrack.cli.main import main
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.data.rig import Image
from rstrack.options import Options
from rstrack.tracking.runs import run
from rstrack.tracking.runs.record import Result
from rstrack.view import Viewer, depth_residuals, open_view, world_points


@pytest.mark.parametrize("scan", ["top-bottom", "bottom-top", "right-left"])
def test_residuals_are_how_far_a_surface_has_moved(scan: Scan) -> None:
    config = synthetic.make_config(width=160, height=120, depth={"readout_s": 0.028, "scan": scan})
    spline, camera, shutter = synthetic.make_spline(), config.depth.camera, config.depth.shutter
    first, second = (Image(t, synthetic.render_depth(spline, camera, shutter, t)) for t in (0.2, 0.3))
    points = world_points(spline, camera, shutter, first, 3)
    # Points are on the walls or on the ball.
    off_wall = np.minimum(np.abs(points - synthetic.BOX[0]), np.abs(points - synthetic.BOX[1])).min(axis=-1)
    off_ball = np.abs(np.linalg.norm(points - synthetic.BALL, axis=-1) - synthetic.BALL_RADIUS)
    assert np.minimum(off_wall, off_ball).max() < 1e-4
    off = depth_residuals(spline, camera, shutter, points, second)
    assert np.isfinite(off).mean() > 0.5
    # Up to what lies between pixels of the ball, and what a line's own time makes of its neighbour.
    assert np.nanmedian(np.abs(off)) < 2e-4 and np.nanpercentile(np.abs(off), 90) < 2e-3
    # A surface that is 50 mm nearer in the other image is that much nearer everywhere.
    nearer = Image(second.stamp, second.pixels - np.float32(0.05))
    change = depth_residuals(spline, camera, shutter, points, nearer) - off
    assert np.isfinite(change).mean() > 0.5 and np.nanmax(np.abs(change + 0.05)) < 1e-3
    assert np.nanmedian(np.abs(change + 0.05)) < 1e-5
    # The same pixels are met as by the exact equation of the shutter.
    uv, _, valid = project_rolling(spline, np.eye(4), camera, shutter, second.stamp, points)
    columns = np.broadcast_to(100.0 + camera.pixel_grid()[..., 0].astype(np.float32), (120, 160))
    met = depth_residuals(spline, camera, shutter, points, Image(second.stamp, columns))
    z = depth_residuals(spline, camera, shutter, points, Image(second.stamp, np.full_like(columns, 100.0)))
    both = valid & np.isfinite(met)
    assert both.sum() > 0.95 * valid.sum() > 1000
    assert np.abs((met - z)[both] - uv[both][:, 0]).max() < 0.05


def test_points_without_depth_are_left_out() -> None:
    config = synthetic.make_config()
    spline, camera, shutter = synthetic.make_spline(), config.depth.camera, config.depth.shutter
    image = Image(0.2, synthetic.render_depth(spline, camera, shutter, 0.2))
    image.pixels[:10] = 0.0
    points = world_points(spline, camera, shutter, image, 1)
    assert np.isnan(points[:10]).all() and np.isfinite(points[10:]).all()
    off = depth_residuals(spline, camera, shutter, points, image)
    assert np.isnan(off[:10]).all() and np.nanmax(np.abs(off[10:])) < 1e-5
    assert np.isfinite(off[11:]).mean() > 0.8, "all but the ball's edge"


class Rerun(MagicMock):
    """Stands in for rerun where it is not installed: it writes a file, and remembers what it was told."""

    def told(self) -> dict[str, int]:
        """How often each thing was logged."""
        names = [call.args[0] for call in self.RecordingStream.return_value.log.call_args_list]
        return {name: names.count(name) for name in names}


@pytest.fixture
def rerun(monkeypatch: pytest.MonkeyPatch) -> Rerun:
    module = Rerun()
    module.RecordingStream.return_value.save.side_effect = lambda path: Path(path).write_text("a recording")
    monkeypatch.setitem(sys.modules, "rerun", module)
    return module


def test_a_run_is_watched_and_stays_the_same_to_the_bit(
    tmp_path: Path, rerun: Rerun, monkeypatch: pytest.MonkeyPatch
) -> None:
    def often(dataset: Dataset, options: Options, *rest: Any) -> Result:
        return tracked(dataset, replace(options, bootstrap_frames=3, keyframe_distance=0.05), *rest)

    tracked = run.track
    monkeypatch.setattr(run, "track", often)
    root = synthetic.make_sequence(tmp_path / "seq", synthetic.make_config(width=80, height=60), frames=14)
    arguments = ["track", str(root), "--backend", "llvm", "--quiet"]
    view = tmp_path / "views/run.rrd"
    # Whether a frame of so small images is lost hangs on the machine's rounding; that both are alike does not.
    status = main([*arguments, "--out", str(tmp_path / "plain")])
    assert main([*arguments, "--out", str(tmp_path / "seen"), "--view", str(view)]) == status
    for name in ("trajectory.txt", "spline.npz"):
        assert (tmp_path / "plain" / name).read_bytes() == (tmp_path / "seen" / name).read_bytes()
    assert [path.name for path in view.parent.iterdir()] == ["run.rrd"]
    told = rerun.told()
    assert told["figures/overlap"] == 14 and told["world/camera"] >= 9 and told["world/path_corrected"] == 1
    assert told["world/camera/color/image"] == told["world/camera/depth/image"] == 5
    assert sum(name.startswith("world/map/") for name in told) >= 2 and told["residuals/depth"] >= 2
    assert max(told[name] for name in told if name.startswith("world/map/")) == 1


def test_a_view_that_breaks_down_leaves_what_was_tracked(
    tmp_path: Path, rerun: Rerun, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(_: Viewer, index: int, *__: object) -> None:
        if index == 4:
            raise UserError("no room")

    root = synthetic.make_sequence(tmp_path / "seq", synthetic.make_config(width=80, height=60), frames=5)
    monkeypatch.setattr(Viewer, "see", broken)
    arguments = ["track", str(root), "--backend", "llvm", "--quiet"]
    assert main([*arguments, "--out", str(tmp_path / "run"), "--view", str(tmp_path / "run.rrd")]) == 1
    assert "--view broke down at frame 4: no room" in capsys.readouterr().err
    assert len((tmp_path / "run/trajectory.txt").read_text().splitlines()) >= 5


def test_a_window_is_opened_where_no_file_is_named(tmp_path: Path, rerun: Rerun) -> None:
    root = synthetic.make_sequence(tmp_path / "seq", synthetic.make_config(width=80, height=60), frames=5)
    arguments = ["track", str(root), "--backend", "llvm", "--frames", "0:4", "--quiet", "--out", str(tmp_path / "run")]
    assert main([*arguments, "--view"]) in (0, 1)
    stream = rerun.RecordingStream.return_value
    assert stream.spawn.call_count == 1 and not stream.save.called
    stream.spawn.side_effect = RuntimeError("no display")
    assert main([*arguments, "--view"]) == 2


@pytest.mark.parametrize(
    ("file", "message"),
    [("run.bin", r"named \.rrd"), ("there.rrd", "is there already"), ("there.rrd/under.rrd", "there.rrd")],
)
def test_what_is_no_place_for_a_recording(tmp_path: Path, rerun: Rerun, file: str, message: str) -> None:
    rig = open_dataset(synthetic.make_sequence(tmp_path / "seq", frames=2)).rig
    (tmp_path / "there.rrd").write_text("mine")
    with pytest.raises(UserError, match=message), open_view(tmp_path / file, rig, "seq"):
        pass
    assert (tmp_path / "there.rrd").read_text() == "mine"


def test_what_breaks_down_leaves_no_recording(tmp_path: Path, rerun: Rerun) -> None:
    rig = open_dataset(synthetic.make_sequence(tmp_path / "seq", frames=2)).rig
    with pytest.raises(KeyboardInterrupt), open_view(tmp_path / "run.rrd", rig, "seq"):
        raise KeyboardInterrupt
    assert [path.name for path in tmp_path.iterdir()] == ["seq"]


def test_a_missing_rerun_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    root = synthetic.make_sequence(tmp_path / "seq", frames=2)
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert main(["track", str(root), "--out", str(tmp_path / "run"), "--view", str(tmp_path / "run.rrd")]) == 2
    assert "--view: rerun is not installed: pip install" in capsys.readouterr().err


def test_rerun_reads_back_what_was_seen(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    chunks = pytest.importorskip("rerun.chunk")
    root = synthetic.make_sequence(tmp_path / "seq", synthetic.make_config(width=80, height=60), frames=14)
    arguments = ["track", str(root), "--backend", "llvm", "--quiet"]
    assert main([*arguments, "--out", str(tmp_path / "run"), "--view", str(tmp_path / "run.rrd")]) == 0
    rows: dict[str, int] = {}
    for chunk in chunks.RrdReader(tmp_path / "run.rrd").stream():
        rows[chunk.entity_path] = rows.get(chunk.entity_path, 0) + chunk.num_rows
    assert rows["/world/camera/color/image"] == 5 and rows["/figures/overlap"] == 14
    assert {"/world/path", "/world/path_corrected", "/residuals/depth"} <= set(rows)
