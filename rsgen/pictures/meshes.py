"""Pictures of coloured meshes side by side, seen by one camera: reconstructions to be compared by eye.

picture_meshes([Path("ours.ply"), Path("theirs.ply")], Path("meshes.png"), labels=["ours", "theirs"])

A surface seen from behind is left out, so a room is looked into from outside, through its ceiling and nearer walls.
Light is a lamp over the camera's shoulder times ambient occlusion: bends, ripples and doubled walls show on plain
surfaces too.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rsgen import srgb
from rsgen.array_types import ByteArray, Float32Array, FloatArray, IntArray
from rsgen.console.progress import Progress, no_progress
from rsgen.device.arrays import aligned
from rsgen.errors import UserError
from rsgen.files import read_bytes
from rsgen.geometry.camera import Camera
from rsgen.limits import MOST_M
from rsgen.motion.make import look_at
from rsgen.scene.meshes import ply_bytes, vertex_normals
from rsgen.sensors.color import to_srgb8

Point = tuple[float, float, float]

SUFFIXES = (".png", ".jpg", ".svg", ".pdf")
MAX_SIZE_PX = 8192
MAX_MESHES = 8

_UP = (0.0, 1.0, 0.0)
_FIELD_OF_VIEW = math.radians(45)  # vertical
_ABOVE = math.radians(55)  # elevation of the view from above
_TRIM_PERCENT = 0.1  # of the vertices on each side need not fit into the picture: strays
_MARGIN = 1.05
_SAMPLES = 32
_LAUNCH = 1 << 22
_REACH = 0.1  # of the meshes' diagonal: how far away a surface still darkens another
_AMBIENT = 0.35
_TO_LAMP = (-0.8, -0.8, -1.0)  # camera frame, far away: over the left shoulder
_SHARP = 0.7  # cosine between face and smoothed normal below which an edge is meant to be sharp
_GREY = 0.5  # linear, of a mesh without colours
_GAP_PX, _TITLE_PX, _DPI = 6, 30, 130
# Steps of the R4 low-discrepancy sequence (Roberts 2018) over footprint x and y and the occlusion ray's direction.
_R4 = (0.8566748838545029, 0.7338918566271260, 0.6287067210378087, 0.5385972572236101)


@dataclass(frozen=True, eq=False)
class ColoredMesh:
    """vertices (n, 3) m, world; faces (m, 3); unit normals (n, 3) smoothed over neighbours; linear colours (n, 3)."""

    vertices: Float32Array
    faces: IntArray
    normals: Float32Array
    colors: Float32Array

    def facing(self, eye: FloatArray) -> ColoredMesh:
        """Only the triangles whose front (counter-clockwise) is turned to `eye` (3,), m, world."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        front = np.einsum("ij,ij->i", np.cross(b - a, c - a), eye.astype(np.float32) - a) > 0
        return ColoredMesh(self.vertices, self.faces[front], self.normals, self.colors)


@dataclass(frozen=True, eq=False)
class PinholeView:
    """A pinhole camera and its pose T_world_cam (4, 4): x right, y down, z forward."""

    camera: Camera
    T_world_cam: FloatArray


def picture_meshes(
    paths: Sequence[Path], out: Path, labels: Sequence[str] | None = None, eye: Point | None = None,
    target: Point | None = None, width: int = 800, height: int = 600, grey: bool = False,
    progress: Progress = no_progress,
) -> Path:  # fmt: skip
    """Draw each mesh of `paths`, all from the same place, write them side by side into `out` and return that.

    eye, target: camera centre and the point in the middle of the image, m, world; without an eye the view is from above
    and takes in all meshes; without a target, it is the meshes' middle. World: y up. width, height: px of one mesh.
    labels: default, the files' names. grey: without the meshes' colours, for their shapes.
    Raises UserError, naming what is wrong.
    """
    from rsgen.figures import save

    names = list(labels) if labels else [path.stem for path in paths]
    _check(paths, out, names, eye, target, (width, height))
    meshes = []
    for k, path in enumerate(paths, 1):
        mesh = read_mesh(path)
        meshes.append(replace(mesh, colors=np.full_like(mesh.colors, _GREY)) if grey else mesh)
        progress("reading", k / len(paths), path.name)
    view = frame_meshes(meshes, eye, target, width, height)
    reach = _REACH * max(float(np.linalg.norm(np.ptp(mesh.vertices, axis=0))) for mesh in meshes)
    images = []
    for k, (path, mesh) in enumerate(zip(paths, meshes, strict=True), 1):
        front = mesh.facing(view.T_world_cam[:3, 3])
        if len(front.faces) == 0:
            raise UserError(f"{path}: all its triangles are seen from behind: look from another side (--from)")
        images.append(render_mesh(front, view, reach))
        progress("drawing", k / len(paths), path.name)
    save(_side_by_side(images, names), out)
    return out


def parse_point(text: str) -> Point:
    """Three numbers 'x,y,z'. Raises UserError."""
    try:
        x, y, z = (float(word) for word in text.split(","))
    except ValueError:
        x, y, z = math.nan, math.nan, math.nan
    if not all(abs(k) <= MOST_M for k in (x, y, z)):
        raise UserError(f"'{text}' is no point: expected x,y,z in metres, for example 0.5,1.6,-2")
    return x, y, z


def read_mesh(path: Path) -> ColoredMesh:
    """A mesh file that trimesh reads, with its vertices' colours if it has some, else grey. Raises UserError."""
    import trimesh

    data = read_bytes(path)
    try:
        mesh = trimesh.load(
            trimesh.util.wrap_as_stream(data), file_type=path.suffix.lower()[1:], process=False, force="mesh"
        )
        vertices, faces = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int64)
        valid = len(faces) > 0 and bool(((faces >= 0) & (faces < len(vertices))).all())
    except Exception as error:  # trimesh raises whatever its parsers do
        raise UserError(f"{path}: is no mesh that can be read ({type(error).__name__}): name a PLY file") from None
    if not valid or not np.abs(vertices).max() <= MOST_M:
        raise UserError(f"{path}: holds no triangles with finite vertices: name a mesh, not a point cloud")
    used, faces = np.unique(faces, return_inverse=True)
    faces = faces.reshape(-1, 3)
    colors = np.full((len(used), 3), _GREY, np.float32)
    if mesh.visual.kind == "vertex":
        colors = srgb.decode(np.asarray(mesh.visual.vertex_colors)[used, :3] / 255).astype(np.float32)
    return ColoredMesh(vertices[used], faces, vertex_normals(vertices[used], faces, _UP).astype(np.float32), colors)


def frame_meshes(
    meshes: Sequence[ColoredMesh], eye: Point | None, target: Point | None, width: int, height: int
) -> PinholeView:
    """The view of `picture_meshes`. From above, it takes in all vertices but strays, and a longer side lies level."""
    focal = 0.5 * height / math.tan(_FIELD_OF_VIEW / 2)
    camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    points = np.concatenate([mesh.vertices for mesh in meshes]).astype(float)
    low, high = np.percentile(points, [_TRIM_PERCENT, 100 - _TRIM_PERCENT], axis=0)
    T_world_cam = np.eye(4)
    if eye is not None:
        at = (low + high) / 2 if target is None else np.array(target)
        T_world_cam[:3, 3] = eye
        try:
            T_world_cam[:3, :3] = look_at(np.array(eye), at)
        except UserError:
            where = " ".join(f"{x:.4g}" for x in at)
            raise UserError(f"--from: looks straight up or down, or at itself, at {where}: move it or --at") from None
        return PinholeView(camera, T_world_cam)
    points = points[((points >= low) & (points <= high)).all(axis=1)]
    horizontal = np.array([0.0, 0.0, 1.0] if high[0] - low[0] >= high[2] - low[2] else [1.0, 0.0, 0.0])
    backward = math.sin(_ABOVE) * np.array([0.0, 1.0, 0.0]) + math.cos(_ABOVE) * horizontal
    R = look_at(backward, np.zeros(3))
    p = points @ R  # the camera's axes, origin still to be found
    half = np.array([width, height]) / (2 * focal * _MARGIN)
    # Far enough along z, then sideways: |x - x0| <= half (z - z0) for both borders of both axes.
    x, z = p[:, :2], p[:, 2:]
    right, left = (x - half * z).max(axis=0), (-x - half * z).max(axis=0)
    z0 = float((-(right + left) / (2 * half)).min())
    T_world_cam[:3, :3], T_world_cam[:3, 3] = R, R @ np.array([*(right - left) / 2, z0])
    return PinholeView(camera, T_world_cam)


def render_mesh(mesh: ColoredMesh, view: PinholeView, reach: float) -> ByteArray:
    """8-bit sRGB picture (h, w, 3) of a mesh on white: every triangle of it, whichever way it faces.

    reach: m, within which a surface darkens its neighbours.
    """
    from rsgen.device.backend import mitsuba

    mi = mitsuba()
    with tempfile.TemporaryDirectory(prefix="rsgen-mesh-") as folder:
        file = Path(folder) / "mesh.ply"
        file.write_bytes(ply_bytes(mesh.vertices, mesh.faces, mesh.normals))
        scene = mi.load_dict({"type": "scene", "mesh": {"type": "ply", "filename": str(file)}})
    colors = mi.Float(aligned(mesh.colors))
    pixels = view.camera.width * view.camera.height
    per_launch = max(1, min(_SAMPLES, _LAUNCH // pixels))
    total = np.zeros((pixels, 3))
    for first in range(0, _SAMPLES, per_launch):
        total += _launch(scene, colors, view, reach, first, min(per_launch, _SAMPLES - first))
    linear = (total / _SAMPLES).astype(np.float32).reshape(view.camera.height, view.camera.width, 3)
    return to_srgb8(linear)


def _launch(scene: Any, colors: Any, view: PinholeView, reach: float, first: int, count: int) -> FloatArray:
    """Sum (pixels, 3), linear, of samples first..first+count of every pixel."""
    import drjit as dr
    import mitsuba as mi

    # Opaque: one kernel serves all views.
    camera, T = view.camera, view.T_world_cam
    pixels = camera.width * camera.height
    width, per_pixel, begin = (dr.opaque(mi.UInt32, n) for n in (camera.width, count, first))
    fx, fy, cx, cy = (dr.opaque(mi.Float, k) for k in (camera.fx, camera.fy, camera.cx, camera.cy))
    R = mi.Matrix3f([[dr.opaque(mi.Float, float(k)) for k in row] for row in T[:3, :3]])
    eye = mi.Point3f(*(dr.opaque(mi.Float, float(k)) for k in T[:3, 3]))

    index = dr.arange(mi.UInt32, pixels * count)
    pixel = index // per_pixel
    sample = mi.Float(index - pixel * per_pixel + begin)
    turned = [sample * step + mi.sample_tea_float32(pixel, k, 4) for k, step in enumerate(_R4)]
    u, v, a, b = (x - dr.floor(x) for x in turned)
    x, y = mi.Float(pixel % width) - 0.5 + u, mi.Float(pixel // width) - 0.5 + v
    direction = dr.normalize(R @ mi.Vector3f((x - cx) / fx, (y - cy) / fy, 1))
    ray = mi.Ray3f(eye, direction)

    hit = scene.ray_intersect_preliminary(ray, coherent=True)
    si = hit.compute_surface_interaction(ray)
    seen = si.is_valid()
    n = dr.select(dr.dot(si.n, si.sh_frame.n) > _SHARP, si.sh_frame.n, si.n)
    n = dr.mulsign(n, -dr.dot(si.n, direction))
    to_lamp = R @ dr.normalize(mi.Vector3f(*_TO_LAMP))
    shaded = _AMBIENT + (1 - _AMBIENT) * dr.maximum(dr.dot(n, to_lamp), 0)
    around = mi.Frame3f(n).to_world(mi.warp.square_to_cosine_hemisphere(mi.Point2f(a, b)))
    blocker = scene.ray_intersect_preliminary(si.spawn_ray(around), active=seen)
    shaded *= dr.select(blocker.is_valid(), dr.minimum(blocker.t / reach, 1), 1)

    faces = dr.gather(mi.Vector3u, mi.UInt32(scene.shapes()[0].faces_buffer()), hit.prim_index, seen)
    weights = (1 - hit.prim_uv.x - hit.prim_uv.y, hit.prim_uv.x, hit.prim_uv.y)
    parts = (dr.gather(mi.Color3f, colors, k, seen) * w for k, w in zip(faces, weights, strict=True))
    color = dr.select(seen, sum(parts, mi.Color3f(0)) * shaded, 1.0)
    sums = [dr.block_sum(channel, count) for channel in color]
    dr.eval(sums)
    return np.stack([np.asarray(s, dtype=float) for s in sums], axis=1)


def _check(
    paths: Sequence[Path], out: Path, labels: Sequence[str], eye: Point | None, target: Point | None,
    size: tuple[int, int],
) -> None:  # fmt: skip
    """Raise UserError for what can be refused before anything is read."""
    if not 1 <= len(paths) <= MAX_MESHES:
        raise UserError(f"{len(paths)} meshes: give 1 to {MAX_MESHES}")
    if out.suffix.lower() not in SUFFIXES:
        raise UserError(f"{out}: pictures cannot be written as '{out.suffix}': choose {', '.join(SUFFIXES)}")
    if len(labels) != len(paths):
        raise UserError(f"{len(labels)} labels for {len(paths)} meshes: give each mesh one --label, or none")
    if target is not None and eye is None:
        raise UserError("--at: is for --from; the view from above finds its own middle")
    if not all(16 <= n <= MAX_SIZE_PX for n in size):
        raise UserError(f"--width {size[0]} --height {size[1]}: must lie in 16 to {MAX_SIZE_PX} px")


def _side_by_side(images: Sequence[ByteArray], labels: Sequence[str]) -> Any:
    """A figure of images (h, w, 3) pixel by pixel, each under its label."""
    import matplotlib.pyplot as plt

    height, width = images[0].shape[:2]
    total = len(images) * (width + _GAP_PX) - _GAP_PX, height + _TITLE_PX
    figure = plt.figure(figsize=(total[0] / _DPI, total[1] / _DPI), dpi=_DPI)
    for k, (image, label) in enumerate(zip(images, labels, strict=True)):
        left = k * (width + _GAP_PX)
        axis = figure.add_axes((left / total[0], 0, width / total[0], height / total[1]))
        axis.imshow(image, interpolation="nearest")
        axis.set_axis_off()
        # parse_math: a label is text, dollar signs included.
        figure.text((left + width / 2) / total[0], 1 - _TITLE_PX / 2 / total[1], label, ha="center", va="center",
                    fontsize=9, parse_math=False)  # fmt: skip
    return figure
