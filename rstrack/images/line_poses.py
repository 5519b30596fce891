"""When the lines of an image are exposed, and their poses and derivatives as tables for the kernels."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Generic, TypeVar
from weakref import WeakKeyDictionary

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.device.arrays import Engine
from rsgen.device.lens import Lens
from rsgen.geometry import se3
from rsgen.geometry.so3 import hat
from rsgen.geometry.spline import Spline

# Evaluations of the spline that the poses of an image's lines are taken from: about every half of a millisecond.
_NODES = 60
# Of a spline's last images; a whole recording is mapped along one spline.
REMEMBERED = 64

Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")


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
def _line_blocks(lens: Lens) -> tuple[FloatArray, FloatArray]:
    """Times (n,) of the blocks' middles after the stamp (s), and each line's time after that (n, per block, 1).

    The last block's lines that the image does not have have its middle.
    """
    at_zero = Exposure(lens, 0.0, np.eye(4))
    per_node = max(1, lens.lines // _NODES)
    middle = at_zero.block_times(per_node)
    dt = np.zeros(len(middle) * per_node)
    dt[: lens.lines] = at_zero.times() - middle.repeat(per_node)[: lens.lines]
    return middle, dt.reshape(len(middle), per_node, 1)


@dataclass(frozen=True)
class _BlockMotion:
    """Poses T_world_body (n, 4, 4) at the blocks' middles, body twists (n, 6) there and their change per second.

    A line dt from the middle is at T exp(twist dt + ½ rate dt²), to second order in dt: exact to nanometres over the
    quarter of a millisecond to a block's edge. (A constant twist is wrong by a micrometre at 35 m/s², and its velocity
    moves what project_rolling finds by 1e-3 px.)
    """

    T: FloatArray
    twist: FloatArray
    rate: FloatArray

    def powers(self, sign: float) -> FloatArray:
        """Coefficients (3, n, 4, 4) of 1, dt and dt² in that exponential, or with sign −1 in its inverse."""
        W, dW = _algebra(self.twist), _algebra(self.rate)
        return np.stack([np.broadcast_to(np.eye(4), W.shape), sign * W, 0.5 * (W @ W + sign * dW)])


def _algebra(twist: FloatArray) -> FloatArray:
    """Twists (n, 6) as elements of se(3) (n, 4, 4)."""
    out = np.zeros((len(twist), 4, 4))
    out[:, :3, :3], out[:, :3, 3] = hat(twist[:, 3:]), twist[:, :3]
    return out


class SplineCache(Generic[Key, Value]):
    """What was worked out of a spline for its last images, as long as the spline is there: all terms ask for the same.

    Several images are worked out together, since a call costs more than the numbers do.
    """

    def __init__(self) -> None:
        self._known: WeakKeyDictionary[Spline, dict[Key, Value]] = WeakKeyDictionary()

    def of(self, spline: Spline) -> dict[Key, Value]:
        """All that are there."""
        return self._known.setdefault(spline, {})

    def add(self, spline: Spline, keys: Iterable[Key], work_out: Callable[[list[Key]], Iterable[Value]]) -> None:
        """Work out those that are not there yet, in place of the oldest."""
        known = self.of(spline)
        new = [key for key in dict.fromkeys(keys) if key not in known]
        if new:
            values = work_out(new)
            for oldest in list(known)[: max(0, len(known) + len(new) - REMEMBERED)]:
                del known[oldest]
            known.update(zip(new, values, strict=True))


_motions: SplineCache[tuple[Lens, float], _BlockMotion] = SplineCache()


def prepare(spline: Spline, exposures: Iterable[Exposure]) -> None:
    """Work out how the lines of several images move at once."""

    def work_out(new: list[tuple[Lens, float]]) -> Iterator[_BlockMotion]:
        middles = [_line_blocks(lens)[0] for lens, _ in new]
        T, twist = spline.pose_and_velocity(
            np.concatenate([stamp + middle for (_, stamp), middle in zip(new, middles, strict=True)])
        )
        ends = np.cumsum([len(middle) for middle in middles])[:-1]
        for middle, own_T, own in zip(middles, np.split(T, ends), np.split(twist, ends), strict=True):
            yield _BlockMotion(own_T, own, _rate(middle, own))

    _motions.add(spline, ((x.lens, x.stamp) for x in exposures), work_out)


def _rate(middle: FloatArray, twist: FloatArray) -> FloatArray:
    """Change per second (n, 6) of the twists (n, 6) of blocks with their middles at these times (n,)."""
    if len(middle) == 1:
        return np.zeros_like(twist)
    # Central differences; a block's twist and the next one's are as far apart as their times.
    slope = (twist[1:] - twist[:-1]) / (middle[1:] - middle[:-1])[:, None]
    return np.concatenate([slope[:1], 0.5 * (slope[1:] + slope[:-1]), slope[-1:]])


def _motion(spline: Spline, exposure: Exposure) -> _BlockMotion:
    prepare(spline, [exposure])
    return _motions.of(spline)[exposure.lens, exposure.stamp]


def _of_lines(lens: Lens, *powers: FloatArray) -> FloatArray:
    """What changes with time as Σ powers[k] dtᵏ within each block, powers (n, m) each: at every line (lines, m)."""
    _, dt = _line_blocks(lens)
    out = powers[-1][:, None]
    for power in reversed(powers[:-1]):
        out = power[:, None] + dt * out
    return out.reshape(-1, out.shape[-1])[: lens.lines]


def line_twists(spline: Spline, exposure: Exposure) -> FloatArray:
    """Body twists (lines, 6) in m/s and rad/s."""
    motion = _motion(spline, exposure)
    return _of_lines(exposure.lens, motion.twist, motion.rate)


def to_base_table(spline: Spline, T_world_base: FloatArray, exposure: Exposure) -> FloatArray:
    """T_base_cam of each line (lines, 12): rotation row-major, translation."""
    motion = _motion(spline, exposure)
    T = se3.inverse(T_world_base) @ motion.T @ motion.powers(1.0) @ se3.inverse(exposure.T_cam_body)
    return _of_lines(exposure.lens, *rows_of(T))


def from_base_table(spline: Spline, T_world_base: FloatArray, exposure: Exposure) -> FloatArray:
    """T_cam_base of each line and the camera's body twist per line delay (lines, 18)."""
    motion = _motion(spline, exposure)
    T = exposure.T_cam_body @ motion.powers(-1.0) @ (se3.inverse(motion.T) @ T_world_base)
    delay = exposure.lens.shutter.line_delay(exposure.lens.camera)
    twists = np.stack([motion.twist, motion.rate, np.zeros_like(motion.rate)])
    twists = delay * twists @ se3.adjoint(exposure.T_cam_body).T
    return _of_lines(exposure.lens, *np.concatenate([rows_of(T), twists], axis=-1))


def rows_of(T: FloatArray) -> FloatArray:
    """Poses (..., 4, 4) as (..., 12): rotation row-major, translation."""
    return np.concatenate([T[..., :3, :3].reshape(*T.shape[:-2], 9), T[..., :3, 3]], axis=-1)


IDENTITY_TO_BASE = np.append(np.eye(3).ravel(), np.zeros(3))
IDENTITY_FROM_BASE = np.concatenate([np.eye(3).ravel(), np.zeros(9)])[None]


def to_base(e: Engine, spline: Spline, T_world_base: FloatArray, exposure: Exposure | None) -> Any:
    """`to_base_table` on the device; None: of an image that is rectified to the base frame."""
    return e.upload(IDENTITY_TO_BASE if exposure is None else to_base_table(spline, T_world_base, exposure))


def from_base(e: Engine, spline: Spline, T_world_base: FloatArray, exposure: Exposure | None) -> Any:
    """`from_base_table` on the device, likewise."""
    return e.upload(IDENTITY_FROM_BASE if exposure is None else from_base_table(spline, T_world_base, exposure))
