"""A sequence as VSLAM-LAB's benchmark has one, for its RGB-D and monocular baselines.

    rgb_0/ depth_0/     images; depth in colour's pixels
    rgb.csv             stamps in ns and paths; a line a colour image, with the depth image that is nearest in time
    calibration.yaml    the colour camera, which is the body; depth_factor: units per metre
    groundtruth.csv     T_world_color
    camera.yaml         the same cameras with their rows' times, which VSLAM-LAB has no words for, as rstrack reads them

The layout is that of VSLAM-LAB's own `dataset_rgbdtum.py` (January 2026).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError
from rsgen.files import atomic_write, encode_yaml, write_lines
from rsgen.formats.export.shared import (
    DEFAULTS,
    ExportOptions,
    aligned_depth,
    color_truth,
    new_folder,
    part_of,
    place_images,
    registered_cameras,
)
from rsgen.geometry.camera import Camera
from rsgen.sensors.imu import nanoseconds
from rsgen.sequence.images import Sequence

_RGB_HEADER = "ts_rgb_0 (ns),path_rgb_0,ts_depth_0 (ns),path_depth_0"
_TRUTH_HEADER = "ts (ns),tx (m),ty (m),tz (m),qx,qy,qz,qw"


def export_vslamlab(
    sequence: Sequence, out: Path, options: ExportOptions = DEFAULTS, progress: Progress = no_progress
) -> str:
    """Write the new folder `out`; returns one line. Images are hard links where they can be, see `aligned_depth`.

    Cameras are those that the sequence declares, poses the true ones. Raises UserError if `out` is not empty, the lens
    has no name there, or an image cannot be read.
    """
    color, depth = sequence.streams["color"], sequence.streams["depth"]
    calibration = _calibration(color.camera, color.rate_hz, depth.depth_scale)
    new_folder(out, "rgb_0", "depth_0")
    place_images(color.paths, out / "rgb_0", options.copy, part_of(progress, 0.0, 0.3))
    near = aligned_depth(sequence, out / "depth_0", options.copy, part_of(progress, 0.3, 1.0))
    stamps = dict(zip((path.name for path in depth.paths), nanoseconds(depth.listed), strict=True))
    lines = [
        f"{ns},rgb_0/{path.name},{stamps.get(name, ns)},depth_0/{name}"
        for ns, path, name in zip(nanoseconds(color.listed), color.paths, near, strict=True)
    ]
    write_lines(out / "rgb.csv", [_RGB_HEADER, *lines])
    atomic_write(out / "calibration.yaml", b"%YAML 1.2\n---\n" + encode_yaml({"cameras": [calibration]}))
    poses, _ = color_truth(sequence)
    lines = [
        f"{ns}," + ",".join(f"{value:.12f}" for value in row)
        for ns, row in zip(nanoseconds(poses[:, 0]), poses[:, 1:], strict=True)
    ]
    write_lines(out / "groundtruth.csv", [_TRUTH_HEADER, *lines])
    atomic_write(out / "camera.yaml", encode_yaml(registered_cameras(sequence)))
    return f"{out}: {len(color.paths)} colour images with depth, {len(poses)} poses"


def _calibration(camera: Camera, rate_hz: float, depth_factor: float) -> dict[str, Any]:
    """The entry of a camera. Raises UserError: a lens that VSLAM-LAB has no name for."""
    entry: dict[str, Any] = {
        "cam_name": "rgb_0", "cam_type": "rgb+depth", "depth_name": "depth_0", "cam_model": "pinhole",
        "focal_length": [camera.fx, camera.fy], "principal_point": [camera.cx, camera.cy],
        "image_dimension": [camera.width, camera.height], "depth_factor": depth_factor, "fps": rate_hz,
        "T_BS": np.eye(4).ravel().tolist(),
    }  # fmt: skip
    if camera.model == "pinhole":
        return entry
    if camera.model == "double_sphere" or any(camera.distortion[5:]):
        raise UserError(f"color: VSLAM-LAB has no {camera.model} lens: render with radtan or fisheye")
    lens = "equid4" if camera.model == "fisheye" else f"radtan{min(len(camera.distortion), 5)}"
    return entry | {"distortion_type": lens, "distortion_coefficients": list(camera.distortion[:5])}
