"""A unit's recording beside a track: what it says of the spline, and what the track says of biases and gravity."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry.spline import Spline
from rstrack.alignment.normal_equations import Quadratic
from rstrack.alignment.priors import ACCELERATION, acceleration_prior
from rstrack.alignment.spline_state import SplineState
from rstrack.data.imu.recording import ImuRecording
from rstrack.inertial.belief import GRAVITY, GYRO, Belief
from rstrack.inertial.residuals import Samples, summed
from rstrack.inertial.smoother import Smoother

# σ of readings (rad/s, m/s²) before it is known what of them the spline can follow, and samples that tell.
_START, _MEMORY = np.array([0.03, 0.3]), 100.0
# Gravity in the world turns as the track drifts, beside what keyframes' covariances say: m/s² per √s.
_DRIFT = 5e-4
# Increments of control points (m, rad) that leave the samples' derivatives as they were.
_SAME = 1e-2
# Part of the degrees of freedom of its samples that a spline leaves, at least, lest few samples seem to fit too well.
_LEAST_LEFT = 0.3


class Inertia:
    """recording: of the unit. belief: of its biases and gravity as far as is known.

    sigma (2,): of a gyroscope's reading against the spline (rad/s), and of an accelerometer's (m/s²): never less than
    their noise, and as much as the spline cannot follow. usable_s: time (s) from which on the unit is of use;
    determined_s: at which gravity's direction was first known; NaN before.
    """

    def __init__(self, recording: ImuRecording) -> None:
        self.recording, self.samples = recording, Samples.of(recording)
        noise, root = recording.noise, np.sqrt(recording.rate_hz)
        self._noise = np.array([noise.gyro_density, noise.accel_density]) * root
        walks = np.repeat([noise.gyro_walk, noise.accel_walk, _DRIFT], 3)
        self._walk = walks**2
        self.sigma = np.maximum(_START, self._noise)
        self.usable_s = self.determined_s = float("nan")
        self._smoother: Smoother | None = None
        self._until, self._next, self._tripled = -np.inf, -np.inf, 0
        self.belief = Belief.initial(np.array([0.0, recording.gravity, 0.0]))

    @property
    def state(self) -> dict[str, object]:
        """All that a track has changed."""
        return {name: value for name, value in vars(self).items() if name not in ("recording", "samples")}

    @state.setter
    def state(self, state: dict[str, object]) -> None:
        vars(self).update(state)

    @property
    def is_usable(self) -> bool:
        """Whether it is of use."""
        return bool(np.isfinite(self.usable_s))

    def begin_world(self) -> None:
        """The world is another one from now on; biases stay what they are."""
        if self._smoother is None:
            return
        information = np.linalg.inv(self.belief.covariance[:6, :6])
        start = Belief.initial(np.array([0.0, self.recording.gravity, 0.0]))
        start.information[:6, :6], start.mean[:6] = information, self.belief.mean[:6]
        self.belief, self._smoother = start, None
        self.usable_s = self.determined_s = float("nan")
        self._until = self._next = -np.inf

    def begin_piece(self) -> None:
        """The spline goes on elsewhere, with control points that have nothing to do with those before."""
        if self._smoother is not None:
            self._smoother.forget(self._smoother.last)
        self._until = self._next = -np.inf

    def shift(self, covariance: FloatArray) -> None:
        """Images tell the pose against another keyframe from now on, which lies in the world up to a left increment
        with covariance (6, 6): that is no motion."""
        if self._smoother is not None:
            self._smoother.shift(covariance)

    def covers(self, begin: float, end: float) -> bool:
        """Whether there are samples from begin to end (s), without a gap worth mentioning."""
        t = self.samples.between(begin, end).t
        longest = max(3.0 / self.recording.rate_hz, 0.02)
        return bool(np.diff(np.concatenate([[begin], t, [end]])).max() <= longest)

    def accelerations(self, seconds: float, R_imu_world: FloatArray) -> FloatArray:
        """σ (6,) of accelerations over so many seconds in an attitude (3, 3), m/s² and rad/s², with what it says."""
        gyro, accel = self.sigma**2 / max(1.0, seconds * self.recording.rate_hz)
        gyro += float(np.diag(self.belief.covariance)[GYRO].max())
        accel += self.belief.force_variance(R_imu_world)
        return np.repeat(np.sqrt([accel, (2.0 / seconds) ** 2 * gyro]), 3)

    # -- what it says of the spline ---------------------------------------------------------------------------------

    def prior(self, state: SplineState, piece: int, first: int) -> InertialPrior:
        """All samples that depend on control points from `first` on, of the piece of the spline that begins at control
        point `piece`, while it moves with `state`; biases and gravity as far as they are known."""
        spline = state.spline
        begin = max(spline.t0 + max(piece, first - 3) * spline.dt, spline.t_begin)
        return InertialPrior(self, self.samples.between(begin, spline.t_end), state, first)

    # -- what the track says of it ----------------------------------------------------------------------------------

    def learn(self, state: SplineState, piece: int, models: Sequence[Quadratic], end: float) -> None:
        """From a frame whose lines end at time `end` (s), which has been found: `models` is what its images say.

        Samples count up to the end of the frame before; the newest control points still move.
        """
        if not models:
            return
        low, high = min(m.first for m in models), max(m.last for m in models)
        begin = max(self._until, state.spline.t0 + piece * state.dt, state.spline.t_begin)
        self._until, self._next = max(begin, self._next), end
        fresh = self.samples.between(begin, self._until)
        smoother = self._smoother or self._started(state, piece)
        if smoother is None:
            return
        self._smoother = smoother
        if not len(smoother.at):
            self._tripled = low + 2
        smoother.reach(state, low, min(high, state.end))
        self._regular(smoother, state.spline)
        for model in models:
            smoother.add(model)
        joint, r = summed(state.spline, fresh, self.recording.T_imu_depth, self.belief, self.sigma)
        if joint is not None:
            smoother.add(joint)
            smoother.diffuse(self._walk * max(1e-6, float(self._until - begin)))
        keep = state.segment(self._until) if joint is not None else smoother.first
        smoother.forget(max(keep, state.first))
        self._believe(smoother)
        if joint is not None and self.is_usable:
            self._learn_sigma(r, fresh.counts, state.dt)
        R_imu_world = self.recording.T_imu_depth[:3, :3] @ state.spline.pose(self._until)[:3, :3].T
        if not self.is_usable and self.belief.is_usable(R_imu_world):
            self.usable_s = end
        if not np.isfinite(self.determined_s) and self.belief.is_determined:
            self.determined_s = end

    def _started(self, state: SplineState, piece: int) -> Smoother | None:
        """A smoother that knows nothing; gravity is guessed from the first samples, so that turns are about right."""
        spline = state.spline
        begin = max(spline.t0 + piece * spline.dt, spline.t_begin)
        fresh = self.samples.between(begin, spline.t_end)
        if not len(fresh):
            return None
        R = spline.pose(fresh.t)[:, :3, :3] @ self.recording.T_imu_depth[:3, :3].T
        up = (R @ fresh.values[:, 3:, None])[..., 0].mean(axis=0)
        if not np.linalg.norm(up) > 0.0:
            return None
        self.belief.mean[GRAVITY] = -self.recording.gravity * up / np.linalg.norm(up)
        return Smoother.start(self.belief)

    def _regular(self, smoother: Smoother, spline: Spline) -> None:
        """The weak prior of accelerations for control points that have come anew."""
        first, last = max(self._tripled - 2, smoother.first), smoother.last
        if last - first >= 3:
            sigma = np.repeat(ACCELERATION[None] * spline.dt**2, last - first - 2, axis=0)
            smoother.add(acceleration_prior(spline, first, last, sigma)[0])
            self._tripled = last

    def _believe(self, smoother: Smoother) -> None:
        free = smoother.marginal()
        self.belief = free.of_strength(self.recording.gravity)
        smoother.around(self.belief.mean)

    def _learn_sigma(self, r: FloatArray, counts: FloatArray, dt: float) -> None:
        left = max(_LEAST_LEFT, 1.0 - 1.0 / (self.recording.rate_hz * dt))
        squares, number = (r**2 * counts).reshape(-1, 2, 3).sum(axis=(0, 2)), counts.reshape(-1, 2, 3).sum(axis=(0, 2))
        known = number > 0.0
        weight = np.minimum(1.0, number / (3.0 * _MEMORY))
        seen = squares / np.maximum(1.0, number) / left
        # One blow must not blind it for long.
        seen = np.minimum(seen, 25.0 * self.sigma**2)
        mean = np.where(known, (1.0 - weight) * self.sigma**2 + weight * seen, self.sigma**2)
        self.sigma = np.maximum(self._noise, np.sqrt(mean))


class InertialPrior:
    """The samples' normal equations around a state, kept while it hardly moves: a `rstrack.alignment.priors.Prior`.

    first, end: the control points that its samples depend on, and how many there were of all.
    """

    def __init__(self, inertia: Inertia, samples: Samples, state: SplineState, first: int) -> None:
        self._inertia, self._samples, self.state = inertia, samples, state
        self.first, self.end = first, state.end
        self._known: tuple[Quadratic, float] | None = None
        self._at = np.zeros((0, 6))

    def __call__(self, spline: Spline) -> tuple[Quadratic, float]:
        if self._known is not None:
            model, cost = self._known
            moved = self.state.received(model.first, model.last) - self._at
            if np.abs(moved).max() < _SAME:
                step = moved.ravel()
                return model.moved(moved), cost + float(model.g @ step + 0.5 * step @ model.H @ step)
        inertia = self._inertia
        joint, _ = summed(spline, self._samples, inertia.recording.T_imu_depth, inertia.belief, inertia.sigma)
        if joint is None:
            return Quadratic(self.state.end - 1, np.zeros((6, 6)), np.zeros(6)), 0.0
        self._known = joint.without_belief(inertia.belief.information)
        self._at = self.state.received(joint.first, joint.first + joint.count)
        return self._known
