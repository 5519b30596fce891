"""`rstrack import` in the working directory, and what has to come of the recording that `recordings` makes."""

from __future__ import annotations

import sys
import types
from pathlib import Path

import numpy as np
import pytest
import recordings
from recordings import COLOR_K, COLOR_SIZE, COUNT, DEPTH_K, T_COLOR_DEPTH, Content

from rstrack.cli.main import main
from rstrack.data.dataset import Dataset, open_dataset

CONTENT = recordings.make_content()


def run(capfd: pytest.CaptureFixture[str], words: str) -> tuple[int, str, str]:
    capfd.readouterr()
    status = main(["import", *words.split(), "--quiet"])
    out, error = capfd.readouterr()
    assert "Traceback" not in error
    return status, out, error


def imported(capfd: pytest.CaptureFixture[str], words: str) -> tuple[Dataset, str]:
    status, out, error = run(capfd, f"{words} out")
    assert status == 0 and not error, error
    assert not [path for path in Path().iterdir() if path.name.endswith(".tmp")]
    return open_dataset(Path("out")), out


def refused(capfd: pytest.CaptureFixture[str], words: str, *said: str) -> None:
    before = sorted(Path().iterdir())
    status, out, error = run(capfd, f"{words} out")
    assert (status, out) == (2, "") and error.count("\n") == 1, (status, out, error)
    assert all(word in error for word in said), error
    assert sorted(Path().iterdir()) == before


def check_frames(dataset: Dataset, content: Content = CONTENT, colors: bool = True) -> None:
    """Images and stamps to the bit and the nanosecond."""
    assert len(dataset) == COUNT
    for k in range(COUNT):
        assert (dataset.images.depth(k) == content.units[k] / np.float32(1000)).all()
        if colors:
            assert (dataset.images.color(k) == content.colors[k]).all()
    for name, stamps, folder in (("depth", content.depth_ns, "depth"), ("rgb", content.color_ns, "rgb")):
        lines = (dataset.root / f"{name}.txt").read_text().splitlines()[1:]
        assert [int(line.split()[0].replace(".", "")) for line in lines] == list(stamps)
        assert all(line.split()[1].startswith(f"{folder}/") for line in lines)


def check_cameras(dataset: Dataset, tolerance: float = 1e-12) -> None:
    for camera, K, size in (
        (dataset.rig.color_camera, COLOR_K, COLOR_SIZE),
        (dataset.rig.depth_camera, DEPTH_K, recordings.DEPTH_SIZE),
    ):
        assert (camera.width, camera.height) == size and camera.model == "pinhole"
        assert np.allclose((camera.fx, camera.fy, camera.cx, camera.cy), K, atol=tolerance, rtol=0)
    assert np.allclose(dataset.rig.T_color_depth, T_COLOR_DEPTH, atol=max(tolerance, 1e-9), rtol=0)


def fake_lzfse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Unpacks what is stored as it is; the library itself, where there is one, does too."""

    def decompress(data: bytes) -> bytes:
        if data[:4] != b"bvx-" or data[-4:] != b"bvx$":
            raise ValueError("no block")
        return data[8:-4]

    module = types.ModuleType("liblzfse")
    module.decompress = decompress  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "liblzfse", module)
