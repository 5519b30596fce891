"""Small images find the place of a frame that was turned and carried away, whatever its exposure and lens."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import synthetic

from rsgen.array_types import FloatArray
from rsgen.device.arrays import engine
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.spline import Spline
from rstrack.data.rig import Frame, Image, Rig
from rstrack.images.device_frame import DeviceFrame, DeviceRig
from rstrack.keyframes.coarse_search import ranked, search, small_frame, small_keyframe
from rstrack.keyframes.maker import KeyframeMaker
from rstrack.options import Options

CAMERA = Camera(160, 120, 120.0, 120.0, 79.5, 59.5)
LENS = Camera(160, 120, 120.0, 118.0, 81.0, 58.0, model="radtan", distortion=(0.12, -0.2, 0.002, -0.001))
engine("auto")


class Place:
    """A frame taken at T_world_depth, and as a keyframe."""

    def __init__(self, T_world_depth: FloatArray, camera: Camera = CAMERA, gain: float = 1.0) -> None:
        self.rig = Rig(camera, Shutter(), camera, Shutter(), synthetic.T_COLOR_DEPTH)
        spline = Spline(np.repeat(T_world_depth[None], 4, axis=0), 0.0, 1.0)
        z = synthetic.render_depth(spline, camera, Shutter(), 0.0)
        rgb = synthetic.render_color(spline, camera, Shutter(), 0.0, synthetic.T_COLOR_DEPTH)
        device = DeviceRig(self.rig, Options(fuse=True))
        rgb = np.clip(gain * rgb, 0, 255).astype(np.uint8)
        self.frame: DeviceFrame = device.upload(0, Frame(Image(0.0, z), (Image(0.0, rgb),)))
        self.ref = KeyframeMaker.of(device).rectified(0, self.frame.depth, self.frame.colors, spline, None)

    @property
    def small(self) -> Any:
        return small_frame(self.frame, self.rig, True)


HOME = Place(np.eye(4))


def apart(T: FloatArray, T_true: FloatArray) -> tuple[float, float]:
    """Metres and degrees."""
    off = se3.log(se3.inverse(T_true) @ T)
    return float(np.linalg.norm(off[:3])), float(np.degrees(np.linalg.norm(off[3:])))


@pytest.mark.parametrize(
    ("xi_deg", "camera", "gain"),
    [
        ((0.05, 0.0, 0.02, 2.0, -3.0, 1.0), CAMERA, 1.0),
        ((0.15, -0.1, 0.1, 3.0, 22.0, -4.0), CAMERA, 1.0),
        ((-0.2, 0.05, 0.0, -14.0, -12.0, 3.0), CAMERA, 0.6),
        ((0.1, 0.1, 0.2, 8.0, 14.0, 5.0), LENS, 0.8),
    ],
)
def test_a_frame_is_found_far_from_where_it_is_looked_for(xi_deg: Any, camera: Camera, gain: float) -> None:
    T = se3.exp(np.array([*xi_deg[:3], *np.radians(xi_deg[3:])]))
    found, score = search(Place(T, camera, gain).small, small_keyframe(HOME.ref), np.eye(4)[None])
    metres, degrees = apart(found, T)
    assert metres < 0.08 and degrees < 2.5 and score > 0.3


def test_the_right_place_ranks_first_and_what_resembles_none_is_left_out() -> None:
    other = Place(se3.exp(np.array([0.2, 0.1, 0.3, 0.0, np.pi, 0.0])))
    T = se3.exp(np.array([0.1, 0.0, 0.1, 0.1, 0.2, 0.0]))
    keyframes = [(small_keyframe(place.ref), np.eye(4)) for place in (other, HOME)]
    order = ranked(Place(T).small, keyframes)
    assert order[0][0] == 1 and apart(order[0][1], T)[0] < 0.08
    black = replace(HOME.small, inverse_depth=None, intensity=None)
    assert ranked(black, keyframes) == []
    # A keyframe without depth, as of a covered camera.
    nothing = replace(keyframes[0][0], points=np.zeros((0, 3)), intensity=np.zeros(0))
    assert search(HOME.small, nothing, np.eye(4)[None])[1] == 0.0


def test_depth_alone_does_within_ten_degrees() -> None:
    T = se3.exp(np.array([0.05, -0.05, 0.1, 0.08, -0.15, 0.03]))
    found, _ = search(replace(Place(T).small, intensity=None), small_keyframe(HOME.ref), np.eye(4)[None])
    metres, degrees = apart(found, T)
    assert metres < 0.1 and degrees < 3.0
