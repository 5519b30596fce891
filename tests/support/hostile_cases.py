"""Cases of hostile files: a folder to make, what reads it, and whether that must refuse it; and how to make them.

base = Base("phones", recordings.write_stray(folder / "scan", CONTENT), imported)
yield base.case("a pipe", piped("odometry.csv"))
"""

from __future__ import annotations

import os
import shutil
import sys
import types
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import hostile
import recordings

from rsgen.device.backend import mitsuba
from rsgen.scene.loading import load_scene
from rsgen.sequence.reader import read_sequence
from rstrack.data.dataset import open_dataset
from rstrack.formats import open_recording
from rstrack.formats.folder import write_folder
from rstrack.formats.recording import ReadOptions

CONTENT = recordings.make_content()
Read = Callable[[Path, Path], object]
Write = Callable[[Path], Path]
Edit = Callable[[Path], object]


@dataclass(frozen=True)
class Case:
    """write makes the files in an empty folder and says what to read; read gets that and a path for what is written."""

    group: str
    name: str
    write: Write
    read: Read
    must_refuse: bool


def prepare() -> None:
    """Load what readers load when they are first used, and a module that unpacks what LZFSE stored as it is."""
    mitsuba()
    module = types.ModuleType("liblzfse")
    module.decompress = lambda data: data[8:-4]  # type: ignore[attr-defined]
    sys.modules["liblzfse"] = module


def imported(path: Path, out: Path) -> None:
    write_folder(open_recording(path, ReadOptions()), out, file=path.name)
    open_dataset(out).readable_frame(0)


def tracked(path: Path, out: Path) -> None:
    """All that `rstrack track` reads of a folder; images that cannot be read are named, not fatal."""
    dataset = open_dataset(path)
    assert dataset.read_imu is None or dataset.imu is not None
    for k in range(len(dataset)):
        for problem in dataset.readable_frame(k)[1]:
            assert "\n" not in problem and str(path) in problem, problem


def every_image(path: Path, out: Path) -> None:
    dataset = open_dataset(path)
    for k in range(len(dataset)):
        dataset.frame(k)


def sequence_read(path: Path, out: Path) -> None:
    sequence = read_sequence(path)
    for k in (0, 1):
        sequence.color(k), sequence.depth(k), sequence.truth_depth(k)
    sequence.rows("color"), sequence.rows("depth")


def scene_read(path: Path, out: Path) -> None:
    load_scene(path)


@dataclass(frozen=True)
class Base:
    """A whole recording; `inside` is the file of it that is damaged, '' where it is the recording itself."""

    group: str
    whole: Path
    read: Read

    def case(self, name: str, edit: Edit, must_refuse: bool = True) -> Case:
        def write(place: Path) -> Path:
            path = place / self.whole.name
            shutil.copytree(self.whole, path, symlinks=True) if self.whole.is_dir() else shutil.copy(self.whole, path)
            edit(path)
            return path

        return Case(self.group, f"{self.whole.name}: {name}", write, self.read, must_refuse)

    def damaged(self, inside: str, every: int = 1) -> Iterator[Case]:
        """The recording with each damage, or every so manieth, to a file of it, which may be harmless."""
        data = (self.whole / inside if inside else self.whole).read_bytes()
        yield self.case(f"{inside} as it is", lambda path: None, False)
        for k, (way, bytes_) in enumerate(hostile.damaged(data, len(inside))):
            if k % every == len(inside) % every:
                yield self.case(f"{inside} {way}", replaced_by(inside, bytes_), False)
        yield self.case(f"{inside} empty", replaced_by(inside, b""), False)


def replaced_by(inside: str, data: bytes) -> Edit:
    return lambda path: (path / inside if inside else path).write_bytes(data)


def text_edited(inside: str, old: str, new: str) -> Edit:
    def edit(path: Path) -> None:
        file = path / inside if inside else path
        text = file.read_text()
        assert old in text, (inside, old)
        file.write_text(text.replace(old, new, 1))

    return edit


def linked(inside: str, target: str) -> Edit:
    """The file becomes a symbolic link; target: from the folder that it lies in."""

    def edit(path: Path) -> None:
        (path / inside).unlink()
        (path / inside).symlink_to(target)

    return edit


def piped(inside: str) -> Edit:
    """The file becomes a pipe that nobody writes to."""

    def edit(path: Path) -> None:
        (path / inside).unlink()
        os.mkfifo(path / inside)

    return edit


def of_8_gb(inside: str) -> Edit:
    return lambda path: hostile.sparse(path / inside if inside else path)


def beside(name: str, data: bytes) -> Callable[[Path], Path]:
    """A file beside the recording's folder, which is nobody's business."""

    def write(path: Path) -> Path:
        file = path.parent.parent / "beside" / name
        file.write_bytes(data)
        return file

    return write


def both(*edits: Edit) -> Edit:
    return lambda path: [edit(path) for edit in edits]


def patched(at: int, data: bytes) -> Edit:
    def edit(path: Path) -> None:
        whole = bytearray(path.read_bytes())
        whole[at : at + len(data)] = data
        path.write_bytes(whole)

    return edit


def entries_changed(base: Base, inside: str, entries: dict[str, str]) -> Iterator[Case]:
    for old, new in entries.items():
        yield base.case(f"{inside}: {new[:30]!r}", text_edited(inside, old, new))


def jpeg_bomb() -> bytes:
    return hostile.jpeg_of(recordings.jpeg(CONTENT.colors[0]), 32000, 32000)
