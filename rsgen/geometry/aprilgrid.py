"""Kalibr's AprilGrid: where the corners of its tags are, and in which order Kalibr counts them.

The target's frame: origin in the lower left corner of tag 0, x to the right, y up, z out of the board towards who looks
at it. Tags are counted from the lower left to the right, then row by row upwards. After Kalibr's
`GridCalibrationTargetAprilgrid.cpp` (its drawings count tags from 1 in places, its code from 0).

    y     | tag 2 |  | tag 3 |        corners of a tag:  3---2
    ^     +-------+  +-------+                           |   |
    |     | tag 0 |  | tag 1 |                           0---1
    +-->x
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsgen.array_types import FloatArray, IntArray


@dataclass(frozen=True)
class AprilGrid:
    """rows x columns of tags with edges of tag_size_m (its black border included), `spacing` tag sizes apart."""

    rows: int
    columns: int
    tag_size_m: float
    spacing: float

    @property
    def tag_count(self) -> int:
        """Tags 0 to tag_count - 1."""
        return self.rows * self.columns

    @property
    def gap_m(self) -> float:
        """Between tags; also the edge of the black squares in the corners between them."""
        return self.spacing * self.tag_size_m

    @property
    def lower_left(self) -> FloatArray:
        """(3,) of the whole board: beyond the outermost black squares lies a white margin of the same width."""
        return np.array([-2.0 * self.gap_m, -2.0 * self.gap_m, 0.0])

    @property
    def size_m(self) -> FloatArray:
        """Width and height (2,) of the whole board."""
        count = np.array([self.columns, self.rows])
        return count * self.tag_size_m + (count + 3) * self.gap_m

    def corners(self) -> FloatArray:
        """Corners (tags, 4, 3) in the target's frame, m: lower left, lower right, upper right, upper left."""
        row, column = np.divmod(np.arange(self.tag_count), self.columns)
        first = np.stack([column, row], axis=-1) * (self.tag_size_m + self.gap_m)
        xy = first[:, None] + self.tag_size_m * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
        return np.concatenate([xy, np.zeros((*xy.shape[:2], 1))], axis=-1)

    def point_index(self) -> IntArray:
        """(tags, 4) numbers of those corners among Kalibr's grid points: row by row from below, 2 columns a row."""
        row, column = np.divmod(np.arange(self.tag_count), self.columns)
        across = 2 * self.columns
        first = 2 * row * across + 2 * column
        return np.asarray(first[:, None] + np.array([0, 1, across + 1, across]))
