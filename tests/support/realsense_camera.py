"""A RealSense that looks into the synthetic box: recorded by librealsense itself, or a stand-in for its playback.

record(tmp_path / "one.db3", frames())      # needs pyrealsense2
stand_in(frames())                          # a module `pyrealsense2`, as far as the live example uses it
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import synthetic

from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter

CAMERA = Camera(160, 120, 120.0, 120.0, 79.5, 59.5)
SHUTTER = Shutter(0.0)  # of both, as a D455 has
UNIT_M, FIRST_S, COUNT = 0.001, 100.0, 8
TRUTH = synthetic.make_spline(0.3)

Pixels = tuple[npt.NDArray[np.uint16], npt.NDArray[np.uint8]]


def stamps() -> npt.NDArray[np.float64]:
    """Of both streams, seconds of the spline."""
    return np.arange(COUNT) / 30.0


def frames() -> list[Pixels]:
    """Depth in millimetres, and colour."""
    found = []
    for t in stamps():
        z = np.rint(synthetic.render_depth(TRUTH, CAMERA, SHUTTER, t) / UNIT_M).astype(np.uint16)
        found.append((z, synthetic.render_color(TRUTH, CAMERA, SHUTTER, t, synthetic.T_COLOR_DEPTH)))
    return found


def record(path: Path, images: Sequence[Pixels]) -> None:
    """A recording as librealsense's recorder writes it, of a software device."""
    import pyrealsense2 as rs

    K = rs.intrinsics()
    K.width, K.height, K.fx, K.fy, K.ppx, K.ppy = CAMERA.width, CAMERA.height, *_pinhole()
    K.model, K.coeffs = rs.distortion.none, [0.0] * 5
    device = rs.software_device()
    streams = []
    for uid, (name, kind, format, size) in enumerate(
        (("Depth", rs.stream.depth, rs.format.z16, 2), ("Color", rs.stream.color, rs.format.rgb8, 3))
    ):
        stream = rs.video_stream()
        stream.type, stream.index, stream.uid, stream.fps, stream.fmt, stream.bpp = kind, 0, uid, 30, format, size
        stream.width, stream.height, stream.intrinsics = CAMERA.width, CAMERA.height, K
        sensor = device.add_sensor(name)
        streams.append((sensor, sensor.add_video_stream(stream), size))
    streams[0][0].add_read_only_option(rs.option.depth_units, UNIT_M)
    extrinsics = rs.extrinsics()
    extrinsics.rotation = synthetic.T_COLOR_DEPTH[:3, :3].T.ravel().tolist()
    extrinsics.translation = synthetic.T_COLOR_DEPTH[:3, 3].tolist()
    streams[0][1].register_extrinsics_to(streams[1][1], extrinsics)

    recorder = rs.recorder(str(path), device)
    queue, sensors = rs.frame_queue(2 * COUNT), recorder.query_sensors()
    for sensor, (_, profile, _) in zip(sensors, streams, strict=True):
        sensor.open(profile)
        sensor.start(queue)
    for k, (t, pair) in enumerate(zip(stamps(), images, strict=True)):
        for (sensor, profile, size), pixels in zip(streams, pair, strict=True):
            frame = rs.software_video_frame()
            frame.pixels, frame.stride, frame.bpp = pixels, size * CAMERA.width, size
            frame.timestamp, frame.domain = 1e3 * (FIRST_S + t), rs.timestamp_domain.hardware_clock
            frame.frame_number, frame.profile = k, profile.as_video_stream_profile()
            sensor.on_video_frame(frame)
        time.sleep(0.02)  # it writes in a thread of its own, and drops what comes too fast
    for sensor in sensors:
        sensor.stop()
        sensor.close()


def stand_in(images: Sequence[Pixels]) -> Any:
    """Answers to the names that the live example uses, with the doubled pairs of librealsense's playback."""
    K = SimpleNamespace(
        width=CAMERA.width, height=CAMERA.height, **dict(zip(("fx", "fy", "ppx", "ppy"), _pinhole(), strict=True)),
        model="none", coeffs=[0.0] * 5,
    )  # fmt: skip
    T = synthetic.T_COLOR_DEPTH
    extrinsics = SimpleNamespace(rotation=T[:3, :3].T.ravel().tolist(), translation=T[:3, 3].tolist())
    stream = SimpleNamespace(get_intrinsics=lambda: K, get_extrinsics_to=lambda _: extrinsics)
    playback = SimpleNamespace(as_playback=lambda: SimpleNamespace(set_real_time=lambda _: None))
    profile = SimpleNamespace(
        get_device=lambda: playback, get_stream=lambda _: SimpleNamespace(as_video_stream_profile=lambda: stream)
    )
    pipeline = SimpleNamespace(start=lambda _: profile, get_active_profile=lambda: profile, stop=lambda: None)
    played = _played(images)
    pipeline.try_wait_for_frames = lambda _: next(played, (False, None))

    class Config:
        def enable_device_from_file(self, file: str, repeat_playback: bool) -> None:
            assert not repeat_playback

    names = {"depth": "depth", "color": "color"}
    return SimpleNamespace(pipeline=lambda: pipeline, config=Config, stream=SimpleNamespace(**names))


def _played(images: Sequence[Pixels]) -> Iterator[tuple[bool, Any]]:
    def one(k: int, which: int) -> Any:
        return SimpleNamespace(
            frame_number=k, get_data=lambda: images[k][which], get_units=lambda: UNIT_M,
            get_timestamp=lambda: 1e3 * (FIRST_S + stamps()[k]),
        )  # fmt: skip

    for k in range(len(images)):
        for color in (k - 1, k) if k else (k,):
            depth = one(k, 0)
            yield True, SimpleNamespace(get_depth_frame=lambda d=depth: d, get_color_frame=lambda c=color: one(c, 1))


def _pinhole() -> tuple[float, float, float, float]:
    return CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy
