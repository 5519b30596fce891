"""When the lines of an image are exposed, and their poses and derivatives as tables for the kernels."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from rsgen.array_types import FloatArray
from rsgen.device.lens import Lens
from rsgen.geometry import se3
from rsgen.geometry.so3 import hat
from rsgen.geometry.spline import Spline

# Evaluations of the spline that the poses of an image's lines are taken from: about every half of a millisecond.
_NODES = 60


@dataclass(frozen=True)
class Exposure:
    """One image's lens, stamp (s, line 0 stops being exposed) and T_cam_body (4, 4): the body is the depth camera."""

    lens: Lens
    stamp: float
    T_cam_body: FloatArray

    def times(self) -> FloatArray:
        """Mid-exposure times (lines,) in s; one for a global shutter."""
        return self.lens.shutter.line_mid_time(self.stamp, np.arange(self.lens.lines), self.lens.camera)

    def block_times(self, per_block: int) -> FloatArray:
        """Times (blocks,) of the middle of each block of lines."""
        first = np.arange(0, self.lens.lines, per_block)
        middle = 0.5 * (first + np.minimum(first + per_block, self.lens.lines) - 1)
        return self.lens.shutter.line_mid_time(self.stamp, middle, self.lens.camera)

    @property
    def first_time(self) -> float:
        """Earliest time in s at which a line is exposed."""
        return float(self.lens.shutter.line_mid_time(self.stamp, 0, self.lens.camera))

    @property
    def last_time(self) -> float:
        """Latest such time."""
        return float(self.lens.shutter.line_mid_time(self.stamp, self.lens.lines - 1, self.lens.camera))

    @property
    def mid_time(self) -> float:
        """Mid readout: the reference time of a rectified image."""
        return 0.5 * (self.first_time + self.last_time)


@lru_cache(maxsize=16)
def _line_blocks(lens: Lens) -> tuple[FloatArray, npt.NDArray[np.intp], FloatArray]:
    """Times of the blocks' middles after the stamp (s), the block of each line, and each line's time after that."""
    at_zero = Exposure(lens, 0.0, np.eye(4))
    per_node = max(1, lens.lines // _NODES)
    middle = at_zero.block_times(per_node)
    block = np.arange(lens.lines) // per_node
    return middle, block, (at_zero.times() - middle[block])[:, None]


# Of a spline's last images, as long as the spline is there: both terms ask for the same. A whole recording is mapped
# along one spline.
_REMEMBERED = 64
_motions: WeakKeyDictionary[Spline, dict[tuple[Lens, float], tuple[FloatArray, FloatArray]]] = WeakKeyDictionary()


def prepare(spline: Spline, exposures: Iterable[Exposure]) -> None:
    """Work out `line_motion` of several images at once: a call costs more than the numbers do."""
    known = _motions.setdefault(spline, {})
    new = list(dict.fromkeys((x.lens, x.stamp) for x in exposures if (x.lens, x.stamp) not in known))
    if not new:
        return
    nodes = [_line_blocks(lens) for lens, _ in new]
    times = np.concatenate([stamp + middle for (_, stamp), (middle, _, _) in zip(new, nodes, strict=True)])
    T, twist = spline.pose_and_velocity(times)
    at, rates, lines = 0, [], []
    for middle, block, _ in nodes:
        rates.append(_rate(middle, twist[at : at + len(middle)]))
        lines.append(at + block)
        at += len(middle)
    poses, twists = _moved(
        T, twist, np.concatenate(rates), np.concatenate(lines), np.concatenate([n[2] for n in nodes])
    )
    ends = np.cumsum([len(block) for block in lines])[:-1]
    for oldest in list(known)[: max(0, len(known) + len(new) - _REMEMBERED)]:
        del known[oldest]
    known.update(zip(new, zip(np.split(poses, ends), np.split(twists, ends), strict=True), strict=True))


def _rate(middle: FloatArray, twist: FloatArray) -> FloatArray:
    """Change per second (n, 6) of the twists (n, 6) of blocks with their middles at these times (n,)."""
    if len(middle) == 1:
        return np.zeros_like(twist)
    # Central differences; a block's twist and the next one's are as far apart as their times.
    slope = (twist[1:] - twist[:-1]) / (middle[1:] - middle[:-1])[:, None]
    return np.concatenate([slope[:1], 0.5 * (slope[1:] + slope[:-1]), slope[-1:]])


def _moved(
    T: FloatArray, twist: FloatArray, rate: FloatArray, block: npt.NDArray[np.intp], dt: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Poses and twists of lines that are dt (n, 1) s from the middle of their block."""
    change = rate[block] * dt
    moved = (twist[block] + 0.5 * change) * dt
    w = hat(moved[:, 3:])
    # Second order of exp: R(I + w + w²/2), and t likewise.
    out = T[block]
    R = out[:, :3, :3].copy()
    Rw = R @ w
    out[:, :3, :3] = R + Rw + 0.5 * (Rw @ w)
    v = moved[:, :3, None]
    out[:, :3, 3] += ((R + 0.5 * Rw) @ v)[..., 0]
    return out, twist[block] + change


def line_motion(spline: Spline, exposure: Exposure) -> tuple[FloatArray, FloatArray]:
    """T_world_body (lines, 4, 4) and body twist (lines, 6), from the middle of each line's block.

    With a twist that changes linearly: over the quarter of a millisecond to a block's edge that is exact to nanometres.
    (A constant one is wrong by a micrometre at 35 m/s², and its velocity moves what project_rolling finds by 1e-3 px.)
    """
    prepare(spline, [exposure])
    return _motions[spline][exposure.lens, exposure.stamp]


def to_base_table(spline: Spline, T_world_base: FloatArray, exposure: Exposure) -> FloatArray:
    """T_base_cam of each line (lines, 12): rotation row-major, translation."""
    T_world_body, _ = line_motion(spline, exposure)
    T = se3.inverse(T_world_base) @ T_world_body @ se3.inverse(exposure.T_cam_body)
    return rows_of(T)


def from_base_table(spline: Spline, T_world_base: FloatArray, exposure: Exposure) -> FloatArray:
    """T_cam_base of each line and the camera's body twist per line delay (lines, 18)."""
    T_world_body, twist = line_motion(spline, exposure)
    T = exposure.T_cam_body @ se3.inverse(T_world_body) @ T_world_base
    delay = exposure.lens.shutter.line_delay(exposure.lens.camera)
    twist_cam = delay * twist @ se3.adjoint(exposure.T_cam_body).T
    return np.concatenate([rows_of(T), twist_cam], axis=1)


def rows_of(T: FloatArray) -> FloatArray:
    """Poses (n, 4, 4) as (n, 12): rotation row-major, translation."""
    return np.concatenate([T[:, :3, :3].reshape(-1, 9), T[:, :3, 3]], axis=1)


IDENTITY_FROM_BASE = np.concatenate([np.eye(3).ravel(), np.zeros(9)])[None]
