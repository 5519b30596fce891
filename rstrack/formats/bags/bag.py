"""ROS 1 bags, ROS 2 bags (SQLite and MCAP) and single MCAP files: topics, and their messages one by one.

What `rosbags` raises on damaged files is not one kind of error, so whatever it raises becomes one line here. Messages
are read by the standard definitions of ROS, not by those in the file: librealsense's bags have more in an image than
their own definition has, which `Message.rest` keeps. `rosbags` has no settings for what a bag may take of memory and
disk, whatever it claims. Its readers look up in tables and modules how to unpack: the bounds are set there.
"""

from __future__ import annotations

import bz2
import types
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from rsgen.errors import UserError, how_to_install
from rsgen.files import read_yaml
from rsgen.inputs import check_input

_ROS1_START = b"#ROSBAG V"
_MCAP_START = b"\x89MCAP0\r\n"
_SQLITE_START = b"SQLite format 3\0"
# Of old bags: the same bytes under another name.
_ALIASES = {"tf/msg/tfMessage": "tf2_msgs/msg/TFMessage"}


@dataclass(frozen=True)
class Topic:
    """Its type as ROS 2 spells it, and how many messages it has."""

    kind: str
    count: int


@dataclass(frozen=True)
class Message:
    """A message by its standard definition; rest: bytes after it. where: for messages to the user."""

    topic: str
    arrival_ns: int
    content: Any
    rest: bytes
    where: str


class BagReader:
    """An open bag; see `open_bag`."""

    def __init__(self, path: Path, reader: Any, store: Any, is_ros1: bool) -> None:
        self.path, self.is_ros1 = path, is_ros1
        self._reader, self._store = reader, store
        self.topics = {
            name: Topic(str(info.msgtype), int(info.msgcount)) for name, info in sorted(reader.topics.items())
        }

    def of_kind(self, *kinds: str) -> list[str]:
        """Topics that have messages, of types without their package's msg folder, such as sensor_msgs/Image."""
        wanted = {kind.replace("/", "/msg/") for kind in kinds}
        return [name for name, topic in self.topics.items() if topic.kind in wanted and topic.count > 0]

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """The messages of topics in the order in which they were recorded. Raises UserError."""
        connections = [c for c in self._reader.connections if c.topic in topics]
        counts = dict.fromkeys(topics, 0)
        if not connections:
            return
        for connection, arrival_ns, raw in _guarded(self.path, self._reader.messages(connections)):
            topic, number = str(connection.topic), counts[connection.topic]
            counts[connection.topic] += 1
            where = f"{self.path}: message {number} of {topic}"
            content, rest = self._read(where, connection.msgtype, bytes(raw))
            yield Message(topic, int(arrival_ns), content, rest, where)

    def first(self, topic: str) -> Message | None:
        """The first message of a topic. Raises UserError."""
        return next(self.messages([topic]), None)

    def _read(self, where: str, kind: str, raw: bytes) -> tuple[Any, bytes]:
        try:
            kind = _ALIASES.get(kind, kind)
            definition = self._store.get_msgdef(kind)
            if self.is_ros1:
                content, end = definition.deserialize_ros1(raw, 0, definition.cls, self._store)
                return content, raw[end:]
            return self._store.deserialize_cdr(raw, kind), b""
        except Exception as error:  # whatever damaged bytes make of the library
            raise UserError(f"{where} is damaged ({_first_line(error)})") from None


def is_bag(path: Path) -> bool:
    """Whether a file or folder is a bag by its first bytes, or by a metadata.yaml in it."""
    if path.is_dir():
        return (path / METADATA).is_file()
    with path.open("rb") as file:
        return file.read(16).startswith((_ROS1_START, _MCAP_START, _SQLITE_START))


@contextmanager
def open_bag(path: Path) -> Iterator[BagReader]:
    """The bag at a path, closed at the end. Raises UserError: damaged, cut short, or `rosbags` is not installed."""
    try:
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2
    except ImportError:
        raise UserError(f"{path}: reading bags needs rosbags: {how_to_install('ros')}") from None
    is_ros1 = path.is_file() and _starts(path, _ROS1_START)
    if path.is_file() and not is_ros1:
        ending = ".mcap" if _starts(path, _MCAP_START) else ".db3"
        if path.suffix != ending:
            raise UserError(f"{path}: is a ROS 2 recording: call it {path.with_suffix(ending).name}")
    if path.is_dir():
        check_folder(path)
    reader: Any = None
    try:
        reader = Reader1(path) if is_ros1 else Reader2(path)
        if not is_ros1:
            bound_unpacking()
        reader.open()
        bound_chunks(reader) if is_ros1 else bound_rows(reader)
        bag = BagReader(path, reader, _standard_types(is_ros1), is_ros1)
    except Exception as error:
        _close(reader)
        raise _damaged(path, error) from None
    try:
        yield bag
    finally:
        _close(reader)


@cache
def _standard_types(is_ros1: bool) -> Any:
    """The messages' definitions, as `rosbags` keeps them; it compiles each when it meets it first."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    if is_ros1:  # which it lacks
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    return store


def _starts(path: Path, start: bytes) -> bool:
    with path.open("rb") as file:
        return file.read(len(start)) == start


def _guarded(path: Path, messages: Iterator[Any]) -> Iterator[Any]:
    """The messages; what goes wrong between them as a UserError."""
    while True:
        try:
            message = next(messages)
        except StopIteration:
            return
        except UserError:
            raise
        except Exception as error:
            raise _damaged(path, error) from None
        yield message


def _damaged(path: Path, error: Exception) -> UserError:
    return UserError(
        f"{path}: is damaged or was not closed by its recorder ({_first_line(error)}): 'rosbag reindex', 'ros2 bag "
        "reindex' or 'mcap recover' may mend it"
    )


def _first_line(error: Exception) -> str:
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text[:120]}" if text else type(error).__name__


def _close(reader: Any) -> None:
    if getattr(reader, "bio", None) is not None or getattr(reader, "is_open", False):
        reader.close()


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
        return _BoundedFile(zstd.open(file, mode), max(_MOST_GROWTH * size, _LEAST_BYTES))

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


class _BoundedFile:
    """A file that is read to its end, of `most` bytes at most."""

    def __init__(self, file: Any, most: int) -> None:
        self._file, self._most, self._left = file, most, most

    def __enter__(self) -> _BoundedFile:
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
