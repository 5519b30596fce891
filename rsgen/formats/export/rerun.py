"""A sequence as a rerun recording (.rrd): cameras, images, path, IMU and the scene's surface on one timeline.

Needs rerun-sdk, an optional extra. Rerun's cameras are pinholes: images are shown as recorded, distortion and all, at
the pose in the middle of their readout.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rsgen.console.progress import Progress, no_progress
from rsgen.console.rerun import recording_file
from rsgen.errors import UserError
from rsgen.files import read_bytes
from rsgen.formats.export.shared import DEFAULTS, ExportOptions, image_streams
from rsgen.geometry import se3
from rsgen.sensors.reports import sequence_imu
from rsgen.sequence.format import ground_truth
from rsgen.sequence.images import Rig

TIMELINE = "time"
_UP = {(0, 1): "X_DOWN", (0, -1): "X_UP", (1, 1): "Y_DOWN", (1, -1): "Y_UP", (2, 1): "Z_DOWN", (2, -1): "Z_UP"}
_PATH_COLOR, _SCENE_COLOR = [230, 120, 30], [190, 190, 190]


def export_rerun(sequence: Rig, out: Path, options: ExportOptions = DEFAULTS, progress: Progress = no_progress) -> str:
    """Write the recording `out` (.rrd), whole or not at all; returns one line. Timeline "time": the sequence's seconds.

    Raises UserError if rerun-sdk is not installed, if `out` is there already or not named .rrd, or a file of the
    sequence cannot be read.
    """
    out = Path(out)
    with recording_file(out, "rsgen", sequence.name, "--out") as (rr, recording):
        _log(rr, recording, sequence.as_taken, progress)
    return f"{out}: {out.stat().st_size / 1e6:.1f} MB, open it with 'rerun {out.name}'"


def _log(rr: Any, recording: Any, sequence: Rig, progress: Progress) -> None:
    imu = sequence_imu(sequence)
    gravity = np.array(imu.config.gravity) if imu else np.zeros(3)
    axis = int(np.argmax(np.abs(gravity)))
    up = _UP[axis, int(np.sign(gravity[axis]))] if gravity.any() else "Y_UP"
    recording.log("world", getattr(rr.ViewCoordinates, f"RIGHT_HAND_{up}"), static=True)
    _log_scene(rr, recording, sequence.root / "scene.ply")
    path = sequence.spline.pose(ground_truth(sequence.spline)[:, 0])[:, :3, 3]
    recording.log("world/path", rr.LineStrips3D([path], colors=[_PATH_COLOR]), static=True)
    for name, channels in (("gyro", "rad/s"), ("accel", "m/s^2")):
        if imu:
            names = [f"{axis} {channels}" for axis in "xyz"]
            recording.log(f"imu/{name}", rr.SeriesLines(names=names), static=True)
            times = [rr.TimeColumn(TIMELINE, duration=imu.samples.t)]
            recording.send_columns(f"imu/{name}", times, rr.Scalars.columns(scalars=getattr(imu.samples, name)))

    streams, done = image_streams(sequence), 0
    count = sum(len(stream.paths) for stream in streams.values())
    for stream in streams.values():
        where, camera = f"world/{stream.name}", stream.camera
        pinhole = rr.Pinhole(
            image_from_camera=camera.K,
            resolution=[camera.width, camera.height],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=0.2,
        )
        recording.log(where, pinhole, static=True)
        middle = stream.shutter.line_mid_time(stream.stamps, 0.5 * (stream.line_count - 1), camera)
        poses = np.asarray(sequence.spline.pose(middle) @ se3.inverse(stream.T_cam_body))
        for k, file in enumerate(stream.paths):
            recording.set_time(TIMELINE, duration=float(stream.stamps[k]))
            recording.log(where, rr.Transform3D(translation=poses[k, :3, 3], mat3x3=poses[k, :3, :3]))
            data = read_bytes(file)
            if stream.depth_scale:
                picture = rr.EncodedDepthImage(data, media_type="image/png", meter=stream.depth_scale)
            else:
                picture = rr.EncodedImage(contents=data, media_type="image/png")
            recording.log(f"{where}/image", picture)
            done += 1
            progress("export", done / count, file.name)


def _log_scene(rr: Any, recording: Any, path: Path) -> None:
    if not path.is_file():
        return
    import trimesh

    try:
        mesh = trimesh.load_mesh(path, process=False)
        vertices, faces = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32)
    except (ValueError, IndexError, KeyError, AttributeError, TypeError, EOFError, OSError):
        raise UserError(f"{path}: cannot be read as a mesh: delete it and render again") from None
    mesh3d = rr.Mesh3D(vertex_positions=vertices, triangle_indices=faces, albedo_factor=_SCENE_COLOR)
    recording.log("world/scene", mesh3d, static=True)
