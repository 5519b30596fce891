"""How far an estimate is from the truth: ATE, drift per second, and the error of every line's pose.

metrics = evaluate(truth_of(dataset), read_estimate(Path("runs/lr_kt2")))
print(metrics.text())
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray, IntArray
from rsgen.console.tables import Table, fixed
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rsgen.sequence.format import associate
from rsgen.sequence.trajectory import Trajectory
from rstrack.data.estimate import Estimate, plain, read_estimate
from rstrack.metrics.association import (
    ASSOCIATE_WITHIN_S,
    Comparison,
    Truth,
    angles_deg,
    compare,
    nearest,
)
from rstrack.metrics.consistency import (
    HORIZONS_S,
    Horizon,
    TruthNoise,
    consistency_table,
    covariances,
    horizon_of,
    motion_covariance,
    motion_errors,
)

_PAIR_WITHIN_S = 0.1
# Stamps rounded to TUM's four digits still are one second apart.
_STAMP_ROUNDING_S = 1e-3
_SHUTTERS = {"rs": "the rolling-shutter model", "gs": "taking the shutter for a global one"}


@dataclass(frozen=True)
class Metrics:
    """Errors of one estimate; None where there are none (`notes` has the reason).

    frames, frames_tracked: of the sequence, and those with a pose within 0.02 s. poses, poses_compared: of the
    estimate, and those with a true counterpart. ate_*: absolute trajectory error. rpe_*: relative pose error over one
    second. row_*: over the depth images' lines. consistency: errors beside the run's covariances, by horizon;
    truth_noise: the truth's own errors that are counted there.
    """

    frames: int
    frames_tracked: int
    poses: int
    poses_compared: int
    ate_rmse_m: float
    ate_mean_m: float
    ate_median_m: float
    ate_std_m: float
    ate_max_m: float
    rpe_trans_rmse_m_per_s: float | None
    rpe_rot_rmse_deg_per_s: float | None
    rpe_pairs: int
    row_rmse_m: float | None
    row_rot_rmse_deg: float | None
    rows: int
    rows_total: int
    notes: tuple[str, ...] = ()
    consistency: tuple[Horizon, ...] = ()
    truth_noise: TruthNoise | None = None

    @property
    def nees(self) -> float | None:
        """NEES/6 over one second: 1 if the run's covariances are right."""
        return None if (found := self.over(1.0)) is None else found.nees

    @property
    def coverage_90(self) -> float | None:
        """Part of the motions of one second within the covariances' 90 % region: 0.9 if these are right."""
        return None if (found := self.over(1.0)) is None else found.within[90]

    @property
    def coverage(self) -> float:
        """Part of the sequence's frames that have a pose, 0 to 1."""
        return self.frames_tracked / self.frames if self.frames else 0.0

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers for JSON; units are in the names."""
        more = {name: getattr(self, name) for name in ("coverage", "nees", "coverage_90")}
        data: dict[str, Any] = plain(dataclasses.asdict(self) | more)
        return data

    def over(self, seconds: float) -> Horizon | None:
        """What `consistency` has of motions over so many seconds."""
        return next((found for found in self.consistency if found.seconds == seconds), None)

    def table(self) -> Table:
        """Errors in millimetres, degrees, and both per second."""
        m = self
        ate = (m.ate_rmse_m, m.ate_mean_m, m.ate_median_m, m.ate_std_m, m.ate_max_m)
        pairs, lines = f"{m.rpe_pairs} pairs 1 s apart", f"{m.rows} of {m.rows_total} lines"
        rows: list[tuple[str, tuple[float | None, ...], float, str]] = [
            ("ATE, mm", ate, 1e3, f"{m.poses_compared} of {m.poses} poses"),
            ("drift, mm/s", (m.rpe_trans_rmse_m_per_s,), 1e3, pairs),
            ("drift, deg/s", (m.rpe_rot_rmse_deg_per_s,), 1.0, pairs),
            ("lines' position, mm", (m.row_rmse_m,), 1e3, lines),
            ("lines' rotation, deg", (m.row_rot_rmse_deg,), 1.0, lines),
        ]
        head = ("error", "RMSE", "mean", "median", "std", "max", "over")
        texts = ((label, *(fixed(v, 3, scale) for v in values), *[""] * (5 - len(values)), over)
                 for label, values, scale, over in rows)  # fmt: skip
        return Table(head, tuple(texts), "Errors against the true trajectory, after rigid alignment", words=(0, 6))

    def text(self) -> str:
        """The table, what it is of, and the notes."""
        tracked = f"{self.frames_tracked} of {self.frames} ({100 * self.coverage:.1f} %)"
        head = [f"frames tracked: {tracked}", ""] if self.frames else []
        notes = [f"note: {note}" for note in self.notes]
        return "\n".join([*head, self.table().text(), *self._sure(), *notes])

    def _sure(self) -> list[str]:
        if not self.consistency:
            return []
        noise = self.truth_noise
        counted = "" if noise is None else (
            f", the truth's own errors of {noise.translation_mm:g} mm and {noise.rotation_deg:g} deg in 1 s counted"
        )  # fmt: skip
        title = f"errors beside their covariances{counted} (NEES/6: 1 if as large):"
        return ["", title, consistency_table(self.consistency).text()]


@dataclass(frozen=True)
class RelativeErrors:
    """Relative pose errors over one second, from each of the times (k,) s on: m (k,) and degrees (k,)."""

    stamps: FloatArray
    translation_m: FloatArray
    rotation_deg: FloatArray


def evaluate(truth: Truth, estimate: Estimate) -> Metrics:
    """Compare an estimate with the truth.

    Association: a spline is evaluated at the estimate's stamps; stamps outside its time are left out and counted. True
    poses are associated with the nearest stamp, one to one and within 0.02 s, as by TUM's associate.py, or, with
    `Truth.interpolate`, interpolated on SE(3). ATE: distances between positions after `association.align`, as in TUM's
    evaluate_ate.py. RPE: E = (T_true,i⁻¹ T_true,j)⁻¹ (T_est,i⁻¹ T_est,j), RMSE of its translation and angle over
    `pairs_one_second_apart`. TUM's evaluate_rpe.py multiplies in the other order: the rotation is the same, the
    translation that of this definition with time reversed. Errors by line: at all depth lines' mid-exposures where both
    splines are known, after the alignment of the frames' poses.

    Raises UserError if fewer than three poses have a true counterpart, or the run's covariances are malformed.
    """
    notes = estimate.untied
    found = compare(truth, estimate)
    missing = len(estimate.stamps) - len(found.index)
    if missing:
        where = "outside the truth's time" if isinstance(truth.motion, Spline) else "without a true pose within 0.02 s"
        notes.append(f"{missing} of {len(estimate.stamps)} poses left out: {where}")
    if not found.is_determined:
        notes.append("positions lie on a line or in a point: what they leave open is aligned by the orientations")
    error = found.position_errors_m

    step = drift(estimate, found)
    consistency = _consistency(truth, estimate, found)
    if truth.noise is not None and not consistency:
        notes.append("the truth's own errors change nothing: there are no covariances to compare with errors")
    if not len(step.stamps):
        notes.append("no drift: no two poses are one second apart")

    t = truth.line_times
    rows, row_count = _errors_by_line(truth.motion, estimate, found.T_true_est, t)
    if not row_count:
        notes.append("no errors by line: they need a spline on both sides")

    return Metrics(
        frames=len(truth.frame_stamps),
        frames_tracked=len(associate(truth.frame_stamps, estimate.stamps, ASSOCIATE_WITHIN_S)),
        poses=len(estimate.stamps),
        poses_compared=len(found.index),
        ate_rmse_m=_rms(error),
        ate_mean_m=float(error.mean()),
        ate_median_m=float(np.median(error)),
        ate_std_m=float(error.std()),
        ate_max_m=float(error.max()),
        rpe_trans_rmse_m_per_s=_rms(step.translation_m) if len(step.stamps) else None,
        rpe_rot_rmse_deg_per_s=_rms(step.rotation_deg) if len(step.stamps) else None,
        rpe_pairs=len(step.stamps),
        row_rmse_m=rows[0],
        row_rot_rmse_deg=rows[1],
        rows=row_count,
        rows_total=len(t),
        notes=tuple(notes),
        consistency=consistency,
        truth_noise=truth.noise,
    )


def pairs_one_second_apart(stamps: FloatArray) -> tuple[IntArray, IntArray]:
    """The pairs of TUM's evaluate_rpe.py with --fixed_delta --delta 1 --delta_unit s --max_pairs 0, see `pairs_apart`.

    (Sturm et al., IROS 2012.) There are two differences. That script drops every pair that ends on the last pose, since
    all i in the last second would end there; here only those whose i + 1 s lies after it (by over 1 ms) are dropped.
    And where the nearest pose is more than 0.1 s off, in a gap, there is no pair: it might be i itself, with an error
    of zero. At even 30 Hz these are evo's pairs for `--delta 30 --delta_unit f --all_pairs`.
    """
    return pairs_apart(stamps, 1.0)


def pairs_apart(stamps: FloatArray, seconds: float) -> tuple[IntArray, IntArray]:
    """Indices i, j (k,) with stamp j the nearest to stamp i plus so many seconds, of increasing stamps (n,), s.

    None where the nearest is more than 0.1 s, or half of the seconds, off; see `pairs_one_second_apart`.
    """
    if not len(stamps):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    target = stamps + seconds
    j = nearest(stamps, target)
    within = min(_PAIR_WITHIN_S, 0.5 * seconds)
    keep = (target <= stamps[-1] + _STAMP_ROUNDING_S) & (np.abs(stamps[j] - target) <= within)
    return np.flatnonzero(keep), j[keep]


def motions(T_world_cam: FloatArray, i: IntArray, j: IntArray) -> FloatArray:
    """T_i⁻¹ T_j (k, 4, 4) between poses i and j (k,) of (n, 4, 4)."""
    return se3.inverse(T_world_cam[i]) @ T_world_cam[j]


def pose_errors(T_a: FloatArray, T_b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Translations (n,), m, and angles (n,), degrees, of T_a⁻¹ T_b, both (n, 4, 4)."""
    return np.linalg.norm((se3.inverse(T_a) @ T_b)[:, :3, 3], axis=1), angles_deg(T_a, T_b)


def drift(estimate: Estimate, found: Comparison) -> RelativeErrors:
    """The relative pose errors whose RMS `evaluate` gives, with the time at which each second begins."""
    i, j = _pairs(estimate, found, 1.0)
    true_step, est_step = (motions(T, i, j) for T in (found.T_world_true, found.T_world_est))
    return RelativeErrors(estimate.stamps[found.index[i]], *pose_errors(true_step, est_step))


def _pairs(estimate: Estimate, found: Comparison, seconds: float) -> tuple[IntArray, IntArray]:
    """Pairs (k,) so many seconds apart, by their indices among the poses that were compared."""
    row = np.full(len(estimate.stamps), -1)
    row[found.index] = np.arange(len(found.index))
    i, j = pairs_apart(estimate.stamps, seconds)
    both = (row[i] >= 0) & (row[j] >= 0)
    return row[i[both]], row[j[both]]


def _consistency(truth: Truth, estimate: Estimate, found: Comparison) -> tuple[Horizon, ...]:
    """Of the horizons that have pairs whose covariances are known."""
    known, stamps = covariances(estimate).at(found.index), estimate.stamps[found.index]
    horizons = []
    for seconds in HORIZONS_S:
        i, j = _pairs(estimate, found, seconds)
        covariance = motion_covariance(found.T_world_est, known, i, j)
        if truth.noise is not None:
            covariance += truth.noise.covariance(stamps[j] - stamps[i])
        horizons.append(horizon_of(seconds, motion_errors(found.T_world_true, found.T_world_est, i, j), covariance))
    return tuple(horizon for horizon in horizons if horizon is not None)


def compared(run: Path, metrics: Metrics, other: Path, theirs: Metrics) -> str:
    """One line: the ATE of a run beside that of another, by what their methods take the shutter for."""
    names = [_SHUTTERS.get(str(read_estimate(path).info.get("method", ""))[:2], str(path)) for path in (run, other)]
    names = names if len(set(names)) == 2 else [str(run), str(other)]
    ours_m, theirs_m = max(metrics.ate_rmse_m, 1e-12), max(theirs.ate_rmse_m, 1e-12)
    times = f"{max(ours_m, theirs_m) / min(ours_m, theirs_m):.3g} times {'worse' if theirs_m >= ours_m else 'better'}"
    return f"{names[0]}: ATE {1e3 * ours_m:.3g} mm; {names[1]}: {1e3 * theirs_m:.3g} mm ({times})"


# ---------------------------------------------------------------------------------------------------------------------


def _errors_by_line(
    motion: Spline | Trajectory, estimate: Estimate, T_true_est: FloatArray, t: FloatArray
) -> tuple[tuple[float | None, float | None], int]:
    """RMS position (m) and angle (deg) at those of the times (n,) where both splines are known, and their number."""
    if not isinstance(motion, Spline) or estimate.spline is None:
        return (None, None), 0
    t = t[(t >= motion.t_begin) & (t <= motion.t_end) & estimate.spline_covers(t)]
    if not t.size:
        return (None, None), 0
    position, angle = pose_errors(motion.pose(t), T_true_est @ estimate.spline.pose(t))
    return (_rms(position), _rms(angle)), t.size


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
