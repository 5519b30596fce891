"""Text files of truth/ beside the images: frame tables, moving objects, a target's corners, labels and their boxes.

truth/labels.yaml      id, name, class, class_id, triangles, box (two corners, world, m; of what moves in its own frame)
truth/boxes_STREAM.csv frame,id,x0,y0,x1,y1,pixels: whole pixels, the last ones included
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError
from scipy import ndimage

from rsgen.array_types import FloatArray, IntArray
from rsgen.errors import UserError, first_problem
from rsgen.files import read_text, read_yaml
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


LABELS = "truth/labels.yaml"
MOST_LABELS = 65535
BOXES_HEAD = "frame,id,x0,y0,x1,y1,pixels"


@dataclass(frozen=True)
class Thing:
    """Before it is written: its name, how many triangles it has, and their corners (2, 3), lowest and highest, m."""

    name: str
    triangles: int
    box: FloatArray


def thing_of(name: str, triangles: FloatArray) -> Thing:
    """The thing of that name with these triangles' corners (m, 3, 3)."""
    points = triangles.reshape(-1, 3)
    return Thing(name, len(triangles), np.stack([points.min(axis=0), points.max(axis=0)]))


class Label(BaseModel):
    """One thing of a table. box: lowest and highest corner, m, world frame; of what moves by itself its own frame."""

    model_config = ConfigDict(extra="ignore", frozen=True, populate_by_name=True)
    id: int = Field(ge=1, le=MOST_LABELS)
    name: str
    class_name: str = Field(alias="class")
    class_id: int = Field(ge=1)
    triangles: int = Field(ge=0)
    box: tuple[tuple[float, float, float], tuple[float, float, float]]


def class_of(name: str, classes: Mapping[str, Sequence[str]]) -> str:
    """The class of a thing: the first whose patterns match its name, else the name without number and letter behind."""
    for of, patterns in classes.items():
        if any(fnmatchcase(name, pattern) for pattern in patterns):
            return of
    return re.sub(r"([ _.-]*(\d+|\b[a-z]))+$", "", name.replace("_", " ")).strip() or name


def labels_yaml(things: Sequence[Thing], classes: Mapping[str, Sequence[str]]) -> dict[str, Any]:
    """Content of LABELS; ids are the things' numbers from 1 on. Raises UserError: there are too many."""
    if len(things) > MOST_LABELS:
        raise UserError(f"truth.labels: {len(things)} things are more than 16 bits have, {MOST_LABELS}: merge shapes")
    of = [class_of(thing.name, classes) for thing in things]
    numbers = {name: k for k, name in enumerate(sorted(set(of)), 1)}
    return {
        "labels": [
            {"id": k, "name": thing.name, "class": name, "class_id": numbers[name], "triangles": thing.triangles,
             "box": np.round(thing.box, 6).tolist()}
            for k, (thing, name) in enumerate(zip(things, of, strict=True), 1)
        ]
    }  # fmt: skip


def read_labels(path: Path) -> tuple[Label, ...]:
    """The table in the file. Raises UserError."""
    try:
        found = TypeAdapter(tuple[Label, ...]).validate_python(read_yaml(path).get("labels"))
    except ValidationError as error:
        raise UserError(f"{path}: {first_problem(error)}: render again to write it") from None
    if [label.id for label in found] != list(range(1, len(found) + 1)):
        raise UserError(f"{path}: ids do not count from 1: render again to write it")
    return found


def boxes_text(frames: Iterable[tuple[int, NDArray[np.uint16]]]) -> str:
    """Boxes of what is seen in each frame (number, labels (h, w)), a line a thing."""
    lines = [BOXES_HEAD]
    for frame, labels in frames:
        pixels = np.bincount(labels.ravel())
        for number, place in enumerate(ndimage.find_objects(labels), 1):
            if place is not None:
                y, x = place
                box = f"{x.start},{y.start},{x.stop - 1},{y.stop - 1}"
                lines.append(f"{frame},{number},{box},{pixels[number]}")
    return "\n".join([*lines, ""])
