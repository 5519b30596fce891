"""Things that move by themselves, for the checks: a camera's motion relative to one, and the files that tell of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rsgen.files import read_text
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.sequence.format import ground_truth, pose_lines
from rsgen.sequence.object_files import poses_file
from rsgen.sequence.reader import Sequence


@dataclass(frozen=True, eq=False)
class RelativeMotion:
    """T_object_body(t) of a body and a thing along splines; `project_rolling` takes it in the place of a spline."""

    body: Spline
    thing: Spline

    @property
    def t_begin(self) -> float:
        """First time at which both are known, s."""
        return max(self.body.t_begin, self.thing.t_begin)

    @property
    def t_end(self) -> float:
        """Last time at which both are known, s."""
        return min(self.body.t_end, self.thing.t_end)

    def pose(self, t: FloatArray) -> FloatArray:
        """T_object_body (..., 4, 4) at times (...,) s."""
        return np.asarray(se3.inverse(self.thing.pose(t)) @ self.body.pose(t))

    def pose_and_velocity(self, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """`pose`, and the body's twist (..., 6) against the thing in the body's frame, m/s and rad/s."""
        T_world_body, w_body = self.body.pose_and_velocity(t)
        T_world_object, w_object = self.thing.pose_and_velocity(t)
        T_object_body = se3.inverse(T_world_object) @ T_world_body
        back = se3.adjoint(se3.inverse(T_object_body))
        return T_object_body, w_body - np.einsum("...ij,...j->...i", back, w_object)


def check_objects(sequence: Sequence) -> tuple[bool, str]:
    """Poses of all objects are what their splines give, and every exact image has a mask that decodes.

    Raises UserError.
    """
    stamps = [stream.stamps for stream in sequence.streams.values()]
    for thing in sequence.objects:
        path = sequence.root / poses_file(thing.name)
        try:
            found = np.loadtxt(read_text(path).splitlines(), ndmin=2)
        except ValueError:
            raise UserError(f"{path}: expected lines of 8 numbers 'stamp tx ty tz qx qy qz qw'") from None
        expected = np.loadtxt(pose_lines("", ground_truth(thing.spline, *stamps)), ndmin=2)
        at = np.isin(found[:, 0], expected[:, 0]) if found.ndim == 2 and found.shape[1] == 8 else np.zeros(1, bool)
        if at.sum() != len(expected) or np.abs(found[at] - expected).max() > 1e-9:
            return False, f"{path}: is not what the object's spline gives: render again to write it"
    seen = [
        np.bincount(np.concatenate([sequence.object_ids(name, k).ravel() for k in range(len(stream.paths))]),
                    minlength=len(sequence.objects) + 1)
        for name, stream in sequence.streams.items()
    ]  # fmt: skip
    share = [100 * (1 - count[0] / max(count.sum(), 1)) for count in seen]
    names = ", ".join(thing.name for thing in sequence.objects)
    return True, f"{names}: {share[0]:.1f} % of colour's pixels, {share[1]:.1f} % of depth's"
