"""What is counted of insulted recordings, with a tracker that does as it is told; vibration against a renderer."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import synthetic
from scipy.optimize import least_squares

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rsgen.geometry import se3, so3
from rsgen.sequence.trajectory import Trajectory
from rstrack.bench.sensitivity import insulted, insults
from rstrack.bench.changes.edits import with_depth
from rstrack.bench.sensitivity.insulted import InsultReport, Outcome, judged, mean_pose
from rstrack.bench.sensitivity.insults import Insult
from rstrack.bench.sensitivity.passing import passed_by
from rstrack.bench.sensitivity.vibration import vibrating
from rstrack.cli.main import main
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.metrics.association import true_poses
from rstrack.options import Options

FRAMES = 30
SPLINE = synthetic.make_spline(0.3)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("insulted") / "seq"
    writer = synthetic.open_writer(folder, synthetic.make_config(64, 48), FRAMES, SPLINE)
    synthetic.write_frames(writer)
    writer.finish()
    return open_dataset(folder)


# --- vibration -------------------------------------------------------------------------------------------------------


def test_vibration_shows_what_a_turning_camera_sees(dataset: Dataset) -> None:
    swing, hertz, begin = np.radians([0.5, -0.9, 0.7]), 17.0, float(dataset.stamps[6])

    class Turning:
        """The motion of the camera that vibrates."""

        def pose(self, t: FloatArray) -> FloatArray:
            T = np.broadcast_to(np.eye(4), (*np.shape(t), 4, 4)).copy()
            T[..., :3, :3] = so3.exp(np.sin(2 * np.pi * hertz * (np.asarray(t) - begin))[..., None] * swing)
            return np.asarray(SPLINE.pose(t) @ T)

    motion: Any = Turning()
    made, rig = vibrating(dataset, 6, 3, swing, hertz), dataset.rig
    assert made.truth is None and made.truth_poses is not None
    np.testing.assert_allclose(made.truth_poses.T_world_cam[6:9], motion.pose(dataset.stamps[6:9]), atol=1e-9)
    np.testing.assert_allclose(made.truth_poses.T_world_cam[9:], SPLINE.pose(dataset.stamps[9:]), atol=1e-9)
    inside = (slice(3, -3), slice(3, -3))
    for k in range(6, 9):
        before, frame = dataset.frame(k), made.frame(k)
        z = synthetic.render_depth(motion, rig.depth_camera, rig.depth_shutter, frame.depth.stamp)
        off, still = (np.abs(shown.depth.pixels - z)[inside] for shown in (frame, before))
        assert np.median(off) < 0.1 * np.median(still) and np.percentile(off, 90) < 0.3 * np.percentile(still, 90)
        shot = synthetic.render_color(motion, rig.color_camera, rig.color_shutter, stamp_of(frame), rig.T_color_depth)
        off, still = (np.abs(s.colors[0].pixels.astype(float) - shot)[inside] for s in (frame, before))
        assert np.median(off) < 0.3 * np.median(still)
    for k in (5, 9):
        np.testing.assert_array_equal(made.frame(k).depth.pixels, dataset.frame(k).depth.pixels)
        np.testing.assert_array_equal(made.frame(k).colors[0].pixels, dataset.frame(k).colors[0].pixels)


def stamp_of(frame: Any) -> float:
    return float(frame.colors[0].stamp)


# --- a thing that passes ---------------------------------------------------------------------------------------------


def test_what_passes_is_one_ball_at_one_speed(dataset: Dataset) -> None:
    """Points that it shows, moved to the world by their own lines' true poses, against a ball fitted to them."""
    first, count, rig = 8, 9, dataset.rig
    made = passed_by(dataset, first, count, seed=3)
    camera, shutter = rig.depth_camera, rig.depth_shutter
    lines, places, times, shares = shutter.line_of_pixel(camera.pixel_grid(), camera), [], [], []
    for k in range(len(dataset)):
        z, before = made.depth(k), dataset.depth(k)
        shown = z != before
        assert not shown.any() or first <= k < first + count
        assert (z[shown] < before[shown]).all()  # the nearer of the two
        t = shutter.line_mid_time(made.stamps[k], lines[shown], camera)
        places.append(se3.transform(SPLINE.pose(t), camera.backproject(camera.pixel_grid()[shown], z[shown])))
        times.append(t)
        shares.append(shown.mean())
    assert shares[first] < 0.01 and shares[first + count - 1] < 0.01 and 0.15 < shares[first + count // 2] < 0.25
    p, t = np.concatenate(places), np.concatenate(times) - made.stamps[first + count // 2]

    def off(ball: FloatArray) -> FloatArray:
        return np.asarray(np.linalg.norm(p - ball[:3] - t[:, None] * ball[3:6], axis=1) - ball[6])

    ball = least_squares(off, [*p.mean(axis=0), 0, 0, 0, 0.2]).x
    assert np.abs(off(ball)).max() < 1e-4 and np.linalg.norm(ball[3:6]) > 1.0

    # Colours, from beside and with lines of other times, show the same ball.
    k = first + count // 2
    i = dataset.groups[k][0]
    shown = (made.images.color(i) != dataset.images.color(i)).any(axis=-1)
    camera, shutter = rig.color_camera, rig.color_shutter
    at, d = synthetic.pixel_rays(SPLINE, camera, shutter, dataset.color_stamps[i], rig.T_color_depth)
    t = shutter.line_mid_time(dataset.color_stamps[i], shutter.line_of_pixel(camera.pixel_grid(), camera), camera)
    to_ball = ball[:3] + (t - made.stamps[k])[..., None] * ball[3:6] - at
    along = (to_ball * d).sum(axis=-1, keepdims=True) / (d**2).sum(axis=-1, keepdims=True) * d
    hit = np.linalg.norm(to_ball - along, axis=-1) < ball[6]
    assert hit.mean() > 0.1 and (shown != hit).mean() < 0.004


def test_what_passes_is_hidden_by_what_is_nearer_and_keeps_its_texture(dataset: Dataset) -> None:
    near = with_depth(dataset, lambda _, z: np.where(np.arange(64) < 28, np.float32(0.3), z))
    bare, made = passed_by(near, 8, 9, seed=3), passed_by(dataset, 8, 9, seed=3)
    for k in range(8, 17):
        np.testing.assert_array_equal(bare.depth(k)[:, :28], near.depth(k)[:, :28])
    i = dataset.groups[12][0]
    shown = [(one.images.color(i) != dataset.images.color(i)).any(axis=-1) for one in (bare, made)]
    assert shown[1][:, :22].any() and not shown[0][:, :22].any() and shown[0][:, 32:].any()
    np.testing.assert_array_equal(made.images.color(i), passed_by(dataset, 8, 9, seed=3).images.color(i))
    assert (made.images.color(i) != passed_by(dataset, 8, 9, seed=4).images.color(i)).any()


def test_nothing_passes_where_no_pose_is_known(dataset: Dataset) -> None:
    with pytest.raises(UserError, match="no true poses"):
        passed_by(dataclasses.replace(dataset, truth=None, sequence=None), 8, 9, seed=3)
    assert dataset.truth is not None
    half = Trajectory(dataset.stamps[::2], SPLINE.pose(dataset.stamps[::2]))  # and at 15 Hz they are interpolated
    made = passed_by(dataclasses.replace(dataset, truth=None, truth_poses=half, sequence=None), 8, 9, seed=3)
    z, known = made.depth(12), passed_by(dataset, 8, 9, seed=3).depth(12)
    assert np.median(np.abs(z - known)[z != dataset.depth(12)]) < 2e-3
    one = passed_by(dataset, 8, 1, seed=3)
    assert 0.15 < (one.depth(8) != dataset.depth(8)).mean() < 0.25
    few = Trajectory(dataset.stamps[:10], SPLINE.pose(dataset.stamps[:10]))
    with pytest.raises(UserError, match="needs true poses from"):
        passed_by(dataclasses.replace(dataset, truth=None, truth_poses=few, sequence=None), 8, 9, seed=3)


# --- what is counted -------------------------------------------------------------------------------------------------


class Told:
    """A tracker in a world of its own that errs as it is told.

    off: metres by which a frame is off, None where it is lost. moves: of frames already given, by the frame at which
    they move. again: frames that begin a new piece. keyframes: frames at which one is made.
    """

    T_own_true = se3.exp(np.array([0.3, -1.0, 2.0, 0.5, -0.2, 0.9]))

    def __init__(
        self, truth: FloatArray, off: dict[int, float | None], *, moves: dict[int, tuple[int, float]] | None = None,
        again: tuple[int, ...] = (), keyframes: tuple[int, ...] = (0,),
    ) -> None:  # fmt: skip
        self._truth, self._off, self._moves, self._again = truth, off, moves or {}, again
        self._keyframes = keyframes
        self._poses: dict[int, tuple[float, FloatArray]] = {}
        self.spline_valid: list[tuple[float, float]] = [(0.0, 0.0)]
        self.reports: list[Any] = []

    def feed(self, frame: Any) -> Any:
        k = len(self.reports)
        off = self._off.get(k, 0.0)
        if off is not None:
            T = self.T_own_true @ self._truth[k]
            T[0, 3] += off
            self._poses[k] = frame.depth.stamp, T
        if k in self._moves:
            moved, by = self._moves[k]
            self._poses[moved][1][1, 3] += by
        if k in self._again:
            self.spline_valid.append((0.0, 0.0))
        self.reports.append(SimpleNamespace(lost=off is None, keyframe=k in self._keyframes))
        return self.reports[-1]

    @property
    def trajectory(self) -> tuple[FloatArray, FloatArray]:
        poses = list(self._poses.values())
        return np.array([t for t, _ in poses]), np.array([T for _, T in poses])


@pytest.fixture
def outcome(dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> Any:
    def make(off: dict[int, float | None], first: int = 10, last: int = 13, **told: Any) -> Outcome:
        _, truth = true_poses(SPLINE, dataset.stamps, interpolate=True)
        monkeypatch.setattr(insulted, "make_tracker", lambda *_, **__: Told(truth, off, **told))
        return judged(Insult("covered", dataset, first, last), Options(), seed=4)

    return make


def test_a_tracker_that_does_nothing_wrong(outcome: Any) -> None:
    found = outcome({})
    assert (found.lost, found.silent, found.found_after, found.is_place_known) == (0, (), 0, False)
    assert found.worst_m < 1e-9 and found.worst_deg < 1e-6 and found.moved_m == found.rewritten_m == 0.0
    assert found.lost_ms is None and found.tracked_ms > 0.0 and (found.seed, found.kind) == (4, "covered")


def test_frames_that_are_off_without_a_word(outcome: Any) -> None:
    found = outcome({8: 0.0, 11: 0.019, 12: 0.021, 20: 0.03})
    assert found.silent == (12, 20) and found.worst_m == pytest.approx(0.03, abs=1e-9)
    # A pose that was wrong when it was given, and one that is wrong in the end.
    assert outcome({11: 0.03}, moves={12: (11, 0.0)}).silent == (11,)
    found = outcome({}, moves={12: (11, 0.05)})
    assert found.silent == (11,) and found.moved_m == 0.0  # it had not converged


@pytest.mark.parametrize(("back", "is_found"), [(13, True), (17, True), (18, False)])
def test_lost_and_found_again(back: int, is_found: bool, outcome: Any) -> None:
    found = outcome({k: None for k in range(10, back)})
    assert found.lost == back - 10 and found.silent == () and found.is_place_known
    assert found.found_after == back - 13 and found.is_found == is_found and found.lost_ms is not None
    # A frame that is given but wrong has not been found.
    wrong = outcome({k: None for k in range(10, back)} | {back: 0.5})
    assert wrong.found_after == back - 12 and wrong.silent == (back,)


def test_never_found_and_a_place_that_no_keyframe_has_seen(outcome: Any) -> None:
    lost: dict[int, float | None] = dict.fromkeys(range(10, FRAMES))
    assert outcome(lost).found_after is None and not outcome(lost).is_found and outcome(lost).is_place_known
    assert not outcome(lost, keyframes=(20,)).is_place_known


def test_poses_that_move_later(outcome: Any) -> None:
    assert outcome({}, moves={14: (4, 0.01)}).moved_m == 0.0
    assert outcome({}, moves={15: (4, 0.01)}).moved_m == pytest.approx(0.01)
    assert outcome({}, moves={14: (13, 0.01)}).rewritten_m == 0.0
    assert outcome({}, moves={14: (13, 0.01)}, again=(14,)).rewritten_m == pytest.approx(0.01)


def test_a_start_that_fails_is_told(outcome: Any) -> None:
    with pytest.raises(UserError, match="first 10 frames were all lost"):
        outcome(dict.fromkeys(range(10)))


def test_the_mean_of_poses() -> None:
    T = se3.exp(np.array([0.1, 0.2, 0.3, 0.4, -0.5, 0.6]))
    turns = np.array([[0.0, 0.0, 0.0, 0.2, 0.0, 0.0], [0.0, 0.0, 0.0, -0.2, 0.0, 0.0]])
    np.testing.assert_allclose(mean_pose(T @ se3.exp(turns)), T, atol=1e-12)


def test_one_row_a_kind_and_a_line_a_silent_error() -> None:
    base = Outcome(7, "frozen", 12, 15, 60, 2, (), 0.001, 0.1, True, 3, 0.0, 0.0, 30.0, 20.0)
    late = dataclasses.replace(base, seed=8, found_after=5, silent=(14, 15, 17), worst_m=0.123, worst_deg=4.56)
    other = dataclasses.replace(base, seed=9, kind="kidnapped", lost_ms=None, is_place_known=False)
    settings = {"options": {"method": "rs-pg"}, "dataset": "room", "frames": [0, 60], "seed": 7}
    report = InsultReport(settings, (base, late, other))
    lines = report.text().splitlines()
    assert lines[0] == "rs-pg on room, frames 0 to 59, insults of seeds 7 and on"
    assert [line.split()[0] for line in lines[3:6]] == ["kidnapped", "frozen", "all"]
    assert lines[4].split() == ["frozen", "2", "1", "3", "123.0", "4.56", "4", "2", "1", "0.000", "0.000", "1.50"]
    assert lines[6] == "wrong without a word: seed 8, frozen in frames 12 to 14: 3 frames from 14 to 17, 123 mm and " \
        "4.6 degrees at worst"  # fmt: skip
    assert report.markdown().count("|") == 5 * 13


# --- the command -----------------------------------------------------------------------------------------------------


def test_the_command_tracks_every_kind_once_and_resumes(
    dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[int] = []

    def told(insult: Insult, options: Options, seed: int) -> Outcome:
        made.append(seed)
        return Outcome(
            seed, insult.kind, insult.first, insult.last, 30, 0, (12,), 0.1, 0.0, False, 0, 0.0, 0.0, 1.0, 2.0
        )

    monkeypatch.setattr(insulted, "judged", told)
    out = tmp_path / "t.md"
    words = ["sensitivity", str(dataset.root), "--quiet", "--seed", "5", "--out", str(out), "--insults"]
    assert main([*words, "3"]) == 0 and main([*words, "10"]) == 0
    assert made == list(range(5, 15))
    outcomes = json.loads(out.with_suffix(".json").read_text())["outcomes"]
    assert [o["kind"] for o in outcomes] == list(insults.KINDS) and outcomes[0]["silent"] == [12]
    assert capsys.readouterr().out.splitlines()[-11].split()[:4] == ["all", "10", "10", "10"]
    assert out.read_text().count("\n| ") == 2 + 10 + 1
    assert main([*words, "0"]) == 2 and "at least 1" in capsys.readouterr().err
