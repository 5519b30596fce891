"""How far a reconstructed surface is from the scene's, and how much of what was seen it has.

In the manner of ICL-NUIM's surface evaluation (Handa et al., ICRA 2014, SurfReg), with exact distances to triangles.

report = run_map_eval(Path("mesh.ply"), Path("out/lr_kt2/scene.ply"))
print(report.text())
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from rsgen.array_types import FloatArray
from rsgen.console.tables import Table, fixed
from rsgen.errors import UserError
from rsgen.files import read_bytes
from rsgen.geometry import se3
from rsgen.sequence.images import Sequence
from rsgen.sequence.reader import read_sequence

# Triangles are cut until no edge is longer (m): then few of them can hold a point's nearest.
_LONGEST_EDGE = 0.04
# Candidates (pairs of a point and a triangle) looked at together: bounds memory.
_PAIRS = 1_000_000
_POINTS_AT_ONCE = 2000
# What was seen is looked up in so many frames at most, at every so-manyth pixel and row, and thinned to one point in
# cubes of this size (m), so that near and far surfaces count alike.
_FRAMES, _STRIDE, _THINNED = 100, 4, 0.02


@dataclass(frozen=True)
class Spread:
    """Distances of n points: mean, median, standard deviation, 90th percentile, in metres."""

    points: int
    mean_m: float
    median_m: float
    std_m: float
    p90_m: float

    @classmethod
    def of(cls, d: FloatArray) -> Spread:
        """Of distances (n,), n ≥ 1."""
        return cls(len(d), float(d.mean()), float(np.median(d)), float(d.std()), float(np.percentile(d, 90)))


@dataclass(frozen=True)
class MapErrors:
    """accuracy: from the mesh to the scene. completeness: from what the depth camera saw of the scene to the mesh;
    None where the scene lies in no sequence. within_2cm: part of those points that are so near."""

    accuracy: Spread
    completeness: Spread | None
    within_2cm: float | None

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers for JSON; units are in the names."""
        return dataclasses.asdict(self)

    def text(self) -> str:
        """A small table in millimetres."""
        rows = tuple(
            (label, *(fixed(v, 3, 1e3) for v in (s.mean_m, s.median_m, s.std_m, s.p90_m)), str(s.points))
            for label, s in (("accuracy, mm", self.accuracy), ("completeness, mm", self.completeness))
            if s is not None
        )
        note = "note: no completeness: what was seen is known of a scene.ply in its sequence's folder"
        if self.within_2cm is not None:
            note = f"{100 * self.within_2cm:.1f} % of what was seen is within 20 mm of the mesh"
        return Table(("", "mean", "median", "std", "90 %", "points"), rows).text() + f"\n{note}"


class Triangles:
    """Nearest distances to triangles (m, 3, 3), in m, exact."""

    def __init__(self, triangles: FloatArray) -> None:
        self._corners = cut(np.asarray(triangles, np.float64), _LONGEST_EDGE)
        self._centre = self._corners.mean(axis=1)
        self._radius = np.linalg.norm(self._corners - self._centre[:, None], axis=-1).max(axis=1)
        self._tree = cKDTree(self._centre)

    def distance(self, points: FloatArray) -> FloatArray:
        """Distances (n,) of points (n, 3).

        The triangle with the nearest centre bounds the distance from above; only triangles whose centre is at most
        that and the largest radius away can be nearer.
        """
        out = np.empty(len(points))
        for begin in range(0, len(points), _POINTS_AT_ONCE):
            out[begin : begin + _POINTS_AT_ONCE] = self._some(points[begin : begin + _POINTS_AT_ONCE])
        return out

    def _some(self, points: FloatArray) -> FloatArray:
        _, first = self._tree.query(points)
        best = _to_triangles(points, self._corners[first])
        hits = self._tree.query_ball_point(points, best + self._radius.max())
        counts = np.array([len(h) for h in hits])
        ends = np.cumsum(counts)
        begin = 0
        while begin < len(points):
            # At least one point, then as many as fit.
            done = ends[begin - 1] if begin else 0
            end = max(begin + 1, int(np.searchsorted(ends, done + _PAIRS, side="right")))
            i = np.repeat(np.arange(begin, end), counts[begin:end])
            j = np.concatenate([np.asarray(h, np.int64) for h in hits[begin:end]])
            near = np.linalg.norm(points[i] - self._centre[j], axis=1) - self._radius[j] < best[i]
            i, j = i[near], j[near]
            np.minimum.at(best, i, _to_triangles(points[i], self._corners[j]))
            begin = end
        return best


def cut(triangles: FloatArray, longest_m: float) -> FloatArray:
    """The same surface in triangles (k, 3, 3) without edges longer than longest_m: the longest edge is halved."""
    done = []
    while len(triangles):
        edges = np.linalg.norm(triangles[:, [1, 2, 0]] - triangles, axis=-1)
        small = edges.max(axis=1) <= longest_m
        done.append(triangles[small])
        rest, at = triangles[~small], edges[~small].argmax(axis=1)
        a, b, c = (np.take_along_axis(rest, ((at + k) % 3)[:, None, None], axis=1)[:, 0] for k in range(3))
        middle = 0.5 * (a + b)
        triangles = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
    return np.concatenate(done) if done else triangles


def sample_surface(triangles: FloatArray, count: int, rng: np.random.Generator) -> FloatArray:
    """Points (count, 3) spread evenly over the area of triangles (m, 3, 3)."""
    area = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
    chosen = triangles[rng.choice(len(triangles), count, p=area / area.sum())]
    u, v = rng.random((2, count, 1))
    flip = u + v > 1.0
    u, v = np.where(flip, 1.0 - u, u), np.where(flip, 1.0 - v, v)
    return np.asarray(chosen[:, 0] + u * (chosen[:, 1] - chosen[:, 0]) + v * (chosen[:, 2] - chosen[:, 0]))


def seen_surface(sequence: Sequence) -> FloatArray:
    """Points (n, 3) of the scene in its world, one in each 2 cm cube, that the depth camera saw.

    Exact: true depth, back-projected with the true pose of each line. Raises UserError as `rsgen.sequence.reader` does.
    """
    stream = sequence.as_taken.streams["depth"]
    uv = stream.camera.pixel_grid()
    rays = np.nan_to_num(stream.camera.unproject(uv))
    pick = slice(None, None, _STRIDE), slice(None, None, _STRIDE)
    points = np.empty((0, 3))
    for k in np.unique(np.linspace(0, len(stream.paths) - 1, min(_FRAMES, len(stream.paths))).astype(int)):
        z = sequence.truth_depth(int(k))[pick]
        p = se3.transform(sequence.pixel_poses("depth", int(k), uv[pick]), rays[pick] * z[..., None])[z > 0.0]
        points = _thinned(np.concatenate([points, p]))
    return points


def evaluate_map(mesh: FloatArray, scene: FloatArray, seen: FloatArray | None, samples: int = 50_000) -> MapErrors:
    """Compare triangles (m, 3, 3) of a mesh with the scene's (k, 3, 3), in one world frame; seen: (n, 3) points.

    `samples` points of each side at most. Raises UserError if a side is empty.
    """
    if not len(mesh) or not len(scene):
        raise UserError("a surface without triangles cannot be compared: give meshes, not point clouds")
    rng = np.random.default_rng(0)
    accuracy = Triangles(scene).distance(sample_surface(mesh, samples, rng))
    if seen is None or not len(seen):
        return MapErrors(Spread.of(accuracy), None, None)
    some = seen if len(seen) <= samples else seen[rng.choice(len(seen), samples, replace=False)]
    missing = Triangles(mesh).distance(some)
    return MapErrors(Spread.of(accuracy), Spread.of(missing), float((missing <= 0.02).mean()))


def run_map_eval(mesh_path: Path, scene_path: Path, samples: int = 50_000) -> MapErrors:
    """Compare a mesh that `rstrack map` wrote with SEQ/scene.ply. Raises UserError, naming the file at fault."""
    mesh, scene = read_triangles(mesh_path), read_triangles(scene_path)
    folder = Path(scene_path).parent
    seen = seen_surface(read_sequence(folder)) if (folder / "sequence.yaml").exists() else None
    return evaluate_map(mesh, scene, seen, samples)


def read_triangles(path: Path) -> FloatArray:
    """Triangles (m, 3, 3) of a PLY. Raises UserError: missing, damaged, none, or in the estimate's own world."""
    import trimesh

    data = read_bytes(path)
    if b"world estimate" in data[:1000]:
        raise UserError(f"{path}: lies in the estimate's world, not the scene's: map again with --world truth")
    try:
        mesh = trimesh.load(trimesh.util.wrap_as_stream(data), file_type="ply", process=False)
        triangles = np.asarray(mesh.triangles, np.float64) if isinstance(mesh, trimesh.Trimesh) else np.empty((0, 3, 3))
    except Exception:  # whatever a damaged file makes the parser raise
        raise UserError(f"{path}: is not a whole PLY file: write it again") from None
    if not len(triangles) or not np.isfinite(triangles).all():
        raise UserError(f"{path}: has no triangles, or some that are not finite: give a mesh, not a point cloud")
    return triangles


# ---------------------------------------------------------------------------------------------------------------------


def _to_triangles(points: FloatArray, triangles: FloatArray) -> FloatArray:
    """Distances (n,) between points (n, 3) and one triangle (n, 3, 3) each."""
    import trimesh

    if not len(points):
        return np.empty(0)
    nearest = trimesh.triangles.closest_point(triangles, points)
    return np.asarray(np.linalg.norm(nearest - points, axis=1))


def _thinned(points: FloatArray) -> FloatArray:
    """The first of the points (n, 3) in each cube of _THINNED m."""
    _, first = np.unique(np.floor(points / _THINNED).astype(np.int64), axis=0, return_index=True)
    return points[np.sort(first)]
