"""What would be tracked: the text of `rstrack info`."""

from __future__ import annotations

from collections import Counter

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.geometry.spline import Spline
from rstrack.data.dataset import Dataset
from rstrack.data.rig import Rig
from rstrack.metrics.association import truth_of


def describe(dataset: Dataset) -> str:
    """Cameras, shutters, frames and truth of a dataset, a few lines."""
    rig = dataset.rig
    rows = [
        ("name", dataset.name),
        ("depth", _stream(dataset.stamps)),
        ("", _camera(rig.depth_camera)),
        ("", _shutter(rig.depth_shutter, rig.depth_camera)),
        ("colour", _stream(dataset.color_stamps)),
        ("", _camera(rig.color_camera)),
        ("", _shutter(rig.color_shutter, rig.color_camera)),
        ("colour", f"{_relative_pose(rig.T_color_depth)} from the depth camera"),
        ("sigma", _sigma(rig)),
        ("frames", f"{len(dataset)}, {_groups(dataset)}"),
        ("truth", _truth(dataset)),
        *_imu(dataset),
        *(("note", note) for note in dataset.notes),
    ]
    if dataset.timing is not None:
        rows += [("clocks" if i == 0 else "", line) for i, line in enumerate(dataset.timing.lines())]
    return "\n".join(f"{label:<8} {text}" for label, text in rows)


def _stream(stamps: FloatArray) -> str:
    if not len(stamps):
        return "no images"
    rate = f" at {1.0 / np.median(np.diff(stamps)):.4g} Hz" if len(stamps) > 1 else ""
    return f"{len(stamps)} images{rate}, {stamps[0]:.3f} to {stamps[-1]:.3f} s"


def _camera(c: Camera) -> str:
    return f"{c.width}x{c.height} {c.model}, fx {c.fx:g} fy {c.fy:g} cx {c.cx:g} cy {c.cy:g}"


def _shutter(shutter: Shutter, camera: Camera) -> str:
    exposure = f"exposure {1e3 * shutter.exposure_s:g} ms"
    if shutter.readout_s == 0:
        return f"global shutter, {exposure}"
    delay = 1e6 * shutter.line_delay(camera)
    return f"rolling shutter, readout {1e3 * shutter.readout_s:g} ms {shutter.scan}, {delay:.3f} us a line, {exposure}"


def _relative_pose(T: FloatArray) -> str:
    angle = np.degrees(np.linalg.norm(se3.log(T)[3:]))
    return f"{1e3 * np.linalg.norm(T[:3, 3]):.1f} mm and {angle:.2f} degrees"


def _sigma(rig: Rig) -> str:
    """How far the cameras may be wrong."""
    s, fx = rig.sigma, rig.color_camera.fx
    if s.is_exact:
        return "the cameras are exact"
    apart = "" if rig.is_registered else f", extrinsics {1e3 * s.translation_m:.3g} mm {s.rotation_deg:.3g} degrees"
    return (
        f"focal length {100 * s.focal:.3g} %, aspect {100 * s.aspect:.3g} %, center {s.center * fx:.3g} px, "
        f"k1 {s.k1:.3g}, p1 and p2 {s.p:.3g}, "
        f"readout {1e3 * s.readout_s:.3g} ms, clock {1e3 * s.offset_s:.3g} ms{apart}, "
        f"depth {100 * s.depth_scale:.3g} % and {s.depth_inverse_offset:.3g}/m, each image {s.depth_image:.3g}/m "
        "(camera file: 'sigma')"
    )


def _imu(dataset: Dataset) -> list[tuple[str, str]]:
    """Samples, noise and place of an IMU, or why it cannot be used; nothing where there is none."""
    if dataset.imu_files is None:
        return []
    try:
        found = dataset.read_imu
    except UserError as error:
        return [("imu", f"not to be used: {error}")]
    if found is None:
        return []
    imu = found.recording
    kind = "accelerometer alone" if imu.gyro is None else "gyroscope and accelerometer"
    noise = imu.noise
    gyro = "" if imu.gyro is None else f"{noise.gyro_density:.3g} rad/s/√Hz, "
    return [
        ("imu", f"{kind}, {len(imu.t)} samples at {imu.rate_hz:.4g} Hz, {imu.t[0]:.3f} to {imu.t[-1]:.3f} s"),
        (
            "",
            f"{_relative_pose(imu.T_imu_depth)} from the depth camera, noise {gyro}{noise.accel_density:.3g} m/s²/√Hz",
        ),
        *(("", note) for note in found.notes),
    ]


def _groups(dataset: Dataset) -> str:
    """How many colour images the frames have."""
    sizes = Counter(len(group) for group in dataset.groups)
    if len(sizes) == 1:
        return f"each with {_images(*sizes)}"
    return ", ".join(f"{number} with {_images(size)}" for size, number in sorted(sizes.items()))


def _images(count: int) -> str:
    return "one colour image" if count == 1 else f"{count or 'no'} colour images"


def _truth(dataset: Dataset) -> str:
    truth = truth_of(dataset)
    if truth is None:
        return "none: runs can be plotted but not evaluated"
    if isinstance(truth.motion, Spline):
        knots = f"{len(truth.motion.control_points)} control points {1e3 * truth.motion.dt:g} ms apart"
        return f"a spline, exact at every line: {knots}"
    return f"{len(truth.motion)} poses, {truth.motion.stamps[0]:.3f} to {truth.motion.stamps[-1]:.3f} s"
