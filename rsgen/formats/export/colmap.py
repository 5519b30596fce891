"""A sequence as a COLMAP text model: `images/`, `sparse/0/cameras.txt images.txt points3D.txt`, and what it loses.

COLMAP's pixel centres are at halves: cx, cy and all observations are half a pixel larger than ours. An image has one
pose, world to camera, quaternions w first: here that of the middle line's mid-exposure. Format:
https://colmap.github.io/format.html
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError
from rsgen.files import write_lines
from rsgen.formats.export import poses
from rsgen.formats.export.shared import DEFAULTS, ExportOptions, new_folder, part_of, place_images
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.sequence.format import pose_rows
from rsgen.sequence.images import Sequence


def export_colmap(
    sequence: Sequence, out: Path, options: ExportOptions = DEFAULTS, progress: Progress = no_progress
) -> str:
    """Write the new folder `out`; returns one line. Images are hard links, or copies with options.copy.

    Cameras and poses are the true ones. Points are exact, their observations where the rolling shutter shows them, so
    that a point's ERROR is what one pose an image loses. rolling_shutter.json and spline.npz have the lines' times and
    poses. Raises UserError if `out` is not empty, or a file cannot be read or written.
    """
    sequence = sequence.as_taken
    color = sequence.streams["color"]
    cameras = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]", f"1 {camera_line(color.camera)}"]
    T_world_color = poses.at_line(sequence, poses.middle_line(sequence))
    observed = poses.observations(sequence)
    losses = {poses.ONE_POSE: poses.loss_of_poses(color.camera, observed, T_world_color[observed.image])}
    points = poses.surface_points(sequence, part_of(progress, 0.0, 0.8))
    names = [path.name for path in color.paths]

    new_folder(out, "images", "sparse/0")
    place_images(color.paths, out / "images", options.copy, part_of(progress, 0.8, 1.0))
    poses.write_shutter_files(sequence, out, losses)
    files = {
        "cameras.txt": cameras,
        "images.txt": _images(T_world_color, names, points),
        "points3D.txt": _points(T_world_color, color.camera, points),
    }
    for name, lines in files.items():
        write_lines(out / "sparse/0" / name, lines)
    return f"{out}: {len(names)} images, {len(points.p_world)} points; {poses.loss_words(losses)}"


def camera_line(camera: Camera) -> str:
    """MODEL WIDTH HEIGHT PARAMS[]: PINHOLE, OPENCV, FULL_OPENCV (k3 and more), OPENCV_FISHEYE. Raises UserError."""
    model, distortion = "PINHOLE", camera.distortion
    if camera.model == "fisheye":
        model = "OPENCV_FISHEYE"
    elif camera.model == "double_sphere":
        raise UserError("COLMAP has no double_sphere lens: render with radtan, rational or fisheye")
    elif any(distortion[4:]):
        model, distortion = "FULL_OPENCV", (*distortion, 0.0, 0.0, 0.0)[:8]
    elif camera.model in ("radtan", "rational"):
        model, distortion = "OPENCV", distortion[:4]
    params = (camera.fx, camera.fy, camera.cx + poses.PIXEL_SHIFT, camera.cy + poses.PIXEL_SHIFT, *distortion)
    return " ".join([model, f"{camera.width} {camera.height}", *(repr(float(value)) for value in params)])


def _images(T_world_color: FloatArray, names: list[str], points: poses.SurfacePoints) -> list[str]:
    lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", "# POINTS2D[] as X Y POINT3D_ID"]
    rows = pose_rows(se3.inverse(T_world_color))[:, [6, 3, 4, 5, 0, 1, 2]]
    for k, (row, name) in enumerate(zip(rows, names, strict=True)):
        image_rows = np.column_stack([points.uv[k] + poses.PIXEL_SHIFT, points.shown[k] + 1]).tolist()
        lines.append(f"{k + 1} {' '.join(f'{value:.15g}' for value in row)} 1 {name}")
        lines.append(" ".join(f"{x:.6f} {y:.6f} {number:.0f}" for x, y, number in image_rows))
    return lines


def _points(T_world_color: FloatArray, camera: Camera, points: poses.SurfacePoints) -> list[str]:
    """With ERROR: the mean distance between observations and what the images' poses make of the point."""
    which = np.concatenate(points.shown)
    image = np.repeat(np.arange(len(points.shown)), [len(shown) for shown in points.shown])
    place = np.concatenate([np.arange(len(shown)) for shown in points.shown])
    uv, _ = camera.project(se3.transform(se3.inverse(T_world_color[image]), points.p_world[which]))
    error = np.nan_to_num(np.linalg.norm(uv - np.concatenate(points.uv), axis=-1))
    count = np.bincount(which, minlength=len(points.p_world))
    mean = np.bincount(which, error, len(points.p_world)) / np.maximum(count, 1)
    order = np.argsort(which, kind="stable")
    tracks = np.split(np.column_stack([image + 1, place])[order], np.cumsum(count)[:-1])
    lines = ["# POINT3D_ID X Y Z R G B ERROR TRACK[] as IMAGE_ID POINT2D_IDX"]
    for number, (p, rgb, track) in enumerate(zip(points.p_world, points.color, tracks, strict=True)):
        place_text = " ".join(f"{a} {b}" for a, b in track.tolist())
        p_text = " ".join(f"{value:.9f}" for value in p)
        lines.append(f"{number + 1} {p_text} {rgb[0]} {rgb[1]} {rgb[2]} {mean[number]:.6f} {place_text}")
    return lines
