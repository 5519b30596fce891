"""A sequence in NVIDIA's NCore format (`nvidia-ncore`, an optional extra), whose readers know rolling shutters.

NAME.ncore4.zarr.itar holds the cameras `color` and `depth` with their images as they are, and the poses of `rig`, the
depth camera, in `world`. Times are whole microseconds, 10⁹ s after the sequence's. An image has those of its first and
its last line, at mid-exposure; NCore puts line i of n at i / (n - 1) between them, as a sensor's lines are. Poses are
as dense as the loss of interpolating them is small: who looks one up for each line has that line's.
"""

from __future__ import annotations

import importlib
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError, how_to_install
from rsgen.files import read_bytes, write_error
from rsgen.formats.export import poses
from rsgen.formats.export.shared import DEFAULTS, EPOCH_S, ExportOptions, counted, image_streams, new_folder
from rsgen.geometry import se3
from rsgen.sequence.images import ImageStream, Rig, Sequence

ENDS, DENSE = "start and end pose of an image", "the pose of each line"
_STEP_US = 500  # a hand turns by nothing that is not straight meanwhile: 0.001 px
Times = npt.NDArray[np.uint64]


def export_ncore(sequence: Rig, out: Path, options: ExportOptions = DEFAULTS, progress: Progress = no_progress) -> str:
    """Write the new folder `out`; returns one line. Cameras and poses are the true ones.

    Raises UserError if nvidia-ncore is not installed, it has no such lens, `out` is not empty, or a file cannot be read
    or written.
    """
    v4, data = _library()
    sequence = sequence.as_taken
    streams = image_streams(sequence)
    models = {name: _model(data, stream) for name, stream in streams.items()}
    frames = {name: frame_times_us(stream) for name, stream in streams.items()}
    first, last = (int(f([f(times) for times in frames.values()])) for f in (np.min, np.max))
    times = np.append(np.arange(first, last, _STEP_US), last).astype(np.uint64)
    T_world_rig = sequence.spline.pose(times.astype(float) * 1e-6 - EPOCH_S)
    losses = _losses(sequence) if isinstance(sequence, Sequence) else {}

    new_folder(out)
    facts = poses.shutter_facts(sequence, losses) | {"epoch_s": EPOCH_S}
    try:
        interval = importlib.import_module("ncore.impl.common.transformations").HalfClosedInterval(first, last + 1)
        writer = v4.SequenceComponentGroupsWriter(out, sequence.name, sequence.name, interval, facts)
        # Its loader looks for these four by this name, masks and boxes too, of which there are none.
        kinds = v4.PosesComponent, v4.IntrinsicsComponent, v4.MasksComponent, v4.CuboidsComponent
        rig, intrinsics, masks, boxes = (writer.register_component_writer(kind.Writer, "default") for kind in kinds)
        boxes.store_observations([])
        rig.store_dynamic_pose("rig", "world", _with_exact_row(T_world_rig), times)
        count, done = sum(len(stream.paths) for stream in streams.values()), 0
        for name, stream in streams.items():
            rig.store_static_pose(name, "rig", _with_exact_row(se3.inverse(stream.T_cam_body)))
            intrinsics.store_camera_intrinsics(name, models[name])
            masks.store_camera_masks(name, {})
            about = {"depth_units_per_metre": stream.depth_scale} if stream.depth_scale else {}
            camera = writer.register_component_writer(v4.CameraSensorComponent.Writer, name, None, about)
            for k, path in enumerate(stream.paths):
                camera.store_frame(read_bytes(path), "png", frames[name][k], {}, {"stamp_s": float(stream.stamps[k])})
                done += 1
                progress("export", done / count, path.name)
        (path,) = writer.finalize()
    except BaseException as error:
        shutil.rmtree(out, ignore_errors=True)  # it was empty before: whole or not at all
        if isinstance(error, OSError):
            raise write_error(out, error) from None
        raise
    return f"{path}: {counted(streams)}, stamps + {EPOCH_S} s; {poses.loss_words(losses)}"


def frame_times_us(stream: ImageStream) -> Times:
    """(n, 2): mid-exposure of the first line that is read and of the last of each image, microseconds."""
    lines = np.array([0.0, stream.line_count - 1.0])
    times = stream.shutter.line_mid_time(poses.blur_centres(stream)[:, None], lines, stream.camera)
    return np.rint(1e6 * (times + EPOCH_S)).astype(np.uint64)


def _library() -> tuple[Any, Any]:
    try:
        return importlib.import_module("ncore.data.v4"), importlib.import_module("ncore.data")
    except ImportError:
        raise UserError(f"writing NCore needs nvidia-ncore: {how_to_install('ncore')}") from None


def _with_exact_row(T: FloatArray) -> FloatArray:
    """The library compares the last row with 0 0 0 1."""
    T = np.array(T, np.float64)
    T[..., 3, :] = (0.0, 0.0, 0.0, 1.0)
    return T


def _model(data: Any, stream: ImageStream) -> Any:
    """The stream's camera as one of NCore's; its pixel centres are at halves. Raises UserError: it has none such."""
    camera = stream.camera
    common = {
        "resolution": np.array([camera.width, camera.height], np.uint64),
        "shutter_type": data.ShutterType[poses.shutter_type(stream.shutter)],
        "external_distortion_parameters": None,
        "principal_point": np.array([camera.cx + poses.PIXEL_SHIFT, camera.cy + poses.PIXEL_SHIFT], np.float32),
        "focal_length": np.array([camera.fx, camera.fy], np.float32),
    }
    if camera.model == "fisheye":
        corners = camera.unproject(np.array([[x, y] for x in (0, camera.width - 1) for y in (0, camera.height - 1)]))
        widest = float(np.arctan(np.linalg.norm(corners[:, :2] / corners[:, 2:], axis=1)).max())
        k = np.array(camera.distortion, np.float32)
        return data.OpenCVFisheyeCameraModelParameters(**common, radial_coeffs=k, max_angle=1.05 * widest)
    if camera.model == "double_sphere":
        raise UserError("NCore has no double_sphere lens: render with radtan, rational or fisheye")
    k1, k2, p1, p2, k3, k4, k5, k6 = (*camera.distortion, *[0.0] * (8 - len(camera.distortion)))
    return data.OpenCVPinholeCameraModelParameters(
        **common,
        radial_coeffs=np.array([k1, k2, k3, k4, k5, k6], np.float32),
        tangential_coeffs=np.array([p1, p2], np.float32),
        thin_prism_coeffs=np.zeros(4, np.float32),
    )


def _losses(sequence: Sequence) -> dict[str, poses.Loss]:
    """Of the two poses of an image, which NCore's camera models take, and of poses looked up for each line."""
    color, observed = sequence.streams["color"], poses.observations(sequence)
    start, end = (poses.at_line(sequence, line)[observed.image] for line in (0.0, color.line_count - 1.0))
    stamps = color.shutter.line_mid_time(poses.blur_centres(color)[observed.image], 0.0, color.camera)
    length = color.shutter.line_delay(color.camera) * (color.line_count - 1)
    part = (observed.t - stamps) / length if length > 0.0 else np.zeros_like(observed.t)
    ends = se3.inverse(poses.between(se3.inverse(start), se3.inverse(end), part))
    step, T_rig_color = 1e-6 * _STEP_US, se3.inverse(sequence.T_color_depth)
    before = np.floor(observed.t / step) * step
    held = np.clip([before, before + step], sequence.spline.t_begin, sequence.spline.t_end)
    T_before, T_after = (sequence.spline.pose(t) for t in held)
    dense = poses.between(T_before, T_after, (observed.t - held[0]) / (held[1] - held[0])) @ T_rig_color
    return {
        ENDS: poses.loss_of_poses(color.camera, observed, ends),
        DENSE: poses.loss_of_poses(color.camera, observed, dense),
    }
