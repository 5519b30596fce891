"""ROS 1 bags, ROS 2 bags (SQLite and MCAP) and single MCAP files: topics, and their messages one by one.

What `rosbags` raises on damaged files is not one kind of error, so whatever it raises becomes one line here. Messages
are read by the standard definitions of ROS, not by those in the file: librealsense's bags have more in an image than
their own definition says, which `Message.rest` keeps.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from rsgen.errors import UserError
from rstrack.formats.bags.bounds import METADATA, bound_chunks, bound_rows, bound_unpacking, check_folder

_ROS1_START = b"#ROSBAG V"
_MCAP_START = b"\x89MCAP0\r\n"
_SQLITE_START = b"SQLite format 3\0"
# Of old bags: the same bytes under another name.
_ALIASES = {"tf/msg/tfMessage": "tf2_msgs/msg/TFMessage"}
INSTALL = "pip install 'rolling-shutter-rgbd[ros]'"


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


class Bag:
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
        for connection, arrival_ns, raw in _told(self.path, self._reader.messages(connections)):
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
def open_bag(path: Path) -> Iterator[Bag]:
    """The bag at a path, closed at the end. Raises UserError: damaged, cut short, or `rosbags` is not installed."""
    try:
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2
    except ImportError:
        raise UserError(f"{path}: reading bags needs rosbags: {INSTALL}") from None
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
        bag = Bag(path, reader, _standard_types(is_ros1), is_ros1)
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


def _told(path: Path, messages: Iterator[Any]) -> Iterator[Any]:
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
