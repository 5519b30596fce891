"""truth/frames_STREAM.txt: what was true of each image of a stream whose listing, or exposure, does not tell.

One line an image: its number; the number of the frame that it shows (an earlier one where a driver repeated it); the
true stamp of that frame and the listed one, s; exposure, s; gain; factor on the light against the config's exposure and
gain; white balance, factors on R, G, B.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rsgen.array_types import FloatArray, IntArray
from rsgen.errors import UserError
from rsgen.files import read_text
from rsgen.sequence.format import FRAME_TABLES, StreamName

_HEAD = "# frame shows taken_s listed_s exposure_s gain brightness red green blue"
_COLUMNS = 10


@dataclass(frozen=True)
class FrameTable:
    """n images. frame, shows (n,): numbers; taken_s (n,): stamps of what they show; listed_s (n,): as listed.

    exposure_s, gain, brightness (n,), balance (n, 3): of the frame shown; 1 where nothing was adapted.
    """

    frame: IntArray
    shows: IntArray
    taken_s: FloatArray
    listed_s: FloatArray
    exposure_s: FloatArray
    gain: FloatArray
    brightness: FloatArray
    balance: FloatArray

    def of(self, frames: NDArray[np.int64]) -> FrameTable:
        """The lines of these frames, in their order; all must be there."""
        at = np.searchsorted(self.frame, frames)
        return FrameTable(*(getattr(self, name)[at] for name in self.__dataclass_fields__))

    def text(self) -> str:
        """The file's content."""
        times = np.column_stack([self.taken_s, self.listed_s, self.exposure_s])
        factors = np.column_stack([self.gain, self.brightness, self.balance])
        lines = [
            f"{frame} {shows} " + " ".join(f"{t:.9f}" for t in time) + " " + " ".join(f"{x:.9g}" for x in factor)
            for frame, shows, time, factor in zip(self.frame, self.shows, times, factors, strict=True)
        ]
        return "\n".join([_HEAD, *lines, ""])


def read_frame_table(root: Path, stream: StreamName) -> FrameTable:
    """The table of a stream of the sequence at `root`. Raises UserError naming the file."""
    path = root / FRAME_TABLES[stream]
    lines = [line for line in read_text(path).splitlines() if line.strip() and not line.startswith("#")]
    try:
        rows = np.array([[float(field) for field in line.split()] for line in lines])
    except ValueError:
        rows = np.empty(0)
    whole = rows.ndim == 2 and rows.shape[1] == _COLUMNS and bool(np.isfinite(rows).all())
    if not (whole and (np.abs(rows) < 1e12).all() and (np.diff(rows[:, 0]) > 0).all() and (rows[:, 4] >= 0).all()):
        raise UserError(f"{path}: expected rising lines of {_COLUMNS} numbers: render again to write it")
    frame, shows = rows[:, :2].astype(np.int64).T
    taken_s, listed_s, exposure_s, gain, brightness = rows[:, 2:7].T
    return FrameTable(frame, shows, taken_s, listed_s, exposure_s, gain, brightness, rows[:, 7:])
