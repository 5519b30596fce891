"""Faults by their seeds, and what is counted of them with a tracker that does as it is told."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import synthetic
from changed_frames import colors, depths, true_positions
from scipy.optimize import least_squares

from benchmarks.measures import MEASURES
from benchmarks.measures import faults as measure
from benchmarks.measures import injected as faults
from benchmarks.measures.faults import judged, mean_pose
from benchmarks.measures.injected import InjectedFault, vibrating
from benchmarks.measures.passing import passed_by
from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rsgen.geometry import se3, so3
from rsgen.sequence.trajectory import Trajectory
from rstrack.bench.cells import Benchmark, load_benchmark
from rstrack.bench.changes import reordered, with_depth
from rstrack.bench.runner import run_cells
from rstrack.bench.task import Sources
from rstrack.data.dataset import Dataset, open_dataset
from rstrack.metrics.association import true_poses
from rstrack.options import Options
from rstrack.tracking.runs import segments

FRAMES = 30
SPLINE = synthetic.make_spline(0.3)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("faults") / "seq"
    writer = synthetic.open_writer(folder, synthetic.make_config(64, 48), FRAMES, SPLINE)
    synthetic.write_frames(writer)
    writer.finish()
    return open_dataset(folder)


def at(stamps: np.ndarray) -> np.ndarray:
    return SPLINE.pose(stamps)[:, :3, 3]


# --- kinds -----------------------------------------------------------------------------------------------------------


def test_what_the_faults_do(dataset: Dataset) -> None:
    whole, shots = depths(dataset), colors(dataset)

    taken = faults.kidnapped(dataset, 10, 8)
    assert len(taken) == 22
    np.testing.assert_array_equal(taken.stamps, dataset.stamps[:22])
    np.testing.assert_array_equal(depths(taken)[10:], whole[18:])
    np.testing.assert_allclose(true_positions(taken)[10:], at(dataset.stamps[18:]), atol=1e-9)

    black = faults.blacked_out(dataset, 10, 3)
    assert not depths(black)[10:13].any() and not colors(black)[10:13].any()
    assert depths(black)[[9, 13]].any(axis=(1, 2)).all() and colors(black)[[9, 13]].any(axis=(1, 2, 3)).all()

    hand = faults.covered(dataset, 10, 3)
    assert not depths(hand)[10:13].any() and depths(hand)[[9, 13]].all()
    np.testing.assert_array_equal(colors(hand), shots)

    stuck = faults.frozen(dataset, 10, 3)
    np.testing.assert_array_equal(depths(stuck)[9:14], whole[[9, 9, 9, 9, 13]])
    np.testing.assert_array_equal(colors(stuck)[9:14], shots[[9, 9, 9, 9, 13]])
    np.testing.assert_array_equal(stuck.stamps, dataset.stamps)
    np.testing.assert_allclose(true_positions(stuck)[9:14], at(dataset.stamps[[9, 9, 9, 9, 13]]), atol=1e-9)

    for count, seed in ((2, 0), (2, 1), (2, 2), (10, 3)):
        mixed = faults.shuffled(dataset, 10, count, seed)
        order = [int(np.argmin(np.abs(whole - z).sum(axis=(1, 2)))) for z in depths(mixed)]
        assert order != list(range(FRAMES)) and sorted(order) == list(range(FRAMES))
        assert order[:10] == list(range(10)) and order[10 + count :] == list(range(10 + count, FRAMES))
        np.testing.assert_allclose(true_positions(mixed), at(dataset.stamps[order]), atol=1e-9)

    odd = faults.mismatched(dataset, 10, 3, 12)
    np.testing.assert_array_equal(depths(odd), whole)
    np.testing.assert_array_equal(colors(odd), shots[[*range(10), 22, 23, 24, *range(13, FRAMES)]])

    fast = faults.sped_up(dataset, 10, 3)
    np.testing.assert_array_equal(depths(fast), whole[[*range(10), 10, 14, 18, *range(22, FRAMES)]])
    np.testing.assert_array_equal(fast.stamps, dataset.stamps[:21])

    wall = faults.bare_wall(dataset, 10, 3)
    for k in range(10, 13):
        assert depths(wall)[k, 0, 0] == np.median(whole[k])
        assert len(np.unique(depths(wall)[k])) == 1 and len(np.unique(colors(wall)[k].reshape(-1, 3), axis=0)) == 1
    np.testing.assert_array_equal(depths(wall)[13:], whole[13:])
    for wrong in ((0, 3), (28, 3), (10, 0)):
        with pytest.raises(UserError, match="cannot be touched"):
            faults.covered(dataset, *wrong)


@pytest.mark.parametrize("kind", faults.KINDS)
def test_random_faults_are_pure_and_leave_both_ends_alone(kind: str, dataset: Dataset) -> None:
    before = colors(dataset), depths(dataset)
    made = [faults.random_fault(dataset, seed, kind) for seed in range(6)]
    assert len({(fault.first, fault.last) for fault in made}) > 1
    for fault, again in zip(made, (faults.random_fault(dataset, seed, kind) for seed in range(6)), strict=True):
        assert (fault.kind, fault.first, fault.last) == (again.kind, again.first, again.last) and kind == again.kind
        # After a jump the first of the frames that stay counts as touched.
        assert 12 <= fault.first < fault.last <= len(fault.dataset) - 12 + (kind == "kidnapped")
        shown, seen = depths(fault.dataset), colors(fault.dataset)
        np.testing.assert_array_equal(shown, depths(again.dataset))
        np.testing.assert_array_equal(shown[:12], before[1][:12])
        np.testing.assert_array_equal(shown[-12:], before[1][-12:])
        same = all(np.array_equal(*pair) for pair in zip((seen, shown), (c[: len(shown)] for c in before), strict=True))
        assert not same or (kind == "sped up" and fault.last - fault.first == 1)
    np.testing.assert_array_equal(depths(dataset), before[1])


def test_kinds_are_drawn_and_short_recordings_refused(dataset: Dataset) -> None:
    drawn = {faults.random_fault(dataset, seed).kind for seed in range(60)}
    assert drawn == set(faults.KINDS)
    with pytest.raises(UserError, match="too few"):
        faults.random_fault(reordered(dataset, range(24), dataset.stamps[:24]), 0)
    with pytest.raises(UserError, match="unknown fault 'rain'"):
        faults.random_fault(dataset, 0, "rain")


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
        self.reports.append(SimpleNamespace(stamp=frame.depth.stamp, lost=off is None, keyframe=k in self._keyframes))
        return self.reports[-1]

    @property
    def trajectory(self) -> tuple[FloatArray, FloatArray]:
        poses = list(self._poses.values())
        return np.array([t for t, _ in poses]), np.array([T for _, T in poses])


@pytest.fixture
def outcome(dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> Any:
    def make(off: dict[int, float | None], first: int = 10, last: int = 13, **told: Any) -> SimpleNamespace:
        _, truth = true_poses(SPLINE, dataset.stamps, interpolate=True)
        nothing = dict.fromkeys(range(FRAMES))
        monkeypatch.setattr(measure, "make_tracker", lambda *_, **__: Told(truth, off, **told))
        monkeypatch.setattr(segments, "make_tracker", lambda *_, **__: Told(truth, nothing, **told))
        return SimpleNamespace(**judged(InjectedFault("covered", dataset, first, last), Options()))

    return make


def test_a_tracker_that_does_nothing_wrong(outcome: Any) -> None:
    found = outcome({})
    assert (found.lost, found.silent, found.silent_fault, found.frames) == (0, 0, 0, FRAMES)
    assert (found.place_known, found.found_in_5, found.kind) == (0, None, list(faults.KINDS).index("covered"))
    assert found.worst_mm < 1e-6 and found.worst_deg < 1e-6 and found.moved_mm == found.rewritten_mm == 0.0
    assert found.lost_ms is None and found.tracked_ms > 0.0


def test_frames_that_are_off_without_a_word(outcome: Any) -> None:
    found = outcome({8: 0.0, 11: 0.019, 12: 0.021, 20: 0.03})
    assert (found.silent, found.silent_fault) == (2, 1) and found.worst_mm == pytest.approx(30, abs=1e-6)
    # A pose that was wrong when it was given, and one that is wrong in the end.
    assert outcome({11: 0.03}, moves={12: (11, 0.0)}).silent == 1
    found = outcome({}, moves={12: (11, 0.05)})
    assert found.silent == 1 and found.moved_mm == 0.0  # it had not converged


@pytest.mark.parametrize(("back", "is_found"), [(13, 1), (17, 1), (18, 0)])
def test_lost_and_found_again(back: int, is_found: int, outcome: Any) -> None:
    found = outcome({k: None for k in range(10, back)})
    assert (found.lost, found.silent, found.place_known) == (back - 10, 0, 1)
    assert found.found_in_5 == is_found and found.lost_ms is not None
    # A frame that is given but wrong has not been found.
    wrong = outcome({k: None for k in range(10, back)} | {back: 0.5})
    assert (wrong.found_in_5, wrong.silent) == (int(back < 17), 1)


def test_never_found_and_a_place_that_no_keyframe_has_seen(outcome: Any) -> None:
    lost: dict[int, float | None] = dict.fromkeys(range(10, FRAMES))
    assert (outcome(lost).found_in_5, outcome(lost).place_known) == (0, 1)
    found = outcome(lost, keyframes=(20,))
    assert (found.found_in_5, found.place_known) == (None, 0)


def test_poses_that_move_later(outcome: Any) -> None:
    assert outcome({}, moves={14: (4, 0.01)}).moved_mm == 0.0
    assert outcome({}, moves={15: (4, 0.01)}).moved_mm == pytest.approx(10)
    assert outcome({}, moves={14: (13, 0.01)}).rewritten_mm == 0.0
    assert outcome({}, moves={14: (13, 0.01)}, again=(14,)).rewritten_mm == pytest.approx(10)


def test_a_start_that_fails_is_told(outcome: Any) -> None:
    with pytest.raises(UserError, match="first 10 frames were all lost"):
        outcome(dict.fromkeys(range(10)))


def test_the_mean_of_poses() -> None:
    T = se3.exp(np.array([0.1, 0.2, 0.3, 0.4, -0.5, 0.6]))
    turns = np.array([[0.0, 0.0, 0.0, 0.2, 0.0, 0.0], [0.0, 0.0, 0.0, -0.2, 0.0, 0.0]])
    np.testing.assert_allclose(mean_pose(T @ se3.exp(turns)), T, atol=1e-12)


# --- the measure -----------------------------------------------------------------------------------------------------


def benchmark(folder: Path, method: str, seeds: int) -> Benchmark:
    text = f"""
sequences: {{room: {{path: seq}}}}
cases: {{piece: {{sequence: room, frames: "1:29"}}}}
cells: [{{cases: [piece], methods: [{method}], measure: faults, seeds: {seeds}}}]
"""
    (folder / "bench.yaml").write_text(text)
    return load_benchmark([folder / "bench.yaml"])


def test_each_seed_is_a_fault_of_the_next_kind(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[InjectedFault] = []

    def watched(fault: InjectedFault, options: Options) -> dict[str, float]:
        assert options.method == "rs-g"
        made.append(fault)
        return {"silent": 0, "kind": len(made) - 1}

    monkeypatch.setattr(measure, "judged", watched)
    # Four frames between both ends, as 'sped up' needs.
    sources = Sources(data=dataset.root.parent)
    record = run_cells(benchmark(tmp_path, "rs-g", 10), tmp_path, sources, measures=MEASURES).records[
        "faults/piece/rs-g"
    ]
    assert record.error is None and record.complete and [fault.kind for fault in made] == list(faults.KINDS)
    assert record.values("kind") == list(range(10))
    cut = reordered(dataset, range(1, 29), dataset.stamps[1:29])
    for seed, fault in enumerate(made):
        again = faults.random_fault(cut, seed, fault.kind)
        assert (again.first, again.last) == (fault.first, fault.last)
        np.testing.assert_array_equal(depths(again.dataset), depths(fault.dataset))


def test_faults_are_for_our_methods(dataset: Dataset, tmp_path: Path) -> None:
    cells = run_cells(benchmark(tmp_path, "orb-slam3", 1), tmp_path, Sources(dataset.root.parent), measures=MEASURES)
    assert "methods of ours" in (cells.records["faults/piece/orb-slam3"].error or "")


def test_a_fault_in_the_recording_is_tracked(dataset: Dataset) -> None:
    found = judged(faults.random_fault(dataset, 2, "covered"), Options(method="baseline"))
    assert found["frames"] == FRAMES and found["kind"] == 2 and (found["tracked_ms"] or 0) > 0
