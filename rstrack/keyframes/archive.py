"""Every keyframe ever made, kept small, and the places that look like a new frame."""

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
from rstrack.images.device_frame import DeviceFrame
from rstrack.keyframes.keyframe import Reference
from rstrack.keyframes.maker import KeyframeMaker

# Correlation of two views' thumbnails from which on they may show one place.
_ALIKE = 0.3


@dataclass(frozen=True)
class _Archived:
    """A keyframe on the host: what does not need the device; images: inverse depth, weight and the host's own (h, w).

    images: None where they are in `file` only. number: of this version of it, counted over all that were added.
    """

    small: Reference
    images: dict[str, npt.NDArray[Any]] | None
    number: int
    file: Path | None = None

    @property
    def size(self) -> int:
        """Bytes of the images that are in memory."""
        return sum(image.nbytes for image in (self.images or {}).values())


@dataclass
class Archive:
    """Keyframes by their numbers. One of 640×480 takes 4 MB instead of 8 on the device.

    Beyond `most_bytes` the images of those that have been there longest are in files only: temporary ones (in TMPDIR),
    which are gone when the archive is, or in `folder`, where they stay. `write` puts all of them there, so that a
    checkpoint need not hold them.
    """

    maker: KeyframeMaker
    most_bytes: float = float("inf")
    folder: Path | None = None
    _kept: dict[int, _Archived] = field(default_factory=dict)
    _size: int = 0
    _added: int = 0
    _temporary: TemporaryDirectory[str] | None = None

    def __len__(self) -> int:
        return len(self._kept)

    def __contains__(self, index: int) -> bool:
        return index in self._kept

    def __getstate__(self) -> dict[str, Any]:
        """For a checkpoint: images that are in files stay there."""
        kept = {k: each if each.file is None else replace(each, images=None) for k, each in self._kept.items()}
        return vars(self) | {"_kept": kept, "_size": sum(each.size for each in kept.values()), "_temporary": None}

    def put_in(self, folder: Path) -> None:
        """Files are in that folder from now on, and so are those that there are."""
        self.folder = folder
        for k, each in self._kept.items():
            if each.file is not None:
                self._kept[k] = replace(each, file=folder / each.file.name)

    @property
    def spilled(self) -> int:
        """Keyframes whose images are in files only."""
        return sum(kept.images is None for kept in self._kept.values())

    def add(self, ref: Reference) -> None:
        """Keep a keyframe as it is now, in place of what was kept of it before. Raises UserError: no room on disk."""
        camera = ref.lens.camera
        rho, weight = (self.maker.e.download(a, (camera.height, camera.width)) for a in (ref.inverse_depth, ref.weight))
        images: dict[str, npt.NDArray[Any]] = {"inverse_depth": rho, "weight": weight.astype(np.float16)}
        own = {"intensity": ref.intensity, "coarse_intensity": ref.coarse_intensity}
        images |= {name: image for name, image in own.items() if image is not None}
        before = self._kept.pop(ref.index, None)
        if before is not None:
            self._size -= before.size
            if before.file is not None and self.folder is None:
                before.file.unlink(missing_ok=True)
        self._added += 1
        self._kept[ref.index] = _Archived(ref.emptied().without_images(), images, self._added)
        self._size += self._kept[ref.index].size
        for index, kept in list(self._kept.items()):
            if self._size <= self.most_bytes:
                break
            if kept.images is not None:
                self._kept[index] = replace(self._written(kept), images=None)
                self._size -= kept.size

    def write(self) -> None:
        """All images that are in no file yet. Raises UserError: no room on disk."""
        self._kept = {index: self._written(kept) for index, kept in self._kept.items()}

    def get(self, index: int) -> Reference:
        """The keyframe of frame `index`, on the device again. Raises UserError: its file is gone."""
        kept = self._kept[index]
        images = kept.images
        if images is None:
            assert kept.file is not None
            images = _read(kept.file)
        small = replace(
            kept.small, intensity=images.get("intensity"), coarse_intensity=images.get("coarse_intensity")
        )  # fmt: skip
        return self.maker.revived(small, images["inverse_depth"], images["weight"].astype(np.float32))

    @property
    def indices(self) -> list[int]:
        """Numbers of the frames that they were made of."""
        return list(self._kept)

    def small(self, index: int) -> Reference:
        """The keyframe of frame `index` without its images."""
        return self._kept[index].small

    def pose(self, index: int) -> FloatArray:
        """T_world_base (4, 4) of the keyframe of frame `index`."""
        return self._kept[index].small.T_world_base

    def alike(self, frame: DeviceFrame, without: set[int], least: float = _ALIKE) -> list[int]:
        """Keyframes whose view resembles a frame's by at least so much, the best first; without those in `without`."""
        numbers = [k for k in self._kept if k not in without]
        scores = resemblances([self._kept[k].small for k in numbers], frame)
        return [numbers[n] for n in np.argsort(-scores, kind="stable") if scores[n] > least]

    def _temporary_folder(self) -> Path:
        if self._temporary is None:
            self._temporary = temporary_folder("keyframes", f"keyframes: {len(self._kept)}")
        return Path(self._temporary.name)

    def _written(self, kept: _Archived) -> _Archived:
        """With its images in a file too, of a name of its own: a checkpoint may mean an earlier version."""
        if kept.file is not None or kept.images is None:
            return kept
        folder = self.folder or self._temporary_folder()
        try:
            folder.mkdir(exist_ok=True)
        except OSError as error:
            raise write_error(folder, error) from None
        path = folder / f"keyframe-{kept.small.index:08d}-{kept.number:08d}.npz"
        atomic_write(path, encode_npz(kept.images))
        return replace(kept, file=path)


def temporary_folder(name: str, what: str) -> TemporaryDirectory[str]:
    """A folder for what does not fit in memory, gone when this is. Raises UserError: there is no room for it."""
    try:
        return TemporaryDirectory(prefix=f"rstrack-{name}-")
    except OSError as error:
        raise UserError(
            f"{what} do not fit --memory-gb, and there is no folder for temporary files ({error.strerror}): set TMPDIR "
            "to one with room, or give more --memory-gb"
        ) from None


def _read(path: Path) -> dict[str, npt.NDArray[Any]]:
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise UserError(f"{path}: a keyframe that was put there cannot be read again ({error})") from None


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
