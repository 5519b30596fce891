"""The tracker when things go wrong, and with a global shutter: nothing is ever wrong without being said."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import synthetic

from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rstrack.alignment.weights import Independence
from rstrack.data.rig import Frame, Image, Rig
from rstrack.options import Method, Options
from rstrack.tracking import bootstrap, succession
from rstrack.tracking.frame_report import Fault
from rstrack.tracking.spline_tracker import Tracker
from rstrack.tracking.succession import Succession

CAMERA = Camera(160, 120, 120.0, 120.0, 79.5, 59.5)
ROLLING, GLOBAL = Shutter(readout_s=0.028), Shutter()
TRUTH = synthetic.make_spline(0.3)


@cache
def frame_at(k: int, shutter: Shutter = ROLLING) -> Frame:
    stamp = k / 30.0
    depth = synthetic.render_depth(TRUTH, CAMERA, shutter, stamp)
    color = synthetic.render_color(TRUTH, CAMERA, shutter, stamp, synthetic.T_COLOR_DEPTH)
    return Frame(Image(stamp, depth), (Image(stamp, color),))


def blank(frame: Frame) -> Frame:
    return replace(frame, depth=replace(frame.depth, pixels=np.zeros_like(frame.depth.pixels)))


def tracker_of(method: Method, shutter: Shutter = ROLLING, **options: Any) -> Tracker:
    return Tracker(Rig(CAMERA, shutter, CAMERA, shutter, synthetic.T_COLOR_DEPTH), Options(method=method, **options))


def feed(tracker: Tracker, frames: Iterable[Frame]) -> Tracker:
    for frame in frames:
        tracker.feed(frame)
    return tracker


def worst_step(tracker: Tracker) -> float:
    """Largest error in m of the motions since the second frame that was found."""
    stamps, T = tracker.trajectory
    T_true = TRUTH.pose(stamps)
    error = se3.inverse(se3.inverse(T_true[1]) @ T_true[1:]) @ (se3.inverse(T[1]) @ T[1:])
    return float(np.linalg.norm(error[:, :3, 3], axis=1).max())


def lost(tracker: Tracker) -> list[int]:
    return [k for k, report in enumerate(tracker.reports) if report.lost]


def test_blank_frames_are_lost_and_the_track_is_found_again() -> None:
    tracker = tracker_of("rs-g")
    feed(tracker, (blank(frame_at(k)) if k in (12, 13) else frame_at(k) for k in range(22)))
    assert lost(tracker) == [12, 13]
    stamps, _ = tracker.trajectory
    assert len(stamps) == 20 and not np.isin(stamps, [12 / 30, 13 / 30]).any()
    assert len(tracker.spline_valid) == 1  # so short a gap the motion before carries over
    assert worst_step(tracker) < 3e-3


@pytest.mark.parametrize("speed", [0.3, 0.8])
def test_depth_that_is_exposed_at_once_beside_colour_that_rolls(speed: float) -> None:
    # As a D435 has it. With a knot a frame, half-way before each, 0.3 lost a frame and had others 20 mm off unsaid;
    # with the first colours as if at rest, 0.8 was lost after three, and after five when images were held against where
    # the spline led.
    truth = synthetic.make_spline(speed)
    tracker = Tracker(Rig(CAMERA, GLOBAL, CAMERA, ROLLING, synthetic.T_COLOR_DEPTH), Options(method="rs-pg"))
    for k in range(16):
        depth = synthetic.render_depth(truth, CAMERA, GLOBAL, k / 30.0)
        color = synthetic.render_color(truth, CAMERA, ROLLING, k / 30.0, synthetic.T_COLOR_DEPTH)
        tracker.feed(Frame(Image(k / 30.0, depth), (Image(k / 30.0, color),)))
    stamps, T = tracker.trajectory
    T_true = truth.pose(stamps)
    error = se3.inverse(se3.inverse(T_true[0]) @ T_true) @ (se3.inverse(T[0]) @ T)
    assert lost(tracker) == [] and np.linalg.norm(error[:, :3, 3], axis=1).max() < 1e-3
    assert tracker.keyframes > 1  # the first has no colours


def test_colour_carries_on_without_depth() -> None:
    tracker = tracker_of("rs-pg")
    feed(tracker, (blank(frame_at(k)) if k in (12, 13) else frame_at(k) for k in range(18)))
    assert lost(tracker) == [] and worst_step(tracker) < 1e-3


def test_a_gap_is_bridged_from_the_last_keyframes() -> None:
    tracker = feed(tracker_of("rs-pg"), (frame_at(k) for k in (*range(12), *range(24, 30))))
    assert lost(tracker) == [] and len(tracker.spline_valid) == 2 and worst_step(tracker) < 2e-3


@pytest.mark.parametrize("method", ["rs-pg", "gs-g"])
def test_holding_only_the_end_of_the_spline_changes_no_bit(method: Method, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = [blank(frame_at(k)) if k == 13 else frame_at(k) for k in (*range(18), *range(27, 36))]
    kept = feed(tracker_of(method), frames)
    monkeypatch.setattr("rstrack.tracking.window._RELEASED", 1)
    released = feed(tracker_of(method), frames)
    assert kept.track.window is not None and released.track.window is not None
    assert kept.track.window.state.first == 0 < 12 < released.track.window.state.first
    # Poses are evaluated in other batches, which rounds otherwise.
    for a, b in zip(kept.trajectory, released.trajectory, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-15)
    assert kept.spline is not None and released.spline is not None
    np.testing.assert_array_equal(kept.spline.control_points, released.spline.control_points)
    assert kept.spline_valid == released.spline_valid


def shown_at(shown: int, k: int) -> Frame:
    """Frame `shown` under the stamp of frame k."""
    frame, late = frame_at(shown), (k - shown) / 30.0
    colors = tuple(replace(c, stamp=c.stamp + late) for c in frame.colors)
    return replace(frame, depth=replace(frame.depth, stamp=k / 30.0), colors=colors)


def test_a_camera_that_was_carried_away_is_found_at_the_second_look_and_what_was_said_stays() -> None:
    """Frames are missing, time goes on without a gap; after a black one it is back where it was."""
    tracker = tracker_of("rs-pg")
    shown = [*range(12), 28, 29, None, 12, 13, 14]
    at_once = []
    for k, source in enumerate(shown):
        frame = blank(frame_at(k)) if source is None else shown_at(source, k)
        black = tuple(replace(c, pixels=np.zeros_like(c.pixels)) for c in frame.colors)
        tracker.feed(replace(frame, colors=black) if source is None else frame)
        at_once.append(tracker.trajectory[1][-1])
    # Nobody carries it so far in a thirtieth of a second: the next frame has to be found there too.
    assert lost(tracker) == [12, 14]
    found = [(k, source) for k, source in enumerate(shown) if k not in (12, 14)]
    T = tracker.trajectory[1]
    T_true = TRUTH.pose(np.array([source / 30.0 for _, source in found]))
    T_end = np.linalg.inv(T_true[1]) @ T_true
    for i, (k, source) in enumerate(found[9:], 9):
        assert np.linalg.norm((se3.inverse(T[1]) @ T[i])[:3, 3] - T_end[i][:3, 3]) < 4e-3, (k, source)
        if k >= 12:
            assert np.linalg.norm(T[i][:3, 3] - at_once[k][:3, 3]) < 3e-3


def test_colour_may_come_late_but_there_is_no_keyframe_without_it() -> None:
    def frames(first_color: int) -> Iterable[Frame]:
        return (frame_at(k) if k >= first_color else replace(frame_at(k), colors=()) for k in range(14))

    assert lost(feed(tracker_of("rs-pg"), frames(1))) == []
    tracker = feed(tracker_of("rs-pg"), [blank(frame_at(0)), *list(frames(8))[1:]])
    assert lost(tracker) == [0, 1, 2, 3, 4, 5]
    assert [report.fault for report in tracker.reports[:6]] == [Fault.NO_START] * 6


def test_first_frames_count_as_little_as_their_errors_hang_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """Depth that is off by the same over blocks of pixels, by others in each frame, as a structured-light camera's."""

    def error_m() -> float:
        rng, frames = np.random.default_rng(5), []
        for frame in map(frame_at, range(6)):
            off = rng.normal(1.0, 0.01, (6, 8)).repeat(20, axis=0).repeat(20, axis=1)
            depth = (frame.depth.pixels * off).astype(np.float32)
            frames.append(replace(frame, depth=replace(frame.depth, pixels=depth)))
        tracker = feed(tracker_of("rs-pg"), frames)
        assert not lost(tracker)
        return worst_step(tracker)

    counted = error_m()
    monkeypatch.setattr(Independence, "inflation", 1.0)
    assert counted < 0.5 * error_m()


def test_first_frames_that_slide_are_lost_and_the_next_ones_begin_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: a track that began before a bare wall went on from a keyframe that was bent, without a word."""
    tracker, forgotten = tracker_of("rs-g"), []
    monkeypatch.setattr(tracker.track.scales, "reset", lambda: forgotten.append(True))

    monkeypatch.setattr(bootstrap, "disagreement", lambda *_: np.eye(12) * (not forgotten))
    feed(tracker, (frame_at(k) for k in range(14)))
    assert forgotten == [True], "their scales"
    assert [report.fault for report in tracker.reports[:6]] == [*[Fault.NO_START] * 5, Fault.NONE]
    assert lost(tracker) == [0, 1, 2, 3, 4] and tracker.keyframes >= 1 and worst_step(tracker) < 3e-3


def test_a_keyframe_whose_colours_are_another_places_is_left() -> None:
    """A global shutter's first frame is the keyframe at once; its colours fit none that come after it."""
    tracker, odd = tracker_of("gs-pg", GLOBAL), np.random.default_rng(0)
    first = frame_at(0, GLOBAL)
    colors = tuple(replace(c, pixels=odd.integers(0, 256, c.pixels.shape).astype(np.uint8)) for c in first.colors)
    feed(tracker, [replace(first, colors=colors), *(frame_at(k, GLOBAL) for k in range(1, 16))])
    used = [report.inliers_color > 0 for report in tracker.reports]
    assert lost(tracker) == [] and not any(used[1:5]) and all(used[10:])
    assert tracker.keyframes == 2 and worst_step(tracker) < 3e-3


def at_a_wall(k: int, is_odd: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Depth and colour of frame k of a camera that moves along a wall by 1 cm a frame; or noisy and random ones."""
    rng, (v, u) = np.random.default_rng(0), np.mgrid[0 : CAMERA.height, 0 : CAMERA.width]
    x = u + CAMERA.fx * (0.01 * k) / 2.0
    grey = 120.0 + 50.0 * np.sin(x / 7.0) * np.cos(v / 9.0) + 40.0 * np.sin(x / 31.0 + v / 23.0)
    z = np.full(grey.shape, 2.0)
    if is_odd:
        z, grey = z + 0.03 * rng.normal(size=z.shape), rng.uniform(0.0, 255.0, z.shape)
    return z.astype(np.float32), np.repeat(grey[..., None].astype(np.uint8), 3, axis=2)


@pytest.mark.parametrize("elsewhere", [True, False])
def test_just_found_before_a_wall_a_frame_of_other_colours_may_be_anywhere(elsewhere: bool) -> None:
    """Regression: depth has it on the wall, and where along it so short a motion was held to know: 0.5 m off."""
    tracker = Tracker(Rig(CAMERA, GLOBAL, CAMERA, GLOBAL, np.eye(4)), Options(method="gs-pg"))
    for k in range(26):
        is_black, is_odd = 9 <= k < 20, k == 22 and elsewhere
        z, color = at_a_wall(k)[0], at_a_wall(k, is_odd)[1]
        report = tracker.feed(Frame(Image(k / 30, z * (not is_black)), (Image(k / 30, color * (not is_black)),)))
        assert report.lost == (is_black or is_odd), (k, report.fault)
    x = tracker.trajectory[1][:, 0, 3]
    np.testing.assert_allclose(x[-1] - x[0], 0.25, atol=3e-3)


@pytest.mark.parametrize(("was_blank", "nearer"), [(False, 0.0), (True, 0.0), (False, 0.06)])
def test_colours_are_left_out_only_where_all_else_agrees_with_the_motion_before(was_blank: bool, nearer: float) -> None:
    """Regression: a jump along a table top passed by depth alone, 0.75 m off, after two lost frames."""
    tracker = Tracker(Rig(CAMERA, GLOBAL, CAMERA, GLOBAL, np.eye(4)), Options(method="gs-pg"))
    for k in range(14):
        is_blank, is_odd = k == 10 and was_blank, k == 11
        z, color = (at_a_wall(k)[0] - nearer * is_odd) * (not is_blank), at_a_wall(k, is_odd)[1] * (not is_blank)
        report = tracker.feed(Frame(Image(k / 30, z.astype(np.float32)), (Image(k / 30, color),)))
        assert report.lost == (is_blank or (is_odd and (was_blank or nearer > 0.0))), (k, report.fault)


@pytest.mark.parametrize("is_odd", [True, False])
def test_where_an_image_fits_far_worse_than_usual_the_motion_before_does_not_make_a_pose_known(is_odd: bool) -> None:
    """Regression: a pose that no image determined was given, 0.1 m off; as good an image as usual may be led."""
    tracker = Tracker(Rig(CAMERA, GLOBAL, CAMERA, GLOBAL, np.eye(4)), Options(method="gs-pg"))
    for k in range(14):
        z, color = at_a_wall(k, is_odd and k == 11)
        report = tracker.feed(Frame(Image(k / 30, z), () if k == 11 else (Image(k / 30, color),)))
        assert report.lost == (k == 11 and is_odd), (k, report.fault)


@pytest.mark.parametrize(("depth", "color"), [(True, False), (False, True), (True, True)])
def test_a_frame_none_of_whose_images_fits_as_usual_is_lost(depth: bool, color: bool) -> None:
    """Regression: after a jump to another place both fitted four times worse than usual, and it was 0.3 m off."""
    tracker, rng = (
        Tracker(Rig(CAMERA, GLOBAL, CAMERA, GLOBAL, np.eye(4)), Options(method="gs-pg")),
        np.random.default_rng(1),
    )
    for k in range(14):
        z, pixels = at_a_wall(k)
        if k == 11 and depth:
            z = (z + 0.03 * rng.normal(size=z.shape)).astype(np.float32)
        if k == 11 and color:
            pixels = np.clip(pixels + 45.0 * rng.normal(size=z.shape)[..., None], 0, 255).astype(np.uint8)
        report = tracker.feed(Frame(Image(k / 30, z), (Image(k / 30, pixels),)))
        assert report.lost == (k == 11 and depth and color), (k, report.fault)


def test_nothing_but_blank_frames() -> None:
    tracker = feed(tracker_of("rs-pg"), (blank(frame_at(k)) for k in range(3)))
    assert lost(tracker) == [0, 1, 2] and tracker.spline is None and len(tracker.trajectory[0]) == 0


def test_another_room_is_never_taken_for_this_one() -> None:
    tracker = feed(tracker_of("rs-pg"), (frame_at(k) for k in range(10)))
    rng = np.random.default_rng(0)
    for k in range(10, 13):
        z = rng.uniform(0.5, 5.0, (CAMERA.height, CAMERA.width)).astype(np.float32)
        color = rng.integers(0, 256, (CAMERA.height, CAMERA.width, 3)).astype(np.uint8)
        assert tracker.feed(Frame(Image(k / 30, z), (Image(k / 30, color),))).lost


def test_a_global_shutter_is_tracked_alike_by_both_models() -> None:
    tracks = {m: feed(tracker_of(m, GLOBAL), (frame_at(k, GLOBAL) for k in range(16))) for m in ("rs-pg", "gs-pg")}
    assert worst_step(tracks["rs-pg"]) < 0.5e-3
    np.testing.assert_array_equal(tracks["rs-pg"].trajectory[1], tracks["gs-pg"].trajectory[1])


@pytest.mark.parametrize("method", ["rs-g", "rs-pg"])
def test_the_newest_frame_serves_as_a_rolling_reference_until_it_is_rectified(method: Method) -> None:
    tracker = tracker_of(method, keyframe_strategy="newest", keyframe_distance=0.03)
    rolling = []
    for k in range(24):
        tracker.feed(frame_at(k))
        ref = tracker.track.succession.reference
        assert ref is not None
        rolling.append(ref.rolling is not None)
    # After the start: rolling for some frames, then rectified, and so on; a keyframe each time.
    changes = np.flatnonzero(np.diff(np.array(rolling[6:], int)) < 0)
    assert len(changes) >= 2 and tracker.keyframes == 1 + len(changes)
    assert lost(tracker) == [] and worst_step(tracker) < 1e-3


def test_a_keyframe_is_made_part_by_part_while_the_old_one_serves(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(succession, "_PART_PX", 1)
    monkeypatch.setattr(succession, "_LATE", 100.0)
    tracker, begun, serving = tracker_of("rs-pg", keyframe_distance=0.03), [], []
    begin = Succession._begun
    monkeypatch.setattr(Succession, "_begun", lambda self, *made_of: begun.append(made_of) or begin(self, *made_of))
    for k in range(24):
        tracker.feed(frame_at(k))
        if len(begun) == 2:  # the first one is the start's
            serving.append(tracker.reference)
            if tracker.reference != serving[0]:
                break
    frame, spline, older, _ = begun[1]
    assert serving == [older.index] * 5 + [frame.index] and tracker.reports[-1].keyframe and not lost(tracker)
    # What the parts have made is what is made at once; the frames since are fused into it then.
    track = tracker.track
    made, download = track.keyframes.newest, track.device.e.download
    at_once = track.maker.rectified(frame.index, frame.depth, frame.colors, spline, older)
    for name in ("inverse_depth", "weight", "roughness"):
        assert np.array_equal(*(download(getattr(ref, name), (120, 160)) for ref in (made, at_once))), name
    np.testing.assert_array_equal(made.intensity, at_once.intensity)
    waiting = [f.index for f in track.succession.recent]
    assert waiting[0] == frame.index and len(waiting) > 5
    tracker.feed(frame_at(len(tracker.reports)))
    fused, alone = (download(ref.weight, (120, 160)).max() for ref in (track.keyframes.newest, made))
    assert fused >= alone + 3 and len(track.succession.recent) < len(waiting)


@pytest.mark.parametrize(
    ("served", "size", "parts"),
    [(0, (640, 480), 6), (9, (640, 480), 6), (10, (640, 480), 3), (29, (640, 480), 2), (30, (640, 480), 1),
     (30, (320, 240), 2), (30, (160, 120), 8), (300, (1280, 960), 1)],
)  # fmt: skip
def test_the_longer_a_keyframe_has_served_the_more_time_the_next_one_takes(
    served: int, size: tuple[int, int], parts: int
) -> None:
    succeeding = tracker_of("rs-pg").track.succession
    frame: Any = SimpleNamespace(depth=SimpleNamespace(exposure=SimpleNamespace(lens=SimpleNamespace(
        camera=Camera(*size, 1.0, 1.0, 0.0, 0.0)))), index=0, colors=())  # fmt: skip
    assert succeeding._begun(frame, TRUTH, None, served).per_frame == parts


def test_frames_out_of_order_or_of_another_camera() -> None:
    tracker = feed(tracker_of("rs-pg"), (frame_at(k) for k in (0, 1)))
    for stamp in (1 / 30, 0.0, 1e5, np.nan):
        frame = frame_at(2)
        with pytest.raises(UserError, match="in order of time"):
            tracker.feed(replace(frame, depth=replace(frame.depth, stamp=stamp)))
    with pytest.raises(UserError, match=r"depth image .* \(60, 80\)"):
        tracker.feed(Frame(Image(0.1, np.ones((60, 80), np.float32)), ()))
    assert not tracker.feed(frame_at(3)).lost


@pytest.mark.parametrize(
    "wrong",
    [{"method": "best"}, {"knot_spacing_s": 0.0}, {"knot_phase": 2.0}, {"keyframe_overlap": -0.5}, {"max_depth": -1.0},
     {"bootstrap_frames": 2}, {"keyframe_strategy": "best"}, {"keyframe_distance": float("nan")}],
)  # fmt: skip
def test_options_are_checked(wrong: dict[str, object]) -> None:
    with pytest.raises(UserError, match=str(next(iter(wrong))).split("_")[0]):
        Options(**wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("interval", "knots"),
    [(1 / 60, 0.025), (1 / 30, 0.025), (0.0399, 0.025), (1 / 15, 0.05), (0.1, 0.075), (5.0, 0.225)],
)
def test_slow_frames_get_fewer_knots_unless_they_are_given(interval: float, knots: float) -> None:
    assert Options().knots_s(interval) == pytest.approx(knots)
    assert Options(knot_spacing_s=0.03).knots_s(interval) == 0.03
    decided = Options().decided(ROLLING, interval)
    assert decided.knot_spacing_s == pytest.approx(knots) and decided.decided(ROLLING) == decided


@pytest.mark.parametrize(("method", "every", "knots"), [("rs-pg", 3, 0.075), ("rs-g", 2, 0.05)])
def test_frames_come_as_slowly_as_they_like(method: Method, every: int, knots: float) -> None:
    tracker = feed(tracker_of(method), (frame_at(k) for k in range(0, 37, every)))
    assert lost(tracker) == [] and worst_step(tracker) < 2e-3
    assert tracker.spline is not None and tracker.spline.dt == pytest.approx(knots)
