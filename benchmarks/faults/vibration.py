"""A camera that vibrates while it is read: lines of an image are turned, each by the angle of its own time."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from rsgen.array_types import ByteArray, Float32Array, FloatArray
from rsgen.geometry import so3
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.sequence.trajectory import Trajectory
from rstrack.bench.changes.edits import with_color, with_depth
from rstrack.data.dataset import Dataset
from rstrack.metrics.association import true_poses, truth_of

# Inverse depths that interpolation mixes belong to one surface if they differ by less than this part.
_ONE_SURFACE = 0.03


def vibrating(dataset: Dataset, first: int, count: int, swing: FloatArray, hertz: float) -> Dataset:
    """Frames [first, first + count) of a depth camera that turns by swing · sin(2π · hertz · (t − t_first)).

    swing (3,): rotation vector in the depth camera's frame, rad; 1/hertz may be shorter than a readout. Either camera
    turns about its own centre (a turn by half a degree moves one 5 cm beside the other by 0.4 mm, which is left out),
    and the little that the recording's own motion changes while a line passes the few pixels of the swing is too.
    """
    rig, begin = dataset.rig, float(dataset.stamps[first])
    touched = frozenset(i for group in dataset.groups[first : first + count] for i in group)
    R_color_depth = rig.T_color_depth[:3, :3]

    def angles(t: FloatArray) -> FloatArray:
        return np.asarray(np.sin(2.0 * np.pi * hertz * (t - begin))[..., None] * swing)

    def turned_depth(k: int, z: Float32Array) -> Float32Array:
        if not first <= k < first + count:
            return z
        R = so3.exp(angles(_pixel_times(rig.depth_camera, rig.depth_shutter, dataset.stamps[k])))
        return _turned_depth(rig.depth_camera, R, z)

    def turned_color(k: int, pixels: ByteArray) -> ByteArray:
        if k not in touched:
            return pixels
        at = angles(_pixel_times(rig.color_camera, rig.color_shutter, dataset.color_stamps[k])) @ R_color_depth.T
        x, y, _ = _source(rig.color_camera, so3.exp(at))
        return np.asarray(cv2.remap(pixels, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))

    made = with_color(with_depth(dataset, turned_depth), turned_color)
    truth = truth_of(dataset)
    if truth is None:
        return made
    index, T = true_poses(truth.motion, dataset.stamps, interpolate=True)
    T, inside = T.copy(), (index >= first) & (index < first + count)
    T[inside, :3, :3] = T[inside, :3, :3] @ so3.exp(angles(dataset.stamps[index[inside]]))
    return replace(made, truth=None, truth_poses=Trajectory(dataset.stamps[index], T), sequence=None)


# ---------------------------------------------------------------------------------------------------------------------


def _pixel_times(camera: Camera, shutter: Shutter, stamp: float) -> FloatArray:
    """Mid-exposures (h, w) of an image's pixels, s."""
    return shutter.line_mid_time(stamp, shutter.line_of_pixel(camera.pixel_grid(), camera), camera)


def _source(camera: Camera, R_still_turned: FloatArray) -> tuple[Float32Array, Float32Array, FloatArray]:
    """Pixels x, y (h, w) of the camera at rest that those of the turned one show, and their directions (h, w, 3)."""
    d = np.einsum("...ij,...j->...i", R_still_turned, camera.unproject(camera.pixel_grid()))
    uv, _ = camera.project(d)
    uv = np.nan_to_num(uv, nan=-1e4).astype(np.float32)
    return np.ascontiguousarray(uv[..., 0]), np.ascontiguousarray(uv[..., 1]), d


def _turned_depth(camera: Camera, R_still_turned: FloatArray, z: Float32Array) -> Float32Array:
    """Depth (h, w) as the turned camera sees it: inverse depth is interpolated, which is exact on planes."""
    x, y, d = _source(camera, R_still_turned)
    rho = np.divide(np.float32(1.0), z, out=np.zeros_like(z), where=z > 0)
    smooth, near = (
        np.asarray(cv2.remap(rho, x, y, how, borderMode=cv2.BORDER_CONSTANT, borderValue=0.0))
        for how in (cv2.INTER_LINEAR, cv2.INTER_NEAREST)
    )
    rho = np.where(np.abs(smooth - near) < _ONE_SURFACE * near, smooth, near)
    # A ray of the turned camera, (x, y, 1) times its z, is d times that: the point's z before is z · d_z.
    return np.divide(1.0, rho * d[..., 2], out=np.zeros(z.shape), where=rho > 0).astype(np.float32)
