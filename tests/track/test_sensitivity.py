"""Changed datasets against their definitions and against a renderer, insults by their seeds, and the table."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import synthetic

import rstrack.bench.sensitivity.run
from rsgen.errors import UserError
from rsgen.geometry.shutter import Scan
from rstrack.bench.sensitivity import insults
from rstrack.bench.changes.named import (
    cases,
    color_late,
    darkened,
    depth_in_blocks,
    depth_told_global,
    flashed,
    gained,
    jittered,
    readout_told,
    swinging_gain,
)
from rstrack.bench.changes.edits import reduced, reordered, with_color, with_depth, with_stamps
from rstrack.bench.sensitivity.run import run_sensitivity
from rstrack.cli.main import main
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.options import Options

FRAMES = 30
SPLINE = synthetic.make_spline()


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    config = synthetic.make_config(32, 24, color={"offset_s": 0.004})
    return open_dataset(synthetic.make_sequence(tmp_path_factory.mktemp("s") / "seq", config, FRAMES))


def depths(dataset: Dataset) -> np.ndarray:
    return np.stack([dataset.frame(k, color=False).depth.pixels for k in range(len(dataset))])


def colors(dataset: Dataset) -> np.ndarray:
    return np.stack([dataset.frame(k).colors[0].pixels for k in range(len(dataset))])


def true_positions(dataset: Dataset) -> np.ndarray:
    assert dataset.truth is None and dataset.truth_poses is not None and dataset.sequence is None
    np.testing.assert_allclose(dataset.truth_poses.stamps, dataset.stamps)
    return dataset.truth_poses.positions


def at(stamps: np.ndarray) -> np.ndarray:
    return SPLINE.pose(stamps)[:, :3, 3]


# --- changes ---------------------------------------------------------------------------------------------------------


def test_images_change_and_nothing_else(dataset: Dataset) -> None:
    doubled = with_depth(dataset, lambda k, z: z * (2 + k))
    np.testing.assert_allclose(depths(doubled), depths(dataset) * (2 + np.arange(FRAMES))[:, None, None], rtol=1e-6)
    np.testing.assert_array_equal(colors(doubled), colors(dataset))
    inverted = with_color(doubled, lambda _, pixels: 255 - pixels)
    np.testing.assert_array_equal(colors(inverted), 255 - colors(dataset))
    np.testing.assert_array_equal(depths(inverted), depths(doubled))
    assert inverted.truth is dataset.truth and inverted.stamps is dataset.stamps


def test_other_stamps_leave_the_truth_with_the_images(dataset: Dataset) -> None:
    stamps = dataset.stamps * 1.5 + 7.0
    moved = with_stamps(dataset, stamps, dataset.color_stamps * 1.5 + 7.0)
    np.testing.assert_allclose(true_positions(moved), at(dataset.stamps), atol=1e-9)
    assert moved.frame(3).depth.stamp == stamps[3] and moved.groups == dataset.groups
    with pytest.raises(UserError, match="must increase"):
        with_stamps(dataset, stamps[::-1], stamps)


def test_reordered_frames_bring_their_colours_and_their_truth(dataset: Dataset) -> None:
    shown = [5, 5, 2, 20]
    stamps = np.array([0.0, 0.1, 0.2, 0.3])
    made = reordered(dataset, shown, stamps)
    np.testing.assert_array_equal(depths(made), depths(dataset)[shown])
    np.testing.assert_array_equal(colors(made), colors(dataset)[shown])
    np.testing.assert_allclose([made.frame(k).colors[0].stamp for k in range(4)], stamps + 0.004)
    np.testing.assert_allclose(true_positions(made), at(dataset.stamps[shown]), atol=1e-9)
    swapped = reordered(dataset, shown, stamps, colors=[1, 2, 3, 4])
    np.testing.assert_array_equal(colors(swapped), colors(dataset)[[1, 2, 3, 4]])
    np.testing.assert_array_equal(depths(swapped), depths(dataset)[shown])
    # Twice is once: frames of frames.
    twice = reordered(made, [3, 0], stamps[:2])
    np.testing.assert_array_equal(colors(twice), colors(dataset)[[20, 5]])
    np.testing.assert_allclose(true_positions(twice), at(dataset.stamps[[20, 5]]), atol=1e-9)


@pytest.mark.parametrize("scan", ["top-bottom", "bottom-top", "left-right", "right-left"])
@pytest.mark.parametrize("factor", [2, 4])
def test_reduced_images_are_those_that_the_smaller_cameras_take(scan: Scan, factor: int, tmp_path: Path) -> None:
    # 34 x 27 pixels: what is cut off must not move lines' times.
    stream = {"scan": scan, "exposure_s": 0.004}
    config = synthetic.make_config(34, 35, color=stream, depth=stream)
    original = open_dataset(synthetic.make_sequence(tmp_path / "seq", config, 3))
    small = reduced(original, factor)
    rig = small.rig
    assert (rig.depth_camera.width, rig.depth_camera.height) == (34 // factor, 35 // factor)
    for k in range(3):
        frame = small.frame(k)
        z = synthetic.render_depth(SPLINE, rig.depth_camera, rig.depth_shutter, frame.depth.stamp)
        np.testing.assert_allclose(frame.depth.pixels, z, atol=2e-4)  # stored to 0.2 mm
        shot = frame.colors[0]
        image = synthetic.render_color(SPLINE, rig.color_camera, rig.color_shutter, shot.stamp, rig.T_color_depth)
        difference = np.abs(shot.pixels.astype(float) - image)
        wrong = dataclasses.replace(rig.color_camera, cx=rig.color_camera.cx + 0.5)
        other = synthetic.render_color(SPLINE, wrong, rig.color_shutter, shot.stamp, rig.T_color_depth)
        assert np.median(difference) < 0.5 * np.median(np.abs(shot.pixels.astype(float) - other))
    np.testing.assert_allclose(true_positions(small), at(small.stamps), atol=1e-9)


# --- cases -----------------------------------------------------------------------------------------------------------


def test_what_the_cases_change(dataset: Dataset) -> None:
    np.testing.assert_allclose(color_late(dataset, 0.01).color_stamps, dataset.color_stamps + 0.01)
    assert readout_told(dataset, shift_s=-0.003).rig.depth_shutter.readout_s == pytest.approx(0.025)
    assert readout_told(dataset, factor=0.7).rig.color_shutter.readout_s == pytest.approx(0.0196)
    assert readout_told(depth_told_global(dataset), shift_s=0.005).rig.depth_shutter.readout_s == 0.0
    rig = depth_told_global(dataset).rig
    assert (rig.depth_shutter.readout_s, rig.color_shutter.readout_s) == (0.0, 0.028)
    grey = np.array([[[0, 100, 250]]], np.uint8)
    assert gained(grey, 1.35).tolist() == [[[0, 135, 255]]] and gained(grey, 0.924).tolist() == [[[0, 92, 231]]]
    dark = colors(darkened(dataset)) / np.maximum(colors(dataset), 1)
    assert (dark[:10] == 1).mean() > 0.99 and np.median(dark[10:]) == pytest.approx(0.92, abs=0.01)
    lit = colors(flashed(with_color(dataset, lambda _, p: np.full_like(p, 100))))[:, 0, 0, 0]
    np.testing.assert_array_equal(lit, np.where(np.isin(np.arange(FRAMES), [8, 17, 26]), 200, 100))
    swung = with_color(swinging_gain(with_color(dataset, lambda _, p: np.full_like(p, 100)), 0.35), lambda _, p: p)
    expected = 100 * (1 + 0.35 * np.sin(2 * np.pi * np.arange(FRAMES) / 30.0))
    np.testing.assert_allclose(colors(swung)[:, 0, 0, 0], expected, atol=0.51)


def test_jitter_is_of_its_size_seeded_and_keeps_the_order(dataset: Dataset) -> None:
    many = dataclasses.replace(
        dataset, stamps=np.arange(3000) / 30.0, color_stamps=np.arange(3000) / 30.0, truth=None, sequence=None
    )
    made = jittered(many, 0.002, 1)
    errors = made.stamps - many.stamps, made.color_stamps - many.color_stamps
    for error in errors:
        assert error.std() == pytest.approx(0.002, rel=0.05) and abs(error.mean()) < 2e-4
    assert abs(np.corrcoef(*errors)[0, 1]) < 0.1
    np.testing.assert_array_equal(made.stamps, jittered(many, 0.002, 1).stamps)
    assert (made.stamps != jittered(many, 0.002, 2).stamps).all()
    assert (np.diff(jittered(many, 1.0, 1).stamps) > 0).all()


def test_half_the_depth_is_missing_in_blocks(dataset: Dataset) -> None:
    made, again, other = (depths(depth_in_blocks(dataset, seed)) for seed in (1, 1, 2))
    whole = depths(dataset)
    np.testing.assert_array_equal(made, again)
    assert ((made == 0) | (made == whole)).all() and (made > 0).mean() == pytest.approx(0.5, abs=0.03)
    assert (made != other).any() and ((made[0] > 0) != (made[1] > 0)).any()
    blocks = (made[0] > 0).reshape(12, 2, 16, 2).swapaxes(1, 2).reshape(12, 16, 4)
    assert (blocks.all(axis=2) | ~blocks.any(axis=2)).all()


def test_a_global_shutter_is_not_told_readouts(dataset: Dataset) -> None:
    names = [case.name for case in cases(dataset)]
    assert names[0] == "untouched" and len(set(names)) == len(names) == 22
    still = [case.name for case in cases(readout_told(dataset, factor=0.0))]
    assert [name for name in names if name not in still] == [n for n in names if "readout" in n or "global" in n]


# --- insults ---------------------------------------------------------------------------------------------------------


def test_what_the_insults_do(dataset: Dataset) -> None:
    whole, shots = depths(dataset), colors(dataset)

    taken = insults.kidnapped(dataset, 10, 8)
    assert len(taken) == 22
    np.testing.assert_array_equal(taken.stamps, dataset.stamps[:22])
    np.testing.assert_array_equal(depths(taken)[10:], whole[18:])
    np.testing.assert_allclose(true_positions(taken)[10:], at(dataset.stamps[18:]), atol=1e-9)

    black = insults.blacked_out(dataset, 10, 3)
    assert not depths(black)[10:13].any() and not colors(black)[10:13].any()
    assert depths(black)[[9, 13]].any(axis=(1, 2)).all() and colors(black)[[9, 13]].any(axis=(1, 2, 3)).all()

    hand = insults.covered(dataset, 10, 3)
    assert not depths(hand)[10:13].any() and depths(hand)[[9, 13]].all()
    np.testing.assert_array_equal(colors(hand), shots)

    stuck = insults.frozen(dataset, 10, 3)
    np.testing.assert_array_equal(depths(stuck)[9:14], whole[[9, 9, 9, 9, 13]])
    np.testing.assert_array_equal(colors(stuck)[9:14], shots[[9, 9, 9, 9, 13]])
    np.testing.assert_array_equal(stuck.stamps, dataset.stamps)
    np.testing.assert_allclose(true_positions(stuck)[9:14], at(dataset.stamps[[9, 9, 9, 9, 13]]), atol=1e-9)

    for count, seed in ((2, 0), (2, 1), (2, 2), (10, 3)):
        mixed = insults.shuffled(dataset, 10, count, seed)
        order = [int(np.argmin(np.abs(whole - z).sum(axis=(1, 2)))) for z in depths(mixed)]
        assert order != list(range(FRAMES)) and sorted(order) == list(range(FRAMES))
        assert order[:10] == list(range(10)) and order[10 + count :] == list(range(10 + count, FRAMES))
        np.testing.assert_allclose(true_positions(mixed), at(dataset.stamps[order]), atol=1e-9)

    odd = insults.mismatched(dataset, 10, 3, 12)
    np.testing.assert_array_equal(depths(odd), whole)
    np.testing.assert_array_equal(colors(odd), shots[[*range(10), 22, 23, 24, *range(13, FRAMES)]])

    fast = insults.sped_up(dataset, 10, 3)
    np.testing.assert_array_equal(depths(fast), whole[[*range(10), 10, 14, 18, *range(22, FRAMES)]])
    np.testing.assert_array_equal(fast.stamps, dataset.stamps[:21])

    wall = insults.bare_wall(dataset, 10, 3)
    for k in range(10, 13):
        assert depths(wall)[k, 0, 0] == np.median(whole[k])
        assert len(np.unique(depths(wall)[k])) == 1 and len(np.unique(colors(wall)[k].reshape(-1, 3), axis=0)) == 1
    np.testing.assert_array_equal(depths(wall)[13:], whole[13:])
    for wrong in ((0, 3), (28, 3), (10, 0)):
        with pytest.raises(UserError, match="cannot be insulted"):
            insults.covered(dataset, *wrong)


@pytest.mark.parametrize("kind", insults.KINDS)
def test_random_insults_are_pure_and_leave_both_ends_alone(kind: str, dataset: Dataset) -> None:
    before = colors(dataset), depths(dataset)
    made = [insults.random_insult(dataset, seed, kind) for seed in range(6)]
    assert len({(insult.first, insult.last) for insult in made}) > 1
    for insult, again in zip(made, (insults.random_insult(dataset, seed, kind) for seed in range(6)), strict=True):
        assert (insult.kind, insult.first, insult.last) == (again.kind, again.first, again.last) and kind == again.kind
        # After a jump the first of the frames that stay counts as touched.
        assert 12 <= insult.first < insult.last <= len(insult.dataset) - 12 + (kind == "kidnapped")
        shown, seen = depths(insult.dataset), colors(insult.dataset)
        np.testing.assert_array_equal(shown, depths(again.dataset))
        np.testing.assert_array_equal(shown[:12], before[1][:12])
        np.testing.assert_array_equal(shown[-12:], before[1][-12:])
        same = all(np.array_equal(*pair) for pair in zip((seen, shown), (c[: len(shown)] for c in before), strict=True))
        assert not same or (kind == "sped up" and insult.last - insult.first == 1)
    np.testing.assert_array_equal(depths(dataset), before[1])


def test_kinds_are_drawn_and_short_recordings_refused(dataset: Dataset) -> None:
    drawn = {insults.random_insult(dataset, seed).kind for seed in range(60)}
    assert drawn == set(insults.KINDS)
    with pytest.raises(UserError, match="too few"):
        insults.random_insult(reordered(dataset, range(24), dataset.stamps[:24]), 0)
    with pytest.raises(UserError, match="unknown insult 'rain'"):
        insults.random_insult(dataset, 0, "rain")


# --- the table -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("table")
    writer = synthetic.open_writer(folder / "seq", synthetic.make_config(160, 120), 8, synthetic.make_spline(0.3))
    synthetic.write_frames(writer)
    writer.finish()
    return folder / "seq"


def test_a_table_of_every_case_that_resumes(
    sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    real, tracked = rstrack.bench.sensitivity.run.track, []

    def track(changed: Dataset, *arguments: object, **named: object) -> object:
        tracked.append(changed)
        if len(tracked) == 4:
            raise KeyboardInterrupt
        return real(changed, *arguments, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(rstrack.bench.sensitivity.run, "track", track)
    words = [
        "sensitivity",
        str(sequence),
        *["--method", "rs-g", "--quiet", "--frames", "1:8", "--out"],
        str(tmp_path / "t.md"),
    ]
    assert main(words) == 130 and len(json.loads((tmp_path / "t.json").read_text())["scores"]) == 3
    capfd.readouterr()
    assert main(words) == 0 and len(tracked) == 4 + 19
    out = capfd.readouterr().out.splitlines()
    scores = json.loads((tmp_path / "t.json").read_text())["scores"]
    assert out[0] == "rs-g on synthetic, frames 1 to 7" and out[2].split()[:2] == ["case", "ATE,"]
    assert len(out) == 3 + len(scores) == 25 and scores[0]["case"] == "untouched"
    assert out[3].split()[-2:] == [str(scores[0]["lost"]), "7"] and out[3].split()[2] == "1.00"
    assert f"{1e3 * scores[5]['ate_m']:.3f}" in out[8]
    table = (tmp_path / "t.md").read_text().splitlines()
    assert table[2].count("|") == table[3].count("|") == 8 and len(table) == 4 + len(scores)
    # Other settings begin anew, other files stay.
    monkeypatch.setattr(rstrack.bench.sensitivity.run, "cases", lambda *given: cases(*given)[:3])
    assert len(run_sensitivity(open_dataset(sequence), Options(method="baseline"), slice(0, 4)).scores) == 3
    (tmp_path / "t.json").write_text("{}")
    assert main(words) == 2 and "t.json: is no table" in capfd.readouterr().err


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("words", "part"),
    [("--out t.txt", ".json or .md"), ("--frames 9:12", "its frames are 0 to 7"), ("--seed -1", "seed")],
)
def test_wrong_words_are_one_line(
    words: str, part: str, sequence: Path, place: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(["sensitivity", str(sequence), "--quiet", *words.split()]) == 2
    error = capfd.readouterr().err
    assert part in error and error.count("\n") == 1 and not list(place.iterdir())
