"""Videos read back by OpenCV, and recordings for rerun where it is installed."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from exported import IMU, make_plain, with_imu

from rsgen.errors import UserError
from rsgen.formats.export.rerun import export_rerun
from rsgen.formats.export.video import write_video
from rsgen.sensors.reports import sequence_imu
from rsgen.sequence.images import Sequence


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    return with_imu(make_plain(tmp_path_factory.mktemp("plain")), IMU)


# --- video -----------------------------------------------------------------------------------------------------------


def ramp(count: int, first: int, step: int, size: tuple[int, int] = (61, 83)) -> Iterator[np.ndarray]:
    return (np.full((*size, 3), (first + step * k, 120, 60), np.uint8) for k in range(count))


@pytest.mark.parametrize("suffix", [".mp4", ".avi"])
@pytest.mark.parametrize("fps", [30.0, 30 / 1.001])
def test_a_video_reads_back(suffix: str, fps: float, tmp_path: Path) -> None:
    path, done = tmp_path / f"both{suffix}", []
    message = write_video(
        path, ramp(12, 20, 10), ramp(12, 220, -10), fps, count=12, progress=lambda stage, part, note: done.append(part)
    )
    assert "12 frames" in message and done[-1] == 1.0
    video = cv2.VideoCapture(str(path))
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(fps, rel=1e-3)
    for k in range(12):
        ok, bgr = video.read()
        assert ok and bgr.shape == (62, 170, 3)
        left, right = bgr[5:20, 5:78, ::-1].mean((0, 1)), bgr[5:20, 92:165, ::-1].mean((0, 1))
        np.testing.assert_allclose(left, (20 + 10 * k, 120, 60), atol=6)
        np.testing.assert_allclose(right, (220 - 10 * k, 120, 60), atol=6)
        assert bgr[45:60, 5:78].max() > 200  # the label
    assert not video.read()[0]
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize(
    ("name", "left"),
    [
        ("v.gif", lambda: ramp(2, 0, 1)),
        ("there.mp4", lambda: ramp(2, 0, 1)),
        ("nowhere/v.mp4", lambda: ramp(2, 0, 1)),
        ("empty.mp4", lambda: ramp(0, 0, 1)),
    ],
)
def test_a_video_that_cannot_be_is_one_line(name: str, left: Callable[[], Any], tmp_path: Path) -> None:
    (tmp_path / "there.mp4").write_text("mine")
    with pytest.raises(UserError) as error:
        write_video(tmp_path / name, left(), left(), 30.0)
    assert "\n" not in str(error.value)
    assert (tmp_path / "there.mp4").read_text() == "mine" and len(list(tmp_path.iterdir())) == 1


def test_unequal_runs_and_sizes_leave_no_video(tmp_path: Path) -> None:
    for right in (ramp(2, 0, 1), ramp(3, 0, 1, (61, 85))):
        with pytest.raises(ValueError):
            write_video(tmp_path / "v.mp4", ramp(3, 0, 1), right, 30.0)
    assert not list(tmp_path.iterdir())


# --- rerun -----------------------------------------------------------------------------------------------------------


def test_a_missing_rerun_is_one_line(sequence: Sequence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(UserError, match=r"^--out: rerun is not installed: pip install [^\n]*$"):
        export_rerun(sequence, tmp_path / "out.rrd")


def test_a_rerun_recording_holds_everything(sequence: Sequence, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    chunks = pytest.importorskip("rerun.chunk")
    out = tmp_path / "out.rrd"
    assert str(out) in export_rerun(sequence, out)
    assert [path.name for path in tmp_path.iterdir()] == ["out.rrd"]
    rows: dict[str, int] = {}
    for chunk in chunks.RrdReader(out).stream():
        rows[chunk.entity_path] = rows.get(chunk.entity_path, 0) + chunk.num_rows
    samples = sequence_imu(sequence)
    assert samples is not None
    assert rows["/world/color/image"] == rows["/world/depth/image"] == 6
    assert rows["/imu/gyro"] == rows["/imu/accel"] == len(samples[1].t) + 1
    assert {"/world", "/world/scene", "/world/path", "/world/color", "/world/depth"} <= set(rows)
    with pytest.raises(UserError, match="there already"):
        export_rerun(sequence, out)
    with pytest.raises(UserError, match=r"named \.rrd"):
        export_rerun(sequence, tmp_path / "out.bin")
