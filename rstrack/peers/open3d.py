"""Other people's trackers on the same frames: Open3D's RGB-D odometry, frame to frame and frame to keyframe.

estimate = run_peer("open3d-hybrid", open_dataset(Path("out/lr_kt2")), slice(0, 300))
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from typing import Any

import numpy as np

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress, no_progress
from rsgen.errors import UserError, how_to_install
from rsgen.geometry import se3
from rsgen.geometry.camera import Camera
from rstrack.data.dataset import Dataset, registered_image
from rstrack.data.estimate import Estimate
from rstrack.data.registration import RegisteredImage, Registrar
from rstrack.options import PEERS, Options
from rstrack.peers.peer import readout_s, run_info, timed_frames

_KEYFRAME = "-keyframe"
# Part of the pixels that must have found a partner, and frames in a row without, after which the reference is given up.
_LEAST_FITNESS = 0.1
_MOST_LOST = 5


@dataclass(frozen=True)
class PeerFrame:
    """What a peer reports of a frame. fitness: part of its pixels with a partner; inlier_rmse: of their residuals."""

    stamp: float
    lost: bool
    keyframe: bool
    fitness: float
    inlier_rmse: float


class PeerTracker:
    """Open3D's `rgbd_odometry_multi_scale` with the iterations and losses that it has by default.

    Its hybrid error (as of 0.20) looks colour and depth up at the nearest pixel, never between, and so cannot settle
    within half a pixel: that adds up frame to frame.

    Frame to frame it starts from no motion, as Open3D's own pipelines do; frame to keyframe from the last pose, with
    our tracker's rule for a new keyframe. A frame that does not fit, or for which Open3D gives up, is lost.
    T_world_depth of the frames found are in `poses`, the world being the first one's camera.

    Raises UserError: unknown name, or Open3D cannot be loaded.
    """

    def __init__(self, name: str, camera: Camera) -> None:
        if name not in PEERS:
            raise UserError(f"unknown peer '{name}': choose {', '.join(PEERS)}")
        self._o3d = open3d()
        self.options = Options()
        self._to_keyframe = name.endswith(_KEYFRAME)
        self._method = getattr(self._o3d.t.pipelines.odometry.Method, "PointToPlane" if "icp" in name else "Hybrid")
        self._intrinsics = self._tensor(camera.K)
        self._reference: Any = None
        self._T_world_ref = np.eye(4)
        self._T_ref_last = np.eye(4)
        self._first_fitness: float | None = None
        self._lost_in_a_row = 0
        self.stamps: list[float] = []
        self.poses: list[FloatArray] = []
        self.reports: list[PeerFrame] = []
        self.keyframes = 0

    def feed(self, stamp: float, image: RegisteredImage) -> PeerFrame:
        """Track one frame."""
        o3d = self._o3d
        rgbd = o3d.t.geometry.RGBDImage(
            o3d.t.geometry.Image(self._tensor(image.color)), o3d.t.geometry.Image(self._tensor(image.depth)), True
        )
        report = self._start(stamp, rgbd, image) if self._reference is None else self._track(stamp, rgbd)
        self.reports.append(report)
        return report

    def _start(self, stamp: float, rgbd: Any, image: RegisteredImage) -> PeerFrame:
        is_lost = bool((image.depth > 0).mean() < _LEAST_FITNESS)
        if not is_lost:
            self._set_reference(rgbd, np.eye(4))
            self._found(stamp, np.eye(4))
        return PeerFrame(stamp, is_lost, not is_lost, float("nan"), float("nan"))

    def _track(self, stamp: float, rgbd: Any) -> PeerFrame:
        start = self._T_ref_last if self._to_keyframe else np.eye(4)
        T_ref_cam, fitness, rmse = self._align(rgbd, start)
        if T_ref_cam is None:
            self._lost_in_a_row += 1
            is_new = self._lost_in_a_row >= _MOST_LOST
            if is_new:
                self._set_reference(rgbd, self._T_world_ref @ self._T_ref_last)
            return PeerFrame(stamp, True, is_new, fitness, rmse)
        T_world_cam = se3.orthonormalise(self._T_world_ref @ T_ref_cam)
        self._found(stamp, T_world_cam)
        self._T_ref_last = T_ref_cam
        self._first_fitness = self._first_fitness or fitness
        is_new = not self._to_keyframe or self.options.left_behind(T_ref_cam, fitness / self._first_fitness)
        if is_new:
            self._set_reference(rgbd, T_world_cam)
        return PeerFrame(stamp, False, is_new, fitness, rmse)

    def _align(self, rgbd: Any, T_ref_cam: FloatArray) -> tuple[FloatArray | None, float, float]:
        """The pose in the reference's frame from a first guess, None if there is none; fitness; RMSE."""
        o3d = self._o3d
        try:
            with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
                found = o3d.t.pipelines.odometry.rgbd_odometry_multi_scale(
                    rgbd, self._reference, self._intrinsics, self._tensor(T_ref_cam), depth_scale=1.0,
                    depth_max=self.options.max_depth, method=self._method,
                )  # fmt: skip
        except RuntimeError:  # a singular system
            return None, 0.0, float("nan")
        T, fitness, rmse = found.transformation.numpy().astype(np.float64), float(found.fitness), found.inlier_rmse
        is_good = fitness >= _LEAST_FITNESS and bool(np.isfinite(T).all())
        return (se3.orthonormalise(T) if is_good else None), fitness, float(rmse)

    def _set_reference(self, rgbd: Any, T_world_ref: FloatArray) -> None:
        self._reference, self._T_world_ref, self._T_ref_last = rgbd, T_world_ref, np.eye(4)
        self._first_fitness, self._lost_in_a_row = None, 0
        self.keyframes += 1

    def _found(self, stamp: float, T_world_cam: FloatArray) -> None:
        self._lost_in_a_row = 0
        self.stamps.append(stamp)
        self.poses.append(T_world_cam)

    def _tensor(self, array: Any) -> Any:
        return self._o3d.core.Tensor(np.ascontiguousarray(array))


def run_peer(name: str, dataset: Dataset, frames: slice = slice(None), progress: Progress = no_progress) -> Estimate:
    """Track frames of a dataset with one of PEERS; its poses at the depth frames' stamps.

    Its input is registered by `rstrack.data.registration`. A pose is taken for that of the middle of the depth image's
    readout, as our baseline's are, and interpolated to the stamp: at the stamp itself all of them would be half a
    readout late.

    Raises UserError: unknown name, Open3D cannot be loaded, no such frames, an image cannot be read, all were lost.
    """
    chosen, registrar = dataset.chosen(frames), Registrar(dataset.rig)
    tracker = PeerTracker(name, registrar.camera)
    begin = time.perf_counter()
    seconds = timed_frames(
        name, chosen, lambda k: registered_image(dataset, registrar, k),
        lambda k, image: tracker.feed(float(dataset.stamps[k]), image), progress,
    )  # fmt: skip
    if not tracker.poses:
        raise UserError(f"{dataset.root}: {name} found no pose: the depth images hold next to nothing")
    stamps = np.array(tracker.stamps)
    T_world_depth = se3.interpolated(stamps + readout_s(dataset, 0.5), np.array(tracker.poses), stamps)
    info = run_info(name, {"open3d": version("open3d")}, "Open3D on the CPU", dataset, chosen, begin, seconds)
    frames_told = [
        {
            "stamp": r.stamp, "lost": r.lost, "keyframe": r.keyframe and _KEYFRAME in name,
            "inliers_depth": r.fitness, "inlier_rmse": r.inlier_rmse,
        }
        for r in tracker.reports
    ]  # fmt: skip
    lost = sum(report.lost for report in tracker.reports)
    info |= {"keyframes": tracker.keyframes, "lost": lost, "frames": frames_told}
    return Estimate(stamps, se3.orthonormalise(T_world_depth), info=info)


@cache
def open3d() -> Any:
    """The module. Raises UserError with what to install."""
    try:
        import open3d as module
    except ModuleNotFoundError as error:
        raise UserError(f"the peers need Open3D ({error}): {how_to_install('peers', package='open3d')}") from None
    except (ImportError, OSError) as error:
        needed = "libusb-1.0-0 libgl1 libegl1 libx11-6 libidn2-0 libgomp1"
        first = str(error).splitlines()[0]
        raise UserError(f"Open3D does not load ({first}): on Debian or Ubuntu, apt-get install {needed}") from None
    return module
