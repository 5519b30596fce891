"""Labels on disk: the table of a sequence's things, and their boxes in every frame.

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

from rsgen.array_types import FloatArray
from rsgen.errors import UserError, first_problem
from rsgen.files import read_yaml

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
