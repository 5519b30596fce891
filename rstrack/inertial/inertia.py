"""An IMU's recording beside a track: its readings constrain the spline, and the track determines biases and gravity."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.geometry.spline import Spline
from rstrack.alignment.normal_equations import Quadratic
from rstrack.alignment.priors import ACCELERATION, acceleration_prior
from rstrack.alignment.spline_state import SplineState
from rstrack.data.imu.recording import ImuRecording
from rstrack.inertial.band import ImuReadings, MotionBand, guessed_gravity, reading_sigmas, variance_about
from rstrack.inertial.estimate import GRAVITY, GYRO, SIZE, ImuEstimate, estimate_dict
from rstrack.inertial.factor import ImuResiduals
from rstrack.inertial.smoother import ReusedPrior, Smoother

# σ of the mean acceleration of a track's first moments, m/s².
_MEAN_ACCELERATION = 1.0
# Samples that estimate how readings scatter about the spline, and as how many the expected scatter counts.
_MEMORY, _EXPECTED = 100.0, 10.0
# Gravity in the world turns as the track drifts, beside keyframes' covariances: m/s² per √s.
_DRIFT = 5e-4
# Increments of control points (m, rad) that leave the rows of a frame's samples as they were linearised before it.
_SAME = 1e-3
# σ of a pose (m, rad) by images that leave a direction open: interpolation alone seems to constrain it so.
_OPEN = np.repeat([1e-2, 5e-3], 3)
# Change of gravity (m/s²) that calls for new derivatives: readings depend on the product of the spline's turns and
# gravity, which no derivative has at the start, when gravity is a guess.
_SAME_GRAVITY = 0.1
# What follows from the recording alone.
_GIVEN = "recording", "samples", "common", "_band"


class Inertia:
    """recording: of the IMU. estimate: of its biases, gravity and turn so far.

    common (6,): standard deviation of accelerations for the motion prior, m/s² and rad/s².
    sigma (2,): of a gyroscope's reading against the spline (rad/s), and of an accelerometer's (m/s²): never less than
    their noise, and as much as the spline cannot follow. usable_s: time (s) from which on the IMU is usable;
    determined_s: at which gravity's direction was first known; NaN before.
    """

    def __init__(self, recording: ImuRecording) -> None:
        self.recording, self.samples = recording, ImuReadings.of(recording)
        self.usable_s = self.determined_s = float("nan")
        self._noise = reading_sigmas(recording)
        self._walk = np.repeat([recording.noise.gyro_walk, recording.noise.accel_walk, _DRIFT, 0.0], 3) ** 2
        self._band, self._dt = MotionBand.of(recording), 0.0
        self.common = self._band.allowed if self.is_informative else ACCELERATION
        self.sigma, self._sampled = self._noise, np.zeros(2)
        self._smoother: Smoother | None = None
        self._until, self._next, self._tripled = -np.inf, -np.inf, 0
        self.estimate = ImuEstimate.initial(np.array([0.0, recording.gravity, 0.0]))
        self._leaves_open = False
        # The rows `ahead` has linearised last: of a state, whose control points from a first one on had received so
        # much by then.
        self._ahead: tuple[SplineState, int, FloatArray, ImuResiduals] | None = None

    @property
    def state(self) -> dict[str, object]:
        """All that a track has changed."""
        return {name: value for name, value in vars(self).items() if name not in _GIVEN}

    @state.setter
    def state(self, state: dict[str, object]) -> None:
        vars(self).update(state)

    def as_dict(self) -> dict[str, Any]:
        """The estimate at the end, and when it was known (s)."""
        at = {"usable_s": self.usable_s, "gravity_determined_s": self.determined_s}
        known = {name: seconds if np.isfinite(seconds) else None for name, seconds in at.items()}
        return known | estimate_dict(self.estimate, self.sigma)

    @property
    def is_usable(self) -> bool:
        """Whether it is of use."""
        return bool(np.isfinite(self.usable_s))

    @property
    def is_informative(self) -> bool:
        """Whether it constrains the motion: with a gyroscope at once, while biases and gravity are still unknown;
        without one when it is usable."""
        return self.is_usable or self.recording.gyro is not None

    def begin_world(self) -> None:
        """The world is another one from now on; biases and turn stay what they are."""
        if self._smoother is None:
            return
        start = ImuEstimate.initial(np.array([0.0, self.recording.gravity, 0.0]))
        own = np.delete(np.arange(SIZE), GRAVITY)
        start.information[np.ix_(own, own)] = np.linalg.inv(self.estimate.covariance[np.ix_(own, own)])
        start.mean[own] = self.estimate.mean[own]
        self.estimate, self._smoother = start, None
        self.usable_s = self.determined_s = float("nan")
        self._until = self._next = -np.inf

    def begin_segment(self) -> None:
        """The spline goes on elsewhere, with control points that have nothing to do with those before."""
        if self._smoother is not None:
            self._smoother.marginalise(self._smoother.last)
        self._until = self._next = -np.inf

    def shift(self, covariance: FloatArray) -> None:
        """Images are aligned to another keyframe from now on, known in the world up to a left increment with covariance
        (6, 6): that is no motion."""
        if self._smoother is not None:
            self._smoother.shift(covariance)

    def covers(self, begin: float, end: float) -> bool:
        """Whether there are samples from begin to end (s), without a gap worth mentioning."""
        t = self.samples.between(begin, end).t
        longest = max(3.0 / self.recording.rate_hz, 0.02)
        return bool(np.diff(np.concatenate([[begin], t, [end]])).max() <= longest)

    def sigmas_over(self, seconds: float, R_imu_world: FloatArray) -> tuple[FloatArray, float]:
        """σ (6,) of accelerations over so many seconds in an attitude (3, 3), m/s² and rad/s², given the readings,
        and of the mean angular rate, rad/s."""
        gyro, accel = self.sigma**2 / max(1.0, seconds * self.recording.rate_hz)
        gyro += float(np.diag(self.estimate.covariance)[GYRO].max())
        accel += self.estimate.force_variance(R_imu_world)
        return np.repeat(np.sqrt([accel, (2.0 / seconds) ** 2 * gyro]), 3), float(np.sqrt(gyro))

    # -- readings constrain the spline ------------------------------------------------------------------------------

    def prior(self, state: SplineState, segment: int, first: int) -> ReusedPrior:
        """All samples on control points from `first` on, of the segment of the spline that begins at control point
        `segment`, while it moves with `state`; biases and gravity as far as they are known."""
        spline = state.spline
        self._expect(spline.dt)
        begin = max(spline.t0 + max(segment, first - 3) * spline.dt, spline.t_begin)
        samples = self.samples.between(begin, spline.t_end)
        estimate = self.estimate
        if not self.is_usable:
            # An estimate that is still wrong would draw the spline and confirm itself. Readings then only say how the
            # motion changes, and a hand accelerates little in the mean where images leave that open.
            estimate = ImuEstimate.initial(guessed_gravity(spline, samples, self.recording))
            estimate.information[GRAVITY, GRAVITY] = np.eye(3) / _MEAN_ACCELERATION**2
        numbers = estimate.mean

        def around() -> tuple[Quadratic, float]:
            nonlocal numbers
            for _ in range(2):
                joint = self._rows(state, samples, numbers).summed(self.sigma)
                if joint is None:
                    return Quadratic(state.end - 1, np.zeros((6, 6)), np.zeros(6)), 0.0
                model, cost, best = joint.without_imu(estimate, numbers)
                if np.abs(best - numbers)[GRAVITY].max() < _SAME_GRAVITY:
                    break
                numbers = best
            return model, cost

        return ReusedPrior(state, first, around)

    def held(self, segment: int) -> int | None:
        """First control point that the smoother has, where the IMU is usable and has seen enough of the segment of the
        spline that begins at control point `segment`. None where images left a direction open: fixed control points
        let the spline slide there by what readings leave open in a frame, a smoother by all that they do."""
        smoother = self._smoother
        if (
            smoother is None
            or self._leaves_open
            or not self.is_usable
            or len(smoother.at) < 4
            or smoother.first < segment
        ):
            return None
        return smoother.first

    def ahead(self, state: SplineState) -> ReusedPrior:
        """All images and samples so far, on the control points that are `held`, and the samples since on those that
        came anew, while they move with `state`."""
        smoother = self._smoother
        assert smoother is not None
        samples = self.samples.between(self._until, state.spline.t_end)

        def around() -> tuple[Quadratic, float]:
            both = smoother.copy()
            cost = both.reach(state, both.first, state.end)
            rows = self._rows(state, samples, self.estimate.mean)
            self._ahead = state, both.first, both.at, rows
            joint = rows.summed(self.sigma)
            if joint is not None:
                both.add(joint)
                cost += joint.cost
            cost += self._regular(both, state.spline)
            model, gained = both.without_imu(self.recording.gravity)
            return model, cost - gained

        return ReusedPrior(state, smoother.first, around)

    # -- the track determines biases and gravity --------------------------------------------------------------------

    def learn(self, state: SplineState, segment: int, models: Sequence[Quadratic], end: float) -> None:
        """From a frame whose lines end at time `end` (s), which has been found: `models` are of its images.

        Samples count up to the end of the frame before; the newest control points still move.
        """
        if not models:
            return
        self._expect(state.dt)
        low, high = min(m.first for m in models), max(m.last for m in models)
        begin = max(self._until, state.spline.t0 + segment * state.dt, state.spline.t_begin)
        self._until, self._next = max(begin, self._next), end
        fresh = self.samples.between(begin, self._until)
        smoother = self._smoother or self._started(state, segment)
        if smoother is None:
            return
        self._smoother = smoother
        if not len(smoother.at):
            self._tripled = low + 2
        smoother.reach(state, low, min(high, state.end))
        self._regular(smoother, state.spline)
        self._tripled = smoother.last
        # As one body: by one left increment of all control points.
        seen = sum(m.H.reshape(-1, 6, len(m.H) // 6, 6).sum(axis=(0, 2)) for m in models)
        self._leaves_open = bool(np.linalg.eigvalsh(_OPEN[:, None] * seen * _OPEN)[0] < 1.0)
        for model in models:
            smoother.add(model)
        rows = self._rows_known(state, fresh)
        joint = rows.summed(self.sigma)
        if joint is not None:
            smoother.add(joint)
            smoother.diffuse(self._walk * max(1e-6, float(self._until - begin)))
        keep = state.segment(self._until) if joint is not None else smoother.first
        smoother.marginalise(max(keep, state.first))
        before = self.estimate.mean
        self._update(smoother)
        if joint is not None and self.is_informative:
            self._learn_sigma(rows.after(self.estimate.mean - before), fresh.counts, state.dt)
        if not self.is_usable:
            T, twist = state.spline.pose_and_velocity(self._until)
            R_imu_depth = self.recording.T_imu_depth[:3, :3]
            usable = self.estimate.is_usable(R_imu_depth @ T[:3, :3].T, R_imu_depth @ twist[3:])
            self.usable_s = end if usable else self.usable_s
        if not np.isfinite(self.determined_s) and self.estimate.is_determined:
            self.determined_s = end

    def _rows(self, state: SplineState, samples: ImuReadings, numbers: FloatArray) -> ImuResiduals:
        return ImuResiduals.of(state.spline, samples, self.recording.T_imu_depth, numbers)

    def _rows_known(self, state: SplineState, fresh: ImuReadings) -> ImuResiduals:
        """Of fresh samples, those until now: from when the frame was solved for, if that was hardly elsewhere."""
        known, self._ahead = self._ahead, None
        if known is not None and known[0] is state:
            _, first, at, rows = known
            rows = rows.until(self._until)
            if len(rows.r) == len(fresh) > 0:
                count = int(rows.first[-1]) + 4 - first
                moved = state.received(first, first + count) - at[:count]
                if np.abs(moved).max() < _SAME:
                    return rows.moved(first, moved)
        return self._rows(state, fresh, self.estimate.mean)

    def _started(self, state: SplineState, segment: int) -> Smoother | None:
        """An empty smoother; gravity is guessed from the first samples, so that turns are about right."""
        spline = state.spline
        begin = max(spline.t0 + segment * spline.dt, spline.t_begin)
        fresh = self.samples.between(begin, spline.t_end)
        if not len(fresh):
            return None
        self.estimate.mean[GRAVITY] = guessed_gravity(spline, fresh, self.recording)
        return Smoother.start(self.estimate)

    def _regular(self, smoother: Smoother, spline: Spline) -> float:
        """Add the weak prior of accelerations for control points that have come anew; its cost."""
        first, last = max(self._tripled - 2, smoother.first), smoother.last
        if last - first < 3:
            return 0.0
        sigma = np.repeat(self.common[None] * spline.dt**2, last - first - 2, axis=0)
        model, cost = acceleration_prior(spline, first, last, sigma)
        smoother.add(model)
        return cost

    def _update(self, smoother: Smoother) -> None:
        free = smoother.marginal()
        self.estimate = free.of_strength(self.recording.gravity)
        smoother.around(self.estimate.mean)

    def _expect(self, dt: float) -> None:
        """Readings to scatter about a spline with knots dt s apart as their noise and what it cannot follow make them.

        Learnt alone, from a weak start, σ would stay as large as that start makes the scatter.
        """
        if dt != self._dt:
            self._dt, self.sigma = dt, np.hypot(self._noise, self._band.scatter(dt))
            self._sampled = np.full(2, _EXPECTED)

    def _learn_sigma(self, r: FloatArray, counts: FloatArray, dt: float) -> None:
        squares, number = (each.reshape(-1, 2, 3).sum(axis=(0, 2)) for each in (r**2 * counts, counts))
        self._sampled = np.minimum(self._sampled + number / 3.0, _MEMORY)
        weight = np.minimum(1.0, number / (3.0 * self._sampled))
        seen = variance_about(dt, self.recording, squares, number)
        seen = np.minimum(seen, 25.0 * self.sigma**2)  # one blow must not blind it for long
        mean = np.where(number > 0.0, (1.0 - weight) * self.sigma**2 + weight * seen, self.sigma**2)
        self.sigma = np.maximum(self._noise, np.sqrt(mean))
