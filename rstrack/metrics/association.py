"""Which estimated pose belongs to which true one, and the rigid motion that brings the two trajectories together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from rsgen.array_types import FloatArray, IntArray
from rsgen.errors import UserError
from rsgen.geometry import se3, so3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.spline import Spline
from rsgen.sequence.format import STAMP_TOLERANCE_S, associate
from rsgen.sequence.trajectory import Trajectory
from rstrack.data.estimate import Estimate
from rstrack.metrics.consistency import TruthNoise

if TYPE_CHECKING:
    from rstrack.data.dataset import Dataset


ASSOCIATE_WITHIN_S = 0.02
"""Stamps at most so far apart belong together: the default of TUM's associate.py."""

_MIN_POSES = 3
# Variance along the second principal axis, relative to the first, under which positions lie on a line; along the first,
# m², under which they are one point.
_LINE, _POINT = 1e-9, 1e-12


@dataclass(frozen=True)
class Truth:
    """What an estimate is compared with.

    motion: T_world_depth(t), or poses. frame_stamps: (n,) seconds, the sequence's depth frames; none where the truth is
    a mere file of poses. camera, shutter: of the depth stream, for errors by line. interpolate: poses are interpolated
    on SE(3) where one of them is within 0.02 s of a stamp; else the nearest is taken, as TUM's associate.py does.
    noise: how far off the truth's own motions are, which counts where covariances are compared with errors.
    """

    motion: Spline | Trajectory
    frame_stamps: FloatArray
    camera: Camera | None = None
    shutter: Shutter | None = None
    interpolate: bool = False
    noise: TruthNoise | None = None

    @property
    def line_times(self) -> FloatArray:
        """Mid-exposures (n,) in s of all lines of all depth images."""
        if self.camera is None or self.shutter is None:
            return np.empty(0)
        lines = np.arange(self.shutter.line_count(self.camera))
        return self.shutter.line_mid_time(self.frame_stamps[:, None], lines, self.camera).ravel()


def truth_of(dataset: Dataset) -> Truth | None:
    """A dataset's truth, None if it has none: its spline, else the poses of its groundtruth.txt."""
    motion = dataset.truth if dataset.truth is not None else dataset.truth_poses
    if motion is None:
        return None
    camera, shutter = dataset.rig.depth_camera, dataset.rig.depth_shutter
    if dataset.sequence is not None:
        true = dataset.sequence.as_taken.streams["depth"]
        camera, shutter = true.camera, true.shutter
    return Truth(motion, dataset.stamps, camera, shutter)


@dataclass(frozen=True)
class Comparison:
    """Poses of the estimate that have a true counterpart, k of them.

    index: (k,) rows of the estimate. T_world_true, T_world_est: (k, 4, 4), the latter aligned: T_true_est (4, 4) times
    the estimate. is_determined: False if the positions alone left the alignment's rotation open.
    """

    index: IntArray
    T_world_true: FloatArray
    T_world_est: FloatArray
    T_true_est: FloatArray
    is_determined: bool

    @property
    def position_errors_m(self) -> FloatArray:
        """(k,) distances after alignment."""
        return np.asarray(np.linalg.norm(self.T_world_est[:, :3, 3] - self.T_world_true[:, :3, 3], axis=1))

    @property
    def rotation_errors_deg(self) -> FloatArray:
        """(k,) angles after alignment."""
        return angles_deg(self.T_world_true, self.T_world_est)


def compare(truth: Truth, estimate: Estimate) -> Comparison:
    """Associate and align, as `evaluate` does. Raises UserError if fewer than three poses have a true counterpart."""
    index, T_true = true_poses(truth.motion, estimate.stamps, truth.interpolate)
    if len(index) < _MIN_POSES:
        begin, end = _span(truth.motion)
        raise UserError(
            f"estimate: {len(index)} of {len(estimate.stamps)} poses have a true one at their stamp, at least "
            f"{_MIN_POSES} are needed: the truth covers {begin:.3f} to {end:.3f} s; are the clocks the same?"
        )
    T_est = estimate.T_world_depth[index]
    T_true_est, is_determined = align(T_true, T_est)
    return Comparison(index, T_true, T_true_est @ T_est, T_true_est, is_determined)


def align(T_world_true: FloatArray, T_world_est: FloatArray) -> tuple[FloatArray, bool]:
    """T_true_est (4, 4) that moves estimated positions closest to the true ones, and whether they determine it.

    Poses (k, 4, 4). Least squares without scale, closed form: Umeyama, PAMI 13(4), 1991 (SciPy's). Where
    positions lie on a line or in one point, the rotation that they leave open is that which brings the orientations
    closest (chordal distance), so that rotation errors mean something there too.
    """
    p_true, p_est = T_world_true[:, :3, 3], T_world_est[:, :3, 3]
    mean_true, mean_est = p_true.mean(axis=0), p_est.mean(axis=0)
    U, s, Vt = np.linalg.svd((p_true - mean_true).T @ (p_est - mean_est) / len(p_true))
    is_determined = bool(s[1] > _LINE * s[0] and s[0] > _POINT)
    if is_determined:
        turn, _ = Rotation.align_vectors(p_true - mean_true, p_est - mean_est)
    else:
        axes_true, axes_est = (np.swapaxes(T[:, :3, :3], 1, 2).reshape(-1, 3) for T in (T_world_true, T_world_est))
        weights = np.ones(len(axes_true))
        if s[0] > _POINT:
            # One line onto the other exactly; the axes decide the spin about it.
            axes_true, axes_est = np.vstack([U[:, 0], axes_true]), np.vstack([Vt[0], axes_est])
            weights = np.append(np.inf, weights)
        turn, _ = Rotation.align_vectors(axes_true, axes_est, weights)
    T = np.eye(4)
    T[:3, :3] = R = turn.as_matrix()
    T[:3, 3] = mean_true - R @ mean_est
    return T, is_determined


def nearest(stamps: FloatArray, t: FloatArray) -> IntArray:
    """Index (n,) of the stamp nearest to each time (n,), the earlier of two; stamps increase, one at least."""
    after = np.clip(np.searchsorted(stamps, t), 0, len(stamps) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(stamps[before] - t) <= np.abs(stamps[after] - t), before, after).astype(np.int64)


def angles_deg(T_a: FloatArray, T_b: FloatArray) -> FloatArray:
    """Angles (n,) between the rotations of poses (n, 4, 4), degrees."""
    R = np.swapaxes(T_a[:, :3, :3], 1, 2) @ T_b[:, :3, :3]
    return np.asarray(np.degrees(np.linalg.norm(so3.log(R), axis=-1)))


def true_poses(motion: Spline | Trajectory, stamps: FloatArray, interpolate: bool) -> tuple[IntArray, FloatArray]:
    """Indices (k,) of the stamps (n,) that have a true pose, and those poses (k, 4, 4); see `Truth.interpolate`."""
    if isinstance(motion, Spline):
        # Stamps are rounded in files: that must not push the first or last one out.
        inside = np.clip(stamps, motion.t_begin, motion.t_end)
        index = np.flatnonzero(np.abs(inside - stamps) <= STAMP_TOLERANCE_S)
        return index, motion.pose(inside[index])
    if not interpolate:
        pairs = np.array(associate(stamps, motion.stamps, ASSOCIATE_WITHIN_S), np.int64).reshape(-1, 2)
        return pairs[:, 0], motion.T_world_cam[pairs[:, 1]]
    if len(motion) < 2:
        return np.empty(0, np.int64), np.empty((0, 4, 4))
    near = np.abs(motion.stamps[nearest(motion.stamps, stamps)] - stamps) <= ASSOCIATE_WITHIN_S
    index = np.flatnonzero(near & (stamps >= motion.stamps[0]) & (stamps <= motion.stamps[-1]))
    return index, se3.interpolated(motion.stamps, motion.T_world_cam, stamps[index])


def _span(motion: Spline | Trajectory) -> tuple[float, float]:
    if isinstance(motion, Spline):
        return motion.t_begin, motion.t_end
    return float(motion.stamps[0]), float(motion.stamps[-1])
