"""Text files of truth/ beside the images: frame tables, poses and splines of moving objects, a target's corners."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rsgen.array_types import FloatArray, IntArray
from rsgen.errors import UserError
from rsgen.files import read_text
from rsgen.geometry import se3
from rsgen.geometry.aprilgrid import AprilGrid
from rsgen.geometry.spline import Spline
from rsgen.sequence.format import OBJECTS, STAMP_TOLERANCE_S

_TABLE_HEAD = "# frame shows taken_s listed_s exposure_s gain brightness red green blue"
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
        return "\n".join([_TABLE_HEAD, *lines, ""])


def read_frame_table(path: Path) -> FrameTable:
    """The table of a stream. Raises UserError naming the file."""
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


@dataclass(frozen=True, eq=False)
class SequenceObject:
    """A thing: number, as masks have it (from 1); T_world_object(t); mesh: PLY of its triangles, its own frame, m."""

    name: str
    number: int
    spline: Spline
    mesh: Path


def spline_file(name: str) -> str:
    """Where within a sequence's folder an object's spline is."""
    return f"{OBJECTS}/{name}_spline.npz"


def poses_file(name: str) -> str:
    """Where within a sequence's folder an object's poses are."""
    return f"{OBJECTS}/{name}.txt"


def mesh_file(name: str) -> str:
    """Where within a sequence's folder an object's mesh is."""
    return f"{OBJECTS}/{name}.ply"


def read_objects(root: Path, names: tuple[str, ...], begin: float, end: float) -> tuple[SequenceObject, ...]:
    """The objects of the sequence in `root`. Raises UserError if one's spline is missing or does not last that long."""
    things = []
    for number, name in enumerate(names, 1):
        spline = Spline.load(root / spline_file(name))
        if not (spline.t_begin <= begin + STAMP_TOLERANCE_S and end - STAMP_TOLERANCE_S <= spline.t_end):
            raise UserError(
                f"{root / spline_file(name)}: covers {spline.t_begin:g} to {spline.t_end:g} s, the frames {begin:g} "
                f"to {end:g} s: restore it or render again"
            )
        things.append(SequenceObject(name, number, spline, root / mesh_file(name)))
    return tuple(things)


TARGET_CORNERS = "truth/target_corners.txt"


def target_corners_text(grid: AprilGrid, T_world_target: FloatArray) -> str:
    """Lines 'tag corner point x y z': corner 0..3 and point are numbered as Kalibr does, see `AprilGrid`; world, m."""
    p_world = se3.transform(T_world_target, grid.corners()) + 0.0  # no negative zeros
    lines = [
        "# corners of the target's tags in the world, m; point: number in Kalibr's grid",
        "# corner: 0 lower left, 1 lower right, 2 upper right, 3 upper left",
        "# tag corner point x y z",
    ]
    for tag, (points, corners) in enumerate(zip(grid.point_index().tolist(), p_world.tolist(), strict=True)):
        for k, (point, xyz) in enumerate(zip(points, corners, strict=True)):
            lines.append(f"{tag} {k} {point} " + " ".join(f"{value:.12f}" for value in xyz))
    return "\n".join([*lines, ""])
