"""What the truth's poses are poses of: a body fixed to the camera, where calibration was to make it the camera itself.

fit = fit_extrinsics(truth, estimate)
metrics = evaluate(mounted(truth, fit.T_body_camera), estimate)

Hand-eye calibration, A X = X B of the motions A of the body and B of the camera: Park, Martin, Robot Sensor
Calibration: Solving AX = XB on the Euclidean Group (IEEE T-RA 10(5), 1994). A camera with wrong intrinsics moves as if
it were elsewhere too: what is found is where the truth fits the estimate best, whoever of the two is wrong.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rsgen.geometry import se3, so3
from rsgen.geometry.spline import Spline
from rsgen.sequence.trajectory import Trajectory
from rstrack.data.estimate import Estimate
from rstrack.metrics.association import Truth, true_poses
from rstrack.metrics.clock import LEAST_PAIRS, resampled_blocks
from rstrack.metrics.evaluate import pairs_one_second_apart

TruthExtrinsics = Literal["auto"]

# Motions of one second must turn the camera this much, degrees RMS, about every axis that the fit needs.
_LEAST_TURN_DEG = 2.0
_ROUNDS = 4
# Scales of residuals that do not differ from zero, m and rad.
_EXACT = 1e-9


@dataclass(frozen=True)
class ExtrinsicsFit:
    """Rigid transform on the right of the truth's poses that fits an estimate best.

    T_body_camera: (4, 4) the estimate's camera to the truth's body. sigma_m, sigma_deg: (3,) standard deviations of the
    translation and of the rotation vector, about the body's axes, from a block bootstrap over the recording's time.
    """

    T_body_camera: FloatArray
    sigma_m: FloatArray
    sigma_deg: FloatArray

    @property
    def translation_m(self) -> FloatArray:
        """(3,) where the camera lies in the body's frame."""
        return np.asarray(self.T_body_camera[:3, 3])

    @property
    def rotation_deg(self) -> FloatArray:
        """(3,) rotation vector of the camera in the body's frame."""
        return np.degrees(so3.log(self.T_body_camera[:3, :3]))

    def text(self) -> str:
        """On one line."""
        moved = _triple(1e3 * self.translation_m, 1e3 * self.sigma_m)
        return f"the truth's camera moved by {moved} mm and {_triple(self.rotation_deg, self.sigma_deg)} deg"

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers for JSON."""
        numbers = dataclasses.asdict(self) | {"translation_m": self.translation_m, "rotation_deg": self.rotation_deg}
        return {name: value.tolist() for name, value in numbers.items()}


def mounted(truth: Truth, T_body_camera: FloatArray) -> Truth:
    """The truth of a camera that lies at T_body_camera (4, 4) in the frame whose poses the truth has."""
    motion: Spline | Trajectory
    if isinstance(truth.motion, Spline):
        # Exact at all times: the twists between control points are those of the same motion, seen from elsewhere.
        motion = Spline(truth.motion.control_points @ T_body_camera, truth.motion.t0, truth.motion.dt)
    else:
        motion = Trajectory(truth.motion.stamps, truth.motion.T_world_cam @ T_body_camera)
    return dataclasses.replace(truth, motion=motion)


def fit_extrinsics(truth: Truth, estimate: Estimate) -> ExtrinsicsFit:
    """Find the transform on the right of the truth's poses with which the motions over one second agree best.

    Least squares over the pairs of `evaluate`'s RPE, translations and rotations each in units of their own remaining
    RMS; as relative motions they know no alignment, and errors that add up along the track count only as fast as they
    arise. Begins at the closed form of Park and Martin, so that a body turned by any angle is found.

    Standard deviations: of 200 solutions, linearised, over blocks of 2 s drawn with replacement.

    Raises UserError: too few poses, or a motion that turns about fewer than two axes, which leaves a translation open.
    """
    index, T_true = true_poses(truth.motion, estimate.stamps, truth.interpolate)
    stamps, T_est = estimate.stamps[index], estimate.T_world_depth[index]
    i, j = pairs_one_second_apart(stamps)
    if len(i) < LEAST_PAIRS:
        raise UserError(
            f"estimate: {len(i)} pairs of poses one second apart have a truth, its extrinsics need {LEAST_PAIRS}"
        )
    body, camera = (se3.inverse(T[i]) @ T[j] for T in (T_true, T_est))
    _refuse_few_turns(body)
    R, p = _closed_form(body, camera)

    def residuals(x: FloatArray) -> FloatArray:
        X = _rigid(so3.exp(x[3:]) @ R, p + x[:3])
        return np.asarray(se3.log(se3.inverse(se3.inverse(X) @ body @ X) @ camera) / scale).ravel()

    x, scale = np.zeros(6), np.ones(6)
    for _ in range(_ROUNDS):
        rest = residuals(x).reshape(-1, 6) * scale
        scale = np.repeat([_size(rest[:, :3]), _size(rest[:, 3:])], 3)
        solution = least_squares(residuals, x, x_scale=np.repeat([1.0, 0.1], 3))
        x = solution.x
    J = np.asarray(solution.jac, np.float64).reshape(-1, 6, 6)
    H, g = np.einsum("nki,nkj->nij", J, J), np.einsum("nki,nk->ni", J, residuals(x).reshape(-1, 6))
    errors = np.stack([-np.linalg.solve(H[k].sum(0), g[k].sum(0)) for k in resampled_blocks(stamps[i])])
    sigma = errors.std(axis=0)
    return ExtrinsicsFit(_rigid(so3.exp(x[3:]) @ R, p + x[:3]), sigma[:3], np.degrees(sigma[3:]))


# ---------------------------------------------------------------------------------------------------------------------


def _refuse_few_turns(body: FloatArray) -> None:
    """Raises UserError if the motions (n, 4, 4) leave one of the extrinsics open."""
    turn = so3.log(body[:, :3, :3])
    spread = np.degrees(np.sqrt(np.maximum(np.linalg.eigvalsh(turn.T @ turn / len(turn)), 0.0)))
    if spread[1] < _LEAST_TURN_DEG:
        what = "along the axis of the turns" if spread[2] >= _LEAST_TURN_DEG else "altogether"
        raise UserError(
            f"truth: the motion leaves its extrinsics open, the translation {what}: within a second it turns by "
            f"{spread[2]:.1f}, {spread[1]:.1f} and {spread[0]:.1f} deg RMS about its three axes, two need "
            f"{_LEAST_TURN_DEG:g}"
        )


def _closed_form(body: FloatArray, camera: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotation (3, 3) and translation (3,) of X in A X = X B, motions A and B (n, 4, 4) of body and camera."""
    # R_X turns the camera's axes of rotation onto the body's.
    R = Rotation.align_vectors(so3.log(body[:, :3, :3]), so3.log(camera[:, :3, :3]))[0].as_matrix()
    A = (body[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    b = (camera[:, :3, 3] @ R.T - body[:, :3, 3]).ravel()
    return R, np.asarray(np.linalg.lstsq(A, b, rcond=None)[0])


def _rigid(R: FloatArray, p: FloatArray) -> FloatArray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, p
    return T


def _size(rest: FloatArray) -> float:
    return max(float(np.sqrt(np.mean(rest**2))), _EXACT)


def _triple(values: FloatArray, sigmas: FloatArray) -> str:
    return f"({', '.join(f'{v:.1f} ± {s:.1f}' for v, s in zip(values, sigmas, strict=True))})"
