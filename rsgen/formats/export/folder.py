"""What the exports share: a fresh folder, linked images, and a camera in other tools' terms."""

from __future__ import annotations

import errno
import os
from collections.abc import Sequence as Items
from dataclasses import dataclass, replace
from pathlib import Path

from rsgen.array_types import FloatArray
from rsgen.console.progress import Progress
from rsgen.errors import UserError
from rsgen.files import atomic_write, read_bytes, write_error
from rsgen.geometry.camera import Camera
from rsgen.geometry.shutter import Shutter
from rsgen.sequence.reader import Sequence, Stream

EPOCH_S = 1_000_000_000
"""Added to stamps that are file names: all have 19 digits then, as EuRoC's have, and sort by time."""

# What a hard link fails with where a copy would do: another disk, a file system without links, too many of them.
_NO_LINK = (errno.EXDEV, errno.EPERM, errno.ENOTSUP, errno.EMLINK, errno.EACCES, errno.ENOSYS)


def new_folder(out: Path) -> Path:
    """Make the folder `out`. Raises UserError if it cannot be made, or is there and holds anything."""
    out = Path(out)
    try:
        if out.exists() and not out.is_dir():
            raise UserError(f"{out}: is a file, not a folder: choose another --out")
        if out.is_dir() and (names := sorted(path.name for path in out.iterdir())):
            raise UserError(f"{out}: is not empty ({names[0]}, ...): choose another --out or delete it")
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(out, error) from None
    return out


def make_folders(*folders: Path) -> None:
    """Make folders with their parents. Raises UserError."""
    for folder in folders:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise write_error(folder, error) from None


def place_images(
    sources: Items[Path], targets: Items[Path], copy: bool, progress: Progress, share: tuple[float, float] = (0.0, 1.0)
) -> None:
    """Hard links from `targets` to `sources`, which take no room; copies where links cannot be, or on request.

    share: where in the whole export's progress this begins and ends. Raises UserError naming the file.
    """
    for k, (source, target) in enumerate(zip(sources, targets, strict=True)):
        if copy or not _linked(source, target):
            atomic_write(target, read_bytes(source))
        progress("export", share[0] + (share[1] - share[0]) * (k + 1) / len(sources), target.name)


def _linked(source: Path, target: Path) -> bool:
    try:
        os.link(source.resolve(), target)
    except OSError as error:
        if error.errno not in _NO_LINK:
            raise write_error(target, error) from None
        return False
    return True


def image_streams(sequence: Sequence) -> tuple[tuple[Stream, FloatArray], tuple[Stream, FloatArray]]:
    """Colour and depth streams, each with the camera of its images and its T_cam_depth (4, 4).

    Registered depth has the colour camera and keeps the sensor's shutter, row for row.
    """
    color, depth = sequence.streams["color"], sequence.streams["depth"]
    return (color, sequence.T_color_depth), (
        replace(depth, camera=sequence.depth_image_camera), sequence.T_image_depth,
    )  # fmt: skip


@dataclass(frozen=True)
class RowClock:
    """When image row v is exposed: mid-exposure at stamp + first_s + v · delay_s; delay_s < 0 from bottom to top."""

    first_s: float
    delay_s: float


def row_clock(name: str, camera: Camera, shutter: Shutter) -> RowClock:
    """The rows' times of a camera called `name`. Raises UserError for one that is read column by column."""
    if shutter.readout_s == 0.0:
        return RowClock(-0.5 * shutter.exposure_s, 0.0)
    if not shutter.by_rows:
        raise UserError(
            f"{name}: scan {shutter.scan} reads columns, but a line_delay belongs to rows: render with top-bottom"
        )
    rows = [[0.0, 0.0], [0.0, 1.0]]
    first, second = shutter.line_mid_time(0.0, shutter.line_of_pixel(rows, camera), camera)
    return RowClock(float(first), float(second - first))


def four_coefficients(name: str, camera: Camera) -> list[float]:
    """Distortion as the four numbers that Kalibr and EuRoC have; zeros (of radtan) for a pinhole. Raises UserError."""
    if camera.model == "pinhole":
        return [0.0] * 4
    if camera.model == "double_sphere":
        raise UserError(f"{name}: EuRoC has no double_sphere lens: render with radtan or fisheye, or export kalibr")
    if any(camera.distortion[4:]):
        number, k = next((i, k) for i, k in enumerate(camera.distortion[4:], 3) if k)
        raise UserError(
            f"{name}: k{number} = {k:g} has no place among Kalibr's and EuRoC's four coefficients: "
            f"render with k{number} = 0 or use a fisheye model"
        )
    return list(camera.distortion[:4])
