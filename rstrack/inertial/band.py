"""An IMU's readings: which of them count, and how dense knots have to be for the band of the motion that they show.

A uniform spline of degree n with knots Δt apart misses of a wave of f Hz, at best and in the mean over its phases, the
part 1 − sinc²ⁿ⁺²(f Δt) / Σ_k sinc²ⁿ⁺²(f Δt + k) of its power (Blu and Unser, Quantitative Fourier Analysis of
Approximation Techniques, IEEE Trans. Signal Processing 47(10), 1999). Poses are cubic, so rates are of degree 2 and
accelerations of degree 1; what is missed of poses follows from the readings' spectrum, divided by (2πf)² and (2πf)⁴.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rsgen.array_types import BoolArray, FloatArray
from rsgen.geometry.spline import Spline
from rstrack.alignment.priors import ACCELERATION
from rstrack.data.imu.description import ImuNoise
from rstrack.data.imu.recording import ImuRecording
from rstrack.options import Options

# Part of a sensor's range from which on a reading is saturated, or may be.
_SATURATED = 0.995
# An outlier stands out from between its neighbours by so many σ of the noise, and so many times as far as the four
# around it differ: motion that sudden would show in these, too. A bus that drops a bit leaves such readings.
_SIGMAS, _TIMES = 20.0, 3.0
# Spacings to choose from, s. No wider than without an IMU: a keyframe is made of a frame whose control points move no
# more, which the camera leaves the further behind the wider they are apart.
_SPACINGS_S = 0.025, 1 / 60, 0.0125, 1 / 120, 0.00625, 0.005
# Samples a knot, at least: fewer readings do not determine the control points.
_SAMPLES = 1.2
# Root mean square by which lines of the depth image may be off their best spline, of what is 1 m away, px.
_MOST_PX = 0.005
# Accelerations that the motion prior allows for, over the mean of the readings: a tighter one would work against them,
# and take for scatter what it suppressed.
_RARE = 3.0
# Seconds whose spectrum is taken at once.
_STRETCH_S = 1.0
# Of the sum over k: what is left out is less than 1e-6 for lines (degree 1), and far less for the others.
_ALIASES = np.arange(-50, 51)


@dataclass(frozen=True)
class ImuReadings:
    """n of a unit's samples: t (n,) s, values (n, 6) = [gyro; accel], counts (n, 6): whether a reading does."""

    t: FloatArray
    values: FloatArray
    counts: FloatArray

    @classmethod
    def of(cls, imu: ImuRecording) -> ImuReadings:
        """All of a recording; saturated readings, outliers, and those that are not numbers do not count."""
        gyro = np.full_like(imu.accel, np.nan) if imu.gyro is None else imu.gyro
        values = np.concatenate([gyro, imu.accel], axis=1)
        parts = zip((gyro, imu.accel), reading_sigmas(imu), strict=True)
        with np.errstate(invalid="ignore"):
            counts = np.isfinite(values) & within_range(values, imu.noise)
            counts &= ~np.concatenate([outliers(part, sigma) for part, sigma in parts], axis=1)
        return cls(np.asarray(imu.t, dtype=np.float64), np.where(counts, values, 0.0), counts.astype(np.float64))

    def between(self, begin: float, end: float) -> ImuReadings:
        """Those of begin ≤ t < end."""
        return self[slice(*np.searchsorted(self.t, [begin, end]))]

    def __getitem__(self, which: slice | BoolArray) -> ImuReadings:
        return ImuReadings(self.t[which], self.values[which], self.counts[which])

    def __len__(self) -> int:
        return len(self.t)


def within_range(values: FloatArray, noise: ImuNoise) -> BoolArray:
    """Which readings (n, 6) = [gyro; accel] are not saturated."""
    limits = [np.inf if limit is None else _SATURATED * limit for limit in (noise.gyro_range, noise.accel_range)]
    return np.asarray(np.abs(values) < np.repeat(limits, 3))


def outliers(values: FloatArray, sigma: float) -> BoolArray:
    """Which readings (n, 3), even ones, of noise sigma are. The first and the last two are not looked at, nor what is
    beside no number."""
    found = np.zeros(values.shape, dtype=bool)
    if len(values) < 5:
        return found
    a, b, x, c, d = (values[i : len(values) - 4 + i] for i in range(5))
    usual = np.abs(b - a) + np.abs(c - b) + np.abs(d - c)
    found[2:-2] = np.abs(x - 0.5 * (b + c)) > _SIGMAS * sigma + _TIMES * usual
    return found


def reading_sigmas(recording: ImuRecording) -> FloatArray:
    """σ (2,) of a gyroscope's reading (rad/s) and of an accelerometer's (m/s²), as stated."""
    noise, root = recording.noise, np.sqrt(recording.rate_hz)
    return np.array([noise.gyro_density, noise.accel_density]) * root


def variance_about(dt: float, recording: ImuRecording, squares: FloatArray, count: FloatArray) -> FloatArray:
    """Of either sensor's readings (2,) about a spline with knots dt s apart, by sums of `count` (2,) squared residuals.

    Of noise a spline follows a part; what it cannot follow is all in the residuals.
    """
    followed = min(1.0, 1.0 / (recording.rate_hz * dt)) * reading_sigmas(recording) ** 2
    return squares / np.maximum(1.0, count) + followed


def guessed_gravity(spline: Spline, readings: ImuReadings, recording: ImuRecording) -> FloatArray:
    """Gravity in the world (3,), m/s², if the mean force were nothing else."""
    R = spline.pose(readings.t)[:, :3, :3] @ recording.T_imu_depth[:3, :3].T
    up = (R @ readings.values[:, 3:, None])[..., 0].sum(axis=0)
    return np.asarray(-recording.gravity * up / max(1e-9, float(np.linalg.norm(up))))


def missed(x: FloatArray, degree: int) -> FloatArray:
    """Part (n,) of the power of waves that a spline of a degree misses; x (n,): waves per knot."""
    power = 2 * degree + 2
    return np.asarray(1.0 - np.sinc(x) ** power / (np.sinc(x[:, None] + _ALIASES) ** power).sum(axis=1))


@dataclass(frozen=True)
class MotionBand:
    """hertz (n,) and, of all three axes together, what motion adds to the noise: rate (n,) (rad/s)²/Hz and force (n,)
    (m/s²)²/Hz. Gravity that turns with the camera is in it, little where knots matter."""

    hertz: FloatArray
    rate: FloatArray
    force: FloatArray

    @classmethod
    def of(cls, recording: ImuRecording) -> MotionBand:
        """Of a whole recording, in the mean over it; None of a gyroscope that is not there."""
        t = np.arange(recording.t[0], recording.t[-1], 1.0 / recording.rate_hz)
        noise = recording.noise
        hertz, force = _spectrum(t, recording.t, recording.accel, noise.accel_density, recording.rate_hz)
        rate = np.zeros_like(force)
        if recording.gyro is not None:
            _, rate = _spectrum(t, recording.t, recording.gyro, noise.gyro_density, recording.rate_hz)
        return cls(
            hertz,
            np.maximum(0.0, rate - 6.0 * noise.gyro_density**2),
            np.maximum(0.0, force - 6.0 * noise.accel_density**2),
        )

    def missed_motion(self, dt: float) -> tuple[float, float]:
        """Root mean square of what the best spline with knots dt s apart is off: turn (rad) and place (m)."""
        part, omega = missed(self.hertz * dt, 3), 2.0 * np.pi * self.hertz
        return self._root(part * self.rate / omega**2), self._root(part * self.force / omega**4)

    def scatter(self, dt: float) -> FloatArray:
        """(2,): root mean square of an axis of the gyroscope (rad/s) and of the accelerometer (m/s²), without their
        noise, about the best spline with knots dt s apart."""
        axis = ((2, self.rate / 3.0), (1, self.force / 3.0))
        return np.array([self._root(missed(self.hertz * dt, degree) * density) for degree, density in axis])

    @property
    def accelerations(self) -> FloatArray:
        """(6,): root mean square of an axis, m/s² and rad/s², of all that is faster than 1 Hz."""
        turning = self._root(self.rate * (2.0 * np.pi * self.hertz) ** 2 / 3.0)
        return np.repeat([self._root(self.force / 3.0), turning], 3)

    @property
    def allowed(self) -> FloatArray:
        """σ (6,) of accelerations for the motion prior, m/s² and rad/s²."""
        return np.maximum(ACCELERATION, _RARE * self.accelerations)

    def knots_s(self, focal: float, rate_hz: float) -> float:
        """The widest spacing (s) that misses less of the motion than a camera with a focal length (px) shows, and the
        densest that readings at rate_hz determine where none does."""
        usable = [dt for dt in _SPACINGS_S if dt * rate_hz >= _SAMPLES] or [_SPACINGS_S[0]]
        return next((dt for dt in usable if focal * np.hypot(*self.missed_motion(dt)) < _MOST_PX), usable[-1])

    def _root(self, density: FloatArray) -> float:
        return float(np.sqrt(density.sum() * (self.hertz[1] - self.hertz[0])))


def with_knots(options: Options, recording: ImuRecording | None, focal: float) -> Options:
    """Options with knots as dense as an IMU's motion needs them for a camera with a focal length (px), unless a spacing
    is asked for; an accelerometer alone does not determine the motion between images."""
    if options.knot_spacing_s is not None or not options.inertial or recording is None or recording.gyro is None:
        return options
    return replace(options, knot_spacing_s=MotionBand.of(recording).knots_s(focal, recording.rate_hz))


def _spectrum(
    t: FloatArray, at: FloatArray, values: FloatArray, density: float, rate_hz: float
) -> tuple[FloatArray, FloatArray]:
    """Frequencies (n,) above 0 and the power (n,) a Hz of values (k, 3), read at times (k,), all axes together.

    t: even times to take it at. density: of the noise.
    """
    from scipy.signal import welch  # only an IMU needs it

    told = (np.isfinite(values) & ~outliers(values, density * np.sqrt(rate_hz))).all(axis=1)
    even: FloatArray = np.stack([np.interp(t, at[told], axis[told]) for axis in values.T])
    length = min(len(t), max(8, round(_STRETCH_S * rate_hz)))
    # The stubs have 'literal' where SciPy has 'linear'.
    hertz, power = welch(even, rate_hz, nperseg=length, detrend="linear")  # type: ignore[call-overload]
    return np.asarray(hertz[1:]), np.asarray(power[:, 1:].sum(axis=0))
