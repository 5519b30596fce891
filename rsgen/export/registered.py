"""Registered depth, as drivers deliver it: warped into the colour camera by geometry alone, motion ignored.

Writes a plain TUM RGB-D folder. A row of a registered image mixes pixels of neighbouring depth rows; where the cameras
lie beside each other their order hardly changes, and camera.yaml says whose lines' times they have.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rsgen.array_types import Float32Array, FloatArray
from rsgen.console.progress import Progress, no_progress
from rsgen.export.folder import make_folders, new_folder, place_images
from rsgen.files import atomic_write, encode_png, encode_yaml
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.produce.writer import quantise
from rsgen.sequence.format import associate, ground_truth, pose_rows
from rsgen.sequence.reader import Sequence

_MARK = "registered to the colour camera"


def export_registered(sequence: Sequence, out: Path, copy: bool = False, progress: Progress = no_progress) -> str:
    """Write the new folder `out` in TUM's layout with registered depth; returns one line.

    rgb/ holds hard links where the disk allows, or copies with `copy`. camera.yaml (as rstrack reads it) says that
    depth has the colour camera, and which camera with which shutter it was warped from; groundtruth.txt holds poses of
    the colour camera. Stamps are the sequence's. Raises UserError if `out` is not empty, or an image cannot be read.
    """
    color, depth = sequence.streams["color"], sequence.streams["depth"]
    sequence.depth(0)  # of the size that sequence.yaml says, or all below would take memory for another one
    new_folder(out)
    make_folders(out / "rgb", out / "depth")
    place_images(color.paths, [out / "rgb" / path.name for path in color.paths], copy, progress, (0.0, 0.1))
    rays = depth.camera.unproject(depth.camera.pixel_grid())
    filled = 0.0
    for k, path in enumerate(depth.paths):
        z = register_depth(rays, sequence.depth(k), color.camera, sequence.T_color_depth)
        filled += float((z > 0).mean()) / len(depth.paths)
        atomic_write(out / "depth" / path.name, encode_png(quantise(z, depth.depth_scale)))
        progress("export", 0.1 + 0.9 * (k + 1) / len(depth.paths), path.name)

    entries = {
        folder: [f"{t:.9f} {folder}/{path.name}" for t, path in zip(stream.stamps, stream.paths, strict=True)]
        for folder, stream in (("rgb", color), ("depth", depth))
    }
    _write(out / "rgb.txt", [f"# colour images of {sequence.name}", "# stamp path", *entries["rgb"]])
    _write(out / "depth.txt", [f"# depth images of {sequence.name}, {_MARK}", "# stamp path", *entries["depth"]])
    pairs = associate(color.stamps, depth.stamps, 0.5 / min(color.rate_hz, depth.rate_hz))
    _write(out / "associations.txt", [f"{entries['rgb'][i]} {entries['depth'][j]}" for i, j in pairs])
    times = ground_truth(sequence.spline, color.stamps, depth.stamps)[:, 0]
    rows = pose_rows(sequence.spline.pose(times) @ se3.inverse(sequence.T_color_depth))
    poses = [f"{t:.9f} " + " ".join(f"{value:.12f}" for value in row) for t, row in zip(times, rows, strict=True)]
    header = [f"# ground truth of {sequence.name}: T_world_color", "# stamp tx ty tz qx qy qz qw"]
    _write(out / "groundtruth.txt", header + poses)
    atomic_write(out / "camera.yaml", f"# depth is {_MARK}\n".encode() + encode_yaml(_camera_yaml(sequence)))
    return f"{out}: {len(depth.paths)} depth images {_MARK}; {100 * filled:.0f} % of pixels have depth"


def register_depth(
    rays_depth: FloatArray, z: Float32Array, color: Camera, T_color_depth: npt.ArrayLike
) -> Float32Array:
    """Depth as the colour camera sees it: planar z (H, W) in metres of its pixels, 0 where no point falls.

    Each depth pixel's point goes to the nearest colour pixel; of several the nearest point stays (z-buffer). Depth
    coarser than colour leaves holes, as it does in drivers that do not fill.

    rays_depth (h, w, 3): rays with z = 1 of the depth camera's pixels. z (h, w): m, 0 where nothing was measured.
    """
    seen = z > 0
    p_color = se3.transform(T_color_depth, rays_depth[seen] * z[seen].astype(np.float64)[:, None])
    uv, _ = color.project(p_color)
    inside = color.contains(uv)
    u, v = np.rint(uv[inside]).astype(np.int64).T
    # A half rounds to the even number, which at the image's edge can be one too far.
    place = np.clip(v, 0, color.height - 1) * color.width + np.clip(u, 0, color.width - 1)
    buffer = np.full(color.height * color.width, np.inf, np.float32)
    np.minimum.at(buffer, place, p_color[inside, 2].astype(np.float32))
    return np.where(np.isfinite(buffer), buffer, np.float32(0)).reshape(color.height, color.width)


def _camera_yaml(sequence: Sequence) -> Mapping[str, Any]:
    color, depth = sequence.streams["color"], sequence.streams["depth"]
    sensor = _camera(depth.camera) | {"T_color_sensor": sequence.T_color_depth.tolist()}
    warped = {"registered": True, "sensor": sensor, "depth_scale": depth.depth_scale}
    return {
        "stamps": "raw",
        "color": _camera(color.camera) | _shutter(color.shutter) | {"offset_s": 0.0},
        "depth": _camera(color.camera) | _shutter(depth.shutter) | warped,
    }


def _camera(camera: Camera) -> dict[str, Any]:
    return {
        "width": camera.width,
        "height": camera.height,
        "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
        "model": camera.model,
        "distortion": list(camera.distortion),
    }


def _shutter(shutter: Shutter) -> dict[str, Any]:
    return {"readout_s": shutter.readout_s, "exposure_s": shutter.exposure_s, "scan": shutter.scan}


def _write(path: Path, lines: list[str]) -> None:
    atomic_write(path, "".join(f"{line}\n" for line in lines).encode())
