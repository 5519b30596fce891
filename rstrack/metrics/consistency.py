"""Whether an estimate's covariances are as large as its errors are."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rstrack.data.estimate import Estimate

# Part of the drift by which it may seem to be less later on.
_SAME = 0.02


def covariances(estimate: Estimate) -> tuple[FloatArray, FloatArray]:
    """Of each pose against its keyframe, and of the keyframe's drift (n, 6, 6) each; NaN where none is known.

    Increments [m; rad] in the depth camera's frame, from run.json's `covariance` and `drift` of the frames.
    """
    out = np.full((2, len(estimate.stamps), 6, 6), np.nan)
    at = {round(float(t), 6): n for n, t in enumerate(estimate.stamps)}
    frames: list[dict[str, Any]] = estimate.info.get("frames") or []
    for frame in frames:
        n = at.get(round(float(frame["stamp"]), 6))
        if n is not None and frame.get("covariance") is not None and frame.get("drift") is not None:
            out[:, n] = _full(frame["covariance"]), _full(frame["drift"])
    return out[0], out[1]


def step_nees(
    T_true: FloatArray, T_est: FloatArray, pose: FloatArray, drift: FloatArray, i: npt.NDArray[Any], j: npt.NDArray[Any]
) -> FloatArray:
    """Normalised errors squared (k,), over 6, of motions from poses i to j (k,): 1 in the mean if all is right.

    T_true, T_est (n, 4, 4); pose, drift (n, 6, 6): see `covariances`. Of the motion's covariance the two poses' own are
    parts, and the drift that comes in between. (Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking
    and Navigation, 2001, section 5.4.) NaN where the drift is less at the end: the track has gone back to an older
    keyframe, and what the two have in common is not known.
    """
    step = se3.inverse(T_est[i]) @ T_est[j]
    error = se3.log(se3.inverse(se3.inverse(T_true[i]) @ T_true[j]) @ step)
    Ad = se3.adjoint(se3.inverse(step))
    turned = np.swapaxes(Ad, 1, 2)
    between = drift[j] - Ad @ drift[i] @ turned
    motion = pose[j] + between + Ad @ pose[i] @ turned
    weighted = np.linalg.solve(motion, error[..., None])[..., 0]
    # Drift is given at mid readout, poses at stamps: what the camera moves by in between is no less drift.
    parts = [np.trace(c[:, at, at], axis1=1, axis2=2) for at in (slice(3), slice(3, 6)) for c in (between, drift[j])]
    is_more = (parts[0] >= -_SAME * parts[1]) & (parts[2] >= -_SAME * parts[3])
    # Less in one direction, though not in all together, leaves no covariance either.
    is_more &= np.linalg.eigvalsh(motion)[:, 0] > 0
    return np.where(is_more, np.einsum("ka,ka->k", error, weighted) / 6.0, np.nan)


def _full(upper: npt.ArrayLike) -> FloatArray:
    out = np.zeros((6, 6))
    out[np.triu_indices(6)] = upper
    return out + np.triu(out, 1).T
