"""Colour's offset against depth, from sequences whose colour stamps were made wrong by a known time."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import synthetic

from rsgen.console.progress import no_progress
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.sequence.format import StreamName
from rstrack.data.dataset import Dataset, group_colors, open_dataset
from rstrack.data.estimate import read_estimate
from rstrack.data.timing import Timing, stream_timing
from rstrack.options import Options
from rstrack.tracking.first_look import color_clock, looked_at, rough_track, views
from rstrack.tracking.first_look.color_clock import ColorOffset, estimate_color_offset
from rstrack.tracking.first_look.rough_track import GeometricTrack, GeometricTracks
from rstrack.tracking.runs.run import track

WRONG_S = 0.0173
RPY = Path(__file__).resolve().parents[4] / "shared/data/tum_fr1_rpy"
needs_rpy = pytest.mark.skipif(not RPY.is_dir(), reason="../shared/data/tum_fr1_rpy is not here")


@pytest.fixture(autouse=True)
def few_points(monkeypatch: pytest.MonkeyPatch) -> None:
    """A quarter of the points of images as small as these, in a third of the time."""
    monkeypatch.setattr(views, "_ACROSS", 80)
    monkeypatch.setattr(color_clock, "_FEWEST", 100)


def shaking() -> Spline:
    """T_world_depth over [-0.2, 1.3] s: turned to and fro by about 0.15 rad twice a second, in one place."""
    dt, t0 = 0.05, -0.2
    t = t0 + dt * (np.arange(33) - 1.0)
    turns = [0.1 * np.sin(9.0 * t), 0.12 * np.cos(11.0 * t), 0.05 * np.sin(13.0 * t)]
    moves = [0.03 * np.sin(7.0 * t), 0.03 * np.cos(5.0 * t), 0.02 * np.sin(6.0 * t)]
    return Spline(se3.exp(np.stack([*moves, *turns], axis=-1)), t0, dt)


@pytest.fixture(scope="module")
def shaken(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Swift changes of direction; colour of another brightness in every image, some of it clipped."""
    root = tmp_path_factory.mktemp("offset") / "seq"
    config = synthetic.make_config(width=160, height=120)
    writer = synthetic.open_writer(root, config, 30, shaking())
    synthetic.write_frames(writer)
    writer.finish()
    return open_dataset(root)


class Brightness:
    """Images with a gain of their own, clipped."""

    def __init__(self, dataset: Dataset) -> None:
        self._images = dataset.images
        self.depth = dataset.images.depth

    def color(self, k: int) -> np.ndarray:
        return np.clip(self._images.color(k) * (1.0 + 0.2 * np.sin(k)), 0, 255).astype(np.uint8)


def wrongly_stamped(dataset: Dataset, by_s: float) -> Dataset:
    stamps = dataset.color_stamps - by_s
    return replace(
        dataset, color_stamps=stamps, groups=group_colors(dataset.stamps, stamps), images=Brightness(dataset)
    )


def along(path: Spline | None) -> list[GeometricTrack | None]:
    return [None if path is None else GeometricTrack(range(30), path, path.t_begin, path.t_end)]


@pytest.mark.parametrize("wrong_s", [WRONG_S, -0.025, 0.0])
def test_the_offset_is_found_along_the_true_path(shaken: Dataset, wrong_s: float) -> None:
    found = estimate_color_offset(wrongly_stamped(shaken, wrong_s), along(shaken.truth))
    assert not found.reason and found.pairs > 10
    assert found.offset_s == pytest.approx(wrong_s, abs=0.5e-3) and found.sigma_s < 0.5e-3
    assert abs(found.offset_s - wrong_s) < 5.0 * found.sigma_s + 0.1e-3


def test_pixels_of_rising_stamps_are_those_of_each_stamp_alone(shaken: Dataset) -> None:
    truth = shaken.truth
    assert truth is not None
    p_world = views.Views(shaken, truth).points(12)
    stamps = shaken.color_stamps[12] + np.linspace(-0.06, 0.06, 13)
    together = views.pixels_of(shaken, truth, p_world, stamps)
    alone = np.concatenate([views.pixels_of(shaken, truth, p_world, stamp[None]) for stamp in stamps])
    seen = (together[..., 0] > -10.0) & (alone[..., 0] > -10.0)
    assert seen.mean() > 0.5 and (seen == (alone[..., 0] > -10.0)).mean() > 0.999
    # Poses are those of the nearest line, which may be the next one: 0.056 px here.
    off = np.abs(together - alone)[seen]
    assert off.max() < 0.06 and off.mean() < 0.02


def test_a_track_that_colour_contradicts_is_not_believed(shaken: Dataset) -> None:
    truth = shaken.truth
    assert truth is not None
    other = replace(truth, control_points=truth.control_points[::-1].copy())
    found = estimate_color_offset(wrongly_stamped(shaken, WRONG_S), along(other))
    assert "does not fit the track" in found.reason and found.offset_s == 0.0


def test_a_clock_is_looked_for_by_depth_alone_along_a_track_that_is_made_once(
    shaken: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A track that follows colours agrees with whatever clock it takes them to have."""
    asked: list[tuple[range, str]] = []

    def lost(_: Dataset, frames: range, options: Options, done: Callable[[float], None]) -> object:
        asked.append((frames, options.method))
        done(1.0)
        return SimpleNamespace(spline_valid=(), spline=None)

    monkeypatch.setattr(rough_track, "rough_track", lost)
    tracks = GeometricTracks(shaken, range(9), Options(), no_progress)
    assert list(tracks) == list(tracks) == [None] and asked == [(range(9), "rs-g")]


@pytest.mark.nightly
@needs_rpy
def test_the_offset_of_a_kinect(tmp_path: Path) -> None:
    """SOURCE.md: about 22 ms, found by trial with stamps straightened over all of the recording."""
    camera = "color: {width: 640, height: 480, intrinsics: [525, 525, 319.5, 239.5], readout_s: 0.03}"
    (tmp_path / "camera.yaml").write_text(camera)
    dataset = open_dataset(RPY, tmp_path / "camera.yaml")
    found = estimate_color_offset(dataset, GeometricTracks(dataset, range(60, 120), Options(), no_progress))
    assert not found.reason and 0.015 < found.offset_s < 0.026 and found.sigma_s < 3e-3


def test_what_the_motion_does_not_tell_is_left_open(shaken: Dataset) -> None:
    truth = shaken.truth
    assert truth is not None
    still = replace(truth, control_points=np.broadcast_to(np.eye(4), truth.control_points.shape).copy())
    found = estimate_color_offset(replace(shaken, images=_Same(shaken)), along(still))
    assert found.reason and found.offset_s == 0.0 and "used as stamped" in found.text()
    found = estimate_color_offset(wrongly_stamped(shaken, 0.09), along(truth))
    assert found.reason and found.offset_s == 0.0
    assert "no track" in estimate_color_offset(shaken, along(None)).reason


def test_where_one_part_does_not_tell_others_are_asked(shaken: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rough_track, "_TRACKED", 8)
    asked: list[range] = []

    def lost(_: Dataset, part: range, *__: object) -> object:
        asked.append(part)
        return SimpleNamespace(spline_valid=(), spline=None)

    monkeypatch.setattr(rough_track, "rough_track", lost)
    tracks = GeometricTracks(shaken, range(len(shaken)), Options(), no_progress)
    found = estimate_color_offset(replace(shaken, images=Brightness(shaken)), (*tracks, *along(shaken.truth)))
    assert not found.reason and abs(found.offset_s) < 1e-3
    assert not set(asked[0]) & set(asked[1]) and {len(part) for part in asked} == {8}
    asked.clear()
    monkeypatch.setattr(rough_track, "_shift", lambda _, part: 0.012 if 20 in part else 1e-4 * part[0])
    tracks = GeometricTracks(shaken, range(len(shaken)), Options(), no_progress)
    assert estimate_color_offset(shaken, tracks).reason, "none of three told"
    assert len(asked) == 3 and 20 in asked[0] and asked[1][0] > asked[2][0]
    assert len(set().union(*asked)) == 24


class _Same:
    """One frame for ever, with the noise of 8 bits."""

    def __init__(self, dataset: Dataset) -> None:
        self._images = dataset.images

    def depth(self, _: int) -> np.ndarray:
        return self._images.depth(0)

    def color(self, k: int) -> np.ndarray:
        noise = np.random.default_rng(k).integers(-2, 3, (120, 160, 3))
        return np.clip(self._images.color(0).astype(int) + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("found", "sigma_s"),
    [
        (ColorOffset(0.017, 2e-3, 20), 2.5e-3),
        (ColorOffset(0.0, np.inf, 0, "the geometry alone gives no track"), 15e-3),
    ],
    ids=["found", "not found"],
)
def test_the_tracker_is_told_how_well_the_clock_is_known(
    shaken: Dataset, monkeypatch: pytest.MonkeyPatch, found: ColorOffset, sigma_s: float
) -> None:
    """Regression: a rendering with a driver's stamps was exact, and 3 σ off where its clock was not found."""
    late_s = 0.001 * np.random.default_rng(0).uniform(0.0, 2.0, (2, len(shaken)))
    depth, color = (stream_timing("any", shaken.stamps + late, "auto", 0.0) for late in late_s)
    unknown = replace(shaken, timing=Timing(depth, color, None))
    assert unknown.rig.sigma.is_exact
    monkeypatch.setattr(color_clock, "estimate_color_offset", lambda *_: found)
    seen = looked_at(unknown, range(30), Options(method="rs-pg"), no_progress)
    assert seen.rig.sigma.offset_s == pytest.approx(sigma_s, rel=1e-3) and seen.rig.sigma.focal == 0.0
    assert looked_at(unknown, range(30), Options(method="rs-g"), no_progress) is unknown


def test_the_part_whose_pairs_differ_least_tells(shaken: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    by_part = iter([ColorOffset(0.0, np.inf, 0, "no"), ColorOffset(0.02, 3e-3, 9), ColorOffset(0.01, 1e-3, 9)])
    monkeypatch.setattr(color_clock, "_estimate", lambda *_: next(by_part))
    assert estimate_color_offset(shaken, 4 * along(shaken.truth)) == ColorOffset(0.01, 1e-3, 9)
    assert next(by_part, None) is None, "the fourth part is not asked"


def test_stamps_of_a_sequence_are_no_guess(shaken: Dataset) -> None:
    assert shaken.timing is None
    later = shaken.with_color_offset(0.1, drift=1e-4)
    expected = shaken.color_stamps + 0.1 + 1e-4 * (shaken.color_stamps - shaken.stamps[len(shaken) // 2])
    np.testing.assert_allclose(later.color_stamps, expected, atol=1e-12)
    assert Path(shaken.root, "sequence.yaml").exists()


def test_a_run_says_and_holds_the_clocks(shaken: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A recording that arrives up to 3 ms late, its colour stamped too early, tracked for a few frames."""
    assert shaken.sequence is not None
    root = tmp_path / "tum"
    root.mkdir()
    rng = np.random.default_rng(1)
    stamps = {}
    streams: tuple[tuple[str, StreamName, float], ...] = (("depth", "depth", 0.0), ("rgb", "color", WRONG_S))
    for name, stream, early in streams:
        shutil.copytree(Path(shaken.root) / name, root / name)
        images = shaken.sequence.streams[stream]
        stamps[name] = images.stamps + rng.uniform(0.0, 3e-3, len(images.paths)) - early
        lines = [f"{t:.6f} {name}/{p.name}" for t, p in zip(stamps[name], images.paths, strict=True)]
        (root / f"{name}.txt").write_text("\n".join(lines) + "\n")
    camera = "{width: 160, height: 120, intrinsics: [120.0, 120.0, 79.5, 59.5], readout_s: 0.028}"
    (root / "camera.yaml").write_text(f"color: {camera}\ndepth: {camera}\n")
    found = ColorOffset(0.0171, 0.001, 12)
    monkeypatch.setattr(color_clock, "estimate_color_offset", lambda *_: found)
    result = track(open_dataset(root), Options(method="rs-pg"), tmp_path / "run", slice(0, 4))
    info = read_estimate(tmp_path / "run").info
    assert info["clocks"]["color_offset_s"] == 0.0171 and info["clocks"]["depth"]["verdict"] == "jittered"
    np.testing.assert_allclose([frame["listed_stamp"] for frame in info["frames"]], stamps["depth"][:4], atol=1e-6)
    assert np.ptp(np.diff([frame["stamp"] for frame in info["frames"]])) < 1e-6
    assert "RMS straightened" in result.text() and "+17.1 ms added" in result.text()
    # Geometry needs no colour: nothing is looked for.
    result = track(open_dataset(root), Options(method="rs-g"), tmp_path / "run", slice(0, 4))
    assert result.timing is not None and result.timing.color_offset_s is None
