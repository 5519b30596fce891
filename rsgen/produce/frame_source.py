"""Frames of all cameras on demand, and a sequence's frames rendered in order into its folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from rsgen.config.cameras import ColorConfig
from rsgen.config.config import Config
from rsgen.console.progress import Progress
from rsgen.produce.camera_sources import ColorShot, ColorSource, DepthShot, DepthSource, Stage
from rsgen.produce.writer import SequenceWriter

# Written frames that may wait for the disk: bounds memory and how much a kill can lose.
_WRITE_AHEAD = 4


class FrameSource:
    """Cameras by name, of which frames are rendered on demand; `rsgen.produce.parts.open_frames` makes one."""

    def __init__(self, stage: Stage, config: Config) -> None:
        """config: of the cameras; its scene is the stage's already."""
        self._of_view, self.colors = config.view, dict[str, ColorSource]()
        cameras: Mapping[str, object] = config.cameras
        for name, stream in cameras.items():
            if isinstance(stream, ColorConfig):
                self.colors[name] = ColorSource(stage, name, stream, config.T_cam_body(name), config.truth)
        into = (config.color.camera, np.asarray(config.T_color_depth, float)) if config.depth.registered else None
        self.depths = {
            name: DepthSource(stage, name, stream, config.T_cam_body(name), self.colors, into)
            for name, stream in config.cameras.items()
            if not isinstance(stream, ColorConfig)
        }

    @property
    def color(self) -> ColorSource:
        """The colour camera: of a rig the first one."""
        return self.colors[self._of_view]

    @property
    def depth(self) -> DepthSource:
        """The depth camera: of a rig the first one."""
        return next(iter(self.depths.values()))


def render_shots(
    writer: SequenceWriter, source: FrameSource, shots: Sequence[tuple[int, str]], progress: Progress
) -> None:
    """Render images (frame, stream) in order and write them; noise and encoding go on beside. Raises UserError."""
    # However this ends, leaving the pool waits for what has been rendered to be written.
    with ThreadPoolExecutor(max_workers=2) as pool:
        pending: list[Future[None]] = []
        for done, (k, stream) in enumerate(shots, 1):
            shown = writer.shows(stream, k)
            stamp = float(writer.stamps(stream)[shown])
            if stream in source.colors:
                after = writer.next_shown(stream, k)
                next_stamp = None if after is None else float(writer.stamps(stream)[after])
                settings = (None if frame is None else writer.setting(stream, frame) for frame in (shown, after))
                shot = source.colors[stream].expose(writer.spline, stamp, shown, next_stamp, *settings)
                pending.append(pool.submit(_write_color, writer, source.colors[stream], stream, k, shot))
            else:
                measured = source.depths[stream].expose(writer.spline, stamp, shown)
                pending.append(pool.submit(_write_depth, writer, source.depths[stream], stream, k, measured))
            while len(pending) > _WRITE_AHEAD:
                pending.pop(0).result()
            progress("frames", done / len(shots), f"frame {k}")
        for write in pending:
            write.result()


def _write_color(writer: SequenceWriter, source: ColorSource, stream: str, k: int, shot: ColorShot) -> None:
    writer.write_color(k, *source.develop(shot), stream=stream)


def _write_depth(writer: SequenceWriter, source: DepthSource, stream: str, k: int, shot: DepthShot) -> None:
    writer.write_depth(k, shot.z, source.develop(shot), shot.ids, stream=stream, labels=shot.labels)
