"""Every keyframe ever made, and the images that they were made of, in memory or files; which look like a new frame."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import numpy.typing as npt

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rsgen.files import atomic_write, write_error
from rsgen.image_codecs import encode_npz
from rstrack.data.rig import Frame, Image
from rstrack.images.device_frame import DeviceFrame
from rstrack.keyframes.keyframe import Reference
from rstrack.keyframes.maker import KeyframeMaker

# Correlation of two views' thumbnails from which on they may show one place.
_ALIKE = 0.3

Arrays = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class _StoredArrays:
    """Arrays; None where they are in `file` only. number: of this version of them, counted over all that were added."""

    arrays: Arrays | None
    number: int
    file: Path | None = None

    @property
    def size(self) -> int:
        """Bytes in memory."""
        return sum(array.nbytes for array in (self.arrays or {}).values())


@dataclass
class SpilledArrays:
    """Arrays by a frame's number. Beyond `most_bytes` those that were stored first are in files only.

    These are temporary ones (in TMPDIR), which are gone when this is, or in `folder`, where they stay. `write` puts all
    of them there, so that a checkpoint need not hold them. name: what files begin with.
    """

    name: str
    most_bytes: float
    folder: Path | None = None
    _entries: dict[int, _StoredArrays] = field(default_factory=dict)
    _size: int = 0
    _added: int = 0
    _temporary: TemporaryDirectory[str] | None = None

    def __getstate__(self) -> dict[str, Any]:
        """For a checkpoint: arrays that are in files stay there."""
        entries = {k: each if each.file is None else replace(each, arrays=None) for k, each in self._entries.items()}
        size = sum(each.size for each in entries.values())
        return vars(self) | {"_entries": entries, "_size": size, "_temporary": None}

    def put_in(self, folder: Path) -> None:
        """Files are in that folder from now on, and so are those that there are."""
        self.folder = folder
        for k, each in self._entries.items():
            if each.file is not None:
                self._entries[k] = replace(each, file=folder / each.file.name)

    @property
    def spilled(self) -> int:
        """Entries that are in files only."""
        return sum(each.arrays is None for each in self._entries.values())

    def put(self, number: int, arrays: Arrays) -> None:
        """Store arrays in place of earlier ones. Raises UserError: no room on disk."""
        before = self._entries.pop(number, None)
        if before is not None:
            self._size -= before.size
            if before.file is not None and self.folder is None:
                before.file.unlink(missing_ok=True)
        self._added += 1
        self._entries[number] = entry = _StoredArrays(arrays, self._added)
        self._size += entry.size
        for k, each in list(self._entries.items()):
            if self._size <= self.most_bytes:
                break
            if each.arrays is not None:
                self._entries[k] = replace(self._written(k, each), arrays=None)
                self._size -= each.size

    def write(self) -> None:
        """All arrays that are in no file yet. Raises UserError: no room on disk."""
        self._entries = {k: self._written(k, each) for k, each in self._entries.items()}

    def get(self, number: int) -> Arrays:
        """Arrays that were stored. Raises UserError: their file is gone."""
        entry = self._entries[number]
        if entry.arrays is not None:
            return entry.arrays
        assert entry.file is not None
        try:
            with np.load(entry.file, allow_pickle=False) as file:
                return {name: file[name] for name in file.files}
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise UserError(f"{entry.file}: images of a keyframe cannot be read again ({error})") from None

    def _written(self, number: int, entry: _StoredArrays) -> _StoredArrays:
        """With its arrays in a file too, of a name of its own: a checkpoint may mean an earlier version."""
        if entry.file is not None or entry.arrays is None:
            return entry
        if self.folder is None and self._temporary is None:
            try:
                self._temporary = TemporaryDirectory(prefix=f"rstrack-{self.name}s-")
            except OSError as error:
                raise UserError(
                    f"{self.name}s: {len(self._entries)} do not fit --memory-gb, and there is no folder for temporary "
                    f"files ({error.strerror}): set TMPDIR to one with room, or give more --memory-gb"
                ) from None
        folder = self.folder or Path(self._temporary.name if self._temporary else "")
        try:
            folder.mkdir(exist_ok=True)
        except OSError as error:
            raise write_error(folder, error) from None
        path = folder / f"{self.name}-{number:08d}-{entry.number:08d}.npz"
        atomic_write(path, encode_npz(entry.arrays))
        return replace(entry, file=path)


class StoredFrames:
    """The images that keyframes were made of, by the frames' numbers, for when their places come back."""

    def __init__(self, most_bytes: float) -> None:
        self._images = SpilledArrays("frame", most_bytes)
        self._stamps: dict[int, list[float]] = {}

    def add(self, number: int, frame: Frame) -> None:
        """Store a frame. Raises UserError: no room on disk."""
        images = (frame.depth, *frame.colors)
        self._stamps[number] = [image.stamp for image in images]
        self._images.put(number, {f"image{n}": image.pixels for n, image in enumerate(images)})

    def get(self, number: int) -> Frame:
        """A frame that was stored. Raises UserError: there is none, its file is gone."""
        if number not in self._stamps:
            raise UserError(f"frame {number}: its images were not stored")
        arrays = self._images.get(number)
        depth, *colors = (Image(stamp, arrays[f"image{n}"]) for n, stamp in enumerate(self._stamps[number]))
        return Frame(depth, tuple(colors))


class Archive:
    """Keyframes by their frames' numbers. One of 640×480 takes 4 MB instead of 8 on the device.

    Their images are a `SpilledArrays` with `most_bytes`.
    """

    def __init__(self, maker: KeyframeMaker, most_bytes: float = float("inf")) -> None:
        self.maker = maker
        self.images = SpilledArrays("keyframe", most_bytes)
        self._small: dict[int, Reference] = {}

    def __len__(self) -> int:
        return len(self._small)

    def __contains__(self, index: int) -> bool:
        return index in self._small

    def add(self, ref: Reference) -> None:
        """Store a keyframe as it is now, in place of an earlier version. Raises UserError: no room on disk."""
        camera = ref.lens.camera
        rho, weight = (self.maker.e.download(a, (camera.height, camera.width)) for a in (ref.inverse_depth, ref.weight))
        arrays: Arrays = {"inverse_depth": rho, "weight": weight.astype(np.float16)}
        own = {"intensity": ref.intensity, "coarse_intensity": ref.coarse_intensity}
        arrays |= {name: image for name, image in own.items() if image is not None}
        self._small.pop(ref.index, None)
        self._small[ref.index] = ref.emptied().without_images()
        self.images.put(ref.index, arrays)

    def get(self, index: int) -> Reference:
        """The keyframe of frame `index`, on the device again. Raises UserError: its file is gone."""
        arrays = self.images.get(index)
        intensity, coarse = arrays.get("intensity"), arrays.get("coarse_intensity")
        small = replace(self._small[index], intensity=intensity, coarse_intensity=coarse)
        return self.maker.revived(small, arrays["inverse_depth"], arrays["weight"].astype(np.float32))

    @property
    def indices(self) -> list[int]:
        """Numbers of the frames that they were made of."""
        return list(self._small)

    def small(self, index: int) -> Reference:
        """The keyframe of frame `index` without its images."""
        return self._small[index]

    def pose(self, index: int) -> FloatArray:
        """T_world_base (4, 4) of the keyframe of frame `index`."""
        return self._small[index].T_world_base

    def alike(self, frame: DeviceFrame, without: set[int], least: float = _ALIKE) -> list[int]:
        """Keyframes whose view resembles a frame's by at least so much, the best first; without those in `without`."""
        numbers = [k for k in self._small if k not in without]
        scores = resemblances([self._small[k] for k in numbers], frame)
        return [numbers[n] for n in np.argsort(-scores, kind="stable") if scores[n] > least]


def resemblances(refs: Sequence[Reference], frame: DeviceFrame) -> FloatArray:
    """Mean correlations (n,), −1 to 1, of a frame's thumbnails and keyframes', those of depth and where there are of
    colour."""
    scores = _correlations([ref.depth_thumbnail for ref in refs], frame.depth.thumbnail)
    colors = [(n, ref.color_thumbnail) for n, ref in enumerate(refs) if ref.color_thumbnail is not None]
    if colors and frame.colors:
        at = [n for n, _ in colors]
        scores[at] = 0.5 * (scores[at] + _correlations([t for _, t in colors], frame.colors[0].thumbnail))
    return scores


def _correlations(many: Sequence[npt.NDArray[Any]], one: npt.NDArray[Any]) -> FloatArray:
    """Of each of n images with another, over the pixels that both have; 0 where these are less than a quarter."""
    if not many:
        return np.zeros(0)
    a, b = np.stack(many).reshape(len(many), -1).astype(float), one.reshape(-1).astype(float)
    in_a, in_b = (a != 0).astype(float), (b != 0).astype(float)
    # Correlations are the same whatever is taken off; this leaves numbers about 0.
    off = b.sum() / max(1.0, in_b.sum())
    a, b = in_a * (a - off), in_b * (b - off)
    shared = in_a @ in_b
    count = np.maximum(1.0, shared)
    sum_a, sum_b = a @ in_b, in_a @ b
    spread_a, spread_b = (a * a) @ in_b - sum_a**2 / count, in_a @ (b * b) - sum_b**2 / count
    size = np.sqrt(np.maximum(0.0, spread_a * spread_b))
    is_known = (shared >= 0.25 * b.size) & (size > 1e-12)
    return np.where(is_known, (a @ b - sum_a * sum_b / count) / np.where(is_known, size, 1.0), 0.0)
