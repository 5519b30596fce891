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

from dataclasses import dataclass, field, replace
from statistics import median

import numpy as np
import scipy.linalg

from rsgen.array_types import FloatArray
from rsgen.geometry import se3
from rstrack.alignment.priors import ACCELERATION, VELOCITY
from rstrack.tracking.judgement.calibration_errors import CalibrationErrors

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
