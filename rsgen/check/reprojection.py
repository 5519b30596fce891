"""Depth checked: carried to the next frame with the poses of their rows, and against an independent ray caster."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from rsgen.array_types import BoolArray, FloatArray, IntArray
from rsgen.errors import UserError, how_to_install
from rsgen.geometry import se3
from rsgen.geometry.shutter import project_rolling
from rsgen.geometry.spline import Spline
from rsgen.sequence.images import COLOR_DEPTH, ImageStream, Rig

# Depth is interpolated bilinearly in 1/z, exact on planes. Where second differences say that this is off by more, there
# is an edge, or a curve too tight for the pixels: such places say nothing about poses, at any resolution.
INTERPOLATION_M = 0.0005
# A point this much (relative to its depth) behind the surface seen at its place is hidden by that surface.
OCCLUDED = 0.02
# Exact depth leaves the interpolation's error: micrometres on planes, tens of them on curved things. Another frame's
# depth or time leaves millimetres: at a walking pace of 0.5 m/s a frame is 17 mm and mid readout 7 mm.
MEDIAN_TOLERANCE_M = 0.0002
INLIER_M = 0.002
INLIER_SHARE = 0.95
MINIMUM_PIXELS = 50
OCCLUDED_SHARE = 0.5
_SCENE_FRAMES = 5
_STEP_PX = 4
_TARGET_PIXELS = 3000  # small images are sampled more densely than every fourth pixel


@dataclass(frozen=True, eq=False)
class RelativeMotion:
    """T_object_body(t) of a body and an object along splines; `project_rolling` takes it in the place of a spline."""

    body: Spline
    thing: Spline

    @property
    def t_begin(self) -> float:
        """First time at which both are known, s."""
        return max(self.body.t_begin, self.thing.t_begin)

    @property
    def t_end(self) -> float:
        """Last time at which both are known, s."""
        return min(self.body.t_end, self.thing.t_end)

    def pose(self, t: FloatArray) -> FloatArray:
        """T_object_body (..., 4, 4) at times (...,) s."""
        return np.asarray(se3.inverse(self.thing.pose(t)) @ self.body.pose(t))

    def pose_and_velocity(self, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """`pose`, and the body's twist (..., 6) against the object in the body's frame, m/s and rad/s."""
        T_world_body, w_body = self.body.pose_and_velocity(t)
        T_world_object, w_object = self.thing.pose_and_velocity(t)
        T_object_body = se3.inverse(T_world_object) @ T_world_body
        back = se3.adjoint(se3.inverse(T_object_body))
        return T_object_body, w_body - np.einsum("...ij,...j->...i", back, w_object)


@dataclass(frozen=True)
class Reprojection:
    """Depth of one frame in the next: predicted minus observed z (n,) in metres where both see the same surface.

    `occluded` more pixels are hidden there by a nearer surface. number (n,): of the object that moves; 0: the scene.
    """

    residual: FloatArray
    occluded: int
    number: IntArray


def check_reprojection(sequence: Rig, name: str, pairs: int) -> tuple[bool, str]:
    """Of a depth camera. The worst pair decides: one frame that does not fit must not drown in nineteen that do."""
    sequence = sequence.seen_from(name)
    neighbours = _neighbours(sequence, name, pairs)
    if not neighbours:
        return True, "no two neighbouring depth frames: nothing to compare"
    sizes, worst, ok = [], (-1.0, ""), True
    for k, next_k in neighbours:
        result = reproject_depth(sequence, k, next_k, name)
        size = np.abs(result.residual)
        frame = "frames {}-{}".format(*sequence.streams[name].indices[[k, next_k]])
        if len(size) < max(MINIMUM_PIXELS, OCCLUDED_SHARE * (len(size) + result.occluded)):
            return False, f"{frame}: only {len(size)} pixels agree on a surface, {result.occluded} are hidden"
        median, share = float(np.median(size)), float((size <= INLIER_M).mean())
        ok &= median <= MEDIAN_TOLERANCE_M and share >= INLIER_SHARE
        for which in np.unique(result.number[result.number > 0]):  # nor an object that moves another way
            part = size[result.number == which]
            if len(part) >= MINIMUM_PIXELS and not np.median(part) <= INLIER_M:
                thing = sequence.objects[which - 1].name
                return False, f"{frame}: object {thing} is off by {np.median(part) * 1e3:.1f} mm in the median"
        sizes.append(size)
        worst = max(worst, (median, f"{frame}: median {median * 1e3:.4f} mm, {share:.2%} within"))
    size = np.concatenate(sizes)
    return ok, (
        f"{len(neighbours)} pairs, {len(size)} pixels: median {np.median(size) * 1e3:.4f} mm, 95 % "
        f"{np.quantile(size, 0.95) * 1e3:.4f} mm, {(size <= INLIER_M).mean():.2%} within {INLIER_M * 1e3:g} mm; "
        f"worst {worst[1]}"
    )


def check_scene(sequence: Rig) -> tuple[bool, str]:
    """scene.ply is whole, and what a few depth frames show lies within its bounds."""
    path = sequence.root / "scene.ply"
    if not path.is_file():
        raise UserError(f"{path}: is missing")
    try:
        mesh = trimesh.load(path, process=False, force="mesh")
        counts, bounds = (len(mesh.vertices), len(mesh.faces)), np.asarray(mesh.bounds, float)
        whole = counts == _ply_counts(path) and np.isfinite(mesh.vertices).all() and mesh.faces.max() < counts[0]
    except Exception as error:  # trimesh raises whatever its parsers run into
        raise UserError(f"{path}: cannot be read ({type(error).__name__})") from None
    if not whole:
        raise UserError(f"{path}: is not a whole mesh: write it again")
    outside = 0.0
    for stream in (stream for stream in sequence.streams.values() if stream.is_depth):
        for k in _spread(len(stream.paths), _SCENE_FRAMES):
            p_world, number, _ = _depth_pixels(sequence, k, stream.name)
            p_world = p_world[number == 0]
            outside = max(outside, float(np.maximum(bounds[0] - p_world, p_world - bounds[1]).max(initial=0.0)))
    size = " x ".join(f"{length:.2f}" for length in bounds[1] - bounds[0])
    detail = f"{counts[1]} triangles, {size} m, depth at most {outside * 1e3:.3f} mm outside"
    return outside <= INLIER_M, detail


def _ply_counts(path: Path) -> tuple[int, int]:
    """Vertices and faces that the header promises."""
    with path.open("rb") as file:
        header = file.read(4096).split(b"end_header")[0].decode("ascii", "replace").split()
    elements = {header[i + 1]: int(header[i + 2]) for i in range(len(header) - 2) if header[i] == "element"}
    return elements.get("vertex", 0), elements.get("face", 0)


def reproject_depth(sequence: Rig, k: int, next_k: int, name: str = "depth") -> Reprojection:
    """Compare exact depth of listed frame k with that of frame next_k, every fourth pixel and row by row.

    name: of the depth camera, which is the body.

    Pixels of frame k go to the world with their own line's pose and into the other frame with the rolling-shutter
    projection (3); the planar z predicted there is compared with the observed one, interpolated bilinearly in inverse
    depth. What is on a moving object goes with it. Left out: places where that is not good to 0.5 mm
    (edges), and points hidden by a nearer surface.
    Raises UserError for unreadable files.
    """
    stream = sequence.streams[name]
    stamp = float(stream.stamps[next_k])
    next_z = sequence.exact_depth(name, next_k).astype(np.float64)
    p_world, number, t_seen = _depth_pixels(sequence, k, name)
    residuals, numbers, occluded = [np.zeros(0)], [np.zeros(0, np.int64)], 0
    for which in range(len(sequence.objects) + 1):
        here = number == which
        if not here.any():
            continue
        points = p_world[here]
        motion: Any = sequence.spline
        if which:
            thing = sequence.objects[which - 1]
            points = se3.transform(se3.inverse(thing.spline.pose(t_seen[here])), points)
            motion = RelativeMotion(sequence.spline, thing.spline)
        uv_next, t, valid = project_rolling(motion, np.eye(4), stream.camera, stream.shutter, stamp, points)
        uv_next, t = uv_next[valid], t[valid]
        predicted = se3.transform(se3.inverse(motion.pose(t)), points[valid])[..., 2]
        observed, smooth = _interpolate_inverse(next_z, uv_next)
        predicted, observed = predicted[smooth], observed[smooth]
        hidden = predicted - observed > OCCLUDED * predicted
        residuals.append((predicted - observed)[~hidden])
        numbers.append(np.full(len(residuals[-1]), which))
        occluded += int(hidden.sum())
    return Reprojection(np.concatenate(residuals), occluded, np.concatenate(numbers))


def _depth_pixels(sequence: Rig, k: int, name: str) -> tuple[FloatArray, IntArray, FloatArray]:
    """What every fourth row and column of exact depth k of a camera shows, each pixel from its own line's pose.

    Points (n, 3) in the world, numbers (n,) of the objects they are on, and their lines' times (n,), s. Raises
    UserError for unreadable files.
    """
    stream = sequence.streams[name]
    camera = stream.camera
    step = max(1, min(_STEP_PX, math.isqrt(camera.width * camera.height // _TARGET_PIXELS)))
    z = sequence.exact_depth(name, k)[::step, ::step].astype(np.float64)
    uv = camera.pixel_grid()[::step, ::step][z > 0]
    p_world = se3.transform(sequence.pixel_poses(name, k, uv), camera.backproject(uv, z[z > 0]))
    t = stream.shutter.line_mid_time(float(stream.stamps[k]), stream.shutter.line_of_pixel(uv, camera), camera)
    return p_world, sequence.object_ids(name, k)[::step, ::step][z > 0].astype(np.int64), np.asarray(t)


def _interpolate_inverse(z: FloatArray, uv: FloatArray) -> tuple[FloatArray, BoolArray]:
    """z (n,) at pixels uv (n, 2), bilinear in 1/z, and where that holds: inside, measured, smooth."""
    h, w = z.shape
    inverse = np.where(z > 0, 1 / np.where(z > 0, z, 1.0), 0.0)
    bend = np.full((h, w), 1e9)
    bend[1:-1, 1:-1] = np.abs(np.diff(inverse, 2, axis=1)[1:-1]) + np.abs(np.diff(inverse, 2, axis=0)[:, 1:-1])
    smooth = bend / 8 * z**2 <= INTERPOLATION_M  # a parabola's largest distance from its chord; dz = z² d(1/z)
    corner = np.clip(np.floor(uv).astype(np.int64), 0, (w - 2, h - 2))
    (x, y), (a, b) = corner.T, (uv - corner).T
    at = [(y, x), (y, x + 1), (y + 1, x), (y + 1, x + 1)]
    inside = (a >= 0) & (a <= 1) & (b >= 0) & (b <= 1)
    holds = inside & np.all([smooth[i] & (z[i] > 0) for i in at], axis=0)
    weights = [(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b]
    sum_inverse = sum(weight * inverse[i] for weight, i in zip(weights, at, strict=True))
    return 1 / np.where(holds, sum_inverse, 1.0), holds


def _neighbours(sequence: Rig, name: str, pairs: int) -> list[tuple[int, int]]:
    """Up to `pairs` pairs of consecutive depth frames, spread evenly."""
    first = np.flatnonzero(np.diff(sequence.streams[name].indices) == 1)
    return [(int(first[i]), int(first[i]) + 1) for i in _spread(len(first), min(pairs, len(first)))]


def _spread(total: int, count: int) -> list[int]:
    """Numbers of so many of `total` things, spread evenly; fewer where there are not as many."""
    return np.unique(np.linspace(0, total - 1, count).round().astype(int)).tolist()


CAST_TOLERANCE_M = 1e-4
CAST_SHARE = 0.999


def check_raycast(sequence: Rig, name: str, count: int) -> tuple[bool, str]:
    """Cast every pixel of `count` frames of a camera, spread over the sequence, again on scene.ply and compare.

    Of a depth camera, or of another one that has exact depth beside its images (`truth.color_depth`). By trimesh with
    Embree, from the rows' poses in float64. What moves by itself is cast in its own frame, with each ray moved to where
    the object is at its line's time.

    True if in every frame at least CAST_SHARE of the pixels are within CAST_TOLERANCE_M and of the right object. Raises
    UserError if embreex is not installed, or scene.ply or a frame cannot be read.
    """
    casters = [_caster(path) for path in (sequence.root / "scene.ply", *(o.mesh for o in sequence.objects))]
    stream = sequence.streams[name]
    total = len(stream.stamps)
    if count < 1 or total == 0:
        raise UserError(f"{sequence.root}: no {name} frames to cast: ask for at least one")
    frames = _spread(total, count)
    differences, shares = [], []
    for k in frames:
        z, number = _cast(casters, sequence, stream, k)
        exact = sequence.exact_depth(name, k) if stream.is_depth else sequence.exact_image(name, COLOR_DEPTH, k)
        differences.append(np.abs(z - exact))
        right = (differences[-1] <= CAST_TOLERANCE_M) & (number == sequence.object_ids(name, k))
        shares.append(float(np.mean(right)))
    return min(shares) >= CAST_SHARE, (
        f"{len(frames)} frames, worst: {100 * min(shares):.4f} % of pixels within {1000 * CAST_TOLERANCE_M:g} mm, "
        f"median difference {1e6 * float(np.median(differences)):.2f} um"
    )


def _caster(path: Path) -> Any:
    try:
        from trimesh.ray.ray_pyembree import RayMeshIntersector
    except ImportError:
        raise UserError(f"ray casting needs embreex: {how_to_install('raycast')}") from None
    try:
        return RayMeshIntersector(trimesh.load(path, process=False, force="mesh"))
    except Exception as error:
        raise UserError(f"{path}: cannot be read ({type(error).__name__})") from None


def _cast(casters: list[Any], sequence: Rig, stream: ImageStream, k: int) -> tuple[FloatArray, IntArray]:
    """Planar z (h, w) of listed frame k, 0 where a ray hits nothing, and the number of the object hit (h, w)."""
    camera = stream.camera
    uv = camera.pixel_grid().reshape(-1, 2)
    T_world_cam = sequence.pixel_poses(stream.name, k, uv)
    exposure_s = stream.shutter.exposure_s if stream.table is None else float(stream.table.exposure_s[k])
    middle = float(stream.stamps[k]) - 0.5 * (exposure_s - stream.shutter.exposure_s)
    t = stream.shutter.line_mid_time(middle, stream.shutter.line_of_pixel(uv, camera), camera)
    z, number = np.full(len(uv), np.inf), np.zeros(len(uv), np.int64)
    for which, caster in enumerate(casters):
        T = T_world_cam
        if which:
            T = se3.inverse(sequence.objects[which - 1].spline.pose(t)) @ T_world_cam
        direction = np.einsum("nij,nj->ni", T[:, :3, :3], camera.unproject(uv))
        _, ray, p = caster.intersects_id(T[:, :3, 3], direction, multiple_hits=False, return_locations=True)
        there = se3.transform(se3.inverse(T[ray]), p)[:, 2]
        nearer = there < z[ray]
        z[ray[nearer]], number[ray[nearer]] = there[nearer], which
    shape = camera.height, camera.width
    return np.where(np.isfinite(z), z, 0.0).reshape(shape), number.reshape(shape)
