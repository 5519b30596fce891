"""An IMU's readings over a whole recording, for the graph: residuals at their own stamps, and what is not known of it.

By `rstrack.inertial.factor`. Biases are linear between knots about a second apart and walk from one to the next;
gravity is one vector in the spline's world; T_imu_depth and the scales are nearly what is stated. In the graph's blocks
of six numbers there are, last of all: T_imu_depth's left increment, the scales, the knots, and gravity, three numbers
of which are unused.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray, IntArray
from rsgen.geometry import se3, so3
from rsgen.geometry.spline import Spline
from rstrack.data.imu.recording import ImuRecording
from rstrack.inertial.band import ImuReadings, MotionBand, guessed_gravity, reading_sigmas, variance_about
from rstrack.inertial.estimate import STRENGTH, ImuEstimate, bias_walk
from rstrack.inertial.factor import ImuFactor, motion

# About how far apart the biases' knots are, s.
_KNOT_S = 1.0
# Blocks of six that a sample depends on: control points, T_imu_depth, scales, knots of the biases and gravity.
_BLOCKS = 4 + 1 + 1 + 2 + 1
# σ of what is stated: of T_imu_depth (m, rad), and of scales, which data sheets of cheap IMUs state to a hundredth.
_PLACE, _SCALE = np.repeat([5e-3, 1e-2], 3), 5e-3
# Samples linearised at once: intermediate matrices then stay small.
_AT_ONCE = 4096


@dataclass(frozen=True)
class Equations:
    """Normal equations of n parts: numbers (n, k) of the blocks of six each depends on, H (n, 6 k, 6 k), g (n, 6 k)."""

    numbers: IntArray
    H: FloatArray
    g: FloatArray


@dataclass(frozen=True)
class ImuState:
    """Values of an IMU. biases (m, 6) = [gyroscope rad/s; accelerometer m/s²] at its knots; gravity (3,) in
    the world, m/s²; T_imu_depth (4, 4); scales (6,) of gyroscope and accelerometer, parts."""

    biases: FloatArray
    gravity: FloatArray
    T_imu_depth: FloatArray
    scales: FloatArray = field(default_factory=lambda: np.zeros(6))

    def __len__(self) -> int:
        """Blocks of six."""
        return len(self.biases) + 3

    def moved(self, step: FloatArray) -> ImuState:
        """After a step (m + 3, 6)."""
        T = se3.orthonormalise(se3.exp(step[0]) @ self.T_imu_depth)
        return ImuState(self.biases + step[2:-1], self.gravity + step[-1, :3], T, self.scales + step[1])

    def turned(self, R: FloatArray) -> ImuState:
        """In a world that is turned by R (3, 3)."""
        return replace(self, gravity=R @ self.gravity)


@dataclass(frozen=True)
class ImuResult:
    """What was estimated of an IMU. estimate: of the biases in the end, of gravity and of the turn; sigmas (12,): of
    T_imu_depth's left increment (m, rad) and of the scales."""

    state: ImuState
    estimate: ImuEstimate
    sigmas: FloatArray

    @classmethod
    def of(cls, state: ImuState, T_imu_depth: FloatArray, inverse: Callable[[IntArray], FloatArray]) -> ImuResult:
        """T_imu_depth (4, 4): as it was stated. inverse: the covariance of unknowns, whose numbers count from the end,
        below 0."""
        own = np.arange(12) - 6 * len(state)
        last = inverse(np.concatenate([np.arange(-12, -3), own[3:6]]))
        turn = so3.log(state.T_imu_depth[:3, :3] @ T_imu_depth[:3, :3].T)
        numbers = np.concatenate([state.biases[-1], state.gravity, turn])
        estimate = ImuEstimate(numbers, np.asarray(np.linalg.inv(0.5 * (last + last.T))))
        return cls(state, estimate, np.sqrt(np.diag(inverse(own))))

    def as_dict(self) -> dict[str, Any]:
        """T_imu_depth and scales, for run.json."""
        return {
            "T_imu_depth": self.state.T_imu_depth.tolist(),
            "T_imu_depth_sigma": self.sigmas[:6].tolist(),
            "scales": self.state.scales.tolist(),
            "scales_sigma": self.sigmas[6:].tolist(),
        }

    def text(self, T_imu_depth: FloatArray) -> str:
        """How far it is from where it was stated (4, 4) to be."""
        off = np.linalg.norm(se3.log(self.state.T_imu_depth @ se3.inverse(T_imu_depth)).reshape(2, 3), axis=1)
        sigma = self.sigmas[:6].reshape(2, 3).max(axis=1)
        return (
            f"{1e3 * off[0]:.1f} mm (σ {1e3 * sigma[0]:.1f}) and {np.degrees(off[1]):.2f}° "
            f"(σ {np.degrees(sigma[1]):.2f}) from where T_imu_depth has it"
        )


@dataclass(frozen=True)
class ImuTerm:
    """What is given. samples: those that count, within the spline. sigma (2,): of a gyroscope's reading (rad/s)
    and of an accelerometer's (m/s²) about the spline; noise (2,): what they are at least. accelerations (6,): σ for the
    motion prior, m/s² and rad/s². segment, per: the segment at which the first knot of the biases is, and segments from
    knot to knot.
    """

    recording: ImuRecording
    samples: ImuReadings
    noise: FloatArray
    sigma: FloatArray
    accelerations: FloatArray
    segment: int
    per: int

    @classmethod
    def of(cls, recording: ImuRecording, spline: Spline, valid: FloatArray) -> ImuTerm | None:
        """Of the samples within valid (k, 2), s: where the spline is an estimate; None without any, or a gyroscope."""
        samples = ImuReadings.of(recording)
        begin, end = np.maximum(valid[:, 0], spline.t_begin), np.minimum(valid[:, 1], spline.t_end)
        inside = np.asarray(((samples.t[:, None] >= begin) & (samples.t[:, None] < end)).any(axis=1))
        if recording.gyro is None or not inside.any():
            return None
        samples = samples[inside]
        band, noise = MotionBand.of(recording), reading_sigmas(recording)
        sigma = np.hypot(noise, band.scatter(spline.dt))
        per = max(1, round(_KNOT_S / spline.dt))
        return cls(recording, samples, noise, sigma, band.allowed, int(spline.locate(samples.t[0])[0]), per)

    def start(self, spline: Spline) -> ImuState:
        """No biases, and gravity along what the mean force would be if it were nothing else."""
        last = int(spline.locate(self.samples.t[-1])[0])
        gravity = guessed_gravity(spline, self.samples, self.recording)
        biases = np.zeros(((last - self.segment) // self.per + 2, 6))
        return ImuState(biases, gravity, self.recording.T_imu_depth)

    def equations(self, spline: Spline, state: ImuState) -> Iterator[Equations]:
        """All samples' normal equations, a part for each segment; the IMU's own blocks count from the end, below 0."""
        own = np.array([-len(state), 1 - len(state)])
        for r, J, first, knot in self._rows(spline, state):
            starts = np.flatnonzero(np.diff(first, prepend=-1))
            group = np.cumsum(np.diff(first, prepend=first[0]) != 0)
            within = np.arange(len(first)) - starts[group]
            padded = np.zeros((len(starts), int(within.max()) + 1, 6, 6 * _BLOCKS + 1))
            padded[group, within] = np.concatenate([J, r[..., None]], axis=2)
            rows = padded.reshape(len(starts), -1, 6 * _BLOCKS + 1)
            total = np.swapaxes(rows, 1, 2) @ rows
            points, knots = first[starts, None] + np.arange(4), knot[starts, None] + np.arange(2, 4) - len(state)
            each = np.ones((len(starts), 1), dtype=int)
            numbers = np.concatenate([points, each * own, knots, -each], axis=1)
            yield Equations(numbers, total[:, :-1, :-1], total[:, :-1, -1])

    def known(self, state: ImuState, dt: float) -> Iterator[Equations]:
        """What is known beforehand: how biases walk and how large they are, how strong gravity is."""
        m, size = len(state.biases), float(np.linalg.norm(state.gravity))
        walk = bias_walk(self.recording.noise, self.per * dt) ** -2.0
        place, scale = _PLACE**-2.0, np.full(6, _SCALE**-2.0)
        loose = np.diag(ImuEstimate.initial(state.gravity).information)[:6]
        along = np.append(state.gravity / size, np.zeros(3))
        off = se3.log(state.T_imu_depth @ se3.inverse(self.recording.T_imu_depth))
        J = se3.left_jacobian_inv(off)
        step = np.diff(state.biases, axis=0) * walk
        between = np.broadcast_to(np.kron([[1.0, -1.0], [-1.0, 1.0]], np.diag(walk)), (m - 1, 12, 12))
        numbers = np.arange(m - 1)[:, None] + np.arange(2) - m - 1
        yield Equations(numbers, between, np.concatenate([-step, step], axis=1))
        for number, H, g in (
            (0, J.T @ (place[:, None] * J), J.T @ (place * off)),
            (1, np.diag(scale), scale * state.scales),
            (2, np.diag(loose), loose * state.biases[0]),
            (m + 2, np.outer(along, along) / STRENGTH**2, along * (size - self.recording.gravity) / STRENGTH**2),
            (m + 2, np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0]), np.zeros(6)),
        ):
            yield Equations(np.array([[number - len(state)]]), H[None], g[None])

    def learnt(self, spline: Spline, state: ImuState) -> ImuTerm:
        """With σ as readings scatter about a spline, of whose noise that follows a part."""
        squares = np.zeros(2)
        for r, *_ in self._rows(spline, state):
            squares += ((r * np.repeat(self.sigma, 3)) ** 2).reshape(-1, 2, 3).sum(axis=(0, 2))
        number = self.samples.counts.reshape(-1, 2, 3).sum(axis=(0, 2))
        sigma = np.sqrt(variance_about(spline.dt, self.recording, squares, number))
        return replace(self, sigma=np.where(number > 0.0, np.maximum(self.noise, sigma), self.sigma))

    def _rows(self, spline: Spline, state: ImuState) -> Iterator[tuple[FloatArray, FloatArray, IntArray, IntArray]]:
        """Residuals (n, 6) and their derivatives (n, 6, 54), in σ, the first control point and knot (n,) of each: of
        whole segments, some at once."""
        segment, u = spline.locate(self.samples.t)
        begin = 0
        while begin < len(segment):
            end = len(segment)
            if begin + _AT_ONCE < end:
                end = int(np.searchsorted(segment, segment[begin + _AT_ONCE]))
                end = end if end > begin else int(np.searchsorted(segment, segment[begin], side="right"))
            part = slice(begin, end)
            samples = self.samples[part]
            at = ImuFactor(motion(spline, samples.t), state.T_imu_depth, state.gravity)
            scale = 1.0 + state.scales
            knot, rest = np.divmod(segment[part] - self.segment, self.per)
            late = ((rest + u[part]) / self.per)[:, None]
            bias = (1.0 - late) * state.biases[knot] + late * state.biases[knot + 1]
            J = np.zeros((len(late), 6, 6 * _BLOCKS))
            J[:, :, :24], J[:, :, 48:51] = at.by_motion, at.by_gravity
            J[:, :, 24:27], J[:, :, 27:30] = at.by_translation, at.by_rotation
            J *= scale[:, None]
            J[:, :, 30:36] = at.readings[..., None] * np.eye(6)
            J[:, :, 36:42] = (1.0 - late)[..., None] * np.eye(6)
            J[:, :, 42:48] = late[..., None] * np.eye(6)
            root = samples.counts / np.repeat(self.sigma, 3)
            r = scale * at.readings + bias - samples.values
            yield root * r, root[..., None] * J, at.motion.first, knot
            begin = end
