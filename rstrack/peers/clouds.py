"""Peers that align clouds of points, as for lidars: KISS-ICP and small_gicp, on depth alone, each point with its time.

estimate = run_cloud_peer("kiss-icp", open_dataset(Path("out/table1")), slice(0, 300))

Both take the rolling shutter for what a lidar's spinning is: KISS-ICP deskews by itself, small_gicp, which does not,
gets clouds deskewed in the same way, by the motion between the two poses before. Settings were tuned once (60 frames
each of lr_kt2 and table1, 320x240, five settings), for rooms instead of streets.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError, how_to_install
from rsgen.geometry import se3
from rstrack.data.dataset import Dataset
from rstrack.data.estimate import Estimate
from rstrack.options import CLOUD_PEERS, Options
from rstrack.peers.peer import readout_s, run_info, timed_frames

# Pixels of a depth image are thinned out to about so many.
_POINTS = 40_000
_NEAREST_M = 0.1
_PACKAGES = {"kiss-icp": "kiss-icp", "small-gicp": "small_gicp"}


class KissIcp:
    """KISS-ICP (Vizzo et al., RA-L 2023): point to point against a voxel map, deskewed to the end of each scan.

    It takes a scan to last as long as the time between two, whatever it is given: shorter readouts are deskewed too
    much. settings: for run.json.
    """

    def __init__(self, max_depth: float) -> None:
        module = _module("kiss_icp.kiss_icp", "kiss-icp")
        config = _module("kiss_icp.config", "kiss-icp").load_config(None)
        self.settings = {"voxel_size": 0.1, "initial_threshold": 0.3, "min_motion_th": 0.02}
        config.data.max_range, config.data.min_range, config.data.deskew = max_depth, _NEAREST_M, True
        config.mapping.voxel_size = self.settings["voxel_size"]
        config.adaptive_threshold.initial_threshold = self.settings["initial_threshold"]
        config.adaptive_threshold.min_motion_th = self.settings["min_motion_th"]
        self._odometry = module.KissICP(config)

    def register(self, p_cam: FloatArray, line: FloatArray) -> FloatArray:
        """T_world_cam (4, 4) at the last line, from points (n, 3) in m that were seen at times `line` (n,), see
        `cloud_of`."""
        # It stretches the times to 0..1: where all are alike, which it would divide by, nothing is to be deskewed.
        self._odometry.register_frame(p_cam, line if np.ptp(line) > 0.0 else np.empty(0))
        return np.array(self._odometry.last_pose)


class SmallGicp:
    """small_gicp (Koide, JOSS 2024): generalised ICP against a keyframe, from a motion that goes on as it was."""

    def __init__(self, options: Options) -> None:
        self._gicp = _module("small_gicp", "small-gicp")
        self.settings = {"downsampling_resolution": 0.05, "max_correspondence_distance": 0.2, "max_iterations": 30}
        self._options = options
        self._key: tuple[Any, Any] | None = None
        self._T_world_key = self._T_world_last = self._delta = np.eye(4)

    def register(self, p_cam: FloatArray, line: FloatArray) -> FloatArray:
        """See `KissIcp`."""
        points = deskewed(p_cam, line, self._delta)
        cloud = self._gicp.preprocess_points(points, self.settings["downsampling_resolution"])
        if self._key is None:
            self._key = cloud
            return self._T_world_last
        guess = se3.inverse(self._T_world_key) @ self._T_world_last @ self._delta
        found = self._gicp.align(
            self._key[0], cloud[0], self._key[1], guess,
            max_correspondence_distance=self.settings["max_correspondence_distance"],
            max_iterations=int(self.settings["max_iterations"]),
        )  # fmt: skip
        T_key_cam = se3.orthonormalise(np.array(found.T_target_source))
        T_world_cam = se3.orthonormalise(self._T_world_key @ T_key_cam)
        self._delta = se3.inverse(self._T_world_last) @ T_world_cam
        self._T_world_last = T_world_cam
        if self._options.remoteness(T_key_cam) > 1.0:
            self._key, self._T_world_key = cloud, T_world_cam
        return T_world_cam


def deskewed(p_cam: FloatArray, line: FloatArray, delta: FloatArray) -> FloatArray:
    """Points (n, 3), seen at times `line` (n,) from 0 to 1, where the camera of time 1 would have seen them.

    delta (4, 4): its motion from 0 to 1, at constant velocity.
    """
    steps = np.linspace(0.0, 1.0, 65)
    moved = se3.exp((steps - 1.0)[:, None] * se3.log(delta))
    return np.asarray(se3.transform(moved[np.rint(64 * line).astype(int)], p_cam))


def run_cloud_peer(
    name: str, dataset: Dataset, frames: slice = slice(None), progress: Progress = no_progress
) -> Estimate:
    """Track frames of a dataset with one of CLOUD_PEERS; its poses at the depth frames' stamps.

    A pose is that of the last line, to whose time points are deskewed, and interpolated to the stamp.

    Raises UserError: unknown name, the peer is not installed, no such frames, an image cannot be read or holds nothing.
    """
    chosen, tracker = dataset.chosen(frames), _tracker(name)
    poses: list[FloatArray] = []

    def feed(k: int, cloud: tuple[FloatArray, FloatArray]) -> None:
        if len(cloud[0]) < 100:
            raise UserError(f"{dataset.root}: depth frame {k} holds next to nothing, of which {name} makes no pose")
        poses.append(tracker.register(*cloud))

    begin = time.perf_counter()
    seconds = timed_frames(name, chosen, cloud_of(dataset), feed, progress)
    stamps = dataset.stamps[chosen]
    T_world_depth = se3.interpolated(stamps + readout_s(dataset, 1.0), np.array(poses), stamps)
    info = run_info(name, {_PACKAGES[name]: version(_PACKAGES[name])}, "on the CPU", dataset, chosen, begin, seconds)
    info |= {"settings": tracker.settings, "keyframes": 0, "lost": 0}
    return Estimate(stamps, se3.orthonormalise(T_world_depth), info=info)


def cloud_of(dataset: Dataset) -> Callable[[int], tuple[FloatArray, FloatArray]]:
    """Of frame k: points (n, 3) in the depth camera, m, and when each was seen (n,), in times between two frames: the
    last line at 1."""
    camera, shutter = dataset.rig.depth_camera, dataset.rig.depth_shutter
    stride = max(1, round(np.sqrt(camera.width * camera.height / _POINTS)))
    uv = camera.pixel_grid()[::stride, ::stride].reshape(-1, 2)
    rays = camera.unproject(uv)
    before_s = readout_s(dataset, 1.0) - shutter.line_mid_time(0.0, shutter.line_of_pixel(uv, camera), camera)
    line = np.maximum(0.0, 1.0 - before_s / float(np.median(np.diff(dataset.stamps))))
    longest = Options().max_depth

    def cloud(k: int) -> tuple[FloatArray, FloatArray]:
        z = dataset.depth(k)[::stride, ::stride].reshape(-1).astype(np.float64)
        seen = (z > _NEAREST_M) & (z < longest)
        return rays[seen] * z[seen, None], line[seen]

    return cloud


def _tracker(name: str) -> KissIcp | SmallGicp:
    if name not in CLOUD_PEERS:
        raise UserError(f"unknown peer '{name}': choose {', '.join(CLOUD_PEERS)}")
    return KissIcp(Options().max_depth) if name == "kiss-icp" else SmallGicp(Options())


def _module(name: str, package: str) -> Any:
    from importlib import import_module

    try:
        return import_module(name)
    except ImportError as error:
        raise UserError(f"the peer needs {package} ({error}): {how_to_install('peers', package=package)}") from None
