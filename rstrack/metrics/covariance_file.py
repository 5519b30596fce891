"""Poses with their covariances as a TUM file with 21 columns more, which smfeval scores (SQUARE 0.3, gaussian_se3).

write_covariances(Path("runs/demo"), Path("demo.cov"))
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rsgen.array_types import FloatArray, IntArray
from rsgen.errors import UserError
from rsgen.files import atomic_write
from rsgen.geometry import se3
from rsgen.sequence.format import pose_rows
from rstrack.data.estimate import Estimate, read_estimate
from rstrack.metrics.consistency import Covariances, covariances, turned

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
