"""Recordings of others' formats, turned into folders that the tracker reads: `rstrack import`.

To add a format, write a module beside these and its line in READERS. The module has

    matches(path) -> bool              whether a file or folder is of this format, by what is in it
    read(path, options) -> Recording   its cameras, and its items as they are asked for (`rstrack.formats.recording`)
    OPTIONS                            optional: names of `ReadOptions` that it heeds

A reader is loaded when a recording is to be read, so that only the command knows it: the tracker's core never does.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

from rsgen.errors import UserError
from rstrack.formats.recording import ReadOptions, Recording

READERS = {
    "a ROS 1 or ROS 2 bag, an MCAP file, what librealsense recorded": "rstrack.formats.bags.ros",
    "an .r3d file of Record3D": "rstrack.formats.record3d",
    "a .sens file of ScanNet": "rstrack.formats.scannet",
    "a folder of Stray Scanner": "rstrack.formats.stray_scanner",
    "a folder of EuRoC's layout": "rstrack.formats.euroc",
}
"""Modules of the readers, by what they read. The first that matches reads."""


def open_recording(path: Path, options: ReadOptions) -> Recording:
    """The recording at a path.

    Raises UserError, one line: nothing there, of no known format, damaged, without depth or colour, or topics are named
    and its format has none.
    """
    known = f"give {', '.join(READERS)}"
    if not path.exists():
        raise UserError(f"{path}: no such file or folder: {known}")
    if path.is_file() and path.stat().st_size == 0:
        raise UserError(f"{path}: is empty")
    if not path.is_dir() and not path.is_file():
        raise UserError(f"{path}: is no file: {known}")
    for name in READERS.values():
        reader: Any = import_module(name)
        if reader.matches(path):
            if options.topics and "topics" not in getattr(reader, "OPTIONS", ()):
                raise UserError(f"{path}: has no topics to be named: they are of bags")
            found: Recording = reader.read(path, options)
            return found
    raise UserError(f"{path}: is of no known format: {known}")
