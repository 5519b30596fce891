"""Which reader a file or folder is for, by what is in it."""

from __future__ import annotations

from pathlib import Path

from rsgen.errors import UserError
from rstrack.formats.bags.bag import is_bag
from rstrack.formats.bags.ros import read_bag
from rstrack.formats.bags.topics import Named
from rstrack.formats.euroc import is_euroc, read_euroc
from rstrack.formats.record3d import is_r3d, read_r3d
from rstrack.formats.recording import Recording
from rstrack.formats.scannet import is_sens, read_sens
from rstrack.formats.stray_scanner import is_stray_scanner, read_stray_scanner

_KNOWN = (
    "a ROS 1 or ROS 2 bag, an MCAP file, what librealsense recorded, a .sens or .r3d file, or a folder of Stray "
    "Scanner or of EuRoC's layout"
)


def open_recording(path: Path, named: Named, confidence: int) -> Recording:
    """The recording at a path. named: topics, for bags. confidence: for ARKit's depth.

    Raises UserError, one line: nothing there, of no known format, damaged, or without depth or colour.
    """
    if not path.exists():
        raise UserError(f"{path}: no such file or folder: give {_KNOWN}")
    if path.is_file() and path.stat().st_size == 0:
        raise UserError(f"{path}: is empty")
    if not path.is_dir() and not path.is_file():
        raise UserError(f"{path}: is no file: give {_KNOWN}")
    if is_bag(path):
        return read_bag(path, named)
    if named != Named():
        raise UserError(f"{path}: has no topics to be named: they are of bags")
    if path.is_file():
        if is_r3d(path):
            return read_r3d(path, confidence)
        if is_sens(path):
            return read_sens(path)
    elif is_stray_scanner(path):
        return read_stray_scanner(path, confidence)
    elif is_euroc(path):
        return read_euroc(path)
    raise UserError(f"{path}: is of no known format: give {_KNOWN}")
