"""The images that keyframes were made of, kept for when their places come back."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from rsgen.errors import UserError
from rsgen.files import atomic_write
from rsgen.image_codecs import encode_npz
from rstrack.data.rig import Frame, Image
from rstrack.keyframes.archive import temporary_folder


@dataclass
class KeptFrames:
    """Frames by their numbers. Beyond `most_bytes` the oldest are in temporary files (in TMPDIR) until asked for."""

    most_bytes: float
    _kept: dict[int, Frame | Path] = field(default_factory=dict)
    _size: int = 0
    _temporary: TemporaryDirectory[str] | None = None

    def add(self, number: int, frame: Frame) -> None:
        """Keep a frame. Raises UserError: no room on disk."""
        self._kept[number] = frame
        self._size += _size(frame)
        for old, kept in list(self._kept.items()):
            if self._size <= self.most_bytes:
                break
            if isinstance(kept, Frame):
                self._kept[old] = self._written(old, kept)
                self._size -= _size(kept)

    def get(self, number: int) -> Frame:
        """A frame that was kept. Raises UserError: there is none, its file is gone."""
        kept = self._kept.get(number)
        if kept is None:
            raise UserError(f"frame {number}: its images were not kept")
        return kept if isinstance(kept, Frame) else _read(kept)

    def _written(self, number: int, frame: Frame) -> Path:
        if self._temporary is None:
            self._temporary = temporary_folder("frames", "keyframes' images: they")
        path = Path(self._temporary.name) / f"frame-{number:08d}.npz"
        images = (frame.depth, *frame.colors)
        arrays = {f"image{n}": image.pixels for n, image in enumerate(images)}
        atomic_write(path, encode_npz(arrays | {"stamps": np.array([image.stamp for image in images])}))
        return path


def _read(path: Path) -> Frame:
    try:
        with np.load(path, allow_pickle=False) as file:
            images = [Image(float(stamp), file[f"image{n}"]) for n, stamp in enumerate(file["stamps"])]
    except OSError as error:
        raise UserError(f"{path}: images of a keyframe that were put there cannot be read again ({error})") from None
    return Frame(images[0], tuple(images[1:]))


def _size(frame: Frame) -> int:
    """Bytes of its images."""
    return sum(image.pixels.nbytes for image in (frame.depth, *frame.colors))
