"""A sequence as nerfstudio's `transforms.json`, with what rolling-shutter methods read beside it.

Camera axes are OpenGL's: x right, y up, z backward; pixel centres at halves. Keys beyond nerfstudio's own:

    camera_linear_velocity, camera_angular_velocity    of each frame, at its middle line, m/s and rad/s in the
    rolling_shutter_time, exposure_time                camera's axes; s: 3dgs-deblur (SpectacularAI's nerfstudio
                                                       and gsplat: t = rolling_shutter_time (y / height - 1/2))
    transform_matrix_start, transform_matrix_end       of the first and the last line that are read: gsplat's `viewmats`
    shutter_type                                       and `viewmats_rs` (inverted, in OpenCV's axes), and its
                                                       `RollingShutterType`; instant-ngp takes both poses as they are,
    rolling_shutter                                    with this: [A, B, C, D], t = A + B u + C v + D blur
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError
from rsgen.files import atomic_write
from rsgen.formats.export import poses
from rsgen.formats.export.shared import (
    DEFAULTS,
    ExportOptions,
    aligned_depth,
    new_folder,
    part_of,
    place_images,
)  # fmt: skip
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.sequence.images import Sequence

GSPLAT, NGP, VELOCITY = "start and end pose in gsplat", "in instant-ngp", "constant velocity in 3dgs-deblur"
_MODELS = {"pinhole": "PINHOLE", "radtan": "OPENCV", "fisheye": "OPENCV_FISHEYE"}
_NAMES = {"pinhole": (), "radtan": ("k1", "k2", "p1", "p2", "k3"), "fisheye": ("k1", "k2", "k3", "k4")}
_GL = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's camera axes in ours, and back


def export_nerfstudio(
    sequence: Sequence, out: Path, options: ExportOptions = DEFAULTS, progress: Progress = no_progress
) -> str:
    """Write the new folder `out`; returns one line. Images are hard links, or copies with options.copy.

    images/, depth/ (aligned to colour, in the sequence's units; warped where the sequence's is not), points3D.ply,
    transforms.json, and rolling_shutter.json and spline.npz with every line's time and pose. Cameras and poses are the
    true ones. 3dgs-deblur knows rows read downwards only: of other scans its keys are left out. Raises UserError if
    `out` is not empty, or a file cannot be read or written.
    """
    sequence = sequence.as_taken
    color = sequence.streams["color"]
    if color.camera.model not in _MODELS:
        raise UserError(f"nerfstudio has no {color.camera.model} lens: render with radtan or fisheye")
    points = poses.surface_points(sequence, part_of(progress, 0.0, 0.5))
    losses = _losses(sequence)

    new_folder(out, "images", "depth")
    place_images(color.paths, out / "images", options.copy, part_of(progress, 0.5, 0.6))
    depths = aligned_depth(sequence, out / "depth", options.copy, part_of(progress, 0.6, 1.0))
    poses.write_shutter_files(sequence, out, losses)
    atomic_write(out / "points3D.ply", _ply(points))
    atomic_write(out / "transforms.json", json.dumps(_transforms(sequence, depths), indent=1).encode())
    note = "" if VELOCITY in losses else f" (no velocities: 3dgs-deblur does not know the scan {color.shutter.scan})"
    counts = f"{len(color.paths)} images with depth, {len(points.p_world)} points"
    return f"{out}: {counts}; {poses.loss_words(losses)}{note}"


def ngp_rolling_shutter(camera: Camera, shutter: Shutter) -> list[float]:
    """instant-ngp's [A, B, C, D]: part of the way from start to end pose = A + B u + C v + D blur; u, v, blur in 0..1.

    u and v count the image's width and height from its edge. Zeros for a global shutter without exposure.
    """
    lines = shutter.line_count(camera)
    if shutter.readout_s == 0.0 or lines < 2:
        return [0.0] * 4
    rate, blur = lines / (lines - 1), shutter.exposure_s / (shutter.line_delay(camera) * (lines - 1))
    first = -0.5 / (lines - 1) if shutter.direction > 0 else rate - 0.5 / (lines - 1)
    across, down = (0.0, rate) if shutter.by_rows else (rate, 0.0)
    return [first - 0.5 * blur, shutter.direction * across, shutter.direction * down, blur]


def _transforms(sequence: Sequence, depths: list[str]) -> dict[str, Any]:
    color = sequence.streams["color"]
    camera, shutter = color.camera, color.shutter
    ends = {"": poses.middle_line(sequence), "_start": 0.0, "_end": color.line_count - 1.0}
    matrices = {f"transform_matrix{name}": poses.at_line(sequence, line) @ _GL for name, line in ends.items()}
    twist = _twists(sequence) * np.tile(np.diag(_GL)[:3], 2)
    speaks = _is_downward(shutter)
    frames = []
    for k, path in enumerate(color.paths):
        frame: dict[str, Any] = {
            "file_path": f"images/{path.name}",
            "depth_file_path": f"depth/{depths[k]}",
            "time": float(color.stamps[k]),
            "exposure_s": float(poses.exposures(color)[k]),
        }
        frame |= {name: T[k].tolist() for name, T in matrices.items()}
        if speaks:
            frame |= {"camera_linear_velocity": twist[k, :3].tolist(), "camera_angular_velocity": twist[k, 3:].tolist()}
        frames.append(frame)
    distortion = zip(_NAMES[camera.model], camera.distortion, strict=False)
    data: dict[str, Any] = {
        "camera_model": _MODELS[camera.model],
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx + poses.PIXEL_SHIFT,
        "cy": camera.cy + poses.PIXEL_SHIFT,
        **dict(distortion),
        "is_fisheye": camera.model == "fisheye",
        "ply_file_path": "points3D.ply",
        "depth_unit_scale_factor": 1.0 / sequence.streams["depth"].depth_scale,
        "rolling_shutter": ngp_rolling_shutter(camera, shutter),
        "shutter_type": poses.shutter_type(shutter),
        "exposure_time": float(poses.exposures(color).mean()),
    }
    if speaks:
        data["rolling_shutter_time"] = shutter.readout_s
    return data | {"frames": frames}


def _is_downward(shutter: Shutter) -> bool:
    return shutter.readout_s == 0.0 or shutter.scan == "top-bottom"


def _twists(sequence: Sequence) -> FloatArray:
    """Velocities (n, 6) of the colour camera at every image's middle line, in its own frame: m/s, then rad/s."""
    color = sequence.streams["color"]
    times = color.shutter.line_mid_time(poses.blur_centres(color), poses.middle_line(sequence), color.camera)
    return np.asarray(sequence.spline.velocity(times) @ se3.adjoint(sequence.T_color_depth).T)


def _losses(sequence: Sequence) -> dict[str, poses.Loss]:
    color, observed = sequence.streams["color"], poses.observations(sequence)
    middle = poses.at_line(sequence, poses.middle_line(sequence))[observed.image]
    losses = {poses.ONE_POSE: poses.loss_of_poses(color.camera, observed, middle)}
    dt = observed.t - color.shutter.line_mid_time(
        poses.blur_centres(color)[observed.image], poses.middle_line(sequence), color.camera
    )
    length = color.shutter.line_delay(color.camera) * (color.line_count - 1)
    if length > 0.0:
        part = 0.5 + dt / length
        start, end = (poses.at_line(sequence, line)[observed.image] for line in (0.0, color.line_count - 1.0))
        T_color_world = poses.between(se3.inverse(start), se3.inverse(end), part)
        losses[GSPLAT] = poses.loss_of_poses(color.camera, observed, se3.inverse(T_color_world))
        losses[NGP] = poses.loss_of_poses(color.camera, observed, poses.between(start, end, part))
    if _is_downward(color.shutter):
        twist = _twists(sequence)[observed.image]
        losses[VELOCITY] = poses.loss_of_image_velocity(color.camera, observed, middle, twist, dt)
    return losses


def _ply(points: poses.SurfacePoints) -> bytes:
    """A cloud with colours, as nerfstudio's `ply_file_path` has it."""
    kinds = [(axis, "<f4") for axis in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    table = np.zeros(len(points.p_world), kinds)
    for values, names in ((points.p_world, ("x", "y", "z")), (points.color, ("red", "green", "blue"))):
        for i, name in enumerate(names):
            table[name] = values[:, i]
    properties = [f"property {'float' if kind == '<f4' else 'uchar'} {name}" for name, kind in kinds]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}", *properties, "end_header", ""]
    return "\n".join(head).encode() + table.tobytes()
