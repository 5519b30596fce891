"""References from a model: its depth against the closed form, and a camera that comes back to where it was."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import synthetic
from rstrack_util import ENGINE

from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.spline import Spline
from rstrack.data.rig import Frame, Image, Rig
from rstrack.images.device_frame import DeviceRig
from rstrack.keyframes.keyframe import strides
from rstrack.keyframes.maker import KeyframeMaker
from rstrack.keyframes.store import SurfaceModel
from rstrack.options import Options, Source
from rstrack.tracking.spline_tracker import Tracker

CAMERA, SHUTTER = Camera(160, 120, 120.0, 120.0, 79.5, 59.5), Shutter(readout_s=0.028)
RIG = Rig(CAMERA, SHUTTER, CAMERA, SHUTTER, synthetic.T_COLOR_DEPTH)
FRAMES, RATE_HZ = 32, 20.0


def there_and_back() -> Spline:
    """Half a metre to the side and 25 degrees round, and back, in 1.5 s."""
    dt, t0 = 0.05, -0.2
    t = t0 + dt * (np.arange(43) - 1.0)
    wave = np.sin(np.pi * t / 1.5)
    xi = np.stack([0.5 * wave, 0.1 * wave**2, 0.1 * wave, 0.1 * wave, 0.44 * wave, 0.05 * wave**2], axis=-1)
    return Spline(se3.exp(xi), t0, dt)


TRUTH = there_and_back()


def frame_at(k: int, noise: float = 0.0, rate_hz: float = 30.0) -> Frame:
    stamp = k / rate_hz
    depth = synthetic.render_depth(TRUTH, CAMERA, SHUTTER, stamp)
    depth = depth + noise * depth**2 * np.random.default_rng(k).standard_normal(depth.shape)
    color = synthetic.render_color(TRUTH, CAMERA, SHUTTER, stamp, synthetic.T_COLOR_DEPTH)
    return Frame(Image(stamp, depth), (Image(stamp, color),))


@pytest.fixture(scope="module")
def tracked() -> dict[Source, Tracker]:
    sources: tuple[Source, ...] = ("keyframe", "model")
    trackers = {s: Tracker(RIG, Options(reference=s, keyframe_distance=0.12, voxel_m=0.02)) for s in sources}
    for k in range(FRAMES):
        frame = frame_at(k, rate_hz=RATE_HZ)
        for tracker in trackers.values():
            tracker.feed(frame)
    return trackers


def end_error(tracker: Tracker) -> float:
    """Distance in m between the true and the estimated motion from the third frame to the last."""
    stamps, T = tracker.trajectory
    T_true = TRUTH.pose(stamps)
    off = se3.inverse(se3.inverse(T_true[2]) @ T_true[-1]) @ se3.inverse(T[2]) @ T[-1]
    return float(np.linalg.norm(off[:3, 3]))


def test_on_the_way_back_old_keyframes_are_used_again(tracked: dict[Source, Tracker]) -> None:
    model, keyframe = tracked["model"], tracked["keyframe"]
    assert not any(r.lost for t in tracked.values() for r in t.reports)
    assert 3 <= model.keyframes < keyframe.keyframes
    assert end_error(model) < 1.5e-3 and end_error(keyframe) < 5e-3


def test_model_depth_is_that_of_the_walls_and_less_noisy_than_a_frame() -> None:
    device = DeviceRig(RIG, Options())
    maker = KeyframeMaker.of(device)
    model = SurfaceModel(maker, 0.02)
    frames = [device.upload(k, frame_at(k, 2e-3)) for k in range(10, 30)]
    for frame in frames:
        model.add(frame.depth, TRUTH)
    newest = frames[-1]
    made = model.keyframe(newest.index, newest.depth, newest.colors, TRUTH, None)
    _, _, own = maker.rectify(newest.depth, TRUTH)
    d = CAMERA.unproject(CAMERA.pixel_grid()) @ made.T_world_base[:3, :3].T
    z = synthetic.cast(np.broadcast_to(made.T_world_base[:3, 3], d.shape), d)

    def errors(rho: Any) -> np.ndarray:
        r = ENGINE.download(rho, z.shape)
        return np.abs(1.0 / r[r > 0] - z[r > 0])

    assert (ENGINE.download(made.inverse_depth, z.shape) > 0).mean() > 0.95
    assert np.median(errors(made.inverse_depth)) < 0.5 * np.median(errors(own))
    assert made.t == newest.depth.exposure.mid_time and len(made.points) == len(strides(160, 120))
