"""How far off a pose may be: its covariance against the keyframe that it was found at, and the keyframe's own.

A frame's images give an information matrix, that of the normal equations with pixels counted as far as they are
independent. What they leave open, the motion before holds, ever less: a Kalman filter over pose and velocity with white
acceleration. Where a frame becomes a keyframe its covariance is added to all that follows: drift.

Errors that all pixels of an image have in common show in no scatter: steps not taken to the end, interpolation. Depth
and colour of a frame each find its pose. How far apart the two are, beyond their noise, bounds such errors: their σ is
the likeliest of a grid, by the last frames (a variance component, as in Searle, Casella, McCulloch, Variance
Components, 1992, chapter 9). Images that are noisy, or of a camera little known, hardly change it.

Increments are [m; rad] in the depth camera's own frame at mid readout, T_world_depth exp(ξ), unless named otherwise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from statistics import median

import numpy as np
import scipy.linalg

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rsgen.geometry.spline import Spline
from rstrack.alignment.observation import Observation, Scores
from rstrack.alignment.priors import ACCELERATION, VELOCITY
from rstrack.alignment.spline_state import SplineState
from rstrack.images.device_frame import DeviceFrame
from rstrack.images.fast_spline import motion
from rstrack.keyframes.keyframe import Reference
from rstrack.tracking.frame_report import FrameReport
from rstrack.tracking.judgement.calibration_errors import CalibrationErrors, Common, Considered
from rstrack.tracking.judgement.consider import CLOCK, Calibration

# σ in pixels of the depth camera where nothing else is known, which counts as a frame, and at most: measured on
# hand-held renderings with noise (docs/notebook/hand-held.md).
SYSTEMATIC_PX = 0.01
_GRID = SYSTEMATIC_PX * 2.0 ** (-0.25 * np.arange(17))
# Frames that count.
_MEMORY = 30
# σ (m, rad) above which a pose is not known; with 10 mm fr1_desk and fr1_rpy are lost for good.
_WORST = np.array([0.02, np.radians(2.0)])
# A pose that nothing tells, m and rad.
_NOWHERE = np.array([10.0, 10.0, 10.0, 3.0, 3.0, 3.0])


def of_pixels(sigma_px: float, focal_px: float, depth_m: float) -> FloatArray:
    """Covariance (6, 6), [m; rad], of errors of so many pixels, of things so far away."""
    turn = sigma_px / focal_px
    return np.diag(np.repeat([turn * depth_m, turn], 3) ** 2)


@dataclass(frozen=True, eq=False)
class Systematic:
    """What the last frames say: logarithms of the likelihoods (17,) of σ; inflations: see `median_inflation`."""

    likelihoods: FloatArray = field(default_factory=lambda: np.zeros(len(_GRID)))
    inflations: tuple[float, ...] = ()

    @property
    def px(self) -> float:
        """σ in pixels of the depth camera."""
        first = _likelihoods(np.full(6, 2.0 * SYSTEMATIC_PX**2), np.zeros(6))
        return float(_GRID[np.argmax(first + self.likelihoods)])

    @property
    def median_inflation(self) -> float:
        """Median of what makes images agree with each other: a wrong camera file has it large."""
        return median(self.inflations) if self.inflations else 1.0

    def with_inflation(self, inflation: float) -> Systematic:
        """With a frame that was found, whose images had to be inflated by so much."""
        return replace(self, inflations=(*self.inflations, inflation)[-_MEMORY:])

    def with_frame(self, apart: FloatArray, covariance: FloatArray, focal_px: float, depth_m: float) -> Systematic:
        """With a frame whose two images' poses are `apart` (6,), [m; rad], of covariance (6, 6) by all else."""
        spread, basis = scipy.linalg.eigh(covariance, of_pixels(1.0, focal_px, depth_m))
        found = _likelihoods((basis.T @ apart) ** 2, np.maximum(spread, 0.0))
        return replace(self, likelihoods=(1.0 - 1.0 / _MEMORY) * self.likelihoods + found)


def _likelihoods(squares: FloatArray, spread: FloatArray) -> FloatArray:
    """Logarithms of how likely distances (6,), squared, are of such a spread (6,) for each σ of both images (17,)."""
    variances = spread + 2.0 * _GRID[:, None] ** 2
    return np.asarray(-0.5 * (np.log(variances) + squares / variances).sum(axis=1))


@dataclass(frozen=True)
class Uncertainty:
    """Of the newest frame. state (12, 12): the filter's covariance of pose and velocity against its keyframe; mixture
    (12, 12): what they have beyond it, see `innovation.mixture`.

    seen (6, 6): what its images say of its pose, the information. drift: for each keyframe by its index the covariance
    (6, 6) of its pose, as left increments in the world. systematic: what images so far have shown of such errors;
    calibration: and of the calibration's.
    """

    state: FloatArray = field(default_factory=lambda: _lost())
    mixture: FloatArray = field(default_factory=lambda: np.zeros((12, 12)))
    seen: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))
    drift: dict[int, FloatArray] = field(default_factory=dict)
    systematic: Systematic = field(default_factory=Systematic)
    calibration: CalibrationErrors = field(default_factory=CalibrationErrors)

    @property
    def pose(self) -> FloatArray:
        """Covariance (6, 6) of the pose against the keyframe."""
        return np.asarray((self.state + self.mixture)[:6, :6])

    def covariance(self, focal_px: float, depth_m: float) -> FloatArray:
        """The same with what is systematic, for a depth camera of such a focal length and things so far away."""
        return np.asarray(self.pose + of_pixels(self.systematic.px, focal_px, depth_m))

    @property
    def is_known(self) -> bool:
        """Whether the pose is known better than to 20 mm and 2° in every direction."""
        sigmas = [np.sqrt(np.linalg.eigvalsh(self.pose[part, part])[-1]) for part in (slice(3), slice(3, 6))]
        return bool((np.array(sigmas) < _WORST).all())

    @property
    def held_by_motion(self) -> float:
        """Largest part, 0 to 1, that the motion before, not the images, has in what is known of any direction."""
        return float(np.clip(1.0 - np.linalg.eigvals(self.pose @ self.seen).real.min(), 0.0, 1.0))

    def after(
        self, seconds: float, seen: FloatArray, accelerations: FloatArray = ACCELERATION, rate: float = np.inf
    ) -> Uncertainty:
        """So many seconds later, with what the images then say (6, 6).

        accelerations (6,): σ of what the velocity changes by beyond what is known, m/s² and rad/s². rate: σ of the
        angular rate itself, rad/s, where a gyroscope measures it: it does not drift, as what is known by changes does.
        """
        updated = _updated(self.predicted(seconds, accelerations, rate), slice(0, 6), seen)
        return replace(self, state=0.5 * (updated + updated.T), seen=seen, mixture=np.zeros((12, 12)))

    def predicted(self, seconds: float, accelerations: FloatArray = ACCELERATION, rate: float = np.inf) -> FloatArray:
        """The state's covariance (12, 12) so many seconds later, before any image; arguments as in `after`."""
        F = np.eye(12)
        F[:6, 6:] = seconds * np.eye(6)
        gain = np.concatenate([0.5 * seconds**2 * np.eye(6), seconds * np.eye(6)])
        predicted = F @ (self.state + self.mixture) @ F.T + gain @ np.diag(accelerations**2) @ gain.T
        return _updated(predicted, slice(9, 12), np.eye(3) / rate**2)

    def begun_anew(self) -> Uncertainty:
        """Nothing is known of any pose; of the cameras it is what was."""
        return Uncertainty(systematic=self.systematic, calibration=self.calibration)

    def of_first(self) -> Uncertainty:
        """Of the frame that the world is taken from, which may move."""
        return replace(self.begun_anew(), state=np.diag(np.concatenate([np.zeros(6), VELOCITY]) ** 2))

    def found_anew(self, seen: FloatArray) -> Uncertainty:
        """Of a frame of which nothing is known but what its images (6, 6) say."""
        return replace(self, state=_lost(), mixture=np.zeros((12, 12))).after(0.0, seen)

    def with_keyframe(self, index: int, before: int, T_world_depth: FloatArray, pose: FloatArray) -> Uncertainty:
        """With a keyframe made of a frame at T_world_depth (4, 4), whose covariance was `pose` against another one."""
        Ad = se3.adjoint(T_world_depth)
        drift = self.drift_of(before) + Ad @ pose @ Ad.T
        return replace(self, drift=self.drift | {index: drift})

    def drift_of(self, index: int) -> FloatArray:
        """Covariance (6, 6) of a keyframe's pose, see `drift`."""
        return self.drift.get(index, np.zeros((6, 6)))


def _updated(P: FloatArray, part: slice, information: FloatArray) -> FloatArray:
    """Covariance P (12, 12) with information (k, k) of a part of the state."""
    # P − P E (H⁻¹ + Eᵀ P E)⁻¹ Eᵀ P without the inverse of H, which may be singular.
    solved = np.linalg.solve(np.eye(len(information)) + information @ P[part, part], information)
    return np.asarray(P - P[:, part] @ solved @ P[part])


def _lost() -> FloatArray:
    return np.diag(np.concatenate([_NOWHERE, VELOCITY]) ** 2)


# -- of a track's frames and keyframes ---------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Recent:
    """Of a frame: the keyframe, the covariance (6, 6) against it, `Common.pose`, the camera's velocity (6,), and what
    was added to its colours' stamps."""

    ref: int
    covariance: FloatArray
    common: FloatArray
    velocity: FloatArray
    color_late_s: float


@dataclass
class PoseCovariances:
    """uncertainty, common: of the newest frame. Of frames that may become keyframes theirs are remembered.

    focal_px: the depth camera's.
    """

    focal_px: float
    calibration: Calibration
    uncertainty: Uncertainty = field(default_factory=Uncertainty)
    common: Common = field(default_factory=Common)
    _recent: dict[int, _Recent] = field(default_factory=dict)

    @property
    def color_late(self) -> tuple[float, float]:
        """Seconds that colour was found to be later than its stamps, and σ of that."""
        mean, sigma = self.uncertainty.calibration.clock
        file_s = self.calibration.sigmas[CLOCK]
        return -file_s * mean, file_s * sigma

    def begun_anew(self) -> PoseCovariances:
        """Of a track that begins, with what is known of the cameras."""
        return PoseCovariances(self.focal_px, self.calibration, self.uncertainty.begun_anew())

    def considered(self, seconds: float) -> Considered | None:
        """What the calibration does to the next frame, so many seconds later; None where it is exact."""
        if self.calibration.is_exact:
            return None
        return Considered(self.calibration, self.common, seconds, self.color_late[0])

    def after(
        self, seconds: float, uncertainty: Uncertainty, fresh: Sequence[Observation], state: SplineState, score: Scores
    ) -> Common:  # fmt: skip
        """`common` so many seconds later (0: found anew), of a frame then so uncertain; score: by its images."""
        if self.calibration.is_exact or not fresh:
            return self.common
        at = motion(state.spline, fresh[0].image.exposure.mid_time)[0]
        own = self.common.cross_information(self.calibration, fresh, state, at, score.excess)
        before = self.common if seconds else self.common.at_rest()
        return before.after(seconds, at, uncertainty.state, score.information, own)

    def add(self, frame: DeviceFrame, ref: Reference, spline: Spline, oldest: int = 0) -> None:
        """A frame that has been found against a keyframe; what is before frame `oldest` is forgotten."""
        kept = {k: one for k, one in self._recent.items() if k >= oldest}
        _, velocity = motion(spline, frame.depth.exposure.mid_time)
        covariance = self.uncertainty.covariance(self.focal_px, ref.median_depth)
        own = _Recent(ref.index, covariance, self.common.pose, velocity, frame.color_late_s)
        self._recent = kept | {frame.index: own}

    def look_at(self, ref: Reference, spline: Spline) -> None:
        """The first keyframe, before anything is found at it."""
        self._keep(ref.index, np.zeros_like(self.common.pose), motion(spline, ref.t)[1])

    def begin(self, ref: Reference, frames: Sequence[DeviceFrame], spline: Spline) -> None:
        """The first keyframe, made of one of the first frames; the world is the first of them."""
        first = self._recent.get(frames[0].index)
        T_world_first = spline.pose(frames[0].depth.exposure.mid_time)
        covariance = np.zeros((6, 6)) if first is None else first.covariance
        self.uncertainty = self.uncertainty.with_keyframe(ref.index, -1, T_world_first, covariance)
        if first is None:
            return
        # Found at a keyframe that was taken for exact, it is the first frame that is.
        self._keep(ref.index, -first.common, self.common.velocities[ref.index])
        self.common = replace(self.common, pose=self.common.pose - first.common)
        self._recent = {k: replace(one, common=one.common - first.common) for k, one in self._recent.items()}

    def keyframe(self, ref: Reference) -> None:
        """A keyframe made of a recent frame."""
        if ref.index in self._recent:
            own = self._recent[ref.index]
            self.uncertainty = self.uncertainty.with_keyframe(ref.index, own.ref, ref.T_world_base, own.covariance)
            self._keep(ref.index, own.common, own.velocity, own.color_late_s)

    def report(
        self, report: FrameReport, frame: DeviceFrame, fresh: Sequence[Observation], spline: Spline
    ) -> FrameReport:
        """A frame's report with its covariance, if it has one."""
        if report.lost or frame.index not in self._recent:
            return report
        report = self.of(report, frame, spline)
        if not fresh or any(o.ref.rolling is not None for o in fresh):
            return report
        return replace(report, held_by_motion=self.uncertainty.held_by_motion)

    def of(self, report: FrameReport, frame: DeviceFrame, spline: Spline, at: int = -1) -> FrameReport:
        """The same where it has none, too: that it is then as good as keyframe `at`."""
        T_world_depth, own = motion(spline, frame.stamp)[0], self._recent.get(frame.index)
        from_world = se3.adjoint(se3.inverse(T_world_depth))
        if own is None:
            common = self.common.of_keyframe(at, T_world_depth)
            covariance = np.zeros((6, 6))
        else:
            to_stamp = from_world @ se3.adjoint(motion(spline, frame.depth.exposure.mid_time)[0])
            at, covariance = own.ref, to_stamp @ own.covariance @ to_stamp.T
            common = from_world @ own.common
        may_be_wrong = self.calibration.sigmas > 0.0
        shared = common[:, may_be_wrong] if may_be_wrong.any() else None
        return replace(report, covariance=covariance, drift_world=self.uncertainty.drift_of(at), common=shared)

    def _keep(self, index: int, common: FloatArray, velocity: FloatArray, color_late_s: float = 0.0) -> None:
        known = self.common
        self.common = replace(
            known, keyframes=known.keyframes | {index: common}, velocities=known.velocities | {index: velocity},
            color_late_s=known.color_late_s | {index: color_late_s},
        )  # fmt: skip
