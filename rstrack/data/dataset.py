"""Datasets: rsgen sequences, TUM RGB-D, ICL-NUIM and 7-Scenes folders, as frames of a depth image and its colours.

dataset = open_dataset(Path("out/lr_kt2"))
for frame in dataset.frames():
    tracker.feed(frame)
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rsgen.array_types import Float32Array, FloatArray
from rsgen.errors import UserError
from rsgen.geometry.spline import Spline
from rsgen.sequence.format import DEPTH_SCALE
from rsgen.sequence.images import Sequence
from rsgen.sequence.trajectory import Trajectory
from rstrack.data.camera_file import RigFile, camera_content, run_cameras
from rstrack.data.estimate import INFO
from rstrack.data.image_files import ImageReader, NoisyImages, prefetched
from rstrack.data.imu.recording import ImuFiles, ImuRecording, ReadImu, find_imu
from rstrack.data.layouts import LAYOUTS, layout_of
from rstrack.data.registration import RegisteredImage, Registrar
from rstrack.data.rig import NO_DEPTH_ERROR, DepthError, Frame, Image, Rig
from rstrack.data.timing import Timing, stream_timing

__all__ = ["Dataset", "Frame", "Image", "Rig", "group_colors", "open_dataset", "open_tracked"]

# Streams that are half a period apart tie, whatever the last digits of their stamps say.
_TIE_S = 1e-6


@dataclass(frozen=True)
class Dataset:
    """Frames on disk with the cameras that took them.

    stamps: (n,) seconds, one for each depth image, strictly increasing. color_stamps: (m,) seconds, increasing.
    groups: for each frame the indices of its colour images.
    truth: T_world_depth(t), of exact rsgen sequences. truth_poses: T_world_depth, of others that have it.
    sequence: the rsgen sequence itself, where it is an exact one (`rstrack.data.layouts.generated`). notes: what had to
    be assumed when it was read. timing: of recordings, how their stamps came about. color_drift: seconds a second that
    colour's offset grows by, see `with_color_offset`. scan_named: whether the cameras' description states which way
    images are read. depth_scale: units per metre of the depth images. depth_offset_s: what has been added to the stamps
    of registered depth, see `rstrack.data.camera_file`. images: as they are on disk; depth_error: of the depth in them.
    imu_files: where an IMU's samples are.
    """

    name: str
    root: Path
    rig: Rig
    stamps: FloatArray
    color_stamps: FloatArray
    groups: tuple[tuple[int, ...], ...]
    images: ImageReader
    truth: Spline | None = None
    truth_poses: Trajectory | None = None
    sequence: Sequence | None = None
    notes: tuple[str, ...] = ()
    timing: Timing | None = None
    color_drift: float = 0.0
    scan_named: bool = True
    depth_scale: float = DEPTH_SCALE
    depth_offset_s: float = 0.0
    depth_error: DepthError = NO_DEPTH_ERROR
    imu_files: ImuFiles | None = None

    def __len__(self) -> int:
        return len(self.stamps)

    def chosen(self, frames: slice) -> range:
        """The numbers of these frames. Raises UserError: there are none."""
        chosen = range(len(self))[frames]
        if not len(chosen):
            raise UserError(f"{self.root}: has no frame {frames.start}: its frames are 0 to {len(self) - 1}")
        return chosen

    def interval_s(self, frames: range) -> float | None:
        """The median time from one of these frames to the next, s; None of a single one."""
        return float(np.median(np.diff(self.stamps[frames]))) if len(frames) > 1 else None

    def frame(self, k: int, *, color: bool = True) -> Frame:
        """Frame k, 0 ≤ k < len, its colour images left out on request.

        Raises UserError naming the file that is missing, damaged or of a wrong size.
        """
        if not 0 <= k < len(self):
            raise IndexError(f"{self.name} has frames 0 to {len(self) - 1}, not {k}")
        depth = Image(float(self.stamps[k]), self.depth(k))
        colors = tuple(Image(float(self.color_stamps[i]), self.images.color(i)) for i in self.groups[k] if color)
        return Frame(depth, colors)

    def readable_frame(self, k: int, *, color: bool = True) -> tuple[Frame | None, tuple[str, ...]]:
        """Frame k without those of its images that cannot be read, and what is wrong with them, one line each.

        Without its depth image it is no frame: None.
        """
        problems: list[str] = []

        def image(stamp: float, read: Callable[[int], npt.NDArray[Any]], i: int) -> list[Image]:
            try:
                return [Image(float(stamp), read(i))]
            except UserError as error:
                problems.append(str(error))
                return []

        depth = image(self.stamps[k], self.depth, k)
        if not depth:
            return None, tuple(problems)
        group = self.groups[k] if color else ()
        colors = [found for i in group for found in image(self.color_stamps[i], self.images.color, i)]
        return Frame(depth[0], tuple(colors)), tuple(problems)

    def depth(self, k: int) -> Float32Array:
        """Planar z (h, w) in m of depth image k, 0 = missing, without the camera's own error. Raises UserError."""
        return self.depth_error.corrected(self.images.depth(k), self.rig.depth_camera)

    def frames(self, first: int = 0, last: int | None = None, prefetch: int = 2) -> Iterator[Frame]:
        """Frames [first, last), decoded ahead in a thread that ends with the iteration, early or not.

        Raises UserError as `frame` does, when it is that frame's turn.
        """
        return prefetched(self.frame, range(len(self))[first:last], prefetch)

    @property
    def imu(self) -> ImuRecording | None:
        """What an IMU recorded meanwhile, None without one; it is read when first asked for.

        Raises UserError, one line: the file that is wrong, or that nothing states where the IMU sits.
        """
        return None if self.read_imu is None else self.read_imu.recording

    @cached_property
    def read_imu(self) -> ReadImu | None:
        """The same with what was assumed or is odd about it. Raises UserError."""
        if self.imu_files is None:
            return None
        return self.imu_files.read(self.stamps, self.middle, self.rig.T_color_depth)

    @property
    def middle(self) -> float:
        """The stamp in s at which colour's offset is what it is called, whatever it grows by."""
        return float(self.stamps[len(self) // 2])

    def with_color_offset(
        self, offset_s: float, note: str = "", drift: float | None = None, sigma_s: float | None = None
    ) -> Dataset:
        """The same recording with `offset_s` added to the stamps that colour would have without any offset.

        note: for the screen, where the offset comes from. drift: what it grows by, s/s, if not as it did. sigma_s: how
        far it may be wrong, if not as far as the rig states. Without a `timing` it is added to the stamps as they are.
        """
        drift = self.color_drift if drift is None else drift
        before = self.color_stamps if self.timing is None else self.timing.color.used
        color_stamps = before + offset_s + drift * (before - self.middle)
        timing = self.timing
        if timing is not None:
            notes = (*timing.notes, note) if note else timing.notes
            timing = replace(timing, color_offset_s=offset_s, notes=notes)
        groups = group_colors(self.stamps, color_stamps)
        sigma = self.rig.sigma if sigma_s is None else replace(self.rig.sigma, offset_s=sigma_s)
        return replace(
            self, rig=replace(self.rig, sigma=sigma), color_stamps=color_stamps, groups=groups, timing=timing,
            color_drift=drift,
        )  # fmt: skip

    def noisy(self, sigma_depth: float, sigma_intensity: float, seed: int) -> Dataset:
        """The same recording with noise in its images, see `rstrack.data.image_files.with_noise`."""
        if not (sigma_depth or sigma_intensity):
            return self
        return replace(self, images=NoisyImages(self.images, sigma_depth, sigma_intensity, seed))

    def with_color_falloff(self, falloff: float, note: str = "") -> Dataset:
        """The same recording with colours that are known to darken so towards the corners, see `Rig`.

        note: for the screen, where that comes from.
        """
        rig = replace(self.rig, color_falloff=falloff)
        return replace(self, rig=rig, notes=(*self.notes, note) if note else self.notes)

    def with_depth_pattern(self, pattern: tuple[float, ...], note: str = "") -> Dataset:
        """The same recording with a depth camera that is known to be off by this pattern, see `DepthError`.

        note: for the screen, where that comes from.
        """
        error = replace(self.depth_error, pattern=pattern)
        return replace(self, depth_error=error, notes=(*self.notes, note) if note else self.notes)

    def seen_with(self, rig: Rig) -> Dataset:
        """The same images taken for those of other cameras, of as many pixels, whose colour may have an offset."""
        if self.timing is not None:
            return replace(self, rig=rig)
        depth, color = (
            stream_timing("depth", self.stamps, "raw", 0.0),
            stream_timing("colour", self.color_stamps, "raw", 0.0),
        )
        return replace(self, rig=rig, timing=Timing(depth, color, 0.0))

    def with_imu_file(self, given: Path) -> Dataset:
        """The same recording with its IMU as a file describes it, which is read when the IMU is asked for."""
        return self if self.imu_files is None else replace(self, imu_files=replace(self.imu_files, given=given))

    @property
    def cameras(self) -> dict[str, Any] | None:
        """For run.json: the cameras as a camera.yaml has them; None of a generated sequence with the cameras that took
        it, which it holds itself."""
        if self.timing is None:
            return None
        clocks = self.timing.mode, self.depth_offset_s, self.timing.color_offset_s, self.color_drift
        return camera_content(RigFile(self.rig, self.depth_scale, *clocks, depth_error=self.depth_error))

    def as_seen_by(self, info: dict[str, Any]) -> Dataset:
        """The same recording with depth's pattern, colour's offset, darker corners and the IMU's description as a run
        had them in the end, whose run.json holds `info`."""
        clocks, recorded, late = (info.get(name) for name in ("clocks", "dataset", "color_late"))
        offset_s = clocks.get("color_offset_s") if self.timing is not None and isinstance(clocks, dict) else None
        late_s = late.get("seconds") if isinstance(late, dict) else None
        timed = self
        if isinstance(offset_s, float | int) or isinstance(late_s, float | int):
            timed = self.with_color_offset(float(offset_s or 0.0) + float(late_s or 0.0))
        imu_file = recorded.get("imu_file") if isinstance(recorded, dict) else None
        if isinstance(imu_file, str) and self.imu_files is not None and self.imu_files.given is None:
            timed = timed.with_imu_file(Path(imu_file))
        pattern = recorded.get("depth_pattern") if isinstance(recorded, dict) else None
        if self.depth_error.pattern is None and isinstance(pattern, list):
            timed = timed.with_depth_pattern(tuple(float(x) for x in pattern))
        falloff = recorded.get("color_falloff") if isinstance(recorded, dict) else None
        if self.rig.color_falloff is not None or not isinstance(falloff, float | int):
            return timed
        return timed.with_color_falloff(float(falloff))


def open_dataset(path: Path, camera_file: Path | None = None, imu_file: Path | None = None) -> Dataset:
    """Read the description and listings of a folder; images are read when asked for.

    path: a folder of one of the layouts in `rstrack.data.layouts`; of a rig, FOLDER:COLOR,DEPTH names two of its
      cameras, which otherwise are the first of either kind.
    camera_file: the cameras, instead of those of a sequence.yaml, camera.yaml or calibration.yaml in the folder;
      see `rstrack.data.camera_file`.
    imu_file: what describes the IMU, see `rstrack.data.imu.description`; without it the IMU is read when asked for.
    Raises UserError, one line: what is missing or wrong, where, and how to mend it.
    """
    root, cameras = _folder_and_cameras(Path(path))
    if not root.is_dir():
        raise UserError(f"{root}: no such folder: give {' or '.join(LAYOUTS)}")
    layout: Any = import_module(layout_of(root))
    found: Dataset = layout.read(root, camera_file, *cameras)
    meta = found.images.meta if isinstance(found.images, Sequence) else None
    found = replace(found, root=Path(path), imu_files=find_imu(root, imu_file, meta))
    if imu_file is not None:
        _ = found.read_imu  # what was named has to be right
    return found


def _folder_and_cameras(path: Path) -> tuple[Path, tuple[str, ...]]:
    """A folder, and the names of a colour and a depth camera if they are given behind a colon. Raises UserError."""
    if path.exists() or ":" not in path.name:
        return path, ()
    root, _, words = str(path).rpartition(":")
    names = tuple(words.split(","))
    if len(names) != 2 or not (Path(root) / "sequence.yaml").exists():
        raise UserError(f"{path}: no such folder; of an rsgen sequence with several cameras, name two: DIR:COLOR,DEPTH")
    return Path(root), names


def open_tracked(path: Path, run: Path, info: dict[str, Any], camera_file: Path | None = None) -> Dataset:
    """A folder as a run saw it, whose run.json holds `info`: by the camera file that is named, else by the run's own
    cameras, else, of runs that do not state them, by the folder's.

    Arguments as in `open_dataset`. Raises UserError.
    """
    recorded = None if run_cameras(info) is None else run / INFO
    return open_dataset(path, camera_file or recorded).as_seen_by(info)


def recorded_dataset(
    root: Path, file: RigFile, depth_stamps: FloatArray, color_stamps: FloatArray, images: ImageReader,
    truth_poses: Trajectory | None, notes: tuple[str, ...], depth_numbers: FloatArray | None = None,
) -> Dataset:  # fmt: skip
    """A recording's folder with the stamps as its camera file wants them.

    file: the camera file's content. depth_stamps (n,), color_stamps (m,): as listed, s, increasing. truth_poses:
    T_world_depth. notes: what had to be assumed, each in one line. depth_numbers: of frames that are numbered, the
    seconds (n,) by their numbers alone. Raises UserError.
    """
    name = root.resolve().name
    file = file.of(name)
    try:
        depth = stream_timing("depth", depth_stamps, file.stamps, file.depth_offset_s)
        color = stream_timing("colour", color_stamps, file.stamps, 0.0)
    except UserError as error:
        raise UserError(f"{root}: {error}") from None
    if depth_numbers is not None:
        depth = replace(depth, listed=depth_numbers)
    timing = Timing(depth, color, file.color_offset_s, file.notes)
    dataset = Dataset(
        name, root, file.rig, depth.used, color.used, (), images, truth_poses=truth_poses, notes=notes, timing=timing,
        scan_named=file.scan_named, depth_scale=file.depth_scale, depth_offset_s=file.depth_offset_s,
        depth_error=file.depth_error,
    )  # fmt: skip
    found = dataset.with_color_offset(file.color_offset_s or 0.0, drift=file.color_drift)
    return replace(found, timing=timing)


def group_colors(depth_stamps: npt.ArrayLike, color_stamps: npt.ArrayLike) -> tuple[tuple[int, ...], ...]:
    """For each depth image (n,) the colour images (m,) that are nearer to it than to any other; ties: the earlier.

    Stamps in seconds, both increasing. Every colour image is in exactly one group.
    """
    depth, color = np.asarray(depth_stamps, float), np.asarray(color_stamps, float)
    after = np.searchsorted(depth, color)
    later, earlier = np.minimum(after, len(depth) - 1), np.maximum(after - 1, 0)
    is_later_nearer = np.abs(depth[later] - color) < np.abs(depth[earlier] - color) - _TIE_S
    owner = np.where(is_later_nearer, later, earlier)
    bounds = np.searchsorted(owner, np.arange(len(depth) + 1))
    return tuple(tuple(range(a, b)) for a, b in zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True))


def registered_image(dataset: Dataset, registrar: Registrar, k: int) -> RegisteredImage:
    """Frame k of a dataset with the colour image whose stamp is nearest, be it half a second off.

    Raises UserError naming an image that is missing, damaged or of a wrong size.
    """
    nearest = int(np.argmin(np.abs(dataset.color_stamps - dataset.stamps[k])))
    return registrar(dataset.depth(k), dataset.images.color(nearest))
