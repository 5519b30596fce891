"""Damaged recordings of every format: one line, nothing half-written, no path left, memory bounded."""

from __future__ import annotations

import resource
import shutil
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import recordings
from import_command import fake_lzfse
from nightly import QUICK_OR_ALL
from recordings import Talker

import rstrack.formats.bags.bag
from rsgen.errors import UserError
from rstrack.data.dataset import open_dataset
from rstrack.formats import open_recording
from rstrack.formats.folder import write_folder
from rstrack.formats.recording import ReadOptions

CONTENT = recordings.make_content()
# Of a format that keeps images as they are, a flipped byte within one is no matter of the import's.
FLIPS, CUTS, FILLS = 5, 3, 4
EVERY = 3
_MOST_GROWTH_KB = 400_000


def _bag(storage: str, is_ros1: bool = True) -> Callable[[Path], Path]:
    def write(path: Path) -> Path:
        talker = Talker(is_ros1)
        return recordings.write_spoken(path, talker, recordings.speak(talker, CONTENT), storage)

    return write


BASES: dict[str, Callable[[Path], Path]] = {
    "one.bag": _bag(""),
    "packed.bag": _bag("bz2"),
    "rs.bag": lambda path: recordings.write_realsense(path, CONTENT),
    "two.mcap": _bag("mcap", False),
    "two.db3": _bag("sqlite3", False),
    "scene.sens": lambda path: recordings.write_sens(path, CONTENT),
    "one.r3d": lambda path: recordings.write_r3d(path, CONTENT),
    "scan": lambda path: recordings.write_stray(path, CONTENT),
}


def damaged(data: bytes, seed: int) -> list[tuple[str, bytes]]:
    """Bytes flipped, cut short, and runs overwritten with what is an absurd size wherever one stands."""
    rng = np.random.default_rng(seed)
    found = []
    for k in range(FLIPS):
        out = bytearray(data)
        # Structures stand at the beginning and the end; images fill the middle.
        low, high = [(0, 64), (0, min(2000, len(data))), (max(0, len(data) - 2000), len(data))][k % 3]
        for at in rng.integers(low, min(high, len(data)), 1 + k):
            out[at] ^= 1 << int(rng.integers(8))
        found.append((f"flip {k}", bytes(out)))
    for k in range(CUTS):
        found.append((f"cut {k}", data[: int(rng.integers(1, len(data)))]))
    for k in range(FILLS):
        out = bytearray(data)
        at = int(rng.integers(0, min(1500, len(data)))) if k % 2 else int(rng.integers(0, len(data)))
        run = [b"\xff" * 8, b"\xff\xff\xff\x7f", bytes(16), rng.bytes(40)][k % 4]
        out[at : at + len(run)] = run
        found.append((f"fill {k}", bytes(out[: len(data)])))
    return found


def attempt(path: Path, out: Path) -> str:
    """What was said, or nothing if it was imported. Whatever else is raised is the test's failure."""
    before = sorted(path.parent.iterdir())
    try:
        write_folder(open_recording(path, ReadOptions()), out, file=path.name)
    except UserError as error:
        assert sorted(path.parent.iterdir()) == before, error
        assert ("\n" not in str(error) and str(path) in str(error)) or path.name in str(error)
        return str(error)
    assert sorted({*path.parent.iterdir()} - set(before)) == [out]
    dataset = open_dataset(out)
    dataset.readable_frame(0)
    shutil.rmtree(out)
    return ""


@pytest.mark.parametrize("is_quick", QUICK_OR_ALL)
@pytest.mark.parametrize("name", BASES)
def test_damaged_recordings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, is_quick: bool) -> None:
    fake_lzfse(monkeypatch)
    place = tmp_path / "place"
    place.mkdir()
    whole = BASES[name](place / name)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert attempt(whole, place / "out") == ""
    files = (
        [whole] if whole.is_file() else [whole / n for n in ("odometry.csv", "rgb.mp4", "depth/000001.png", "imu.csv")]
    )
    refused = tried = 0
    for file in files:
        data = file.read_bytes()
        for _, bytes_ in damaged(data, len(data))[:: EVERY if is_quick else 1]:
            file.write_bytes(bytes_)
            refused += bool(attempt(whole, place / "out"))
            tried += 1
        file.write_bytes(data)
    print(name, refused, "of", tried)
    assert tried >= (4 if is_quick else 12) and refused >= tried // 4, (tried, refused)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - grown < _MOST_GROWTH_KB
    assert sorted(path.name for path in tmp_path.iterdir()) == ["place"]


@pytest.mark.parametrize("name", ["packed.bag", "two.mcap"])
def test_a_chunk_that_unpacks_to_too_much_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    path = BASES[name](tmp_path / name)
    monkeypatch.setattr(rstrack.formats.bags.bag, "_MOST_CHUNK_BYTES", 1000)
    assert "unpacks to more than 1000 bytes" in attempt(path, tmp_path / "out")


def test_a_zip_bomb_and_names_that_leave_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_lzfse(monkeypatch)
    path = recordings.write_r3d(tmp_path / "one.r3d", CONTENT)
    bomb = tmp_path / "bomb.r3d"
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as new:
        for info in old.infolist():
            new.writestr(info.filename, bytes(100 << 20) if info.filename == "rgbd/1.jpg" else old.read(info))
    assert bomb.stat().st_size < 1 << 20
    assert f"unpacks to {100 << 20} bytes" in attempt(bomb, tmp_path / "out")
    # The directory lies about the size: what comes out is counted.
    data = bytearray(bomb.read_bytes())
    at = data.rindex(b"PK\x01\x02", 0, data.rindex(b"rgbd/1.jpg"))
    data[at + 24 : at + 28] = struct.pack("<I", 1000)
    bomb.write_bytes(data)
    assert attempt(bomb, tmp_path / "out") != ""
    assert not (tmp_path.parent / "outside.txt").exists()


def test_metadata_of_any_shape(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_lzfse(monkeypatch)
    for change in (
        {"K": None}, {"K": [1] * 8}, {"poses": [[1]]}, {"poses": "x"}, {"frameTimestamps": ["x"] * 5},
        {"perFrameIntrinsicCoeffs": [[1e400] * 4] * 5}, {"dw": 10**9, "dh": 10**9}, {"dw": -1},
        {"fps": 0, "frameTimestamps": []},
        {"frameTimestamps": [1e300] * 5}, {"K": [0.0] * 9, "perFrameIntrinsicCoeffs": []},
    ):  # fmt: skip
        assert attempt(recordings.write_r3d(tmp_path / "one.r3d", CONTENT, **change), tmp_path / "out"), change
    # Poses that are none are no truth, and no reason to refuse the rest.
    odd = [[float("nan")] * 7, [0] * 7, [2, 0, 0, 0, 1, 1, 1], [0, 0, 0, 1, 1e300, 0, 0], [0, 0, 0, 1, 0, 0, 0]]
    assert attempt(recordings.write_r3d(tmp_path / "one.r3d", CONTENT, poses=odd), tmp_path / "out") == ""
