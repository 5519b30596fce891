"""Poses from a RealSense while it runs, or from a file that it recorded: prints each frame's pose, one line a frame.

    python docs/examples/live_realsense.py                       # the camera that is plugged in
    python docs/examples/live_realsense.py recorded.db3          # the same loop over a file (.bag of older versions)
    python docs/examples/live_realsense.py --color-readout-s 0.017 --color-offset-s -0.004

Needs librealsense (pip install '.[realsense]'; Debian: also libusb-1.0-0). Readout and offset are
nowhere to be read: record ten seconds, then `rstrack import` and `rstrack calibrate` find them (docs/recordings.md).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from queue import Queue
from threading import Thread
from typing import Any

import numpy as np
import pyrealsense2 as rs

from rsgen import Camera, Shutter
from rstrack import Frame, Image, Options, Rig, Tracker

# Frames that may wait before every second one is skipped: a start takes half a second to two.
QUEUE = 30


def open_pipeline(file: str | None) -> Any:
    """A started pipeline of depth and colour; a file is played once, as fast as it is asked for."""
    pipeline, config = rs.pipeline(), rs.config()
    if file is None:
        config.enable_stream(rs.stream.depth, 640, 480, rs.format.z16, 30)
        config.enable_stream(rs.stream.color, 640, 480, rs.format.rgb8, 30)
    else:
        rs.config.enable_device_from_file(config, file, repeat_playback=False)
    profile = pipeline.start(config)
    if file is not None:
        profile.get_device().as_playback().set_real_time(False)
    return pipeline


def camera_of(stream: Any) -> Camera:
    """librealsense's intrinsics as ours: pixel centres at integers in both."""
    K = stream.get_intrinsics()
    if any(K.coeffs) and K.model not in (rs.distortion.brown_conrady, rs.distortion.inverse_brown_conrady):
        raise SystemExit(f"lens model {K.model} is not that of a D400: see rstrack/formats/recording.py for others")
    lens = ("radtan", tuple(K.coeffs)) if any(K.coeffs) else ()
    return Camera(K.width, K.height, K.fx, K.fy, K.ppx, K.ppy, *lens)


def rig_of(pipeline: Any, color_readout_s: float) -> Rig:
    """Both cameras; depth of a D400 has a global shutter, of some models colour too (readout 0)."""
    profile = pipeline.get_active_profile()
    depth, color = (profile.get_stream(s).as_video_stream_profile() for s in (rs.stream.depth, rs.stream.color))
    found = depth.get_extrinsics_to(color)
    T_color_depth = np.eye(4)
    T_color_depth[:3, :3] = np.reshape(found.rotation, (3, 3)).T  # librealsense stores columns
    T_color_depth[:3, 3] = found.translation
    return Rig(camera_of(depth), Shutter(0.0), camera_of(color), Shutter(color_readout_s), T_color_depth)


def pairs(pipeline: Any) -> Iterator[tuple[Any, Any]]:
    """Each depth frame once, with the last colour frame that came with it, until a second is silent."""
    held = None
    while True:
        is_there, frames = pipeline.try_wait_for_frames(1000)
        depth, color = (frames.get_depth_frame(), frames.get_color_frame()) if is_there else (None, None)
        # Playback gives depth 8 with colour 7, then with colour 8: what comes last belongs to it.
        if held is not None and (not is_there or (depth and depth.frame_number != held[0].frame_number)):
            yield held
            held = None
        if not is_there:
            return
        if depth and color:
            held = depth, color


def grab(pipeline: Any, color_offset_s: float) -> Iterator[Frame]:
    """Frames as the tracker takes them: stamps in s, depth in metres (0 = missing), RGB. Pixels are copied."""
    for depth, color in pairs(pipeline):
        z = np.asarray(depth.get_data(), np.float32) * np.float32(depth.get_units())
        rgb = np.array(color.get_data(), np.uint8)
        stamps = 1e-3 * depth.get_timestamp(), 1e-3 * color.get_timestamp() + color_offset_s
        yield Frame(Image(stamps[0], z), colors=(Image(stamps[1], rgb),))


def meanwhile(frames: Iterator[Frame]) -> Iterator[Frame]:
    """The same frames, taken from the camera by a thread while the tracker works (docs/examples/live_loop.py)."""
    waiting: Queue[Frame | None] = Queue()

    def take() -> None:
        try:
            for frame in frames:
                waiting.put(frame)
        finally:
            waiting.put(None)

    Thread(target=take, daemon=True).start()
    while (frame := waiting.get()) is not None:
        yield frame
        for _ in range(waiting.qsize() // QUEUE):
            waiting.get()


def main(words: list[str] | None = None) -> Tracker:
    """Track until the file ends or Ctrl-C; returns the tracker, whose `spline` is the path at any time."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", nargs="?", help="a recording instead of the camera")
    parser.add_argument("--color-readout-s", type=float, default=0.0, help="first line to one past the last")
    parser.add_argument("--color-offset-s", type=float, default=0.0, help="added to colour's stamps")
    given = parser.parse_args(words)

    pipeline = open_pipeline(given.file)
    tracker = Tracker(rig_of(pipeline, given.color_readout_s), Options(method="rs-pg"))
    try:
        frames = grab(pipeline, given.color_offset_s)
        for frame in frames if given.file else meanwhile(frames):
            report = tracker.feed(frame)
            if report.lost:
                print(f"{frame.depth.stamp:.3f} lost: {report.fault}")
                continue
            stamps, T_world_depth = tracker.trajectory
            x, y, z = T_world_depth[-1, :3, 3]
            print(f"{stamps[-1]:.3f} x {x:+.4f} y {y:+.4f} z {z:+.4f} m")
    except KeyboardInterrupt:
        pass
    finally:
        pipeline.stop()
    return tracker


if __name__ == "__main__":
    main()
