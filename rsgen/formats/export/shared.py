"""What the exports share: options, a fresh folder or file, linked images, aligned depth, colour's poses, lenses."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Mapping
from collections.abc import Sequence as Items
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from rsgen.array_types import Float32Array, FloatArray
from rsgen.console.progress import Progress
from rsgen.errors import UserError
from rsgen.files import atomic_write, read_bytes, write_error
from rsgen.geometry.camera import Camera
from rsgen.image_codecs import encode_png
from rsgen.produce.writer import quantise
from rsgen.sensors.depth import register_depth
from rsgen.sensors.reports import reported_poses, sequence_mocap
from rsgen.sequence.camera_yaml import Cameras, ColorClock, camera_yaml
from rsgen.sequence.format import ground_truth
from rsgen.sequence.images import ImageStream, Rig, Sequence

Storage = Literal["sqlite3", "mcap"]
EPOCH_S = 1_000_000_000
"""Added to stamps that are file names: all have 19 digits then, as EuRoC's have, and sort by time."""

# What a hard link fails with where a copy would do: another disk, a file system without links, too many of them.
_NO_LINK = (errno.EXDEV, errno.EPERM, errno.ENOTSUP, errno.EMLINK, errno.EACCES, errno.ENOSYS)


NO_DEPTH = "nothing.png"
"""All zeros: for colour images that no depth image was taken with."""


@dataclass(frozen=True)
class ExportOptions:
    """What a user may choose; an export ignores what does not concern it.

    name: of the export, for a module that handles several. copy: images, rather than linking them. scene: for the
    video, which renders again. storage: of a ROS 2 bag.
    """

    name: str = ""
    copy: bool = False
    scene: Path | None = None
    storage: Storage = "sqlite3"


DEFAULTS = ExportOptions()


def new_file(out: Path, what: str, suffixes: Items[str]) -> Path:
    """The path `out` of `what`, to be written. Raises UserError if it is there, named otherwise, or has no folder."""
    out = Path(out)
    if suffixes and out.suffix.lower() not in suffixes:
        raise UserError(f"{out}: {what} is named {' or '.join(suffixes)}: choose another --out")
    if out.exists():
        raise UserError(f"{out}: is there already: choose another --out or delete it")
    if not out.parent.is_dir():
        raise UserError(f"{out.parent}: no such folder: make it or choose another --out")
    return out


def new_folder(out: Path, *inside: str) -> None:
    """Make the folder `out`, and those inside. Raises UserError if one cannot be made, or `out` holds anything."""
    folder = out
    try:
        if out.exists() and not out.is_dir():
            raise UserError(f"{out}: is a file, not a folder: choose another --out")
        if out.is_dir() and (names := sorted(path.name for path in out.iterdir())):
            raise UserError(f"{out}: is not empty ({names[0]}, ...): choose another --out or delete it")
        for folder in (out, *(out / name for name in inside)):
            folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(folder, error) from None


def part_of(progress: Progress, begin: float, end: float) -> Progress:
    """The progress of what is `begin` to `end` of the whole export."""
    return lambda stage, fraction, note: progress(stage, begin + (end - begin) * fraction, note)


def place_images(
    sources: Items[Path], folder: Path, copy: bool, progress: Progress, names: Items[str] | None = None
) -> None:
    """Hard links in `folder` to `sources`, which take no room; copies where links cannot be, or on request.

    names: of the links, where they are not the files' own. Raises UserError naming the file.
    """
    targets = [folder / name for name in names or [source.name for source in sources]]
    for k, (source, target) in enumerate(zip(sources, targets, strict=True), 1):
        if copy or not _linked(source, target):
            atomic_write(target, read_bytes(source))
        progress("export", k / len(sources), target.name)


def _linked(source: Path, target: Path) -> bool:
    try:
        os.link(source.resolve(), target)
    except OSError as error:
        if error.errno not in _NO_LINK:
            raise write_error(target, error) from None
        return False
    return True


def image_streams(sequence: Rig) -> dict[str, ImageStream]:
    """All streams by name, each with the camera of its images and that camera's T_cam_body.

    Registered depth has the colour camera and keeps the sensor's shutter, row for row.
    """
    streams = dict(sequence.streams)
    if isinstance(sequence, Sequence):
        camera, T = sequence.depth_image_camera, sequence.T_image_depth
        streams["depth"] = replace(streams["depth"], camera=camera, T_cam_body=T)
    return streams


def counted(streams: Mapping[str, ImageStream]) -> str:
    """How many images there are, in words."""
    words = {"color": "colour"}
    kinds = list(dict.fromkeys(stream.kind for stream in streams.values()))
    counts = (sum(len(s.paths) for s in streams.values() if s.kind == kind) for kind in kinds)
    parts = [f"{count} {words.get(kind, kind)}" for count, kind in zip(counts, kinds, strict=True)]
    return f"{', '.join(parts[:-1])}{' and ' if len(parts) > 1 else ''}{parts[-1]} images"


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


def nearest_depth(sequence: Sequence, k: int) -> int:
    """The depth image that is nearest in time to colour image k."""
    return int(np.abs(sequence.streams["depth"].stamps - sequence.streams["color"].stamps[k]).argmin())


def depth_warper(sequence: Sequence, folder: Path) -> Callable[[int], Float32Array]:
    """What writes depth image k into `folder`, warped into the colour camera, and returns it, planar z (h, w), m."""
    color, depth = sequence.streams["color"], sequence.streams["depth"]
    rays = depth.camera.unproject(depth.camera.pixel_grid())

    def write(k: int) -> Float32Array:
        z = register_depth(rays, sequence.depth(k), color.camera, sequence.T_color_depth)
        atomic_write(folder / depth.paths[k].name, encode_png(quantise(z, depth.depth_scale)))
        return z

    return write


def aligned_depth(sequence: Sequence, folder: Path, copy: bool, progress: Progress) -> list[str]:
    """Write depth images into `folder`, 16-bit in the sequence's units; returns the file name for each colour image.

    Of each colour image the depth image that is nearest in time, within half a period of the slower stream. Links (or
    copies with `copy`) where depth has the colour camera's pixels: registered, or one camera for both; else warped by
    geometry alone, as `export registered` does. Raises UserError.
    """
    color, depth = sequence.streams["color"], sequence.streams["depth"]
    nearest = np.array([nearest_depth(sequence, k) for k in range(len(color.paths))])
    apart = np.abs(depth.stamps[nearest] - color.stamps)
    paired = apart <= 0.5 / min(color.rate_hz, depth.rate_hz)
    used = np.unique(nearest[paired])
    sources = [depth.paths[i] for i in used]
    if has_color_pixels(sequence):
        place_images(sources, folder, copy, progress)
    else:
        write = depth_warper(sequence, folder)
        for count, i in enumerate(used, 1):
            write(int(i))
            progress("export", count / len(used), depth.paths[i].name)
    if not paired.all():
        atomic_write(folder / NO_DEPTH, encode_png(np.zeros((color.camera.height, color.camera.width), np.uint16)))
    return [depth.paths[i].name if found else NO_DEPTH for i, found in zip(nearest, paired, strict=True)]


def registered_cameras(sequence: Sequence) -> dict[str, Any]:
    """A camera.yaml of depth that was warped into the colour camera: from where, and whose rows' times it has."""
    color, depth = sequence.streams["color"], sequence.streams["depth"]
    driver = any((stream.listed != stream.stamps).any() for stream in (color, depth))
    clock = ColorClock("auto", is_exact=False) if driver else ColorClock()
    return camera_yaml(Cameras.of(color, depth, sequence.T_color_depth), clock, is_registered=True)


def color_truth(sequence: Sequence) -> tuple[FloatArray, str]:
    """Rows (n, 8) of the colour camera's true poses, or of those that a motion capture reports, and words for that."""
    T_color_depth = sequence.as_taken.T_color_depth
    if (mocap := sequence_mocap(sequence)) is not None:
        return reported_poses(sequence.spline, *mocap, T_color_depth), ", as a motion capture reports it"
    stamps = (sequence.streams[name].stamps for name in ("color", "depth"))
    return ground_truth(sequence.spline, *stamps, T_cam_body=T_color_depth), ""


def has_color_pixels(sequence: Sequence) -> bool:
    """Whether the images in depth/ are in the colour camera's pixels."""
    color, depth = sequence.streams["color"], sequence.streams["depth"]
    one_camera = color.camera == depth.camera and bool((sequence.T_color_depth == np.eye(4)).all())
    return depth.registered or one_camera
