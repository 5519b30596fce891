"""Files of whatever origin: none that never ends, none beyond a bound, no archive that unpacks to far more than it is.

What a reader does with bytes is its own business; how many there are is not left to the file.
"""

from __future__ import annotations

import io
import stat
import struct
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rsgen.errors import UserError

MOST_BYTES = 1 << 31
"""Of one file that is read whole: hours of an IMU, a mesh of forty million triangles."""

MOST_PIXELS = 1 << 26
"""Of one image: 8192x8192. No camera has more, and a PNG of a few kilobytes may claim thousands of times that."""

PNG_START, EXR_START = b"\x89PNG\r\n\x1a\n", b"\x76\x2f\x31\x01"
# Markers of a JPEG's segments that tell its size: SOF0 to SOF15 but for three that are something else.
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
# Flags of an EXR's second version byte: deep images, and files of several parts. What a channel has after its name.
_EXR_OTHER_KINDS, _EXR_CHANNEL_BYTES = 0x08 | 0x10, 16
# An archive of arrays may unpack to this much more than it is. Ours are stored as they are.
_MOST_GROWTH = 1 << 26


def check_input(path: Path, most: int = MOST_BYTES) -> None:
    """Raises UserError where reading the whole file would not end, or take more than `most` bytes.

    What lies in /dev was named by the user: a pipe of the shell's. A file that is not there is the reader's to report.
    """
    path = Path(path)
    try:
        status = path.stat()
    except (OSError, ValueError):
        return
    if not (stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode)) and path.parts[:2] != ("/", "dev"):
        raise UserError(f"{path}: is a device or a pipe, not a file: copy what it stands for")
    if status.st_size > most:
        raise UserError(f"{path}: has {status.st_size} bytes, more than the {most} that are read: it is damaged")


def read_arrays(path: Path, names: Iterable[str]) -> dict[str, npt.NDArray[Any]]:
    """Arrays of an .npz file by their names.

    Raises UserError as `check_input` does; OSError, ValueError, KeyError, EOFError or zipfile.BadZipFile where the file
    is none, or damaged, or unpacks to far more than it is.
    """
    check_input(path)
    data = Path(path).read_bytes()
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        unpacked = sum(info.file_size for info in archive.infolist())
    if unpacked > len(data) + _MOST_GROWTH:
        raise ValueError(f"{len(data)} bytes that unpack to {unpacked}")
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        try:
            return {name: arrays[name] for name in names}
        except MemoryError:  # of a shape that is claimed, before anything is read
            raise ValueError("an array that claims more than all memory") from None


def image_size(data: bytes) -> tuple[int, int] | None:
    """(width, height) that the header of a PNG, JPEG or EXR tells, undecoded; None where it tells none."""
    if data.startswith(EXR_START):
        try:
            height, width, _ = exr_size(data)
        except (ValueError, LookupError, struct.error):
            return None
        return width, height
    if data.startswith(PNG_START):
        return struct.unpack_from(">II", data, 16) if data[12:16] == b"IHDR" and len(data) >= 24 else None
    at = 2
    while data.startswith(b"\xff\xd8") and at + 9 <= len(data) and data[at] == 0xFF:
        marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        if marker in _JPEG_FRAMES:
            height, width = struct.unpack_from(">HH", data, at + 5)
            return width, height
        at += 1 if marker == 0xFF else 2 + length  # bytes between segments may be filled
    return None


def exr_size(data: bytes) -> tuple[int, int, int]:
    """(height, width, channels) that the header of an EXR tells. Raises ValueError, LookupError, struct.error."""
    if data[5] & _EXR_OTHER_KINDS:
        raise ValueError("it has several parts, or depths of each pixel")
    at, found = 8, {}
    while data[at] != 0:
        name, kind = (data[at : data.index(b"\0", at)], data[data.index(b"\0", at) + 1 :][:64].partition(b"\0")[0])
        at += len(name) + len(kind) + 2
        (length,) = struct.unpack_from("<i", data, at)
        if length < 0 or at + 4 + length >= len(data):
            raise ValueError("its header is cut short")
        found[name], at = data[at + 4 : at + 4 + length], at + 4 + length
    x0, y0, x1, y1 = struct.unpack("<4i", found[b"dataWindow"])
    if x1 < x0 or y1 < y0:
        raise ValueError("its window is none")
    channels, at, count = found[b"channels"], 0, 0
    while channels[at] != 0:
        at, count = channels.index(b"\0", at) + 1 + _EXR_CHANNEL_BYTES, count + 1
    return y1 - y0 + 1, x1 - x0 + 1, count
