"""Which older keyframes may see what a keyframe sees, by where a track has them and by how far it may have drifted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rsgen.array_types import FloatArray, IntArray
from rsgen.geometry import se3
from rstrack.options import Options

# Keyframes that follow each other see the same; so many later another place may come back.
_APART = 3
# Of the distance and angle at which a keyframe is left: older ones within so many times these see much the same.
_NEAR = 1.2
# Older keyframes that each is aligned to at most, and how far apart these must be in their order.
_MOST, _SPREAD = 3, 2
# How far a track may have drifted: so many σ of its own, and a part of the way and of the turning since.
_DRIFT_SIGMAS, _DRIFT_SHARE = 6.0, 0.02
AGREE = np.array([0.01, np.radians(0.5)])
"""How far the two ways of aligning a pair may differ, m at one metre and rad."""


@dataclass(frozen=True)
class KeyframeTrack:
    """Keyframes' numbers in their order (n), their poses T (n, 4, 4) in the world and the covariances (n, 6, 6) of
    these, as in `Uncertainty`."""

    order: list[int]
    T: FloatArray
    drift: FloatArray

    @cached_property
    def way(self) -> FloatArray:
        """Metres and radians (n, 2) from the first keyframe to each, along all between."""
        steps = sizes(se3.inverse(self.T[:-1]) @ self.T[1:])
        return np.cumsum(np.concatenate([np.zeros((1, 2)), steps]), axis=0)

    def older(self, n: int) -> list[int]:
        """Numbers of those so much older than the nth that they do not merely see the same still."""
        return self.order[: max(0, n - _APART + 1)]

    def allowed(self, early: IntArray, late: int) -> FloatArray:
        """Metres and radians (k, 2) by which the track may be off between the early ones (k,) and the late one."""
        Ad = se3.adjoint(se3.inverse(self.T[late]))
        own = Ad @ (self.drift[late] - self.drift[early]) @ Ad.T
        variances = np.stack([np.trace(own[:, at, at], axis1=1, axis2=2) for at in (slice(3), slice(3, 6))], axis=1)
        return np.asarray(
            _DRIFT_SIGMAS * np.sqrt(np.abs(variances)) + _DRIFT_SHARE * (self.way[late] - self.way[early]) + AGREE
        )


@dataclass(frozen=True)
class Candidate:
    """A keyframe by its frame's number, and T_early_late (4, 4) as the track has it, up to metres and radians (2,)."""

    early: int
    T_early_late: FloatArray
    allowed: FloatArray


def candidates(track: KeyframeTrack, n: int, alike: Sequence[int], options: Options) -> list[Candidate]:
    """Older keyframes that may see what the nth of a track sees, the most promising first.

    alike: of the older ones those that look like it, the best first.
    """
    rank = {k: at for at, k in enumerate(alike)}
    early = np.array([m for m, k in enumerate(track.older(n)) if k in rank], int)
    if not len(early):
        return []
    T_early_late = se3.inverse(track.T[early]) @ track.T[n]
    remote, allowed = options.remoteness_of_each(T_early_late), track.allowed(early, n)
    off = np.zeros((len(early), 6))
    off[:, 0], off[:, 5] = allowed[:, 0], np.minimum(allowed[:, 1], 1.0)
    # As near as the drift may have hidden.
    hidden = options.remoteness_of_each(se3.exp(off))
    is_first = np.array([rank[track.order[m]] < _MOST for m in early])
    may_be = (remote < _NEAR) | (is_first & (remote < _NEAR + hidden))
    chosen: list[int] = []
    for c in np.lexsort((early, remote)):
        if may_be[c] and len(chosen) < _MOST and all(abs(early[c] - early[other]) >= _SPREAD for other in chosen):
            chosen.append(int(c))
    return [Candidate(track.order[early[c]], T_early_late[c], allowed[c]) for c in chosen]


def sizes(T: FloatArray) -> FloatArray:
    """Metres and radians (..., 2) of motions (..., 4, 4)."""
    return np.asarray(np.linalg.norm(se3.log(T).reshape(*T.shape[:-2], 2, 3), axis=-1))
