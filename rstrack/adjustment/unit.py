"""An IMU's readings over a whole recording, for the graph: residuals at their own stamps, biases that walk, gravity.

Biases are linear between knots about a second apart, gravity is one vector in the spline's world. In the graph's
blocks of six numbers each knot is one, [gyroscope; accelerometer], and gravity another, whose last three say nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from rsgen.array_types import FloatArray, IntArray
from rsgen.geometry.spline import Spline
from rstrack.data.imu.recording import ImuRecording
from rstrack.inertial.band import Band
from rstrack.inertial.belief import GRAVITY, SIZE, STRENGTH, WARMS, Belief
from rstrack.inertial.residuals import Rows, Samples

# About how far apart the biases' knots are, s.
_KNOT_S = 1.0
# Control points, knots of the biases and gravity that a sample depends on: blocks of six.
_BLOCKS = 4 + 2 + 1
# Samples linearised at once: intermediate matrices then stay small.
_AT_ONCE = 4096


@dataclass(frozen=True)
class Sums:
    """Normal equations of n parts: numbers (n, k) of the blocks of six each depends on, H (n, 6 k, 6 k), g (n, 6 k)."""

    numbers: IntArray
    H: FloatArray
    g: FloatArray


@dataclass(frozen=True)
class Biases:
    """values (m, 6) = [gyroscope rad/s; accelerometer m/s²] at the unit's knots; gravity (3,) in the world, m/s²."""

    values: FloatArray
    gravity: FloatArray

    def __len__(self) -> int:
        """Blocks of six."""
        return len(self.values) + 1

    @property
    def last(self) -> FloatArray:
        """The nine numbers (9,) of a `Belief`, in the end."""
        return np.concatenate([self.values[-1], self.gravity])

    def moved(self, step: FloatArray) -> Biases:
        """After a step (m + 1, 6)."""
        return Biases(self.values + step[:-1], self.gravity + step[-1, :3])

    def turned(self, R: FloatArray) -> Biases:
        """In a world that is turned by R (3, 3)."""
        return replace(self, gravity=R @ self.gravity)


@dataclass(frozen=True)
class Unit:
    """What is given. samples: those that count, at times the spline knows. sigma (2,): of a gyroscope's reading (rad/s)
    and of an accelerometer's (m/s²) about the spline; noise (2,): what they are at least. accelerations (6,): σ for the
    motion prior, m/s² and rad/s². segment, per: the segment at which the first knot of the biases is, and segments from
    knot to knot.
    """

    recording: ImuRecording
    samples: Samples
    noise: FloatArray
    sigma: FloatArray
    accelerations: FloatArray
    segment: int
    per: int

    @classmethod
    def of(cls, recording: ImuRecording, spline: Spline, valid: FloatArray) -> Unit | None:
        """Of the samples within valid (k, 2), s: where the spline is an estimate; None without any, or a gyroscope."""
        samples = Samples.of(recording)
        begin, end = np.maximum(valid[:, 0], spline.t_begin), np.minimum(valid[:, 1], spline.t_end)
        inside = ((samples.t[:, None] >= begin) & (samples.t[:, None] < end)).any(axis=1)
        if recording.gyro is None or not inside.any():
            return None
        samples = Samples(samples.t[inside], samples.values[inside], samples.counts[inside])
        band, root = Band.of(recording), np.sqrt(recording.rate_hz)
        noise = np.array([recording.noise.gyro_density, recording.noise.accel_density]) * root
        sigma = np.hypot(noise, band.scatter(spline.dt))
        per = max(1, round(_KNOT_S / spline.dt))
        return cls(recording, samples, noise, sigma, band.allowed, int(spline.locate(samples.t[0])[0]), per)

    def start(self, spline: Spline) -> Biases:
        """No biases, and gravity along what the mean force would be if it were nothing else."""
        last = int(spline.locate(self.samples.t[-1])[0])
        R = spline.pose(self.samples.t)[:, :3, :3] @ self.recording.T_imu_depth[:3, :3].T
        up = (R @ self.samples.values[:, 3:, None])[..., 0].sum(axis=0)
        gravity = -self.recording.gravity * up / max(1e-9, float(np.linalg.norm(up)))
        return Biases(np.zeros(((last - self.segment) // self.per + 2, 6)), gravity)

    def said(self, spline: Spline, biases: Biases) -> Iterator[Sums]:
        """All samples' normal equations, a part for each segment; blocks of biases and gravity count from −m − 1 on."""
        for r, J, first, knot in self._rows(spline, biases):
            starts = np.flatnonzero(np.diff(first, prepend=-1))
            group = np.cumsum(np.diff(first, prepend=first[0]) != 0)
            within = np.arange(len(first)) - starts[group]
            padded = np.zeros((len(starts), int(within.max()) + 1, 6, 6 * _BLOCKS + 1))
            padded[group, within] = np.concatenate([J, r[..., None]], axis=2)
            rows = padded.reshape(len(starts), -1, 6 * _BLOCKS + 1)
            total = np.swapaxes(rows, 1, 2) @ rows
            knots = knot[starts, None] + np.arange(2) - len(biases)
            numbers = np.concatenate([first[starts, None] + np.arange(4), knots, np.full((len(starts), 1), -1)], axis=1)
            yield Sums(numbers, total[:, :-1, :-1], total[:, :-1, -1])

    def known(self, biases: Biases, dt: float) -> Iterator[Sums]:
        """What is known beforehand: how biases walk and how large they are, how strong gravity is."""
        m, walk = len(biases.values), self._walk(dt) ** -2.0
        step = np.diff(biases.values, axis=0) * walk
        H = np.broadcast_to(np.kron([[1.0, -1.0], [-1.0, 1.0]], np.diag(walk)), (m - 1, 12, 12))
        yield Sums(np.arange(m - 1)[:, None] + np.arange(2) - len(biases), H, np.concatenate([-step, step], axis=1))
        loose = np.diag(Belief.initial(biases.gravity).information)
        yield Sums(np.array([[-len(biases)]]), np.diag(loose[:6])[None], (loose[:6] * biases.values[0])[None])
        size = float(np.linalg.norm(biases.gravity))
        along = biases.gravity / size
        H_gravity = np.eye(6)
        H_gravity[:3, :3] = np.outer(along, along) / STRENGTH**2
        g_gravity = np.append(along * (size - self.recording.gravity) / STRENGTH**2, np.zeros(3))
        yield Sums(np.array([[-1]]), H_gravity[None], g_gravity[None])

    def learnt(self, spline: Spline, biases: Biases) -> Unit:
        """With σ as readings scatter about a spline, of whose noise that follows a part."""
        squares = np.zeros(2)
        for r, *_ in self._rows(spline, biases):
            squares += ((r * np.repeat(self.sigma, 3)) ** 2).reshape(-1, 2, 3).sum(axis=(0, 2))
        number = self.samples.counts.reshape(-1, 2, 3).sum(axis=(0, 2))
        followed = min(1.0, 1.0 / (self.recording.rate_hz * spline.dt)) * self.noise**2
        sigma = np.sqrt(squares / np.maximum(1.0, number) + followed)
        return replace(self, sigma=np.where(number > 0.0, np.maximum(self.noise, sigma), self.sigma))

    def _walk(self, dt: float) -> FloatArray:
        """σ (6,) of the biases' steps from knot to knot."""
        noise, seconds = self.recording.noise, self.per * dt
        walk = np.array([noise.gyro_walk, noise.accel_walk]) * np.sqrt(seconds)
        return np.repeat(np.hypot(walk, np.array(WARMS) * seconds), 3)

    def _rows(self, spline: Spline, biases: Biases) -> Iterator[tuple[FloatArray, FloatArray, IntArray, IntArray]]:
        """Residuals (n, 6) and their derivatives (n, 6, 42), in σ, the first control point and knot (n,) of each: of
        whole segments, some at once."""
        nine = np.zeros(SIZE)
        nine[GRAVITY] = biases.gravity
        segment, u = spline.locate(self.samples.t)
        begin = 0
        while begin < len(segment):
            end = len(segment)
            if begin + _AT_ONCE < end:
                end = int(np.searchsorted(segment, segment[begin + _AT_ONCE]))
                end = end if end > begin else int(np.searchsorted(segment, segment[begin], side="right"))
            part = slice(begin, end)
            samples = Samples(self.samples.t[part], self.samples.values[part], self.samples.counts[part])
            rows = Rows.of(spline, samples, self.recording.T_imu_depth, nine)
            knot, rest = np.divmod(segment[part] - self.segment, self.per)
            late = ((rest + u[part]) / self.per)[:, None]
            root = samples.counts / np.repeat(self.sigma, 3)
            r = rows.r + (1.0 - late) * biases.values[knot] + late * biases.values[knot + 1]
            J = np.zeros((len(r), 6, 6 * _BLOCKS))
            J[:, :, :24], J[:, :, 36:39] = rows.J[:, :, :24], rows.J[:, :, 24:][:, :, GRAVITY]
            J[:, :, 24:30] = (1.0 - late)[..., None] * np.eye(6)
            J[:, :, 30:36] = late[..., None] * np.eye(6)
            yield root * r, root[..., None] * J, rows.first, knot
            begin = end
