"""What a bag may take of memory and disk, whatever it claims: bounds on what `rosbags` unpacks and what SQLite makes.

The library has no settings for that. Its readers look up in tables and modules how to unpack: those are told here.
"""

from __future__ import annotations

import bz2
import types
from functools import cache
from pathlib import Path
from typing import Any

from rsgen.files import read_yaml
from rsgen.inputs import check_input

METADATA = "metadata.yaml"
# A chunk or a message of a bag that is larger than this once unpacked is refused: recorders write chunks of a few MB.
_MOST_CHUNK_BYTES = 1 << 27
# A packed file in a bag's folder may unpack to this many times its size, onto the disk.
_MOST_GROWTH, _LEAST_BYTES = 200, 1 << 26
_ANY_SIZE = 1 << 62


def check_folder(path: Path) -> None:
    """Raises UserError where a folder's metadata.yaml is none, or what lies beside it is a device or a pipe."""
    read_yaml(path / METADATA)
    for file in sorted(path.iterdir()):
        check_input(file, _ANY_SIZE)


def bound_chunks(reader: Any) -> None:
    """Let no chunk of a ROS 1 bag unpack to more than a bound, whatever it claims."""
    from lz4.frame import LZ4FrameDecompressor
    from rosbags.rosbag1.reader import decompressors

    def unbz2(data: bytes) -> bytes:
        return _bounded(bz2.BZ2Decompressor(), data, _MOST_CHUNK_BYTES)

    def unlz4(data: bytes) -> bytes:
        return _bounded(LZ4FrameDecompressor(), data, _MOST_CHUNK_BYTES)

    ours = {decompressors["bz2"]: unbz2, decompressors["lz4"]: unlz4}
    reader.chunks = {
        at: chunk._replace(decompressor=ours.get(chunk.decompressor, chunk.decompressor))
        for at, chunk in reader.chunks.items()
    }


@cache
def bound_unpacking() -> None:
    """Let no chunk of an MCAP unpack to more than it claims, nor that, nor a packed message or file, beyond a bound."""
    from lz4.frame import LZ4FrameDecompressor
    from rosbags.rosbag2 import reader, storage_mcap

    zstd: Any = storage_mcap.zstd

    def unzstd(data: bytes, size: int) -> bytes:
        return _bounded(zstd.ZstdDecompressor(), data, min(size, _MOST_CHUNK_BYTES))

    def unlz4(data: bytes, size: int) -> bytes:
        return _bounded(LZ4FrameDecompressor(), data, min(size, _MOST_CHUNK_BYTES))

    def message(data: bytes) -> bytes:
        return unzstd(data, _MOST_CHUNK_BYTES)

    def opened(file: Any, mode: str) -> Any:
        size = Path(file.name).stat().st_size
        return _Counted(zstd.open(file, mode), max(_MOST_GROWTH * size, _LEAST_BYTES))

    storage_mcap.DECOMPRESSORS |= {"zstd": unzstd, "lz4": unlz4}
    # Of folders whose files or messages are packed.
    vars(reader)["zstd"] = types.SimpleNamespace(decompress=message, open=opened)


def bound_rows(reader: Any) -> None:
    """Let no value of an SQLite database be larger than a bound: a column can be computed, and take no room on disk."""
    import apsw

    storage = reader.storage
    for part in getattr(storage, "storages", [storage]):
        if (connection := getattr(part, "dbconn", None)) is not None:
            connection.limit(apsw.SQLITE_LIMIT_LENGTH, _MOST_CHUNK_BYTES)


class _Counted:
    """A file that is read to its end, of `most` bytes at most."""

    def __init__(self, file: Any, most: int) -> None:
        self._file, self._most, self._left = file, most, most

    def __enter__(self) -> _Counted:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def read(self, size: int) -> bytes:
        data: bytes = self._file.read(size)
        self._left -= len(data)
        if self._left < 0:
            raise ValueError(f"a file unpacks to more than {self._most} bytes")
        return data


def _bounded(decompressor: Any, data: bytes, most: int) -> bytes:
    out: bytes = decompressor.decompress(data, most)
    if not decompressor.eof:
        raise ValueError(f"a chunk is cut short, or unpacks to more than {most} bytes")
    return out
