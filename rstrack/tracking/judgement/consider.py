"""What a wrong camera file does to a pose: consider parameters (Schmidt 1966; Woodbury and Junkins, AIAA 2010).

An error of the calibration moves the point of a pixel by some `a` in the image and by some `b` in the keyframe, which
has it too. A residual changes by g·(a − b), g its derivative by a shift of the point, and an aligned pose by −H⁻¹ Jᵀ c
of these. c is made of some points of the keyframe, its landmarks: it is smooth, and they are enough.

Increments are [m; rad] in the depth camera's frame at mid readout; parameters in the order of `rig.CALIBRATION_NAMES`
and in their units.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.device.lens import Lens
from rsgen.geometry import se3
from rstrack.alignment.observation import Observation
from rstrack.alignment.spline_state import SplineState
from rstrack.data.rig import CALIBRATION_NAMES, LENS, Rig
from rstrack.images.fast_spline import motion
from rstrack.images.sampling import NEAREST
from rstrack.keyframes.keyframe import Points, Reference, strides

# Points nearer than this are left out, m; and about so many are enough.
NEAR, _POINTS = 0.05, 400
COUNT = len(CALIBRATION_NAMES)
# Keyframes whose landmarks are remembered.
_REMEMBERED = 4
_DEPTH_LENS, _COLOR_LENS, _EXTRINSICS = np.split(np.arange(COUNT - 5), (len(LENS), 2 * len(LENS)))
_DEPTH_READOUT, _COLOR_READOUT, CLOCK, _SCALE, _INVERSE = range(COUNT - 5, COUNT)
# Part of what the points see in all directions below which a direction is not seen.
_LEAST = 1e-6


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Some points of a rectified keyframe: p (n, 3) in m, normals of the surface (n, 3), and gradients of intensity
    along it (n, 3), 1/m, zero where there is none; all in the keyframe's frame. velocity (6,): [m; rad]/s of the camera
    when the keyframe was taken, in its own axes."""

    p: FloatArray
    normal: FloatArray
    gradient: FloatArray
    median_depth: float
    velocity: FloatArray

    @classmethod
    def of(cls, ref: Reference, velocity: FloatArray) -> Landmarks:
        """Of a keyframe that is on the device."""
        camera = ref.lens.camera
        stride = strides(camera.width, camera.height)[2]
        pick = np.s_[::stride, ::stride]
        every = max(1, round(np.sqrt(camera.width * camera.height / _POINTS) / stride))
        few = np.s_[every // 2 :: every, every // 2 :: every]
        rho, sx, sy = (
            image.numpy().reshape(camera.height, camera.width)[pick].astype(float)
            for image in (ref.inverse_depth, ref.slope_x, ref.slope_y)
        )
        v, u = np.mgrid[0 : camera.height : stride, 0 : camera.width : stride]
        slope = _slopes(ref.points[2], rho.shape, stride) if ref.points else np.zeros((*rho.shape, 2))
        rho, sx, sy, u, v, slope = (image[few] for image in (rho, sx, sy, u, v, slope))
        x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
        plane = np.stack([sx, sy, rho - sx * x - sy * y], axis=-1)
        known = (rho > 0.0) & (rho < 1.0 / NEAR)
        normal = plane[known] / np.linalg.norm(plane[known], axis=1, keepdims=True)
        p = np.stack([x, y, np.ones_like(x)], axis=-1)[known] / rho[known, None]
        # ∂I/∂p through the pixel; what counts of it is the part along the surface.
        at = slope[known] * (camera.fx, camera.fy) / p[:, 2:]
        gradient = np.column_stack([at, -(at * p[:, :2]).sum(axis=1) / p[:, 2]])
        return cls(p, normal, gradient, ref.median_depth, velocity)


def _slopes(points: Points, shape: tuple[int, int], stride: int) -> FloatArray:
    """∂I by pixels (h, w, 2), zero where a neighbour is missing."""
    intensity, z = (values.numpy().reshape(shape).astype(float) for values in (points.intensity, points.z))
    seen = np.where(z > 0.0, intensity, np.nan)
    dy, dx = np.gradient(seen, stride) if min(shape) > 1 else (np.full(shape, np.nan),) * 2
    return np.nan_to_num(np.stack([dx, dy], axis=-1))


@dataclass(frozen=True, eq=False)
class Coupling:
    """Of one image: J (n, 12), the residuals' derivatives by a twist of all lines, and by one that grows from the first
    line, −1, to the last, 1; c (n, 26), those by the parameters, and by colour's clock in the keyframe alone."""

    J: FloatArray
    c: FloatArray

    def twists(self, count: int, lever: float) -> FloatArray:
        """What the first `count`, 6 or 12, of the twists have to be for each of c (count, 22) to undo it.

        lever: m, that makes turns comparable to shifts.
        """
        size = np.tile(np.repeat([1.0, 1.0 / lever], 3), 2)[:count]
        J = self.J[:, :count] * size
        H = J.T @ J
        return -size[:, None] * np.linalg.solve(H + (_LEAST * np.trace(H) + 1e-12) * np.eye(count), J.T @ self.c)


@dataclass(frozen=True, eq=False)
class Rays:
    """How the cameras see: depth's and colour's lens and T_color_depth (4, 4); is_one: depth is registered."""

    depth: Lens
    color: Lens
    T_color_depth: FloatArray
    is_one: bool


def coupling(
    o: Observation, landmarks: Landmarks, rays: Rays, T_cam_ref: FloatArray, velocity: FloatArray
) -> Coupling:  # fmt: skip
    """Of an image against a keyframe. T_cam_ref (4, 4), velocity (6,): of the depth camera at mid readout."""
    R = T_cam_ref[:3, :3]
    p = landmarks.p @ R.T + T_cam_ref[:3, 3]
    T_color_depth = np.eye(4) if o.is_depth else rays.T_color_depth
    lens = o.image.exposure.lens
    q = p @ T_color_depth[:3, :3].T + T_color_depth[:3, 3]
    uv, seen = lens.camera.project(q)
    seen &= lens.camera.contains(uv) & (q[:, 2] > NEAR)
    ref_lens = rays.depth if o.is_depth else rays.color
    q_ref = landmarks.p @ T_color_depth[:3, :3].T + T_color_depth[:3, 3]
    uv_ref, seen_ref = ref_lens.camera.project(q_ref)
    seen &= seen_ref
    p, q, uv, P, q_ref, uv_ref = (some[seen] for some in (p, q, uv, landmarks.p, q_ref, uv_ref))
    normal, line = landmarks.normal[seen] @ R.T, _line(lens, uv)
    if o.is_depth:
        even = np.minimum((landmarks.median_depth / p[:, 2]) ** 2, NEAREST)
        g = g_ref = normal * even[:, None]
    else:
        gradient, center = landmarks.gradient[seen] @ R.T, -T_color_depth[:3, :3].T @ T_color_depth[:3, 3]
        g = _across(gradient, normal, p - center)
        g_ref = _across(gradient, normal, (P - center) @ R.T)
    here = _moves(rays, o.is_depth, p, q, velocity, line, lens)
    there = _moves(rays, o.is_depth, P, q_ref, landmarks.velocity, _line(ref_lens, uv_ref), lens) @ R.T
    by_keyframe = np.einsum("kni,ni->nk", there, g_ref)
    c = np.einsum("kni,ni->nk", here, g) - by_keyframe
    if not o.is_depth:
        # Where the keyframe's depth has a point, colour has it in both images: only its parallax tells.
        placed = _moves(rays, True, P, P, landmarks.velocity, _line(rays.depth, uv_ref), rays.depth) @ R.T
        c -= np.einsum("kni,ni->nk", placed, g - g_ref)
    if rays.is_one:
        c[:, _COLOR_LENS] += c[:, _DEPTH_LENS]
    j = np.column_stack([g, np.cross(p, g)])
    return Coupling(np.column_stack([j, 2.0 * line[:, None] * j]), np.column_stack([c, by_keyframe[:, CLOCK]]))


class Calibration:
    """A rig whose camera file may be wrong. rays: as a method sees it; sigmas (25,): of the parameters."""

    def __init__(self, rays: Rays, sigmas: FloatArray) -> None:
        self._rays, self.sigmas = rays, sigmas
        self._landmarks: dict[int, Landmarks] = {}
        # Of the newest frame's images: what they are like changes little while it is aligned.
        self._couplings: dict[tuple[int, int, float, bool], Coupling] = {}
        self._known: dict[tuple[int, int, float, bool, int], FloatArray] = {}

    @classmethod
    def of(cls, rig: Rig, depth: Lens, color: Lens) -> Calibration:
        """Of a rig whose cameras a method sees through these lenses."""
        is_one = rig.is_registered
        return cls(Rays(depth, color, rig.T_color_depth, is_one), rig.sigma.vector(is_one))

    def anew(self) -> Calibration:
        """The same with nothing remembered: a keyframe's landmarks are of when it was first looked at."""
        return Calibration(self._rays, self.sigmas)

    @property
    def is_exact(self) -> bool:
        """Whether nothing may be wrong: then nothing is worked out."""
        return not self.sigmas.any()

    def moved(self, o: Observation, state: SplineState, velocity: FloatArray, count: int = 6) -> FloatArray:
        """How one σ of each parameter would have an image move its lines (count, 25), against a rectified keyframe.

        velocity (6,): at which that was taken. count: 6 for all lines alike, 12 as of `Observation.steady`.
        """
        return self._twists(o, state, velocity, count)[:, :COUNT] * self.sigmas

    def lagging(self, o: Observation, state: SplineState, velocity: FloatArray) -> FloatArray:
        """How the lines (12,) of an image move by each second that its keyframe alone has colour stamped too early."""
        return self._twists(o, state, velocity, 12)[:, COUNT]

    def _twists(self, o: Observation, state: SplineState, velocity: FloatArray, count: int) -> FloatArray:
        key = o.frame, o.ref.index, o.image.exposure.first_time, o.is_depth
        if key not in self._couplings:
            if any(frame != o.frame for frame, *_ in self._couplings):
                self._couplings.clear()
                self._known.clear()
            T_world_cam, own = motion(state.spline, o.image.exposure.mid_time)
            T_cam_ref = se3.inverse(T_world_cam) @ o.ref.T_world_base
            self._couplings[key] = coupling(o, self._seen(o.ref, velocity), self._rays, T_cam_ref, own)
        if (*key, count) not in self._known:
            self._known[*key, count] = self._couplings[key].twists(count, o.ref.median_depth)
        return self._known[*key, count]

    def _seen(self, ref: Reference, velocity: FloatArray) -> Landmarks:
        found = self._landmarks.get(ref.index)
        if found is None:
            found = Landmarks.of(ref, velocity)
            for oldest in list(self._landmarks)[: len(self._landmarks) - _REMEMBERED + 1]:
                del self._landmarks[oldest]
            self._landmarks[ref.index] = found
        return found


def _moves(
    rays: Rays, is_depth: bool, p: FloatArray, q: FloatArray, velocity: FloatArray, line: FloatArray, lens: Lens
) -> FloatArray:  # fmt: skip
    """By how much errors of the parameters move points (25, n, 3) in the depth camera's axes, if a camera sees them.

    p, q (n, 3): the points in the depth camera's frame and in that camera's; velocity (6,): of the depth camera; line
    (n,): when they are seen, see `_line`.
    """
    out = np.zeros((COUNT, *p.shape))
    x, y, z = (q / q[:, 2:]).T[0], (q / q[:, 2:]).T[1], q[:, 2]
    r2, xy, zero = x * x + y * y, 2.0 * x * y, np.zeros_like(x)
    pinhole = [x, y], [zero, y], [zero + 1, zero], [zero, zero + 1]
    bent = [x * r2, y * r2], [xy, r2 + 2 * y * y], [r2 + 2 * x * x, xy]
    by_lens = -z * np.array([*pinhole, *bent])
    turned = by_lens.transpose(0, 2, 1) @ (np.eye(3) if is_depth else rays.T_color_depth[:3, :3])[:2]
    rolled = velocity[:3] + np.cross(velocity[3:], p)
    if is_depth:
        out[_DEPTH_LENS] = turned
        out[_SCALE], out[_INVERSE] = p, -p[:, 2:] * p
        out[_DEPTH_READOUT] = rolled * line[:, None] if lens.lines > 1 else 0.0
        return out
    R = rays.T_color_depth[:3, :3]
    out[_COLOR_LENS] = turned
    for axis in range(3):
        unit = np.eye(3)[axis]
        out[_EXTRINSICS[axis]] = -unit @ R
        out[_EXTRINSICS[3 + axis]] = -np.cross(unit, q) @ R
    out[_COLOR_READOUT] = rolled * line[:, None] if lens.lines > 1 else 0.0
    out[CLOCK] = rolled
    return out


def _across(gradient: FloatArray, normal: FloatArray, ray: FloatArray) -> FloatArray:
    """Derivatives (n, 3) of what a camera sees along rays (n, 3) by a shift of the points: as `gradient` (n, 3) along
    the surface, none along the ray."""
    slant = (normal * ray).sum(axis=1, keepdims=True)
    slant = np.where(np.abs(slant) > 0.1 * np.linalg.norm(ray, axis=1, keepdims=True), slant, np.inf)
    return gradient - normal * (gradient * ray).sum(axis=1, keepdims=True) / slant


def _line(lens: Lens, uv: FloatArray) -> FloatArray:
    """When pixels (n, 2) are read, from −½, the first line, to ½: (n,)."""
    if lens.lines == 1:
        return np.zeros(len(uv))
    along = uv[:, 1] if lens.shutter.by_rows else uv[:, 0]
    part = along / (lens.lines - 1.0) - 0.5
    return np.asarray(part if lens.shutter.direction > 0.0 else -part)
