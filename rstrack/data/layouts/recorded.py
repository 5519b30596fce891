"""A recording's folder as a data set: listed images and stamps, the clock that its camera file wants, and truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rsgen.array_types import FloatArray
from rsgen.errors import UserError
from rsgen.sequence.trajectory import Trajectory
from rstrack.data.camera_file import RigFile
from rstrack.data.dataset import Dataset
from rstrack.data.image_files import ImageReader
from rstrack.data.timing import Timing, stream_timing

CAMERA_FILES = ("camera.yaml", "calibration.yaml", "camchain-imucam.yaml", "camchain.yaml")


@dataclass(frozen=True)
class RecordedFolder:
    """What is found in a folder. Stamps as listed (n,) and (m,) in seconds, increasing; truth_poses are T_world_depth.

    file: the camera file's content. notes: what had to be assumed, each in one line. depth_numbers: of frames that are
    numbered, the seconds (n,) by their numbers alone.
    """

    file: RigFile
    depth_stamps: FloatArray
    color_stamps: FloatArray
    images: ImageReader
    truth_poses: Trajectory | None
    notes: tuple[str, ...] = ()
    depth_numbers: FloatArray | None = None

    def dataset(self, root: Path) -> Dataset:
        """With the stamps as the camera file wants them. Raises UserError."""
        name = root.resolve().name
        file = self.file.of(name)
        try:
            depth = stream_timing("depth", self.depth_stamps, file.stamps, file.depth_offset_s)
            color = stream_timing("colour", self.color_stamps, file.stamps, 0.0)
        except UserError as error:
            raise UserError(f"{root}: {error}") from None
        if self.depth_numbers is not None:
            depth = replace(depth, listed=self.depth_numbers)
        timing = Timing(depth, color, file.color_offset_s, file.notes)
        dataset = Dataset(
            name, root, file.rig, depth.used, color.used, (), self.images, truth_poses=self.truth_poses,
            notes=self.notes, timing=timing, scan_named=file.scan_named, depth_scale=file.depth_scale,
            depth_offset_s=file.depth_offset_s, depth_error=file.depth_error,
        )  # fmt: skip
        found = dataset.with_color_offset(file.color_offset_s or 0.0, drift=file.color_drift)
        return replace(found, timing=timing)


def find_camera_file(root: Path, camera_file: Path | None) -> Path | None:
    """The given one, else that in the folder, None without any."""
    if camera_file is not None:
        return camera_file
    return next((root / name for name in CAMERA_FILES if (root / name).exists()), None)


def repeats_note(name: str, again: npt.NDArray[np.bool_]) -> str:
    """For the screen. again (n,): which images of a stream are the one before again."""
    return (
        f"{np.count_nonzero(again)} of {len(again)} {name} images are the one before again, byte for byte: they were "
        "not taken anew, and are left out"
    )
