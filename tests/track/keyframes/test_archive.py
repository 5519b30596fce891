"""Keyframes that are put away: in memory as long as they fit, then in files, and the same when they come back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import synthetic

from rsgen.errors import UserError
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rstrack.data.rig import Frame, Image, Rig
from rstrack.images.device_frame import DeviceRig
from rstrack.keyframes.archive import Archive, resemblances
from rstrack.keyframes.keyframe import Reference
from rstrack.keyframes.maker import KeyframeMaker
from rstrack.options import Options
from rstrack.tracking.spline_tracker import Tracker

CAMERA, SHUTTER = Camera(80, 60, 60.0, 60.0, 39.5, 29.5), Shutter(readout_s=0.02)
TRUTH = synthetic.make_spline(0.3)
RIG = Rig(CAMERA, SHUTTER, CAMERA, SHUTTER, synthetic.T_COLOR_DEPTH)
ONE = 80 * 60 * (4 + 2 + 4)  # inverse depth, weight, intensity


@pytest.fixture(scope="module")
def made() -> tuple[KeyframeMaker, list[Reference]]:
    device = DeviceRig(RIG, Options(backend="llvm"))
    maker, refs = KeyframeMaker.of(device), []
    for k in range(4):
        stamp = 0.1 + 0.1 * k
        depth = synthetic.render_depth(TRUTH, CAMERA, SHUTTER, stamp)
        color = synthetic.render_color(TRUTH, CAMERA, SHUTTER, stamp, synthetic.T_COLOR_DEPTH)
        frame = device.upload(k, Frame(Image(stamp, depth), (Image(stamp, color),)))
        refs.append(maker.rectified(k, frame.depth, frame.colors, TRUTH, None))
    return maker, refs


def same(a: Reference, b: Reference) -> bool:
    on_device = ("inverse_depth", "weight", "slope_x", "roughness")
    arrays = [(getattr(a, n).numpy(), getattr(b, n).numpy()) for n in on_device]
    arrays += [(p.intensity.numpy(), q.intensity.numpy()) for p, q in zip(a.points, b.points, strict=True)]
    arrays.append((a.intensity, b.intensity))
    return all(np.array_equal(x, y, equal_nan=True) for x, y in arrays) and a.median_depth == b.median_depth


def test_what_does_not_fit_goes_to_files_and_comes_back_the_same(
    made: tuple[KeyframeMaker, list[Reference]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    maker, refs = made
    all_of_them, few = Archive(maker), Archive(maker, most_bytes=2.5 * ONE)
    for archive in (all_of_them, few):
        for ref in refs:
            archive.add(ref)
    assert (all_of_them.images.spilled, few.images.spilled) == (0, 2) and len(few) == 4
    files = sorted(tmp_path.glob("*/*.npz"))
    assert [file.name for file in files] == ["keyframe-00000000-00000001.npz", "keyframe-00000001-00000002.npz"]
    for ref in refs:
        assert same(few.get(ref.index), all_of_them.get(ref.index))
    # Used again and put back: its file is old, and it is the newest.
    few.add(replace(few.get(0), stamp=9.0))
    assert few.get(0).stamp == 9.0 and few.images.spilled == 2 and not files[0].exists()
    del few, archive
    assert not list(tmp_path.iterdir())


def test_a_file_that_is_gone_and_a_full_disk_are_said(
    made: tuple[KeyframeMaker, list[Reference]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    maker, refs = made
    archive = Archive(maker, most_bytes=1.0)
    archive.add(refs[0])
    next(tmp_path.glob("*/*.npz")).unlink()
    with pytest.raises(UserError, match="cannot be read again"):
        archive.get(0)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "nowhere"))
    with pytest.raises(UserError, match="set TMPDIR"):
        Archive(maker, most_bytes=1.0).add(refs[1])


def test_a_tracker_with_hardly_any_memory_finds_the_same() -> None:
    def frames() -> list[Frame]:
        depths = [synthetic.render_depth(TRUTH, CAMERA, SHUTTER, k / 30.0) for k in range(14)]
        depths[9] = np.zeros_like(depths[9])
        return [Frame(Image(k / 30.0, depth), ()) for k, depth in enumerate(depths)]

    found = []
    for memory_gb in (2.0, 1e-6):
        options = Options(method="rs-g", keyframe_distance=0.01, bootstrap_frames=3, memory_gb=memory_gb)
        tracker = Tracker(RIG, options)
        for frame in frames():
            tracker.feed(frame)
        found.append(tracker)
    stored = [tracker.track.keyframes.archive for tracker in found]
    assert found[0].keyframes > 2 and stored[1].images.spilled > 0 == stored[0].images.spilled
    for a, b in zip(found[0].trajectory, found[1].trajectory, strict=True):
        np.testing.assert_array_equal(a, b)


def plain_correlation(a: np.ndarray, b: np.ndarray) -> float:
    both = (a != 0) & (b != 0)
    if both.sum() < 0.25 * both.size or not np.ptp(a[both]) or not np.ptp(b[both]):
        return 0.0
    return float(np.corrcoef(a[both], b[both])[0, 1])


def test_views_resemble_each_other_as_their_thumbnails_correlate() -> None:
    rng = np.random.default_rng(3)

    def thumbnail(known: float, base: np.ndarray | None = None) -> np.ndarray:
        image = 0.3 + 0.1 * rng.standard_normal((15, 20)) + (0.0 if base is None else base)
        return np.where(rng.random((15, 20)) < known, image, 0.0).astype(np.float32)

    seen = 0.2 * rng.standard_normal((15, 20))
    depth, color = thumbnail(0.8, seen), thumbnail(1.0, seen)
    refs = [
        (thumbnail(0.9, seen), thumbnail(1.0, seen)),
        (thumbnail(0.9, -seen), thumbnail(1.0)),
        (thumbnail(0.7, seen), None),
        (thumbnail(0.2, seen), thumbnail(1.0, seen)),  # hardly anything known
        (np.full((15, 20), 0.5, np.float32), thumbnail(0.5)),  # a wall
        (np.zeros((15, 20), np.float32), thumbnail(1.0, seen)),  # no depth
    ]
    keyframes: list[Any] = [SimpleNamespace(depth_thumbnail=d, color_thumbnail=c) for d, c in refs]
    frame: Any = SimpleNamespace(
        depth=SimpleNamespace(thumbnail=depth), colors=[SimpleNamespace(thumbnail=color)]
    )  # fmt: skip
    found = resemblances(keyframes, frame)
    for n, (d, c) in enumerate(refs):
        expected = [plain_correlation(d, depth)] + ([] if c is None else [plain_correlation(c, color)])
        assert found[n] == pytest.approx(np.mean(expected), abs=1e-9)
    assert found[0] > 0.6 > 0.1 > found[1] and found[5] == pytest.approx(0.5 * plain_correlation(refs[5][1], color))
    frame.colors = []
    assert resemblances(keyframes, frame)[5] == 0.0 and resemblances([], frame).shape == (0,)
