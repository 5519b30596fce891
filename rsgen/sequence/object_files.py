"""Files of the things that move by themselves, in truth/objects: NAME_spline.npz, NAME.txt (TUM poses), NAME.ply."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rsgen.errors import UserError
from rsgen.geometry.spline import Spline
from rsgen.sequence.format import OBJECTS, STAMP_TOLERANCE_S


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
