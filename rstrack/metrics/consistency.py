"""Whether an estimate's covariances are as large as its errors are, over motions of a tenth of a second to five.

And the file of poses and covariances that smfeval scores.

C = motion_covariance(estimate.T_world_depth, covariances(estimate), i, j)
horizon = horizon_of(1.0, motion_errors(T_true, estimate.T_world_depth, i, j), C)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri

from rsgen.array_types import FloatArray, IntArray
from rsgen.console.tables import Table, fixed
from rsgen.errors import UserError
from rsgen.files import atomic_write
from rsgen.geometry import se3
from rsgen.sequence.format import pose_rows
from rstrack.data.estimate import INFO, Estimate, read_estimate

HORIZONS_S = (0.1, 1.0, 5.0)
AXES = ("x", "y", "z", "rx", "ry", "rz")
LEVELS = (50, 90, 99)
"""Regions and intervals by the part of the errors that should lie within, per cent."""

# Part of the drift that rounding may be.
_ROUNDING = 1e-9

# The truth is T_world_depth exp(ξ), ξ = [m; rad] in the depth camera's frame, and the world is whatever fits best.
_HEADER = """\
#%FORMAT SQUARE/0.3
#%REPRESENTATION gaussian_se3
#%POSE_FRAME world
#%BODY_FRAME depth
#%GAUGE se3
#%TIMESTAMP_UNIT seconds
#%ALGORITHM rstrack
#%ALGORITHM_VERSION {version}
#%TANGENT_CONVENTION right_perturbation
#%TANGENT_ORDER translation_rotation
#%ROTATION_PARAM axis_angle
# stamp tx ty tz qx qy qz qw c11 c21 c22 c31 c32 c33 c41 ... c66
"""


@dataclass(frozen=True, eq=False)
class Covariances:
    """What is known of the errors of n poses; increments [m; rad] in the depth camera's frame, T_world_depth exp(ξ).

    pose: (n, 6, 6) of a pose against its keyframe. drift_world: (n, 6, 6) of the keyframe against the first frame, in
    the world: exp(ξ) T_world_depth. NaN where they are not known. common: (n, 6, m) by how much m standard normals, the
    same ones for all poses, move each: the errors of the camera's calibration; 0 where they are not known.
    """

    pose: FloatArray
    drift_world: FloatArray
    common: FloatArray

    def at(self, index: npt.NDArray[Any]) -> Covariances:
        """Those of some poses, by index or mask."""
        return Covariances(self.pose[index], self.drift_world[index], self.common[index])


def covariances(estimate: Estimate) -> Covariances:
    """Those of the frames in run.json. Raises UserError: they are malformed."""
    pose, drift = np.full((2, len(estimate.stamps), 6, 6), np.nan)
    shared: dict[int, FloatArray] = {}
    at = {round(float(t), 6): n for n, t in enumerate(estimate.stamps)}
    frames: list[dict[str, Any]] = estimate.info.get("frames") or []
    try:
        for frame in frames:
            n = at.get(round(float(frame["stamp"]), 6))
            if n is not None and frame.get("covariance") is not None and frame.get("drift_world") is not None:
                pose[n], drift[n] = _full(frame["covariance"]), _full(frame["drift_world"])
                if frame.get("common") is not None:
                    shared[n] = _rows(frame["common"])
        common = np.zeros((len(pose), 6, max((rows.shape[1] for rows in shared.values()), default=0)))
        if shared:
            common[list(shared)] = np.stack([*shared.values()])
    except (AttributeError, KeyError, TypeError, ValueError):
        raise UserError(
            f"estimate: covariance and drift_world of the frames in {INFO} must be 21 numbers each, common six rows as "
            "long as in all other frames: run the tracker again"
        ) from None
    return Covariances(pose, drift, common)


def motion_covariance(
    T_world_depth: FloatArray, known: Covariances, i: npt.NDArray[Any], j: npt.NDArray[Any]
) -> FloatArray:
    """Covariances (k, 6, 6) of the motions T_i⁻¹ T_j between poses i and j (k,) of (n, 4, 4).

    Increments [m; rad] in the frame of pose j. The covariance is the sum of the two poses' own, of the drift between
    their keyframes, and of what errors of the calibration change of the one pose and not of the other. NaN where
    nothing is known of one of the poses, and where neither keyframe was found by way of the other: what the drifts of
    the two have in common is not known then.
    """
    out = np.full((len(i), 6, 6), np.nan)
    both = np.flatnonzero(np.isfinite(known.pose[i] + known.pose[j]).all(axis=(1, 2)))
    i, j = i[both], j[both]
    grown = known.drift_world[j] - known.drift_world[i]
    spread, noise = np.linalg.eigvalsh(grown), _ROUNDING * np.trace(known.drift_world[i], axis1=1, axis2=2)
    is_later, is_earlier = spread[:, 0] >= -noise, spread[:, -1] <= noise
    between = np.where(is_later[:, None, None], grown, -grown)
    from_world, Ad = (se3.adjoint(se3.inverse(T_world_depth[j]) @ T) for T in (np.eye(4), T_world_depth[i]))
    common = known.common[j] - Ad @ known.common[i]
    total = turned(from_world, between) + known.pose[j] + turned(Ad, known.pose[i]) + common @ np.swapaxes(common, 1, 2)
    is_known = is_later | is_earlier
    out[both[is_known]] = total[is_known]
    return out


def turned(A: FloatArray, covariance: FloatArray) -> FloatArray:
    """Covariances (n, 6, 6) of A ξ (n, 6, 6)."""
    return np.asarray(A @ covariance @ np.swapaxes(A, 1, 2))


def motion_errors(
    T_true: FloatArray, T_est: FloatArray, i: npt.NDArray[Any], j: npt.NDArray[Any]
) -> FloatArray:  # fmt: skip
    """Errors (k, 6), [m; rad], of the estimated motions between poses i and j (k,): true motion exp(ξ) = estimate."""
    true = se3.inverse(T_true[i]) @ T_true[j]
    return se3.log(se3.inverse(true) @ se3.inverse(T_est[i]) @ T_est[j])


def step_nees(errors: FloatArray, covariance: FloatArray) -> FloatArray:
    """Errors squared (k,), normalised and over 6, of errors (k, 6): 1 in the mean if their covariances are right.

    (Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 5.4.)
    """
    weighted = np.linalg.solve(covariance, errors[..., None])[..., 0]
    return np.asarray(np.einsum("ka,ka->k", errors, weighted) / 6.0)


@dataclass(frozen=True)
class Horizon:
    """Errors of motions over some seconds beside their covariances.

    pairs: motions whose covariances are known. nees: mean of `step_nees`, 1 if the covariances are right. within: part
    of the errors within the covariances' regions, by their `LEVELS`, per cent; axes: the same of each axis alone, by
    its name in `AXES`: along and about the depth camera's own.
    """

    seconds: float
    pairs: int
    nees: float
    within: dict[int, float]
    axes: dict[str, dict[int, float]]


def horizon_of(seconds: float, errors: FloatArray, covariance: FloatArray) -> Horizon | None:
    """Compare errors (k, 6) with covariances (k, 6, 6); None where no covariance is known (NaN)."""
    known = np.isfinite(covariance).all(axis=(1, 2))
    if not known.any():
        return None
    errors, covariance = errors[known], covariance[known]
    nees = step_nees(errors, covariance)
    squares = errors**2 / np.diagonal(covariance, axis1=1, axis2=2)
    axes = {name: _within(squares[:, a], 1) for a, name in enumerate(AXES)}
    return Horizon(seconds, len(nees), float(nees.mean()), _within(6.0 * nees, 6), axes)


def consistency_table(horizons: Sequence[Horizon]) -> Table:
    """A row a horizon, and one for each axis over one second."""

    def row(name: str, pairs: str, nees: str, within: dict[int, float]) -> tuple[str, ...]:
        return name, pairs, nees, *(fixed(within[level], 1, 100.0) for level in LEVELS)

    rows = [row(f"{h.seconds:g} s", str(h.pairs), fixed(h.nees, 2), h.within) for h in horizons]
    rows += [row(f"{h.seconds:g} s, {a}", "", "", h.axes[a]) for h in horizons if h.seconds == 1.0 for a in AXES]
    head = ("motions over", "pairs", "NEES/6", *(f"in {level} %" for level in LEVELS))
    return Table(head, tuple(rows), "NEES, and per cent of the truths within the covariances' regions")


@dataclass(frozen=True)
class TruthNoise:
    """Errors of the truth's own motions over one second: σ along and about each of the camera's axes, mm and degrees.

    Motion capture errs by millimetres within a second. σ grows as the square root of the time.
    """

    translation_mm: float
    rotation_deg: float

    @classmethod
    def parse(cls, text: str) -> TruthNoise:
        """The noise that 'MM,DEG' names. Raises UserError."""
        try:
            mm, deg = (float(word) for word in text.split(","))
        except ValueError:
            mm = deg = math.nan
        if not (0.0 <= mm < math.inf and 0.0 <= deg < math.inf):
            raise UserError(f"--truth-noise {text}: expected MM,DEG, two numbers of at least 0, for example 2,0.25")
        return cls(mm, deg)

    def covariance(self, seconds: FloatArray) -> FloatArray:
        """Covariances (k, 6, 6), [m; rad], of the truth's motions over so many seconds (k,)."""
        sigma = np.repeat([1e-3 * self.translation_mm, np.radians(self.rotation_deg)], 3)
        return np.asarray(seconds[:, None, None] * np.diag(sigma**2))


def write_covariances(run: Path, out: Path) -> int:
    """Write the poses of a run whose covariances are known; returns their number. Raises UserError: there are none."""
    estimate = read_estimate(run)
    known = covariances(estimate)
    index = np.flatnonzero(np.isfinite(known.pose).all(axis=(1, 2)))
    if not len(index):
        raise UserError(f"{run}: has no covariances of poses: give a run of one of the rs or gs methods")
    atomic_write(out, covariance_text(estimate, known, index).encode())
    return len(index)


def covariance_text(estimate: Estimate, known: Covariances, index: IntArray) -> str:
    """The file for the poses `index` (k,): stamp, pose, and the lower triangle of the covariance row by row."""
    T = estimate.T_world_depth[index]
    lower = against_first(T, known.at(index))[:, *np.tril_indices(6)]
    lines = [
        f"{stamp:.9f} " + " ".join(f"{v:.12f}" for v in row) + " " + " ".join(f"{v:.9g}" for v in entries)
        for stamp, row, entries in zip(estimate.stamps[index], pose_rows(T), lower, strict=True)
    ]
    version = (estimate.info.get("versions") or {}).get("rstrack", "unknown")
    return _HEADER.format(version=version) + "\n".join(lines) + "\n"


def against_first(T_world_depth: FloatArray, known: Covariances) -> FloatArray:
    """Covariances (n, 6, 6) of poses (n, 4, 4) against the first of them, increments [m; rad] on their right.

    Errors of the calibration count as far as they change a pose otherwise than the first one.
    """
    from_world, Ad = (se3.adjoint(se3.inverse(T_world_depth) @ T) for T in (np.eye(4), T_world_depth[0]))
    common = known.common - Ad @ known.common[0]
    drift = turned(from_world, known.drift_world)
    return np.asarray(known.pose + drift + common @ np.swapaxes(common, 1, 2))


# ---------------------------------------------------------------------------------------------------------------------


def _within(squares: FloatArray, freedoms: int) -> dict[int, float]:
    return {level: float((squares <= chdtri(freedoms, 1.0 - level / 100.0)).mean()) for level in LEVELS}


def _full(upper: npt.ArrayLike) -> FloatArray:
    out = np.zeros((6, 6))
    out[np.triu_indices(6)] = upper
    return out + np.triu(out, 1).T


def _rows(six: npt.ArrayLike) -> FloatArray:
    out = np.asarray(six, np.float64)
    if out.ndim != 2 or len(out) != 6:
        raise ValueError
    return out
