"""Splines of things that move by themselves: T_world_object(t) of a config's `objects`, over all of a sequence."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from rsgen.array_types import FloatArray
from rsgen.config.motion import ObjectConfig, ObjectMotionConfig, Waypoint
from rsgen.errors import UserError
from rsgen.geometry import se3, so3
from rsgen.geometry.spline import Spline
from rsgen.motion.fit import fit_spline
from rsgen.motion.free_space import nearest_surface
from rsgen.motion.make import TourCurve
from rsgen.sequence.trajectory import Trajectory, read_trajectory

_RATE_HZ = 200.0
_LEVEL = 0.02  # sine of a way's angle to the vertical below which it has no heading
_CLOCK_S = 1e-6
_CHECK_S = 0.005
_NEAR_M = 0.02  # a camera this near a surface is in it


def object_spline(thing: ObjectConfig, begin: float, end: float, before: float, after: float) -> Spline:
    """T_world_object(t) of a thing over the sequence's poses, `begin` to `end` s, and `before` and `after` s beyond.

    Raises UserError, naming the object, if its motion is too short or cannot be made.
    """
    motion = thing.motion
    where = f"objects.{thing.name}.motion"
    try:
        if motion.kind == "file":
            assert motion.file is not None  # or the config were refused
            poses = read_trajectory(motion.file)
            _expect_to_last(poses.stamps, begin, end, f"its file {motion.file}")
        elif motion.kind == "waypoints":
            times = begin + np.array([w.time_s for w in motion.waypoints])
            _expect_to_last(times, begin, end, "its waypoints")
            poses = _through(motion, times)
        else:
            first, last = begin - before, end + after
            t = np.linspace(first, last, math.ceil((last - first) * _RATE_HZ) + 2)
            kinds = {"circle": _circle, "swing": _swing, "drive": _drive}
            poses = Trajectory(t, kinds[motion.kind](motion, t - begin) @ _own_turning(motion, t - begin))
        pad_begin, pad_end = (max(float(x), 0.0) for x in (poses.stamps[0] - begin + before,
                                                           end + after - poses.stamps[-1]))  # fmt: skip
        return fit_spline(poses, dt=motion.knot_spacing_s, pad_begin_s=pad_begin, pad_end_s=pad_end).spline
    except UserError as error:
        raise UserError(f"{where}: {error}") from None


def _expect_to_last(stamps: FloatArray, begin: float, end: float, what: str) -> None:
    if stamps[0] > begin + _CLOCK_S or stamps[-1] < end - _CLOCK_S:
        raise UserError(
            f"{what} last from {stamps[0]:g} to {stamps[-1]:g} s, the sequence from {begin:g} to {end:g} s: add poses"
        )


def _through(motion: ObjectMotionConfig, times: FloatArray) -> Trajectory:
    """Smooth motion through poses: cubic in position, and in rotation after SciPy's `RotationSpline`."""
    p = np.array([w.position for w in motion.waypoints])
    R = Rotation.from_rotvec(np.radians([w.rotation_deg for w in motion.waypoints]))
    t = np.linspace(times[0], times[-1], max(math.ceil((times[-1] - times[0]) * _RATE_HZ), 8) + 1)
    return Trajectory(t, _poses(CubicSpline(times, p, bc_type="natural")(t), RotationSpline(times, R)(t).as_matrix()))


def _poses(p_world: FloatArray, R: FloatArray) -> FloatArray:
    T = np.tile(np.eye(4), (len(p_world), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R, p_world
    return T


def _own_turning(motion: ObjectMotionConfig, t: FloatArray) -> FloatArray:
    """(n, 4, 4) of the object in its place: `rotation_deg`, then the spin about its own y axis."""
    turn = so3.exp(np.radians(motion.rotation_deg)) @ so3.exp(
        np.radians(motion.spin_deg_s) * t[:, None] * np.array([0.0, 1.0, 0.0])
    )
    return _poses(np.zeros((len(t), 3)), turn)


def _circle(motion: ObjectMotionConfig, t: FloatArray) -> FloatArray:
    """Level, anticlockwise seen from above; the object's z axis goes ahead."""
    assert motion.radius_m is not None and motion.period_s is not None
    angle = math.radians(motion.phase_deg) + 2 * math.pi * t / motion.period_s
    place = motion.radius_m * np.stack([np.cos(angle), np.zeros_like(t), -np.sin(angle)], axis=-1)
    heading = so3.exp((angle + math.pi)[:, None] * np.array([0.0, 1.0, 0.0]))
    return _poses(np.asarray(motion.position) + place, heading)


def _swing(motion: ObjectMotionConfig, t: FloatArray) -> FloatArray:
    """Turned about the pivot's axis to and fro, sinusoidally."""
    assert motion.angle_deg is not None and motion.period_s is not None
    angle = math.radians(motion.angle_deg) * np.sin(math.radians(motion.phase_deg) + 2 * np.pi * t / motion.period_s)
    axis = np.asarray(motion.axis, float) / np.linalg.norm(motion.axis)
    turn = so3.exp(angle[:, None] * axis)
    pivot = np.asarray(motion.pivot, float)
    return _poses(pivot + turn @ (np.asarray(motion.position, float) - pivot), turn)


def _drive(motion: ObjectMotionConfig, t: FloatArray) -> FloatArray:
    """Along a smooth curve through the points, the object's z axis ahead, its y axis up; to and fro: sinusoidally."""
    assert motion.speed_m_s is not None
    try:
        curve = TourCurve.through([Waypoint(position=p, target=p) for p in motion.points], motion.closed)
    except UserError as error:
        raise UserError(str(error).removeprefix("motion: ").replace("waypoints", "points")) from None
    s = motion.speed_m_s * t
    if not motion.closed:
        s = 0.5 * curve.length * (1.0 - np.cos(np.pi * s / curve.length))
    u = curve.u(s % curve.length if motion.closed else s)
    p_world, ahead = curve.both(u)[:, :3], curve.both(u, 1)[:, :3]
    along = np.linalg.norm(ahead[:, ::2], axis=-1)
    if (along <= _LEVEL * np.linalg.norm(ahead, axis=-1)).any():
        raise UserError("it drives straight up or down, where it has no heading: use kind waypoints")
    heading = np.arctan2(ahead[:, 0], ahead[:, 2])
    return _poses(p_world, so3.exp(heading[:, None] * np.array([0.0, 1.0, 0.0])))


def check_objects_clear(
    names: Sequence[str], splines: Sequence[Spline], triangles: Sequence[FloatArray], camera: Spline,
    span: tuple[float, float], cameras: Sequence[FloatArray],
) -> None:  # fmt: skip
    """Raises UserError if an object comes through a camera within `span` (s). triangles (m, 3, 3): in its frame.

    camera: T_world_body; cameras: T_cam_body (4, 4) of each.
    """
    for name, spline, corners in zip(names, splines, triangles, strict=True):
        radius = float(np.linalg.norm(corners, axis=-1).max()) + _NEAR_M
        for T_eye_body in cameras:

            def way(t: FloatArray, spline: Spline = spline, T_eye: FloatArray = T_eye_body) -> FloatArray:
                return np.asarray((se3.inverse(spline.pose(t)) @ camera.pose(t) @ se3.inverse(T_eye))[:, :3, 3])

            t = np.linspace(*span, max(2, math.ceil((span[1] - span[0]) / _CHECK_S)))
            fastest = float(np.linalg.norm(np.diff(way(t), axis=0), axis=1).max())
            t = np.linspace(*span, len(t) * max(1, math.ceil(fastest / _NEAR_M)))  # no step leaps over a surface
            p = way(t)
            close = np.flatnonzero(np.linalg.norm(p, axis=-1) < radius)
            if not len(close):
                continue
            distance, _ = nearest_surface(p[close], corners, _NEAR_M)
            if np.isfinite(distance).any():
                when = t[close[int(np.argmax(np.isfinite(distance)))]]
                raise UserError(
                    f"objects.{name}: comes through the camera at {when:.3f} s: move its path or the camera's"
                )
