"""One function for all exports: where each goes by default, and what it is called with."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from rsgen.console.progress import Progress
from rsgen.formats.export.bags.bag import Storage
from rsgen.sequence.reader import Sequence, read_sequence

Export = Literal[
    "kalibr", "euroc", "registered", "ros1", "ros2", "mcap", "colmap", "nerfstudio", "ncore", "video", "rerun"
]  # fmt: skip

_BAGS: dict[str, str] = {"ros1": "{}.bag", "ros2": "ros2", "mcap": "{}.mcap"}


def export(
    to: Export, path: Path, out: Path | None, copy: bool, scene: Path | None, storage: Storage, progress: Progress
) -> str:
    """Export the sequence at `path` and say in one line what was written. Raises UserError.

    out: default kalibr/, mav0/, registered/, NAME.bag, ros2/, NAME.mcap, colmap/, nerfstudio/, ncore/, shutter.mp4 or
    NAME.rrd within the sequence's folder. copy: images, rather than linking them. scene: for the video, which renders
    again. storage: of a ROS 2 bag.
    """
    sequence = read_sequence(path)
    if to == "kalibr":
        from rsgen.formats.export.folders.kalibr import export_kalibr

        return export_kalibr(sequence, out or path / "kalibr", copy, progress)
    if to == "euroc":
        from rsgen.formats.export.folders.euroc import export_euroc

        return export_euroc(sequence, out or path, copy, progress=progress)
    if to == "registered":
        from rsgen.formats.export.folders.registered import export_registered

        return export_registered(sequence, out or path / "registered", copy, progress)
    if to == "ros1" or to == "ros2" or to == "mcap":
        from rsgen.formats.export.bags.ros import export_ros

        return export_ros(sequence, out or path / _BAGS[to].format(sequence.name), to, storage, progress)
    if to == "colmap":
        from rsgen.formats.export.reconstruction.colmap import export_colmap

        return export_colmap(sequence, out or path / "colmap", copy, progress)
    if to == "nerfstudio":
        from rsgen.formats.export.reconstruction.nerfstudio import export_nerfstudio

        return export_nerfstudio(sequence, out or path / "nerfstudio", copy, progress)
    if to == "ncore":
        from rsgen.formats.export.reconstruction.ncore import export_ncore

        return export_ncore(sequence, out or path / "ncore", progress)
    if to == "rerun":
        from rsgen.formats.export.viewing.rerun import export_rerun

        return export_rerun(sequence.as_taken, out or path / f"{sequence.name}.rrd", progress)
    return _export_video(sequence.as_taken, out or path / "shutter.mp4", scene, progress)


def _export_video(sequence: Sequence, out: Path, scene: Path | None, progress: Progress) -> str:
    from rsgen.formats.export.viewing.video import write_video
    from rsgen.pictures.frames import config_of
    from rsgen.produce.frame_source import FrameSource, setting_of

    stream = sequence.streams["color"]
    config = config_of(sequence.root, sequence.meta, scene)
    source = FrameSource(config, progress, global_shutter=True, objects=[thing.spline for thing in sequence.objects])
    # All lines at the middle line's time.
    middle = 0.5 * (stream.line_count - 1) * stream.shutter.line_delay(stream.camera)
    frames = range(len(stream.paths))
    left = (
        source.color(sequence.spline, stamp + middle, int(k), setting_of(config, stream.table, i))
        for i, (stamp, k) in enumerate(zip(stream.stamps, stream.indices, strict=True))
    )
    right = (sequence.color(k) for k in frames)
    return write_video(out, left, right, stream.rate_hz, count=len(frames), progress=progress)
