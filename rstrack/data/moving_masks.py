"""Which pixels of depth images a track has left out since they move by themselves: in memory, and in a run's folder.

masks = MovingMasks.read(Path("runs/moving1"))
z[masks.of(17, *z.shape)] = 0.0
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from rsgen.errors import UserError
from rsgen.files import atomic_write
from rsgen.image_codecs import encode_npz
from rsgen.inputs import MOST_PIXELS, read_arrays

MOVING = "moving.npz"

Mask = npt.NDArray[np.bool_]


@dataclass
class MovingMasks:
    """Masks by frame number, of every stride-th pixel of every stride-th row, packed: some 200 bytes each.

    shape: rows and columns of a mask; (0, 0) while there is none.
    """

    shape: tuple[int, int] = (0, 0)
    stride: int = 1
    _packed: dict[int, bytes] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self._packed)

    def put(self, frame: int, mask: Mask, stride: int) -> None:
        """Keep the mask (gh, gw) of a frame in place of what was kept of it; one without pixels is none."""
        self._packed.pop(frame, None)
        if mask.any():
            self.shape, self.stride = (mask.shape[0], mask.shape[1]), stride
            self._packed[frame] = zlib.compress(np.packbits(mask).tobytes())

    def grid(self, frame: int) -> Mask | None:
        """The mask (gh, gw) of a frame; None where nothing was left out of it."""
        packed = self._packed.get(frame)
        return None if packed is None else _unpacked(packed, self.shape)

    def of(self, frame: int, height: int, width: int, margin: int = 0) -> Mask | None:
        """The same for all pixels (height, width), and those within a margin (px) of it.

        Raises UserError if they are masks of images of another size.
        """
        mask = self.grid(frame)
        if mask is None:
            return None
        if self.shape != (-(-height // self.stride), -(-width // self.stride)):
            raise UserError(
                f"{MOVING}: masks of {self.shape[1]}x{self.shape[0]}, every {self.stride} pixels, are not of images of "
                f"{width}x{height}: give the sequence that was tracked"
            )
        full = mask.repeat(self.stride, axis=0).repeat(self.stride, axis=1)[:height, :width]
        if margin:
            size = 2 * margin + 1
            full = np.asarray(cv2.dilate(full.astype(np.uint8), np.ones((size, size), np.uint8)) > 0)
        return full

    def write(self, folder: Path, numbers: Sequence[int]) -> None:
        """Write moving.npz into a run's folder, frames numbered as in the data set: `numbers` has them in order.

        No file where nothing was left out. Raises UserError.
        """
        if not self._packed:
            return
        blobs = [np.frombuffer(blob, np.uint8) for blob in self._packed.values()]
        arrays = {
            "frames": np.array([numbers[frame] for frame in self._packed], np.int64),
            "ends": np.cumsum([len(blob) for blob in blobs]),
            "packed": np.concatenate(blobs),
            "shape": np.array(self.shape),
            "stride": np.array(self.stride),
        }
        atomic_write(folder / MOVING, encode_npz(arrays))

    @classmethod
    def read(cls, folder: Path) -> MovingMasks:
        """Those of a run's folder; none where it has no moving.npz. Raises UserError: damaged."""
        path = folder / MOVING
        if not path.exists():
            return cls()
        try:
            arrays = read_arrays(path, ("frames", "ends", "packed", "shape", "stride"))
            height, width = (int(size) for size in arrays["shape"])
            if height * width > MOST_PIXELS:
                raise ValueError(f"masks of {width}x{height} pixels")
            ends = [0, *(int(end) for end in arrays["ends"])]
            packed = arrays["packed"].astype(np.uint8).tobytes()
            out = cls((height, width), int(arrays["stride"]))
            for frame, begin, end in zip(arrays["frames"], ends[:-1], ends[1:], strict=True):
                _unpacked(packed[begin:end], out.shape)
                out._packed[int(frame)] = packed[begin:end]
        except Exception as error:  # whatever a damaged archive makes NumPy, zipfile and zlib say
            raise UserError(f"{path}: cannot be read ({error}): track again") from None
        return out


def _unpacked(packed: bytes, shape: tuple[int, int]) -> Mask:
    data = zlib.decompressobj().decompress(packed, (shape[0] * shape[1] + 7) // 8)
    bits = np.unpackbits(np.frombuffer(data, np.uint8), count=shape[0] * shape[1])
    return bits.reshape(shape).astype(bool)
