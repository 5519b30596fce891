"""What moves by itself: free space against ray casting, regions against made ones, and a track that does without."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
import pytest
import synthetic
from moving_ball import RIG, SIZE, T_COLOR_DEPTH, picture
from rstrack_util import (
    Plane,
    depth_input,
    exact_reference,
    exposure,
    hand_held,
    plane_before,
    small_camera,
)

from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import project_rolling
from rsgen.geometry.spline import Spline
from rstrack.alignment.free_space import FreeSpace, SeenFrom, grid_of
from rstrack.alignment.spline_state import SplineState
from rstrack.data.moving_masks import Mask
from rstrack.data.rig import Frame, Image, Rig
from rstrack.images import line_poses as lines
from rstrack.images.device_frame import DeviceRig, untimed, without_pixels
from rstrack.options import Options
from rstrack.tracking.moving.leave_out import moving, moving_with
from rstrack.tracking.moving.majority import not_with_most
from rstrack.tracking.track import TrackState

REF_STAMP, STAMP = 0.43, 0.465
SHAPE = 72, 96


# -- free space -------------------------------------------------------------------------------------------------------


@pytest.fixture
def exact_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every line's pose from the spline, not from its block's middle."""
    monkeypatch.setattr(lines, "NODES", 10**6)


@pytest.mark.parametrize("ref_scan", [None, "top-bottom"])
@pytest.mark.usefixtures("exact_poses")
def test_free_space_is_what_rays_say(ref_scan: Literal["top-bottom"] | None) -> None:
    """A plane that has come 0.1 m nearer: how far its points stand before the old one, and the other way round."""
    truth, camera = hand_held(1), small_camera()
    old = plane_before(truth.pose(REF_STAMP), (0.3, -0.2, 1.0))
    new = Plane(old.normal, old.offset - 0.1)
    at, ref_at = exposure(STAMP, "top-bottom", camera), exposure(REF_STAMP, ref_scan, camera)
    ref, depth = exact_reference(old.cast, truth, ref_at), depth_input(new.cast, truth, at)
    shutter = at.lens.shutter
    space = FreeSpace(DeviceRig(Rig(camera, shutter, camera, shutter, np.eye(4)), Options(backend="llvm")))
    intensity = space.intensity(ref, None, np.zeros(2), truth)
    in_frame = space.seen_from(ref, depth, intensity, truth)
    in_ref = space.seen_from(depth, ref, intensity, truth)
    for seen, own, other, plane, sign in ((in_ref, at, ref_at, old, 1), (in_frame, ref_at, at, new, -1)):
        uv = camera.pixel_grid()
        T = truth.pose(own.lens.shutter.line_mid_time(own.stamp, own.lens.shutter.line_of_pixel(uv, camera), camera))
        p = se3.transform(T, camera.unproject(uv) * seen.z[..., None].astype(np.float64))
        _, t, valid = project_rolling(truth, np.eye(4), camera, other.lens.shutter, other.stamp, p)
        T = truth.pose(np.where(valid, t, STAMP))
        origin, z = T[..., :3, 3], se3.transform(se3.inverse(T), p)[..., 2]
        apart = plane.cast(origin, (p - origin) / z[..., None]) - z
        good = valid & np.isfinite(seen.apart)
        assert good.sum() > 1500
        assert np.abs(seen.apart - apart)[good].max() < 3e-4
        assert (sign * seen.apart[good] > 0.05).all()
        # The nearest about there is nearer, by what the plane's slant makes of a pixel and a half.
        assert (seen.free[good] < seen.apart[good]).all() and (seen.free[good] > seen.apart[good] - 0.15).all()
        assert not (np.isfinite(seen.free) & seen.outside).any() and (valid[~seen.outside]).mean() > 0.95
        assert np.isnan(seen.intensity).all()


def test_only_every_stride_th_pixel_is_looked_at() -> None:
    """And the closer look begins with what the first one gave."""
    camera = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)
    truth, at = hand_held(1), exposure(STAMP, "top-bottom", camera)
    plane = plane_before(truth.pose(REF_STAMP), (0.3, -0.2, 1.0))
    ref = exact_reference(plane.cast, truth, exposure(REF_STAMP, None, camera))
    depth = depth_input(Plane(plane.normal, plane.offset - 0.1).cast, truth, at)
    space = FreeSpace(DeviceRig(Rig(camera, at.lens.shutter, camera, at.lens.shutter, np.eye(4)), Options("rs-g")))
    assert grid_of(at.lens)[1] == 2
    intensity = space.intensity(ref, None, np.zeros(2), truth)
    for near, seen, rho in (
        (
            space.before(depth, ref, truth),
            space.seen_from(depth, ref, intensity, truth),
            depth.inverse_z,
        ),
        (
            space.before(ref, depth, truth),
            space.seen_from(ref, depth, intensity, truth),
            ref.inverse_depth,
        ),
    ):
        picked = space.device.e.download(rho, (240, 320))[::2, ::2]
        np.testing.assert_array_equal(near.z, np.float32(1.0) / picked)
        np.testing.assert_array_equal(seen.z, near.z)
        np.testing.assert_array_equal(seen.free, near.free)


# -- regions ----------------------------------------------------------------------------------------------------------


def still(seed: int = 0) -> SeenFrom:
    """A wall 2 m away with 4 mm of noise, seen twice; its right quarter has not been seen before."""
    rng = np.random.default_rng(seed)
    apart = rng.normal(0.0, 4e-3, SHAPE).astype(np.float32)
    outside = np.zeros(SHAPE, bool)
    outside[:, 72:] = True
    apart[outside] = np.nan
    intensity = rng.normal(0.0, 0.01, SHAPE).astype(np.float32)
    return SeenFrom(np.full(SHAPE, 2.0, np.float32), apart.copy(), apart, intensity, outside)


def regions(seen: SeenFrom) -> Mask:
    return moving(seen, 4e-3, 2.0, 0.01)


def test_what_rests_does_not_move() -> None:
    """Noise, edges that lie a line or two elsewhere, flying pixels, what was hidden or not seen, another light."""
    seen = still()
    seen.free[20:22] = seen.free[:, 30:32] = seen.apart[20:22] = 0.5
    flying = np.random.default_rng(1).random(SHAPE) < 0.02
    seen.free[flying] = 1.0
    seen.apart[40:60, 10:30] = seen.free[40:60, 10:30] = -0.4
    seen.intensity[40:, 40:60] = 0.2
    assert not regions(seen).any()


@pytest.mark.parametrize("way", ["depth", "intensity", "hole"])
def test_a_thing_is_found_whole(way: str) -> None:
    """A box 0.5 m before the wall: a third of it has come into free space, the rest is where it was before."""
    seen, box = still(), np.zeros(SHAPE, bool)
    box[20:50, 20:50] = True
    came = box & (np.arange(SHAPE[1]) < 30)
    seen.z[box] = 1.5
    seen.free[came] = seen.apart[came] = 0.5
    rest = box & ~came
    if way == "depth":
        seen.apart[rest] += 0.012
    elif way == "intensity":
        seen.intensity[rest] += np.where(np.indices(SHAPE).sum(axis=0) // 4 % 2, 0.1, -0.1)[rest]
    else:
        seen.free[rest] = seen.apart[rest] = np.nan
    found = regions(seen)
    assert found[box].mean() > 0.95 and (found & ~box).sum() < 0.2 * box.sum()


def test_a_thing_ends_where_another_surface_or_what_rests_begins() -> None:
    """Against the wall, beside where nobody has looked: growth ends after a few pixels, and does not take the wall."""
    seen = still()
    seen.free[30:50, 60:72] = seen.apart[30:50, 60:72] = 0.5
    found = regions(seen)
    assert found[30:50, 60:72].all() and found.sum() < 900
    seen = still()
    seen.free[30:50, 60:72] = seen.apart[30:50, 60:72] = 0.5
    seen.free[:, 40:60] = seen.apart[:, 40:60] = -0.4  # what something hid before
    found = regions(seen)
    assert found[30:50, 60:72].all() and found.sum() < 900


def test_a_thing_ends_at_its_rim_before_a_hole() -> None:
    """The wall behind it, on all sides, of which the other image tells nothing, as something was left out there."""
    seen, box = still(), np.zeros(SHAPE, bool)
    box[20:40, 20:40] = True
    seen.z[box], seen.free[box], seen.apart[box] = 1.5, 0.5, 0.5
    hole = np.zeros(SHAPE, bool)
    hole[10:55, 8:65] = True
    seen.apart[hole & ~box] = seen.free[hole & ~box] = np.nan
    found = regions(seen)
    assert found[box].all() and (found & ~box).sum() < 0.4 * box.sum()


def test_what_another_frame_does_without_is_found_by_its_place() -> None:
    """Hardly moved since: it would not show in free space."""
    seen, box = still(), np.zeros(SHAPE, bool)
    box[20:50, 20:50] = True
    seen.z[box], seen.free[box] = 1.5, 0.0
    before = np.roll(box, 2, axis=1)
    seen.apart[box & ~before] = 0.5
    seen.free[box & ~before] = 0.5
    seen.apart[before & ~box] = -0.5  # the wall behind, where it was before: that rests
    assert not regions(seen)[30:40, 30:40].any()
    found = moving_with(seen, before, 4e-3, 2.0)
    assert found[box].mean() > 0.95 and (found & ~box).sum() < 0.2 * box.sum()


# -- the track --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Recording:
    """A rig's frames, where the ball is in their depth images, and the motion of the camera."""

    rig: Rig
    frames: list[Frame]
    balls: list[Mask]
    truth: Spline


@pytest.fixture(scope="module")
def recording() -> Recording:
    """A third of a second with 2 mm of noise on depth; a fifth of the picture moves."""
    truth, rng = synthetic.make_spline(0.5), np.random.default_rng(3)
    frames, balls = [], []
    for k in range(0, 11, 2):
        z, _, ball = picture(truth, k / 30, np.eye(4))
        _, color, _ = picture(truth, k / 30 + 0.004, T_COLOR_DEPTH)
        z = (z + rng.normal(0.0, 2e-3, z.shape)).astype(np.float32)
        color = np.clip(np.rint(color + rng.normal(0.0, 1.5, color.shape)), 0, 255).astype(np.uint8)
        frames.append(Frame(Image(k / 30, z), (Image(k / 30 + 0.004, color),)))
        balls.append(ball)
    assert 0.1 < np.mean(balls) < 0.3
    return Recording(RIG, frames, balls, truth)


def test_a_ball_that_passes_is_left_out_of_frame_and_keyframe(recording: Recording) -> None:
    track = TrackState(recording.rig, Options(backend="llvm"), untimed)
    e, state = track.device.e, SplineState(recording.truth)
    frames = [track.device.upload(k, frame) for k, frame in enumerate(recording.frames)]
    ref = track.maker.rectified(0, frames[0].depth, frames[0].colors, recording.truth, None)
    for k in (2, 5):
        fresh = track.observe(frames[k], ref)
        for o in fresh:
            o.linearise(track.terms, state, 1)
        (left,) = track.leave_out([frames[k]], ref, fresh, state)
        mask = e.download(left.depth.z, SIZE) == 0.0
        ball = recording.balls[k]
        assert mask[ball].mean() > 0.9 and ball[mask].mean() > 0.8
        assert left.depth.moving == pytest.approx(mask.mean(), abs=1e-6)
        assert left.depth.occluder is frames[k].depth
        depth, color = fresh
        assert depth.image is left.depth and color.occluder is left.depth.hider
        kept = e.download(color.ref.inverse_depth, SIZE) > 0.0
        first = recording.balls[0]
        assert kept[_inner(first)].mean() < (0.3 if k == 2 else 0.1) and kept[~first].mean() > 0.85
        assert color.ref is depth.ref and (e.download(ref.inverse_depth, SIZE) > 0.0)[first].mean() > 0.8
        again = track.observe(replace(frames[k], depth=left.depth), ref)
        assert [o.occluder for o in again] == [None, left.depth.hider]
        for o in fresh:
            o.linearise(track.terms, state, 0)
            assert o.lin.fit > 0.95
        again = track.observe(frames[k], ref)
        for o in again:
            o.linearise(track.terms, state, 0)
        # Where it has been in the keyframe it hides what is behind, which is no misfit.
        assert min(o.lin.fit for o in again) < 0.93
    made = track.maker.rectified(5, left.depth, frames[5].colors, recording.truth, None)
    assert made.intensity is not None and np.isnan(made.intensity[_inner(recording.balls[5])]).all()


def test_a_keyframe_has_an_older_ones_colours_where_something_moves(recording: Recording) -> None:
    track = TrackState(recording.rig, Options(backend="llvm"), untimed)
    e, truth = track.device.e, recording.truth
    frames = [track.device.upload(k, recording.frames[k]) for k in (0, 5)]
    first, last = (without_pixels(e, f.depth, recording.balls[k], 1) for f, k in zip(frames, (0, 5), strict=True))
    older = track.maker.rectified(0, first, frames[0].colors, truth, None)
    made, alone, darker = (
        track.maker.rectified(5, last, frames[1].colors, truth, before, as_now).intensity
        for before, as_now in ((older, (1.0, 0.0)), (None, (1.0, 0.0)), (older, (0.8, 0.05)))
    )
    _, color, _ = picture(truth, 10 / 30 + 0.004, T_COLOR_DEPTH, 1e-6)
    z, _, _ = picture(truth, 10 / 30, np.eye(4), 1e-6)
    empty = Frame(Image(10 / 30, z.astype(np.float32)), (Image(10 / 30 + 0.004, color.astype(np.uint8)),))
    shot = track.device.upload(5, empty)
    room = track.maker.rectified(5, shot.depth, shot.colors, truth, None).intensity
    assert made is not None and alone is not None and darker is not None and room is not None
    behind = _inner(recording.balls[5])
    inherited = behind & np.isfinite(made)
    assert inherited.sum() > 200 and not np.isfinite(alone[behind]).any()
    off = np.abs(made - room)[inherited]
    assert np.nanmedian(off) < 0.01 and np.nanpercentile(off, 90) < 0.04
    # Elsewhere they are its own, looked up by averaged depth.
    assert np.nanpercentile(np.abs(made - alone), 99.0) < 1e-2
    np.testing.assert_allclose(darker[inherited], 0.8 * made[inherited] + 0.05, atol=1e-6)


def test_what_moves_hides_a_little_more_of_colours_than_of_depth(recording: Recording) -> None:
    """By the time of the colour image it has moved: no point is compared with its own edge."""
    track = TrackState(recording.rig, Options(backend="llvm"), untimed)
    e, state = track.device.e, SplineState(recording.truth)
    frames = [track.device.upload(k, frame) for k, frame in enumerate(recording.frames)]
    ref = track.maker.rectified(0, frames[0].depth, frames[0].colors, recording.truth, None)
    fresh = track.observe(frames[2], ref)
    for o in fresh:
        o.linearise(track.terms, state, 1)
    (left,) = track.leave_out([frames[2]], ref, fresh, state)
    exact, wide = (e.download(image.z, SIZE) for image in (left.depth.occluder, left.depth.hider))
    assert (wide <= exact + 1e-6).all()
    nearer = wide < exact - 0.05
    about = cv2.dilate(recording.balls[2].astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    ring = about & (cv2.dilate(recording.balls[2].astype(np.uint8), np.ones((3, 3), np.uint8)) == 0)
    assert nearer[~about].mean() < 0.01 and nearer[ring].mean() > 0.3
    assert frames[2].depth.hider is frames[2].depth  # nothing left out: nothing made wider


def test_what_is_told_not_to_look_does_not(recording: Recording) -> None:
    track = TrackState(recording.rig, Options(backend="llvm", moving=False), untimed)
    frames = [track.device.upload(k, recording.frames[k]) for k in (0, 5)]
    ref = track.maker.rectified(0, frames[0].depth, frames[0].colors, recording.truth, None)
    fresh = track.observe(frames[1], ref)
    for o in fresh:
        o.linearise(track.terms, SplineState(recording.truth), 1)
    (left,) = track.leave_out([frames[1]], ref, fresh, SplineState(recording.truth))
    assert left.depth is frames[1].depth and left.gone is None and left.depth.moving == 0.0
    assert all(o.ref is ref for o in fresh)


def test_a_keyframe_does_without_what_several_frames_see_through(recording: Recording) -> None:
    track = TrackState(recording.rig, Options(backend="llvm"), untimed)
    first = track.device.upload(0, recording.frames[0])
    ref = track.succession.make(first, recording.truth, None)
    gone = np.zeros(SIZE, bool)
    gone[10:30, 20:60] = True
    for _ in range(2):
        track.succession.saw_through(gone)
        assert track.succession.reference is ref
    track.succession.saw_through(None)
    track.succession.saw_through(gone)
    cleaned = track.succession.reference
    assert cleaned is not None and track.keyframes.newest is cleaned
    rho = track.device.e.download(cleaned.inverse_depth, SIZE)
    assert not rho[gone].any() and (rho[~gone] > 0.0).mean() > 0.9
    assert not track.device.e.download(cleaned.points[0].z, SIZE)[gone].any()


def _inner(mask: Mask) -> Mask:
    """Without two pixels at the border."""
    return np.asarray(cv2.erode(mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0)


def test_the_majority_is_what_rests(recording: Recording) -> None:
    """Told by the first frames alone, before anything has been aligned."""
    device = DeviceRig(recording.rig, Options(backend="llvm"))
    frames = [device.upload(k, frame) for k, frame in enumerate(recording.frames[:4])]
    odd = not_with_most(device.e, frames, device.rays)
    assert odd is not None
    ball = recording.balls[0]
    assert odd[ball].mean() > 0.3 and odd[~ball].mean() < 0.15
    assert not_with_most(device.e, frames[:1], device.rays) is None


def test_the_majority_is_told_by_depth_where_there_are_no_colours(recording: Recording) -> None:
    """A smaller ball: the large one and one wall are more than the rest, for who sees no colours."""
    rng, frames = np.random.default_rng(3), []
    for k in range(4):
        z, _, ball = picture(recording.truth, k / 30, np.eye(4), radius=0.2)
        frames.append(Frame(Image(k / 30, (z + rng.normal(0.0, 2e-3, z.shape)).astype(np.float32)), ()))
        if k == 0:
            first = ball
    device = DeviceRig(recording.rig, Options(method="rs-g", backend="llvm"))
    uploaded = [device.upload(k, frame) for k, frame in enumerate(frames)]
    odd = not_with_most(device.e, uploaded, device.rays)
    assert odd is not None
    assert odd[first].mean() > 0.5 and odd[~first].mean() < 0.1
    resting = [replace(frame, depth=uploaded[0].depth) for frame in uploaded]
    assert not np.asarray(not_with_most(device.e, resting, device.rays)).any()
